"""`beampose check`: reads a rig file or a run folder as a run does, and reports what it finds."""

from __future__ import annotations

import datetime
from pathlib import Path

import numpy as np

from geometry import rotations
from geometry.forward_model import SpotModel
from geometry.pose_prior import PosePrior
from geometry.pose_solver.gauss_newton import SolveLimits
from geometry.pose_solver.visibility import symmetries
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigCovariance
from lab.errors import CalibrationError, InputError
from lab.files.rig.calibration_state import CalibrationState, require_valid_calibration
from lab.files.rig.rig_file import joint_covariance, load_rig_file
from lab.files.run.run_file import Run, load_run
from lab.findings.outcome import Done
from lab.progress import Progress
from lab.runs.frames.open_frames import open_frames
from lab.runs.input_check.findings import Findings, table
from lab.runs.input_check.pictures import check_pictures
from lab.runs.input_check.setup import check_recording, check_rig
from lab.runs.input_check.visibility import check_visibility
from tracking.parameters import LabelParameters


def check(path: Path, progress: Progress | None = None) -> Done[None]:
    """Check a rig.yaml, or a run folder with all its pictures, which are decoded one by one.

    Errors of the input become lines of the result.
    """
    path = Path(path)
    if path.is_dir() or path.name == "run.yaml":
        return _check_run(path, progress)
    findings = Findings(str(path))
    try:
        file = load_rig_file(path)
        rig, covariance = file.rig, joint_covariance(file.rig, file.covariances, path)
    except InputError as error:
        findings.add_error(error)
    else:
        _describe_rig(findings, rig)
        check_rig(findings, rig, None, LabelParameters())
        _describe_calibration(findings, file.calibration, covariance, path, None)
        check_visibility(findings, rig, None, SolveLimits(), str(path))
    return findings.result()


def _check_run(folder: Path, progress: Progress | None) -> Done[None]:
    findings = Findings(str(folder))
    try:
        run = load_run(folder)
    except InputError as error:
        findings.add_error(error)
        return findings.result()
    findings.subject = f"{folder} ({run.name})"
    _describe_rig(findings, run.rig)
    with_truth = (run.folder / "truth" / "pose.csv").exists()
    check_rig(findings, run.rig, run.prior, run.tracker.labels, with_truth)
    _describe_calibration(findings, run.calibration, run.covariance, run.rig_path, run.recorded)
    for name in run.left_out:
        findings.remarks.append(
            f"{run.path}: cameras: camera {name!r} of the rig is left out; the run works without it"
        )
    for outside in run.paths_outside:
        findings.facts += ["", f"Read from outside the run folder: {outside}"]
    if run.prior is None:
        _describe_search(findings, run)
    try:
        reader = open_frames(run)
    except InputError as error:
        findings.add_error(error)
    else:
        check_recording(findings, run, check_pictures(findings, run, reader, progress))
    limits = SolveLimits(run.tracker.max_sigma_m, float(np.deg2rad(run.tracker.max_sigma_deg)))
    check_visibility(findings, run.rig, run.prior, limits, str(run.rig_path))
    return findings.result()


def _describe_calibration(
    findings: Findings,
    state: CalibrationState | None,
    covariance: RigCovariance | None,
    path: Path,
    recorded: datetime.date | None,
) -> None:
    """Date and verdict of the calibration, and whether it may be used on the day of the recording (or today)."""
    try:
        day = datetime.date.today() if recorded is None else recorded
        require_valid_calibration(state, path, day, "today" if recorded is None else "the recording's day")
    except CalibrationError as error:
        findings.unusable += str(error).splitlines()
    text = "the rig file does not state when it was calibrated"
    if state is not None:
        until = "" if state.valid_until is None else f", {state.validity}"
        text = f"calibrated {state.date.isoformat()}: {state.verdict}{until}"
    known = "no covariance: sigmas will include the noise only"
    if covariance is not None:
        known = f"covariance of {len(covariance.names)} numbers: sigmas will include the calibration's errors too"
    findings.facts += ["", "Calibration", f"  {text}", f"  {known}"]


def _describe_search(findings: Findings, run: Run) -> None:
    """For a run without a prior: the range that is searched, and whether the rig is symmetric."""
    space = PosePrior.everywhere(run.rig)
    centre = ", ".join(f"{v + 0.0:.3g}" for v in space.centre.translation)
    findings.facts += [
        "",
        "Prior: none given; the first pose is searched for among all that show enough spots,"
        f" within {space.within_m:.3g} m of ({centre}), in any attitude",
    ]
    for turn in symmetries(SpotModel.of(run.rig)):
        findings.remarks.append(
            f"{run.path}: prior: none given, and a rotation by"
            f" {np.rad2deg(rotations.angle(turn.rotation)):.4g} deg maps the beams onto each other: the first labels"
            " remain ambiguous between these poses. Add"
            " prior: {position_m: [x, y, z], yaw_pitch_roll_deg: [yaw, pitch, roll], within_m: 0.5, within_deg: 30}"
            " with the approximate first pose"
        )


def _describe_rig(findings: Findings, rig: Rig) -> None:
    watched = {camera.screen for camera in rig.cameras.values()}
    findings.facts.append("Rig")
    rows = []
    for c in rig.cameras.values():
        spots = [s.name for s in rig.spots.values() if s.screen == c.screen]
        size = f"{c.image_size_px[0]}x{c.image_size_px[1]} px"
        rows.append((c.name, size, f"screen {c.screen}", f"spots {', '.join(spots)}" if spots else "no spots"))
        if not spots:
            findings.remarks.append(f"cameras.{c.name}: no spot falls on the screen {c.screen!r} that it observes")
    findings.facts += table(("camera", "picture", "observes", ""), rows)
    for s in rig.spots.values():
        if s.screen not in watched:
            findings.remarks.append(f"target.spots.{s.name}: no camera observes its screen {s.screen!r}")
