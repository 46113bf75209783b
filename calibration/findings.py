"""Findings of a calibration, each with a level, a reason and a remedy, and the verdict that they give."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum


class Level(IntEnum):
    """Severity of a finding, in ascending order."""

    PASS = 0
    WARN = 1  # usable; the user should know
    FAIL = 2  # must not be used


@dataclass(frozen=True, slots=True)
class Finding:
    """The result of one test, in words for the person who acts on it."""

    level: Level
    what: str  # what was tested and the result, with figures
    why: str = ""  # what it means for a measurement
    remedy: str = ""  # what to do; empty for PASS
    code: str = ""  # BP-B01 ...: `beampose explain CODE`; may be empty for PASS


def unless_pass(level: Level, what: str, why: str, remedy: str, *, code: str) -> Finding:
    """A finding whose reason and remedy are dropped when its level is PASS."""
    if level is Level.PASS:
        return Finding(level, what, code=code)
    return Finding(level, what, why, remedy, code)


def verdict(findings: Iterable[Finding]) -> Level:
    """The most severe level among the findings; PASS if there are none."""
    return max((f.level for f in findings), default=Level.PASS)
