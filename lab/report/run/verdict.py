"""The verdict of a run in words. The status is decided where the run is processed; here it is only read out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

WORDS = {
    "pass": ("PASS", "The run was processed and every quality gate passed."),
    "check": ("CHECK", "The run was processed and its gates passed, but look at the points below before using it."),
    "fail": ("FAIL", "The run was processed, but a quality gate failed: do not use it unseen."),
}
UNKNOWN = ("NO VERDICT", "The results hold no verdict: summary.json is missing or was written by another program.")


@dataclass(frozen=True, slots=True)
class Point:
    """One reason, with what to do about it."""

    what: str
    remedy: str = ""
    fails: bool = False  # a gate


@dataclass(frozen=True, slots=True)
class VerdictText:
    """What to think of a run, and why."""

    status: str  # pass, check, fail or unknown
    word: str
    sentence: str
    reasons: tuple[str, ...]
    exit_status: int | None
    points: tuple[Point, ...]  # the reasons with their remedies; of results without evidence the reasons alone


def verdict_of(summary: dict[str, Any]) -> VerdictText:
    """The verdict that summary.json holds, whatever of it is there."""
    block = summary.get("verdict")
    block = block if isinstance(block, dict) else {}
    status = str(block.get("status", "unknown")).lower()
    word, sentence = WORDS.get(status, UNKNOWN)
    reasons = block.get("reasons") or ()
    if isinstance(reasons, str):
        reasons = (reasons,)
    code = block.get("exit_status")
    return VerdictText(
        status=status if status in WORDS else "unknown",
        word=word,
        sentence=sentence,
        reasons=tuple(str(r) for r in reasons),
        exit_status=code if isinstance(code, int) else None,
        points=_points(block.get("evidence")) or tuple(Point(str(r)) for r in reasons),
    )


def _points(evidence: Any) -> tuple[Point, ...]:
    found = [e for e in evidence if isinstance(e, dict)] if isinstance(evidence, list) else []
    return tuple(Point(str(e.get("what")), str(e.get("remedy") or ""), e.get("level") == "fail") for e in found)
