"""`beampose calibrate rig`: joint calibration of lenses, cameras, screens and beams of a project."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from calibration.beams.beam_findings import BeamGoals, beam_findings
from calibration.findings import Finding, Level, verdict
from calibration.least_squares.adjustment import AdjustmentError
from calibration.rig.joint_findings import RigLimits, joint_findings
from calibration.rig.rig_figures import central_pose, expected_pose, hold_out, spot_sigma
from calibration.rig.rig_steps import RigCalibration, calibrate_in_steps
from calibration.screens.network_findings import ScreenLimits, near_findings
from calibration.screens.network_findings import findings as network_findings
from calibration.screens.screens import ScreensResult
from geometry.rig import Rig
from lab.calibrate.beams.recording_check import check_no_duplicates, diagnose_failed_fit
from lab.calibrate.beams.recordings import Recordings, read_recordings, stand_of
from lab.calibrate.calibration_date import calibration_date, expiry_date, expiry_findings
from lab.calibrate.rig.rig_outcome import RigOutcome
from lab.calibrate.rig.rig_tables import RESIDUALS, write_residuals
from lab.calibrate.screens.screen_inputs import (
    ScreenInputs,
    SearchProgress,
    adjusted_screens,
    screen_inputs,
    survey_findings,
)
from lab.errors import CalibrationError, InputError
from lab.files.project.project import load_project
from lab.files.project.project_blocks import Project
from lab.files.rig.calibration_state import CalibrationState
from lab.files.rig.rig_file import RigFile, covariance_blocks, save_rig
from lab.files.text.atomic_write import atomic_folder, check_output_folder, keep_good_results

RIG = "rig.yaml"
FAILED_RIG = "rig.failed.yaml"  # file name if the verdict is FAIL, so that no program reads it by mistake
_NO_FIT_LIMITS = ScreenLimits(np.inf, np.inf, factor_warn=np.inf, factor_fail=np.inf)
_NO_SIGMA_LIMITS = BeamGoals(direction=np.inf, direction_unusable=np.inf, wrong_share=np.inf, noise_scale=np.inf)


def calibrate_rig(
    project_path: Path,
    out: Path,
    today: datetime.date | None = None,
    limits: RigLimits | None = None,
    *,
    progress: SearchProgress | None = None,
) -> RigOutcome:
    """Calibrate a whole rig; write rig.yaml, residuals.csv and report.html into the folder `out`.

    rig.yaml holds the verdict and the joint covariance of all parameters (in the target's block; cameras and screens
    hold their own parts of it). If the verdict is FAIL, the file is called rig.failed.yaml; a FAIL never replaces an
    earlier calibration, its results go to `OUT-failed`. progress: of the search for a mistake in a survey.

    Raises:
        InputError: for errors in the files.
        CalibrationError: if the measurements do not determine a calibration. Nothing is written.
    """
    check_output_folder(out, _is_ours)
    project = load_project(Path(project_path))
    day = calibration_date(project, today)
    check_no_duplicates(project)
    if not project.beams or not project.spots:
        raise InputError(
            f"{project.path}: target: expected the nominal beams and spots, got none; add them, or calibrate only the"
            " screens (`beampose calibrate screen`)"
        )
    inputs = screen_inputs(project)
    rig = replace(inputs.network.rig, beams=project.beams, spots=project.spots)
    inputs = replace(inputs, network=replace(inputs.network, rig=rig))
    screens = adjusted_screens(project, inputs, progress)
    recordings = _recordings(project, screens.fit.rig)
    steps = _solved(project, screens, recordings)
    joint = steps.joint
    expected = expected_pose(joint, central_pose(joint), spot_sigma(joint))
    try:
        held_out = hold_out(steps.measured, joint)
    except AdjustmentError:
        held_out = None
    findings = [
        *near_findings(screens, inputs.near),
        *joint_findings(steps, recordings.names, expected, held_out, limits or RigLimits()),
        *survey_findings(project, screens),
        *_step_findings(steps, rig, recordings.names),
        *expiry_findings(project, day, today),
        *_input_findings(project, recordings, inputs, day),
    ]
    level = verdict(findings)
    folder = keep_good_results(out, level == Level.FAIL, RIG)
    outcome = RigOutcome(project.name, folder, level, tuple(findings), steps, expected, held_out)
    with atomic_folder(folder, may_replace=_is_ours) as work:
        save_rig(_rig_file(outcome, project, day), work / (FAILED_RIG if level == Level.FAIL else RIG))
        write_residuals(steps, recordings.names, work / RESIDUALS)
        from lab.calibrate.rig.rig_page import write_page  # imports the template engine

        write_page(outcome, rig, recordings, project.inputs, day, work)
    return outcome


def _is_ours(folder: Path) -> bool:
    return (folder / RESIDUALS).is_file()


def _recordings(project: Project, lab: Rig) -> Recordings:
    """The recordings with known stand positions. lab: surveyed cameras and screens, used to label frames of runs."""
    recordings = read_recordings(project, lab)
    if recordings.stand_from_body is None:
        raise InputError(
            f"{project.path}: recordings: expected poses of the stand, got none; add `poses` to each recording, or"
            " calibrate only the angles between the beams (`beampose calibrate beams`)"
        )
    return recordings


def _solved(project: Project, screens: ScreensResult, recordings: Recordings) -> RigCalibration:
    try:
        return calibrate_in_steps(screens, recordings.spots, stand_of(project, recordings))
    except (AdjustmentError, ValueError) as error:
        diagnose_failed_fit(project, screens.fit.rig, recordings, screens.fit.covariance)
        raise CalibrationError(f"{project.path}: the rig cannot be calibrated: {error}") from None


def _step_findings(steps: RigCalibration, nominal: Rig, positions: Sequence[str]) -> list[Finding]:
    """Warnings of the single steps about the measurements. The quality of the fit is judged on the joint adjustment."""
    beams = steps.beams
    if steps.joint.scales:
        # The test whether two ends form one line used the original sigmas, which turned out too small.
        beams = replace(beams, collinearity=())
    out = network_findings(steps.screens, _NO_FIT_LIMITS) + beam_findings(beams, nominal, positions, _NO_SIGMA_LIMITS)
    return [f for f in out if f.level > Level.PASS]


def _input_findings(
    project: Project, recordings: Recordings, inputs: ScreenInputs, day: datetime.date
) -> list[Finding]:
    out = [Finding(Level.PASS, note) for note in (*inputs.notes, *recordings.notes)]
    for name, camera in project.cameras.items():
        state = camera.lens.calibration
        if state is not None and state.verdict == "FAIL":
            why = f": {state.reasons[0]}" if state.reasons else ""
            out.append(
                Finding(
                    Level.FAIL,
                    f"camera {name!r}: the lens calibration {camera.lens_path.name} has the verdict FAIL{why}",
                    "an error of the lens distorts every measurement of the camera",
                    "calibrate the lens again (`beampose calibrate camera`)",
                    code="BP-K04",
                )
            )
        if state is not None and state.valid_until and state.valid_until < day.isoformat():
            out.append(
                Finding(
                    Level.WARN,
                    f"camera {name!r}: the lens calibration {camera.lens_path.name} expired on {state.valid_until}",
                    "lenses change with time and temperature",
                    "calibrate the lens again (`beampose calibrate camera`)",
                    code="BP-K05",
                )
            )
        if camera.lens.covariance is None:
            out.append(
                Finding(
                    Level.WARN,
                    f"camera {name!r}: {camera.lens_path.name} has no covariance: its lens is assumed exact",
                    "all sigmas are too small, since the error of the lens is missing in them",
                    "calibrate the lens with beampose, which writes the covariance",
                    code="BP-K06",
                )
            )
    stand = project.stand
    if stand is not None and stand.world_from_stand is not None and stand.sigma_m == 0 and stand.sigma_rad == 0:
        out.append(
            Finding(
                Level.WARN,
                "stand.world_from_stand has no sigma: it is assumed exact",
                "its error goes unnoticed into the boresight of all beams",
                "give stand.sigma_m and stand.sigma_deg, or omit world_from_stand so that it is estimated",
                code="BP-K03",
            )
        )
    if not np.any(recordings.pose_sigmas):
        out.append(
            Finding(
                Level.PASS,
                "the stand's positions are assumed exact; give stand.pose_sigma_m and pose_sigma_deg unless its"
                " encoders are much more precise than the spots",
            )
        )
    return out


def _rig_file(outcome: RigOutcome, project: Project, day: datetime.date) -> RigFile:
    joint = outcome.steps.joint
    until = expiry_date(project, day)
    worst_first = sorted(outcome.findings, key=lambda f: -f.level)
    reasons = tuple(f.what for f in worst_first if f.level > Level.PASS)
    state = CalibrationState(day, outcome.level.name, until, reasons, project.notes)
    return RigFile(joint.rig, covariance_blocks(joint.covariance), state)
