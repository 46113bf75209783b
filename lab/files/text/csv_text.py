"""CSV tables in: the columns that must be there, numbers as numbers, and a plain line where that fails."""

from __future__ import annotations

import csv
import io
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from geometry.arrays import Array, Ints
from lab.errors import InputError
from lab.files.text.yaml_text import did_you_mean, shown

if TYPE_CHECKING:
    import pandas as pd

WORDS = ("camera", "spot", "beam", "status", "point", "screen")  # every other column holds numbers
LARGEST_FRAME = 2**53  # beyond it a number read as float is no longer exact
_TEXTS_KEPT = 1000  # per column, of fields that should be numbers and are none


def read_table(
    path: Path, required: Sequence[str], numbers: Sequence[str] | None = None, damaged: bool = False
) -> pd.DataFrame:
    """A CSV file with at least the required columns; further ones are kept.

    The columns `numbers` (all required ones that are no names, where not given) come as floats, with nan for a field
    that is empty or no number; `numbers_in` and `found_at` tell the two apart. Lines with too many fields are left out;
    `attrs["malformed"]` counts them. damaged: bytes that are no text are let through, for those who leave out single
    rows. Raises InputError.
    """
    import pandas as pd  # 0.4 s: only for those who read a table

    data = table_bytes(path, required, damaged)
    check_header(path, header_of(data), required)
    wanted = numbers if numbers is not None else [c for c in required if c not in WORDS]
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            table = pd.read_csv(
                io.BytesIO(data),
                encoding="utf-8-sig",
                encoding_errors="replace",
                skipinitialspace=True,
                index_col=False,
                keep_default_na=False,
                dtype=dict.fromkeys(WORDS, str),
                na_values={c: [""] for c in wanted},
                on_bad_lines="warn",
                low_memory=False,
            )
    except (pd.errors.ParserError, ValueError) as error:
        raise InputError(f"{path}: expected a CSV table, got {str(error).splitlines()[0]}") from None
    table.columns = [str(c).strip() for c in table.columns]
    texts = {}
    for name in wanted:
        if name in table.columns:
            table[name], texts[name] = _as_numbers(table[name])
    table.attrs["texts"] = texts
    table.attrs["malformed"] = sum(str(w.message).count("Skipping line") for w in caught)
    return table


def table_bytes(path: Path, required: Sequence[str], damaged: bool = False) -> bytes:
    """The content of a table, UTF-8 text with a line or more. Raises InputError."""
    try:
        data = Path(path).read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: expected a table with columns {','.join(required)}, found no file") from None
    except IsADirectoryError:
        raise InputError(f"{path}: expected a table, found a folder; name the CSV file in it") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    remedy = "save it as CSV, comma-separated, in UTF-8"
    if data[:2] in (b"\xff\xfe", b"\xfe\xff") or b"\0" in data[:4096]:
        raise InputError(f"{path}: expected a CSV table, got a file that is not text in UTF-8; {remedy}")
    if not data.removeprefix(b"\xef\xbb\xbf").strip():
        raise InputError(f"{path}: expected columns {','.join(required)}, got an empty file")
    if not damaged:
        try:
            data.decode("utf-8")
        except UnicodeDecodeError as error:
            line = data.count(b"\n", 0, error.start) + 1
            raise InputError(
                f"{path}: line {line}: expected text in UTF-8, got a byte that is none; {remedy}"
            ) from None
    return data


def header_of(data: bytes) -> str:
    """The first line of a table that is not blank."""
    lines = data[: 1 << 16].decode("utf-8-sig", errors="replace").splitlines()
    return next((line for line in lines if line.strip()), "")


def check_header(path: Path, line: str, required: Sequence[str]) -> None:
    """Raises InputError unless a header names each required column, and none twice."""
    header = [c.strip() for c in next(csv.reader([line], skipinitialspace=True), [])]
    for other, word in ((";", "semicolons"), ("\t", "tabs")):
        if line.count(other) > line.count(",") and not set(required) <= set(header):
            raise InputError(
                f"{path}: expected columns separated by commas, got {word}; separate columns with commas, and write"
                " decimals with a point"
            )
    for name in required:
        if name not in header:
            near = did_you_mean(name, header)
            meant = f"{near.removesuffix('?')} in the header?" if "did you mean" in near else ""
            raise InputError(f"{path}: expected a column {name!r}, got {shown_line(','.join(header))}{meant}")
    twice = [name for i, name in enumerate(header) if name and name in header[:i]]
    if twice:
        raise InputError(
            f"{path}: expected each column once, got {twice[0]!r} twice in the header; rename or remove one"
        )


def shown_line(line: str) -> str:
    """A line of a file as an error shows it: short, and no control characters on the terminal."""
    text = "".join(c if c.isprintable() else "?" for c in line)
    return text if len(text) <= 150 else f"{text[:146]} ..."


def _as_numbers(column: pd.Series) -> tuple[Array, dict[int, str]]:
    """Numbers, nan where there is none; and by row what stands there instead, where the field is not empty."""
    import pandas as pd

    if pd.api.types.is_bool_dtype(column):
        column = column.astype(str)
    values = pd.to_numeric(column, errors="coerce").to_numpy(dtype=float)
    if pd.api.types.is_numeric_dtype(column):
        return values, {}
    none = np.flatnonzero(np.isnan(values) & column.notna().to_numpy())
    texts = {int(i): str(column.iloc[i]).strip() for i in none[:_TEXTS_KEPT]}
    return values, {i: text for i, text in texts.items() if text}


def found_at(table: pd.DataFrame, column: str, i: int) -> str:
    """What stands in a number's place in row i, as an error shows it."""
    text = table.attrs["texts"].get(column, {}).get(int(table.index[i]))
    if text is not None:
        return shown(text)
    value = float(table[column].iloc[i])
    return "nothing" if np.isnan(value) else f"{value:.7g}"


def line_of(table: pd.DataFrame, i: int) -> int:
    """The line of the file in which row i stands, rows left out since it was read or not."""
    return int(table.index[i]) + 2


def numbers_in(
    table: pd.DataFrame, column: str, path: Path, expected: str = "a number", may_be_empty: bool = False
) -> Array:
    """A column (n,) of finite numbers; nan for fields that are empty, where they may be.

    Raises InputError, with line and text, at the first field that is anything else.
    """
    values = table[column].to_numpy(dtype=float)
    for i in np.flatnonzero(~np.isfinite(values)).tolist():
        found = found_at(table, column, i)
        if found != "nothing" or not may_be_empty:
            remedy = "; leave the field empty where it is not known" if may_be_empty else ""
            raise InputError(f"{path}: line {line_of(table, i)}: {column}: expected {expected}, got {found}{remedy}")
    return values


def whole_numbers(table: pd.DataFrame, column: str, path: Path) -> Ints:
    """A column of frame numbers. Raises InputError, with the line, at the first field that is none."""
    values = table[column].to_numpy(dtype=float)
    bad = np.flatnonzero(~is_whole(values))
    if bad.size:
        found = found_at(table, column, bad[0])
        raise InputError(f"{path}: line {line_of(table, bad[0])}: {column}: expected a whole number, got {found}")
    return values.astype(np.int64)


def is_whole(values: np.ndarray) -> np.ndarray:
    """Which floats (n,) are whole numbers that an integer can hold exactly."""
    with np.errstate(invalid="ignore"):
        return np.isfinite(values) & (np.abs(values) < LARGEST_FRAME) & (values == np.round(values))
