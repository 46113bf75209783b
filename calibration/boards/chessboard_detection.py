"""Detection of plain chessboards."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from calibration.boards import corner_refinement
from calibration.boards.board_types import Chessboard
from calibration.boards.board_view import (
    QUICK_SEARCH_FAILED,
    BoardView,
    GreyImage,
    NotFound,
    at_full_size,
    if_sharp,
    low_contrast,
    scaled,
    scales,
)
from calibration.boards.corner_refinement import Corners
from geometry.arrays import Array

_ALTERNATING = 0.9  # share of neighbouring squares that alternate in colour; real boards reach 1
_QUICK_PX = 1000  # longer side of the picture that is searched first
# Smoothing of larger pictures and their first copy for the classical detector, px: without it a noisy picture without a
# whole board takes 4 s of 1280x960 and 1 s of half of it, with it .5 and .06 s. Real boards are found equally; corners
# are measured in the original.
_SMOOTH_PX = 0.8
_CLASSIC = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
_SECTORS = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE


def find_chessboard(image: GreyImage, board: Chessboard, thorough: bool = True) -> BoardView | NotFound:
    """All inner corners of a chessboard, or the reason why they were not found. A part of it is not sufficient.

    thorough: if False, only the classical detector is used, and the reason for a failure is not determined.
    """
    pale = low_contrast(image)
    if pale is not None:
        return pale
    parts: list[Array] = []
    size = (board.columns, board.rows)
    for grid in _grids(image, *size, parts) if thorough else _quick_grids(image, *size):
        found = _measured(image, grid, board)
        if found is not None:
            return found
    if not thorough:
        return QUICK_SEARCH_FAILED
    largest = max(parts, key=lambda part: part.size, default=None)
    if largest is not None and sorted(largest.shape[:2]) == sorted((board.columns, board.rows)):
        return NotFound(  # `_grown` has tried to measure them
            "too blurred or noisy: the board was found, but its corners cannot be measured; focus, hold it still"
        )
    return _other_size(largest, board)


def _measured(image: GreyImage, grid: Array | Corners, board: Chessboard) -> BoardView | NotFound | None:
    """The view from approximate corners (rows, columns, 2) or measured ones; None if they are not of a chessboard."""
    fine = grid if isinstance(grid, Corners) else corner_refinement.refined(image, grid)
    if not np.isfinite(fine.pixels).all() or not _is_sheet(fine.pixels):
        return None
    ordered = oriented(image, np.dstack([fine.pixels, fine.sigmas_px]))
    if ordered is None:
        return None
    return _checked(image, replace(fine, pixels=ordered[..., :2], sigmas_px=ordered[..., 2]), board)


def _grids(image: GreyImage, columns: int, rows: int, parts: list[Array]) -> Iterator[Array | Corners]:
    """Candidates (rows, columns, 2), px, from the fastest methods first; parts: gets the chessboards of any size.

    Where the classical detector finds nothing, it takes more than 1 s of a noisy picture of 1280x960, and .06 s of
    half of it: a copy of up to 1000 px shows whether it finds a board at all. Its corners are those of the whole
    picture, since outer ones of the copy may be off by a fourth of a square. Smaller copies serve for pictures out of
    focus. cv2.findChessboardCornersSB in the whole picture finds none of 47 real and 24 rendered boards that the others
    miss, and in copies 4 of 393 blurred and noisy ones: its exhaustive search, .2 to .6 s without a board, finds as
    many as the usual one, .1 to .2 s. Without a board a quick check ends the search of the whole picture.
    """
    size, sizes = (columns, rows), scales(image)
    first = next((s for s in sizes if s * max(image.shape) <= _QUICK_PX), sizes[-1])

    def classic(scale: float, more_flags: int = 0) -> Iterator[Array]:
        copy = scaled(image, scale)
        if scale >= first and max(image.shape) > _QUICK_PX:
            copy = np.asarray(cv2.GaussianBlur(copy, (0, 0), _SMOOTH_PX), dtype=np.uint8)
        yield from _as_grid(cv2.findChessboardCorners(copy, size, flags=_CLASSIC | more_flags), columns, rows, scale)

    quick = list(classic(first))
    if quick and first != 1.0:
        yield from classic(1.0)
    yield from quick
    for part in _parts(image):
        parts.append(part)
        yield from _grown(image, part, rows, columns)
    for scale in sizes:
        if scale != first and not (quick and scale == 1.0):
            yield from classic(scale, cv2.CALIB_CB_FAST_CHECK if scale > first else 0)
    for scale in sizes:
        if scale <= first:
            answer = cv2.findChessboardCornersSB(scaled(image, scale), size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
            yield from _as_grid(answer, columns, rows, scale)


def _quick_grids(image: GreyImage, columns: int, rows: int) -> Iterator[Array]:
    """Candidates of the classical detector in copies of up to 1000 px, with an early exit if nothing resembles a board.

    0.01 s for 1280x1024 without a board, where `_grids` takes 5 s; it finds 45 of 48 real boards, `_grids` 47.
    """
    sizes = scales(image)
    for scale in [s for s in sizes if s * max(image.shape) <= _QUICK_PX] or sizes[-1:]:
        answer = cv2.findChessboardCorners(
            scaled(image, scale), (columns, rows), flags=_CLASSIC | cv2.CALIB_CB_FAST_CHECK
        )
        yield from _as_grid(answer, columns, rows, scale)


def _as_grid(answer: Any, columns: int, rows: int, scale: float) -> Iterator[Array]:
    found, corners = answer[:2]
    if found and corners is not None and len(corners.reshape(-1, 2)) == columns * rows:
        yield at_full_size(corners.reshape(rows, columns, 2).astype(float), scale)


def _is_sheet(grid: Array) -> bool:
    """Whether all cells have the same sense of rotation, as on a sheet that is not folded."""
    turn = _cell_turns(grid)
    return bool(np.all(turn > 0) or np.all(turn < 0))


def _cell_turns(grid: Array) -> Array:
    a, b = grid[:-1, 1:] - grid[:-1, :-1], grid[1:, :-1] - grid[:-1, :-1]
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def orders(grid: Array) -> list[Array]:
    """The numberings of a grid (rows, columns, 2), px with v down, that keep its shape and are not mirrored."""
    ways = [grid, grid[::-1], grid[:, ::-1], grid[::-1, ::-1]]
    if grid.shape[0] == grid.shape[1]:
        ways += [np.swapaxes(w, 0, 1) for w in ways]
    return [w for w in ways if np.median(_cell_turns(w)) > 0]


def upright(ways: list[Array]) -> Array:
    """Of equivalent numberings of the board, the one whose rows point most to the right in the picture."""
    return max(ways, key=lambda w: float(np.sum(w[:, -1, 0] - w[:, 0, 0]) / max(np.ptp(w[..., 0]), 1e-9)))


def oriented(image: GreyImage, grid: Array) -> Array | None:
    """The grid numbered from the corner whose outer square is black, consistently over all pictures where possible.

    grid (rows, columns, 2 or more): pixels, and what else belongs to corners. None if the squares do not alternate, as
    on things that resemble a chessboard.
    """
    ways = orders(grid)
    shades = [alternation(image, way[..., :2]) for way in ways]
    if max(abs(shade) for shade in shades) < _ALTERNATING:
        return None
    # Both corners white (a board with an even sum, printed with the colours exchanged): any of them, but upright.
    black_first = [way for way, shade in zip(ways, shades, strict=True) if shade > 0] or ways
    return upright(black_first)


def alternation(image: GreyImage, grid: Array) -> float:
    """1 if all squares alternate in colour and the first one is black, -1 if it is white, near 0 for other patterns.

    The square between the first four corners has the colour of that outside the first corner. Each is sampled at five
    places, because the markers of other boards also have black and white parts.
    """
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[:-1, 1:], grid[1:, 1:]
    middle = (a + b + c + d) / 4
    grey = np.mean(
        [corner_refinement.sampled(image, middle + 0.5 * (q - middle)) for q in (a, b, c, d, middle)], axis=0
    )
    i, j = np.indices(grey.shape)
    lighter = grey * np.where((i + j) % 2 == 0, -1, 1)
    steps = np.concatenate([(lighter[1:] + lighter[:-1]).ravel(), (lighter[:, 1:] + lighter[:, :-1]).ravel()])
    typical = float(np.median(np.abs(steps)))
    if typical < 4:
        return 0.0
    return float(np.mean(steps > 0.3 * typical) - np.mean(steps < -0.3 * typical))


def _checked(image: GreyImage, fine: Corners, board: Chessboard) -> BoardView | NotFound:
    larger = _goes_on(image, fine.pixels)
    if larger:
        return NotFound(
            f"the chessboard continues {' and '.join(larger)} beyond {board.columns}x{board.rows} inner corners; count"
            " the inner corners along both sides again"
        )
    apart = corner_refinement.spacing(fine.pixels)
    pixels, sigmas = fine.pixels.reshape(-1, 2), fine.sigmas_px.ravel()
    return if_sharp(BoardView(board.ids, pixels, apart, fine.blur_px, sigmas_px=sigmas))


def _grown(image: GreyImage, part: Array, rows: int, columns: int) -> Iterator[Corners]:
    """The corners (rows, columns) of a board of which a part was found, if rows and columns follow where it lacks some.

    At the rim of wide lenses squares are narrow and bent: every method then finds a part in most pictures, with wrong
    corners in its outer lines, which are left out first.
    """
    fine = corner_refinement.refined(image, part).pixels
    while np.isnan(fine).any() and min(fine.shape[:2]) > 3:
        worst = max(_SIDES, key=lambda side: np.isnan(_from_side(fine, side)[0]).sum())
        fine = _from_side(_from_side(fine, worst)[1:], worst)
    for shape in ((rows, columns), (columns, rows)):
        grid = fine
        while grid.shape[:2] != shape and np.all(np.less_equal(grid.shape[:2], shape)) and np.isfinite(grid).all():
            lacks = np.less(grid.shape[:2], shape)
            sides = [side for side in _goes_on(image, grid) if lacks[int(side in _ASIDE)]]
            if not sides:
                break
            g = _from_side(grid, sides[0])
            new = _from_side(np.arange(len(g) + 1)[:, None] + np.zeros(g.shape[1]), sides[0]) == 0
            g = _from_side(np.concatenate([_next_line(g), g]), sides[0])
            grid = corner_refinement.refined(image, g, again=new).pixels
        if grid.shape[:2] == shape:
            yield corner_refinement.refined(image, grid if shape == (rows, columns) else np.swapaxes(grid, 0, 1))


_ASIDE = ("to the left", "to the right")
_SIDES = ("above", "below", *_ASIDE)


def _from_side(grid: Array, side: str) -> Array:
    """The grid (rows, columns, ...) with the outermost line of a side first; the same again gives the grid back."""
    if side in ("below", "to the right"):
        grid = grid[::-1, ::-1]
    return np.swapaxes(grid, 0, 1) if side in _ASIDE else grid


def _next_line(grid: Array) -> Array:
    """(1, columns, 2): the line before the first one, if each column goes on as a quadratic."""
    return 3 * grid[:1] - 3 * grid[1:2] + grid[2:3]


def _goes_on(image: GreyImage, grid: Array) -> list[str]:
    """Sides on which more corners follow: "to the right", ...; empty where the board ends.

    At the next corner four squares must meet: the two on one diagonal are darker than the others by the board's
    contrast. At the end of a board two of the four are its margin, which halves the difference; outermost squares that
    are cut narrower give no difference.
    """
    names = []
    for side in _SIDES:
        g = _from_side(grid, side)
        g = np.concatenate([_next_line(g), g[:3]])
        beyond, within = _crossing(image, g, 0), _crossing(image, g, 2)
        contrast = np.median(np.abs(within[np.isfinite(within)])) if np.isfinite(within).any() else 0.0
        if contrast == 0:
            continue  # overexposed, unlit, or a line of points that are no corners
        like = beyond * np.sign(within) / contrast
        if np.isfinite(like).sum() >= 3 and np.nanmedian(like) > 0.75 and np.nanmin(like) > 0.3:
            names.append(side)
    return names


def _crossing(image: GreyImage, grid: Array, row: int) -> Array:
    """Difference (n,), DN, by which one diagonal of the four squares at each corner of a row is darker; nan outside."""
    down, along = (np.asarray(np.gradient(grid, axis=k))[row] for k in (0, 1))
    total = np.zeros(grid.shape[1])
    for dj, di in ((-1, -1), (1, 1), (-1, 1), (1, -1)):
        pixels = grid[row] + 0.22 * (dj * along + di * down)
        grey = corner_refinement.sampled(image, pixels)
        outside = np.any((pixels < 0) | (pixels > np.array(image.shape[::-1]) - 1), axis=1)
        total += np.where(outside, np.nan, grey) * (-dj * di) / 2
    return total


def _parts(image: GreyImage) -> Iterator[Array]:
    """Chessboards (rows, columns, 2), px, of any size, or parts of them.

    No method and no picture size always finds a whole board: in nine pictures each of the four combinations finds the
    whole one in six or seven, and together they find all.
    """
    small = [s for s in scales(image) if s * max(image.shape) <= _QUICK_PX][:2]
    for scale in small or [scales(image)[-1]]:
        for flags in (_SECTORS, cv2.CALIB_CB_NORMALIZE_IMAGE):
            found, corners, meta = cv2.findChessboardCornersSBWithMeta(
                scaled(image, scale), (3, 3), flags | cv2.CALIB_CB_LARGER
            )
            if not found or meta is None or meta.ndim < 2 or meta.size * 2 != corners.size:
                continue
            grid = at_full_size(corners.reshape(*meta.shape[:2], 2).astype(float), scale)
            # 3x3 corners occur by chance in many pictures
            if min(grid.shape[:2]) >= 4 and abs(alternation(image, grid)) >= _ALTERNATING:
                yield grid


def _other_size(grid: Array | None, board: Chessboard) -> NotFound:
    """The message about a chessboard of another size than the expected one."""
    if grid is None:
        return NotFound("no chessboard found: it must lie wholly in the picture, with a white margin and without glare")
    columns, rows = sorted(grid.shape[:2], reverse=board.columns >= board.rows)
    wide, high = sorted((board.columns, board.rows), reverse=board.columns >= board.rows)
    if columns <= wide and rows <= high:
        return NotFound(
            f"only {columns}x{rows} of the {board.columns}x{board.rows} inner corners are visible: the board is partly"
            " hidden, in glare or outside the picture, or it has fewer corners than stated"
        )
    return NotFound(
        f"a chessboard of {columns}x{rows} inner corners, not {board.columns}x{board.rows}; count the inner corners"
        " along both sides again"
    )
