"""The printed pattern of a board: as shapes for a printer, and as ink density at any point.

Drawings have their own frame: origin at the top left corner of the printed area, x right, y down, m.
`BoardShapes.first_point` is the origin of the board's frame in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from calibration.boards.board_types import DICTIONARIES, Board, Charuco, Chessboard, CircleGrid
from geometry.arrays import Array, Bools, Ints


@dataclass(frozen=True, slots=True)
class Layer:
    """Shapes of one colour, painted over the previous layers. Paint the shapes of a layer as ONE path.

    Touching squares that are painted one by one show hairlines between them in most PDF viewers.
    """

    is_black: bool
    rectangles: Array  # (n, 4), m: left, top, width, height
    circles: Array  # (n, 3), m: centre x, y, radius


@dataclass(frozen=True, slots=True)
class BoardShapes:
    """A board as layers from the bottom up, on white paper."""

    size_m: tuple[float, float]  # width, height of the printed area
    first_point: Array  # (2,), m: the origin of the board's frame
    layers: tuple[Layer, ...]


def draw(board: Board) -> BoardShapes:
    """The shapes of a board in real size."""
    none = np.empty((0, 4))
    if isinstance(board, CircleGrid):
        start = np.full(2, board.diameter_m / 2)
        circles = np.column_stack([board.points[:, :2] + start, np.full(len(board.ids), board.diameter_m / 2)])
        return BoardShapes(board.size_m, start, (Layer(True, none, circles),))
    s, (columns, rows) = board.square_m, squares(board)
    start = np.array([s, s])
    j, i = np.meshgrid(np.arange(columns), np.arange(rows))
    black = is_black_square(board, j, i)
    ink = ~black if isinstance(board, Charuco) and board.inverted else black
    layers = [Layer(True, _cells(j[ink], i[ink], s, np.zeros(2)), np.empty((0, 3)))]
    if isinstance(board, Charuco):
        markers, cells = _marker_cells(board, j[~black], i[~black])
        layers.append(Layer(not board.inverted, markers, np.empty((0, 3))))
        layers.append(Layer(board.inverted, cells, np.empty((0, 3))))
    return BoardShapes(board.size_m, start, tuple(layers))


def squares(board: Board) -> tuple[int, int]:
    """Columns and rows of squares of a chessboard or ChArUco board."""
    if isinstance(board, Charuco):
        return board.columns, board.rows
    return board.columns + 1, board.rows + 1


def is_black_square(board: Board, column: Ints, row: Ints) -> Bools:
    """Whether squares (...), counted from the outer top left one, are black (before inversion)."""
    light_first = isinstance(board, Charuco) and board.light_first
    return (column + row + light_first) % 2 == 0


def marker_bits(dictionary: str, number: int) -> Bools:
    """The modules (n + 2, n + 2) of a marker with its border: True where black."""
    known = cv2.aruco.getPredefinedDictionary(DICTIONARIES[dictionary])
    return np.asarray(cv2.aruco.generateImageMarker(known, number, int(known.markerSize) + 2)) < 128


def ink_at(board: Board, xy: Array) -> Array:
    """Ink density of a board at points (..., 2), m, of its frame: 1 ink, 0 paper; 0 outside the printed area."""
    if isinstance(board, CircleGrid):
        return _circle_ink(board, xy)
    ink, x_edges, y_edges = _ink_of_cells(board)
    return ink[np.searchsorted(y_edges, xy[..., 1], side="right"), np.searchsorted(x_edges, xy[..., 0], side="right")]


@lru_cache(maxsize=8)
def _ink_of_cells(board: Chessboard | Charuco) -> tuple[Array, Array, Array]:
    """Ink of the cells that the edges of squares and of the modules of markers form, and these edges in x and y, m.

    With a row and a column without ink before the first edge and behind the last, where nan is sorted to as well.
    """
    columns, rows = squares(board)
    j, i = np.meshgrid(np.arange(columns), np.arange(rows))
    ink, steps = is_black_square(board, j, i), np.zeros(1)
    if isinstance(board, Charuco):
        bits = [marker_bits(board.dictionary, number) for number in range(board.markers)]
        share, modules = board.marker_m / board.square_m, len(bits[0])
        steps = np.append(0.0, (1 - share) / 2 + share * np.arange(modules + 1) / modules)
        places = np.argwhere(~ink) * len(steps) + 1
        ink = ink.repeat(len(steps), axis=0).repeat(len(steps), axis=1)
        for marker, (row, column) in zip(bits, places.tolist(), strict=True):
            ink[row : row + modules, column : column + modules] = marker
        ink ^= board.inverted
    edges = (board.square_m * (np.arange(n)[:, None] + steps - 1).ravel() for n in (columns, rows))
    x, y = (np.append(e, board.square_m * (n - 1)) for e, n in zip(edges, (columns, rows), strict=True))
    return np.pad(ink.astype(float), 1), x, y


def _circle_ink(board: CircleGrid, xy: Array) -> Array:
    """Ink of the nearest circle: its row is one of the two adjacent ones, its column the nearest in that row."""
    x, y = np.nan_to_num(xy[..., 0], nan=-1e9), np.nan_to_num(xy[..., 1], nan=-1e9)
    ink = np.zeros(x.shape, dtype=bool)
    pitch = board.spacing_m * (2 if board.asymmetric else 1)
    for side in (0, 1):
        i = np.clip(np.floor(y / board.spacing_m) + side, 0, board.rows - 1)
        shift = (i % 2) * board.spacing_m if board.asymmetric else 0.0
        j = np.clip(np.round((x - shift) / pitch), 0, board.columns - 1)
        ink |= np.hypot(x - j * pitch - shift, y - i * board.spacing_m) < board.diameter_m / 2
    return ink.astype(float)


def _cells(j: Ints, i: Ints, step: float, start: Array) -> Array:
    side = np.full(len(j), step)
    return np.column_stack([start[0] + j * step, start[1] + i * step, side, side])


def _marker_cells(board: Charuco, j: Ints, i: Ints) -> tuple[Array, Array]:
    """The whole markers in black, and the white modules in them. Numbered row by row, as in OpenCV."""
    margin = (board.square_m - board.marker_m) / 2
    corners = np.column_stack([j, i]) * board.square_m + margin
    black = np.column_stack([corners, np.full((len(j), 2), board.marker_m)])
    white = []
    for number, corner in enumerate(corners):
        bits = marker_bits(board.dictionary, number)
        y, x = np.nonzero(~bits)
        white.append(_cells(x, y, board.marker_m / len(bits), corner))
    return black, np.concatenate(white)
