"""One run of a batch: skipped where results with the fingerprint of its inputs and settings exist, else processed.

Whatever happens, it has a row of batch.csv.
"""

from __future__ import annotations

import contextlib
import dataclasses
import glob
import hashlib
import json
import os
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

from lab.errors import BeamposeError, InputError, RunError
from lab.files.output.saved_traceback import unexpected_error
from lab.files.run.fingerprints import fingerprints
from lab.files.run.run_file import Run
from lab.files.text.atomic_write import atomic_write_text
from lab.files.text.json_text import bytes_of_file, plain_value, read_json
from lab.packages import versions
from lab.progress import heard
from lab.runs.process import process_run, ready_run
from lab.runs.run_log import NAME


def listed_runs(given: Sequence[str | os.PathLike[str]], lists: Sequence[str | os.PathLike[str]] = ()) -> list[Path]:
    """Run folders of the command line, in order.

    given: folders, patterns such as `data/*/run-*` (`**`: folders at any depth), or `@FILE`. lists: files of runs; `-`
    is standard input. A file names a folder or pattern per line; blank lines and lines with # at the start are ignored;
    paths start at the current folder. A folder that several patterns or lists find is processed once. Raises
    InputError: a folder is given more than once by name, a pattern finds no run, a list cannot be read.
    """
    out: dict[str, Path] = {}
    named: set[str] = set()
    for text in (os.fspath(g) for g in given):
        is_list = text.startswith("@") and len(text) > 1 and not os.path.exists(text)
        for folder in _of_file(text[1:]) if is_list else _of_argument(text):
            place = os.path.realpath(folder)
            by_name = not is_list and str(folder) == str(Path(text))
            if by_name and place in named:
                raise InputError(f"batch: the run folder {text} is given more than once")
            if by_name:
                named.add(place)
            out.setdefault(place, folder)
    for text in (os.fspath(g) for g in lists):
        for folder in _of_file(text):
            out.setdefault(os.path.realpath(folder), folder)
    if not out:
        raise InputError("batch: expected one or more run folders, got none")
    return list(out.values())


def _of_file(path: str) -> Iterator[Path]:
    try:
        data = sys.stdin.buffer.read() if path == "-" else bytes_of_file(Path(path))
    except OSError as error:
        raise InputError(f"{path}: expected a text file with a run folder per line: {error.strerror}") from None
    for number, line in enumerate(data.removeprefix(b"\xef\xbb\xbf").splitlines(), start=1):
        text = os.fsdecode(line).strip()
        if "\0" in text:
            raise InputError(f"{path}: line {number}: expected a run folder, got a line with a null byte")
        if text and not text.startswith("#"):
            yield from _of_argument(text)


def _of_argument(text: str) -> list[Path]:
    """The folder, or the run folders that a pattern finds, sorted."""
    if not glob.has_magic(text) or os.path.lexists(text):
        return [Path(text)]
    found = [Path(p) for p in sorted(glob.glob(text, recursive=True)) if os.path.isfile(os.path.join(p, "run.yaml"))]
    if not found:
        raise InputError(f"batch: {text}: no folder with a run.yaml matches this pattern")
    return found


def shard_of(text: str) -> tuple[int, int]:
    """`2/5` as (2, 5): the second of five parts. Raises InputError."""
    number, slash, count = text.partition("/")
    if not (slash and number.isascii() and number.isdigit() and count.isascii() and count.isdigit()):
        raise InputError(f"--shard: expected I/N, such as 2/5 for the second of five parts, got {text!r}")
    if len(count) > 9 or not 1 <= int(number) <= int(count):
        raise InputError(f"--shard: expected I/N with I from 1 to N, got {text!r}")
    return int(number), int(count)


# The result folder of every run of a batch. It stays the same in later batches into the same folder.


FILE_NAME = ".batch-folders.json"
SCHEMA = "beampose/batch-folders/1"
RESERVED = ("batch.csv", "index.html", "errors", "parquet")  # names in the batch's folder that no run may have


def displayed(path: str | os.PathLike[str]) -> str:
    """A path as printable UTF-8 text; other bytes and control characters as `\\xe9`."""
    text = os.fsencode(path).decode("utf-8", "backslashreplace")
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def allotted(out: Path, folders: Sequence[Path], resumable: Mapping[str, str]) -> list[str]:
    """The name of the result folder in `out` for each run folder; recorded in `out`. To be called under the lock.

    It is the name of the run folder, with that of its parent where two runs of the batch have one name, and with a
    digest of its place where another run has that name already. A run that has a result folder keeps it. resumable:
    result folders by run folder, of runs that have been moved: the run takes over the results. Raises InputError: the
    record is damaged or cannot be written.
    """
    record = _read(out / FILE_NAME)
    owners = {name.casefold(): place for place, name in record.items()}
    places = [displayed(os.path.realpath(f)) for f in folders]
    simple = [_simple(p) for p in folders]
    names = []
    for place, folder, name in zip(places, folders, simple, strict=True):
        if place not in record and place in resumable:
            taken = resumable[place]
            record = {p: n for p, n in record.items() if n != taken}
            record[place], owners[taken.casefold()] = taken, place
        if place not in record:
            parent = _simple(Path(os.path.realpath(folder)).parent)
            digest = hashlib.sha256(place.encode()).hexdigest()[:8]
            choices = [f"{parent}-{name}", f"{name}-{digest}", f"{name}-{digest}-2"]
            if simple.count(name) == 1:
                choices.insert(0, name)
            record[place] = next(c for c in choices if c.casefold() not in owners and c not in RESERVED)
            owners[record[place].casefold()] = place
        names.append(record[place])
    atomic_write_text(json.dumps({"schema": SCHEMA, "folders": record}, indent=1) + "\n", out / FILE_NAME)
    return names


def moved_runs(out: Path, folders: Sequence[Path]) -> dict[str, tuple[Path, str]]:
    """Runs without a result folder, where one of the same name belongs to a run folder that is gone.

    Returns the run folder and the name of the results, by place.
    """
    record = _read(out / FILE_NAME)
    gone = {name: place for place, name in record.items() if not os.path.isdir(place)}
    found = {}
    for folder in folders:
        place, name = displayed(os.path.realpath(folder)), _simple(folder)
        if place not in record and name in gone:
            found[place] = (folder, name)
    return found


def _simple(folder: Path) -> str:
    """The folder's own name, such that every file system and table can hold it."""
    name = os.fsencode(os.path.basename(os.path.realpath(folder))).decode("utf-8", "replace").replace("\ufffd", "_")
    return "".join(c if c.isprintable() else "_" for c in name) or "run"


def _read(path: Path) -> dict[str, str]:
    try:
        content = read_json(path)
        folders = content["folders"]
        if content["schema"] != SCHEMA or not all(isinstance(v, str) for v in folders.values()):
            raise ValueError
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InputError(f"{path}: expected the result folders of a batch, found another file; delete it") from None
    return dict(folders)


_RESULTS = ("attitude.csv", "spots.csv", "report.html")  # beside summary.json
_PROGRAM = ("geometry", "tracking", "calibration", "lab")


def fingerprint_of(run: Run, causal: bool, full: bool = False) -> str:
    """SHA-256 of all that a run's results depend on, as hexadecimal digits.

    These are the contents of its inputs, the resolved parameters, the calibration, the versions, and the sources of
    the program. Places and times of files are not part of it. full: large files are read completely, not sampled.
    """
    content = {
        "schema": "beampose/run-fingerprint/1",
        "name": run.name,
        "inputs": [[entry["sha256"], entry["bytes"]] for entry in fingerprints(run, full)],
        "cameras": {name: type(source).__name__ for name, source in run.cameras.items()},
        "tracker": dataclasses.asdict(run.tracker),
        "causal": causal,
        "calibration": None if run.calibration is None else run.calibration.as_mapping(),
        "versions": versions(),
        "program": program_digest(),
    }
    return hashlib.sha256(json.dumps(plain_value(content), sort_keys=True, default=str).encode()).hexdigest()


@cache
def program_digest() -> str:
    """SHA-256 of the program's sources and templates: a version in development has no number of its own."""
    root = Path(__file__).resolve().parents[3]
    digest = hashlib.sha256()
    for package in _PROGRAM:
        for file in sorted((root / package).rglob("*")):
            if file.suffix in (".py", ".j2", ".css", ".js") and file.is_file():
                digest.update(f"{file.relative_to(root).as_posix()}\0".encode() + file.read_bytes())
    return digest.hexdigest()


def finished_summary(results: Path, fingerprint: str) -> dict[str, Any] | None:
    """summary.json of complete results that have this fingerprint; None where there are none."""
    try:
        summary = read_json(results / "summary.json")
    except (OSError, ValueError):
        return None
    if not isinstance(summary, dict) or summary.get("fingerprint") != fingerprint:
        return None
    return summary if all((results / name).is_file() for name in _RESULTS) else None


COLUMNS = (
    "run", "name", "folder", "status", "exit_status", "frames", "measured_frames", "measured_share", "seconds",
    "results", "message", "report",
)  # fmt: skip
REPORT = "report.html"  # in a result folder


@dataclass(frozen=True, slots=True)
class Task:
    """One run to process. It can be sent to another process."""

    folder: Path  # of the run
    out: Path  # of the batch
    results: str  # name of the result folder in `out`
    overrides: Mapping[str, Any] = field(default_factory=dict)
    causal: bool = False
    force: bool = False  # process although results exist
    full_hash: bool = False
    provenance: Mapping[str, Any] = field(default_factory=dict)  # added to summary.json

    @property
    def place(self) -> str:
        """The run folder without links, which identifies the run in batch.csv."""
        return displayed(os.path.realpath(self.folder))

    @property
    def error_file(self) -> Path:
        """Where the traceback of an unforeseen error is saved."""
        return self.out / "errors" / f"{self.results}.txt"

    @property
    def error_report(self) -> Path:
        """The report of a run that ended with an error. Its result folder keeps earlier results."""
        return self.error_file.with_suffix(".html")


@dataclass(frozen=True, slots=True)
class TaskOutcome:
    """The row of batch.csv, and whether the results of an earlier batch are used."""

    row: dict[str, Any]
    skipped: bool = False
    code: str = ""  # of the error, for `beampose explain`
    log: tuple[str, ...] = ()  # the lines of the run's log


def perform(task: Task) -> TaskOutcome:
    """Process a run, or use its earlier results. Any error becomes the row of the run."""
    log: list[str] = []
    with heard(NAME, log.append):
        try:
            outcome = _processed(task)
        except BeamposeError as error:
            outcome = TaskOutcome(failed_row(task, str(error), error.exit_status), code=error.code)
        except Exception as error:  # unforeseen: it must not stop the other runs
            words, _, _ = unexpected_error(error, task.error_file).partition("\n")
            outcome = TaskOutcome(failed_row(task, words), code=RunError.code)
    return dataclasses.replace(outcome, log=tuple(log))


def _processed(task: Task) -> TaskOutcome:
    """The outcome of a run that can be processed, or has been. Raises as `process_run`."""
    started, results = time.perf_counter(), task.out / task.results
    run = ready_run(task.folder, task.overrides)
    value = fingerprint_of(run, task.causal, task.full_hash)
    earlier = None if task.force else finished_summary(results, value)
    if earlier is not None:
        try:
            return TaskOutcome(_row(task, earlier), skipped=True)
        except (KeyError, TypeError, AttributeError, ValueError):
            raise RunError("summary.json of the earlier results is damaged; delete the folder") from None
    done = process_run(run, results, causal=task.causal, more={**task.provenance, "fingerprint": value})
    return TaskOutcome({**_row(task, done.summary), "seconds": round(time.perf_counter() - started, 3)})


def failed_row(task: Task, message: str, exit_status: int = RunError.exit_status) -> dict[str, Any]:
    """The row of a run without results."""
    row: dict[str, Any] = dict.fromkeys(COLUMNS, "")
    return row | {
        "run": displayed(task.folder),
        "name": displayed(os.path.basename(os.path.realpath(task.folder))),
        "folder": task.place,
        "status": "error",
        "exit_status": exit_status,
        "message": _as_text(" | ".join(message.splitlines())),
    }


def _row(task: Task, summary: Mapping[str, Any]) -> dict[str, Any]:
    """The row of a run with results."""
    verdict, counts = summary["verdict"], summary["counts"]
    frames, measured = int(counts["frames"]), int(counts["pose_status"].get("measured", 0))
    return {
        "run": displayed(task.folder),
        "name": _as_text(str(summary["name"])),
        "folder": task.place,
        "status": str(verdict["status"]),
        "exit_status": int(verdict["exit_status"]),
        "frames": frames,
        "measured_frames": measured,
        "measured_share": round(measured / frames, 6) if frames else 0.0,
        "seconds": round(float(summary["timings"]["wall_s"]), 3),
        "results": task.results,
        "message": _as_text("; ".join(verdict["reasons"])),
        "report": f"{task.results}/{REPORT}",
    }


def _as_text(text: str) -> str:
    """Text that UTF-8 can hold."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def concluded(task: Task, outcome: TaskOutcome) -> TaskOutcome:
    """The outcome with its report: that of a failure is written here, and that of an earlier failure is removed."""
    if outcome.row["status"] != "error":
        _remove_error_files(task)
        return outcome
    from lab.report.page import Failure, write_failure_report  # imports the template engine

    row, saved = outcome.row, task.error_file
    failure = Failure(
        name=row["name"],
        message=row["message"],
        run_folder=row["run"],
        code=outcome.code or RunError.code,
        exit_status=row["exit_status"],
        log=outcome.log,
        traceback=quote(os.fsencode(saved.name)) if str(saved) in row["message"] else "",
        earlier=(task.out / task.results / REPORT).is_file(),
    )
    try:
        saved.parent.mkdir(parents=True, exist_ok=True)
        write_failure_report(task.error_report, failure)
    except (OSError, BeamposeError):  # a full disk: the row has the message
        return outcome
    report = f"{saved.parent.name}/{task.error_report.name}"
    return dataclasses.replace(outcome, row={**row, "report": report})


def _remove_error_files(task: Task) -> None:
    """The traceback and the report of an earlier attempt, and the folder where they were the last."""
    with contextlib.suppress(OSError):
        task.error_report.unlink(missing_ok=True)
        task.error_file.unlink(missing_ok=True)
        task.error_file.parent.rmdir()
