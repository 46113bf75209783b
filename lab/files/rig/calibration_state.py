"""The state of a calibration: its date, validity and verdict, and whether it may be used."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Annotated, Any

import pydantic

from lab.errors import CalibrationError
from lab.files.text.fields import Block, Integer, Lines, NonNegative, Number, Positive, Text, one_of, unexpected_value
from lab.findings.finding import Level

VERDICTS = tuple(level.name for level in Level)


def iso_date(value: Any) -> datetime.date:
    """A date, or one written as 2026-03-14; a time of day after it is ignored."""
    if isinstance(value, datetime.date):
        return value
    if isinstance(value, str):
        try:
            return datetime.datetime.fromisoformat(value.strip()).date()
        except ValueError:
            pass
    raise unexpected_value("a date such as 2026-03-14", value)


def _day_or_none(value: Any) -> datetime.date | None:
    return None if value in (None, "") else iso_date(value)


Day = Annotated[datetime.date, pydantic.PlainValidator(iso_date)]
OptionalDay = Annotated[datetime.date | None, pydantic.PlainValidator(_day_or_none)]


class CalibrationState(Block):
    """Date, verdict and validity of a calibration: the block `calibration:` of a file."""

    date: Day
    verdict: Annotated[str, pydantic.PlainValidator(one_of(VERDICTS))]
    valid_until: OptionalDay = None  # the last valid day; without it, no limit
    reasons: Lines = ()  # a line for each finding that is not a PASS
    notes: Text = ""
    made_from: Lines = ()  # a line for each file from which it was made, with its SHA-256

    def days_left(self, day: datetime.date) -> int | None:
        """Days of validity after `day`: negative after its end, None without one."""
        return None if self.valid_until is None else (self.valid_until - day).days

    @property
    def validity(self) -> str:
        """The end of the validity in words."""
        return "without an expiry date" if self.valid_until is None else f"valid until {self.valid_until}"

    @property
    def failed(self) -> bool:
        """Whether the verdict is FAIL: it must not be used."""
        return self.verdict == Level.FAIL.name

    @property
    def reason(self) -> str:
        """The first reason of the verdict, such as ` (RMS 3 px)`; empty without one."""
        return f" ({self.reasons[0]})" if self.reasons else ""


class CameraCalibration(CalibrationState):
    """The state of a lens calibration with its quality: the block of a camera.yaml. All of it may be unknown."""

    date: OptionalDay = None  # type: ignore[assignment]  # a lens may have none, a rig has one
    verdict: Annotated[str, pydantic.PlainValidator(one_of((*VERDICTS, "")))] = ""
    rms_px: NonNegative | None = None  # of the corners' residuals, per axis
    sigma_px: NonNegative | None = None  # of one corner's coordinate, estimated by the solve
    hold_out_rms_px: NonNegative | None = None  # of corners not used by the solve
    views: Integer | None = None  # photographs used
    corners: Integer | None = None  # corners used
    board: Text = ""  # description of the board, or its file
    distance_m: Positive | None = None  # distance for figures in millimetres
    figures: dict[str, Number] = {}  # noqa: RUF012 - frozen  # further figures, with their unit in the name


def require_valid_calibration(
    state: CalibrationState | None, path: Path, recorded: datetime.date | None = None
) -> None:
    """Checks that a calibration may be used for a recording of that day, or of today; None (state unknown) may.

    Raises CalibrationError: the verdict is FAIL, or the calibration is out of date (exit status 3).
    """
    if state is None:
        return
    if state.failed:
        raise CalibrationError(
            f"{path}: calibration.verdict: FAIL{state.reason}: this calibration must not be used; correct the cause and"
            " calibrate again (`beampose calibrate rig`)"
        )
    on, what = (datetime.date.today(), "today") if recorded is None else (recorded, "the recording's day")
    left = state.days_left(on)
    if left is not None and left < 0:
        raise CalibrationError(
            f"{path}: calibration.valid_until: {state.valid_until} was {-left} day{'s' if left < -1 else ''}"
            f" before {on.isoformat()} ({what}): the calibration is out of date; calibrate again, or confirm it with"
            " `beampose calibrate check` and set a new date"
        )
