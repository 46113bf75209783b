"""Tables of board corners that another program found: mrcal's corners.vnl, or a CSV file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calibration.boards.board_types import Board
from calibration.boards.board_view import BoardView
from geometry.arrays import Array, Ints
from lab.calibrate.camera.photos import PhotoSet
from lab.errors import InputError
from lab.files.text.csv_text import read_table
from lab.files.text.regular_file import text_of_file

TABLE_SUFFIXES = (".vnl", ".csv")
CSV_COLUMNS = ("view", "id", "u_px", "v_px")


def read_corner_table(path: Path, board: Board, image_size_px: tuple[int, int]) -> PhotoSet:
    """The views of a board in a table of corners.

    vnl: `filename x y [weight]`, one row per point of the board in the order of the rows, `-` where it was not found;
    rows with a weight of 0 or less are left out, other weights are not used. CSV: columns view, id, u_px, v_px, with
    the numbers of the points from 0 row by row, as in corners.csv. Pixels refer to the centre of the first pixel.

    Raises:
        InputError: the table cannot be read, or is not of this board or picture size.
    """
    views = _read_vnl(path, board) if path.suffix.lower() == ".vnl" else _read_csv(path)
    size = np.array(image_size_px)
    found: list[tuple[str, BoardView]] = []
    for name, (ids, pixels) in views.items():
        if not np.isin(ids, board.ids).all() or len(np.unique(ids)) != len(ids):
            raise InputError(
                f"{path}: {name}: expected each of the points 0 to {len(board.ids) - 1} of {board.describe()} at most"
                f" once, got {len(ids)} with numbers up to {ids.max()}"
            )
        if np.any(pixels < -0.5) or np.any(pixels > size - 0.5):
            raise InputError(
                f"{path}: {name}: expected corners inside {size[0]}x{size[1]} px, got {np.max(pixels[:, 0]):.0f},"
                f" {np.max(pixels[:, 1]):.0f}; check --image-size"
            )
        order = np.argsort(ids)
        if len(ids):
            found.append((name, BoardView(ids[order], pixels[order], np.nan, np.nan, np.nan)))
    if not found:
        raise InputError(f"{path}: expected corners of {board.describe()}, got none")
    return PhotoSet(board, image_size_px, tuple(found), (), {name: path for name, _ in found})


def _read_vnl(path: Path, board: Board) -> dict[str, tuple[Ints, Array]]:
    try:
        lines = text_of_file(path).splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from None
    rows: dict[str, list[tuple[float, float, float]]] = {}
    for number, line in enumerate(lines, 1):
        fields = line.split()
        if not fields or line.startswith("#"):
            continue
        try:
            x, y, weight = (float("nan") if f == "-" else float(f) for f in (*fields[1:3], *fields[3:4], "1")[:3])
        except ValueError:
            raise InputError(f"{path}: line {number}: expected `filename x y [weight]`, got {line[:60]!r}") from None
        rows.setdefault(fields[0], []).append((x, y, weight))
    out = {}
    for name, points in rows.items():
        values = np.array(points)
        if len(values) == 1 and np.isnan(values[0, 0]):  # a picture without the board
            continue
        if len(values) != len(board.ids):
            raise InputError(
                f"{path}: {name}: expected {len(board.ids)} rows, one per point of {board.describe()}, got"
                f" {len(values)}"
            )
        good = np.isfinite(values).all(axis=1) & (values[:, 2] > 0)
        out[name] = (board.ids[good], values[good, :2])
    return out


def _read_csv(path: Path) -> dict[str, tuple[Ints, Array]]:
    table = read_table(path, CSV_COLUMNS)
    table.require_rows(CSV_COLUMNS)
    ids = table.finite("id", "the number of a point of the board")
    pixels = np.stack([table.finite("u_px"), table.finite("v_px")], axis=1)
    view = table.words["view"]
    return {name: (ids[view.codes == k].astype(np.int64), pixels[view.codes == k]) for k, name in enumerate(view.words)}
