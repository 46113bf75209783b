"""`beampose calibrate check`: does the stored calibration still hold today?

Known points, or a vehicle that stands still, are compared with what rig.yaml foretells. What the calibration itself
leaves uncertain counts as uncertainty here, so that only a change since then is called drift. (Points that the
calibration was made from make the check milder than it says: their own errors are in both.)
"""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calibration.drift import (
    CAMERA_KINDS,
    TURNED_ZOOMED,
    Change,
    UsualSizes,
    Verdicts,
    expected_rms,
    find_changes,
    rms_length,
)
from calibration.findings import Finding, Level, verdict
from geometry.arrays import Array
from geometry.camera import Camera
from geometry.planes import meet_plane
from geometry.rig import Rig
from lab.calibrate.drift_check.drift_expected import Compared, compare_points, compare_still, refuse_moving
from lab.calibrate.drift_check.drift_history import HistoryRow, read_history, write_history
from lab.calibrate.drift_check.drift_inputs import read_points, read_still, read_still_pose
from lab.calibrate.drift_check.drift_messages import camera_findings, other_findings, state_findings
from lab.calibrate.drift_check.drift_page import write_page
from lab.calibrate.drift_check.drift_result import (
    CameraDrift,
    DailyLimits,
    DriftOutcome,
    OtherChange,
    is_weak,
    level_of,
    not_checked,
)
from lab.errors import InputError
from lab.files.rig.rig_covariance import joint_covariance
from lab.files.rig.rig_file import RigFile, load_rig_file
from lab.files.text.atomic_write import atomic_folder, refuse_foreign
from lab.files.text.csv_text import csv_word

TABLE = "drift.csv"
COLUMNS = (
    "camera", "points", "drift_px", "noise_px", "drift_mm", "shift_u_px", "shift_v_px", "sigma_shift_u_px",
    "sigma_shift_v_px", "turn_x_deg", "turn_y_deg", "turn_z_deg", "sigma_turn_x_deg", "sigma_turn_y_deg",
    "sigma_turn_z_deg", "scale_ppm", "sigma_scale_ppm", "p_value", "detectable_px", "detectable_mm", "explanation",
    "verdict",
)  # fmt: skip


def check_drift(
    rig_path: Path,
    out: Path,
    points: Path | None = None,
    run: Path | None = None,
    today: datetime.date | None = None,
    *,
    survey: Path | None = None,
    pose: Path | None = None,
    history: Path | None = None,
    limits: DailyLimits | None = None,
) -> DriftOutcome:
    """Compare known points or a still vehicle with the stored calibration; write report.html and drift.csv into `out`.

    points: CSV camera,point,u_px,v_px[,sigma_px], places in it or in `survey` (daily_inputs.read_points). run: a run
    folder, a folder of results or a spots.csv of a vehicle at rest, whose pose is free or read from `pose`. history: a
    CSV that this check's rows are added to. Raises InputError.
    """
    refuse_foreign(out, _is_ours)
    limits = limits or DailyLimits()
    today = today or datetime.date.today()
    rig_path = Path(rig_path)
    if (points is None) == (run is None):
        got = "neither" if points is None else "both"
        raise InputError(f"expected either known points (--points) or a static run (--run), got {got}")
    if points is None and survey is not None:
        raise InputError("expected --survey together with --points: a static run needs no surveyed points")
    if run is None and pose is not None:
        raise InputError("expected --pose together with --run: known points need no pose")
    file = load_rig_file(rig_path)
    covariance = joint_covariance(file.rig, file.covariances, rig_path)
    if points is not None:
        points = Path(points)
        known = read_points(points, None if survey is None else Path(survey), file.rig, limits.point_sigma_px)
        compared = compare_points(file.rig, known, covariance, points)
        sigma_given, pose_free = known.sigma_given, False
    else:
        assert run is not None
        still = read_still(run, file.rig)
        refuse_moving(still, limits.still_px, Path(run))
        stands = None if pose is None else (read_still_pose(Path(pose)), _pose_covariance(limits))
        compared = [compare_still(file.rig, still, covariance, stands, limits.floor_px, Path(run))]
        sigma_given, pose_free = True, pose is None
    cameras, others, findings = judge(file, compared, limits, today, covariance is not None, sigma_given, pose_free)
    earlier = read_history(history) if history is not None else []
    rows = [HistoryRow(today, c.camera, c.drift_px, c.noise_px, c.drift_mm, c.level) for c in cameras]
    inputs = [rig_path, *(p for p in (points, survey, pose) if p is not None)]
    inputs += [Path(run)] if run is not None and Path(run).is_file() else []
    outcome = DriftOutcome(Path(out), verdict(findings), tuple(cameras), tuple(findings), _unchecked(file.rig, cameras))
    with atomic_folder(Path(out), may_replace=_is_ours) as work:
        write_drift_table(cameras, work / TABLE)
        write_page(outcome, file, compared, others, [*earlier, *rows], limits, today, inputs, work)
    if history is not None:
        write_history([*earlier, *rows], history)
    return outcome


def _is_ours(folder: Path) -> bool:
    return (folder / TABLE).is_file()


def _pose_covariance(limits: DailyLimits) -> Array:
    return np.diag([limits.pose_sigma_m**2] * 3 + [np.deg2rad(limits.pose_sigma_deg) ** 2] * 3)


def judge(
    file: RigFile,
    compared: list[Compared],
    limits: DailyLimits,
    today: datetime.date,
    with_covariance: bool = True,
    sigma_given: bool = True,
    pose_free: bool = False,
) -> tuple[list[CameraDrift], list[OtherChange], list[Finding]]:
    """What the comparisons say: of each camera, of points and lasers, and in words."""
    each = limits.p_false_alarm / max(len(compared), 1)
    cameras: list[CameraDrift] = []
    others: list[OtherChange] = []
    findings = state_findings(file.calibration, today, limits.expiry_warning_days)
    for one in compared:
        verdicts = find_changes(one.misfit, one.columns, one.others, each)
        found = [_camera_drift(file.rig, name, one, verdicts, limits, each) for name in one.columns]
        apart = [_other(file.rig, one, c) for c in verdicts.changes if c.kind not in CAMERA_KINDS]
        cameras += found
        others += apart
        findings += [f for c in found for f in camera_findings(c, limits, pose_free)]
    findings += other_findings(others, limits)
    unseen = _unchecked(file.rig, cameras)
    if unseen:
        findings.append(
            Finding(
                Level.WARN,
                not_checked(unseen),
                "its drift, if any, is not known",
                "measure known points in every camera",
            )
        )
    if not with_covariance:
        findings.append(
            Finding(
                Level.WARN,
                "rig.yaml holds no covariance: the calibration's own errors count as drift here",
                "the false-alarm rate is not what it says",
                "calibrate with beampose, which writes the covariance",
            )
        )
    if not sigma_given:
        findings.append(
            Finding(Level.PASS, f"the points' file gives no sigma_px: {limits.point_sigma_px:g} px is taken for each")
        )
    return cameras, others, findings


def _unchecked(rig: Rig, cameras: Sequence[CameraDrift]) -> tuple[str, ...]:
    checked = {c.camera for c in cameras}
    return tuple(name for name in rig.cameras if name not in checked)


def _camera_drift(
    rig: Rig, name: str, one: Compared, verdicts: Verdicts, limits: DailyLimits, p_false_alarm: float
) -> CameraDrift:
    camera, rows = rig.cameras[name], one.rows_of(name)
    of_rows = np.stack([2 * rows, 2 * rows + 1], axis=1).ravel()
    model = one.columns[name].model
    own = next((c for c in verdicts.changes if c.kind in CAMERA_KINDS and c.subject == name), None)
    # The numbers are of what is left when all other changes are explained.
    misfit = one.misfit.without(c for c in verdicts.changes if c is not own)
    fit = misfit.fit(TURNED_ZOOMED, name, one.columns[name].kinds(UsualSizes())[TURNED_ZOOMED])
    drift = (own or fit).displacement[of_rows].reshape(-1, 2)
    mean = model[of_rows].reshape(-1, 2, 4).mean(axis=0)
    sigmas = np.sqrt(np.maximum(np.diagonal(fit.covariance), 0))
    ways = np.zeros((len(one.misfit.white), 2))
    ways[of_rows[::2], 0] = ways[of_rows[1::2], 1] = 1.0
    tests = limits_share(p_false_alarm, len(one.columns))
    detectable = misfit.detectable(ways, model, tests, limits.power)
    foretold = one.foretold[rows]
    mm_per_px = mm_at_screen(rig, camera, foretold, np.full_like(foretold, np.sqrt(0.5)))
    left = np.full((len(rows), 2), np.nan)
    if verdicts.unexplained:
        left = (verdicts.left.factor @ verdicts.left.white)[of_rows].reshape(-1, 2)
    px, mm = rms_length(drift), mm_at_screen(rig, camera, foretold, drift)
    left_px = rms_length(left)
    left_mm = mm_at_screen(rig, camera, foretold, left) if verdicts.unexplained else float("nan")
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
        residual_px=(one.pixels - one.foretold)[rows],
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
    """The false-alarm rate of one camera's own test, as find_changes spends it."""
    return p_false_alarm / 2 / max(n_cameras, 1)


def mm_at_screen(rig: Rig, camera: Camera, pixels: Array, displacement_px: Array) -> float:
    """RMS length, mm, on the camera's screen of displacements (n, 2), px, at pixels (n, 2); nan where all rays miss.

    Taken along the ray at half the displacement to either side; the screen's bow, a few mm, changes nothing here.
    """
    screen = rig.screens[camera.screen].world_from_screen
    ends = [meet_plane(*camera.rays(pixels + sign * displacement_px / 2), screen) for sign in (-1, 1)]
    squared = np.sum((ends[1] - ends[0]) ** 2, axis=1)
    squared = squared[np.isfinite(squared)]
    return 1e3 * float(np.sqrt(squared.mean())) if len(squared) else float("nan")


def _other(rig: Rig, one: Compared, change: Change) -> OtherChange:
    moved = change.displacement.reshape(-1, 2)
    rows = np.flatnonzero(np.abs(moved).max(axis=1) > 0)
    camera = rig.cameras[one.camera[rows[0] if len(rows) else 0]]
    mm = mm_at_screen(rig, camera, one.foretold[rows[:1]], moved[rows[:1]]) if len(rows) else 0.0
    return OtherChange(change, rms_length(moved[rows].ravel()), mm)


def write_drift_table(cameras: list[CameraDrift], path: Path) -> None:
    """drift.csv: a row per camera."""
    lines = [",".join(COLUMNS)]
    for c in cameras:
        numbers = [
            c.drift_px, c.noise_px, c.drift_mm, *c.shift_px, *c.sigma_shift_px, *c.turn_deg, *c.sigma_turn_deg,
            c.scale_ppm, c.sigma_scale_ppm, c.p_value, c.detectable_px, c.detectable_mm,
        ]  # fmt: skip
        explanation = c.change.kind if c.change is not None else ""
        fields = ["" if not np.isfinite(v) else f"{v:.6g}" for v in numbers]
        lines.append(",".join([csv_word(c.camera), str(len(c.pixels)), *fields, csv_word(explanation), c.level.name]))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
