"""The pose that explains the images of all markers in both cameras: the joint reprojection fit.

Generalised least squares: the covariance of the pixels is their noise plus what is common to all frames, the errors of
the calibration and of the surveyed markers. Source: ours, after the solver of the main path
(geometry/pose_solver/gauss_newton.py).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools, Ints, symmetric
from geometry.pose import Pose
from tracking.binocular.marker_model import MarkerModel, StereoPair, calibration_jacobian, project_markers

_STEPS = 40
_CONVERGED = 1e-6  # squared length of the last step, in sigmas
_LEAST_DAMPING = 1e-9  # keeps the equations regular where the images determine five numbers only
_RANK = 1e-9  # smallest singular value over the largest of the whitened Jacobian with scaled columns


@dataclass(frozen=True, slots=True)
class MarkerObservations:
    """The labelled images of K markers in both cameras."""

    uv_px: Array  # (2, K, 2), distorted; nan where not seen
    cov_px2: Array  # (2, K, 2, 2), of the noise

    @property
    def seen(self) -> Bools:
        """(2, K): which markers each camera sees."""
        return np.isfinite(self.uv_px[..., 0])


@dataclass(frozen=True, slots=True)
class JointFit:
    """A fitted pose."""

    pose: Pose  # world_from_body
    covariance: Array  # (6, 6): of noise, calibration and marker survey
    systematic: Array  # (6, 6): the part of the calibration and the marker survey
    residuals_px: Array  # (2, K, 2), measured minus predicted; nan where not seen
    chi2: float
    dof: int  # 2 x images - 6
    observable: bool  # the images determine all six numbers

    @property
    def rms_px(self) -> float:
        """RMS of the residuals per coordinate; nan without images."""
        used = self.residuals_px[np.isfinite(self.residuals_px)]
        return float(np.sqrt(np.mean(used**2))) if used.size else float("nan")


def fit_pose(pair: StereoPair, model: MarkerModel, observed: MarkerObservations, start: Pose) -> JointFit | None:
    """The most likely pose near `start`, by Levenberg-Marquardt; None where it does not converge.

    With fewer than three images of markers, or where they do not determine the pose, `observable` is False and the
    covariance is infinite.
    """
    rows: Ints = np.flatnonzero(np.repeat(observed.seen.ravel(), 2)).astype(np.int64)
    if len(rows) < 6:
        return None
    whitening = _whitening(pair, model, observed, start, rows)
    if whitening is None:
        return None
    found = _minimised(pair, model, observed.uv_px, start, rows, whitening)
    if found is None:
        return None
    again = _whitening(pair, model, observed, found, rows)  # the calibration's part, at the solution
    if again is None:
        return None
    r, J = _whitened(pair, model, observed.uv_px, found, rows, again)
    residuals = np.full(observed.uv_px.shape, np.nan)
    pixels = project_markers(pair, model, found)[0]
    residuals[observed.seen] = (observed.uv_px - pixels)[observed.seen]
    covariance, observable = _covariance(J)
    systematic = np.zeros((6, 6))
    if observable:
        gain: Array = covariance @ J.T @ again
        systematic = symmetric(gain @ _common_errors(pair, model, found, rows) @ gain.T)
    return JointFit(found, covariance, systematic, residuals, float(r @ r), len(rows) - 6, observable)


def bound(pair: StereoPair, model: MarkerModel, pose: Pose, cov_px2: Array, seen: Bools) -> Array:
    """The smallest covariance (6, 6) of an unbiased pose from these images (Cramer-Rao), without calibration errors.

    cov_px2 (2, K, 2, 2): noise of the images; seen (2, K). Infinite where the images do not determine the pose.
    """
    J = project_markers(pair, model, pose)[1]
    weight = np.linalg.inv(cov_px2[seen])
    H = np.einsum("nij,nik,nkl->jl", J[seen], weight, J[seen])
    scale = 1 / np.sqrt(np.maximum(np.diagonal(H), 1e-300))
    values, vectors = np.linalg.eigh(H * np.outer(scale, scale))
    if values[0] < _RANK**2 * values[-1]:
        return np.full((6, 6), np.inf)
    return symmetric((vectors / values) @ vectors.T) * np.outer(scale, scale)


def _minimised(
    pair: StereoPair, model: MarkerModel, uv_px: Array, start: Pose, rows: Ints, whitening: Array
) -> Pose | None:
    pose, damping = start, 1e-3
    r, J = _whitened(pair, model, uv_px, pose, rows, whitening)
    if not np.isfinite(r).all():
        return None
    cost = float(r @ r)
    for _ in range(_STEPS):
        H, g = J.T @ J, J.T @ r
        scale = 1 / np.sqrt(np.maximum(np.diagonal(H), 1e-300))
        scaled = H * np.outer(scale, scale) + damping * np.eye(6)
        step: Array = scale * np.linalg.solve(scaled, scale * g)
        trial = pose.plus(step)
        t_r, t_J = _whitened(pair, model, uv_px, trial, rows, whitening)
        t_cost = float(t_r @ t_r)
        if np.isfinite(t_cost) and t_cost <= cost:
            small = cost - t_cost < 1e-6 * (1 + cost) and float(step @ H @ step) < _CONVERGED
            pose, r, J, cost, damping = trial, t_r, t_J, t_cost, max(damping / 10, _LEAST_DAMPING)
            if small:
                return pose
        else:
            damping *= 10
            if damping > 1e10:
                return pose  # no descent: at the minimum to rounding
    return None


def _whitened(
    pair: StereoPair, model: MarkerModel, uv_px: Array, pose: Pose, rows: Ints, whitening: Array
) -> tuple[Array, Array]:
    """Residuals (m,) in sigmas and the derivatives (m, 6) of the prediction."""
    pixels, J = project_markers(pair, model, pose)
    both = np.column_stack([(uv_px - pixels).reshape(-1)[rows], J.reshape(-1, 6)[rows]])
    if not np.isfinite(both).all():
        return np.full(len(rows), np.nan), np.full((len(rows), 6), np.nan)
    white = whitening @ both
    return white[:, 0], white[:, 1:]


def _common_errors(pair: StereoPair, model: MarkerModel, pose: Pose, rows: Ints) -> Array:
    """Covariance (m, m), px^2, of pixel coordinates due to the calibration and the survey of the markers."""
    out = np.zeros((len(rows), len(rows)))
    if pair.covariance is not None:
        J = calibration_jacobian(pair, pose.apply(model.positions))
        J = J.reshape(-1, J.shape[-1])[rows]
        out += J @ pair.covariance.matrix @ J.T
    if model.sigma_m > 0:
        by_point = project_markers(pair, model, pose)[1][..., :3].reshape(-1, 3)[rows] * model.sigma_m
        marker = np.tile(np.repeat(np.arange(len(model)), 2), 2)[rows]
        out += (by_point @ by_point.T) * (marker[:, None] == marker)  # errors of one marker, in both cameras
    return out


def _whitening(
    pair: StereoPair, model: MarkerModel, observed: MarkerObservations, pose: Pose, rows: Ints
) -> Array | None:
    """W (m, m) with W C W^T = I for the covariance C of the m pixel coordinates; None where a marker has no image."""
    blocks = observed.cov_px2[observed.seen]
    C = np.zeros((len(rows), len(rows)))
    at = np.arange(0, len(rows), 2)
    for i in range(2):
        for j in range(2):
            C[at + i, at + j] = blocks[:, i, j]
    C += _common_errors(pair, model, pose, rows)
    if not np.isfinite(C).all():
        return None
    return np.asarray(np.linalg.inv(np.linalg.cholesky(C)))


def _covariance(J: Array) -> tuple[Array, bool]:
    """Covariance (6, 6) from a whitened Jacobian (m, 6), and whether that has full rank; infinite if not."""
    scale = np.linalg.norm(J, axis=0)
    if np.any(scale == 0):
        return np.full((6, 6), np.inf), False
    _, values, vectors = np.linalg.svd(J / scale, full_matrices=False)
    if len(values) < 6 or values[-1] < _RANK * values[0]:
        return np.full((6, 6), np.inf), False
    root = (vectors.T / values) / scale[:, None]
    return symmetric(root @ root.T), True
