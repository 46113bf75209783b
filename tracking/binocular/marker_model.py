"""The markers of a target, their images in one picture, and the calibrated pair of cameras that sees them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from geometry.arrays import Array, Bools, Ints, cross
from geometry.camera import FISHEYE, Camera, pinhole_numbers, project_points, project_points_full
from geometry.lens import padded
from geometry.pose import Pose
from geometry.uncertainty.rig_uncertainty import DISTORTION, PINHOLE, POSE, RigCovariance, split_name


@dataclass(frozen=True, slots=True)
class MarkerModel:
    """K markers in the body frame of the target."""

    names: tuple[str, ...]
    positions: Array  # (K, 3), m
    colour: Ints  # (K,) index of the colour range
    radius_m: Array  # (K,), nan where it is not known
    sigma_m: float = 0.0  # of each coordinate of `positions`: how well the markers are surveyed
    facing: Array = field(init=False, repr=False)  # (K, 3), m: normals of discs, as long as their radii; 0: not known

    def __post_init__(self) -> None:
        normal = np.linalg.svd(self.positions - self.positions.mean(axis=0))[2][-1]
        object.__setattr__(self, "facing", np.nan_to_num(self.radius_m)[:, None] * normal)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def extent_m(self) -> float:
        """Largest distance of a marker from the mean of all."""
        return float(np.linalg.norm(self.positions - self.positions.mean(axis=0), axis=1).max())


@dataclass(frozen=True, slots=True)
class MarkerImages:
    """n marker candidates in one picture."""

    uv_px: Array  # (n, 2), distorted
    cov_px2: Array  # (n, 2, 2)
    area_px2: Array  # (n,), nan where it is not known
    colour: Ints  # (n,) index of the colour range

    def __len__(self) -> int:
        return len(self.uv_px)

    @staticmethod
    def none() -> MarkerImages:
        """No candidates."""
        return MarkerImages(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0), np.zeros(0, dtype=np.int64))

    def pick(self, index: Ints) -> MarkerImages:
        """Some of the candidates."""
        return MarkerImages(self.uv_px[index], self.cov_px2[index], self.area_px2[index], self.colour[index])


@dataclass(frozen=True, slots=True)
class CameraNumbers:
    """The numbers of both cameras, stacked: one call projects into both, at half the cost of two."""

    rotation: Array  # (2, 3, 3) camera_from_world
    translation: Array  # (2, 3), m
    pinhole: Array  # (2, 1, 4)
    distortion: Array  # (2, 1, 14)
    fold_r2: Array  # (2, 1)
    fisheye: Bools | None  # (2, 1); None: neither camera is one

    @staticmethod
    def of(cameras: tuple[Camera, Camera]) -> CameraNumbers:
        """Of two cameras."""
        wide = np.array([[c.lens == FISHEYE] for c in cameras])
        return CameraNumbers(
            np.stack([c.camera_from_world.rotation for c in cameras]),
            np.stack([c.camera_from_world.translation for c in cameras]),
            np.stack([pinhole_numbers(c) for c in cameras])[:, None],
            np.stack([padded(c.distortion) for c in cameras])[:, None],
            np.array([[c.fold_r2] for c in cameras]),
            wide if wide.any() else None,
        )


@dataclass(frozen=True, slots=True)
class StereoPair:
    """Two calibrated cameras; the pictures of the first are the reference of the histogram specification.

    covariance: of the errors of the calibration, names as in geometry/uncertainty/rig_uncertainty.py.

    Raises:
        ValueError: the cameras are at the same place, or a covariance names another camera.
    """

    cameras: tuple[Camera, Camera]
    covariance: RigCovariance | None = None
    numbers: CameraNumbers = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "numbers", CameraNumbers.of(self.cameras))
        if not self.baseline_m > 0:
            raise ValueError("the two cameras are at the same place: there is no baseline")
        names = [c.name for c in self.cameras]
        for name in () if self.covariance is None else self.covariance.names:
            if split_name(name)[1] not in names:
                raise ValueError(f"covariance: expected parameters of {names[0]} and {names[1]}, got {name}")

    @property
    def baseline_m(self) -> float:
        """Distance of the two projection centres."""
        left, right = (c.camera_from_world.inverse().translation for c in self.cameras)
        return float(np.linalg.norm(left - right))


def project(pair: StereoPair, points_world: Array, facing: Array | None = None) -> tuple[Array, Array]:
    """Distorted pixels (..., 2, K, 2) of world points (..., K, 3), m, in both cameras, and d(pixel)/d(point).

    facing (..., K, 3): normals of discs in world, as long as their radii, m: the pixels are then the centroids of the
    discs' images. The derivatives (..., 2, K, 2, 3) are px/m, by the point in world. nan behind a camera or beyond the
    lens's fold.

    Source of the centroids: ours. The near part of a tilted disc is larger in the picture than its far part. Its
    centroid is the mean of (x, y) / z over the disc, weighted with z^-3, here to second order in radius over distance.
    """
    n = pair.numbers
    turn = np.swapaxes(n.rotation, -1, -2)
    in_cameras = points_world[..., None, :, :] @ turn + n.translation[:, None]
    if facing is not None:
        m = facing[..., None, :, :] @ turn
        z = in_cameras[..., 2:]
        flat = np.sum(m * m, axis=-1, keepdims=True) - m[..., 2:] ** 2
        with np.errstate(invalid="ignore", divide="ignore"):
            shift = (m[..., :2] * m[..., 2:] + in_cameras[..., :2] / z * flat) / z
        in_cameras[..., :2] += shift
    pixels, J = project_points(in_cameras, n.pinhole, n.distortion, n.fold_r2, n.fisheye)
    return pixels, J @ n.rotation[:, None]


def project_markers(pair: StereoPair, model: MarkerModel, world_from_body: Pose) -> tuple[Array, Array]:
    """Pixels (..., 2, K, 2) of all markers for poses (...), and their Jacobian (..., 2, K, 2, 6) by the pose error.

    The pose error is that of section 1 of the file contract: [dt (m, in world), dtheta (rad, in body)]. The pixels are
    centroids of discs where radii are known; the derivatives are those of the centres, which differ by less than 1 %.
    """
    R = world_from_body.rotation
    back = np.swapaxes(R, -1, -2)
    places = model.positions @ back + world_from_body.translation[..., None, :]
    pixels, by_point = project(pair, places, model.facing @ back)
    # d(R Exp(theta) m)/dtheta = -R [m]_x; with a row w of the derivative by the point, -w R [m]_x = m x (w R).
    in_body = by_point @ R[..., None, None, :, :]
    by_turn = cross(model.positions[:, None, :], in_body)
    return pixels, np.concatenate([by_point, by_turn], axis=-1)


def calibration_jacobian(pair: StereoPair, points_world: Array, names: Sequence[str] | None = None) -> Array:
    """Derivatives (2, K, 2, p) of the pixels of world points (K, 3) by p parameters; None: those of the covariance.

    Source: ours; the parameters and their errors are those of geometry/uncertainty/rig_uncertainty.py.
    """
    if names is None:
        assert pair.covariance is not None
        names = pair.covariance.names
    out = np.zeros((2, len(points_world), 2, len(names)))
    for c, camera in enumerate(pair.cameras):
        to_camera = camera.camera_from_world
        seen = project_points_full(
            to_camera.apply(points_world),
            pinhole_numbers(camera),
            padded(camera.distortion),
            np.asarray(camera.fold_r2),
            np.asarray(camera.lens == FISHEYE),
        )
        by_turn = cross(points_world[:, None, :], seen.d_point @ to_camera.rotation)
        by = dict(
            zip(
                (*PINHOLE, *DISTORTION, *POSE),
                np.concatenate([seen.d_pinhole, seen.d_distortion, seen.d_point, by_turn], axis=-1).transpose(2, 0, 1),
                strict=True,
            )
        )
        for i, name in enumerate(names):
            _, item, parameter = split_name(name)
            if item == camera.name:
                out[c, :, :, i] = by[parameter]
    return out
