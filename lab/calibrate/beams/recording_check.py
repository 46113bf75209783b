"""Recordings whose spots do not agree: the usual mistake behind it, in words, or that there is no calibration."""

from __future__ import annotations

from pathlib import Path

from calibration.beams.error_diagnosis import suspect
from geometry.rig import Rig
from geometry.uncertainty.rig_parameters import RigCovariance
from lab.calibrate.beams.recordings import Recordings, stand_of
from lab.errors import InputError
from lab.files.project.project_types import Project


def refuse_known_mistakes(
    project: Project, rig: Rig, recordings: Recordings, knowledge: RigCovariance | None = None
) -> None:
    """Where no calibration was found: InputError if one usual mistake in poses or labels explains it.

    rig: cameras and screens as calibrated, beams as drawn; knowledge: of their errors. Positions must be known.
    """
    found = suspect(rig, recordings.spots, stand_of(project, recordings), knowledge)
    if found is None:
        return
    files = [r.spots or r.run if found.in_labels else r.poses for r in project.recordings]
    where = ", ".join(str(f) for f in files if f is not None)
    subject = "the spots fit" if found.in_labels else "the spots fit these poses"
    raise InputError(f"{where}: {subject} only {found.words}; {found.remedy}")


def refuse_repeated(project: Project) -> None:
    """InputError for a recording that is listed twice: its spots would count twice, and all sigmas be too small."""
    seen: dict[Path, int] = {}
    for k, recording in enumerate(project.recordings):
        path = recording.spots or recording.run
        if path is None:
            continue
        first = seen.setdefault(path.resolve(), k)
        if first != k:
            raise InputError(
                f"{project.path}: recordings.{k}: expected another recording than recordings.{first}, got {path.name}"
                " again; list each once, or its spots count twice"
            )
