"""Checks of recordings: spots that do not fit the poses or labels, and recordings listed twice."""

from __future__ import annotations

from pathlib import Path

from calibration.beams.error_diagnosis import diagnose_error
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigCovariance
from lab.calibrate.beams.recordings import Recordings, stand_of
from lab.errors import InputError
from lab.files.project.project import Project


def diagnose_failed_fit(
    project: Project, rig: Rig, recordings: Recordings, lab_covariance: RigCovariance | None = None
) -> None:
    """Look for a common mistake in poses or labels that explains why the calibration failed.

    rig: calibrated cameras and screens with nominal beams; lab_covariance: of cameras and screens. The stand positions
    must be known.

    Raises:
        InputError: if a single known mistake explains the failure.
    """
    found = diagnose_error(rig, recordings.spots, stand_of(project, recordings), lab_covariance)
    if found is None:
        return
    files = [r.spots or r.run if found.in_labels else r.poses for r in project.recordings]
    where = ", ".join(str(f) for f in files if f is not None)
    subject = "the spots fit" if found.in_labels else "the spots fit these poses"
    raise InputError(f"{where}: {subject} only {found.words}; {found.remedy}")


def check_no_duplicates(project: Project) -> None:
    """Refuse a recording that is listed twice: its spots would count twice and all sigmas would be too small.

    Raises:
        InputError: names both entries.
    """
    seen: dict[Path, int] = {}
    for k, recording in enumerate(project.recordings):
        path = recording.spots or recording.run
        if path is None:
            continue
        first = seen.setdefault(path.resolve(), k)
        if first != k:
            raise InputError(
                f"{project.path}: recordings.{k}: {path.name} is already listed as recordings.{first}; list each"
                " recording once, otherwise its spots count twice"
            )
