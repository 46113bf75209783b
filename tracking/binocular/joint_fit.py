"""Points from two pictures, and the pose that explains the images of all markers in both: the joint reprojection fit.

Triangulation and the pose of points are Zhou's (2020), equations (7) to (9) and (13). The joint fit is generalised
least squares: the covariance of the pixels is their noise plus what is common to all frames, the errors of the
calibration and of the surveyed markers. Source: ours, after the solver of the main path
(geometry/pose_solver/gauss_newton.py).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools, symmetric
from geometry.camera import Camera
from geometry.planes import common_perpendicular
from geometry.pose import Pose
from geometry.pose_solver import gauss_newton
from geometry.pose_solver.gauss_newton import PoseFit, covariance_of
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


FEWEST = 3  # images of markers that a pose needs


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
class _Views:
    """The images of K markers in both cameras as 2 K views of one pose: the left camera's first."""

    pair: StereoPair
    model: MarkerModel

    def project(self, world_from_body: Pose) -> tuple[Array, Array]:
        """Pixels (2 K, 2) and their Jacobian (2 K, 2, 6)."""
        pixels, J = project_markers(self.pair, self.model, world_from_body)
        return pixels.reshape(-1, 2), J.reshape(-1, 2, 6)

    def at(self, world_from_body: Pose) -> Array:
        """Covariance (4 K, 4 K), px^2, due to the calibration and the survey of the markers; nan without an image."""
        by_point = self.project(world_from_body)[1][..., :3].reshape(-1, 3) * self.model.sigma_m
        marker = np.tile(np.repeat(np.arange(len(self.model)), 2), 2)
        out = (by_point @ by_point.T) * (marker[:, None] == marker)  # errors of one marker, in both cameras
        if self.pair.covariance is not None:
            J = calibration_jacobian(self.pair, world_from_body.apply(self.model.positions))
            J = J.reshape(-1, J.shape[-1])
            out += J @ self.pair.covariance.matrix @ J.T
        return out


def fit_pose(pair: StereoPair, model: MarkerModel, observed: MarkerObservations, start: Pose) -> PoseFit | None:
    """The most likely pose near `start`; None where it does not converge, and with fewer than three images of markers.

    Rows of the result: 2 K views, the left camera's first.
    """
    views, rows = _Views(pair, model), np.flatnonzero(observed.seen.ravel())
    if len(rows) < FEWEST or not np.isfinite(views.project(start)[0][rows]).all():
        return None
    uv, cov = observed.uv_px.reshape(-1, 2)[rows], observed.cov_px2.reshape(-1, 2, 2)[rows]
    return gauss_newton.fit_pose(views, rows, uv, cov, start, calibration=views)


def bound(pair: StereoPair, model: MarkerModel, pose: Pose, cov_px2: Array, seen: Bools) -> Array:
    """The smallest covariance (6, 6) of an unbiased pose from these images (Cramer-Rao), without calibration errors.

    cov_px2 (2, K, 2, 2): noise of the images; seen (2, K). Infinite where the images do not determine the pose.
    """
    J = project_markers(pair, model, pose)[1]
    weight = np.linalg.inv(cov_px2[seen])
    H = np.einsum("nij,nik,nkl->jl", J[seen], weight, J[seen])
    return covariance_of(H)[0]
