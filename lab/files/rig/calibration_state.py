"""The state of a calibration: when it was made, until when it holds, what it says of itself; and who may use it."""

from __future__ import annotations

import datetime
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import pydantic

from lab.errors import CalibrationError
from lab.files.text.fields import Block, Lines, Text, one_of, unexpected

VERDICTS = ("PASS", "WARN", "FAIL")


@dataclass(frozen=True, slots=True)
class CalibrationState:
    """What a calibrated file says of its own making."""

    date: datetime.date
    verdict: str  # one of VERDICTS
    valid_until: datetime.date | None = None  # the last day on which it holds; None: for ever
    reasons: tuple[str, ...] = ()  # a line for each finding that is not a PASS
    notes: str = ""


def iso_date(value: Any) -> datetime.date:
    """A day written as 2026-03-14; a time of day after it is dropped."""
    if isinstance(value, str):
        try:
            return datetime.datetime.fromisoformat(value.strip()).date()
        except ValueError:
            pass
    raise unexpected("a date such as 2026-03-14", value)


def _day_or_none(value: Any) -> datetime.date | None:
    return None if value in (None, "") else iso_date(value)


Day = Annotated[datetime.date, pydantic.PlainValidator(iso_date)]
OptionalDay = Annotated[datetime.date | None, pydantic.PlainValidator(_day_or_none)]


class CalibrationStateBlock(Block):
    """The block `calibration:` of a rig.yaml."""

    date: Day
    verdict: Annotated[str, pydantic.PlainValidator(one_of(VERDICTS))]
    valid_until: OptionalDay = None
    reasons: Lines = []  # noqa: RUF012 - frozen
    notes: Text = ""

    def value(self) -> CalibrationState:
        """The block as a value."""
        return CalibrationState(self.date, self.verdict, self.valid_until, tuple(self.reasons), self.notes)


def state_mapping(state: CalibrationState) -> dict[str, Any]:
    """The plain mapping that a `CalibrationStateBlock` reads back to the same value."""
    out: dict[str, Any] = {"date": state.date.isoformat(), "verdict": state.verdict}
    if state.valid_until is not None:
        out["valid_until"] = state.valid_until.isoformat()
    if state.reasons:
        out["reasons"] = list(state.reasons)
    if state.notes:
        out["notes"] = state.notes
    return out


def require_usable(state: CalibrationState | None, path: Path, on: datetime.date, what: str = "today") -> None:
    """Raise CalibrationError (exit status 3) where a calibration must not be used on a day; None may.

    what: how the message names that day.
    """
    if state is None:
        return
    if state.verdict == "FAIL":
        why = f" ({state.reasons[0]})" if state.reasons else ""
        raise CalibrationError(
            f"{path}: calibration.verdict: FAIL{why}: this calibration must not be used; put the cause right and"
            " calibrate again (`beampose calibrate rig`)"
        )
    if state.valid_until is not None and on > state.valid_until:
        days = (on - state.valid_until).days
        raise CalibrationError(
            f"{path}: calibration.valid_until: {state.valid_until.isoformat()} was {days} day{'s' if days > 1 else ''}"
            f" before {on.isoformat()} ({what}): the calibration is out of date; calibrate again, or confirm it with"
            " `beampose calibrate check` and set a new date"
        )
