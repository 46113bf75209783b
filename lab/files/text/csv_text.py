"""Reads and writes CSV files: every table that the program reads passes through this module.

`read_table` reads the named columns of any CSV file into a `Table`. A regular file (each line as many commas as the
header, no quotes, no blank line) is split at its commas; the csv module reads all others. All errors name the line of
the file (`Table.error`). Range checks of columns find a digit too many, a wrong unit, a placeholder. See
docs/decisions/csv-layer.md.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from geometry.arrays import Array, Bools, Ints
from lab.errors import InputError
from lab.files.text.atomic_write import atomic_write_text
from lab.files.text.error_text import describe_value, is_formula, near_name, printable_line, suggest_name
from lab.files.text.json_text import bytes_of_file

MAX_COORDINATE_M = 10_000.0  # from the origin: those of a national grid must be transformed to a local frame first
MAX_SCAN_COORDINATE = 1e8  # units of a scanned cloud, which may be millimetres and in a national grid
MARGIN_PICTURES = 1.0  # how far outside the picture, in picture widths, a pixel is accepted: predictions lie there
MAX_TIME_S = 1e12  # s, thirty thousand years
SIGMA_RANGE_M = (1e-9, MAX_COORDINATE_M)
SIGMA_RANGE_PX = (1e-6, 1e5)
SIGMA_RANGE_DEG = (0.0, 360.0)


def check_coordinates(table: Table, names: Sequence[str], farthest_m: float = MAX_COORDINATE_M) -> None:
    """Raises InputError at the first coordinate, m, of the columns `names` that lies outside any lab."""
    xyz = table.stack(*names)
    for i, k in np.argwhere(~(np.abs(xyz) <= farthest_m))[:1]:
        raise table.error(
            i,
            f"{names[k]}: expected metres, within {farthest_m / 1e3:g} km of the origin, got {xyz[i, k]:.7g}; are these"
            " millimetres, or a national grid? give metres in the lab's own frame",
        )


def check_pixels(table: Table, sizes: Mapping[str, tuple[int, int]]) -> None:
    """Raises InputError at the first pixel (u_px, v_px) more than MARGIN_PICTURES outside its camera's picture.

    sizes: width and height, px, of each camera; rows of other cameras are not checked.
    """
    cameras = table.words["camera"]
    known = np.array([sizes.get(c, (np.inf, np.inf)) for c in cameras.words], dtype=float).reshape(-1, 2)
    size, pixels = known[cameras.codes], table.stack("u_px", "v_px")
    bad = np.argwhere((pixels < -MARGIN_PICTURES * size) | (pixels > (1 + MARGIN_PICTURES) * size))
    for i, k in bad[:1]:
        name = cameras.words[cameras.codes[i]]
        width, height = sizes[name]
        raise table.error(
            i,
            f"{('u_px', 'v_px')[k]}: expected a pixel in or near the picture of camera {name!r} ({width} x {height}"
            f" px), got {pixels[i, k]:.7g}; correct it, or remove the row",
        )


def check_sigmas(table: Table, name: str, allowed: tuple[float, float], unit: str) -> None:
    """Raises InputError at the first sigma of the column `name` outside the allowed range; nan: not given."""
    sigma, (least, largest) = table.numbers[name], allowed
    for i in np.flatnonzero((sigma < least) | (sigma > largest))[:1]:
        expected = "0 or more" if least == 0 else "a number above 0"
        if sigma[i] > largest:
            expected += f", up to {largest:g} {unit}"
        elif sigma[i] > 0:
            expected += f", from {least:g} {unit}"
        raise table.error(
            i,
            f"{name}: expected {expected}, got {sigma[i]:.7g}; give the measurement's standard deviation, or leave the"
            " field empty",
        )


# The columns that hold words; every other column holds numbers.
WORD_COLUMNS = ("camera", "spot", "beam", "status", "point", "screen", "date", "verdict", "view")
_ROWS_AT_ONCE, _BYTES_AT_ONCE = 1_500, 200_000  # bound the memory of the text (1 MB): a table is read in pieces
_MAX_TEXTS = 1000  # kept per column, of fields that are not numbers


# Reading -------------------------------------------------------------------------------------------------------------


def read_table(path: Path, required: Iterable[str], optional: Iterable[str] = (), damaged: bool = False) -> Table:
    """The required and optional columns of a CSV file; other columns are ignored.

    A column of WORD_COLUMNS holds words, without surrounding blanks; any other one holds numbers, nan where the field
    is empty or not a number (`Table.finite` and `Table.found` distinguish the two). An optional column that the file
    does not have is nan (numbers) or missing from `Table.words`. damaged: bytes that are not UTF-8 are replaced, for
    readers that leave out single rows.

    Raises InputError: no such file, not text, a required column missing or a column named twice.
    """
    path, required = Path(path), tuple(required)
    data = _content(path, required, damaged)
    header = _checked_header(path, data, required)
    wanted = tuple(dict.fromkeys((*required, *optional)))
    table = (_read_regular if _is_regular(data, header) else _read_any)(path, data, header, wanted)
    for name in wanted:
        if name not in header and name not in WORD_COLUMNS:
            table.numbers[name] = np.full(len(table), np.nan)
    return table


def _content(path: Path, required: Sequence[str], damaged: bool) -> bytes:
    """The bytes of a table, UTF-8 text with a line or more. Raises InputError."""
    try:
        data = bytes_of_file(path)
    except FileNotFoundError:
        raise InputError(f"{path}: expected a table with columns {','.join(required)}, found no file") from None
    except IsADirectoryError:
        raise InputError(f"{path}: expected a table, found a folder; name the CSV file in it") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    remedy = "save it as CSV, comma-separated, in UTF-8"
    if data[:2] in (b"\xff\xfe", b"\xfe\xff") or b"\0" in data[:4096]:
        raise InputError(f"{path}: expected a CSV table, got a file that is not text in UTF-8; {remedy}")
    data = data.removeprefix(b"\xef\xbb\xbf")
    if not data.strip():
        raise InputError(f"{path}: expected columns {','.join(required)}, got an empty file")
    if not damaged:
        try:
            data.decode("utf-8")
        except UnicodeDecodeError as error:
            line = data.count(b"\n", 0, error.start) + 1
            raise InputError(f"{path}: line {line}: expected text in UTF-8, got an invalid byte; {remedy}") from None
    return data


def _checked_header(path: Path, data: bytes, required: Sequence[str]) -> tuple[str, ...]:
    """The column names of the first line that is not blank. Raises InputError."""
    lines = data[: 1 << 16].decode("utf-8", errors="replace").splitlines()
    line = next((line for line in lines if line.strip()), "")
    header = [c.strip() for c in next(csv.reader([line], skipinitialspace=True), [])]
    for other, word in ((";", "semicolons"), ("\t", "tabs")):
        if line.count(other) > line.count(",") and not set(required) <= set(header):
            raise InputError(
                f"{path}: expected columns separated by commas, got {word}; separate columns with commas, and write"
                " decimals with a point"
            )
    # A single text is not shown: the path may name any file.
    found = printable_line(",".join(header)) if len(header) > 1 or header[0] in required else "a line without commas"
    for name in required:
        if name not in header:
            similar = near_name(name, [h for h in header if h not in required])
            rename = f"; rename {similar!r} to {name!r} if it is that column" if similar else ""
            raise InputError(f"{path}: expected a column {name!r}, got {found}{rename}")
    twice = [name for i, name in enumerate(header) if name and name in header[:i]]
    if twice:
        raise InputError(
            f"{path}: expected each column once, got {twice[0]!r} twice in the header; rename or remove one"
        )
    return tuple(header)


def _is_regular(data: bytes, header: tuple[str, ...]) -> bool:
    """Whether row i of a table stands in line i + 2, with each field between two commas."""
    first = data[: data.find(b"\n") + 1].decode("utf-8", errors="replace")
    return tuple(first.strip().split(",")) == header and _all_lines_are_equal(data, len(header))


def _all_lines_are_equal(data: bytes, columns: int) -> bool:
    """Whether all lines have this many fields, without quotes, blank lines or lone carriage returns."""
    returns = data.count(b"\r")
    if b'"' in data or not data.endswith(b"\n") or columns > 200 or (returns and returns != data.count(b"\r\n")):
        return False
    content = np.frombuffer(data, np.uint8)
    starts = np.append(0, np.flatnonzero(content == ord("\n"))[:-1] + 1)
    commas = np.add.reduceat((content == ord(",")).view(np.uint8), starts, dtype=np.uint8)
    return columns > 1 and bool(np.all(commas == columns - 1))


class _Columns:
    """The wanted columns of a file as they are read, in pieces."""

    def __init__(self, header: tuple[str, ...], wanted: Sequence[str]) -> None:
        self.place = {name: header.index(name) for name in wanted if name in header}
        self._header = header
        self._lines = [np.zeros(0, dtype=np.int64)]
        self._numbers = {name: [np.zeros(0)] for name in self.place if name not in WORD_COLUMNS}
        self._codes = {name: [np.zeros(0, dtype=np.int64)] for name in self.place if name in WORD_COLUMNS}
        self._known: dict[str, dict[str, int]] = {name: {} for name in self._codes}
        self._texts: dict[str, dict[int, str]] = {name: {} for name in self._numbers}

    def add(self, fields: Mapping[str, list[str]], lines: Sequence[int]) -> None:
        """Add some rows: the fields of each wanted column, and the line of each row."""
        self._lines.append(np.array(lines, dtype=np.int64))
        for name, pieces in self._numbers.items():
            pieces.append(_as_numbers(fields[name], lines, self._texts[name]))
        for name, known in self._known.items():
            code = {field: known.setdefault(field.strip(), len(known)) for field in dict.fromkeys(fields[name])}
            self._codes[name].append(np.array([code[field] for field in fields[name]], dtype=np.int64))

    def table(self, path: Path, long_lines: Sequence[int] = (), short_lines: Sequence[int] = ()) -> Table:
        """The rows so far."""
        return Table(
            path,
            self._header,
            {name: np.concatenate(pieces) for name, pieces in self._numbers.items()},
            {n: Categorical(np.concatenate(pieces), tuple(self._known[n])) for n, pieces in self._codes.items()},
            np.concatenate(self._lines),
            {name: found for name, found in self._texts.items() if found},
            tuple(long_lines),
            tuple(short_lines),
        )


def _read_regular(path: Path, data: bytes, header: tuple[str, ...], wanted: Sequence[str]) -> Table:
    columns, line = _Columns(header, wanted), 2
    begin = data.find(b"\n") + 1
    while begin < len(data):
        end = data.find(b"\n", begin + _BYTES_AT_ONCE) + 1 or len(data)
        text = data[begin:end].decode("utf-8", errors="replace").replace("\r\n", "\n")
        fields = text.replace("\n", ",").split(",")[:-1]
        rows = len(fields) // len(header)
        columns.add({name: fields[i :: len(header)] for name, i in columns.place.items()}, range(line, line + rows))
        begin, line = end, line + rows
    return columns.table(path)


def _records(path: Path, data: bytes) -> Iterator[tuple[int, list[str]]]:
    """Line number and fields of each line that is not blank. Raises InputError."""
    reader = csv.reader(
        io.StringIO(data.decode("utf-8", errors="replace"), newline=""), skipinitialspace=True, strict=True
    )
    try:
        for fields in reader:
            if fields and (len(fields) > 1 or fields[0].strip()):
                yield reader.line_num, fields
    except csv.Error as error:
        raise InputError(
            f"{path}: line {reader.line_num}: expected a CSV table, got unbalanced quotes ({error})"
        ) from None


def _read_any(path: Path, data: bytes, header: tuple[str, ...], wanted: Sequence[str]) -> Table:
    """By the csv module. Raises InputError."""
    columns = _Columns(header, wanted)
    long_lines, short_lines = [], []
    records = _records(path, data)
    next(records)  # the header
    while piece := list(islice(records, _ROWS_AT_ONCE)):
        kept = []
        for line, fields in piece:
            extra = len(fields) - len(header)
            if extra > 0 and any(f.strip() for f in fields[len(header) :]):
                long_lines.append(line)
                continue
            if extra < 0:
                short_lines.append(line)
                fields = [*fields, *[""] * -extra]
            kept.append((line, fields))
        at = [line for line, _ in kept]
        columns.add({name: [fields[i] for _, fields in kept] for name, i in columns.place.items()}, at)
    return columns.table(path, long_lines, short_lines)


def _as_numbers(fields: list[str], lines: Sequence[int], texts: dict[int, str]) -> Array:
    """Numbers (n,), nan where a field is empty or not a number; `texts` gets the latter by line."""
    empty = fields.count("")
    try:
        numbers = map(float, fields) if not empty else (float(field or "nan") for field in fields)
        values = np.fromiter(numbers, float, len(fields))
        if np.count_nonzero(np.isnan(values)) == empty and "_" not in "".join(fields):
            return values
    except ValueError:
        values = np.full(len(fields), np.nan)
    for i, field in enumerate(fields):
        text = field.strip()
        try:
            values[i] = math.nan if "_" in text else float(text or "nan")
        except ValueError:
            values[i] = math.nan
        if text and math.isnan(values[i]) and len(texts) < _MAX_TEXTS:
            texts[lines[i]] = text
    return values


# Writing -------------------------------------------------------------------------------------------------------------


def csv_word(text: str) -> str:
    """A name as a CSV field, quoted where it contains a comma, a quote or a line break."""
    return '"' + text.replace('"', '""') + '"' if any(c in text for c in ',"\n\r') else text


def csv_text(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table as CSV text, quoted where needed."""
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(header)
    writer.writerows([_not_a_formula(field) for field in row] for row in rows)
    return out.getvalue()


def _not_a_formula(field: object) -> object:
    """A text that a spreadsheet would read as a formula, with an apostrophe in front; any other field as it is."""
    return f"'{field}" if isinstance(field, str) and is_formula(field) else field


def text_of_field(field: str) -> str:
    """What `csv_text` was given for a field: without the apostrophe that it puts in front of a formula."""
    return field[1:] if field.startswith("'") and is_formula(field[1:]) else field


def number_fields(values: Iterable[float]) -> list[str]:
    """Fields with ten significant digits, more than any measurement here has; empty for nan."""
    return ["" if v != v else f"{v:.10g}" for v in values]


def write_table(path: Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a CSV file, complete or not at all. Raises InputError."""
    atomic_write_text(csv_text(header, rows), path)


# A table of a CSV file in memory, and its errors with their line numbers.


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

    def finite_stack(self, *columns: str) -> Array:
        """(n, k): columns of finite numbers side by side. Raises InputError."""
        return np.stack([self.finite(column) for column in columns], axis=1)

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

    def rising(self, column: str) -> Ints:
        """A column (n,) of whole numbers, each larger than the one before. Raises InputError, with the line."""
        values = self.whole(column)
        for i in np.flatnonzero(np.diff(values) <= 0)[:1] + 1:
            remedy = f"sort the rows, and give each {column} once"
            raise self.error(i, f"{column}: expected rising numbers, got {values[i]} after {values[i - 1]}; {remedy}")
        return values

    def refuse_unknown(self, column: str, known: Collection[str], expected: str) -> None:
        """Raises InputError at the first name of a column that is not known. expected: `a camera of the rig`."""
        for code, word in enumerate(self.words[column].words):
            for i in np.flatnonzero(self.words[column].codes == code)[: word not in known]:
                near = suggest_name(word, known)
                raise self.error(i, f"{column}: expected {expected}, got {word!r}{near}"[:240])

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
