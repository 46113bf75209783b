"""Processes many runs one after the other: a result folder each, batch.csv and index.html."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lab.errors import QUALITY_GATE_FAILED, BeamposeError, CalibrationError, InputError, RunError
from lab.files.run.parameter_overrides import with_overrides
from lab.files.text.csv_text import write_table
from lab.runs.process import RunOutcome, process_run
from lab.runs.smoothing_pass import Progress
from tracking.parameters import TrackerParameters

COLUMNS = (
    "run", "name", "status", "exit_status", "frames", "measured_frames", "measured_share", "seconds", "results",
    "message",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class BatchOutcome:
    """The rows of batch.csv, and the files written."""

    rows: tuple[Mapping[str, Any], ...]
    table: Path
    index: Path

    @property
    def exit_status(self) -> int:
        """1 if a run could not be processed, 3 if its calibration is the only reason; else 4 or 0."""
        found = {row["exit_status"] for row in self.rows}
        failed = found - {0, QUALITY_GATE_FAILED}
        if failed:
            return CalibrationError.exit_status if failed == {CalibrationError.exit_status} else RunError.exit_status
        return QUALITY_GATE_FAILED if QUALITY_GATE_FAILED in found else 0


def process_batch(
    run_folders: Sequence[Path],
    out: Path,
    *,
    overrides: Mapping[str, Any] | None = None,
    causal: bool = False,
    report: Callable[[str], None] = lambda line: None,
    progress: Callable[[str], Progress | None] = lambda name: None,
) -> BatchOutcome:
    """Process runs into out/<name of the run folder>; a run that fails does not stop the others.

    overrides, causal: as for process_run. report: called with one line per run. progress: returns, for a run's name,
    the callback for its frames.

    Raises:
        InputError: the command as a whole cannot be carried out.
    """
    if not run_folders:
        raise InputError("batch: expected one or more run folders, got none")
    with_overrides(
        TrackerParameters(), overrides or {}
    )  # a misspelt parameter is the command's mistake, not each run's
    names = _names(run_folders)
    out = Path(out)
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: expected a folder for the results, found a file; choose another --out")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: the folder cannot be made: {error.strerror}") from None
    rows: list[dict[str, Any]] = []
    for folder, name in zip(run_folders, names, strict=True):
        try:
            outcome = process_run(folder, out / name, overrides=overrides, causal=causal, progress=progress(name))
            row = _row(folder, outcome)
            report(f"{name}: {row['status'].upper()}: {row['message']}")
        except BeamposeError as error:
            row = _failed(folder, name, error)
            report(f"{name}: ERROR: {row['message']}")
        rows.append(row)
        # After every run: if the next one is killed, the rows so far are kept.
        write_table(out / "batch.csv", COLUMNS, [[row[c] for c in COLUMNS] for row in rows])
    from lab.report.index.index import write_index

    index = write_index(rows, out)
    return BatchOutcome(tuple(rows), out / "batch.csv", index)


def _names(folders: Sequence[Path]) -> list[str]:
    """The name of each run's result folder: that of the run folder, with the parent's before it where two are equal."""
    resolved = [Path(f).resolve() for f in folders]
    twice = [str(f) for f, r in zip(folders, resolved, strict=True) if resolved.count(r) > 1]
    if twice:
        raise InputError(f"batch: the run folder {twice[0]} is given more than once")
    names = [r.name for r in resolved]
    return [
        f"{r.parent.name}-{r.name}-{i}" if names.count(r.name) > 1 else r.name for i, r in enumerate(resolved, start=1)
    ]


def _row(folder: Path, outcome: RunOutcome) -> dict[str, Any]:
    return {
        "run": str(folder),
        "name": outcome.name,
        "status": outcome.verdict.status,
        "exit_status": outcome.exit_status,
        "frames": outcome.frames,
        "measured_frames": outcome.measured,
        "measured_share": round(outcome.measured / outcome.frames, 6) if outcome.frames else 0.0,
        "seconds": round(outcome.seconds, 3),
        "results": outcome.out.name,
        "message": "; ".join(outcome.verdict.texts),
    }


def _failed(folder: Path, name: str, error: BeamposeError) -> dict[str, Any]:
    status = CalibrationError.exit_status if isinstance(error, CalibrationError) else error.exit_status
    return {
        "run": str(folder),
        "name": name,
        "status": "error",
        "exit_status": status,
        "frames": "",
        "measured_frames": "",
        "measured_share": "",
        "seconds": "",
        "results": "",
        "message": " | ".join(str(error).splitlines()),
    }
