"""batch.csv and index.html: the rows of all batches into one folder, merged under a lock."""

from __future__ import annotations

import contextlib
import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import filelock

from lab.errors import InputError
from lab.files.text.csv_text import text_of_field, write_table
from lab.files.text.regular_file import text_of_file
from lab.runs.batch.task import COLUMNS

LOCK_SECONDS = 120.0  # the lock is held for milliseconds: longer waiting means a broken file system
FILE_NAME, LOCK_NAME = "batch.csv", ".batch.lock"


@contextlib.contextmanager
def locked(out: Path) -> Iterator[None]:
    """Only one process at a time is in this block for a batch's folder.

    Raises:
        InputError: the lock cannot be had.
    """
    lock = filelock.FileLock(out / LOCK_NAME, timeout=LOCK_SECONDS)
    try:
        lock.acquire()
    except filelock.Timeout:
        raise InputError(f"{out / LOCK_NAME}: another program has locked this file for {LOCK_SECONDS:.0f} s") from None
    except (OSError, NotImplementedError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{out / LOCK_NAME}: cannot be locked: {reason}; choose another --out") from None
    try:
        yield
    finally:
        lock.release()


class BatchTable:
    """The table of a folder of batches; `add` puts rows of this batch into it, and rows of other batches stay."""

    def __init__(self, out: Path, places: Sequence[str]) -> None:
        """places: the `folder` of each run of this batch, in order. Raises InputError: batch.csv is another table."""
        self.path = out / FILE_NAME
        self._out, self._order = out, {place: i for i, place in enumerate(places)}
        self._own: dict[str, Mapping[str, Any]] = {}  # rows of this batch that are not yet in the file
        self._skipped: set[str] = set()
        read_rows(self.path)

    def add(self, row: Mapping[str, Any], skipped: bool = False) -> None:
        """Remember a row of this batch for the next `write`. skipped: it was made from earlier results."""
        self._own[row["folder"]] = row
        if skipped:
            self._skipped.add(row["folder"])

    def write(self, index: bool = False) -> None:
        """Merge the rows added since into batch.csv, and with `index` write index.html.

        Raises:
            InputError: a file cannot be written. The rows are kept for the next attempt.
        """
        with locked(self._out):
            there = read_rows(self.path)
            for row in there:  # the time of the processing is better known than from the results
                own = self._own.get(row["folder"])
                if own and row["folder"] in self._skipped and row["results"] == own["results"] and row.get("seconds"):
                    self._own[row["folder"]] = {**own, "seconds": row["seconds"]}
            rows = merged(there, self._own, self._order)
            extra = [c for c in dict.fromkeys(c for row in rows for c in row) if c not in COLUMNS]
            header = [*COLUMNS, *extra]
            write_table(self.path, header, [[row.get(c, "") for c in header] for row in rows])
            self._own.clear()
            if index:
                from lab.report.index.index import write_index

                write_index([dict(row) for row in rows], self._out)


def merged(
    there: Sequence[Mapping[str, Any]], own: Mapping[str, Mapping[str, Any]], order: Mapping[str, int]
) -> list[Mapping[str, Any]]:
    """Rows of a table with this batch's rows in place of older ones; new ones at the end.

    The rows of this batch's runs are in the order of its runs, whatever the order in which they ended. A row whose
    results another run has taken over is dropped.
    """
    taken = {row["results"]: place for place, row in own.items() if row["results"]}
    rows: dict[str, Mapping[str, Any]] = {
        row["folder"]: row for row in there if taken.get(row["results"], row["folder"]) == row["folder"]
    }
    rows |= {place: {**rows.get(place, {}), **row} for place, row in own.items()}
    in_order = iter(sorted((p for p in rows if p in order), key=order.__getitem__))
    return [rows[next(in_order) if place in order else place] for place in rows]


def read_rows(path: Path) -> list[dict[str, str]]:
    """The rows of batch.csv; none where there is no such file. Rows of older versions get their `folder`.

    Raises:
        InputError: the file is not a table of a batch.
    """
    try:
        text = text_of_file(path)
        rows = list(csv.DictReader(io.StringIO(text, newline=""), restval="", strict=True))
    except FileNotFoundError:
        return []
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, csv.Error):
        rows = [{}]
    for row in rows:
        row.pop(None, None)  # fields beyond the header
        if not {"run", "status", "results"} <= set(row):
            raise InputError(
                f"{path}: expected the table of a batch, found another file; move it or choose another --out"
            )
        row.update({name: text_of_field(field) for name, field in row.items() if isinstance(field, str)})
        row["folder"] = row.get("folder") or str(Path(row["run"]).absolute())
    return rows
