"""A calibrated camera: world points to distorted pixels and back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from geometry import lens
from geometry.arrays import Array, Bools, skew
from geometry.pose import Pose

PERSPECTIVE, FISHEYE = "perspective", "fisheye"
LENSES = (PERSPECTIVE, FISHEYE)


@dataclass(frozen=True, slots=True)
class SensorNoise:
    """The relation between photo-electrons and grey values."""

    gain_e_per_dn: float  # electrons per DN
    read_noise_e: float  # electrons, 1 sigma
    black_dn: float = 0.0  # DN of a pixel without light


@dataclass(frozen=True, slots=True)
class Camera:
    """A calibrated camera, fixed in the lab.

    Raises ValueError: unknown lens model, or a number of distortion coefficients that it does not have.
    """

    name: str
    screen: str  # name of the screen that it observes
    image_size_px: tuple[int, int]  # width, height
    matrix: Array  # (3, 3), px: fx, fy, cx, cy; no skew
    distortion: tuple[float, ...]  # OpenCV order; 0, 4, 5, 8, 12 or 14 numbers
    camera_from_world: Pose
    noise: SensorNoise | None = None
    lens: str = PERSPECTIVE  # or FISHEYE: the model whose coefficients the distortion numbers are
    # Of its clock in every recording, added to what the recording states: its mid-exposure minus the frame's instant,
    # and by how much each row is exposed later than the one above.
    time_offset_s: float = 0.0
    row_time_s: float = 0.0
    fold_r2: float = field(init=False)  # squared normalised radius beyond which the lens model folds

    def __post_init__(self) -> None:
        if len(self.distortion) not in lens.ALLOWED_LENGTHS:
            raise ValueError(
                f"camera {self.name!r}: {len(self.distortion)} distortion numbers,"
                " OpenCV's models have 0, 4, 5, 8, 12 or 14"
            )
        if self.lens not in LENSES:
            raise ValueError(f"camera {self.name!r}: expected lens {' or '.join(LENSES)}, got {self.lens!r}")
        if self.lens == FISHEYE and len(self.distortion) not in (0, 4):
            raise ValueError(
                f"camera {self.name!r}: {len(self.distortion)} distortion numbers, the fisheye model has 4 (or none)"
            )
        limit = lens.fisheye_fold_limit if self.lens == FISHEYE else lens.fold_limit
        object.__setattr__(self, "fold_r2", limit(self.distortion))

    def project(self, points_world: Array) -> Array:
        """Distorted pixels (..., 2) of world points (..., 3), m; nan behind the camera or beyond the fold."""
        in_camera = self.camera_from_world.apply(np.asarray(points_world, dtype=float))
        return project_points(in_camera, *self.lens_numbers)[0]

    @property
    def lens_numbers(self) -> tuple[Array, Array, Array, Bools]:
        """Pinhole numbers, distortion, fold and kind of lens, as arguments of `project_points`."""
        fold_r2, fisheye = np.asarray(self.fold_r2), np.asarray(self.lens == FISHEYE)
        return pinhole_numbers(self), lens.padded(self.distortion), fold_r2, fisheye

    def rays(self, pixels: Array) -> tuple[Array, Array]:
        """Origins (3,), m, and unit directions (..., 3), both in world, of distorted pixels (..., 2)."""
        pixels = np.asarray(pixels, dtype=float)
        world = self._towards(pixels) @ self.camera_from_world.rotation  # rows times R = R^T x
        world /= np.linalg.norm(world, axis=1, keepdims=True)
        return self.camera_from_world.inverse().translation, world.reshape(*pixels.shape[:-1], 3)

    def _towards(self, pixels: Array) -> Array:
        """(n, 3): points in the camera frame, at z = 1, of distorted pixels (..., 2)."""
        fx, fy, cx, cy = pinhole_numbers(self)
        distorted = (pixels - [cx, cy]) / [fx, fy]
        flat = lens.undistort(
            distorted.reshape(-1, 2), lens.padded(self.distortion), self.fold_r2, self.lens == FISHEYE
        )
        return np.concatenate([flat, np.ones((len(flat), 1))], axis=1)

    def by_turns(self, pixels: Array) -> Array:
        """(n, 2, 3), px/rad: d(pixel)/d(rotation vector) of what distorted pixels (n, 2) show, in the camera frame.

        The rotation is that of the scene about the camera: that of the camera has the opposite sign. nan beyond the
        fold.
        """
        points = self._towards(np.asarray(pixels, dtype=float))
        J = project_points(points, *self.lens_numbers)[1]
        return np.asarray(-J @ skew(points))

    def sees(self, pixels: Array, margin_px: float = 0.0) -> Bools:
        """Whether pixels (..., 2) lie in the picture, or at most `margin_px` outside it; False for nan."""
        return in_picture(np.asarray(pixels, dtype=float), np.asarray(self.image_size_px), margin_px)


def in_picture(pixels: Array, sizes_px: Array, margin_px: float | Array = 0.0) -> Bools:
    """Whether pixels (..., 2) lie in pictures: -0.5 <= u < width - 0.5, the same for v, widened by the margin.

    sizes_px (..., 2): width, height. False for nan.
    """
    shifted = pixels + 0.5
    margin = np.asarray(margin_px)[..., None]
    return np.all((shifted >= -margin) & (shifted < sizes_px + margin), axis=-1)


def pinhole_numbers(camera: Camera) -> Array:
    """fx, fy, cx, cy (4,), px."""
    return np.array([camera.matrix[0, 0], camera.matrix[1, 1], camera.matrix[0, 2], camera.matrix[1, 2]])


def camera_matrix(pinhole: Array | Sequence[float]) -> Array:
    """The camera matrix (3, 3), px, of fx, fy, cx, cy, px."""
    fx, fy, cx, cy = pinhole
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def project_points(
    points_camera: Array, pinhole: Array, distortion: Array, fold_r2: Array, fisheye: Bools
) -> tuple[Array, Array]:
    """Pixels (..., 2) and d(pixel)/d(point) (..., 2, 3), px/m, of points (..., 3), m, in the camera frame.

    pinhole (..., 4): fx, fy, cx, cy; distortion (..., 14); fold_r2 (...); fisheye (...). All are
    broadcast against the points, so that one call serves points of several cameras. nan behind the camera (z <= 0)
    or beyond the fold.
    """
    return _projected(points_camera, pinhole, distortion, fold_r2, fisheye)[:2]


def _projected(
    points_camera: Array, pinhole: Array, distortion: Array, fold_r2: Array, fisheye: Bools
) -> tuple[Array, Array, Array, Array]:
    """As `project_points`, then the normalised points (..., 2) and the distorted ones (..., 2)."""
    xy, z, in_front = _on_image_plane(points_camera)
    focal, centre = pinhole[..., :2], pinhole[..., 2:]
    if distortion.any() or np.any(fisheye):
        distorted, J_lens = lens.distort(xy, distortion, fisheye)
        good = in_front & lens.is_one_to_one(xy, J_lens, fold_r2)
        J_xy = focal[..., :, None] * J_lens
    else:
        distorted, good = xy, in_front
        J_xy = np.broadcast_to(focal[..., :, None] * np.eye(2), (*xy.shape, 2))
    pixels = np.where(good[..., None], focal * distorted + centre, np.nan)
    J = np.empty((*xy.shape, 3))
    J[..., :2] = J_xy / z[..., None, None]
    J[..., 2] = -np.einsum("...ij,...j->...i", J[..., :2], xy)
    return pixels, J, xy, distorted


@dataclass(frozen=True, slots=True)
class Projected:
    """Pixels of points and their derivatives with respect to the point and to every number of the camera."""

    pixels: Array  # (..., 2), distorted; nan as in `project_points`
    d_point: Array  # (..., 2, 3), px/m
    d_pinhole: Array  # (..., 2, 4), px per px of fx, fy, cx, cy
    d_distortion: Array  # (..., 2, 14), px


def project_points_full(
    points_camera: Array, pinhole: Array, distortion: Array, fold_r2: Array, fisheye: Bools
) -> Projected:
    """As `project_points`, with the derivatives with respect to the camera's numbers too: for calibrations."""
    pixels, d_point, xy, distorted = _projected(points_camera, pinhole, distortion, fold_r2, fisheye)
    d_coefficients = lens.coefficient_jacobian(xy, distortion, fisheye)
    d_pinhole = np.zeros((*pixels.shape, 4))
    d_pinhole[..., 0, 0], d_pinhole[..., 1, 1] = distorted[..., 0], distorted[..., 1]
    d_pinhole[..., 0, 2] = d_pinhole[..., 1, 3] = 1.0
    return Projected(pixels, d_point, d_pinhole, pinhole[..., :2, None] * d_coefficients)


def _on_image_plane(points_camera: Array) -> tuple[Array, Array, Bools]:
    """Normalised image points (..., 2), depths (...), m (1 for points behind the camera), and which lie in front."""
    z = points_camera[..., 2]
    in_front = z > 1e-9
    z = np.where(in_front, z, 1.0)
    return points_camera[..., :2] / z[..., None], z, in_front
