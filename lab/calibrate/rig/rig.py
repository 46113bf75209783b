"""`beampose calibrate rig`: joint calibration of lenses, cameras, screens and beams of a project.

residuals.csv of a joint calibration: the residual of every measurement.
"""

from __future__ import annotations

import datetime
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from calibration.least_squares.adjustment import AdjustmentError
from calibration.rig.joint import CORNERS, DOTS, RECORDS, SPOTS, Joint
from calibration.rig.rig_figures import (
    RigCalibration,
    calibrate_in_steps,
    central_pose,
    expected_pose,
    hold_out,
    in_degrees,
    in_mm,
    spot_sigma,
)
from calibration.screens.screens import FittedScreens
from calibration.terms.corners import CornerTerm
from calibration.terms.surveyed import RecordTerm, array_of
from geometry.arrays import Array
from geometry.rig import Rig
from lab.calibrate.beams.beams_page import (
    BeamGoals,
    beam_findings,
    check_no_duplicates,
    diagnose_failed_fit,
    stand_findings,
)
from lab.calibrate.beams.recordings import Recordings, read_recordings, stand_of
from lab.calibrate.rig.rig_page import CalibratedRig, joint_findings, page_of
from lab.calibrate.screens.screen_inputs import adjusted_screens, screen_inputs
from lab.calibrate.screens.screen_page import ScreenLimits, near_findings, network_findings, survey_findings
from lab.calibrate.step import Solved, Step, calibration_date, expiry_date, expiry_findings, run_step, state_of
from lab.errors import CalibrationError, InputError
from lab.files.project.project import Project, load_project
from lab.files.rig.rig_file import RigFile, covariance_blocks, save_rig
from lab.files.text.atomic_write import atomic_write_text
from lab.files.text.csv_text import csv_word
from lab.findings.finding import Finding, Level, Outcome, finding, passed, verdict
from lab.progress import Progress

RESIDUALS = "residuals.csv"
COLUMNS = ("kind", "name", "camera", "axis", "residual", "unit", "sigmas", "used")
_AXES = ("x", "y", "z", "rot_x", "rot_y", "rot_z")


def write_residuals(steps: RigCalibration, positions: Sequence[str], path: Path) -> None:
    """Write the table, measured minus adjusted, one row per number. Column sigmas: in units of the stated sigma."""
    lines = [",".join(COLUMNS)]
    for kind, name, camera, axis, residual, unit, sigmas, used in _rows(steps, positions):
        lines.append(f"{kind},{csv_word(name)},{camera},{axis},{residual:.6g},{unit},{sigmas:.4g},{int(used)}")
    atomic_write_text("\n".join(lines) + "\n", path)


_Row = tuple[str, str, str, str, float, str, float, bool]


def _rows(steps: RigCalibration, positions: Sequence[str]) -> Iterator[_Row]:
    joint, measured = steps.joint, steps.measured
    cameras, views = list(joint.rig.cameras), joint.rig.views()
    network = measured.network
    if SPOTS in joint.every:
        spots = measured.spots
        roots = np.linalg.cholesky(spots.covariance)
        residuals = joint.every[SPOTS].linearise(joint.values).residuals
        for i, (r, root) in enumerate(zip(residuals, roots, strict=True)):
            camera, spot = views[spots.view[i]]
            name = f"position {positions[spots.position[i]]} spot {spot}"
            yield from _pixel("spot", name, camera, -(root @ r), r, bool(joint.kept[SPOTS][i]))
    if DOTS in joint.every:
        s = network.point_observations
        residuals = joint.every[DOTS].linearise(joint.values).residuals
        for i, r in enumerate(residuals):
            name = network.control_points.names[s.point_of[i]]
            yield from _pixel("dot", name, cameras[s.camera_of[i]], -r * s.sigma_px[i], r, bool(joint.kept[DOTS][i]))
    if len(network.control_points):
        errors = network.control_points.xyz - array_of(joint.values, "points")
        sigma = np.sqrt(np.diagonal(network.control_points.covariance, axis1=1, axis2=2))
        for name, e, s1 in zip(network.control_points.names, errors, sigma, strict=True):
            for k in range(3):
                yield "survey", name, "", _AXES[k], float(1e3 * e[k]), "mm", float(e[k] / s1[k]), True
    records = joint.every.get(RECORDS)
    if isinstance(records, RecordTerm):
        yield from _records(records, joint, positions)
    corners = joint.every.get(CORNERS)
    if isinstance(corners, CornerTerm):
        for i, r in enumerate(corners.linearise(joint.values).residuals):
            name = f"{network.placements[corners.placement[i]]} corner {i}"
            px = -r * corners.sigma_px[i]
            yield from _pixel("corner", name, cameras[corners.camera[i]], px, r, bool(joint.kept[CORNERS][i]))


def _pixel(kind: str, name: str, camera: str, px: Array, sigmas: Array, used: bool) -> Iterator[_Row]:
    for axis, value, s in zip("uv", px, sigmas, strict=True):
        yield kind, name, camera, axis, float(value), "px", float(-s), used


def _records(term: RecordTerm, joint: Joint, positions: Sequence[str]) -> Iterator[_Row]:
    stated = term.sigmas
    for k, r in enumerate(term.linearise(joint.values).residuals):
        for axis in range(6):
            if np.isfinite(stated[k, axis]) and stated[k, axis] > 0:
                value = -r[axis] * stated[k, axis]
                value, unit = (1e3 * value, "mm") if axis < 3 else (np.rad2deg(value), "deg")
                name = f"position {positions[k]}"
                yield "stand", name, "", _AXES[axis], float(value), unit, float(-r[axis]), bool(joint.kept[RECORDS][k])


RIG = "rig.yaml"
FAILED_RIG = "rig.failed.yaml"  # file name if the verdict is FAIL, so that no program reads it by mistake
_STEP = Step("rig", (RESIDUALS,), RIG)
_NO_FIT_LIMITS = ScreenLimits(np.inf, np.inf, factor_warn=np.inf, factor_fail=np.inf)
_NO_SIGMA_LIMITS = BeamGoals(direction=np.inf, direction_unusable=np.inf, wrong_share=np.inf, noise_scale=np.inf)


def calibrate_rig(
    project_path: Path,
    out: Path,
    today: datetime.date | None = None,
    *,
    progress: Progress | None = None,
) -> Outcome[CalibratedRig]:
    """Calibrate a whole rig; write rig.yaml, residuals.csv and report.html into the folder `out`.

    rig.yaml holds the verdict and the joint covariance of all parameters (in the target's block; cameras and screens
    hold their own parts of it). If the verdict is FAIL, the file is called rig.failed.yaml. progress: of the search for
    a mistake in a survey. Raises InputError: for errors in the files; CalibrationError: if the measurements do not
    determine a calibration.
    """
    return run_step(_STEP, out, lambda: _solve(Path(project_path), today, progress))


def _solve(project_path: Path, today: datetime.date | None, progress: Progress | None) -> Solved[CalibratedRig]:
    project = load_project(project_path)
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
    result = CalibratedRig(steps, expected, held_out)
    findings = (
        *near_findings(screens, inputs.near),
        *joint_findings(steps, recordings.names, expected, held_out),
        *survey_findings(project, screens),
        *_step_findings(steps, rig, recordings.names),
        *expiry_findings(project, day, today),
        *map(passed, (*inputs.notes, *recordings.notes)),
        *_lens_findings(project, day),
        *stand_findings(project, recordings),
    )
    failed = verdict(findings) is Level.FAIL

    def write(folder: Path) -> None:
        state = state_of(findings, day, expiry_date(project, day), project.notes)
        file = RigFile(joint.rig, covariance_blocks(joint.covariance), state)
        save_rig(file, folder / (FAILED_RIG if failed else RIG))
        write_residuals(steps, recordings.names, folder / RESIDUALS)

    return Solved(
        name=project.name,
        result=result,
        findings=findings,
        figures=_figures(result),
        write=write,
        page=lambda: page_of(result, rig, recordings.names),
        day=day,
        inputs=project.inputs,
    )


def _figures(result: CalibratedRig) -> str:
    rig = result.steps.joint.rig
    out = f"{len(rig.cameras)} cameras, {len(rig.screens)} screens, {len(rig.beams)} beams"
    if result.expected is not None:
        out += f"; one frame: {in_degrees(result.expected.total):.2g} deg, {in_mm(result.expected.total):.2g} mm"
    if result.held_out is not None:
        deg, mm = np.rad2deg(result.held_out.attitude_rms), 1e3 * result.held_out.position_rms
        out += f"; held out: {deg:.2g} deg, {mm:.2g} mm"
    kept = result.steps.joint.kept[SPOTS]
    if not kept.all():
        out += f"; {int(np.sum(~kept))} of {len(kept)} spots excluded"
    return out


def _recordings(project: Project, lab: Rig) -> Recordings:
    """The recordings with known stand positions. lab: surveyed cameras and screens, used to label frames of runs."""
    recordings = read_recordings(project, lab)
    if recordings.stand_from_body is None:
        raise InputError(
            f"{project.path}: recordings: expected poses of the stand, got none; add `poses` to each recording, or"
            " calibrate only the angles between the beams (`beampose calibrate beams`)"
        )
    return recordings


def _solved(project: Project, screens: FittedScreens, recordings: Recordings) -> RigCalibration:
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


def _lens_findings(project: Project, day: datetime.date) -> list[Finding]:
    out = []
    for name, camera in project.cameras.items():
        state, file = camera.lens.calibration, camera.lens_path.name
        if state is not None and state.failed:
            what = f"camera {name!r}: the lens calibration {file} has the verdict FAIL{state.reason}"
            out.append(finding("BP-K04", Level.FAIL, what))
        if state is not None and (state.days_left(day) or 0) < 0:
            what = f"camera {name!r}: the lens calibration {file} expired on {state.valid_until}"
            out.append(finding("BP-K05", Level.WARN, what))
        if camera.lens.covariance is None:
            what = f"camera {name!r}: {file} has no covariance: its lens is assumed exact"
            out.append(finding("BP-K06", Level.WARN, what))
    return out
