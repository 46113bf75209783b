"""Clocks of the cameras of a recording, estimated from the delays that the model check tests.

A camera that is late shows its spots where they were earlier on their paths: its residuals against the pose of all
cameras are its spots' velocities times the delay. A rolling shutter delays each row by another time. As in the model
check the poses of all frames are eliminated, and the calibration's stated errors are part of the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.model_check.faults import FaultParameters, pixel_velocities
from calibration.model_check.linearised_frames import (
    LinearisedFrames,
    ModelCheckRecording,
    clock_derivatives,
    correlation_time,
    linearise,
)
from geometry.arrays import Array, Bools, evenly_spaced
from geometry.forward_model import SpotModel
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigCovariance

FEWEST_SPOTS = 4  # of a frame: three determine the pose and say nothing about clocks
_LARGEST_ARRAY = 12_000_000  # numbers in one array of derivatives, 96 MB
# Times the usual chi-square per degree of freedom from which a frame is left out: its spots do not move steadily.
_UNSTEADY = 12.0
_ROUNDS = 4  # of fitting and leaving out


@dataclass(frozen=True, slots=True)
class ClockNumber:
    """One unknown number of a camera's clock: its offset, or its row time."""

    camera: str
    is_row_time: bool

    @property
    def name(self) -> str:
        """In messages."""
        return f"{'row_time_s' if self.is_row_time else 'time_offset_s'} of camera `{self.camera}`"


@dataclass(frozen=True, slots=True)
class ClockFit:
    """Corrections of p numbers of clocks, with the prior."""

    correction_s: Array  # (p,)
    covariance: Array  # (p, p)


def fit_clocks(
    rig: Rig,
    recording: ModelCheckRecording,
    calibration: RigCovariance | None,
    numbers: Sequence[ClockNumber],
    prior: tuple[Array, Array],
) -> ClockFit:
    """Corrections of the numbers (p,) with which the frames of a recording have been related to their instants.

    prior: means and sigmas (p,), s, of the corrections. Source: ours; least squares with the poses eliminated, as in
    fault_identification.py.
    """
    mean, sigma = prior
    nothing = ClockFit(mean.copy(), np.diag(sigma**2))
    model = SpotModel.of(rig)
    testable = np.flatnonzero(recording.usable.sum(axis=1) >= FEWEST_SPOTS)
    if not len(testable) or not len(numbers):
        return nothing
    parameters = FaultParameters.of(rig, model, calibration) if calibration is not None else None
    known = np.zeros(0, np.int64) if parameters is None else np.flatnonzero(np.diagonal(parameters.covariance) > 0)
    columns = len(numbers) + (0 if parameters is None else len(parameters.names))
    lin = linearise(model, recording, evenly_spaced(testable, max(_LARGEST_ARRAY // (2 * len(model) * columns), 8)))
    J = _derivatives(model, recording, lin, numbers)
    if parameters is not None:
        J = np.concatenate([J, parameters.jacobian(recording, lin)[..., known]], axis=-1)
    free, left = lin.residual_part(J), lin.residual_part(lin.residual)
    precision = np.zeros((J.shape[-1],) * 2)
    precision[: len(mean), : len(mean)] = np.diag(1 / sigma**2)
    if parameters is not None and len(known):
        C = parameters.covariance[np.ix_(known, known)]
        precision[len(mean) :, len(mean) :] = np.linalg.inv(C + 1e-9 * np.diag(np.diagonal(C)))
    start = np.concatenate([mean, np.zeros(len(known))])
    dof = np.maximum(2.0 * lin.used.sum(axis=1) - lin.rank, 0.0)
    keep = dof > 0
    if not keep.any():
        return nothing
    theta: Array = start
    covariance: Array = np.asarray(np.linalg.inv(precision), dtype=float)
    for _ in range(_ROUNDS):
        variance = 1.0
        for _ in range(2):  # the second time with the noise that the first one shows
            X, r = free[keep].reshape(-1, J.shape[-1]), left[keep].ravel()
            covariance = np.asarray(np.linalg.inv(X.T @ X / variance + precision), dtype=float)
            theta = covariance @ (X.T @ r / variance + precision @ start)
            rest = left - free @ theta
            chi2 = np.sum(rest**2, axis=(1, 2))
            variance = _noise_variance(lin, rest, keep, chi2, dof)
        per_freedom = chi2 / np.maximum(dof, 1e-9)
        usual = float(np.median(per_freedom[dof > 0]))
        steady = (dof > 0) & (chi2 < _UNSTEADY * max(usual, 1.0) * (dof + 1))
        if np.array_equal(steady, keep) or steady.sum() < 0.5 * np.count_nonzero(dof > 0):
            break
        keep = steady
    p = len(mean)
    return ClockFit(theta[:p], covariance[:p, :p])


def _derivatives(
    model: SpotModel, recording: ModelCheckRecording, lin: LinearisedFrames, numbers: Sequence[ClockNumber]
) -> Array:
    """Derivatives (K, n, 2, p) of the whitened pixels by the numbers."""
    velocity = np.nan_to_num(pixel_velocities(model, recording, lin.frames))
    by_clock = clock_derivatives(model, recording.uv_px[lin.frames], velocity)
    out = np.zeros((*velocity.shape, len(numbers)))
    for i, number in enumerate(numbers):
        views = model.camera_of == model.camera_names.index(number.camera)
        out[:, views, :, i] = by_clock[:, views, :, int(number.is_row_time)]
    return np.asarray(lin.W @ out)


def _noise_variance(lin: LinearisedFrames, rest: Array, keep: Bools, chi2: Array, dof: Array) -> float:
    """Variance of the whitened residuals that counts in sums over frames: at least 1, and more where they correlate."""
    series = np.where(lin.used[keep][..., None], rest[keep], np.nan).reshape(int(keep.sum()), -1)
    return max(float(chi2[keep].sum() / dof[keep].sum()), 1.0) * correlation_time(series)
