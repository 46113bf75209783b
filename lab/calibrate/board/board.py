"""`calibrate board`: writes a calibration board for printing, with its description."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from calibration.boards.board_types import Board, Charuco
from lab.calibrate.board.board_page import as_pdf, as_png, as_svg, lay_out
from lab.errors import InputError
from lab.files.rig.board_file import load_board, load_board_or_text, save_board
from lab.files.text.atomic_write import atomic_folder, atomic_write_bytes
from lab.files.text.error_text import suggest_name
from lab.findings.outcome import Done

FORMATS = ("pdf", "svg", "png")
DESCRIPTION = "board.yaml"
# Smallest white rim around a marker, in marker modules. Measured on rendered boards of 7x5 squares of 36 mm, 960x720
# px, blur 0.7 and 1.2 px: with a rim of 0.05 no marker is detected; corner errors are 0.1 to 0.7 px with 0.2, 0.05 to
# 0.3 px with 0.4, and 0.03 to 0.06 px from 0.7 on. OpenCV recommends 0.7 too.
MIN_RIM_MODULES = 0.7


def write_board(
    board: Board | str | Path,
    out: Path,
    formats: Sequence[str] = FORMATS,
    page: str = "A4",
    dpi: float = 300.0,
) -> Done[Board]:
    """Write board.pdf, board.svg, board.png and board.yaml into the folder `out`.

    If `out` names a file with one of these suffixes, only that format and its description are written. All files are
    written or none. board: a value, its text, or the path of a board.yaml.

    Raises:
        InputError: for an unknown format, a board that does not fit on the page, or files that cannot be written.
    """
    if isinstance(board, str | Path):
        board = load_board_or_text(board)
    out = Path(out)
    single = out.suffix.lower()[1:]
    if single in FORMATS and not out.is_dir():
        formats = (single,)
    for name in formats:
        if name not in FORMATS:
            raise InputError(f"format: expected {', '.join(FORMATS)}, got {name!r}{suggest_name(name, FORMATS)}")
    if out.suffix and not out.is_dir() and not (single in FORMATS or _is_number(single)):
        raise InputError(
            f"{out}: expected a folder, or a file ending in .{', .'.join(FORMATS)}, got {out.suffix};"
            " use one of these suffixes"
        )
    _check_rim(board)
    layout = lay_out(board, page)
    writers = {
        "pdf": lambda: as_pdf(layout),
        "svg": lambda: as_svg(layout).encode("utf-8"),
        "png": lambda: as_png(layout, dpi),
    }
    contents = {name: writers[name]() for name in dict.fromkeys(formats)}
    if single in FORMATS and not out.is_dir():
        description = out.with_suffix(".yaml")
        if description.exists() and load_board(description) != board:
            raise InputError(f"{description}: describes another board; choose another name")
        out.parent.mkdir(parents=True, exist_ok=True)
        atomic_write_bytes(contents[single], out)
        save_board(board, description)
        return _done(board, (out, description), layout.name)
    with atomic_folder(out, _holds_boards_only) as work:
        for name, data in contents.items():
            (work / f"board.{name}").write_bytes(data)
        save_board(board, work / DESCRIPTION)
    return _done(board, (*(out / f"board.{name}" for name in contents), out / DESCRIPTION), layout.name)


def _done(board: Board, files: Sequence[Path], page: str) -> Done[Board]:
    names, folder = ", ".join(path.name for path in files), files[0].parent
    line = f"{board.describe()} on {page}: {names} in {folder}; print at 100 % and measure the bar of 100 mm"
    return Done(board, (line,))


def _is_number(suffix: str) -> bool:
    """Whether the part after the last dot belongs to a folder name, as in boards-v1.2 or 2026.11.21."""
    return suffix[:1].isdigit()


def _check_rim(board: Board) -> None:
    """Raise InputError for a ChArUco board whose markers nearly touch the squares.

    Only printing is refused. Photographs of existing boards show by themselves whether the markers can be read.
    """
    if isinstance(board, Charuco) and board.rim_modules < MIN_RIM_MODULES * (1 - 1e-9):
        largest_mm = math.floor(10_000 * board.marker_with_rim_m(MIN_RIM_MODULES)) / 10
        raise InputError(
            f"{board.describe()}: the white rim around the markers is only {board.rim_modules:.2f} marker modules wide,"
            f" at least {MIN_RIM_MODULES:g} are needed to find the corners; make the markers {largest_mm:g} mm or less"
        )


def _holds_boards_only(folder: Path) -> bool:
    known = {DESCRIPTION, *(f"board.{name}" for name in FORMATS)}
    return {path.name for path in folder.iterdir()} <= known
