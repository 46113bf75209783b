"""Surveyed points, boards fixed to screens, and recorded poses as terms of an adjustment; subsets of terms.

Stacks: "intrinsics" (fx, fy, cx, cy, px, and 14 distortion coefficients), "cameras" (camera_from_world), "screens"
(world_from_screen), "bow" (1/m), "points" (world, m), "boards" (world_from_board). All Jacobians are by the errors that
these stacks define.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol, Self, cast

import numpy as np

from calibration.least_squares.adjustment import Linearised, Loss, Part, Poses, Term, Values, Vectors
from geometry import lens, rotations
from geometry.arrays import Array, Bools, Ints, skew
from geometry.camera import project_points_full
from geometry.pose import Pose


class ScalableTerm(Term, Protocol):
    """A term whose sigmas may be too small."""

    def widened(self, scale: float) -> Self:
        """The same term with all its sigmas multiplied."""


class MeasurementTerm(ScalableTerm, Protocol):
    """A term with one row per measurement, of which outliers can be left out."""

    def __len__(self) -> int:
        """Number of measurements."""

    def pick(self, rows: Bools, loss: Loss | None = None) -> Self:
        """Some of the measurements, with this loss."""


def rows_of(term: Term) -> int:
    """Number of measurements of a term."""
    return len(cast(MeasurementTerm, term))


def picked(term: Term, rows: Bools, loss: Loss | None = None) -> Term:
    """Some rows of a term, with this loss."""
    return cast(MeasurementTerm, term).pick(rows, loss)


def widened(term: Term, scale: float) -> Term:
    """A term with all its sigmas multiplied; with a scale of 1 any term."""
    return term if scale == 1.0 else cast(ScalableTerm, term).widened(scale)


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
    """x^2, x y, y^2 (..., 3), m^2, of points (..., 2 or 3), m: derivatives of the height of a bent screen or board."""
    x, y = on_screen[..., 0], on_screen[..., 1]
    return np.stack([x * x, x * y, y * y], axis=-1)


def bow_slope(on_screen: Array, step: Array) -> Array:
    """Derivatives (..., 3), m, of `bow_shape` at points (..., 2 or 3), m, along directions (..., 2 or 3)."""
    x, y, p, q = on_screen[..., 0], on_screen[..., 1], step[..., 0], step[..., 1]
    return np.stack([2 * x * p, x * q + y * p, 2 * y * q], axis=-1)


def surface_heights(on_screen: Array, bow: Array) -> Array:
    """Heights (...), m, along z, of points (..., 3), m, in the screen frame, above its surface. bow (..., 3), 1/m."""
    return on_screen[..., 2] - np.sum(bow_shape(on_screen) * bow, axis=-1)


def surface_slope(on_screen: Array, bow: Array) -> Array:
    """d(height)/d(point) (..., 3), in the screen frame, at points (..., 3), m. bow (..., 3), 1/m."""

    a, b, c = np.moveaxis(bow, -1, 0)
    x, y = on_screen[..., 0], on_screen[..., 1]
    return np.stack([-(2 * a * x + b * y), -(b * x + 2 * c * y), np.ones_like(x)], axis=-1)


@dataclass(frozen=True, slots=True)
class BoardOnScreenTerm:
    """n boards, each flat on its screen with the printed side outwards: the board's z axis points into the screen."""

    screen_of: Ints  # (n,) index into "screens" and "bow"
    placement_of: Ints  # (n,) index into "boards"
    middle: Array  # (n, 3), m, in the board's frame: the point at which the offset holds
    offset_m: Array  # (n,): height of the printed side above the screen's surface
    sigma_m: Array  # (n,): sigma of the offset
    tilt_sigma_rad: Array  # (n,): sigma of the angle between board and surface, about each axis of the board
    loss: Loss | None = None

    def linearise(self, values: Values) -> Linearised:
        """Height minus offset, and the slopes of the board's x and y axes against the surface: (n, 3), in sigmas."""
        world_from_screen = pose_of(values, "screens")[self.screen_of]
        world_from_board = pose_of(values, "boards")[self.placement_of]
        bow = array_of(values, "bow")[self.screen_of]
        screen_from_board = world_from_screen.inverse() @ world_from_board
        p = screen_from_board.apply(self.middle)
        axes = np.swapaxes(screen_from_board.rotation[..., :2], -1, -2)  # (n, 2, 3): the board's x, y
        g = surface_slope(p, bow)
        residuals = np.concatenate(
            [(surface_heights(p, bow) - self.offset_m)[:, None], (axes @ g[..., None])[..., 0]], axis=1
        )
        # p and the axes, in the screen's frame, depend on the board's pose and on the screen's.
        curve = np.zeros((*g.shape, 3))  # d(g)/d(p)
        a, b, c = np.moveaxis(bow, -1, 0)
        curve[:, 0, 0], curve[:, 0, 1], curve[:, 1, 0], curve[:, 1, 1] = -2 * a, -b, -b, -2 * c
        by_p = np.concatenate([g[:, None, :], axes @ curve], axis=1)  # (n, 3, 3)
        R_t = np.swapaxes(world_from_screen.rotation, -1, -2)
        R = screen_from_board.rotation
        by_board = np.concatenate([by_p @ R_t, -by_p @ R @ skew(self.middle)], axis=-1)
        by_screen = np.concatenate([-by_p @ R_t, by_p @ skew(p)], axis=-1)
        for k in range(2):
            # A rotation theta of the board changes its axis by R (theta x e), one of the screen by -theta x axis.

            e = np.broadcast_to(np.eye(3)[k], p.shape)
            by_board[:, 1 + k, 3:] += (-g[:, None, :] @ R @ skew(e))[:, 0]
            by_screen[:, 1 + k, 3:] += (g[:, None, :] @ skew(axes[:, k]))[:, 0]
        by_bow = -np.concatenate([bow_shape(p)[:, None], bow_slope(p[:, None], axes)], axis=1)
        sigma = np.stack([self.sigma_m, self.tilt_sigma_rad, self.tilt_sigma_rad], axis=1)
        whiten = 1.0 / sigma[..., None]
        return Linearised(
            residuals / sigma,
            [
                Part("screens", self.screen_of, by_screen * whiten),
                Part("bow", self.screen_of, by_bow * whiten),
                Part("boards", self.placement_of, by_board * whiten),
            ],
        )


@dataclass(frozen=True, slots=True)
class RecordTerm:
    """n recorded transforms of a stack of poses, each number with its own sigma."""

    stack: str
    index: Ints  # (n,) index into the stack
    recorded: Pose  # (n,)
    sigmas: Array  # (n, 6), m and rad, of the error [dt, dtheta]; inf: not recorded; 0 only for numbers held fixed
    loss: Loss | None = None

    def __len__(self) -> int:
        return len(self.index)

    def pick(self, rows: Bools, loss: Loss | None = None) -> RecordTerm:
        """Some of the records, with this loss."""
        return RecordTerm(self.stack, self.index[rows], self.recorded[rows], self.sigmas[rows], loss)

    def widened(self, scale: float) -> RecordTerm:
        """The same records with all sigmas multiplied."""
        return replace(self, sigmas=self.sigmas * scale)

    def linearise(self, values: Values) -> Linearised:
        """Pose minus record (n, 6), in sigmas; 0 for numbers that are not recorded or held fixed."""
        delta = pose_of(values, self.stack)[self.index].minus(self.recorded)
        used = np.isfinite(self.sigmas) & (self.sigmas > 0)
        per_sigma = np.where(used, 1.0 / np.where(used, self.sigmas, 1.0), 0.0)
        J = np.zeros((len(self.index), 6, 6))
        J[:, :3, :3] = np.eye(3)
        # d(log(R_0^T R Exp(theta))) / d(theta) is the inverse of the right Jacobian at the difference.
        J[:, 3:, 3:] = np.linalg.inv(rotations.right_jacobian(delta[:, 3:]))
        return Linearised(delta * per_sigma, [Part(self.stack, self.index, per_sigma[..., None] * J)])
