"""Start values for an unknown camera: trial focal lengths, and the board poses that follow from them.

Of several starts, the best after a short fit to some of the views is taken. OpenCV's solvers end in bad minima when no
start is given (4.13: 22 of 300 strongly distorted sets), and in none of these sets with a given focal length.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from calibration.least_squares.adjustment import AdjustmentError, Cauchy, Values
from calibration.lens.fit.corner_table import CornerTable
from calibration.lens.fit.lens_adjustment import ROUGH, FitSettings, adjust, term_of
from calibration.lens.fit.lens_fit import FEWEST_CORNERS
from calibration.lens.fit.lens_models import LensModel, folds_in_picture, undistorted
from calibration.lens.fit.lens_parameters import AS_STATED, lens_of, values_of
from calibration.terms.corners import INTRINSICS_COUNT
from geometry.arrays import Array, Bools, Ints, evenly_spaced
from geometry.camera import FISHEYE
from geometry.pose import Pose

TRIAL_VIEWS = 25  # enough to distinguish good starts from bad ones
_PERSPECTIVE_GUESSES = (0.5, 0.9, 1.8)  # focal lengths over the longer side: 90, 58 and 31 deg across
_FISHEYE_GUESSES = (1 / np.pi, 0.5, 0.9)  # 180, 115 and 64 deg across
_FEW_PARAMETERS = np.isin(np.arange(INTRINSICS_COUNT), (0, 1, 4))  # solved first: from a bad start all may diverge
_SAME_FOCAL = 0.01  # relative: short solves from two guesses end within .2 % of each other, or are tens of % apart
_RIVAL = 1.3  # error of a short solve over the least one's up to which it may lead to the better start
_WIDEST = np.deg2rad(75.0)  # off the axis: beyond it normalised image points, from which poses are found, diverge


class StartError(ValueError):
    """No start explains the corners; the message gives the cause."""


def start(table: CornerTable, fisheye: bool) -> tuple[LensModel, Values]:
    """The best start of a kind of lens, with a pose for every view (nan where none explains its corners).

    Raises StartError: no start can be found, or the board is mirrored.
    """
    model = LensModel(4, FISHEYE) if fisheye else LensModel(5)
    trial = table.only_views(_spread_out(table))
    best: tuple[float, Array] | None = None
    solved: dict[float, float] = {}  # focal length, px: error, px, of short solves from which full ones succeeded
    seen, mirrored = 0, 0
    for focal in _guesses(trial, fisheye):
        lens = _first_lens(focal, table.image_size_px)
        poses, back_to_front = board_poses(trial, lens, fisheye)
        seen, mirrored = seen + trial.views, mirrored + back_to_front
        found = np.asarray(np.isfinite(poses.translation).all(axis=1))
        trusted = found[trial.view]
        if not trusted.any():
            continue
        try:
            values = _solved(trial, trusted, model, values_of(lens, poses, len(table.board_points)), _FEW_PARAMETERS)
            short, error = float(lens_of(values)[0]), _missed(trial, trusted, fisheye, values)
            if any(abs(short / other - 1) < _SAME_FOCAL for other in solved):
                break
            if solved and error > _RIVAL * min(solved.values()):
                continue
            values = _solved(trial, trusted, model, values, model.free)
        except AdjustmentError:
            continue
        solved[short], error = error, _missed(trial, trusted, fisheye, values)
        lens = lens_of(values)
        if folds_in_picture(lens, fisheye, table.image_size_px):
            error *= 1.5
        if best is None or error < best[0]:
            best = error, lens
    if mirrored > seen / 2:
        raise StartError("the picture of the board is mirrored: its points are in the opposite sense of rotation")
    if best is None:
        raise StartError("no focal length and no pose of the board explain the corners")
    poses, _ = board_poses(table, best[1], fisheye)
    return model, values_of(best[1], poses, len(table.board_points))


def _spread_out(table: CornerTable) -> Ints:
    """Indices of trial views with enough corners, spread evenly over the sequence."""
    usable = np.flatnonzero(table.counts() >= FEWEST_CORNERS)
    if not len(usable):
        raise StartError(f"no view has {FEWEST_CORNERS} corners or more")
    return evenly_spaced(usable, TRIAL_VIEWS)


def _guesses(table: CornerTable, fisheye: bool) -> Sequence[float]:
    """Focal lengths, px: Zhang's from the homographies if plausible, and fixed multiples of the picture's width."""
    longer = max(table.image_size_px)
    guesses = [g * longer for g in (_FISHEYE_GUESSES if fisheye else _PERSPECTIVE_GUESSES)]
    if fisheye:
        return guesses
    points = [table.points[table.view == v].astype(np.float32) for v in range(table.views)]
    pixels = [table.pixels[table.view == v].astype(np.float32) for v in range(table.views)]
    try:
        zhang = float(cv2.initCameraMatrix2D(points, pixels, table.image_size_px, 1.0)[0, 0])
    except cv2.error:
        return guesses
    return [zhang, *guesses] if 0.15 * longer < zhang < 30 * longer else guesses


def _first_lens(focal: float, image_size_px: tuple[int, int]) -> Array:
    lens = np.zeros(INTRINSICS_COUNT)
    width, height = image_size_px
    lens[:4] = focal, focal, (width - 1) / 2, (height - 1) / 2
    return lens


def _solved(table: CornerTable, used: Bools, model: LensModel, values: Values, lens_free: Bools) -> Values:
    """The values after a robust fit of some lens parameters (18,)."""
    sigma = max(_missed(table, used, model.fisheye, values, np.nan), 0.05)
    return adjust(table, used, model, values, AS_STATED, FitSettings(sigma, Cauchy(), ROUGH), lens_free).values


def _missed(table: CornerTable, used: Bools, fisheye: bool, values: Values, of_others: float = np.inf) -> float:
    """Median distance, px, of predicted corners, infinite of those not used: up to half of them may be wrong."""
    away = np.full(len(table), of_others)
    left = np.linalg.norm(term_of(table, used, fisheye).project(values) - table.pixels[used], axis=1)
    away[used] = np.where(np.isfinite(left), left, np.inf)  # behind the camera
    return float(np.nanmedian(away))


def board_poses(table: CornerTable, lens: Array, fisheye: bool) -> tuple[Pose, int]:
    """camera_from_board of every view (V), nan where there is none; and the number of boards seen from behind."""
    rotation, translation = np.full((table.views, 3, 3), np.nan), np.full((table.views, 3), np.nan)
    flat, in_reach = _flattened(table, lens, fisheye)
    points = table.points
    behind = 0
    for v in range(table.views):
        mine = (table.view == v) & in_reach
        if mine.sum() < FEWEST_CORNERS:
            continue
        pose = _planar_pose(points[mine], flat[mine])
        if pose is None:
            continue
        facing = pose.rotation[:, 2] @ pose.apply(table.middle)
        behind += int(facing < 0)
        if facing > 0:
            rotation[v], translation[v] = pose.rotation, pose.translation
    return Pose(rotation, translation), behind


def _planar_pose(points: Array, flat: Array) -> Pose | None:
    """camera_from_board from points (n, 3) of a plane and normalised image points (n, 2); None where there is none."""
    # IPPE is most accurate for a plane through the origin; centring the corners achieves it for parts of boards.
    origin = points.mean(axis=0)
    try:
        good, rotvec, t = cv2.solvePnP(points - origin, flat, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    except cv2.error:
        return None
    if not good:  # then the rotation is an empty array
        return None
    R = np.asarray(cv2.Rodrigues(rotvec)[0], dtype=float)
    t = np.asarray(t, dtype=float).ravel() - R @ origin
    depth = points @ R[2] + t[2]
    return Pose(R, t) if np.isfinite(t).all() and np.all(depth > 0) else None


def _flattened(table: CornerTable, lens: Array, fisheye: bool) -> tuple[Array, Bools]:
    """Normalised image points (N, 2) without distortion, and which of them are usable."""
    fx, fy, cx, cy = lens[:4]
    distorted = (table.pixels - [cx, cy]) / [fx, fy]
    if not lens[4:].any() and not fisheye:
        return distorted, np.ones(len(distorted), dtype=bool)
    flat = undistorted(table.pixels, lens, fisheye)
    with np.errstate(invalid="ignore"):
        good = np.hypot(*flat.T) < np.tan(_WIDEST)
    return np.where(good[:, None], flat, 0.0), good
