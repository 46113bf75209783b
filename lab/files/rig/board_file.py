"""board.yaml: the description of a calibration board. A short text such as chessboard:9x6:25mm may replace it."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import pydantic

from calibration.boards.board_types import Board, Charuco, Chessboard, CircleGrid, parse
from lab.errors import InputError
from lab.files.text.fields import Block, Integer, Positive, Word, boolean, field_error, one_of, validated
from lab.files.text.yaml_text import read_mapping, write_mapping

SCHEMA = "beampose/board/1"
CHESSBOARD, CIRCLES, CHARUCO = "chessboard", "circles", "charuco"
_TruthValue = Annotated[bool, pydantic.PlainValidator(boolean)]


def load_board_or_text(text_or_path: str | Path) -> Board:
    """The board of a board.yaml, or of a text such as chessboard:9x6:25mm. Raises InputError, in one line."""
    text = str(text_or_path)
    if Path(text).suffix.lower() in (".yaml", ".yml") or Path(text).is_file():
        return load_board(Path(text))
    try:
        return parse(text)
    except ValueError as error:
        raise InputError(f"{error}; or name a board.yaml") from None


def load_board(path: Path) -> Board:
    """The board of a board.yaml. Raises InputError: one line for each mistake, with file and field."""
    path = Path(path)
    return validated(_BoardBlock, read_mapping(path), path).board()


def save_board(board: Board, path: Path) -> None:
    """Write a board.yaml, atomically. Raises InputError."""
    write_mapping(as_mapping(board), Path(path))


def as_mapping(board: Board) -> dict[str, Any]:
    """The content of board.yaml as a plain mapping."""
    kind = next(name for name, made in _KINDS.items() if isinstance(board, made))
    values = {name.removeprefix("stated_"): value for name, value in asdict(board).items() if value is not None}
    return {"schema": SCHEMA, "kind": kind, **values}


_KINDS = {CHESSBOARD: Chessboard, CIRCLES: CircleGrid, CHARUCO: Charuco}
_FIELDS = {  # kind: required fields, optional fields
    CHESSBOARD: ({"square_m"}, set()),
    CIRCLES: ({"spacing_m"}, {"asymmetric", "diameter_m"}),
    CHARUCO: ({"square_m", "marker_m", "dictionary"}, {"inverted", "legacy"}),
}


class _BoardBlock(Block):
    schema_: Annotated[str, pydantic.PlainValidator(one_of((SCHEMA,)))] = pydantic.Field(alias="schema")
    kind: Annotated[str, pydantic.PlainValidator(one_of((CHESSBOARD, CIRCLES, CHARUCO)))]
    columns: Integer  # inner corners, circles per row, or squares of a ChArUco board
    rows: Integer
    square_m: Positive | None = None
    spacing_m: Positive | None = None
    asymmetric: _TruthValue | None = None
    diameter_m: Positive | None = None  # of the circles; without it, measured in the photographs
    marker_m: Positive | None = None
    dictionary: Word | None = None
    inverted: _TruthValue | None = None
    legacy: _TruthValue | None = None

    @pydantic.model_validator(mode="after")
    def _whole(self) -> _BoardBlock:
        must, may = _FIELDS[self.kind]
        given = {name for name in self.model_fields_set if name not in ("schema_", "kind", "columns", "rows")}
        for name in sorted(must - given):
            raise field_error(f"expected {name} for a board of kind {self.kind!r}, got nothing; add it")
        for name in sorted(given - must - may):
            raise field_error(f"unexpected {name} for a board of kind {self.kind!r}; remove it")
        try:
            self.board()
        except ValueError as error:
            raise field_error(str(error)) from None
        return self

    def board(self) -> Board:
        given = {"stated_diameter_m" if n == "diameter_m" else n: v for n, v in self if v is not None}
        del given["schema_"], given["kind"]
        return _KINDS[self.kind](**given)
