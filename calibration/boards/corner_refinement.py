"""Refinement of chessboard corners to a hundredth of a pixel, and the sharpness of the edges between them.

Measured on rendered boards (640x480, 54 corners 22 to 52 px apart, blur sigma 0.5 to 2.5 px), RMS error per coordinate:
cv2.findChessboardCornersSB with CALIB_CB_ACCURACY 0.03 to 0.18 px without noise and 0.04 to 0.13 px with noise of 4 DN;
cv2.cornerSubPix in a window of 0.4 spacings 0.01 to 0.04 px and 0.03 to 0.07 px. Therefore corners from every detector
are refined here; the width of the window matters more than the detector.
"""

from __future__ import annotations

import cv2
import numpy as np

from calibration.boards.board_view import GreyImage
from geometry.arrays import Array, Bools, Ints

_REACH = 0.4  # half of the window, in distances of the nearest parallel edge, which would be included from 0.5 on
_MOST_PX = 20  # half of the window: a larger one includes curved edges and takes longer without being more accurate
_MARGIN = 3  # px around the window in resampled pictures: further measurements move corners by less
_FEWEST_NEAR = 8  # known corners around a corner from which its curvature is estimated
# Measurements in resampled pictures. cv2.cornerSubPix exaggerates a shift of some hundredths of a pixel by a quarter: a
# corner is free of bias only if it starts in the right place. In photographs of a fisheye lens the mean shift towards
# the middle is -.028, +.007, -.002, +.002, .000 px after 0 to 4 of them (RMS .033, .032, .026, .027, .026 px).
_ROUNDS = 3
_STOP = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 60, 1e-4)


def refined(image: GreyImage, grid: Array, known: Bools | None = None, reach: float = _REACH) -> Array:
    """Corners (rows, columns, 2), px, refined to the point where four squares meet; nan if not converged.

    known (rows, columns): which corners exist, None for all. reach: half of the window in distances of parallel edges;
    smaller if something else is printed in the squares.
    """
    rows, columns = grid.shape[:2]
    known = np.ones((rows, columns), dtype=bool) if known is None else known
    height = edge_distance(grid, known)
    half = np.clip(np.nan_to_num(reach * height, nan=2.0).astype(int), 2, _MOST_PX)
    out = _measured(image, grid, half, known, None)
    for _ in range(_ROUNDS):
        found = known & np.isfinite(out).all(axis=-1)
        again = _measured(image, out, half, found, _curvature(out, found))
        out = np.where(np.isfinite(again), again, out)
    out[np.linalg.norm(out - grid, axis=-1) > np.maximum(1.5, 0.75 * half)] = np.nan
    return out


def _measured(image: GreyImage, grid: Array, half: Ints, known: Bools, bent: Array | None) -> Array:
    """Corners (rows, columns, 2) by cv2.cornerSubPix from start positions; nan where unknown or outside the picture.

    bent: local curvature of the grid (see `_curvature`). The picture around each corner is then resampled such that
    edges are straight: in a window of 20 px the curved edges of a fisheye lens would displace corners by .04 px.
    """
    out = np.full(grid.shape, np.nan)
    within = known & np.all((grid >= 0) & (grid <= np.array(image.shape[::-1]) - 1), axis=-1)
    for size in np.unique(half[within]).tolist():
        which = within & (half == size)
        start, window = grid[which], (size, size)
        if bent is None:
            points = np.ascontiguousarray(start, dtype=np.float32).reshape(-1, 1, 2)
            out[which] = cv2.cornerSubPix(image, points, window, (-1, -1), _STOP).reshape(-1, 2)
            continue
        reach = size + _MARGIN
        t = np.stack(np.meshgrid(np.arange(-reach, reach + 1.0), np.arange(-reach, reach + 1.0)), axis=-1)
        C = bent[which]
        at = start[:, None, None] + t + _quadratic(C[:, None, None], t)
        patches = sampled(image, at, cv2.INTER_CUBIC).reshape(-1, 2 * reach + 1)
        middle = np.stack([np.full(len(C), reach), reach + (2 * reach + 1) * np.arange(len(C))], axis=1)
        points = np.ascontiguousarray(middle, dtype=np.float32).reshape(-1, 1, 2)
        ends = cv2.cornerSubPix(patches.astype(np.float32), points, window, (-1, -1), _STOP).reshape(-1, 2)
        moved = ends - middle
        moved[np.linalg.norm(moved, axis=1) > _MARGIN] = np.nan
        out[which] = start + moved + _quadratic(C, moved)
    return out


def _quadratic(C: Array, t: Array) -> Array:
    """(..., 2): the second-order displacement at offsets t (..., 2), px, with coefficients C (..., 3, 2), 1/px."""
    x, y = t[..., 0], t[..., 1]
    return np.einsum("...k,...kj->...j", np.stack([x * x, x * y, y * y], axis=-1), C)


def _curvature(grid: Array, known: Bools) -> Array:
    """(rows, columns, 3, 2), 1/px: coefficients of x², xy, y² of the curvature of the grid around each corner.

    Of the quadratic through the corners of three rows and columns around, seen as a displacement from its own
    linear part, along which edges are straight. 0 where too few corners are known.
    """
    out = np.zeros((*known.shape, 3, 2))
    for i, j in np.argwhere(known):
        rows, columns = (slice(f := min(max(k - 1, 0), n - 3), f + 3) for k, n in zip((i, j), known.shape, strict=True))
        b, a = np.nonzero(known[rows, columns])
        near = grid[rows, columns][b, a]
        a, b = a + columns.start - j, b + rows.start - i
        if len(np.unique(a)) < 3 or len(np.unique(b)) < 3 or len(a) < _FEWEST_NEAR:
            continue
        M = np.stack([np.ones(len(a)), a, b, a * a, a * b, b * b], axis=1)
        X = np.linalg.lstsq(M, near, rcond=None)[0]
        L = np.linalg.inv(X[1:3])  # offset in px times L: offset in squares
        (p, q), (r, s) = L
        squares = np.array([[p * p, p * q, q * q], [2 * p * r, p * s + q * r, 2 * q * s], [r * r, r * s, s * s]])
        out[i, j] = squares @ X[3:]
    return out


def edge_distance(grid: Array, known: Bools) -> Array:
    """Distance (rows, columns), px, of a corner to the nearest edge that does not pass through it; nan where unknown.

    The height of the parallelogram spanned by a corner's two neighbours; the smallest of up to four.
    """
    g = np.where(known[..., None], grid, np.nan)
    out = np.full(g.shape[:2], np.nan)
    for flip_r in (1, -1):
        for flip_c in (1, -1):
            h = g[::flip_r, ::flip_c]
            a, b = h[:-1, 1:] - h[:-1, :-1], h[1:, :-1] - h[:-1, :-1]
            area = np.abs(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
            height = np.full(out.shape, np.nan)
            height[:-1, :-1] = area / np.maximum(
                np.maximum(np.linalg.norm(a, axis=-1), np.linalg.norm(b, axis=-1)), 1e-9
            )
            out = np.fmin(out, height[::flip_r, ::flip_c])
    return out


def spacing(grid: Array) -> float:
    """Median distance, px, of neighbours in a grid (rows, columns, 2) with nan where a point is unknown."""
    along = np.linalg.norm(np.diff(grid, axis=1), axis=-1).ravel()
    down = np.linalg.norm(np.diff(grid, axis=0), axis=-1).ravel()
    both = np.concatenate([along, down])
    return float(np.nanmedian(both)) if np.isfinite(both).any() else np.nan


def edge_blur(image: GreyImage, grid: Array, reach: float = 0.4) -> tuple[float, float]:
    """Sigma, px, of the edges between neighbouring corners (rows, columns, 2), and their contrast, DN; nan if unknown.

    Every edge gives a profile across its middle. Their mean, which suppresses noise, is a step blurred by a Gaussian
    whose steepest slope is contrast / (sigma sqrt(2 pi)). The variance 1/6 px^2 of the interpolation between pixels is
    subtracted.
    """
    pairs = np.concatenate(
        [
            np.stack([grid[:, :-1], grid[:, 1:]], axis=2).reshape(-1, 2, 2),
            np.stack([grid[:-1], grid[1:]], axis=2).reshape(-1, 2, 2),
        ]
    )
    pairs = pairs[np.isfinite(pairs).all(axis=(1, 2))]
    if len(pairs) == 0:
        return np.nan, np.nan
    along = pairs[:, 1] - pairs[:, 0]
    length = np.linalg.norm(along, axis=1, keepdims=True)
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / length
    half = max(2.0, reach * float(np.median(length)))
    t = np.linspace(-half, half, 81)
    where = pairs.mean(axis=1)[:, None] + t[:, None] * normal[:, None]
    values = sampled(image, where)
    step = values[:, -16:].mean(axis=1) - values[:, :16].mean(axis=1)
    contrast = float(np.median(np.abs(step)))
    good = np.abs(step) > 0.5 * contrast
    if contrast < 1 or not good.any():
        return np.nan, contrast
    mean = np.mean(values[good] / step[good, None], axis=0)
    slope = float(np.max(np.gradient(mean, t)))
    return float(np.sqrt(max(1 / (2 * np.pi * slope**2) - 1 / 6, 0.0))), contrast


def sampled(image: GreyImage, where: Array, method: int = cv2.INTER_LINEAR) -> Array:
    """Grey values (...) at (..., 2), by default by bilinear interpolation; outside, those of the border."""
    flat = np.nan_to_num(where, nan=-1.0).reshape(-1, 2).astype(np.float32)
    out = np.empty(len(flat))
    for first in range(0, len(flat), 30_000):  # cv2.remap's maps have at most 32767 rows
        u, v = np.ascontiguousarray(flat[first : first + 30_000].T)[..., None]
        read = cv2.remap(image, u, v, method, borderMode=cv2.BORDER_REPLICATE)
        out[first : first + 30_000] = read.ravel()
    return out.reshape(where.shape[:-1])
