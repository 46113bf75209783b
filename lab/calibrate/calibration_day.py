"""The day of a calibration, and whether its result still holds when it is written."""

from __future__ import annotations

import datetime

from calibration.findings import Finding, Level
from lab.errors import InputError
from lab.files.project.project_types import Project


def day_of(project: Project, today: datetime.date | None) -> datetime.date:
    """The day that the result carries: today where it is given, else that of the measurements, else the clock's.

    Raises InputError for measurements of the future.
    """
    now = today or datetime.date.today()
    if project.date is not None and project.date > now:
        raise InputError(
            f"{project.path}: date: expected the day of the measurements, got {project.date.isoformat()}, after"
            f" today ({now.isoformat()}); correct it, or the clock"
        )
    return today or project.date or now


def last_day(project: Project, day: datetime.date) -> datetime.date | None:
    """The last day on which the result holds; None: for ever."""
    return None if project.valid_days is None else day + datetime.timedelta(days=project.valid_days)


def expired(project: Project, day: datetime.date, today: datetime.date | None) -> list[Finding]:
    """A warning where the result does not hold any more on the day that it is written."""
    until, now = last_day(project, day), today or datetime.date.today()
    if until is None or until >= now:
        return []
    return [
        Finding(
            Level.WARN,
            f"the calibration held until {until.isoformat()}, {(now - until).days} days ago",
            f"measured on {day.isoformat()}, valid for {project.valid_days} days: runs of today will refuse it",
            "measure again, or correct date and valid_days",
        )
    ]
