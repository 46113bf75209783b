"""A finding: what a command has found, how severe it is, what it means and what to do; and the verdict of several.

What a command returns: results with a verdict (`Outcome`), or files and lines without one (`Done`).
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import cache
from pathlib import Path
from typing import Any, Generic, TypeVar

from lab.errors import QUALITY_GATE_FAILED, InputError
from lab.files.text.error_text import suggest_name

_WIDTH = 100


@dataclass(frozen=True, slots=True)
class Entry:
    """What a code means, for a person who sees it in a report, in summary.json or on the terminal."""

    title: str
    meaning: str  # what was found, and what it means for the results
    remedy: str
    kind: str = ""  # the word in the summary of a run
    variants: Mapping[str, Mapping[str, str]] = field(default_factory=dict)  # other texts, by the name of a variant

    def variant(self, name: str) -> Entry:
        """The entry with the texts of a variant; itself for the empty name."""
        return replace(self, **self.variants[name]) if name else self  # type: ignore[arg-type]


def _entry(table: Mapping[str, Any]) -> Entry:
    texts = {key: value for key, value in table.items() if isinstance(value, str)}
    return Entry(**texts, variants={key: value for key, value in table.items() if key not in texts})


@cache
def _table() -> dict[str, Any]:
    """The catalogue. Read when a code is first looked up: that takes a tenth of a start of the program."""
    import tomllib

    return tomllib.loads(Path(__file__).with_name("catalogue.toml").read_text("utf-8"))


@cache
def entries() -> Mapping[str, Entry]:
    """The entries of all codes."""
    return {code: _entry(table) for code, table in _table().items() if code != "sections"}


@cache
def sections() -> Mapping[str, Mapping[str, Entry]]:
    """The entries by the title of their section."""
    return {
        title: {code: entry for code, entry in entries().items() if code.startswith(f"BP-{letter}")}
        for letter, title in _table()["sections"].items()
    }


def explain(code: str) -> str:
    """The explanation of a code, as lines; `V03`, `v3` and `bp-v03` are read as BP-V03.

    Raises InputError: there is no such code.
    """
    name = code.strip().upper()
    name = name if name.startswith("BP-") else f"BP-{name}"
    if parts := re.fullmatch(r"BP-([A-Z])(\d)", name):
        name = f"BP-{parts[1]}0{parts[2]}"
    if name not in entries():
        near = suggest_name(name, entries())
        hint = near if "did you mean" in near else ""
        raise InputError(f"expected a code such as BP-V03, got {code!r}{hint}; `beampose explain` lists all codes")
    entry = entries()[name]
    lines = [f"{name}  {entry.title}"]
    for part in (f"What it means: {entry.meaning}", f"What to do: {entry.remedy}"):
        lines += ["", *textwrap.wrap(part, _WIDTH, break_long_words=False, break_on_hyphens=False)]
    return "\n".join(lines)


def listed() -> list[str]:
    """A line for each code, under the title of its section."""
    lines: list[str] = []
    for title, section in sections().items():
        lines += ["", title] if lines else [title]
        lines += [f"  {code}  {entry.title}" for code, entry in section.items()]
    return lines


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
            "kind": entries()[self.code].kind if self.code else "",
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
    entry = entries()[code].variant(variant)
    if level is Level.PASS:
        return Finding(level, what, why, code=code, numbers=numbers or {})
    return Finding(level, what, why or entry.meaning, remedy or entry.remedy, code, numbers or {})


def clause(sentence: str) -> str:
    """A sentence as part of another one: without its capital and its full stop."""
    return f"{sentence[:1].lower()}{sentence[1:]}".rstrip(".")


def sentence(text: str) -> str:
    """A text with a capital and one full stop."""
    return f"{text[:1].upper()}{text[1:].rstrip('.')}."


def first_sentence(text: str) -> str:
    """The first sentence of a text, without its full stop; the report has the whole text."""
    return re.split(r"(?<=[\w)%`'\"])\.\s+(?=[A-Z`])|(?<=\?)\s+", text, maxsplit=1)[0].rstrip(".")


def verdict(findings: Iterable[Finding]) -> Level:
    """The most severe level among the findings; PASS if there are none."""
    return max((f.level for f in findings), default=Level.PASS)


def counted(findings: Sequence[Finding]) -> str:
    """`2 failed, 1 warning, 5 passed`."""
    count = {level: sum(f.level == level for f in findings) for level in Level}
    warnings = f"{count[Level.WARN]} warning{'s' if count[Level.WARN] != 1 else ''}"
    return f"{count[Level.FAIL]} failed, {warnings}, {count[Level.PASS]} passed"


def level_above(value: float, warn: float, fail: float) -> Level:
    """The level of a value that should be small: WARN above the first limit, FAIL above the second; nan is a PASS."""
    return Level.FAIL if value > fail else Level.WARN if value > warn else Level.PASS


def worst_first(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """The findings, failures first; those of one level in their order."""
    return tuple(sorted(findings, key=lambda f: -f.level))


def reasons(findings: Iterable[Finding]) -> tuple[str, ...]:
    """The texts of warnings and failures."""
    return tuple(f.what for f in findings if f.level > Level.PASS)


# What a command returns: results with a verdict (`Outcome`), or files and lines without one (`Done`).
#
# The third shape is that of many runs, `lab/runs/batch/`: a row of a table for each.


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
