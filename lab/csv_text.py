"""CSV tables in: the columns that must be there, numbers as numbers, and a plain line where that fails."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from geometry.arrays import Ints
from lab.errors import InputError
from lab.yaml_text import did_you_mean

if TYPE_CHECKING:
    import pandas as pd

WORDS = ("camera", "spot", "beam", "status", "point", "screen")  # every other column holds numbers
LARGEST_FRAME = 2**53  # beyond it a number read as float is no longer exact


def read_table(path: Path, required: Sequence[str], numbers: Sequence[str] | None = None) -> pd.DataFrame:
    """A CSV file with at least the required columns; further ones are kept.

    The columns `numbers` (all required ones that are no names, where not given) come as floats, with nan for a field
    that is empty or no number. Lines with too many fields are left out; `attrs["malformed"]` counts them.
    Raises InputError.
    """
    import pandas as pd  # 0.4 s: only for those who read a table

    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            table = pd.read_csv(
                path,
                encoding="utf-8-sig",
                encoding_errors="replace",
                skipinitialspace=True,
                index_col=False,
                keep_default_na=False,
                dtype=dict.fromkeys(WORDS, str),
                na_values={c: ["", "nan", "NaN", "NA"] for c in required if c not in WORDS},
                on_bad_lines="warn",
                low_memory=False,
            )
    except FileNotFoundError:
        raise InputError(f"{path}: expected a table, found no file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except pd.errors.EmptyDataError:
        raise InputError(f"{path}: expected columns {','.join(required)}, got an empty file") from None
    except (pd.errors.ParserError, ValueError) as error:
        raise InputError(f"{path}: expected a CSV table, got {str(error).splitlines()[0]}") from None
    table.columns = [str(c).strip() for c in table.columns]
    for name in required:
        if name not in table.columns:
            near = did_you_mean(name, table.columns)
            meant = f"{near.removesuffix('?')} in the header?" if "did you mean" in near else ""
            raise InputError(f"{path}: expected a column {name!r}, got {','.join(table.columns)}{meant}"[:300])
    twice = table.columns[table.columns.duplicated()]
    if len(twice):
        raise InputError(f"{path}: expected each column once, got {twice[0]!r} twice")
    for name in numbers if numbers is not None else [c for c in required if c not in WORDS]:
        if name in table.columns:
            table[name] = pd.to_numeric(table[name], errors="coerce").astype(float)
    table.attrs["malformed"] = sum(str(w.message).count("Skipping line") for w in caught)
    return table


def whole_numbers(table: pd.DataFrame, column: str, path: Path) -> Ints:
    """A column of frame numbers. Raises InputError, with the line, at the first field that is none."""
    values = table[column].to_numpy(dtype=float)
    bad = np.flatnonzero(~is_whole(values))
    if bad.size:
        raise InputError(f"{path}: line {bad[0] + 2}: {column}: expected a whole number, got {values[bad[0]]:g}")
    return values.astype(np.int64)


def is_whole(values: np.ndarray) -> np.ndarray:
    """Which floats (n,) are whole numbers that an integer can hold exactly."""
    with np.errstate(invalid="ignore"):
        return np.isfinite(values) & (np.abs(values) < LARGEST_FRAME) & (values == np.round(values))
