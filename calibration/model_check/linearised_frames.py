"""The spots and poses of a recording, linearised with a free pose per frame; leave-one-out residuals; unseen spots.

In a least-squares fit one wrong spot also shifts the pose and thereby the residuals of its neighbours. The residual of
a spot against a fit without it does not have this problem. It follows in closed form from the one fit with all spots:
with the whitened Jacobian A, H = A (A^T A)^-1 A^T and the fit's residual e = (I - H) r, the leave-one-out residual is
(I - H_ii)^-1 e_i and its covariance (I - H_ii)^-1 (Cook & Weisberg 1982, Residuals and Influence in Regression, ch.
2.2, for rows; ours: for the two rows of one spot together). I - H is the redundancy matrix of geodesy.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import prod

import numpy as np

from geometry.arrays import Array, Bools, Ints, finite
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import whiten


@dataclass(frozen=True, slots=True)
class ModelCheckRecording:
    """T frames of n views, in the order of SpotModel.views. Values of spots that were not measured may be nan."""

    t_s: Array  # (T,) increasing
    seen: Bools  # (T, n) whether the spot was measured
    uv_px: Array  # (T, n, 2) measured
    cov_px2: Array  # (T, n, 2, 2) stated covariance of the measurement alone
    poses: Pose  # (T,) world_from_body, any good estimate; nan without one
    predicted_px: Array | None = None  # (T, n, 2) one-step predictions, made before the frame was processed
    predicted_cov_px2: Array | None = None  # (T, n, 2, 2) stated covariance of the predicted spot position
    pose_covariance: Array | None = None  # (T, 6, 6) stated by the run, [m in world, rad in body]
    width_px: Array | None = None  # (n,) usual sigma of each view's intensity profile; nan or None: unknown
    velocity_px_s: Array | None = None  # (T, n, 2) of the spots, where clocks are unknown; 0 where it is unknown
    # (n, 2), s: offset and row time of the rig's cameras, by view, with which the spots were moved to their instants.
    clock_s: Array | None = None

    def __post_init__(self) -> None:
        T, n = self.seen.shape
        expected = {
            "t_s": (T,),
            "uv_px": (T, n, 2),
            "cov_px2": (T, n, 2, 2),
            "predicted_px": (T, n, 2),
            "predicted_cov_px2": (T, n, 2, 2),
            "pose_covariance": (T, 6, 6),
            "width_px": (n,),
            "velocity_px_s": (T, n, 2),
            "clock_s": (n, 2),
        }
        for name, shape in expected.items():
            value = getattr(self, name)
            if value is not None and value.shape != shape:
                raise ValueError(f"{name}: expected shape {shape} as `seen` has {(T, n)}, got {value.shape}")
        if self.poses.translation.shape != (T, 3):
            raise ValueError(f"poses: expected {T} poses, got shape {self.poses.translation.shape}")

    def at(self, rows: Ints) -> ModelCheckRecording:
        """Some of the frames."""
        of_frames = {
            name: getattr(self, name)[rows]
            for name in ModelCheckRecording.__slots__
            if name not in ("width_px", "clock_s") and getattr(self, name) is not None
        }
        return replace(self, **of_frames)

    @property
    def usable(self) -> Bools:
        """(T, n): measured, with finite pixels, a positive definite covariance and a pose of its frame."""
        a, b, c = self.cov_px2[..., 0, 0], self.cov_px2[..., 0, 1], self.cov_px2[..., 1, 1]
        known = finite(self.poses.translation, -1) & finite(self.poses.rotation, (-1, -2))
        with np.errstate(invalid="ignore"):
            positive = (a > 0) & (a * c - b * b > 0) & np.isfinite(a + b + c)
        return np.asarray(self.seen & finite(self.uv_px, -1) & positive & known[:, None])


def with_clocks(model: SpotModel, recording: ModelCheckRecording, clock_s: Array) -> ModelCheckRecording:
    """The recording with its spots moved to the frames' instants by other clocks (n, 2), s."""
    if recording.velocity_px_s is None or recording.clock_s is None:
        return recording
    by_clock = clock_derivatives(model, recording.uv_px, recording.velocity_px_s)
    return replace(recording, uv_px=recording.uv_px - (by_clock * (clock_s - recording.clock_s)[:, None]).sum(axis=-1))


def clock_derivatives(model: SpotModel, uv_px: Array, velocity_px_s: Array) -> Array:
    """Derivatives (T, n, 2, 2) of spots (T, n, 2) by their camera's offset, px/s, and row time, px rows/s."""
    later = np.nan_to_num(uv_px[..., 1]) - (model.image_size_px[:, 1] - 1) / 2
    return np.stack([velocity_px_s, velocity_px_s * later[..., None]], axis=-1)


def whitening(covariances: Array, where: Bools) -> Array:
    """W (..., 2, 2) with W C W^T = I where `where` (...) is true; 0 elsewhere."""
    safe = np.where(where[..., None, None], covariances, np.eye(2))
    return np.where(where[..., None, None], whiten(safe), 0.0)


_RANK = 1e-12  # eigenvalues below this share of the largest (columns scaled to one) are rounding errors
_LARGEST_STEP = np.array([0.1] * 3 + [0.05] * 3)  # m, rad: a pose that would move farther is not linearised again
_LEAST_REDUNDANCY = 1e-3  # below it the frame's pose follows the spot: no other spots check it
OUTLIER_SIGMAS = 6.0  # of a view's usual scatter about its own median: p = 4e-9 for a normal error
_OUTLIER_ROUNDS = 2  # each drops the worst spot of a frame: one gross error makes its neighbours look wrong too


@dataclass(frozen=True, slots=True)
class LinearisedFrames:
    """K frames of n views, linearised about their poses and whitened by the stated covariances; 0 for unused views."""

    frames: Ints  # (K,) index into the recording
    poses: Pose  # (K,) after one Gauss-Newton step
    used: Bools  # (K, n)
    outlier: Bools  # (K, n) measured, but a gross outlier
    W: Array  # (K, n, 2, 2) whitening matrices, 1/px
    residual: Array  # (K, n, 2) measured minus projected, whitened
    A: Array  # (K, n, 2, 6) whitened Jacobian by the pose error
    normal_inverse: Array  # (K, 6, 6) pseudo-inverse of A^T A
    rank: Ints  # (K,) rank of A^T A: 6 where the frame alone determines its pose

    @property
    def dof(self) -> int:
        """Degrees of freedom: measured coordinates minus pose parameters."""
        return int(2 * self.used.sum() - self.rank.sum())

    def pose_shift(self, rows: Array) -> Array:
        """Least-squares pose shifts (K, 6, ...) caused by whitened pixel shifts (K, n, 2, ...)."""
        flat = rows.reshape(len(rows), rows.shape[1] * 2, -1)
        A = self.A.reshape(len(rows), -1, 6)
        out = self.normal_inverse @ (np.swapaxes(A, -1, -2) @ flat)
        return out.reshape(len(rows), 6, *rows.shape[3:])

    def residual_part(self, rows: Array) -> Array:
        """(I - H) applied to whitened pixel shifts (K, n, 2, ...): the part that the poses cannot absorb."""
        flat = rows.reshape(len(rows), rows.shape[1] * 2, -1)
        A = self.A.reshape(len(rows), -1, 6)
        return np.asarray((flat - A @ self.pose_shift(rows).reshape(len(rows), 6, -1)).reshape(rows.shape))

    def redundancy(self) -> Array:
        """I - H_ii, (K, n, 2, 2): the part of each view's error that the poses do not absorb; 0 for unused views."""
        own = np.eye(2) - self.A @ (self.normal_inverse[:, None] @ np.swapaxes(self.A, -1, -2))
        return np.where(self.used[..., None, None], own, 0.0)

    def inverse_redundancy(self) -> Array:
        """(I - H_ii)^-1, (K, n, 2, 2); nan for unused views and where the other views do not check this one."""
        own = np.eye(2) - self.A @ (self.normal_inverse[:, None] @ np.swapaxes(self.A, -1, -2))
        a, b, c = own[..., 0, 0], own[..., 0, 1], own[..., 1, 1]
        det = a * c - b * b
        # det / trace is a lower bound of the smaller eigenvalue.
        known = self.used & (a + c > _LEAST_REDUNDANCY) & (det > _LEAST_REDUNDANCY * (a + c))
        inverse = np.stack([np.stack([c, -b], -1), np.stack([-b, a], -1)], -2)
        return np.where(known[..., None, None], inverse / np.where(known, det, 1.0)[..., None, None], np.nan)

    def leave_one_out_residuals(self) -> tuple[Array, Array]:
        """Residuals (K, n, 2), px, of each view against the pose of the other views, and their covariances, px^2."""
        weights = self.inverse_redundancy()
        whitened = (weights @ self.residual_part(self.residual)[..., None])[..., 0]
        back = np.linalg.inv(np.where(self.used[..., None, None], self.W, np.eye(2)))
        return (back @ whitened[..., None])[..., 0], back @ weights @ np.swapaxes(back, -1, -2)

    def inverse_group_redundancy(self, views: Ints) -> Array:
        """(I - H_SS)^-1, (K, 2v, 2v), of a group of v views; nan where the other views do not check the group."""
        A = self.A[:, views].reshape(len(self.frames), -1, 6)
        own = np.eye(A.shape[1]) - A @ self.normal_inverse @ np.swapaxes(A, -1, -2)
        smallest = np.linalg.eigvalsh(own).min(axis=1, initial=np.inf)
        known: Bools = self.used[:, views].any(axis=1) & (smallest > _LEAST_REDUNDANCY)
        inverse = np.linalg.inv(np.where(known[:, None, None], own, np.eye(A.shape[1])))
        return np.where(known[:, None, None], inverse, np.nan)

    def leave_group_out(self, views: Ints, rows: Array) -> tuple[Array, Array]:
        """Residuals of a group of v views against the pose of all other views; v may be 0 (a beam without spots).

        rows: (K, n, 2, ...), whitened pixel shifts. Returns residuals (K, v, 2, ...), px, and their covariances
        (K, v, 2, 2), px^2; nan for unused views and where the other views do not determine the pose.
        """
        K, v, columns = len(self.frames), len(views), prod(rows.shape[3:])
        inverse = self.inverse_group_redundancy(views)
        used = self.used[:, views]
        back = np.linalg.inv(np.where(used[..., None, None], self.W[:, views], np.eye(2)))
        off = (inverse @ self.residual_part(rows)[:, views].reshape(K, 2 * v, columns)).reshape(K, v, 2, columns)
        off = np.where(used[..., None, None], back @ off, np.nan).reshape(K, v, 2, *rows.shape[3:])
        blocks = inverse.reshape(K, v, 2, v, 2)[:, np.arange(v), :, np.arange(v)].swapaxes(0, 1)
        covariance = back @ blocks @ np.swapaxes(back, -1, -2)
        return off, np.where(used[..., None, None], covariance, np.nan)


def linearise(model: SpotModel, recording: ModelCheckRecording, frames: Ints) -> LinearisedFrames:
    """Linearise the given frames (K,) of a recording. At most two gross outliers per frame are excluded."""
    used = recording.usable[frames]
    uv, cov = recording.uv_px[frames], recording.cov_px2[frames]
    known = finite(recording.poses.translation[frames], -1)
    poses = Pose(
        np.where(known[:, None, None], recording.poses.rotation[frames], np.eye(3)),
        np.where(known[:, None], recording.poses.translation[frames], 0.0),
    )
    W = whitening(cov, used)
    first = linearised_at(model, frames, poses, used, np.zeros_like(used), uv, W)
    step = first.pose_shift(first.residual)
    small = np.all(np.abs(step) < _LARGEST_STEP, axis=-1)
    poses = poses.plus(np.where(small[:, None], step, 0.0))
    outlier = np.zeros_like(used)
    at_pose = linearised_at(model, frames, poses, used, outlier, uv, W)
    for _ in range(_OUTLIER_ROUNDS):
        worst = _worst_of_frame(at_pose)
        if not worst.any():
            break
        outlier = outlier | worst
        at_pose = linearised_at(model, frames, poses, used, outlier, uv, W)
    return at_pose


def linearised_at(
    model: SpotModel, frames: Ints, poses: Pose, seen: Bools, outlier: Bools, uv: Array, W: Array
) -> LinearisedFrames:
    """Frames (K,) linearised at given poses (K,); seen, outlier (K, n), uv (K, n, 2), and W (K, n, 2, 2) whitens."""
    projected, J = model.project(poses)
    used = seen & ~outlier & finite(projected, -1)
    W = np.where(used[..., None, None], W, 0.0)
    residual = np.where(used[..., None], uv - np.where(used[..., None], projected, 0.0), 0.0)
    A = W @ np.where(used[..., None, None], J, 0.0)
    flat = A.reshape(len(frames), -1, 6)
    normal_inverse, rank = _pseudo_inverse(np.swapaxes(flat, -1, -2) @ flat)
    return LinearisedFrames(frames, poses, used, outlier, W, (W @ residual[..., None])[..., 0], A, normal_inverse, rank)


def _pseudo_inverse(N: Array) -> tuple[Array, Ints]:
    """Pseudo-inverses of normal matrices (K, 6, 6), and their ranks. Metres and radians are scaled alike first."""
    scale = np.sqrt(np.maximum(np.diagonal(N, axis1=-2, axis2=-1), 0.0))
    scale = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(N / (scale[:, :, None] * scale[:, None, :]))
    good = values > _RANK * np.maximum(values[:, -1:], 1e-300)
    inverse = np.where(good, 1.0 / np.where(good, values, 1.0), 0.0)
    scaled = (vectors * inverse[:, None, :]) @ np.swapaxes(vectors, -1, -2)
    return scaled / (scale[:, :, None] * scale[:, None, :]), good.sum(axis=-1)


def _worst_of_frame(lin: LinearisedFrames) -> Bools:
    """(K, n): the worst spot of each frame, if it is a gross outlier.

    Compared with the median and the scatter of its own view, not with 0: in a wrong set-up all residuals are large, and
    the check must keep them.
    """
    residual, covariance = lin.leave_one_out_residuals()
    known = finite(residual, -1)
    whitened = (whitening(covariance, known) @ np.where(known[..., None], residual, 0.0)[..., None])[..., 0]
    z = np.where(known[..., None], whitened, np.nan)
    some = known.any(axis=0)
    gap = np.zeros(z.shape)
    if some.any():
        off = np.abs(z[:, some] - np.nanmedian(z[:, some], axis=0))
        # Scaled by the 90th percentile, not the median: residuals of a wrong set-up form clusters, since spots leave
        # the picture. With the median, 15 % of a correct view were excluded (measured: a camera turned by 0.3 deg).
        gap[:, some] = np.nan_to_num(off / np.maximum(1.0, np.nanpercentile(off, 90, axis=0) / 1.645))
    largest = gap.max(axis=-1)
    worst = np.zeros_like(known)
    worst[np.arange(len(worst)), largest.argmax(axis=-1)] = True
    return np.asarray(worst & (largest > OUTLIER_SIGMAS))


# Spots that should be in the picture but are hardly ever measured.
#
# A beam that points far away from where the rig file says leaves no residual: the tracker takes its spot for clutter,
# and the expected spot counts as occluded. Measured: a beam with a single spot, wrong by 0.1 deg, had no other symptom.

MOSTLY_UNSEEN = 0.2  # a view measured in less than this share of the frames is reported
FEWEST_FRAMES = 30  # in which it is expected: a shorter occlusion is no fault
_INSIDE_PX = 20.0  # from the picture's edge, where a whole spot is visible even if its position is not exact


@dataclass(frozen=True, slots=True)
class UnseenView:
    """A view that is hardly ever measured."""

    view: int
    measured: int  # frames
    expected: int  # frames in which the pose puts it well inside the picture


def unseen_views(model: SpotModel, recording: ModelCheckRecording, frames: Ints) -> tuple[UnseenView, ...]:
    """The unseen views over the given frames (K,), each of which has a pose from other spots."""
    pixels = model.project(recording.poses[frames])[0]
    inside = model.in_picture(pixels, -_INSIDE_PX)
    expected = inside.sum(axis=0)
    measured = (inside & recording.seen[frames]).sum(axis=0)
    return tuple(
        UnseenView(i, int(measured[i]), int(expected[i]))
        for i in range(len(model))
        if expected[i] >= FEWEST_FRAMES and measured[i] < MOSTLY_UNSEEN * expected[i]
    )


_FEWEST_FRAMES = 8  # with fewer, a scatter or an autocorrelation is meaningless


def correlation_time(series: Array) -> float:
    """Number of consecutive samples that count as one: 1 + 2 sum of autocorrelations, at least 1.

    series (N, m), mean removed, is pooled over its m columns; nan is ignored. The sum ends at the first pair of
    neighbouring autocorrelations that is not positive (Geyer 1992, Practical Markov chain Monte Carlo, Stat. Sci. 7,
    sec. 3.3: initial positive sequence).
    """
    N = len(series)
    known = np.isfinite(series)
    x = np.where(known, series, 0.0)
    power = float(np.sum(x * x))
    if N < _FEWEST_FRAMES or power <= 0:
        return 1.0
    size = 2 ** int(np.ceil(np.log2(2 * N)))

    def lagged(values: Array) -> Array:
        return np.asarray(np.fft.irfft(np.abs(np.fft.rfft(values, size, axis=0)) ** 2, size, axis=0)[:N].sum(axis=1))

    pairs = np.maximum(lagged(known.astype(float)), 1.0)
    rho = (lagged(x) / pairs) / (power / max(int(known.sum()), 1))
    rho[pairs < _FEWEST_FRAMES] = 0.0
    half = rho[: 2 * (N // 2)].reshape(-1, 2).sum(axis=1)
    ends = np.flatnonzero(half <= 0)
    return float(max(1.0, 2 * half[: ends[0] if ends.size else len(half)].sum() - 1))
