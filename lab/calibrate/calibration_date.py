"""Date of a calibration and end of its validity."""

from __future__ import annotations

import datetime

from calibration.findings import Finding, Level
from lab.errors import InputError
from lab.files.project.project_blocks import Project


def calibration_date(project: Project, today: datetime.date | None) -> datetime.date:
    """Date written into the result: `today` if given, else the date of the measurements, else the current date.

    Raises:
        InputError: if the measurements are dated in the future.
    """
    now = today or datetime.date.today()
    if project.date is not None and project.date > now:
        raise InputError(
            f"{project.path}: date: expected the day of the measurements, got {project.date.isoformat()}, after"
            f" today ({now.isoformat()}); correct the date or the computer's clock"
        )
    return today or project.date or now


def expiry_date(project: Project, day: datetime.date) -> datetime.date | None:
    """Last day on which the result is valid; None: no expiry."""
    return None if project.valid_days is None else day + datetime.timedelta(days=project.valid_days)


def expiry_findings(project: Project, day: datetime.date, today: datetime.date | None) -> list[Finding]:
    """A warning if the result has already expired on the day on which it is written."""
    until, now = expiry_date(project, day), today or datetime.date.today()
    if until is None or until >= now:
        return []
    return [
        Finding(
            Level.WARN,
            f"the calibration expired on {until.isoformat()}, {(now - until).days} days ago",
            f"measured on {day.isoformat()}, valid for {project.valid_days} days: runs recorded today refuse it",
            "measure again, or correct date and valid_days",
            code="BP-K07",
        )
    ]
