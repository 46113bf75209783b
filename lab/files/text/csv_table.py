"""A table of a CSV file in memory, and its errors with their line numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geometry.arrays import Array, Bools, Ints
from lab.errors import InputError
from lab.files.text.error_text import describe_value

MAX_EXACT_INTEGER = 2**53  # a larger number read as float is not exact


@dataclass(frozen=True, slots=True)
class Categorical:
    """A column of words, n rows; each word is kept once."""

    codes: Ints  # (n,) index into words
    words: tuple[str, ...]

    def recoded(self, words: tuple[str, ...]) -> Ints:
        """(n,) index into the given words; -1 for a word that is not among them."""
        place = {word: i for i, word in enumerate(words)}
        return np.array([place.get(word, -1) for word in self.words] or [-1], dtype=np.int64)[self.codes]

    def tolist(self) -> list[str]:
        """The words of all rows."""
        return [self.words[code] for code in self.codes.tolist()]


@dataclass(frozen=True, slots=True)
class Table:
    """Some columns of a CSV file, n rows."""

    path: Path
    header: tuple[str, ...]
    numbers: dict[str, Array]  # (n,) each; nan where the field is empty or not a number, or the column is absent
    words: dict[str, Categorical]
    lines: Ints  # (n,) line of the file, from 1, in which each row ends
    texts: dict[str, dict[int, str]]  # by column and line: fields that are not numbers
    long_lines: tuple[int, ...]  # lines left out because they have more fields than the header
    short_lines: tuple[int, ...]  # lines with fewer fields than the header; the missing fields count as empty

    def __len__(self) -> int:
        return len(self.lines)

    def __contains__(self, column: str) -> bool:
        return column in self.header

    def stack(self, *names: str) -> Array:
        """(n, k): the number columns of these names side by side."""
        return np.stack([self.numbers[n] for n in names], axis=-1)

    def select(self, rows: Bools) -> Table:
        """The table with some of its rows (n,)."""
        return Table(
            self.path,
            self.header,
            {name: values[rows] for name, values in self.numbers.items()},
            {name: Categorical(column.codes[rows], column.words) for name, column in self.words.items()},
            self.lines[rows],
            self.texts,
            self.long_lines,
            self.short_lines,
        )

    def error(self, row: int, mistake: str) -> InputError:
        """The error of one row: `file: line 7: mistake`."""
        return InputError(f"{self.path}: line {self.lines[row]}: {mistake}")

    def found(self, column: str, row: int) -> str:
        """The content of a number field as an error message shows it."""
        text = self.texts.get(column, {}).get(int(self.lines[row]))
        if text is not None:
            return describe_value(text)
        value = float(self.numbers[column][row])
        return "nothing" if math.isnan(value) else f"{value:.7g}"

    def require_rows(self, expected: Sequence[str]) -> None:
        """Raises InputError where the table has no rows, or lines with too many fields. expected: shown columns."""
        self.refuse_long_lines()
        if not len(self):
            raise InputError(f"{self.path}: expected rows {','.join(expected)} below the header, got none")

    def refuse_long_lines(self) -> None:
        """Raises InputError where lines have more fields than the header."""
        if self.long_lines:
            raise InputError(
                f"{self.path}: line {self.long_lines[0]}: expected {len(self.header)} fields as in the header, got more"
                f" ({len(self.long_lines)} such lines); correct them (a comma too many, or a decimal comma)"
            )

    def finite(self, column: str, expected: str = "a number", may_be_empty: bool = False) -> Array:
        """A column (n,) of finite numbers; nan for empty fields where `may_be_empty`.

        Raises InputError, with line and text, at the first field that is something else.
        """
        values = self.numbers[column]
        for i in np.flatnonzero(~np.isfinite(values)).tolist():
            found = self.found(column, i)
            if found != "nothing" or not may_be_empty:
                remedy = "; leave the field empty where it is not known" if may_be_empty else ""
                raise self.error(i, f"{column}: expected {expected}, got {found}{remedy}")
        return values

    def optional(self, column: str) -> Array:
        """A column (n,) of finite numbers; nan for empty fields, and where the file does not have the column."""
        return self.finite(column, may_be_empty=True)

    def whole(self, column: str) -> Ints:
        """A column (n,) of whole numbers. Raises InputError, with the line, at the first field that is not one."""
        values = self.numbers[column]
        bad = np.flatnonzero(~is_whole(values))
        if bad.size:
            raise self.error(bad[0], f"{column}: expected a whole number, got {self.found(column, bad[0])}")
        return values.astype(np.int64)

    def names(self, column: str, may_be_empty: bool = False) -> list[str]:
        """A column of names. Raises InputError at the first empty field, unless `may_be_empty`."""
        names = self.words[column].tolist()
        if not may_be_empty and "" in names:
            raise self.error(names.index(""), f"{column}: expected a name, got nothing")
        return names


def is_whole(values: Array) -> Bools:
    """Which floats (n,) are whole numbers that an integer can hold exactly."""
    with np.errstate(invalid="ignore"):
        return np.isfinite(values) & (np.abs(values) < MAX_EXACT_INTEGER) & (values == np.round(values))
