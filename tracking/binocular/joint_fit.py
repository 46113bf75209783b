"""Points from two pictures, and the pose that explains the images of all markers in both: the joint reprojection fit.

Triangulation and the pose of points are Zhou's (2020), equations (7) to (9) and (13). The joint fit is generalised
least squares: the covariance of the pixels is their noise plus what is common to all frames, the errors of the
calibration and of the surveyed markers. Source: ours, after the solver of the main path
(geometry/pose_solver/gauss_newton.py).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools, Ints, symmetric
from geometry.camera import Camera
from geometry.planes import common_perpendicular
from geometry.pose import Pose
from tracking.binocular.marker_model import MarkerModel, StereoPair, calibration_jacobian, project, project_markers

# Pose from points in two frames by unit quaternions: Zhou (2020), equations (10) to (18); Horn (1987).
#
# Horn, "Closed-form solution of absolute orientation using unit quaternions", J. Opt. Soc. Am. A 4, 629. The paper
# does not print the matrix M of (14); this is Horn's. Maximising (14) is the same as minimising (13); the text names
# (12) and (13). The largest eigenvalue is lambda_1 in (18). Two quaternions, q and -q, are one rotation. Three points
# suffice.


def quaternion_matrix(from_body: Array, measured: Array) -> Array:
    """The matrix M (4, 4) with D = q^T M q of equation (14), of centred points (n, 3) in body and measured (n, 3)."""
    S = from_body.T @ measured  # S[i, j] = sum of body_i measured_j
    d = np.array([S[1, 2] - S[2, 1], S[2, 0] - S[0, 2], S[0, 1] - S[1, 0]])
    M = np.empty((4, 4))
    M[0, 0] = np.trace(S)
    M[0, 1:] = M[1:, 0] = d
    M[1:, 1:] = S + S.T - np.trace(S) * np.eye(3)
    return M


def pose_of_points(body: Array, measured: Array) -> Pose:
    """The pose a_from_body with the least sum of squared distances, equation (13).

    body, measured (n, 3), m: the same n >= 3 points in body and in the frame a, not on one line.
    """
    centre_b, centre_m = body.mean(axis=0), measured.mean(axis=0)
    M = quaternion_matrix(body - centre_b, measured - centre_m)
    q = np.linalg.eigh(M)[1][:, -1]
    rotation = Pose.from_quaternion(q, np.zeros(3)).rotation
    return Pose(rotation, centre_m - rotation @ centre_b)


# Points in space from their images in two cameras: the paper's linear form, and the most likely point.
#
# Source: Zhou, Xu & Jia (2020), equations (5) to (9). In (7) the rows of v must have m21, m22, m23 and m24 of the
# camera matrices; printed are m11 to m14, those of the rows of u.


_STEPS = 6  # of Gauss-Newton; three are enough from the middle of the common perpendicular


@dataclass(frozen=True, slots=True)
class Triangulated:
    """n points from pairs of images."""

    points: Array  # (n, 3), m, in world; nan where the rays do not meet in front of both cameras
    covariance: Array  # (n, 3, 3), m^2
    chi2: Array  # (n,), one degree of freedom: the epipolar distance in sigmas, squared


def linear_points(pair: StereoPair, uv_px: Array) -> Array:
    """World points (n, 3), m, of undistorted pixels (2, n, 2): the least-squares solution of equations (7) to (9)."""
    rows, constants = [], []
    for camera, uv in zip(pair.cameras, uv_px, strict=True):
        M = camera.matrix @ np.column_stack([camera.camera_from_world.rotation, camera.camera_from_world.translation])
        for axis in range(2):
            rows.append(uv[:, axis, None] * M[2, :3] - M[axis, :3])
            constants.append(M[axis, 3] - uv[:, axis] * M[2, 3])
    A, b = np.stack(rows, axis=1), np.stack(constants, axis=1)
    normal = np.swapaxes(A, 1, 2) @ A
    return np.asarray(np.linalg.solve(normal, (np.swapaxes(A, 1, 2) @ b[..., None]))[..., 0])


def undistorted_pixels(camera: Camera, uv_px: Array) -> Array:
    """Pixels (n, 2) that a camera without distortion would have, of distorted pixels (n, 2); nan beyond the fold."""
    direction = camera.camera_from_world.turn(camera.rays(uv_px)[1])
    with np.errstate(invalid="ignore", divide="ignore"):
        flat = direction[:, :2] / direction[:, 2:]
    return np.asarray(flat * np.diagonal(camera.matrix)[:2] + camera.matrix[:2, 2])


def triangulate(pair: StereoPair, uv_px: Array, cov_px2: Array) -> Triangulated:
    """The most likely points of n pairs of images with their covariance. Source: ours, by Gauss-Newton.

    uv_px (2, n, 2): distorted pixels in both cameras; cov_px2 (2, n, 2, 2): their covariances.
    """
    n = uv_px.shape[1]
    if not n:
        return Triangulated(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0))
    (from_left, along_left), (from_right, along_right) = (
        camera.rays(uv) for camera, uv in zip(pair.cameras, uv_px, strict=True)
    )
    feet = common_perpendicular(from_left, along_left, from_right, along_right)
    points = 0.5 * (feet[0] + feet[1])
    weight: Array = np.asarray(np.linalg.inv(cov_px2), dtype=np.float64)
    for _ in range(_STEPS):
        residual, JtW, H = _normal_equations(pair, points, uv_px, weight)
        step = _solved(H, JtW, residual)
        points = points + step
        if not np.any(np.linalg.norm(step, axis=1) > 1e-9 * np.linalg.norm(points, axis=1)):
            break
    residual, _, H = _normal_equations(pair, points, uv_px, weight)
    chi2 = np.einsum("cni,cnij,cnj->n", residual, weight, residual)
    good: Bools = np.asarray(np.isfinite(H).all(axis=(1, 2)))
    H[~good] = np.eye(3)
    covariance = np.where(good[:, None, None], symmetric(np.asarray(np.linalg.inv(H), dtype=np.float64)), np.nan)
    return Triangulated(points, covariance, chi2)


def _normal_equations(pair: StereoPair, points: Array, uv_px: Array, weight: Array) -> tuple[Array, Array, Array]:
    """Residuals (2, n, 2), J^T W (2, n, 3, 2) and the normal matrices (n, 3, 3)."""
    pixels, J = project(pair, points)
    JtW = np.swapaxes(J, -1, -2) @ weight
    return uv_px - pixels, JtW, (JtW @ J).sum(axis=0)


def _solved(H: Array, JtW: Array, residual: Array) -> Array:
    """Steps (n, 3); nan where a point has no projection or the rays are parallel."""
    right = (JtW @ residual[..., None]).sum(axis=0)
    finite = np.isfinite(H).all(axis=(1, 2)) & np.isfinite(right).all(axis=(1, 2))
    good: Bools = np.asarray(finite)
    good[good] = np.linalg.cond(H[good]) < 1e15
    step = np.full(right.shape, np.nan)
    if good.any():
        step[good] = np.linalg.solve(H[good], right[good])
    return step[..., 0]


_FIT_STEPS = 40
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
    for _ in range(_FIT_STEPS):
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
