"""Plain chessboards in pictures."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np

from calibration import corner_refinement
from calibration.board_view import BLUR_LIMIT, BoardView, GreyImage, NotFound, low_contrast, too_blurred
from calibration.boards import Chessboard
from calibration.smaller_pictures import at_full_size, scaled, scales
from geometry.arrays import Array

_ALTERNATING = 0.9  # share of neighbouring squares that differ as they should; real boards reach 1
_QUICK_PX = 1000  # longer side of the picture in which a board is looked for first
_CLASSIC = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
_SECTORS = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE


def find_chessboard(image: GreyImage, board: Chessboard) -> BoardView | NotFound:
    """All inner corners of a chessboard, or the reason why they cannot be had. A part of it is not enough."""
    for grid in _grids(image, board.columns, board.rows):
        fine = corner_refinement.refined(image, grid)
        if not np.isfinite(fine).all() or not _is_sheet(fine):
            continue
        ordered = oriented(image, fine)
        if ordered is not None:
            return _checked(image, ordered, board)
    return _why_not(image, board)


def _grids(image: GreyImage, columns: int, rows: int) -> Iterator[Array]:
    """Candidates (rows, columns, 2), px, quick ways first.

    The classical finder needs 0.03 s for 1920x1080 and cv2.findChessboardCornersSB 0.9 to 1.9 s; of 41 real pictures
    the first finds 39, the second 39, and not the same. Smaller copies serve pictures out of focus.
    """
    size = (columns, rows)
    sizes = scales(image)
    for scale in sizes:
        yield from _as_grid(cv2.findChessboardCorners(scaled(image, scale), size, flags=_CLASSIC), columns, rows, scale)
    first = next((s for s in sizes if s * max(image.shape) <= _QUICK_PX), sizes[-1])
    yield from _as_grid(cv2.findChessboardCornersSB(scaled(image, first), size, flags=_SECTORS), columns, rows, first)
    if first != 1.0:
        yield from _as_grid(cv2.findChessboardCornersSB(image, size, flags=_SECTORS), columns, rows, 1.0)
    for scale in sizes:
        if scale < first:
            yield from _as_grid(
                cv2.findChessboardCornersSB(scaled(image, scale), size, flags=_SECTORS), columns, rows, scale
            )


def _as_grid(answer: Any, columns: int, rows: int, scale: float) -> Iterator[Array]:
    found, corners = answer[:2]
    if found and corners is not None and len(corners.reshape(-1, 2)) == columns * rows:
        yield at_full_size(corners.reshape(rows, columns, 2).astype(float), scale)


def _is_sheet(grid: Array) -> bool:
    """Whether all cells turn the same way round: the order of a sheet that is not folded."""
    turn = _cell_turns(grid)
    return bool(np.all(turn > 0) or np.all(turn < 0))


def _cell_turns(grid: Array) -> Array:
    a, b = grid[:-1, 1:] - grid[:-1, :-1], grid[1:, :-1] - grid[:-1, :-1]
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def orders(grid: Array) -> list[Array]:
    """The ways to number a grid (rows, columns, 2) that keep its shape and are not mirrored, px with v down."""
    ways = [grid, grid[::-1], grid[:, ::-1], grid[::-1, ::-1]]
    if grid.shape[0] == grid.shape[1]:
        ways += [np.swapaxes(w, 0, 1) for w in ways]
    return [w for w in ways if np.median(_cell_turns(w)) > 0]


def upright(ways: list[Array]) -> Array:
    """Of orders that the board cannot tell apart, the one whose rows point most to the right in the picture."""
    return max(ways, key=lambda w: float(np.sum(w[:, -1, 0] - w[:, 0, 0]) / max(np.ptp(w[..., 0]), 1e-9)))


def oriented(image: GreyImage, grid: Array) -> Array | None:
    """The grid numbered from the corner whose outer square is dark, the same way in all pictures where that can be.

    None where the squares do not alternate: what only looks like a chessboard.
    """
    ways = orders(grid)
    shades = [alternation(image, way) for way in ways]
    if max(abs(shade) for shade in shades) < _ALTERNATING:
        return None
    # Both corners light (a board with an even sum, printed the other way round): then any of them, but always upright.
    dark_first = [way for way, shade in zip(ways, shades, strict=True) if shade > 0] or ways
    return upright(dark_first)


def alternation(image: GreyImage, grid: Array) -> float:
    """1 where every square between the corners differs from its neighbours as on a chessboard whose first square is
    dark, -1 where it is light, near 0 for other patterns.

    The square between the first four corners has the colour of that outside the first corner. Each is read at five
    places, as the markers of other boards also have their dark and light parts.
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


def _checked(image: GreyImage, grid: Array, board: Chessboard) -> BoardView | NotFound:
    larger = _goes_on(image, grid)
    if larger:
        return NotFound(
            f"the chessboard goes on {larger} beyond {board.columns}x{board.rows} inner corners; count the inner"
            " corners along both sides again"
        )
    blur, contrast = corner_refinement.edge_blur(image, grid)
    apart = corner_refinement.spacing(grid)
    if blur > BLUR_LIMIT * apart:
        return too_blurred(blur, apart)
    return BoardView(board.ids, grid.reshape(-1, 2), apart, blur, contrast)


def _goes_on(image: GreyImage, grid: Array) -> str:
    """On which side squares follow beyond the outermost ones: 'to the right', ...; empty where the board ends.

    Beyond the outermost square lies its margin. The two squares further out are read at half a square's distance,
    where an honest margin is even and a chessboard alternates as within.
    """
    sides = {"above": grid, "below": grid[::-1], "to the left": np.swapaxes(grid, 0, 1)}
    sides["to the right"] = np.swapaxes(grid[:, ::-1], 0, 1)
    names = []
    h, w = image.shape
    for side, g in sides.items():
        corner = 3 * g[0] - 3 * g[1] + g[2]  # the next row outside, by its parabola
        further = 6 * g[0] - 8 * g[1] + 3 * g[2]  # and the one after
        inner = (g[0, :-1] + g[0, 1:] + g[1, :-1] + g[1, 1:]) / 4
        outer = (corner[:-1] + corner[1:] + further[:-1] + further[1:]) / 4
        seen = np.all((outer >= 0) & (outer < [w, h]), axis=1)
        if seen.sum() < 2:
            continue
        sign = np.where(np.arange(len(inner)) % 2 == 0, 1, -1)
        inside = corner_refinement.sampled(image, inner)
        outside = corner_refinement.sampled(image, outer)
        a = np.mean((inside - np.median(inside)) * sign)
        steps = np.diff(outside[seen]) * sign[:-1][: seen.sum() - 1]
        if np.median(steps * np.sign(-a)) > abs(a) and np.all(steps * np.sign(-a) > 0.5 * abs(a)):
            names.append(side)
    return " and ".join(names)


def _why_not(image: GreyImage, board: Chessboard) -> NotFound:
    pale = low_contrast(image)
    if pale is not None:
        return pale
    scale = min(1.0, _QUICK_PX / max(image.shape))
    flags = _SECTORS | cv2.CALIB_CB_LARGER
    found, corners, meta = cv2.findChessboardCornersSBWithMeta(scaled(image, scale), (3, 3), flags)
    nothing = NotFound("no chessboard seen: it must lie wholly in the picture, with a light margin and no glare on it")
    if not found or meta is None or meta.ndim < 2 or meta.size * 2 != corners.size:
        return nothing
    rows, columns = meta.shape[:2]
    grid = at_full_size(corners.reshape(rows, columns, 2).astype(float), scale)
    if min(rows, columns) < 4 or abs(alternation(image, grid)) < _ALTERNATING:
        return nothing  # 3x3 corners are found in many a room
    columns, rows = sorted((columns, rows), reverse=board.columns >= board.rows)
    wide, high = sorted((board.columns, board.rows), reverse=board.columns >= board.rows)
    if columns <= wide and rows <= high:
        return NotFound(
            f"only {columns}x{rows} of the {board.columns}x{board.rows} inner corners can be seen: the board is partly"
            " hidden, in glare or outside the picture, or it has fewer corners than said"
        )
    return NotFound(
        f"a chessboard of {columns}x{rows} inner corners, not {board.columns}x{board.rows}; count the inner corners"
        " along both sides again"
    )
