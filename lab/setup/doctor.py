"""All checks of `beampose doctor`."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from pathlib import Path

from lab.findings.finding import Finding, Level
from lab.setup.installation import check_installation


def examine(files: Sequence[Path] = (), out: Path = Path()) -> list[Finding]:
    """A finding per check. files: calibration files or run folders. out: where results will be written."""
    lines = check_installation()
    if any(line.code == "BP-D02" and line.level > Level.PASS for line in lines):
        return lines  # the other checks need the libraries
    from lab.setup.doctor_checks import check_calibration, check_opencv, check_places

    today = datetime.date.today()
    return [*lines, *check_opencv(), *check_places(out), *(check_calibration(f, today) for f in files)]
