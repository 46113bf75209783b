"""What a command returns: results with a verdict (`Outcome`), or files and lines without one (`Done`).

The third shape is that of many runs, `lab/runs/batch/`: a row of a table for each.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

from lab.errors import QUALITY_GATE_FAILED
from lab.findings.finding import Finding, Level, first_sentence, reasons, verdict

R_co = TypeVar("R_co", covariant=True)
_REFERS_TO_OTHERS = "BP-V02"  # the remedy of this code names the other reasons


@dataclass(frozen=True, slots=True)
class Verdict:
    """What can be said of results as a whole."""

    findings: tuple[Finding, ...] = ()  # failures first
    praise: str = ""  # what is said where no finding is a reason

    @property
    def level(self) -> Level:
        """PASS; WARN: usable, but something needs a check by the user; FAIL: must not be used as it is."""
        return verdict(self.findings)

    @property
    def status(self) -> str:
        """The level as in summary.json: pass, check or fail."""
        return self.level.word

    @property
    def exit_status(self) -> int:
        """The command's exit status where a FAIL is a failed quality gate, section 5 of the files' contract."""
        return QUALITY_GATE_FAILED if self.level is Level.FAIL else 0

    @property
    def texts(self) -> tuple[str, ...]:
        """The reasons in words."""
        return reasons(self.findings) or ((self.praise,) if self.praise else ())

    @property
    def remedy(self) -> str:
        """The remedy of the first failure with one of its own; empty where nothing failed."""
        failed = (f.remedy for f in self.findings if f.level is Level.FAIL and f.code != _REFERS_TO_OTHERS)
        return next(failed, "")

    def as_mapping(self) -> dict[str, Any]:
        """The block `verdict` of summary.json."""
        return {
            "status": self.status,
            "reasons": list(self.texts),
            "exit_status": self.exit_status,
            "evidence": [f.as_mapping() for f in self.findings],
        }

    def of_frames(self, measured: int, frames: int, errors: Sequence[str] = ()) -> str:
        """The verdict on frames in one line: the first reason in one sentence; errors: against truth, in words.

        With the next reason where the first refers to the others.
        """
        codes = [f.code for f in self.findings if f.level > Level.PASS]
        shown = 2 if codes[:1] == [_REFERS_TO_OTHERS] else 1
        more = len(self.texts) - shown
        first = [first_sentence(text) for text in self.texts[:shown]]
        others = [f"{more} more in the report"] if more > 0 else []
        texts = "; ".join([*first, *others, *errors])
        said = f" ({texts})" if texts else ""
        remedy = f" {first_sentence(self.remedy)}." if self.remedy else ""
        remedy = remedy.replace("?.", "?")
        return f"{self.status.upper()}: {measured} of {frames} frames measured{said}{remedy}"


@dataclass(frozen=True, slots=True)
class Outcome(Generic[R_co]):
    """Results that a command has judged and written."""

    name: str
    out: Path  # the folder they are in
    verdict: Verdict
    result: R_co
    said: str  # verdict and key figures, for the terminal
    summary: Mapping[str, Any] = field(default_factory=dict)  # the content of summary.json, where there is one
    failed_status: int = QUALITY_GATE_FAILED  # exit status of a FAIL
    more: tuple[str, ...] = ()  # further lines for the terminal
    notes: tuple[str, ...] = ()  # for standard error

    @property
    def findings(self) -> tuple[Finding, ...]:
        """All findings."""
        return self.verdict.findings

    @property
    def level(self) -> Level:
        """The level of the verdict."""
        return self.verdict.level

    @property
    def exit_status(self) -> int:
        """0, or the status of results that must not be used."""
        return self.failed_status if self.level is Level.FAIL else 0

    def line(self) -> str:
        """For the terminal."""
        return "\n".join([f"{self.name}: {self.said} -> {self.out}", *self.more])


@dataclass(frozen=True, slots=True)
class Done(Generic[R_co]):
    """The result of a command that judges nothing."""

    result: R_co
    lines: tuple[str, ...]  # for the terminal
    notes: tuple[str, ...] = ()  # for standard error: what could not be done
    exit_status: int = 0

    def line(self) -> str:
        """For the terminal."""
        return "\n".join(self.lines)
