"""The markers of a target, their images, the calibrated pair that sees them, and the parameters of the measurement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from geometry.arrays import Array, Bools, Ints, cross
from geometry.camera import FISHEYE, Camera, pinhole_numbers, project_points, project_points_full
from geometry.lens import padded
from geometry.pose import Pose
from geometry.uncertainty.rig_uncertainty import DISTORTION, PINHOLE, POSE, RigCovariance, split_name


@dataclass(frozen=True, slots=True)
class SegmentationParameters:
    """From a picture to marker candidates: Zhou (2020), section 2. Raises ValueError: a value is out of its range."""

    gamma: float = 0.8  # of the left picture; the paper's value, below 1: brightens low levels
    specify_histogram: bool = True  # right picture to the histogram of the left one
    median_px: int = 0  # side of the median filter of the mask, odd; 0 or 1: none; removes markers of 3 px
    opening_px: int = 0  # side of the opening, removes specks; 0 or 1: none; removes markers of 3 px
    closing_px: int = 0  # side of the closing, fills holes; 0 or 1: none
    min_area_px2: float = 1.0  # smaller regions are noise
    max_area_px2: float = 40000.0  # larger regions are background
    centroid: Literal["coverage", "contour"] = "coverage"  # contour: the paper's
    sigma_floor_px: float = 0.005  # smallest sigma of a centroid: shading and texture of a real marker
    max_markers: int = 40  # per picture, the largest regions first

    def __post_init__(self) -> None:
        if not 0 < self.gamma <= 5:
            raise ValueError(f"gamma: expected a number above 0 and up to 5, got {self.gamma:g}")
        for name in ("median_px", "opening_px", "closing_px"):
            value = getattr(self, name)
            if not 0 <= value <= 51 or (name == "median_px" and value > 1 and value % 2 == 0):
                odd = " and odd" if name == "median_px" else ""
                raise ValueError(f"{name}: expected 0 to 51{odd}, got {value}")
        if not 0 <= self.min_area_px2 < self.max_area_px2:
            raise ValueError("min_area_px2: expected 0 or more and less than max_area_px2")
        if not 0 < self.sigma_floor_px <= 10:
            raise ValueError(f"sigma_floor_px: expected above 0 and up to 10, got {self.sigma_floor_px:g}")
        if not 3 <= self.max_markers <= 200:
            raise ValueError(f"max_markers: expected 3 to 200, got {self.max_markers}")


@dataclass(frozen=True, slots=True)
class MatchParameters:
    """From candidates in two pictures to labelled markers and a pose. Source: ours.

    Raises ValueError: a value is out of its range.
    """

    epipolar_sigmas: float = 5.0  # largest epipolar distance of two images of one marker
    epipolar_floor_px: float = 1.0  # added to it: calibration error and motion between the two exposures
    gate_sigmas: float = 4.5  # largest distance of a candidate from the predicted place of its marker
    area_factor: float = 4.0  # largest ratio of a candidate's area and the predicted one
    outlier_chi2: float = 18.4  # of one image's residual, 2 degrees of freedom: one good image in 10,000 is above
    detection_probability: float = 0.9  # of a marker in view
    lead_nats: float = 7.0  # of the best pose over every other one, and over "all candidates are false": 1 in 1,000
    min_markers: int = 3  # different markers in a measured pose
    max_pose_chi2_p: float = 1e-6  # a pose with a less probable misfit is not measured
    acceleration_m_s2: float = 3.0  # of the target, 1 sigma: predictions for matching
    turn_rad_s2: float = 3.0
    max_predicted_frames: int = 25  # frames without a measurement after which the target is lost

    def __post_init__(self) -> None:
        for name in ("epipolar_sigmas", "gate_sigmas", "outlier_chi2", "acceleration_m_s2", "turn_rad_s2"):
            if not 0 < getattr(self, name) < 1e6:
                raise ValueError(f"{name}: expected a number above 0, got {getattr(self, name):g}")
        if not 0 <= self.epipolar_floor_px <= 100:
            raise ValueError(f"epipolar_floor_px: expected 0 to 100, got {self.epipolar_floor_px:g}")
        if not 1 < self.area_factor <= 100:
            raise ValueError(f"area_factor: expected above 1 and up to 100, got {self.area_factor:g}")
        if not 0.5 <= self.detection_probability < 1:
            raise ValueError(f"detection_probability: expected 0.5 to 1, got {self.detection_probability:g}")
        if not 3 <= self.min_markers <= 100:
            raise ValueError(f"min_markers: expected 3 to 100, got {self.min_markers}")
        if not (0 <= self.lead_nats <= 100 and 0 <= self.max_pose_chi2_p < 1):
            raise ValueError("lead_nats: expected 0 to 100; max_pose_chi2_p: expected 0 to 1")
        if not 0 <= self.max_predicted_frames <= 100000:
            raise ValueError(f"max_predicted_frames: expected 0 to 100000, got {self.max_predicted_frames}")


@dataclass(frozen=True, slots=True)
class BinocularParameters:
    """All parameters of the binocular measurement."""

    segmentation: SegmentationParameters = field(default_factory=SegmentationParameters)
    match: MatchParameters = field(default_factory=MatchParameters)


@dataclass(frozen=True, slots=True)
class MarkerModel:
    """K markers in the body frame of the target."""

    names: tuple[str, ...]
    positions: Array  # (K, 3), m
    colour: Ints  # (K,) index of the colour range
    radius_m: Array  # (K,), nan where it is not known
    sigma_m: float = 0.0  # of each coordinate of `positions`: how well the markers are surveyed
    normal: Array = field(init=False, repr=False)  # (3,) of the plane that fits best
    facing: Array = field(init=False, repr=False)  # (K, 3), m: normals of discs, as long as their radii; 0: not known

    def __post_init__(self) -> None:
        object.__setattr__(self, "normal", np.linalg.svd(self.positions - self.positions.mean(axis=0))[2][-1])
        object.__setattr__(self, "facing", np.nan_to_num(self.radius_m)[:, None] * self.normal)

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
    fisheye: Bools  # (2, 1)

    @staticmethod
    def of(cameras: tuple[Camera, Camera]) -> CameraNumbers:
        """Of two cameras."""
        return CameraNumbers(
            np.stack([c.camera_from_world.rotation for c in cameras]),
            np.stack([c.camera_from_world.translation for c in cameras]),
            np.stack([pinhole_numbers(c) for c in cameras])[:, None],
            np.stack([padded(c.distortion) for c in cameras])[:, None],
            np.array([[c.fold_r2] for c in cameras]),
            np.array([[c.lens == FISHEYE] for c in cameras]),
        )


@dataclass(frozen=True, slots=True)
class StereoPair:
    """Two calibrated cameras; the pictures of the first are the reference of the histogram specification.

    covariance: of the errors of the calibration, names as in geometry/uncertainty/rig_uncertainty.py. Raises
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
        seen = project_points_full(to_camera.apply(points_world), *camera.lens_numbers)
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
