"""summary.json as a typed value, read once. What an older or damaged file lacks is left empty."""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeVar, cast

from pydantic import TypeAdapter, ValidationError

from lab.files.run.results import REFINED, ListedEvent
from lab.findings.finding import Finding, Level

T = TypeVar("T")
DETAILS = ("parameters", "smoother", "rates", "timings", "versions")  # blocks that the report shows as they are
METHODS = ("rigid", "spots")
_OLDEST_METHOD = "spots"  # the only tracker of results that do not state one
VERDICTS = {
    "pass": ("PASS", "The run was processed and every quality gate passed."),
    "check": ("CHECK", "The run was processed and its gates passed; read the points below before using it."),
    "fail": ("FAIL", "The run was processed, but a quality gate failed: read the points below."),
    "error": ("ERROR", "The run could not be processed: there are no results to use."),
}
_NO_VERDICT = ("NO VERDICT", "The results hold no verdict: summary.json is missing or was written by another program.")


@dataclass(frozen=True, slots=True)
class VerdictText:
    """The verdict of a run in words. It is decided where the run is processed."""

    status: str  # pass, check, fail or unknown
    word: str
    sentence: str
    points: tuple[Finding, ...]  # the reasons with their remedies; without a remedy in older results


@dataclass(frozen=True, slots=True)
class InputFile:
    """The fingerprint of a file that the run was made from."""

    path: str = ""
    bytes: int | None = None
    sha256: str = ""


@dataclass(frozen=True, slots=True)
class RunSummary:
    """The parts of summary.json that a report shows."""

    present: bool  # False: there is no summary.json
    name: str
    run_folder: str
    method: str  # of the tracker: one of METHODS
    stated_method: str  # as written; empty where it is not stated
    verdict: VerdictText
    notes: tuple[str, ...]
    events: tuple[ListedEvent, ...]
    event_counts: dict[str, int]  # by kind
    found_again: int | None  # times the vehicle was found again after it was lost; None: not stated
    no_image: dict[str, list[tuple[int, int]]]  # by camera: first and last frame number of each range
    inputs: tuple[InputFile, ...]
    details: dict[str, list[tuple[str, str]]]  # the blocks of DETAILS: dotted names and plain values
    errors: Mapping[str, Any] | None  # of the score against truth, as lab.runs.verdict.score writes it
    model_check: Mapping[str, Any] | None
    refined: Mapping[str, Any]  # of `run --refined`: line, report, heads and rows of the changes; otherwise empty
    calibration: Mapping[str, Any] | None  # date, verdict, valid_until; None where the rig states none


def summary_of(tree: Mapping[str, Any]) -> RunSummary:
    """The content of summary.json; of an empty mapping, that of a missing file."""
    counts, parameters = _mapping(tree.get("counts")), _mapping(tree.get("parameters"))
    method = _mapping(parameters.get("tracker")).get("method") or parameters.get("method")
    known = method if method in METHODS else _OLDEST_METHOD
    return RunSummary(
        present=bool(tree),
        name=str(tree.get("name") or ""),
        run_folder=valid(str, tree.get("run_folder")) or "",
        method=known,
        stated_method=str(method or ""),
        verdict=verdict_of(tree),
        notes=tuple(map(str, _list(tree.get("notes")))),
        events=tuple(e for x in _list(tree.get("events")) if (e := valid(ListedEvent, x))),
        event_counts=valid(dict[str, int], counts.get("events")) or {},
        found_again=valid(int, counts.get("found_again")),
        no_image=valid(dict[str, list[tuple[int, int]]], counts.get("no_image")) or {},
        inputs=tuple(i for x in _list(tree.get("inputs")) if (i := valid(InputFile, x))),
        details={name: flattened(tree.get(name) or {}) for name in DETAILS},
        errors=_mapping(tree.get("errors")) or None,
        model_check=valid(dict[str, Any], tree.get("model_check")),
        refined=_mapping(tree.get(REFINED)),
        calibration=valid(dict[str, Any], tree.get("calibration")),
    )


def verdict_of(tree: Mapping[str, Any]) -> VerdictText:
    """The verdict in the content of summary.json, as far as it is there."""
    block = _mapping(tree.get("verdict"))
    status = str(block.get("status", "unknown")).lower()
    word, sentence = VERDICTS.get(status, _NO_VERDICT)
    points = findings_in(block.get("evidence"))
    return VerdictText(
        status=status if status in VERDICTS else "unknown",
        word=word,
        sentence=sentence,
        points=points or tuple(Finding(Level.WARN, str(r)) for r in _list(block.get("reasons"))),
    )


def findings_in(value: object) -> tuple[Finding, ...]:
    """The findings of a block of summary.json, as far as they are there."""
    levels = {**Level.__members__, **{level.word: level for level in Level}}
    texts = ("what", "why", "remedy", "code")
    return tuple(
        Finding(levels.get(str(f.get("level")), Level.WARN), **{name: str(f.get(name) or "") for name in texts})  # type: ignore[arg-type]  # the names are those of its texts
        for f in mappings(value)
    )


def mappings(value: object) -> list[Mapping[str, Any]]:
    """The mappings in a list; empty where it is no list."""
    return [v for v in value if isinstance(v, Mapping)] if isinstance(value, list) else []


_ADAPTER = cache(TypeAdapter)


def valid(kind: type[T], value: object) -> T | None:
    """The value as this type, with nested values as the types of its fields; None where it does not fit."""
    hashable: Any = kind
    try:
        return cast(T, _ADAPTER(hashable).validate_python(value))
    except ValidationError:
        return None


def day_of(value: object) -> datetime.date | None:
    """The day of a date or time as text; None where it is none."""
    try:
        return datetime.date.fromisoformat(str(value).strip()[:10])
    except ValueError:
        return None


def _mapping(value: object) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _list(value: object) -> list[Any]:
    return value if isinstance(value, list) else [] if value is None else [value]


def flattened(tree: Any, name: str = "") -> list[tuple[str, str]]:
    """Dotted names and plain values of nested mappings, for a table."""
    if isinstance(tree, dict):
        return [row for key, value in tree.items() for row in flattened(value, f"{name}.{key}" if name else str(key))]
    if isinstance(tree, list) and any(isinstance(x, dict) for x in tree):
        return [row for i, value in enumerate(tree) for row in flattened(value, f"{name}[{i}]")]
    if isinstance(tree, list):
        return [(name, ", ".join(_plain(x) for x in tree))]
    return [(name, _plain(tree))]


def _plain(value: Any) -> str:
    if value is None:
        return "not set"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.6g}" if isinstance(value, float) else str(value)
