"""A finding: what a command has found, how severe it is, what it means and what to do; and the verdict of several."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

from lab.findings.catalogue import ENTRIES


class Level(IntEnum):
    """Severity of a finding, in ascending order."""

    PASS = 0
    WARN = 1  # usable; the user should know
    FAIL = 2  # must not be used

    @property
    def word(self) -> str:
        """The word in summary.json and in the verdict of a run: pass, check or fail."""
        return ("pass", "check", "fail")[self]


@dataclass(frozen=True, slots=True)
class Finding:
    """The result of one test, in words for the person who acts on it."""

    level: Level
    what: str  # what was tested and the result, with figures
    why: str = ""  # what it means for a measurement
    remedy: str = ""  # what to do; empty for PASS
    code: str = ""  # BP-B01 ...: `beampose explain CODE`; may be empty for PASS
    numbers: Mapping[str, Any] = field(default_factory=dict)  # plain values, for summary.json

    def as_mapping(self) -> dict[str, Any]:
        """For summary.json."""
        return {
            "kind": ENTRIES[self.code].kind if self.code else "",
            "code": self.code,
            "level": self.level.word,
            "what": self.what,
            "why": self.why,
            "remedy": self.remedy,
            "numbers": dict(self.numbers),
        }


def passed(what: str) -> Finding:
    """A finding without anything to do."""
    return Finding(Level.PASS, what)


def finding(
    code: str,
    level: Level,
    what: str,
    *,
    why: str = "",
    remedy: str = "",
    variant: str = "",
    numbers: Mapping[str, Any] | None = None,
) -> Finding:
    """A finding with the texts of its code in the catalogue, unless others are given.

    variant: of the code, with texts of its own. A PASS has no remedy, and a reason only if one is given.
    """
    entry = ENTRIES[code].variant(variant)
    if level is Level.PASS:
        return Finding(level, what, why, code=code, numbers=numbers or {})
    return Finding(level, what, why or entry.meaning, remedy or entry.remedy, code, numbers or {})


def clause(sentence: str) -> str:
    """A sentence as part of another one: without its capital and its full stop."""
    return f"{sentence[:1].lower()}{sentence[1:]}".rstrip(".")


def verdict(findings: Iterable[Finding]) -> Level:
    """The most severe level among the findings; PASS if there are none."""
    return max((f.level for f in findings), default=Level.PASS)


def level_above(value: float, warn: float, fail: float) -> Level:
    """The level of a value that should be small: WARN above the first limit, FAIL above the second; nan is a PASS."""
    return Level.FAIL if value > fail else Level.WARN if value > warn else Level.PASS


def worst_first(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """The findings, failures first; those of one level in their order."""
    return tuple(sorted(findings, key=lambda f: -f.level))


def reasons(findings: Iterable[Finding]) -> tuple[str, ...]:
    """The texts of warnings and failures."""
    return tuple(f.what for f in findings if f.level > Level.PASS)
