"""The shape of a board's grid around each corner of a picture: steps along rows and columns, and curvature.

Lines of a board are straight in the plane x = H(column, row). The lens takes x to v = x atan(q) / q, q = sqrt(m) |x|,
about the middle of the picture: m = 0 is a pinhole's picture, m = 1/f^2 that of an equidistant fisheye with the focal
length f, m < 0 a pincushion's. H and m are those of the whole board. What is left between v and the picture is small
and smooth: a quartic of five rows and columns around a corner. A quartic from x instead cannot follow a wide lens,
whose series converges to 45 deg off the axis: outer corners near a fisheye lens were displaced by up to .07 px.

Source: Devernay & Faugeras (2001), "Straight lines have to be straight", Machine Vision and Applications 13, for the
lens; the quartic is ours.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from scipy.special import comb

from geometry.arrays import Array, Bools, Ints

_SPARE = 2  # known corners around a corner beyond the coefficients of its polynomial
_BENDS = 20  # known corners from which on m is solved for: few do not determine it
_STARTS = (0.0, 2.0, 4.0)  # of m, lengths in halves of the picture's diagonal: from pinholes to fisheyes of 180 deg
_WIDEST = 1.4  # rad off the axis of a start's corners: beyond, a plane is no picture of them
_STEPS = 10  # of the fit of H and m: what it leaves is in the quartic
_ENOUGH = 1e-2  # relative decrease of the square error in the last step
_SMALL = 1e-2  # below it the series of five terms has an error of 1e-11


def local_shape(grid: Array, known: Bools, image_size_px: tuple[int, int]) -> Array:
    """(rows, columns, 5, 2): the steps along columns and rows, px, and the curvature of the grid at each known corner.

    grid (rows, columns, 2), px. The curvature, 1/px, is the coefficients of x^2, xy, y^2 of the displacement from the
    linear part, along which lines of the board are straight. 0 where the corners are on a line or fewer than four.
    """
    out = np.zeros((*known.shape, 5, 2))
    row, column = np.nonzero(known)
    middle, unit = (np.array(image_size_px) - 1) / 2, float(np.hypot(*image_size_px)) / 2
    cells = np.stack([column, row], axis=1)
    picture = _Picture.of((grid[known] - middle) / unit, cells.astype(float))
    if picture is None:
        if len(row):
            flat = np.column_stack([np.ones(len(row)), cells])
            out[..., :2, :] = np.linalg.lstsq(flat, grid[known], rcond=None)[0][1:]
        return out
    seen = np.full(grid.shape, np.nan)
    seen[known] = picture.at(cells.astype(float)) * unit
    by, twice = np.tile(np.eye(2), (*known.shape, 1, 1)), np.zeros((*known.shape, 2, 2, 2))
    done = ~known
    for order, across in ((4, 5), (2, 3)):
        left = np.argwhere(~done)
        first = np.maximum(np.minimum(left - across // 2, np.array(known.shape) - across), 0)
        for corner in np.unique(first, axis=0):
            block = np.s_[corner[0] : corner[0] + across, corner[1] : corner[1] + across]
            at = left[np.all(first == corner, axis=1)]
            left_over = _left_over(seen[block], grid[block], known[block], at - corner, order)
            if left_over is not None:
                by[*at.T], twice[*at.T] = left_over
                done[*at.T] = True
    out[known] = _combined(*picture.derivatives(cells.astype(float), unit), by[known], twice[known])
    return out


def straightened(seen: Array, image_size_px: tuple[int, int]) -> Iterator[Array]:
    """Pixels (n, 2) as a pinhole would see them, if a lens from a pinhole to a fisheye of 180 deg took the picture."""
    middle, unit = (np.array(image_size_px) - 1) / 2, float(np.hypot(*image_size_px)) / 2
    for m in _STARTS:
        plane = _straightened((seen - middle) / unit, m)
        if plane is not None:
            yield middle + unit * plane


def _straightened(seen: Array, m: float) -> Array | None:
    """x (n, 2) of v (n, 2) for a lens without pincushion; None where one of them is too far off the axis."""
    angle = np.sqrt(m) * np.linalg.norm(seen, axis=1, keepdims=True)
    if np.max(angle, initial=0.0) >= _WIDEST:
        return None
    return seen * np.where(angle > 0, np.tan(angle) / np.where(angle > 0, angle, 1.0), 1.0)


def misfit(seen: Array, xy: Array, image_size_px: tuple[int, int]) -> tuple[float, bool]:
    """RMS distance, px, of pixels (n, 2) from the picture of a plane's points (n, 2), and whether it is mirrored.

    inf where they are no picture of a plane.
    """
    middle, unit = (np.array(image_size_px) - 1) / 2, float(np.hypot(*image_size_px)) / 2
    picture = _Picture.of((seen - middle) / unit, xy)
    if picture is None:
        return np.inf, False
    off = unit * np.linalg.norm(picture.at(xy) - (seen - middle) / unit, axis=1)
    return float(np.nan_to_num(np.sqrt(np.mean(off**2)), nan=np.inf)), bool(np.linalg.det(picture.H) < 0)


def predicted(seen: Array, xy: Array, image_size_px: tuple[int, int]) -> tuple[Array, Array]:
    """Points (n, 2), px, of the picture of a plane that pixels (n, 2) fit best, and its derivatives (n, 2, 2).

    Raises ValueError: they are no picture of a plane.
    """
    middle, unit = (np.array(image_size_px) - 1) / 2, float(np.hypot(*image_size_px)) / 2
    picture = _Picture.of((seen - middle) / unit, xy)
    if picture is None:
        raise ValueError("these pixels are no picture of a plane")
    by_plane, _, by_point = picture.derivatives(xy, unit)
    return middle + unit * picture.at(xy), by_plane @ by_point


@dataclass(frozen=True, slots=True)
class _Picture:
    """The picture of a board: H and the lens; lengths in halves of the picture's diagonal, about its middle."""

    H: Array  # (3, 3), from column, row
    m: float

    @classmethod
    def of(cls, seen: Array, cells: Array) -> _Picture | None:
        """The best one of corners (n, 2) of cells (n, 2); None if four corners do not span a plane."""
        if len(cells) < 4 or min(len(np.unique(cells[:, k])) for k in (0, 1)) < 2:
            return None
        best, least = None, np.inf
        for m in _STARTS if len(cells) >= _BENDS else _STARTS[:1]:
            plane = _straightened(seen, m)
            if plane is not None:
                H = cv2.findHomography(cells, plane, 0)[0]
                if H is not None and H[2, 2] != 0:
                    start = cls(H / H[2, 2], m)
                    error = float(np.sum((start.at(cells) - seen) ** 2))
                    best, least = (start, error) if error < least else (best, least)
        return best if best is None or len(cells) < _BENDS else best._fitted(seen, cells)

    def _fitted(self, seen: Array, cells: Array) -> _Picture:
        """By least squares, damped."""
        best, damping = self, 1e-3
        off = best.at(cells) - seen
        for _ in range(_STEPS):
            J = best._by_parameters(cells).reshape(-1, 9)
            N = J.T @ J
            step = np.linalg.solve(N + damping * np.diag(np.diag(N)), J.T @ off.ravel())
            H = best.H.ravel().copy()
            H[:8] -= step[:8]
            tried = _Picture(H.reshape(3, 3), best.m - step[8])
            left = tried.at(cells) - seen
            before, after = np.sum(off**2), np.sum(left**2)
            if not after < before:  # nan: beyond the horizon
                damping *= 100
                continue
            best, off, damping = tried, left, damping / 10
            if before - after < _ENOUGH * before:
                break
        return best

    def _plane(self, cells: Array) -> tuple[Array, Array]:
        """x (n, 2) and its denominator (n,); nan beyond the horizon."""
        w = cells @ self.H[:, :2].T + self.H[:, 2]
        return w[:, :2] / np.where(w[:, 2:] > 0, w[:, 2:], np.nan), w[:, 2]

    def at(self, cells: Array) -> Array:
        """v (n, 2) of cells (n, 2)."""
        x, _ = self._plane(cells)
        return x * _ratio(self.m * np.sum(x * x, axis=1))[0][:, None]

    def _by_parameters(self, cells: Array) -> Array:
        """(n, 2, 9): derivatives of v by the first eight numbers of H, and m."""
        x, w = self._plane(cells)
        s = np.sum(x * x, axis=1)
        F, by, _ = _ratio(self.m * s)
        one = np.column_stack([cells, np.ones(len(cells))]) / w[:, None]
        J = np.zeros((len(cells), 2, 8))
        J[:, 0, :3] = J[:, 1, 3:6] = one
        J[:, :, 6:] = -x[:, :, None] * one[:, None, :2]
        G = F[:, None, None] * np.eye(2) + 2 * self.m * by[:, None, None] * x[:, :, None] * x[:, None]
        return np.concatenate([G @ J, (x * (by * s)[:, None])[:, :, None]], axis=2)

    def derivatives(self, cells: Array, unit: float) -> tuple[Array, Array, Array]:
        """Of v by x (n, 2, 2), the second ones (n, 2, 2, 2), and of x by column and row (n, 2, 2); lengths in px."""
        x, w = self._plane(cells)
        F, by, twice = _ratio(self.m * np.sum(x * x, axis=1))
        by, twice = 2 * self.m * by, 4 * self.m**2 * twice
        square, one = x[:, :, None] * x[:, None], np.eye(2)
        G = F[:, None, None] * one + by[:, None, None] * square
        mixed = one[:, :, None] * x[:, None, None]  # (n, i, j, k), one of i and j
        mixed = mixed + np.swapaxes(mixed, 2, 3) + np.swapaxes(mixed, 1, 3)
        G2 = by[:, None, None, None] * mixed + twice[:, None, None, None] * square[..., None] * x[:, None, None]
        return G, G2 / unit, unit * (self.H[:2, :2] - x[:, :, None] * self.H[2, :2]) / w[:, None, None]


def _ratio(z: Array) -> tuple[Array, Array, Array]:
    """atan(q) / q for z = q^2, and its first and second derivatives by z; nan for z <= -1."""
    small = np.abs(z) < _SMALL
    safe = np.where(small, 0.5, np.where(z > -1, z, np.nan))
    q = np.sqrt(np.abs(safe))
    F = np.where(safe > 0, np.arctan(q), np.arctanh(np.minimum(q, 1 - 1e-9))) / q
    by = (1 / (1 + safe) - F) / (2 * safe)
    twice = (-1 / (1 + safe) ** 2 - 3 * by) / (2 * safe)
    F = np.where(small, 1 - z * (1 / 3 - z * (1 / 5 - z * (1 / 7 - z / 9))), F)
    by = np.where(small, -1 / 3 + z * (2 / 5 - z * (3 / 7 - z * (4 / 9 - z * 5 / 11))), by)
    twice = np.where(small, 2 / 5 - z * (6 / 7 - z * (12 / 9 - z * (20 / 11 - z * 30 / 13))), twice)
    return F, by, twice


@cache
def _powers(order: int) -> tuple[Ints, Ints, Array]:
    """Powers of x and y (2, k) of a polynomial, those of its derivatives by 1, x, y, x^2, xy, y^2, and their factors.

    Factors (6, k) over the factorials of the derivative's powers: those of Taylor's coefficients.
    """
    powers = np.array([(n - k, k) for n in range(order + 1) for k in range(n + 1)])
    by = powers[:6, None]
    return powers.T, np.moveaxis(np.maximum(powers - by, 0), -1, 0), np.prod(comb(powers, by), axis=-1)


def _left_over(seen: Array, grid: Array, known: Bools, at: Ints, order: int) -> tuple[Array, Array] | None:
    """Derivatives of pixels by v: (m, 2, 2), and the second ones (m, 2, 2, 2), at corners (m, 2), row and column.

    By a polynomial of the known corners of a block; None if too few.
    """
    b, a = np.nonzero(known)
    powers, lower, factor = _powers(order)
    if min(len(set(a)), len(set(b))) <= order or len(a) < powers.shape[1] + _SPARE:
        return None
    v = seen[known]
    middle, size = v.mean(axis=0), np.ptp(v, axis=0).max() / 2
    X = np.linalg.lstsq(_products((v - middle) / size, powers, order), grid[known], rcond=None)[0]
    # (m, 6, 2): Taylor's coefficients of 1, x, y, x^2, xy, y^2 at each corner
    taylor = (_products((seen[*at.T] - middle) / size, lower, order) * factor) @ X
    second = taylor[:, [[3, 4], [4, 5]]] * np.array([[2.0, 1.0], [1.0, 2.0]])[..., None]
    return np.swapaxes(taylor[:, 1:3], 1, 2) / size, np.moveaxis(second, -1, 1) / size**2


def _products(w: Array, powers: Ints, order: int) -> Array:
    """x^i y^j of points (n, 2) for powers i, j (2, ...): (n, ...)."""
    table = w[:, :, None] ** np.arange(order + 1)
    return np.asarray(table[:, 0][:, powers[0]] * table[:, 1][:, powers[1]])


def _combined(G: Array, G2: Array, steps: Array, A: Array, A2: Array) -> Array:
    """`local_shape` (m, 5, 2): derivatives G, G2 of v by x, A, A2 of pixels by v, and of x by column and row."""
    L: Array = A @ G
    to_v, to_x = np.asarray(np.linalg.inv(A)), np.asarray(np.linalg.inv(L))
    by_x = A @ _substituted(G2, to_x).reshape(len(A), 2, 4)
    bend = by_x.reshape(-1, 2, 2, 2) + _substituted(A2, to_v)
    curvature = np.stack([bend[..., 0, 0] / 2, bend[..., 0, 1], bend[..., 1, 1] / 2], axis=1)
    return np.concatenate([np.swapaxes(L @ steps, 1, 2), curvature], axis=1)


def _substituted(second: Array, by: Array) -> Array:
    """Second derivatives (m, 2, 2, 2) by other coordinates, with the derivatives (m, 2, 2) of the old ones by them."""
    return np.asarray(np.swapaxes(by, 1, 2)[:, None] @ second @ by[:, None])
