"""Whether the two cameras expose at the same time, from residuals that grow with the velocity in the picture.

If the right picture is taken a time d after the left one, each of its images is shifted by d times its velocity.
Part of the shift is absorbed by the pose; the rest (across the epipolar lines, and in the size of the target) is a
residual. All frames together give d by least squares, beside a rotation of the right camera, which shifts all frames
equally. Source: ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools
from tracking.binocular.joint_fit import JointFit, MarkerObservations
from tracking.binocular.marker_model import MarkerModel, StereoPair, project, project_markers

_FEWEST_FRAMES = 8
_UNKNOWNS = 4  # the time and three rotations of the right camera


@dataclass(frozen=True, slots=True)
class FittedFrame:
    """One frame with a fitted pose."""

    t_s: float
    fit: JointFit
    observed: MarkerObservations


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """The result for a recording."""

    offset_s: float  # right after left
    sigma_s: float
    rotation_rad: Array  # (3,) of the right camera about its axes, beside the calibration
    rotation_sigma_rad: Array  # (3,)
    jitter_s: float  # scatter of the offsets of single frames beyond their sigmas
    jitter_significance: float  # chi-square of the offsets of single frames over its degrees of freedom, in its sigmas
    shift_px: float  # RMS shift of the right images by the offset (or by the jitter, whichever is larger)
    frames: int

    @property
    def significant(self) -> bool:
        """Whether the offset is certain (5 sigma) and shifts the images by more than 0.05 px."""
        certain = abs(self.offset_s) > 5 * self.sigma_s or self.jitter_significance > 8
        return certain and self.shift_px > 0.05


def clock_offset(pair: StereoPair, model: MarkerModel, frames: Sequence[FittedFrame]) -> ClockOffset | None:
    """The offset of the right camera's clock; None with fewer than eight moving frames that determine it."""
    N, b = np.zeros((_UNKNOWNS, _UNKNOWNS)), np.zeros(_UNKNOWNS)
    left, dof, used = 0.0, 0, []
    for before, frame, after in zip(frames, frames[1:], frames[2:], strict=False):
        rate = after.fit.pose.minus(before.fit.pose) / (after.t_s - before.t_s)
        part = _reduced(pair, model, frame, rate)
        if part is None:
            continue
        A, r, free, moved2 = part
        N, b, left, dof = N + A.T @ A, b + A.T @ r, left + float(r @ r), dof + free
        used.append((A, r, moved2))
    if len(used) < _FEWEST_FRAMES:
        return None
    scale = np.sqrt(np.maximum(np.diagonal(N), 1e-300))
    values, vectors = np.linalg.eigh(N / np.outer(scale, scale))
    if values[0] < 1e-10:
        return None
    covariance = (vectors / values) @ vectors.T / np.outer(scale, scale)
    x = covariance @ b
    factor = max(1.0, (left - float(b @ x)) / max(dof - _UNKNOWNS, 1))
    sigma = np.sqrt(np.diagonal(covariance) * factor)
    moved = float(np.sqrt(np.mean([m for _, _, m in used])))
    jitter, significance = _jitter(x, used, factor)
    shift = moved * max(abs(float(x[0])), jitter if significance > 8 else 0.0)
    return ClockOffset(float(x[0]), float(sigma[0]), x[1:], sigma[1:], jitter, significance, shift, len(used))


def _jitter(x: Array, used: Sequence[tuple[Array, Array, float]], factor: float) -> tuple[float, float]:
    """Scatter, s, of the offsets of single frames around the common one, and its significance."""
    single, weight = [], []
    for A, r, _ in used:
        information = float(A[:, 0] @ A[:, 0])
        if information > 0:
            single.append(float(A[:, 0] @ (r - A @ x)) / information)
            weight.append(information)
    d, w = np.array(single), np.array(weight)
    if not len(d):
        return 0.0, 0.0
    chi2 = float(np.sum(d * d * w)) / min(factor, 2.0)
    excess = (chi2 - len(d)) / float(np.sum(w))
    return float(np.sqrt(max(excess, 0.0))), (chi2 - len(d)) / float(np.sqrt(2 * len(d)))


def _reduced(
    pair: StereoPair, model: MarkerModel, frame: FittedFrame, rate: Array
) -> tuple[Array, Array, int, float] | None:
    """Design (m, 4), residuals (m,), degrees of freedom and mean squared velocity (px/s)^2 of one frame.

    Whitened, and without the directions that a change of the pose explains.
    """
    seen: Bools = frame.observed.seen & np.isfinite(frame.fit.residuals_px[..., 0])
    if seen[0].sum() < 2 or seen[1].sum() < 2:
        return None
    J = project_markers(pair, model, frame.fit.pose)[1]
    velocity = J[1] @ rate
    camera = pair.cameras[1].camera_from_world
    world = frame.fit.pose.apply(model.positions)
    by_point = project(pair, world)[1][1]
    by_turn = np.cross(camera.apply(world)[:, None, :], by_point @ camera.rotation.T)  # Exp(theta) x in the camera
    A = np.zeros((2, len(model), 2, _UNKNOWNS))
    A[1, :, :, 0], A[1, :, :, 1:] = velocity, by_turn
    W = np.linalg.inv(np.linalg.cholesky(frame.observed.cov_px2[seen]))
    J_w = (W @ J[seen]).reshape(-1, 6)
    A_w = (W @ A[seen]).reshape(-1, _UNKNOWNS)
    r_w = (W @ frame.fit.residuals_px[seen][..., None]).reshape(-1)
    Q = np.linalg.qr(J_w)[0]
    free = len(r_w) - 6
    if free < 1:
        return None
    moved2 = float(np.mean(np.sum(velocity[seen[1]] ** 2, axis=-1)))
    return A_w - Q @ (Q.T @ A_w), r_w - Q @ (Q.T @ r_w), free, moved2
