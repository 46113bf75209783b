"""What summary.json records of how a result was made, and whether its inputs are still the same."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pydantic

from lab.errors import InputError
from lab.files.run.fingerprints import fingerprints
from lab.files.run.run_file import Run
from lab.files.text.dataclass_fields import dataclass_from_yaml
from lab.files.text.json_text import read_json
from lab.runs.summary import SUMMARY_SCHEMA
from lab.versions import versions
from tracking.parameters import TrackerParameters


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

    run_folder: Path
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

    Raises:
        InputError: the folder holds no results of a run, or summary.json lacks what is needed.
    """
    path = Path(results) / "summary.json"
    try:
        content = read_json(path)
    except FileNotFoundError:
        raise InputError(
            f"{results}: expected a folder that `beampose run` wrote, found no summary.json in it"
        ) from None
    except (ValueError, OSError) as error:
        raise InputError(f"{path}: expected the summary of a run, found {error}; process the run again") from None
    if not isinstance(content, dict) or content.get("schema") != SUMMARY_SCHEMA:
        raise InputError(f"{path}: schema: expected {SUMMARY_SCHEMA!r}; process the run again")
    try:
        summary = _Summary.model_validate(content)
    except pydantic.ValidationError as error:
        field = ".".join(str(part) for part in error.errors()[0]["loc"])
        raise InputError(f"{path}: {field}: expected what a run records there; process the run again") from None
    tracker = dataclass_from_yaml(TrackerParameters, summary.parameters.tracker, path, "parameters.tracker")
    causal = summary.attitude == "causal"
    return Recorded(Path(summary.run_folder), causal, tracker, summary.versions, tuple(summary.inputs))


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
