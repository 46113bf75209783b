"""`beampose calibrate check`: checks a stored calibration for drift; its findings and its report.

The pixels of known points, or of a vehicle at rest, are compared with the prediction by rig.yaml. The covariance of the
calibration is part of the test, so that only a change since the calibration counts as drift. (With points that were
used in the calibration, the test is less sensitive than stated: their errors are in the calibration too.)
"""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calibration.changes import (
    ALL_CHANGED,
    CAMERA_KINDS,
    LASER_MOVED,
    TURNED,
    TURNED_ZOOMED,
    ZOOMED,
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
from lab.calibrate.step import Solved, Step, run_step
from lab.files.rig.camera_file import CalibrationState
from lab.files.rig.rig_file import RigFile, joint_covariance, load_rig_file
from lab.files.text.csv_text import write_table
from lab.findings.finding import Finding, Level, Outcome, finding, passed
from lab.number_format import decimals_of, format_count, format_number, format_p
from lab.report.calibration.calibration_drawings import DriftLine, corners_overlay, drift_chart
from lab.report.calibration.calibration_scene import Marker, rig_things, scene_views
from lab.report.page import KeyFigure, PageDrawing, PageTable, Section


def state_findings(state: CalibrationState | None, today: datetime.date, warning_days: int) -> list[Finding]:
    """Findings on the date, verdict and expiry of the calibration in rig.yaml."""
    if state is None:
        what = "rig.yaml does not state when it was calibrated (no block `calibration`)"
        return [finding("BP-C01", Level.WARN, what)]
    out = []
    if state.failed:
        why = state.reasons[0] if state.reasons else "no reason given"
        out.append(finding("BP-C02", Level.FAIL, f"the calibration of {state.date} failed: {why}"))
    if state.date > today:
        out.append(finding("BP-C03", Level.WARN, f"the calibration is dated {state.date}, after today ({today})"))
    left = state.days_left(today)
    if left is not None and left < 0:
        what = f"the calibration expired on {state.valid_until}, {format_count(-left, 'day')} ago"
        out.append(finding("BP-C04", Level.FAIL, what))
    elif left is not None and left <= warning_days:
        what = f"the calibration expires on {state.valid_until}, in {format_count(left, 'day')}"
        out.append(finding("BP-C05", Level.WARN, what))
    else:
        out.append(passed(f"calibrated on {state.date}, {state.validity}"))
    return out


def unchecked_finding(cameras: Sequence[str]) -> Finding:
    """The finding on cameras without measurements."""
    them = "it" if len(cameras) == 1 else "them"
    what = f"camera {', '.join(cameras)} not checked: nothing was measured in {them}"
    return finding("BP-C10", Level.WARN, what)


def size(px: float, mm: float) -> str:
    """An amount of drift in words: `0.52 px (1.5 mm at the screen)`."""
    return f"{format_number(px)} px" + (
        f" ({format_number(mm)} mm at the screen)" if np.isfinite(mm) else " (the rays miss the screen)"
    )


def camera_findings(c: CameraDrift, limits: DriftLimits, pose_free: bool) -> list[Finding]:
    """Findings on one camera. pose_free: whether the pose of the vehicle was fitted."""
    out = []
    name = f"camera {c.camera}"
    if c.change is not None:
        level = level_of(c.drift_px, c.drift_mm, limits)
        why = {
            Level.PASS: f"it is significant but small: below {limits.warn_mm:g} mm it is less than the spots' noise",
            Level.WARN: f"beyond {limits.warn_mm:g} mm it affects the pose, and the stated sigmas do not include it",
            Level.FAIL: f"beyond {limits.fail_mm:g} mm the error of the pose exceeds the stated sigmas",
        }[level]
        if pose_free:
            why += ". The fit of the unknown vehicle pose may absorb part of the change."
        change = describe_change(c)
        what = f"{name} {change}: its picture is off by {size(c.drift_px, c.drift_mm)}, p {format_p(c.change.p_value)}"
        out.append(finding("BP-C06", level, what, why=why, variant=c.change.kind))
    if np.isfinite(c.unexplained_px):
        what = (
            f"{name}: pixels are off by {size(c.unexplained_px, c.unexplained_mm)} in a way that a turned or moved"
            " camera, a changed focus or a few wrong points do not explain"
        )
        out.append(finding("BP-C07", level_of(c.unexplained_px, c.unexplained_mm, limits), what))
    if out:
        return out
    weak = is_weak(c.detectable_mm, limits)
    detectable = "a common shift of its picture is not detectable"
    if np.isfinite(c.detectable_px):
        detectable = f"the smallest detectable shift is {size(c.detectable_px, c.detectable_mm)}"
    state = "shows no change, but this check is weak" if weak else "has not changed"
    what = f"{name} {state}: drift {size(c.drift_px, c.drift_mm)}, expected from noise {format_number(c.noise_px)} px"
    what += f"; {detectable}"
    if not weak:
        return [passed(what)]
    why = f"the check can miss a drift far beyond {limits.fail_mm:g} mm, the limit for use"
    return [finding("BP-C08", Level.WARN, what, why=why, variant="pose unknown" if pose_free else "")]


def describe_change(c: CameraDrift) -> str:
    """The change of a camera in words, with its figures."""
    assert c.change is not None
    kind = c.change.kind
    if kind == ZOOMED:
        scale = f"{format_number(c.scale_ppm, signed=True)} ± {format_number(c.sigma_scale_ppm)} ppm"
        return f"has another focal length ({scale}): focus or zoom changed"
    if kind in (TURNED, TURNED_ZOOMED):
        turn = c.change.delta[:3]
        sigma = np.sqrt(np.maximum(np.diagonal(c.change.covariance)[:3], 0))
        angle = float(np.linalg.norm(turn))
        of_angle = float(np.sqrt((turn / max(angle, 1e-12)) ** 2 @ sigma**2))
        axis = ("its horizontal axis (up or down)", "its vertical axis (sideways)", "its optical axis (rolled)")
        main = axis[int(np.argmax(np.abs(turn)))]
        size = f"{format_number(np.rad2deg(angle))} ± {format_number(np.rad2deg(of_angle), 2)} deg"
        words = f"turned by {size}, mainly about {main}"
        return words + (", and its focal length changed" if kind == TURNED_ZOOMED else "")
    moved = 1e3 * float(np.linalg.norm(c.change.delta[3:6]))
    turned = np.rad2deg(float(np.linalg.norm(c.change.delta[:3])))
    words = f"moved by about {format_number(moved, 2)} mm and turned by about {format_number(turned, 2)} deg"
    return words + (", and its focal length changed" if kind == ALL_CHANGED else "")


def other_findings(others: Sequence[OtherChange], limits: DriftLimits) -> list[Finding]:
    """Findings on wrong points and moved lasers."""
    out = []
    for o in others:
        level, off = level_of(o.px, o.mm, limits), size(o.px, o.mm)
        if o.change.kind == LASER_MOVED:
            what, variant = f"laser {o.change.subject} has moved: its spots are off by {off}", "laser"
        else:
            what, variant = f"one point is wrong: {o.change.subject} is off by {off}, the others are not", "point"
            level = min(level, Level.WARN)  # an error of the point, not of the calibration
        out.append(finding("BP-C09", level, f"{what}, p {format_p(o.change.p_value)}", variant=variant))
    return out


def page_of(
    result: DriftResult,
    file: RigFile,
    compared: Sequence[PixelComparison],
    history: Sequence[HistoryRow],
    limits: DriftLimits,
    today: datetime.date,
) -> tuple[list[KeyFigure], list[Section]]:
    """Key figures and sections of the report. history: all checks up to and including this one."""
    sections = [_drift_section(result.cameras, compared, limits, file)]
    if len({r.date for r in history}) > 1:
        sections.append(_history_section(history, limits, file))
    sections += [_points_section(compared, result.others, result.cameras), _scene_section(file, compared)]
    return _key_figures(result.cameras, file, limits, today), sections


def _key_figures(
    cameras: Sequence[CameraDrift], file: RigFile, limits: DriftLimits, today: datetime.date
) -> list[KeyFigure]:
    out = []
    for c in cameras:
        value = f"{format_number(c.drift_px)} px · {format_number(c.drift_mm)} mm"
        state = (
            describe_change(c) if c.change is not None else f"expected from noise: {format_number(c.noise_px, 2)} px"
        )
        if c.change is None and is_weak(c.detectable_mm, limits):
            state = f"weak check: shifts below {format_number(c.detectable_px, 2)} px are not detected"
        out.append((f"drift of camera {c.camera}", value, state))
    if file.calibration is not None:
        left, days = file.calibration.validity, file.calibration.days_left(today)
        if days is not None:
            left += f", {days} days left" if days >= 0 else f", expired {-days} days ago"
        out.append(("calibrated on", file.calibration.date.isoformat(), left))
    out.append(("limits", f"{limits.warn_mm:g} / {limits.fail_mm:g} mm", "warning / failure, at the screen"))
    return out


def _drift_section(
    cameras: Sequence[CameraDrift], compared: Sequence[PixelComparison], limits: DriftLimits, file: RigFile
) -> Section:
    labels = {name: [one.label[i] for i in one.rows_of(name)] for one in compared for name in one.columns}
    heads = (
        "camera", "verdict", "points", "drift (px)", "drift (mm)", "noise (px)", "p", "detectable (px)",
        "detectable (mm)", "shift u, v (px)", "rotation x, y, z (deg)", "scale (ppm)",
    )  # fmt: skip
    rows = [
        (
            c.camera, c.level.name, len(c.pixels), c.drift_px, c.drift_mm, c.noise_px, f"{c.p_value:.1g}",
            c.detectable_px, c.detectable_mm, _plus_minus(c.shift_px, c.sigma_shift_px),
            _plus_minus(c.turn_deg, c.sigma_turn_deg),
            f"{format_number(c.scale_ppm)} ± {format_number(c.sigma_scale_ppm, 2)}",
        )
        for c in cameras
    ]  # fmt: skip
    drawings: list[PageDrawing] = []
    caption = (
        "Parallel arrows: the camera turned. Arrows around a centre: it rolled. Arrows away from a centre: focus or"
        " zoom changed. A single arrow: this point is wrong."
    )
    for c in cameras:
        size_px, title = file.rig.cameras[c.camera].image_size_px, f"Camera {c.camera}: measured − predicted"
        picture = corners_overlay(size_px, c.pixels, c.residual_px, title, labels=labels[c.camera])
        drawings.append(PageDrawing(picture, "" if drawings else caption))
    words = [
        "Drift: the rotation of the camera and change of its focal length that fit today's pixels, as RMS displacement"
        " over the points. The sigmas include the uncertainties of the pixels, the survey and the calibration.",
        f"A drift is reported if it is significant (one false alarm in {1 / limits.p_false_alarm:,.0f} checks) and"
        f" large: a warning beyond {limits.warn_mm:g} mm at the screen, a failure beyond {limits.fail_mm:g} mm."
        f" Detectable: the shift that this check finds with a probability of {100 * limits.power:.0f} %.",
    ]
    return Section("Drift per camera", words, drawings, PageTable(heads, rows))


def _plus_minus(values: Array, sigmas: Array) -> str:
    """Values rounded to the precision of their largest sigma, and that sigma."""
    sigma = float(np.max(sigmas))
    decimals = decimals_of(sigma) if sigma > 0 else 3
    words = ", ".join(f"{v:.{decimals}f}" for v in values.tolist())
    return f"{words} ± {format_number(sigma, 2)}".replace("-", "−")


def _history_section(history: Sequence[HistoryRow], limits: DriftLimits, file: RigFile) -> Section:
    def lines(unit: str) -> dict[str, DriftLine]:
        out = {}
        for camera in dict.fromkeys(r.camera for r in history):
            rows = [r for r in history if r.camera == camera]
            values = np.array([getattr(r, f"drift_{unit}") for r in rows])
            noise = np.array([r.noise_px for r in rows]) if unit == "px" else None
            out[camera] = DriftLine([r.date for r in rows], values, noise)
        return out

    until = None if file.calibration is None else file.calibration.valid_until
    warn, fail = limits.warn_mm, limits.fail_mm
    drawings = [
        drift_chart(lines("mm"), "Drift at the screen", "mm", warn=warn, fail=fail, expires=until),
        drift_chart(lines("px"), "Drift in the picture", "px", expires=until),
    ]
    words = "All checks so far. A slow increase indicates a creeping mount or a change of temperature, a step a shock."
    return Section("Drift over time", words, drawings)


def _points_section(
    compared: Sequence[PixelComparison], others: Sequence[OtherChange], cameras: Sequence[CameraDrift]
) -> Section:
    by_camera = {c.camera: c for c in cameras}
    heads = (
        "camera", "point", "u (px)", "v (px)", "residual u (px)", "residual v (px)",
        "without the camera's change (px)", "sigma of the pixel (px)", "sigma of the calibration (px)",
    )  # fmt: skip
    rows = []
    for one in compared:
        for name in dict.fromkeys(one.camera):
            c = by_camera[name]
            for k, i in enumerate(one.rows_of(name)):
                left = float(np.linalg.norm(c.residual_px[k] - c.explained_px[k]))
                sigmas = one.measured_sigma_px[i], one.calibration_sigma_px[i]
                rows.append((name, one.label[i], *one.pixels[i], *c.residual_px[k], left, *sigmas))
    words = [f"{o.change.subject}: {o.change.kind}, {size(o.px, o.mm)}." for o in others]
    return Section("Points", words, (), PageTable(heads, rows))


def _scene_section(file: RigFile, compared: Sequence[PixelComparison]) -> Section:
    things = rig_things(file.rig)
    marks: dict[str, Marker] = {}
    for one in compared:
        for label, xyz in zip(one.label, one.xyz, strict=True):
            marks.setdefault(label, Marker(label, xyz))
    return Section("The lab", (), scene_views([*things, *marks.values()], "Cameras, screens and points"))


TABLE = "drift.csv"
COLUMNS = (
    "camera", "points", "drift_px", "noise_px", "drift_mm", "shift_u_px", "shift_v_px", "sigma_shift_u_px",
    "sigma_shift_v_px", "turn_x_deg", "turn_y_deg", "turn_z_deg", "sigma_turn_x_deg", "sigma_turn_y_deg",
    "sigma_turn_z_deg", "scale_ppm", "sigma_scale_ppm", "p_value", "detectable_px", "detectable_mm", "explanation",
    "verdict",
)  # fmt: skip


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
    compared, notes = _compare(file, rig_path, inputs, limits)
    pose_free = inputs.run is not None and inputs.pose is None
    result, findings = judge(file, compared, pose_free, limits, today)
    drifts = ", ".join(f"{c.camera} {_two(c.drift_px)} px / {_two(c.drift_mm)} mm" for c in result.cameras)
    return Solved(
        name="drift check",
        title=f"check of {today.isoformat()}",
        result=result,
        findings=(*findings, *notes),
        figures=drifts + (f"; not checked: {', '.join(result.unchecked)}" if result.unchecked else ""),
        write=lambda folder: write_drift_table(result.cameras, folder / TABLE),
        page=lambda: page_of(result, file, compared, [*earlier, *_rows(result, today)], limits, today),
        day=today,
        inputs=[rig_path, *inputs.files()],
    )


def _rows(result: DriftResult, day: datetime.date) -> list[HistoryRow]:
    return [HistoryRow(day, c.camera, c.drift_px, c.noise_px, c.drift_mm, c.level) for c in result.cameras]


def _two(value: float) -> str:
    return "?" if not np.isfinite(value) else f"{value:.2f}"


def _compare(
    file: RigFile, rig_path: Path, inputs: DriftInputs, limits: DriftLimits
) -> tuple[list[PixelComparison], list[Finding]]:
    """Read the measurements and compare them with the prediction by the rig; and what is not known of their errors."""
    covariance, notes = joint_covariance(file.rig, file.covariances, rig_path), []
    if covariance is None:
        what = "rig.yaml has no covariance: the calibration's own errors count as drift here"
        notes.append(finding("BP-C11", Level.WARN, what))
    if inputs.points is not None:
        known = read_points(inputs.points, inputs.survey, file.rig, limits.point_sigma_px)
        if not known.sigma_given:
            notes.append(passed(f"the points' file has no sigma_px: {limits.point_sigma_px:g} px is assumed"))
        return compare_points(file.rig, known, covariance, inputs.points), notes
    assert inputs.run is not None
    still = read_still_spots(inputs.run, file.rig)
    check_at_rest(still, limits.still_px, inputs.run)
    covariance_of_pose = np.diag([limits.pose_sigma_m**2] * 3 + [np.deg2rad(limits.pose_sigma_deg) ** 2] * 3)
    pose = None if inputs.pose is None else (read_still_pose(inputs.pose), covariance_of_pose)
    return [compare_still(file.rig, still, covariance, pose, limits.floor_px, inputs.run)], notes


def judge(
    file: RigFile, compared: Sequence[PixelComparison], pose_free: bool, limits: DriftLimits, today: datetime.date
) -> tuple[DriftResult, tuple[Finding, ...]]:
    """The drift of each camera, wrong points and moved lasers, and the findings. pose_free: the pose was fitted."""
    p_each = limits.p_false_alarm / max(len(compared), 1)
    cameras: list[CameraDrift] = []
    others: list[OtherChange] = []
    findings = state_findings(file.calibration, today, limits.expiry_warning_days)
    for one in compared:
        verdicts = find_changes(one.misfit, one.columns, one.others, p_each)
        drifts = [_camera_drift(file.rig, name, one, verdicts, limits, p_each) for name in one.columns]
        cameras += drifts
        others += [_other(file.rig, one, c) for c in verdicts.changes if c.kind not in CAMERA_KINDS]
        findings += [f for c in drifts for f in camera_findings(c, limits, pose_free)]
    findings += other_findings(others, limits)
    checked = {c.camera for c in cameras}
    unchecked = tuple(name for name in file.rig.cameras if name not in checked)
    if unchecked:
        findings.append(unchecked_finding(unchecked))
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
    tests = p_false_alarm / 2 / max(len(one.columns), 1)  # of one camera, as `find_changes` shares the rate
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
