"""`beampose calibrate beams`: direction and offset of each laser from recordings at positions of a stand."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calibration.beams.beam_findings import ARCSEC, UNDETERMINED, BeamGoals, beam_findings, direction_sigmas
from calibration.beams.beams import BeamCalibration, self_calibrate
from calibration.beams.beams import calibrate_beams as solve_beams
from calibration.beams.excitation import summary_of
from calibration.findings import Finding, Level, verdict
from calibration.least_squares.adjustment import AdjustmentError
from geometry.uncertainty.rig_uncertainty import RigCovariance
from lab.calibrate.beams.beam_tables import BEAMS, write_tables
from lab.calibrate.beams.recording_check import check_no_duplicates, diagnose_failed_fit
from lab.calibrate.beams.recordings import Recordings, read_recordings, stand_of
from lab.calibrate.calibration_date import calibration_date, expiry_date, expiry_findings
from lab.errors import CalibrationError, InputError
from lab.files.project.project import load_project
from lab.files.project.project_blocks import Project
from lab.files.rig.calibration_state import CalibrationState
from lab.files.rig.rig_file import RigFile, covariance_blocks, joint_covariance, load_rig_file, save_rig
from lab.files.rig.screens_file import load_screens
from lab.files.text.atomic_write import atomic_folder, check_output_folder, keep_good_results
from lab.files.text.error_text import suggest_name
from lab.files.text.yaml_text import read_mapping

RIG = "rig.yaml"


@dataclass(frozen=True, slots=True)
class BeamsOutcome:
    """Result of a beam calibration."""

    name: str
    out: Path
    level: Level
    findings: tuple[Finding, ...]
    calibration: BeamCalibration
    rig: Path | None  # the rig.yaml written; None where the verdict is FAIL

    @property
    def exit_status(self) -> int:
        """0, or 3 if the calibration must not be used."""
        return CalibrationError.exit_status if self.level == Level.FAIL else 0

    def line(self) -> str:
        """One line for the terminal."""
        c = self.calibration
        sigma = float(np.sqrt(np.mean(direction_sigmas(c) ** 2))) / ARCSEC
        worst = max(self.findings, key=lambda f: f.level)
        what = f"{len(c.lines)} beams from {len(c.world_from_body.translation)} positions"
        if c.world_from_stand is None and c.angles:
            between = float(np.sqrt(np.mean([a.sigma**2 for a in c.angles]))) / ARCSEC
            what += f" at unknown poses, angles between beams to {between:.3g} arcsec RMS"
        elif not c.undetermined:
            what += f", directions to {sigma:.3g} arcsec RMS"
        if not c.fit.kept.all():
            what += f", {int(np.sum(~c.fit.kept))} of {len(c.fit.kept)} spots excluded"
        warnings = sum(f.level == Level.WARN for f in self.findings)
        reason = f"; {warnings} warning{'s' if warnings > 1 else ''}, see report.html" if warnings else ""
        if self.level == Level.FAIL:
            what_failed = worst.what.split(" (")[0]
            if c.undetermined and worst.what.startswith(UNDETERMINED):
                what_failed = f"{UNDETERMINED}: {summary_of(c.undetermined)}"
            reason = f"; {what_failed}: {worst.remedy}"
        return f"{self.name}: {self.level.name}: {what}{reason} -> {self.out}"


def calibrate_beams(
    project_path: Path, out: Path, rig: Path | None = None, today: datetime.date | None = None
) -> BeamsOutcome:
    """Calibrate the beams of a project; write three tables, report.html and, unless the verdict is FAIL, rig.yaml.

    rig: the rig.yaml or screens.yaml with the calibrated cameras and screens and their covariances (None: `rig.yaml`
    beside the project). The project need not repeat cameras, screens and target; if it has a target, this replaces
    the rig's. A FAIL never replaces an earlier calibration: its results go to `OUT-failed`.

    Raises:
        InputError: for errors in the files.
        CalibrationError: if the spots do not determine a calibration. `out` is left unchanged.
    """
    check_output_folder(out, _is_ours)
    project = load_project(Path(project_path), lab_known=True)
    day = calibration_date(project, today)
    check_no_duplicates(project)
    rig_path = Path(rig) if rig is not None else project.path.parent / RIG
    file, lab_covariance = _calibrated_lab(project, rig_path)
    recordings = read_recordings(project, file.rig)
    try:
        if recordings.stand_from_body is None:
            found = self_calibrate(file.rig, recordings.spots, len(recordings.names), lab_covariance)
        else:
            found = solve_beams(file.rig, recordings.spots, stand_of(project, recordings), lab_covariance)
    except AdjustmentError as error:
        if recordings.stand_from_body is not None:
            diagnose_failed_fit(project, file.rig, recordings, lab_covariance)
        raise CalibrationError(f"{project.path}: the beams cannot be calibrated: {error}") from None
    findings = [
        *beam_findings(found, file.rig, recordings.names, BeamGoals()),
        *expiry_findings(project, day, today),
        *_input_findings(project, recordings, lab_covariance is not None, file.calibration, rig_path),
    ]
    level = verdict(findings)
    folder = keep_good_results(out, level == Level.FAIL, RIG)
    outcome = BeamsOutcome(
        project.name, folder, level, tuple(findings), found, None if level == Level.FAIL else folder / RIG
    )
    with atomic_folder(folder, may_replace=_is_ours) as work:
        write_tables(found, file.rig, recordings.names, work)
        if level != Level.FAIL:
            save_rig(_rig_file(file, found, project, findings, day), work / RIG)
        from lab.calibrate.beams.beams_page import write_page  # imports the template engine

        inputs = [rig_path, *project.inputs]
        write_page(project.name, found, findings, file.rig, recordings.names, inputs, day, work)
    return outcome


def _is_ours(folder: Path) -> bool:
    return (folder / BEAMS).is_file()


def _calibrated_lab(project: Project, rig_path: Path) -> tuple[RigFile, RigCovariance | None]:
    """The calibrated cameras and screens with the project's target, and the covariance of cameras and screens."""
    if not rig_path.is_file():
        raise InputError(
            f"{rig_path}: expected a rig.yaml with calibrated cameras and screens, found no file; run"
            f" `beampose calibrate screen {project.path}` first and give its rig.yaml with --rig"
        )
    file, lab_covariance = _lab_file(rig_path)
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


def _lab_file(path: Path) -> tuple[RigFile, RigCovariance | None]:
    """Cameras and screens of a rig.yaml or a screens.yaml, and their covariance where the file states it."""
    if str(read_mapping(path).get("schema", "")).startswith("beampose/screens/"):
        screens = load_screens(path)
        return RigFile(screens.rig, {}, screens.calibration), screens.covariance
    file = load_rig_file(path)
    return file, joint_covariance(file.rig, file.covariances, path)


def _input_findings(
    project: Project, recordings: Recordings, with_covariance: bool, lab_state: CalibrationState | None, rig_path: Path
) -> list[Finding]:
    out = [Finding(Level.PASS, note) for note in recordings.notes]
    if lab_state is not None and lab_state.verdict != Level.PASS.name:
        out.append(
            Finding(
                Level[lab_state.verdict],
                f"{rig_path.name} has the verdict {lab_state.verdict}:"
                f" {'; '.join(lab_state.reasons) or 'no reason given'}",
                "errors of cameras and screens carry over to the beams",
                "see the report beside it",
                code="BP-K01",
            )
        )
    if not with_covariance:
        out.append(
            Finding(
                Level.WARN,
                f"{rig_path.name} holds no covariance of cameras and screens: they are taken as exact",
                "the sigmas of the beams are of the spots' noise alone, too small",
                "calibrate cameras and screens with beampose, which writes their covariance",
                code="BP-K02",
            )
        )
    stand = project.stand
    placed = recordings.stand_from_body is not None and stand is not None and stand.world_from_stand is not None
    if placed and stand is not None and stand.sigma_m == stand.sigma_rad == 0:
        out.append(
            Finding(
                Level.WARN,
                "stand.world_from_stand has no sigma: it is assumed exact",
                "its error goes unnoticed into the boresight of all beams",
                "give stand.sigma_m and stand.sigma_deg, or omit world_from_stand so that it is estimated",
                code="BP-K03",
            )
        )
    if recordings.stand_from_body is not None and not np.any(recordings.pose_sigmas):
        out.append(
            Finding(
                Level.PASS,
                "the stand's positions are assumed exact; give stand.pose_sigma_m and pose_sigma_deg unless its"
                " encoders are much more precise than the spots",
            )
        )
    return out


def _rig_file(
    file: RigFile, c: BeamCalibration, project: Project, findings: Sequence[Finding], day: datetime.date
) -> RigFile:
    lab = file.calibration  # of cameras and screens: the new rig.yaml expires no later than they do
    expiry = [d for d in (lab.valid_until if lab is not None else None, expiry_date(project, day)) if d is not None]
    reasons = [f.what for f in findings if f.level > Level.PASS]
    state = CalibrationState(day, verdict(findings).name, min(expiry, default=None), tuple(reasons), project.notes)
    return RigFile(c.rig, covariance_blocks(c.covariance), state)
