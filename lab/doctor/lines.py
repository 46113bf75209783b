"""The lines that the checks of `beampose doctor` return."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

from lab.errors import CalibrationError, InputError, RunError


class State(IntEnum):
    """Severity of a line, in ascending order."""

    OK = 0
    WARN = 1  # works; the user should know
    FAIL = 2  # some command will not work


@dataclass(frozen=True, slots=True)
class Line:
    """The result of one check."""

    code: str  # BP-D01 ...: `beampose explain CODE`
    state: State
    what: str
    remedy: str = ""  # what to do; empty for OK
    exit_status: int = RunError.exit_status  # of the command, if the state is FAIL

    def __str__(self) -> str:
        remedy = f". {self.remedy} [{self.code}]" if self.state > State.OK else ""
        return f"{self.state.name:<5}{self.what}{remedy}"


def exit_status(lines: Sequence[Line]) -> int:
    """Exit status of the command: 0 without a FAIL; 2: a file is wrong; 1: the installation is; 3: a calibration."""
    failed = {line.exit_status for line in lines if line.state is State.FAIL}
    order = (InputError.exit_status, RunError.exit_status, CalibrationError.exit_status)
    return next((status for status in order if status in failed), 0)
