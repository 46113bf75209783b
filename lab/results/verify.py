"""`beampose verify`: a result computed again from its recorded inputs, and the differences."""

from __future__ import annotations

import csv
import dataclasses
import filecmp
import itertools
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pydantic

from lab.errors import QUALITY_GATE_FAILED, InputError
from lab.files.run.fingerprints import fingerprints
from lab.files.run.results import ResultFolder
from lab.files.run.run_file import LiveDevice, Run
from lab.files.text.dataclass_fields import dataclass_from_yaml
from lab.findings.finding import Done
from lab.packages import versions
from lab.progress import Progress
from lab.runs.frames.pipeline import Pipeline
from lab.runs.process import write_tables
from lab.runs.smoothing_pass import TrackingAndSmoothing
from tracking.parameters import TrackerParameters

# What summary.json records of how a result was made, and whether its inputs are still the same.


class _Input(pydantic.BaseModel):
    path: str
    sha256: str
    bytes: int
    covers: str = ""


class _Parameters(pydantic.BaseModel):
    tracker: dict[str, Any]


class _Summary(pydantic.BaseModel):
    run_folder: str
    attitude: str
    parameters: _Parameters
    versions: dict[str, str] = {}
    inputs: list[_Input] = []


@dataclass(frozen=True, slots=True)
class Recorded:
    """How a result was made."""

    causal: bool
    tracker: TrackerParameters
    versions: Mapping[str, str]
    inputs: tuple[_Input, ...]


@dataclass(frozen=True, slots=True)
class InputsNow:
    """The inputs of today against the recorded ones, in words."""

    changed: tuple[str, ...]
    not_compared: tuple[str, ...]
    same: int


def read_recorded(results: Path) -> Recorded:
    """How the result in a folder was made.

    Raises InputError: the folder holds no results of a run, or summary.json lacks what is needed.
    """
    content, path = ResultFolder.of_run(results).summary, Path(results) / "summary.json"
    try:
        summary = _Summary.model_validate(content)
    except pydantic.ValidationError as error:
        field = ".".join(str(part) for part in error.errors()[0]["loc"])
        raise InputError(f"{path}: {field}: expected what a run records there; process the run again") from None
    tracker = dataclass_from_yaml(TrackerParameters, summary.parameters.tracker, path, "parameters.tracker")
    causal = summary.attitude == "causal"
    return Recorded(causal, tracker, summary.versions, tuple(summary.inputs))


def other_versions(recorded: Recorded) -> list[str]:
    """The versions that differ from the recorded ones: `numpy 2.1.0, now 2.2.0`."""
    now = versions()
    return [
        f"{name} {recorded.versions.get(name, 'unknown')}, now {version}"
        for name, version in now.items()
        if recorded.versions.get(name) != version
    ]


def compare_inputs(recorded: Recorded, run: Run) -> InputsNow:
    """Compare the fingerprints of a run's inputs with the recorded ones.

    Files are matched by name (of equal names, in order), since a run folder may have moved. A file that has no recorded
    fingerprint, or one of another part of the file than today's, cannot be compared.
    """
    current = _by_name(fingerprints(run))
    old_ones = _by_name([old.model_dump() for old in recorded.inputs])
    full: dict[tuple[str, int], dict[str, Any]] | None = None
    changed = [f"{old['path']}: was an input, is none now" for key, old in old_ones.items() if key not in current]
    not_compared, same = [], 0
    for key, now in current.items():
        old = old_ones.get(key)
        if old is None:
            not_compared.append(f"{now['path']}: no fingerprint was recorded")
            continue
        if old["covers"] != now["covers"]:
            full = _by_name(fingerprints(run, full=True)) if full is None else full
            now = full[key]
        if old["covers"] != now["covers"] and old["bytes"] == now["bytes"]:
            not_compared.append(f"{now['path']}: the recorded fingerprint covers {old['covers'] or 'an unknown part'}")
        elif (old["sha256"], old["bytes"]) != (now["sha256"], now["bytes"]):
            size = f", {old['bytes']} bytes, now {now['bytes']}" if old["bytes"] != now["bytes"] else ""
            changed.append(f"{now['path']}: other contents{size}")
        else:
            same += 1
    return InputsNow(tuple(changed), tuple(not_compared), same)


def _by_name(entries: Sequence[dict[str, Any]]) -> dict[tuple[str, int], dict[str, Any]]:
    """Entries by name of file and number among those of that name."""
    names = [Path(e["path"]).name for e in entries]
    return {(name, names[:i].count(name)): e for i, (name, e) in enumerate(zip(names, entries, strict=True))}


# Where two tables differ: file, row and column.


MOST_SHOWN = 60  # characters of a field in a message


def difference_of(recorded: Path, computed: Path) -> str | None:
    """The table and its first difference, with the number of rows that differ; None for the same bytes."""
    name = recorded.name
    if not recorded.is_file() or not computed.is_file():
        which = "is missing in the results" if computed.is_file() else "is in the results, but is not computed any more"
        return f"{name}: {which}"
    if filecmp.cmp(recorded, computed, shallow=False):
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
    return f"{name}: {first} ({counted}{length})"


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


# Computes a result again and compares all its tables byte by byte.


# Tables that a run writes under some conditions only: in the results but not computed, they are a difference.
_OPTIONAL = ("systematic.csv", "budget.csv", "attitude_causal.csv", "covariance_causal.csv")
_NEW = ("budget.csv",)  # that earlier versions did not write


@dataclass(frozen=True, slots=True)
class Verification:
    """The outcome of a verification."""

    results: Path
    inputs: InputsNow
    versions: tuple[str, ...]  # those that differ
    tables: tuple[str, ...]  # compared
    differences: tuple[str, ...]

    @property
    def identical(self) -> bool:
        """Whether inputs and tables are the recorded ones."""
        return not self.differences and not self.inputs.changed

    def lines(self) -> list[str]:
        """The outcome for the terminal."""
        same = len(self.tables) - len(self.differences)
        word = "SAME" if self.identical else "DIFFERENT"
        out = [
            f"{word}: {same} of {len(self.tables)} tables of {self.results} are identical; {self.inputs.same} inputs"
            " unchanged"
        ]
        out += [f"  input changed: {text}" for text in self.inputs.changed]
        out += [f"  {difference}" for difference in self.differences]
        out += [f"  not compared: {text}" for text in self.inputs.not_compared]
        out += [f"  other version: {text}" for text in self.versions]
        return out


def verify(results: Path, run_folder: Path | None = None, progress: Progress | None = None) -> Done[Verification]:
    """Compute the tables of a result folder again, from its recorded run folder, settings and parameters.

    run_folder: where the run is now, if it has moved. The expiry of the calibration plays no part, since the result was
    made while it was valid. Raises InputError: the results or their inputs cannot be read.
    """
    results = Path(results)
    recorded = read_recorded(results)
    run = dataclasses.replace(ResultFolder(results, run_folder).run(), tracker=recorded.tracker)
    if any(isinstance(source, LiveDevice) for source in run.cameras.values()):
        raise InputError(f"{run.path}: expected recorded pictures or points, found a live camera: nothing to verify")
    inputs = compare_inputs(recorded, run)
    with tempfile.TemporaryDirectory(prefix="beampose-verify-") as name:
        work = Path(name)
        passes = TrackingAndSmoothing.of(Pipeline.of(run), work, progress)
        write_tables(passes, work, causal=recorded.causal)
        missing = {name for name in _NEW if not (results / name).is_file()}
        computed = {p.name for p in work.glob("*.csv")} - missing
        tables = sorted(computed | {n for n in _OPTIONAL if (results / n).is_file()})
        found = [difference_of(results / table, work / table) for table in tables]
    differences = tuple(d for d in found if d is not None)
    same = Verification(results, inputs, tuple(other_versions(recorded)), tuple(tables), differences)
    return Done(same, tuple(same.lines()), exit_status=0 if same.identical else QUALITY_GATE_FAILED)
