"""Which runs of a batch are done: the fingerprint of a run's inputs and settings, and results that have it."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from functools import cache
from pathlib import Path
from typing import Any

from lab.files.rig.calibration_state import state_mapping
from lab.files.run.fingerprints import fingerprints
from lab.files.run.run_file import Run
from lab.files.text.json_text import plain_value, read_json
from lab.versions import versions

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
        "calibration": None if run.calibration is None else state_mapping(run.calibration),
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
