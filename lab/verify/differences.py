"""Where two tables differ: file, row and column."""

from __future__ import annotations

import csv
import itertools
from dataclasses import dataclass
from pathlib import Path

MOST_SHOWN = 60  # characters of a field in a message


@dataclass(frozen=True, slots=True)
class Difference:
    """The difference of one table."""

    file: str
    text: str

    def __str__(self) -> str:
        return f"{self.file}: {self.text}"


def difference_of(recorded: Path, computed: Path) -> Difference | None:
    """The first difference of two tables with the number of rows that differ; None for the same bytes."""
    name = recorded.name
    if not recorded.is_file() or not computed.is_file():
        which = "is missing in the results" if computed.is_file() else "is in the results, but is not computed any more"
        return Difference(name, which)
    if _same_bytes(recorded, computed):
        return None
    first, rows, old_rows, new_rows = "", 0, 0, 0
    header: list[str] = []
    with recorded.open("rb") as old_file, computed.open("rb") as new_file:
        for number, (old, new) in enumerate(itertools.zip_longest(old_file, new_file), start=1):
            old_rows, new_rows = old_rows + (old is not None), new_rows + (new is not None)
            if number == 1 and new is not None:
                header = _fields(new)
            if old != new:
                rows += 1
                first = first or _row_text(number, header, old, new)
    counted = f"{rows} of {max(old_rows, new_rows)} lines differ"
    length = f"; {old_rows} lines recorded, {new_rows} computed" if old_rows != new_rows else ""
    return Difference(name, f"{first} ({counted}{length})")


def _same_bytes(first: Path, second: Path) -> bool:
    if first.stat().st_size != second.stat().st_size:
        return False
    with first.open("rb") as a, second.open("rb") as b:
        while block := a.read(2**20):
            if block != b.read(2**20):
                return False
    return True


def _fields(line: bytes) -> list[str]:
    """The fields of a line; a damaged line that is no CSV is one field."""
    text = line.decode("utf-8", "replace").rstrip("\r\n")
    try:
        return next(csv.reader([text]), [])
    except csv.Error:  # a carriage return within a field, or a field of more than 131,072 characters
        return [text]


def _row_text(number: int, header: list[str], old: bytes | None, new: bytes | None) -> str:
    if old is None:
        return f"line {number} is missing"
    if new is None:
        return f"line {number} is not computed"
    before, after = _fields(old), _fields(new)
    frame = f" (frame {after[0]})" if number > 1 and header[:1] == ["frame"] and after else ""
    for i, (a, b) in enumerate(itertools.zip_longest(before, after, fillvalue="nothing")):
        if a != b:
            column = header[i] if i < len(header) else f"field {i + 1}"
            return f"line {number}{frame}: {column}: recorded {a[:MOST_SHOWN]!r}, computed {b[:MOST_SHOWN]!r}"
    return f"line {number}{frame}: other bytes at the same fields (line ends or quotes)"
