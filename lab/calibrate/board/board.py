"""`calibrate board`: a calibration board to print, with its description."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from calibration.boards.board_types import Board, Charuco
from lab.calibrate.board.board_page import as_pdf, as_png, as_svg, lay_out
from lab.errors import InputError
from lab.files.rig.board_file import board_of, load_board, save_board
from lab.files.text.atomic_write import atomic_folder, atomic_write_bytes
from lab.files.text.error_text import did_you_mean

FORMATS = ("pdf", "svg", "png")
DESCRIPTION = "board.yaml"
# Rendered boards, 7x5 squares of 36 mm, 960x720 px, blur 0.7 and 1.2 px: with a rim of 0.05 modules no marker is seen,
# with 0.2 corners err by 0.1 to 0.7 px, with 0.4 by 0.05 to 0.3, from 0.7 on by 0.03 to 0.06. OpenCV asks for 0.7 too.
LEAST_RIM = 0.7


@dataclass(frozen=True, slots=True)
class BoardOutcome:
    """What was written."""

    board: Board
    files: tuple[Path, ...]
    page: str

    def line(self) -> str:
        """One line for the user."""
        names = ", ".join(path.name for path in self.files)
        return (
            f"{self.board.describe()} on {self.page}: {names} in {self.files[0].parent};"
            " print at 100 % and measure the bar of 100 mm"
        )

    @property
    def exit_status(self) -> int:
        """0: a board that could not be written is an error."""
        return 0


def write_board(
    board: Board | str | Path,
    out: Path,
    formats: Sequence[str] = FORMATS,
    page: str = "A4",
    dpi: float = 300.0,
) -> BoardOutcome:
    """Write a board as board.pdf, .svg, .png and board.yaml into the folder `out`, or as the one file that it names.

    board: a value, its text, or the path of a board.yaml. Everything is written or nothing. Raises InputError.
    """
    if isinstance(board, str | Path):
        board = board_of(board)
    out = Path(out)
    single = out.suffix.lower()[1:]
    if single in FORMATS and not out.is_dir():
        formats = (single,)
    for name in formats:
        if name not in FORMATS:
            raise InputError(f"format: expected {', '.join(FORMATS)}, got {name!r}{did_you_mean(name, FORMATS)}")
    if out.suffix and not out.is_dir() and not (single in FORMATS or _is_number(single)):
        raise InputError(
            f"{out}: expected a folder, or a file ending in .{', .'.join(FORMATS)}, got {out.suffix};"
            " choose one of them"
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
        return BoardOutcome(board, (out, description), layout.name)
    with atomic_folder(out, _holds_boards_only) as work:
        for name, data in contents.items():
            (work / f"board.{name}").write_bytes(data)
        save_board(board, work / DESCRIPTION)
    return BoardOutcome(board, (*(out / f"board.{name}" for name in contents), out / DESCRIPTION), layout.name)


def _is_number(suffix: str) -> bool:
    """Whether what follows the last dot belongs to a folder's name: boards-v1.2, 2026.11.21."""
    return suffix[:1].isdigit()


def _check_rim(board: Board) -> None:
    """Raises InputError for a ChArUco board whose markers nearly touch the squares: such boards are not to be printed.

    Boards that are there already are another matter: photographs of them show whether they can be read.
    """
    if isinstance(board, Charuco) and board.rim_modules < LEAST_RIM * (1 - 1e-9):
        most = math.floor(10_000 * board.marker_with_rim_m(LEAST_RIM)) / 10
        raise InputError(
            f"{board.describe()}: the white rim about the markers is only {board.rim_modules:.2f} of a marker's dots"
            f" wide, {LEAST_RIM:g} or more are needed to find its corners; make the markers {most:g} mm or smaller"
        )


def _holds_boards_only(folder: Path) -> bool:
    known = {DESCRIPTION, *(f"board.{name}" for name in FORMATS)}
    return {path.name for path in folder.iterdir()} <= known
