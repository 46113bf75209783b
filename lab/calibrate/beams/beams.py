"""`beampose calibrate beams`: direction and offset of each laser from recordings at positions of a stand."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from calibration.beams.beams import BeamCalibration, self_calibrate
from calibration.beams.beams import calibrate_beams as solve_beams
from calibration.least_squares.adjustment import AdjustmentError
from geometry.uncertainty.rig_uncertainty import RigCovariance
from lab.calibrate.beams.beams_page import (
    ARCSEC,
    BEAMS,
    BeamGoals,
    beam_findings,
    check_no_duplicates,
    diagnose_failed_fit,
    page_of,
    stand_findings,
    write_tables,
)
from lab.calibrate.beams.recordings import read_recordings, stand_of
from lab.calibrate.step import Solved, Step, calibration_date, expiry_date, expiry_findings, run_step, state_of
from lab.errors import CalibrationError, InputError
from lab.files.project.project import Project, load_project
from lab.files.rig.camera_file import CalibrationState
from lab.files.rig.rig_file import RigFile, covariance_blocks, joint_covariance, load_lab_file, save_rig
from lab.files.text.error_text import suggest_name
from lab.findings.finding import Finding, Level, Outcome, finding, passed, verdict

RIG = "rig.yaml"


_STEP = Step("beams", (BEAMS,), RIG)


def calibrate_beams(
    project_path: Path, out: Path, rig: Path | None = None, today: datetime.date | None = None
) -> Outcome[BeamCalibration]:
    """Calibrate the beams of a project; write three tables, report.html and, unless the verdict is FAIL, rig.yaml.

    rig: the rig.yaml or screens.yaml with the calibrated cameras and screens and their covariances (None: `rig.yaml`
    beside the project). The project need not repeat cameras, screens and target; if it has a target, this replaces the
    rig's. Raises InputError: for errors in the files; CalibrationError: if the spots do not determine a calibration.
    """
    return run_step(_STEP, out, lambda: _solve(Path(project_path), rig, today))


def _solve(project_path: Path, rig: Path | None, today: datetime.date | None) -> Solved[BeamCalibration]:
    project = load_project(project_path, lab_known=True)
    day = calibration_date(project, today)
    check_no_duplicates(project)
    rig_path = Path(rig) if rig is not None else project.path.parent / RIG
    file, lab_covariance = _calibrated_lab(project, rig_path)
    recordings = read_recordings(project, file.rig)
    try:
        if recordings.stand_from_body is None:
            c = self_calibrate(file.rig, recordings.spots, len(recordings.names), lab_covariance)
        else:
            c = solve_beams(file.rig, recordings.spots, stand_of(project, recordings), lab_covariance)
    except AdjustmentError as error:
        if recordings.stand_from_body is not None:
            diagnose_failed_fit(project, file.rig, recordings, lab_covariance)
        raise CalibrationError(f"{project.path}: the beams cannot be calibrated: {error}") from None
    findings = (
        *beam_findings(c, file.rig, recordings.names, BeamGoals()),
        *expiry_findings(project, day, today),
        *map(passed, recordings.notes),
        *_lab_findings(lab_covariance is not None, file.calibration, rig_path),
        *stand_findings(project, recordings),
    )

    def write(folder: Path) -> None:
        write_tables(c, file.rig, recordings.names, folder)
        if verdict(findings) < Level.FAIL:
            save_rig(_rig_file(file, c, project, findings, day), folder / RIG)

    return Solved(
        name=project.name,
        result=c,
        findings=findings,
        figures=_figures(c),
        write=write,
        page=lambda: page_of(c, file.rig, recordings.names),
        day=day,
        inputs=[rig_path, *project.inputs],
    )


def _figures(c: BeamCalibration) -> str:
    out = f"{len(c.lines)} beams from {len(c.world_from_body.translation)} positions"
    if c.world_from_stand is None and c.angles:
        between = float(np.sqrt(np.mean([a.sigma**2 for a in c.angles]))) / ARCSEC
        out += f" at unknown poses, angles between beams to {between:.3g} arcsec RMS"
    elif not c.undetermined:
        out += f", directions to {float(np.sqrt(np.mean(c.direction_sigmas**2))) / ARCSEC:.3g} arcsec RMS"
    if not c.fit.kept.all():
        out += f", {int(np.sum(~c.fit.kept))} of {len(c.fit.kept)} spots excluded"
    return out


def _calibrated_lab(project: Project, rig_path: Path) -> tuple[RigFile, RigCovariance | None]:
    """The calibrated cameras and screens with the project's target, and the covariance of cameras and screens."""
    if not rig_path.is_file():
        raise InputError(
            f"{rig_path}: expected a rig.yaml with calibrated cameras and screens, found no file; run"
            f" `beampose calibrate screen {project.path}` first and give its rig.yaml with --rig"
        )
    file = load_lab_file(rig_path)
    lab_covariance = joint_covariance(file.rig, file.covariances, rig_path)
    for kind, wanted, calibrated in (
        ("camera", project.cameras, file.rig.cameras),
        ("screen", project.screens, file.rig.screens),
    ):
        for name in wanted:
            if name not in calibrated:
                raise InputError(
                    f"{rig_path}: expected {kind} {name!r} of {project.path.name}, got {', '.join(calibrated)}"
                    f"{suggest_name(name, calibrated)}; calibrate it first (`beampose calibrate screen`)"[:300]
                )
    if not project.beams and not file.rig.beams:
        raise InputError(
            f"{project.path}: target: expected the nominal beams and spots, got none; add them: names, ends and"
            " screens are needed, approximate directions and points are enough"
        )
    if not project.beams:
        return file, lab_covariance
    for name, spot in project.spots.items():
        if spot.screen not in file.rig.screens:
            raise InputError(
                f"{project.path}: target.spots.{name}.screen: expected a screen of {rig_path}, got {spot.screen!r}"
            )
    return replace(file, rig=replace(file.rig, beams=project.beams, spots=project.spots)), lab_covariance


def _lab_findings(with_covariance: bool, state: CalibrationState | None, rig_path: Path) -> list[Finding]:
    out = []
    if state is not None and state.verdict != Level.PASS.name:
        why = "; ".join(state.reasons) or "no reason given"
        what = f"{rig_path.name} has the verdict {state.verdict}: {why}"
        out.append(finding("BP-K01", Level[state.verdict], what))
    if not with_covariance:
        what = f"{rig_path.name} holds no covariance of cameras and screens: they are taken as exact"
        out.append(finding("BP-K02", Level.WARN, what))
    return out


def _rig_file(
    file: RigFile, c: BeamCalibration, project: Project, findings: Sequence[Finding], day: datetime.date
) -> RigFile:
    lab = file.calibration  # of cameras and screens: the new rig.yaml expires no later than they do
    expiry = [d for d in (lab.valid_until if lab is not None else None, expiry_date(project, day)) if d is not None]
    state = state_of(findings, day, min(expiry, default=None), project.notes)
    return RigFile(c.rig, covariance_blocks(c.covariance), state)
