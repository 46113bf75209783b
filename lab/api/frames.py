"""Tables of results as pandas frames, with the names of the CSV files, which contain the units."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pandas as pd

from lab.files.run.results import read_result_table
from lab.files.text.csv_table import Categorical, Table

WHOLE = ("frame", "spots_used")  # columns of whole numbers


def read_frame(path: Path, names: Iterable[str], optional: Iterable[str] = ()) -> pd.DataFrame:
    """A CSV file of results: numbers are float64, frame numbers int64, names and statuses categories.

    Columns that an older file does not have are nan. Raises InputError.
    """
    names, optional = list(names), list(optional)
    table = read_result_table(path, [n for n in names if n not in optional], optional)
    return frame_of(table, names)


def frame_of(table: Table, names: Iterable[str]) -> pd.DataFrame:
    """The named columns of a table."""
    return pd.DataFrame({name: _column(table, name) for name in names})


def _column(table: Table, name: str) -> object:
    if name in table.words:
        return category(table.words[name])
    values = table.numbers[name]
    return values.astype(np.int64) if name in WHOLE and np.isfinite(values).all() else values


def category(column: Categorical) -> pd.Categorical[str]:
    """A column of words as categories, in the order in which the file names them."""
    return pd.Categorical.from_codes(column.codes, categories=pd.Index(column.words, dtype=str))
