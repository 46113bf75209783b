"""Runs the command of a case in this process and judges how it ended."""

from __future__ import annotations

import csv
import io
import json
import os
import resource
import shutil
import sys
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from bench.fuzz.cases import write_case
from lab.runs.batch.task import COLUMNS

STATUSES = (0, 1, 2, 3, 4)
LIMIT_S = 20.0
LIMIT_MEMORY_MB = 3000
_NOT_FINITE = ("nan", "inf", "-inf", "+inf", "infinity", "-infinity")


@dataclass(frozen=True, slots=True)
class Ending:
    """How a case ended. fault: empty if it is right."""

    number: int
    kind: str
    command: Sequence[str]
    status: int
    seconds: float
    fault: str


class _Kept(io.BytesIO):
    """Bytes that stay when the text stream above them is deleted."""

    def close(self) -> None: ...


def run_case(seed: int, number: int, base: Path, work: Path) -> Ending:
    """Write a case into the folder `work`, run it, judge it, and remove it."""
    shutil.rmtree(os.fsencode(work), ignore_errors=True)
    work.mkdir(parents=True)
    kind, command = write_case(seed, number, base, work)
    return judged(number, kind, command, lambda: work)


def judged(number: int, kind: str, command: Sequence[str], work: Callable[[], Path]) -> Ending:
    """Run a command and judge it. work: the folder in which the results are looked for."""
    before = _identities(work())
    started, clock = time.process_time(), time.monotonic()
    status, out, err, fault = run_command(command)
    seconds = max(time.process_time() - started, min(time.monotonic() - clock, 0.0))
    if not fault and seconds > LIMIT_S:
        fault = f"took {seconds:.0f} s"
    if not fault and resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024 > LIMIT_MEMORY_MB:
        fault = "memory"
    if not fault:
        fault = fault_of_lines(status, out, err)
    if not fault and status in (0, 4):
        fault = not_finite_in(work(), before)
    return Ending(number, kind, tuple(command), status, seconds, fault)


def run_command(command: Sequence[str]) -> tuple[int, str, str, str]:
    """Exit status, stdout, stderr, and the traceback that left the program (empty: none)."""
    from cli import main

    streams = sys.stdout, sys.stderr
    # As a terminal's: stdout refuses what has no UTF-8 form.
    raw_out, raw_err = _Kept(), _Kept()
    sys.stdout = io.TextIOWrapper(raw_out, "utf-8", write_through=True)
    sys.stderr = io.TextIOWrapper(raw_err, "utf-8", errors="backslashreplace", write_through=True)
    status, fault = -1, ""
    try:
        main.main(list(command), prog_name="beampose")
    except SystemExit as error:
        status = 0 if error.code is None else error.code if isinstance(error.code, int) else 1
    except BaseException:
        fault = traceback.format_exc()
    finally:
        sys.stdout, sys.stderr = streams
    return status, raw_out.getvalue().decode("utf-8"), raw_err.getvalue().decode("utf-8"), fault


def fault_of_lines(status: int, out: str, err: str) -> str:
    """What is wrong with the exit status or the lines; empty: nothing."""
    if status not in STATUSES:
        return f"exit status {status}"
    if "traceback" in (out + err).lower():
        return f"a traceback: {err[-300:]}"
    if status and not (out + err).strip():
        return f"exit status {status} without a line"
    if len(err.splitlines()) > 3:
        return f"{len(err.splitlines())} lines on stderr: {err[:300]}"
    if len(err) > 20_000:
        return f"{len(err)} characters on stderr"
    if any(ord(c) < 32 and c not in "\n\t" for c in out + err):
        return "a control character in a line"
    return ""


def _identities(folder: Path) -> Mapping[Path, tuple[int, int]]:
    """Number and time of the files under a folder's results."""
    found = ((path, path.lstat()) for path in folder.glob("out*/**/*") if path.is_file())
    return {path: (stat.st_ino, stat.st_mtime_ns) for path, stat in found}


def not_finite_in(folder: Path, before: Mapping[Path, tuple[int, int]] | None = None) -> str:
    """The first table or JSON file under a folder's results with a number that is not finite; empty: none.

    before: files that were there before the command (a damaged table may be one), as `_identities` returns them.
    """
    written = dict(_identities(folder).items() - (before or {}).items())
    for path in sorted(path for path in written if path.suffix == ".csv"):
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
        # batch.csv keeps columns that a user has added as they are.
        own = len(COLUMNS) if path.name == "batch.csv" else None
        for n, fields in enumerate(list(csv.reader(lines))[1:], 2):
            if any(field.strip().lower() in _NOT_FINITE for field in fields[:own]):
                return f"{path.name} line {n}: {','.join(fields)[:200]}"
    for path in sorted(path for path in written if path.suffix == ".json"):
        found: list[str] = []
        try:
            json.loads(path.read_text(encoding="utf-8", errors="replace"), parse_constant=found.append)
        except ValueError as error:
            return f"{path.name}: {error}"
        if found:
            return f"{path.name}: {found[0]}"
    return ""
