"""The tables of all runs of a batch as Parquet data sets: a file per run, with the run's result folder as a column."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from lab.errors import InputError
from lab.files.text.csv_text import WORD_COLUMNS
from lab.files.text.json_text import read_json
from lab.files.text.regular_file import require_regular_file

FOLDER = "parquet"
TABLES = ("attitude", "spots")


def require_pyarrow() -> None:
    """Raises InputError where pyarrow is not installed: to be called before long work."""
    try:
        import pyarrow  # noqa: F401
    except ImportError:
        raise InputError(
            "--parquet: expected the package pyarrow (the extra `parquet`), which is not installed: pip install pyarrow"
        ) from None


def update_data_sets(rows: Iterable[Mapping[str, Any]], out: Path) -> Path:
    """Write out/parquet/attitude/ and out/parquet/spots/, a file per run; returns out/parquet.

    rows: of batch.csv. A file that was made from the same results stays; that of a run without results is removed.
    `frame` is an integer, names and statuses are text, all other columns are numbers, null where the table is empty.

    Raises:
        InputError: pyarrow is not installed, a table of the results is damaged, or a file cannot be written.
    """
    require_pyarrow()
    root = Path(out) / FOLDER
    kept: dict[str, set[str]] = {name: set() for name in TABLES}
    try:
        for row in rows:
            if not row["results"]:
                continue
            results = Path(out) / row["results"]
            for name in TABLES:
                file = root / name / f"{row['results']}.parquet"
                kept[name].add(file.name)
                _update(results, name, file)
        for name in TABLES:
            for file in (root / name).glob("*.parquet"):
                if file.name not in kept[name]:
                    file.unlink()
    except OSError as error:
        raise InputError(f"{error.filename or root}: cannot be written: {error.strerror}") from None
    return root


def _update(results: Path, name: str, file: Path) -> None:
    import pyarrow as pa
    from pyarrow import csv, parquet

    source = results / f"{name}.csv"
    made_from = _identity(results, source)
    if file.is_file():
        try:
            if (parquet.read_schema(file).metadata or {}).get(b"made_from") == made_from:
                return
        except (pa.ArrowException, OSError):
            pass  # a damaged file is written again
    require_regular_file(source)
    try:
        with source.open(encoding="utf-8") as text:
            header = text.readline().strip().split(",")
        types = {c: pa.int64() if c == "frame" else pa.string() if c in WORD_COLUMNS else pa.float64() for c in header}
        table = csv.read_csv(source, convert_options=csv.ConvertOptions(column_types=types, null_values=["", "nan"]))
    except (pa.ArrowException, ValueError) as error:
        reason = (str(error).splitlines() or [""])[0]
        raise InputError(f"{source}: expected a table of results, got another file: {reason}") from None
    run = pa.array([results.name] * len(table)).dictionary_encode()
    table = table.add_column(0, "run", run).replace_schema_metadata({b"made_from": made_from})
    file.parent.mkdir(parents=True, exist_ok=True)
    handle, part = tempfile.mkstemp(dir=file.parent, prefix=".", suffix=".part")
    os.close(handle)
    try:
        parquet.write_table(table, part)
        os.chmod(part, 0o666 & ~_umask())
        os.replace(part, file)
    except BaseException:
        Path(part).unlink(missing_ok=True)
        raise


def _identity(results: Path, source: Path) -> bytes:
    """Identifies the contents of a table: the fingerprint of its run, its size and time."""
    try:
        fingerprint = read_json(results / "summary.json").get("fingerprint")
    except (ValueError, AttributeError):
        fingerprint = None
    state = source.stat()
    return f"{fingerprint} {state.st_size} {state.st_mtime_ns}".encode()


def _umask() -> int:
    mask = os.umask(0o022)
    os.umask(mask)
    return mask
