"""Random lenses from a pinhole to 120 deg, with simulated corners and the error of their calibration.

The projection is independent of the code under test: OpenCV's models through OpenCV, and radial lenses r = tan(a t) / a
(a = 1 is a pinhole, 1/2 stereographic, 0 equidistant; sin for negative a), which none of the models describes exactly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import least_squares

from calibration.lens.fit.corner_table import CornerTable
from calibration.lens.fit.lens_models import undistorted
from calibration.lens.intrinsics import Intrinsics
from geometry.arrays import Array
from geometry.rotations import exp

SIZE = (1280, 1024)
KEPT = 1.3  # error over claim that most sets keep
KINDS = ("pinhole", "plain", "rational", "fisheye", "radial")


@dataclass(frozen=True)
class TrueLens:
    """A lens with its projection of points (n, 3) in the camera frame to pixels (n, 2)."""

    kind: str
    fov_deg: float  # from corner to corner
    project: Callable[[Array], Array]
    focal_px: float


def radial(a: float) -> Callable[[Array], Array]:
    """Radial distance as a function of the angle off the axis, for the focal length 1."""

    def r(t: Array) -> Array:
        if abs(a) < 1e-6:
            return t
        return np.tan(a * t) / a if a > 0 else np.sin(-a * t) / -a

    return r


def random_lens(seed: int, kind: str | None = None) -> TrueLens:
    """A lens of random kind, field of view and principal point; the wide kinds start at 80 deg."""
    rng = np.random.default_rng([seed, 77])
    kind = kind or KINDS[seed % len(KINDS)]
    low, high = {"pinhole": (25, 75), "plain": (40, 85)}.get(kind, (80, 120))
    fov = rng.uniform(low, high)
    half = np.deg2rad(fov / 2)
    corner = np.hypot(*SIZE) / 2
    cx, cy = (np.array(SIZE) - 1) / 2 + rng.normal(0, 8, 2)
    aspect = 1 + rng.normal(0, 3e-4)
    a = 1.0 if kind == "pinhole" else rng.uniform(0.75, 1.0) if kind == "plain" else rng.uniform(-0.4, 0.8)
    f = corner / float(radial(a)(np.array(half)))
    p = rng.normal(0, 3e-4, 2) if kind != "pinhole" else np.zeros(2)
    K = np.array([[f * aspect, 0, cx], [0, f, cy], [0, 0, 1.0]])
    if kind == "fisheye":
        t = np.linspace(0, half * 1.05, 100)[1:]
        A = np.stack([t**3, t**5, t**7, t**9], axis=1)
        d = np.linalg.lstsq(A, radial(a)(t) - t, rcond=1e-8)[0]
        return TrueLens(kind, fov, lambda x: cv2.fisheye.projectPoints(_in_front(x), *_NO_MOVE, K, d)[0][:, 0], f)
    if kind == "radial":
        return TrueLens(kind, fov, lambda x: _radial_pixels(x, radial(a), K, p), f)
    d = _opencv_numbers(kind, a, half, rng)
    d[2:4] = p
    return TrueLens(kind, fov, lambda x: cv2.projectPoints(_in_front(x), *_NO_MOVE, K, d)[0][:, 0], f)


_NO_MOVE = (np.zeros(3), np.zeros(3))


def _in_front(points: Array) -> Array:
    return np.ascontiguousarray(points, dtype=float).reshape(-1, 1, 3)


def _radial_pixels(points: Array, r: Callable[[Array], Array], K: Array, p: Array) -> Array:
    away = np.linalg.norm(points[:, :2], axis=1)
    bent = points[:, :2] * (r(np.arctan2(away, points[:, 2])) / np.maximum(away, 1e-12))[:, None]
    x, y = bent.T
    r2 = x * x + y * y
    bent = bent + np.stack([2 * p[0] * x * y + p[1] * (r2 + 2 * x * x), p[0] * (r2 + 2 * y * y) + 2 * p[1] * x * y], 1)
    return bent @ K[:2, :2].T + K[:2, 2]


def _opencv_numbers(kind: str, a: float, half: float, rng: np.random.Generator) -> Array:
    """k1 ... k6, or k1, k2, k3 alone, that approximate the radial lens up to the corner of the picture."""
    d = np.zeros(8)
    if kind == "pinhole":
        return d
    t = np.linspace(0, half * 1.05, 200)[1:]
    x = np.tan(t)
    r2, s = x * x, radial(a)(t) / x
    powers = np.stack([r2, r2**2, r2**3], axis=1)
    if kind == "plain":
        d[[0, 1, 4]] = np.linalg.lstsq(powers, s - 1, rcond=1e-8)[0] * rng.uniform(0.8, 1.2)
        return d
    # The denominator is random and the numerator is fitted, so that k1 to k6 are all significant.
    d[5:8] = np.array([1.0, 0.3, 0.02]) * rng.uniform(0.3, 1.5, 3)
    d[[0, 1, 4]] = np.linalg.lstsq(powers, s * (1 + powers @ d[5:8]) - 1, rcond=1e-10)[0]
    return d


def corners_of(true: TrueLens, seed: int, views: int = 20, sigma_px: float = 0.1) -> CornerTable:
    """Corners of a 12 x 8 chessboard all over the picture, tilted to all sides."""
    rng = np.random.default_rng([seed, 78])
    x, y = np.meshgrid(np.arange(12) * 0.03, np.arange(8) * 0.03)
    board = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    middle = (board.min(axis=0) + board.max(axis=0)) / 2
    reach = np.tan(np.deg2rad(true.fov_deg / 2))
    seen: list[tuple[Array, Array]] = []
    while len(seen) < views:
        R = exp(rng.uniform(-1, 1, 3) * [0.6, 0.6, 0.5])
        z = 0.36 / (2 * min(reach, 1.2)) * rng.uniform(1.1, 2.2)
        at = np.append(rng.uniform(-0.75, 0.75, 2) * [0.8 * reach, 0.6 * reach], 1.0) * z
        points = board @ R.T + at - R @ middle
        if np.any(points[:, 2] < 0.25 * z):
            continue
        pixels = true.project(points)
        inside = np.all((pixels > 2) & (pixels < np.array(SIZE) - 3), axis=1)
        off_axis = np.arctan2(np.linalg.norm(points[:, :2], axis=1), points[:, 2])
        inside &= off_axis < np.deg2rad(true.fov_deg / 2 + 3)
        if inside.mean() > 0.5:
            noise = rng.normal(0, sigma_px, (int(inside.sum()), 2))
            seen.append((np.flatnonzero(inside), pixels[inside] + noise))
    return CornerTable.of(seen, board, middle, SIZE)


def within_boards(c: Intrinsics, pixels: Array) -> Array:
    """Which pixels (n, 2) lie inside the corners of some view."""
    inside = np.zeros(len(pixels), dtype=bool)
    for v in np.flatnonzero(c.table.counts(c.fit.used) > 2):
        hull = cv2.convexHull(c.table.pixels[c.fit.used & (c.table.view == v)].astype(np.float32))
        inside |= np.array([cv2.pointPolygonTest(hull, (float(x), float(y)), False) >= 0 for x, y in pixels])
    return inside


@dataclass(frozen=True)
class LensError:
    """Actual and stated error (RMS, px) of a calibrated lens where corners were seen."""

    error_px: float
    stated_px: float
    chance: float  # of a ratio at least as large, if the stated covariance is right
    kept: float  # the probability of a ratio of at most 1.3 then


def lens_error(true: TrueLens, c: Intrinsics) -> LensError:
    """Error of the true projection of the calibrated rays of grid pixels, after the best-fitting rotation.

    Pixels that the calibrated lens does not map (it states no error for them) do not count.
    """
    grid = c.map.pixels.reshape(-1, 2)
    near = within_boards(c, grid) & np.isfinite(c.map.covariance_px2(c.covariance)).all(axis=(-2, -1)).ravel()
    flat = undistorted(grid[near], c.fit.lens, c.model.fisheye)
    rays = np.column_stack([flat, np.ones(len(flat))])

    def off(turn: Array) -> Array:
        return (true.project(rays @ exp(turn).T) - grid[near]).ravel()

    left = least_squares(off, np.zeros(3), x_scale=1e-3).fun
    error = np.sqrt(np.sum(left**2) / near.sum())
    by_parameter = c.map.by_parameter.reshape(len(grid), 2, -1)[near].reshape(2 * near.sum(), -1)
    M = by_parameter.T @ by_parameter / near.sum() @ c.covariance
    stated = np.sqrt(np.trace(M))
    # The square of the ratio is a weighted sum of chi-squares of one degree of freedom each.
    weights = np.maximum(np.linalg.eigvals(M).real, 0) / np.trace(M)
    ratios = np.sqrt(np.random.default_rng(0).chisquare(1, (20_000, len(weights))) @ weights)
    chance = np.mean(ratios >= error / stated)
    return LensError(float(error), float(stated), float(chance), float(np.mean(ratios <= KEPT)))
