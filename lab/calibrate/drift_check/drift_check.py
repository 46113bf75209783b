"""`beampose calibrate check`: checks a stored calibration for drift.

The pixels of known points, or of a vehicle at rest, are compared with the prediction by rig.yaml. The covariance of the
calibration is part of the test, so that only a change since the calibration counts as drift. (With points that were
used in the calibration, the test is less sensitive than stated: their errors are in the calibration too.)
"""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration.changes import (
    CAMERA_KINDS,
    TURNED_ZOOMED,
    Change,
    FoundChanges,
    expected_rms,
    find_changes,
    rms_length,
)
from geometry.arrays import Array
from geometry.camera import Camera
from geometry.planes import intersect_plane
from geometry.rig import Rig
from lab.calibrate.drift_check.drift_comparison import (
    CameraDrift,
    DriftLimits,
    DriftResult,
    HistoryRow,
    OtherChange,
    PixelComparison,
    check_at_rest,
    compare_points,
    compare_still,
    is_weak,
    level_of,
    read_history,
    write_history,
)
from lab.calibrate.drift_check.drift_inputs import DriftInputs, read_points, read_still_pose, read_still_spots
from lab.calibrate.drift_check.drift_page import (
    camera_findings,
    other_findings,
    page_of,
    state_findings,
    unchecked_finding,
)
from lab.calibrate.step import Solved, Step, run_step
from lab.files.rig.rig_file import RigFile, joint_covariance, load_rig_file
from lab.files.text.csv_text import write_table
from lab.findings.finding import Finding, Level, finding, passed
from lab.findings.outcome import Outcome

TABLE = "drift.csv"
COLUMNS = (
    "camera", "points", "drift_px", "noise_px", "drift_mm", "shift_u_px", "shift_v_px", "sigma_shift_u_px",
    "sigma_shift_v_px", "turn_x_deg", "turn_y_deg", "turn_z_deg", "sigma_turn_x_deg", "sigma_turn_y_deg",
    "sigma_turn_z_deg", "scale_ppm", "sigma_scale_ppm", "p_value", "detectable_px", "detectable_mm", "explanation",
    "verdict",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class CheckData:
    """Measured and predicted pixels of a check, and how they were obtained."""

    comparisons: list[PixelComparison]
    with_covariance: bool  # whether rig.yaml has a covariance
    sigma_given: bool  # whether the points' file states sigmas
    pose_free: bool  # whether the vehicle's pose was fitted


_STEP = Step("drift check", (TABLE,))


def check_drift(
    rig_path: Path,
    out: Path,
    inputs: DriftInputs,
    today: datetime.date | None = None,
    *,
    history: Path | None = None,
    limits: DriftLimits | None = None,
) -> Outcome[DriftResult]:
    """Compare known points or a vehicle at rest with the stored calibration; write report.html and drift.csv to `out`.

    history: a CSV to which the rows of this check are appended. Raises InputError: for errors in the files.
    """
    day = today or datetime.date.today()
    earlier = read_history(history) if history is not None else []
    outcome = run_step(_STEP, out, lambda: _solve(Path(rig_path), inputs, day, earlier, limits or DriftLimits()))
    if history is not None:
        write_history([*earlier, *_rows(outcome.result, day)], history)
    return outcome


def _solve(
    rig_path: Path, inputs: DriftInputs, today: datetime.date, earlier: list[HistoryRow], limits: DriftLimits
) -> Solved[DriftResult]:
    inputs.check()
    file = load_rig_file(rig_path)
    data = _compare(file, rig_path, inputs, limits)
    result, findings = judge(file, data, limits, today)
    drifts = ", ".join(f"{c.camera} {_two(c.drift_px)} px / {_two(c.drift_mm)} mm" for c in result.cameras)
    return Solved(
        name="drift check",
        title=f"check of {today.isoformat()}",
        result=result,
        findings=findings,
        figures=drifts + (f"; not checked: {', '.join(result.unchecked)}" if result.unchecked else ""),
        write=lambda folder: write_drift_table(result.cameras, folder / TABLE),
        page=lambda: page_of(result, file, data.comparisons, [*earlier, *_rows(result, today)], limits, today),
        day=today,
        inputs=[rig_path, *inputs.files()],
    )


def _rows(result: DriftResult, day: datetime.date) -> list[HistoryRow]:
    return [HistoryRow(day, c.camera, c.drift_px, c.noise_px, c.drift_mm, c.level) for c in result.cameras]


def _two(value: float) -> str:
    return "?" if not np.isfinite(value) else f"{value:.2f}"


def _compare(file: RigFile, rig_path: Path, inputs: DriftInputs, limits: DriftLimits) -> CheckData:
    """Read the measurements and compare them with the prediction by the rig."""
    covariance = joint_covariance(file.rig, file.covariances, rig_path)
    if inputs.points is not None:
        known = read_points(inputs.points, inputs.survey, file.rig, limits.point_sigma_px)
        compared = compare_points(file.rig, known, covariance, inputs.points)
        return CheckData(compared, covariance is not None, known.sigma_given, pose_free=False)
    assert inputs.run is not None
    still = read_still_spots(inputs.run, file.rig)
    check_at_rest(still, limits.still_px, inputs.run)
    pose = None if inputs.pose is None else (read_still_pose(inputs.pose), _pose_covariance(limits))
    compared = [compare_still(file.rig, still, covariance, pose, limits.floor_px, inputs.run)]
    return CheckData(compared, covariance is not None, sigma_given=True, pose_free=pose is None)


def _pose_covariance(limits: DriftLimits) -> Array:
    return np.diag([limits.pose_sigma_m**2] * 3 + [np.deg2rad(limits.pose_sigma_deg) ** 2] * 3)


def judge(
    file: RigFile, data: CheckData, limits: DriftLimits, today: datetime.date
) -> tuple[DriftResult, tuple[Finding, ...]]:
    """Judge a check: the drift of each camera, wrong points and moved lasers, and the findings."""
    p_each = limits.p_false_alarm / max(len(data.comparisons), 1)
    cameras: list[CameraDrift] = []
    others: list[OtherChange] = []
    findings = state_findings(file.calibration, today, limits.expiry_warning_days)
    for one in data.comparisons:
        verdicts = find_changes(one.misfit, one.columns, one.others, p_each)
        drifts = [_camera_drift(file.rig, name, one, verdicts, limits, p_each) for name in one.columns]
        cameras += drifts
        others += [_other(file.rig, one, c) for c in verdicts.changes if c.kind not in CAMERA_KINDS]
        findings += [f for c in drifts for f in camera_findings(c, limits, data.pose_free)]
    findings += other_findings(others, limits)
    checked = {c.camera for c in cameras}
    unchecked = tuple(name for name in file.rig.cameras if name not in checked)
    if unchecked:
        findings.append(unchecked_finding(unchecked))
    if not data.with_covariance:
        what = "rig.yaml has no covariance: the calibration's own errors count as drift here"
        findings.append(finding("BP-C11", Level.WARN, what))
    if not data.sigma_given:
        findings.append(passed(f"the points' file has no sigma_px: {limits.point_sigma_px:g} px is assumed"))
    return DriftResult(tuple(cameras), tuple(others), unchecked), tuple(findings)


def _camera_drift(
    rig: Rig, name: str, one: PixelComparison, verdicts: FoundChanges, limits: DriftLimits, p_false_alarm: float
) -> CameraDrift:
    camera, rows = rig.cameras[name], one.rows_of(name)
    of_rows = np.stack([2 * rows, 2 * rows + 1], axis=1).ravel()
    model = one.columns[name].model
    own = next((c for c in verdicts.changes if c.kind in CAMERA_KINDS and c.subject == name), None)
    # The figures are computed after removing all other changes.
    misfit = one.misfit.without(c for c in verdicts.changes if c is not own)
    fit = misfit.fit(TURNED_ZOOMED, name, one.columns[name].kinds()[TURNED_ZOOMED])
    drift = (own or fit).displacement[of_rows].reshape(-1, 2)
    mean = model[of_rows].reshape(-1, 2, 4).mean(axis=0)
    sigmas = np.sqrt(np.maximum(np.diagonal(fit.covariance), 0))
    ways = np.zeros((len(one.misfit.white), 2))
    ways[of_rows[::2], 0] = ways[of_rows[1::2], 1] = 1.0
    tests = limits_share(p_false_alarm, len(one.columns))
    detectable = misfit.detectable(ways, model, tests, limits.power)
    predicted = one.predicted[rows]
    mm_per_px = mm_at_screen(rig, camera, predicted, np.full_like(predicted, np.sqrt(0.5)))
    left = np.full((len(rows), 2), np.nan)
    if verdicts.unexplained:
        left = (verdicts.left.factor @ verdicts.left.white)[of_rows].reshape(-1, 2)
    px, mm = rms_length(drift), mm_at_screen(rig, camera, predicted, drift)
    left_px = rms_length(left)
    left_mm = mm_at_screen(rig, camera, predicted, left) if verdicts.unexplained else float("nan")
    level = Level.PASS
    if own is not None:
        level = level_of(px, mm, limits)
    if verdicts.unexplained:
        level = max(level, level_of(left_px, left_mm, limits))
    elif own is None and is_weak(detectable * mm_per_px, limits):
        level = Level.WARN
    return CameraDrift(
        camera=name,
        pixels=one.pixels[rows],
        residual_px=(one.pixels - one.predicted)[rows],
        explained_px=drift if own is not None else np.zeros_like(drift),
        drift_px=px,
        noise_px=expected_rms(model[of_rows], fit.noise),
        drift_mm=mm,
        shift_px=drift.mean(axis=0),
        sigma_shift_px=np.sqrt(np.maximum(np.diagonal(mean @ fit.covariance @ mean.T), 0)),
        turn_deg=np.rad2deg(fit.delta[:3]),
        sigma_turn_deg=np.rad2deg(sigmas[:3]),
        scale_ppm=1e6 * float(fit.delta[3]),
        sigma_scale_ppm=1e6 * float(sigmas[3]),
        p_value=fit.p_value,
        detectable_px=detectable,
        detectable_mm=detectable * mm_per_px,
        change=own,
        unexplained_px=left_px,
        unexplained_mm=left_mm,
        level=level,
    )


def limits_share(p_false_alarm: float, n_cameras: int) -> float:
    """Share of the false-alarm rate that `find_changes` gives to the test of one camera."""
    return p_false_alarm / 2 / max(n_cameras, 1)


def mm_at_screen(rig: Rig, camera: Camera, pixels: Array, displacement_px: Array) -> float:
    """RMS length on the camera's screen, mm, of displacements (n, 2), px, at pixels (n, 2); nan if all rays miss it.

    Distance between the points of the screen at half the displacement to either side; its bow, a few mm, is neglected.
    """
    screen = rig.screens[camera.screen].world_from_screen
    ends = [intersect_plane(*camera.rays(pixels + sign * displacement_px / 2), screen) for sign in (-1, 1)]
    squared = np.sum((ends[1] - ends[0]) ** 2, axis=1)
    squared = squared[np.isfinite(squared)]
    return 1e3 * float(np.sqrt(squared.mean())) if len(squared) else float("nan")


def _other(rig: Rig, one: PixelComparison, change: Change) -> OtherChange:
    moved = change.displacement.reshape(-1, 2)
    rows = np.flatnonzero(np.abs(moved).max(axis=1) > 0)
    camera = rig.cameras[one.camera[rows[0] if len(rows) else 0]]
    mm = mm_at_screen(rig, camera, one.predicted[rows[:1]], moved[rows[:1]]) if len(rows) else 0.0
    return OtherChange(change, rms_length(moved[rows].ravel()), mm)


def write_drift_table(cameras: Sequence[CameraDrift], path: Path) -> None:
    """Write drift.csv, a row per camera."""
    rows: list[list[object]] = []
    for c in cameras:
        numbers = [
            c.drift_px, c.noise_px, c.drift_mm, *c.shift_px, *c.sigma_shift_px, *c.turn_deg, *c.sigma_turn_deg,
            c.scale_ppm, c.sigma_scale_ppm, c.p_value, c.detectable_px, c.detectable_mm,
        ]  # fmt: skip
        explanation = c.change.kind if c.change is not None else ""
        fields = ["" if not np.isfinite(v) else f"{v:.6g}" for v in numbers]
        rows.append([c.camera, len(c.pixels), *fields, explanation, c.level.name])
    write_table(path, COLUMNS, rows)
