"""The points of light of one frame, and the labelling problem for compiled code: views, limits, workspace of a pose."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled, compiled_in_caller
from geometry.compiled_projection import Views
from geometry.forward_model import SpotModel
from geometry.planes import intersect_surface
from geometry.rig import Rig
from tracking.detections import Detections
from tracking.parameters import LabelParameters
from tracking.shapes import log_shape_ratio

NO_POINT = -1  # label of a view without a point
# Sigmas within which points of two cameras that observe the same screen are one point of light.
SAME_POINT = 6.0


class Points(NamedTuple):
    """m points of light that may be spots, ordered by camera; only the clearest of a crowded picture."""

    uv: Array  # (m, 2) px
    cov: Array  # (m, 2, 2) px^2, as stated by the detections
    world: Array  # (m, 3) m, on the screen; nan where the line of sight misses it
    m_per_px: Array  # (m,) m, displacement on the screen for one pixel, the larger of both axes
    first: Ints  # (cameras + 1,) row of the first point of each camera
    row: Ints  # (m,) row in that camera's detections
    log_shape: Array  # (m,) see `log_shape_ratio`
    log_density: Array  # (cameras,) log of the density of all points, 1/px^2
    log_unused: Array  # (cameras, most + 1): see `_log_unused`


def _clearest_first(found: Detections) -> Ints:
    """The rows of points, by signal to noise: their width over the sigma of their centre; otherwise by flux.

    Objects in front of which a spot shines are often brighter than it, but no Gaussian: their centre is uncertain. The
    flux counts where widths are unknown or all sigmas are the same.
    """
    clear = found.major_px * found.minor_px / found.variance_px2
    measured = len(found) > 1 and np.isfinite(clear).all() and np.ptp(found.variance_px2) > 0
    return np.argsort(-(clear if measured else np.nan_to_num(found.flux, nan=0.0)), kind="stable")


def points_of(
    rig: Rig,
    model: SpotModel,
    detections: Mapping[str, Detections],
    parameters: LabelParameters,
    reached: Callable[[int, Array], Bools],
) -> Points:
    """The points of all cameras. The rig is the one that `model` was made of.

    reached: for a camera (by number) and points (k, 3), m, on its screen: which of them any spot may light.
    """
    cameras = len(model.camera_names)
    uv, cov, world, row = [np.zeros((0, 2))], [np.zeros((0, 2, 2))], [np.zeros((0, 3))], [np.zeros(0, dtype=np.int64)]
    m_per_px, log_shape = [np.zeros(0)], [np.zeros(0)]
    first = np.zeros(cameras + 1, dtype=np.int64)
    log_density = np.zeros(cameras)
    log_unused = np.zeros((cameras, len(model) + 1))
    for c, name in enumerate(model.camera_names):
        found = detections.get(name)
        count = 0
        if found is not None and len(found):
            camera = rig.cameras[name]
            screen = rig.screens[camera.screen]
            order = _clearest_first(found)
            if len(found) > parameters.max_points:
                origin, rays = camera.rays(found.uv_px[order])
                possible = np.flatnonzero(
                    reached(c, intersect_surface(origin, rays, screen.world_from_screen, screen.bow))
                )
                clearest = order[possible[: parameters.max_points]]
                # The density of false points is that of all points at least as clear as these.
                if len(possible) > parameters.max_points:
                    order = order[: possible[parameters.max_points]]
            else:
                clearest = order
            here = found.uv_px[clearest]
            origin, rays = camera.rays(here + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])[:, None])
            hits = intersect_surface(origin, rays, screen.world_from_screen, screen.bow)
            uv.append(here)
            cov.append(found.cov_px2[clearest])
            world.append(hits[0])
            m_per_px.append(np.linalg.norm(hits[1:] - hits[0], axis=-1).max(axis=0))
            row.append(clearest)
            ratio = np.zeros(len(found))
            ratio[order] = log_shape_ratio(found[order], int(np.count_nonzero(model.camera_of == c)))
            log_shape.append(ratio[clearest])
            count = len(clearest)
            rivals = len(order)
            area = float(np.prod(camera.image_size_px))
            log_density[c] = np.log(rivals / area)
            log_unused[c] = _log_unused(rivals, area, parameters.clutter_per_px2 * area, len(model))
        first[c + 1] = first[c] + count
    return Points(
        np.concatenate(uv),
        np.concatenate(cov),
        np.concatenate(world),
        np.concatenate(m_per_px),
        first,
        np.concatenate(row).astype(np.int64),
        np.concatenate(log_shape),
        log_density,
        log_unused,
    )


def _log_unused(count: int, area: float, expected: float, most: int) -> Array:
    """Log of the likelihood ratio of a picture's false points if k = 0 ... most of its points are spots instead.

    For a Poisson process of unknown density, with an exponential prior of mean mu = `expected` false points per
    picture: j false points in a picture of `area` px^2 have the density j! / area^j mu^j / (1 + mu)^(j + 1).
    """
    k = np.minimum(np.arange(most + 1), count)
    falling = np.concatenate([[0.0], np.cumsum(np.log(np.maximum(count - np.arange(most), 1.0)))])
    mu = max(expected, 1e-3)
    return np.asarray(k * (np.log(area) + np.log1p(1 / mu)) - falling[k])


class PointsOnScreens(NamedTuple):
    """The points that candidate poses are made from: a point seen by two cameras of one screen is entered once."""

    point: Ints  # (k,) index into Points, ordered by screen, the clearest first
    first: Ints  # (screens + 1,)


def on_screens(points: Points, screen_of_camera: Ints, screens: int, sigma_px: float, most: int) -> PointsOnScreens:
    """The points of every screen, without duplicates.

    screen_of_camera (cameras,): the screen that each camera observes; most: number of points per camera, the clearest;
    sigma_px: the model's error, in addition to a point's own.
    """
    sigma_m = points.m_per_px * np.sqrt(np.trace(points.cov, axis1=1, axis2=2) + 2 * sigma_px**2)
    chosen: list[int] = []
    first = [0]
    for s in range(screens):
        here: list[int] = []
        for c in np.flatnonzero(screen_of_camera == s):
            of_camera = np.arange(points.first[c], points.first[c + 1])[:most]
            of_camera = of_camera[np.isfinite(points.world[of_camera]).all(axis=1)]
            if here:
                before = np.array(here)
                gap = np.linalg.norm(points.world[of_camera][:, None] - points.world[before], axis=-1)
                limit = SAME_POINT * np.hypot(sigma_m[of_camera][:, None], sigma_m[before])
                of_camera = of_camera[~(gap < limit).any(axis=1)]
            here += [int(i) for i in of_camera]
        chosen += here
        first.append(len(chosen))
    return PointsOnScreens(np.array(chosen, dtype=np.int64), np.array(first, dtype=np.int64))


GATE = 25.0  # squared sigmas: a point farther from a predicted spot is not this spot (p = 4e-6)
LOG_2PI = float(np.log(2 * np.pi))


class SpotGeometry(NamedTuple):
    """The n views and their spots, except for the projection."""

    camera: Ints  # (n,)
    spot: Ints  # (n,)
    size: Array  # (n, 2) px: width, height of the picture
    has_image: Bools  # (n,)
    model_cov: Array  # (n, 2, 2) px^2, covariance of the largest model error considered: the sum of ...
    known_cov: Array  # (n, 2, 2) px^2, the calibration's stated covariance ...
    allowance: float  # px^2, ... and the largest allowance for other model errors
    view_at: Ints  # (spots, cameras) the view of a spot in a camera, or -1
    spot_point: Array  # (spots, 3) m, in body
    spot_ray: Array  # (spots, 3) in body
    spot_screen: Ints  # (spots,) -1: observed by no camera that has a picture


class LabelLimits(NamedTuple):
    """The prior region of poses and the limits of a labelling."""

    R: Array  # (3, 3) centre of the prior
    t: Array  # (3,) m
    half_width_m: float
    least_trace: float  # of the rotation from R
    p_detect: float
    min_spots: int


class LabelProblem(NamedTuple):
    """All that the labels of one frame depend on."""

    views: Views  # (n,)
    spots: SpotGeometry
    points: Points
    limits: LabelLimits
    front: Array  # (n, 4) the screen of each view as a plane n . x = d, with the normal towards the camera


class PoseWorkspace(NamedTuple):
    """Quantities at one pose."""

    uv: Array  # (n, 2) px, the projected spots
    J: Array  # (n, 2, 6) their Jacobians
    H: Array  # (6, 6) information of the pose, or its Cholesky factor
    left: Array  # (2, 6) scratch


@compiled
def pose_workspace(views: int) -> PoseWorkspace:
    """The workspace for that number of views."""
    return PoseWorkspace(np.empty((views, 2)), np.empty((views, 2, 6)), np.empty((6, 6)), np.empty((2, 6)))


@compiled
def allowed(limits: LabelLimits, R: Array, t: Array) -> bool:
    """Whether a pose lies in the prior region."""
    trace = 0.0
    for a in range(3):
        if not abs(t[a] - limits.t[a]) <= limits.half_width_m:
            return False
        for b in range(3):
            trace += R[a, b] * limits.R[a, b]
    return trace >= limits.least_trace


@compiled
def distinct_spots(labels: Ints, spot: Ints) -> int:
    """The number of spots that have a point in any view."""
    count = 0
    for v in range(labels.shape[0]):
        if labels[v] == NO_POINT:
            continue
        new = 1
        for w in range(v):
            if labels[w] != NO_POINT and spot[w] == spot[v]:
                new = 0
        count += new
    return count


@compiled
def clear(H: Array) -> None:
    """Set a matrix (6, 6) to zero."""
    for i in range(6):
        for j in range(6):
            H[i, j] = 0.0


@compiled
def add_information(H: Array, J: Array, cov: Array, model_cov: Array) -> float:
    """H += J^T S^-1 J with S (2, 2) the sum of two covariances; returns det S."""
    a, b, c = cov[0, 0] + model_cov[0, 0], cov[0, 1] + model_cov[0, 1], cov[1, 1] + model_cov[1, 1]
    det = a * c - b * b
    for i in range(6):
        w0, w1 = (c * J[0, i] - b * J[1, i]) / det, (a * J[1, i] - b * J[0, i]) / det
        for j in range(6):
            H[i, j] += w0 * J[0, j] + w1 * J[1, j]
    return det


@compiled
def cholesky(H: Array) -> float:
    """Replace H (6, 6) by its lower Cholesky factor; returns log det H, or -inf if H is singular."""
    log_det = 0.0
    for i in range(6):
        full = H[i, i]
        for j in range(i + 1):
            s = H[i, j]
            for k in range(j):
                s -= H[i, k] * H[j, k]
            if i == j:
                if not s > 1e-13 * full:
                    return -np.inf
                H[i, i] = np.sqrt(s)
                log_det += np.log(s)
            else:
                H[i, j] = s / H[j, j]
    return log_det


@compiled_in_caller
def solve_cholesky(L: Array, x: Array) -> None:
    """x = (L L^T)^-1 x, in place."""
    for i in range(6):
        s = x[i]
        for k in range(i):
            s -= L[i, k] * x[k]
        x[i] = s / L[i, i]
    for i in range(5, -1, -1):
        s = x[i]
        for k in range(i + 1, 6):
            s -= L[k, i] * x[k]
        x[i] = s / L[i, i]


@compiled
def predicted_spread(L: Array, J: Array, left: Array) -> tuple[float, float, float]:
    """J C J^T as (a, b, c) of [[a, b], [b, c]], px^2, with C the inverse of L L^T; left (2, 6) is scratch."""
    for row in range(2):
        for i in range(6):
            s = J[row, i]
            for k in range(i):
                s -= L[i, k] * left[row, k]
            left[row, i] = s / L[i, i]
    a = b = c = 0.0
    for i in range(6):
        a += left[0, i] * left[0, i]
        b += left[0, i] * left[1, i]
        c += left[1, i] * left[1, i]
    return a, b, c
