"""Residuals of a recording with every frame's pose free, to first order: of each spot against all the others.

A residual left by a fit smears: one spot that is off drags the pose, and its neighbours seem off too. Leaving the spot
out of its frame's fit tells what the others expect of it. In closed form from the one fit with all: with the whitened
Jacobian A, H = A (A^T A)^-1 A^T and the fit's residual e = (I - H) r, the residual against the others is
(I - H_ii)^-1 e_i, its covariance (I - H_ii)^-1 (Cook & Weisberg 1982, Residuals and Influence in Regression, ch. 2.2,
for rows; ours: for the two rows of one spot together).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from lab.runs.model_check.recording import ModelCheckRecording, finite, whitening

_RANK = 1e-12  # of a normal matrix' largest eigenvalue, columns scaled to one: below lies rounding
_LARGEST_STEP = np.array([0.1] * 3 + [0.05] * 3)  # m, rad: farther than this a pose is no good estimate; it is left
_OWN = 1e-3  # a spot that its frame's pose follows to all but this share has no others to be compared with
OUTLIER_SIGMAS = 6.0  # of a view's usual scatter about its own median: p = 4e-9 for a normal error
_ROUNDS = 2  # of dropping the worst spot of each frame: one gross error makes its neighbours look wrong too


@dataclass(frozen=True, slots=True)
class LinearisedFrames:
    """K frames of n views about their poses, whitened by the claimed covariances; 0 for views that are not used."""

    frames: Ints  # (K,) index into the recording
    poses: Pose  # (K,) after a step towards the pixels
    used: Bools  # (K, n)
    outlier: Bools  # (K, n) seen, but grossly elsewhere
    W: Array  # (K, n, 2, 2), 1/px
    residual: Array  # (K, n, 2) measured minus projected
    A: Array  # (K, n, 2, 6) its Jacobian by the pose error
    gain: Array  # (K, 6, 6) pseudo-inverse of A^T A
    rank: Ints  # (K,) of it: 6 where the frame has a pose of its own

    @property
    def dof(self) -> int:
        """Numbers measured less those that the poses take."""
        return int(2 * self.used.sum() - self.rank.sum())

    def to_pose(self, rows: Array) -> Array:
        """What whitened pixels (K, n, 2, ...) do to each frame's pose: (K, 6, ...)."""
        flat = rows.reshape(len(rows), rows.shape[1] * 2, -1)
        A = self.A.reshape(len(rows), -1, 6)
        out = self.gain @ (np.swapaxes(A, -1, -2) @ flat)
        return out.reshape(len(rows), 6, *rows.shape[3:])

    def pose_free(self, rows: Array) -> Array:
        """What the poses cannot follow of whitened pixels (K, n, 2, ...)."""
        flat = rows.reshape(len(rows), rows.shape[1] * 2, -1)
        A = self.A.reshape(len(rows), -1, 6)
        return np.asarray((flat - A @ self.to_pose(rows).reshape(len(rows), 6, -1)).reshape(rows.shape))

    def own_share(self) -> Array:
        """I - H_ii (K, n, 2, 2): what of each view's error the poses do not follow; 0 for views that are not used."""
        own = np.eye(2) - self.A @ (self.gain[:, None] @ np.swapaxes(self.A, -1, -2))
        return np.where(self.used[..., None, None], own, 0.0)

    def weights(self) -> Array:
        """(I - H_ii)^-1 (K, n, 2, 2); nan where the others do not tell where the spot should be, or it is not used."""
        own = np.eye(2) - self.A @ (self.gain[:, None] @ np.swapaxes(self.A, -1, -2))
        a, b, c = own[..., 0, 0], own[..., 0, 1], own[..., 1, 1]
        det = a * c - b * b
        # The smaller eigenvalue is at least det / trace; it is the share of the spot that the pose does not follow.
        known = self.used & (a + c > _OWN) & (det > _OWN * (a + c))
        inverse = np.stack([np.stack([c, -b], -1), np.stack([-b, a], -1)], -2)
        return np.where(known[..., None, None], inverse / np.where(known, det, 1.0)[..., None, None], np.nan)

    def against_others(self) -> tuple[Array, Array]:
        """Residuals (K, n, 2), px, of each view against the pose of the other views, and their covariance."""
        weights = self.weights()
        whitened = (weights @ self.pose_free(self.residual)[..., None])[..., 0]
        back = np.linalg.inv(np.where(self.used[..., None, None], self.W, np.eye(2)))
        return (back @ whitened[..., None])[..., 0], back @ weights @ np.swapaxes(back, -1, -2)

    def left_out(self, views: Ints) -> Array:
        """(I - H_SS)^-1 (K, 2v, 2v) of v views left out together; nan where the others do not tell where they are."""
        A = self.A[:, views].reshape(len(self.frames), -1, 6)
        own = np.eye(A.shape[1]) - A @ self.gain @ np.swapaxes(A, -1, -2)
        known = self.used[:, views].any(axis=1) & (np.linalg.eigvalsh(own)[:, 0] > _OWN)
        inverse = np.linalg.inv(np.where(known[:, None, None], own, np.eye(A.shape[1])))
        return np.where(known[:, None, None], inverse, np.nan)

    def against_the_rest(self, views: Ints, rows: Array) -> tuple[Array, Array]:
        """Whitened pixels (K, n, 2, ...) of v views against the pose of all other views: (K, v, 2, ...), px.

        And their covariance (K, v, 2, 2), px^2. nan where the others do not tell, and where a view is not used.
        """
        K, v = len(self.frames), len(views)
        inverse = self.left_out(views)
        used = self.used[:, views]
        back = np.linalg.inv(np.where(used[..., None, None], self.W[:, views], np.eye(2)))
        off = (inverse @ self.pose_free(rows)[:, views].reshape(K, 2 * v, -1)).reshape(K, v, 2, -1)
        off = np.where(used[..., None, None], back @ off, np.nan).reshape(K, v, 2, *rows.shape[3:])
        blocks = inverse.reshape(K, v, 2, v, 2)[:, np.arange(v), :, np.arange(v)].swapaxes(0, 1)
        covariance = back @ blocks @ np.swapaxes(back, -1, -2)
        return off, np.where(used[..., None, None], covariance, np.nan)


def linearise(model: SpotModel, recording: ModelCheckRecording, frames: Ints) -> LinearisedFrames:
    """The given frames (K,) of a recording; gross outliers left out of the fits, two spots of a frame at most."""
    used = recording.usable[frames]
    uv, cov = recording.uv_px[frames], recording.cov_px2[frames]
    known = finite(recording.poses.translation[frames], -1)
    poses = Pose(
        np.where(known[:, None, None], recording.poses.rotation[frames], np.eye(3)),
        np.where(known[:, None], recording.poses.translation[frames], 0.0),
    )
    W = whitening(cov, used)
    first = _about(model, frames, poses, used, np.zeros_like(used), uv, W)
    step = first.to_pose(first.residual)
    small = np.all(np.abs(step) < _LARGEST_STEP, axis=-1)
    poses = poses.plus(np.where(small[:, None], step, 0.0))
    outlier = np.zeros_like(used)
    at_pose = _about(model, frames, poses, used, outlier, uv, W)
    for _ in range(_ROUNDS):
        worst = _worst_of_frame(at_pose)
        if not worst.any():
            break
        outlier = outlier | worst
        at_pose = _about(model, frames, poses, used, outlier, uv, W)
    return at_pose


def _about(
    model: SpotModel, frames: Ints, poses: Pose, seen: Bools, outlier: Bools, uv: Array, W: Array
) -> LinearisedFrames:
    projected, J = model.project(poses)
    used = seen & ~outlier & finite(projected, -1)
    W = np.where(used[..., None, None], W, 0.0)
    residual = np.where(used[..., None], uv - np.where(used[..., None], projected, 0.0), 0.0)
    A = W @ np.where(used[..., None, None], J, 0.0)
    flat = A.reshape(len(frames), -1, 6)
    gain, rank = _pseudo_inverse(np.swapaxes(flat, -1, -2) @ flat)
    return LinearisedFrames(frames, poses, used, outlier, W, (W @ residual[..., None])[..., 0], A, gain, rank)


def _pseudo_inverse(N: Array) -> tuple[Array, Ints]:
    """Of normal matrices (K, 6, 6), and their ranks; metres and radians are brought to one scale first."""
    scale = np.sqrt(np.maximum(np.diagonal(N, axis1=-2, axis2=-1), 0.0))
    scale = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(N / (scale[:, :, None] * scale[:, None, :]))
    good = values > _RANK * np.maximum(values[:, -1:], 1e-300)
    inverse = np.where(good, 1.0 / np.where(good, values, 1.0), 0.0)
    scaled = (vectors * inverse[:, None, :]) @ np.swapaxes(vectors, -1, -2)
    return scaled / (scale[:, :, None] * scale[:, None, :]), good.sum(axis=-1)


def _worst_of_frame(lin: LinearisedFrames) -> Bools:
    """(K, n): in each frame the one spot farthest from where its view usually lies, if that is grossly far.

    About the view's own median and by its own scatter: a set-up that is wrong makes all its residuals large, and they
    are what the check is for.
    """
    residual, covariance = lin.against_others()
    known = finite(residual, -1)
    whitened = (whitening(covariance, known) @ np.where(known[..., None], residual, 0.0)[..., None])[..., 0]
    z = np.where(known[..., None], whitened, np.nan)
    some = known.any(axis=0)
    gap = np.zeros(z.shape)
    if some.any():
        off = np.abs(z[:, some] - np.nanmedian(z[:, some], axis=0))
        # By the 90th percentile, not the median: residuals of a wrong set-up come in clusters, as spots leave the
        # picture and others do not, and 15 % of a right view were thrown out (a camera turned by 0.3 deg).
        gap[:, some] = np.nan_to_num(off / np.maximum(1.0, np.nanpercentile(off, 90, axis=0) / 1.645))
    largest = gap.max(axis=-1)
    worst = np.zeros_like(known)
    worst[np.arange(len(worst)), largest.argmax(axis=-1)] = True
    return np.asarray(worst & (largest > OUTLIER_SIGMAS))
