"""Monte Carlo of the binocular measurement: distances from 5 to 30 m, and the pose of seven markers at 10 m.

The camera of Zhou (2020): the field of 46 m at 40 m on 1080 lines is a focal length of 939 px. The baseline is not
printed and cannot be computed from what is; 0.5 m is ours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.lens.fit.corner_table import CornerTable
from calibration.lens.fit.lens_models import LensModel
from calibration.lens.intrinsics import IntrinsicsOptions, calibrate_intrinsics
from calibration.pair.pair_calibration import CalibratedPair, calibrate_pair
from geometry import rotations
from geometry.arrays import Array, Ints
from geometry.camera import in_picture
from geometry.pose import Pose
from lab.binocular.simulated_recording import drogue_markers, simulated_pair
from tracking.binocular.first_fit import first_fit
from tracking.binocular.horn import pose_of_points
from tracking.binocular.joint_fit import MarkerObservations, bound
from tracking.binocular.marker_model import StereoPair, project, project_markers
from tracking.binocular.triangulation import linear_points, triangulate, undistorted_pixels

FOCAL_PX, SIZE_PX, BASELINE_M = 939.0, (1920, 1080), 0.5
DISTANCES_M = (5.0, 10.0, 15.0, 20.0, 25.0, 30.0)
METHODS = ("paper's method", "single points", "joint fit")  # equations (7) to (9); most likely points; all markers


@dataclass(frozen=True, slots=True)
class DistanceErrors:
    """Errors of the distance of marker 1 from the left camera, m, by method (METHODS), over many trials."""

    distance_m: float
    errors: Array  # (trials, 3)
    bounds: Array  # (trials, 2): the smallest sigma of an unbiased estimate, from one marker and from all

    @property
    def bias(self) -> Array:
        """(3,), m."""
        return np.asarray(self.errors.mean(axis=0))

    @property
    def rms(self) -> Array:
        """(3,), m."""
        return np.asarray(np.sqrt((self.errors**2).mean(axis=0)))

    @property
    def bound(self) -> Array:
        """(3,), m: RMS of the bounds, of the information that each method uses."""
        one, every = np.sqrt((self.bounds**2).mean(axis=0))
        return np.array([one, one, every])


def distance_errors(
    distance_m: float, trials: int, noise_px: float, rng: np.random.Generator, known: StereoPair | None = None
) -> DistanceErrors:
    """Trials at a distance, with Gaussian noise (1 sigma) of the centroids; known: the calibration of the true pair."""
    true, model = simulated_pair(FOCAL_PX, SIZE_PX, BASELINE_M), drogue_markers()
    pair = true if known is None else StereoPair(known.cameras)
    cov = np.broadcast_to(noise_px**2 * np.eye(2), (2, len(model), 2, 2))
    seen = np.ones((2, len(model)), dtype=bool)
    errors, bounds = [], []
    for _ in range(trials):
        pose = random_pose(distance_m, rng)
        marker = pose.apply(model.positions[0])
        uv = project_markers(true, model, pose)[0] + rng.normal(0, noise_px, (2, len(model), 2))
        flat = np.stack([undistorted_pixels(c, u[:1]) for c, u in zip(pair.cameras, uv, strict=True)])
        points = triangulate(pair, uv, cov)
        fit = first_fit(pair, model, MarkerObservations(uv, cov))
        assert fit is not None
        found = (linear_points(pair, flat)[0], points.points[0], fit.pose.apply(model.positions[0]))
        far = float(np.linalg.norm(marker))
        errors.append([float(np.linalg.norm(x)) - far for x in found])
        sight = marker / far
        by_point = project(true, marker[None])[1].reshape(4, 3) / noise_px
        single = np.linalg.inv(by_point.T @ by_point)
        by_pose = np.concatenate([sight, np.cross(model.positions[0], pose.rotation.T @ sight)])
        every = by_pose @ bound(true, model, pose, cov, seen) @ by_pose
        bounds.append([float(np.sqrt(sight @ single @ sight)), float(np.sqrt(every))])
    return DistanceErrors(distance_m, np.array(errors), np.array(bounds))


def random_pose(distance_m: float, rng: np.random.Generator) -> Pose:
    """A drogue near the middle of both pictures, turned by up to about 30 deg, facing the cameras."""
    place = np.array([0.25, 0.0, 0.0]) + distance_m * np.array([*rng.uniform(-0.08, 0.08, 2), 1.0])
    return Pose(rotations.exp(rng.normal(0, 0.25, 3)), place)


@dataclass(frozen=True, slots=True)
class PoseErrors:
    """Errors of the pose of seven markers over many trials."""

    horn: Array  # (trials, 6), section 1 of the file contract: the paper's method
    joint: Array  # (trials, 6): the joint fit
    bounds: Array  # (trials, 6): smallest sigmas of an unbiased estimate
    nees: Array  # (trials,) of the joint fit

    def ratios(self) -> Array:
        """(2,): RMS over its bound, of position and rotation of the joint fit."""
        error, smallest = (np.sqrt((a**2).mean(axis=0)) for a in (self.joint, self.bounds))
        return np.array([np.linalg.norm(error[s]) / np.linalg.norm(smallest[s]) for s in (slice(0, 3), slice(3, 6))])


def pose_errors(
    trials: int, noise_px: float, rng: np.random.Generator, distance_m: float = 10.0, focal_px: float = 1500.0
) -> PoseErrors:
    """Trials of seven markers (rim of 0.3 m) at a distance."""
    pair, model = simulated_pair(focal_px, (1280, 1024), BASELINE_M), drogue_markers()
    cov = np.broadcast_to(noise_px**2 * np.eye(2), (2, len(model), 2, 2))
    seen = np.ones((2, len(model)), dtype=bool)
    rows: list[tuple[Array, Array, Array, float]] = []
    for _ in range(trials):
        pose = random_pose(distance_m, rng)
        uv = project_markers(pair, model, pose)[0] + rng.normal(0, noise_px, (2, len(model), 2))
        flat = np.stack([undistorted_pixels(c, u) for c, u in zip(pair.cameras, uv, strict=True)])
        horn = pose_of_points(model.positions, linear_points(pair, flat))
        fit = first_fit(pair, model, MarkerObservations(uv, cov))
        assert fit is not None
        delta = pose.minus(fit.pose)
        sigmas = np.sqrt(np.diagonal(bound(pair, model, pose, cov, seen)))
        rows.append((pose.minus(horn), delta, sigmas, float(delta @ np.linalg.solve(fit.covariance, delta))))
    horns, joints, bounds, nees = zip(*rows, strict=True)
    return PoseErrors(np.array(horns), np.array(joints), np.array(bounds), np.array(nees))


def simulated_calibration(rng: np.random.Generator, pairs: int = 20, noise_px: float = 0.1) -> CalibratedPair:
    """The pair of `distance_errors`, calibrated from corners of a board of 9 x 6 squares of 80 mm at 1.2 to 3.5 m."""
    true = simulated_pair(FOCAL_PX, SIZE_PX, BASELINE_M)
    grid = np.array([[x, y, 0.0] for y in range(6) for x in range(9)]) * 0.08
    middle = grid.mean(axis=0)
    found: list[list[tuple[Ints, Array]]] = [[], []]
    numbers: tuple[list[int], list[int]] = ([], [])
    number = 0
    while min(map(len, numbers)) < pairs:
        number += 1
        depth = rng.uniform(1.2, 3.5)
        at = np.array([0.25 + rng.uniform(-0.7, 0.7) * depth, rng.uniform(-0.4, 0.4) * depth, depth])
        turn = rotations.exp(rng.uniform(-0.6, 0.6, 3))
        board = Pose(turn, at - turn @ middle)
        pixels = project(true, board.apply(grid))[0]
        for c, camera in enumerate(true.cameras):
            inside: Ints = np.flatnonzero(in_picture(pixels[c], np.array(camera.image_size_px), -10.0)).astype(np.int64)
            if len(inside) >= 20:
                found[c].append((inside, pixels[c, inside] + rng.normal(0, noise_px, (len(inside), 2))))
                numbers[c].append(number)
    options = IntrinsicsOptions(lens=LensModel(5), warp=False, stretch=False)
    single = [calibrate_intrinsics(CornerTable.of(views, grid, middle, SIZE_PX), options) for views in found]
    return calibrate_pair(("left", "right"), (single[0], single[1]), numbers)
