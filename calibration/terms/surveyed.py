"""Surveyed points as terms of an adjustment: their pixels, the screens on which they lie, their surveyed coordinates.

Stacks: "intrinsics" (fx, fy, cx, cy, px, and 14 distortion coefficients), "cameras" (camera_from_world), "screens"
(world_from_screen), "bow" (1/m), "points" (world, m). All Jacobians are by the errors that these stacks define.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibration.least_squares.adjustment import Linearised, Loss, Part, Values
from calibration.least_squares.parameter_blocks import Poses, Vectors
from geometry import lens
from geometry.arrays import Array, Bools, Ints, skew
from geometry.camera import project_points_full
from geometry.pose import Pose


def pose_of(values: Values, stack: str) -> Pose:
    """The transforms of a stack."""
    poses = values[stack]
    assert isinstance(poses, Poses)
    return poses.pose


def array_of(values: Values, stack: str) -> Array:
    """The vectors (k, d) of a stack."""
    vectors = values[stack]
    assert isinstance(vectors, Vectors)
    return vectors.array


def whitening(covariances: Array) -> Array:
    """Whitening matrices W (..., d, d) of covariances C (..., d, d): W C W^T = I."""
    return np.linalg.inv(np.linalg.cholesky(covariances))


def fold_limits(intrinsics: Array, fisheye: Bools) -> Array:
    """Squared radii (n_cameras,) at which the lens models fold, of intrinsics (n_cameras, 18)."""
    return np.array(
        [
            (lens.fisheye_fold_limit(tuple(row[4:8])) if wide else lens.fold_limit(tuple(row[4:])))
            for row, wide in zip(intrinsics, fisheye, strict=True)
        ]
    )


@dataclass(frozen=True, slots=True)
class PointTerm:
    """n observations: pixels of points in fixed cameras."""

    camera_of: Ints  # (n,)
    point_of: Ints  # (n,)
    pixels: Array  # (n, 2), px, distorted
    whiten: Array  # (n, 2, 2): `whitening` of the pixel's covariance
    fisheye: Bools  # (n_cameras,)
    loss: Loss | None = None

    def __len__(self) -> int:
        return len(self.pixels)

    def pick(self, rows: Bools, loss: Loss | None = None) -> PointTerm:
        """Some of the observations, with this loss."""
        return PointTerm(
            self.camera_of[rows], self.point_of[rows], self.pixels[rows], self.whiten[rows], self.fisheye, loss
        )

    def widened(self, scale: float) -> PointTerm:
        """The same observations with all sigmas multiplied."""
        return replace(self, whiten=self.whiten / scale)

    def linearise(self, values: Values) -> Linearised:
        """Predicted minus measured pixels (n, 2), in sigmas; nan where the point lies behind the camera."""
        intrinsics = array_of(values, "intrinsics")
        camera_from_world = pose_of(values, "cameras")[self.camera_of]
        points = array_of(values, "points")[self.point_of]
        projected = project_points_full(
            camera_from_world.apply(points),
            intrinsics[self.camera_of, :4],
            intrinsics[self.camera_of, 4:],
            fold_limits(intrinsics, self.fisheye)[self.camera_of],
            self.fisheye[self.camera_of],
        )
        R = camera_from_world.rotation
        W = self.whiten
        d_point = W @ projected.d_point
        # x_c = R Exp(dtheta) X + t + dt
        d_camera = np.concatenate([d_point, -d_point @ R @ skew(points)], axis=-1)
        d_intrinsics = W @ np.concatenate([projected.d_pinhole, projected.d_distortion], axis=-1)
        return Linearised(
            (W @ (projected.pixels - self.pixels)[..., None])[..., 0],
            [
                Part("intrinsics", self.camera_of, d_intrinsics),
                Part("cameras", self.camera_of, d_camera),
                Part("points", self.point_of, d_point @ R),
            ],
        )


@dataclass(frozen=True, slots=True)
class SurfaceTerm:
    """n points that lie on the surface of a screen, each to within its sigma."""

    screen_of: Ints  # (n,)
    point_of: Ints  # (n,)
    sigma_m: Array  # (n,): distance of a point from the surface (paint, paper, shape that the bow does not describe)
    loss: Loss | None = None

    def widened(self, scale: float) -> SurfaceTerm:
        """The same points with all sigmas multiplied."""
        return replace(self, sigma_m=self.sigma_m * scale)

    def linearise(self, values: Values) -> Linearised:
        """Heights (n, 1), in sigmas, above the surface z = a x^2 + b x y + c y^2 in the screen frame."""
        world_from_screen = pose_of(values, "screens")[self.screen_of]
        bow = array_of(values, "bow")[self.screen_of]
        points = array_of(values, "points")[self.point_of]
        on_screen = world_from_screen.inverse().apply(points)
        per_m = 1.0 / self.sigma_m[:, None, None]
        slope = surface_slope(on_screen, bow)[:, None, :] * per_m  # (n, 1, 3)
        R_t = np.swapaxes(world_from_screen.rotation, -1, -2)
        # x_s = Exp(-dtheta) R^T (X - t - dt)
        d_screen = np.concatenate([-slope @ R_t, slope @ skew(on_screen)], axis=-1)
        return Linearised(
            surface_heights(on_screen, bow)[:, None] / self.sigma_m[:, None],
            [
                Part("screens", self.screen_of, d_screen),
                Part("bow", self.screen_of, -bow_shape(on_screen)[:, None, :] * per_m),
                Part("points", self.point_of, slope @ R_t),
            ],
        )


@dataclass(frozen=True, slots=True)
class SurveyTerm:
    """The surveyed coordinates of n points, in world."""

    point_of: Ints  # (n,)
    surveyed: Array  # (n, 3), m
    whiten: Array  # (n, 3, 3): `whitening` of the point's covariance
    loss: Loss | None = None

    def widened(self, scale: float) -> SurveyTerm:
        """The same survey with all sigmas multiplied."""
        return replace(self, whiten=self.whiten / scale)

    def linearise(self, values: Values) -> Linearised:
        """Point minus survey (n, 3), in sigmas."""
        delta = array_of(values, "points")[self.point_of] - self.surveyed
        return Linearised((self.whiten @ delta[..., None])[..., 0], [Part("points", self.point_of, self.whiten)])


@dataclass(frozen=True, slots=True)
class FrameTerm:
    """Fixes origin and axes of screen frames within their planes, which no measurement determines (gauge).

    Only the shift within the plane and the turn about its normal are constrained, to 1 um and 1 urad. The plane itself
    stays free.
    """

    screen_of: Ints  # (n,)
    chosen: Pose  # (n,) world_from_screen of the chosen frame
    loss: Loss | None = None
    sigma: float = 1e-6  # m and rad

    def linearise(self, values: Values) -> Linearised:
        """Shift along x, shift along y and turn about z relative to the chosen frame (n, 3), in sigmas."""
        world_from_screen = pose_of(values, "screens")[self.screen_of]
        delta = world_from_screen.minus(self.chosen)
        axes = np.swapaxes(self.chosen.rotation[..., :2], -1, -2)  # (n, 2, 3)
        shift = (axes @ delta[..., :3, None])[..., 0]
        residuals = np.concatenate([shift, delta[..., 5:]], axis=-1)
        # The turn stays far below a radian, where d(log)/d(theta) is the identity.
        J = np.zeros((len(self.screen_of), 3, 6))
        J[:, :2, :3] = axes
        J[:, 2, 5] = 1.0
        return Linearised(residuals / self.sigma, [Part("screens", self.screen_of, J / self.sigma)])


def bow_shape(on_screen: Array) -> Array:
    """x^2, x y, y^2 (..., 3), m^2, of points (..., 3), m, in the screen's frame."""
    x, y = on_screen[..., 0], on_screen[..., 1]
    return np.stack([x * x, x * y, y * y], axis=-1)


def surface_heights(on_screen: Array, bow: Array) -> Array:
    """Heights (...), m, along z, of points (..., 3), m, in the screen frame, above its surface. bow (..., 3), 1/m."""
    return on_screen[..., 2] - np.sum(bow_shape(on_screen) * bow, axis=-1)


def surface_slope(on_screen: Array, bow: Array) -> Array:
    """d(height)/d(point) (..., 3), in the screen frame, at points (..., 3), m. bow (..., 3), 1/m."""

    a, b, c = np.moveaxis(bow, -1, 0)
    x, y = on_screen[..., 0], on_screen[..., 1]
    return np.stack([-(2 * a * x + b * y), -(b * x + 2 * c * y), np.ones_like(x)], axis=-1)
