"""Report of a drift check.

Findings of a drift check: the state of the calibration, the change of each camera, wrong points and moved lasers.
"""

from __future__ import annotations

import datetime
from collections.abc import Sequence

import numpy as np

from calibration.changes import ALL_CHANGED, LASER_MOVED, TURNED, TURNED_ZOOMED, ZOOMED
from geometry.arrays import Array
from lab.calibrate.drift_check.drift_comparison import (
    CameraDrift,
    DriftLimits,
    DriftResult,
    HistoryRow,
    OtherChange,
    PixelComparison,
    is_weak,
    level_of,
)
from lab.files.rig.calibration_state import CalibrationState
from lab.files.rig.rig_file import RigFile
from lab.findings.finding import Finding, Level, finding, passed
from lab.number_format import format_count, format_number
from lab.report.calibration.calibration_charts import DriftLine, drift_chart
from lab.report.calibration.calibration_drawings import corners_overlay
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
        what = f"{name} {change}: its picture is off by {size(c.drift_px, c.drift_mm)}, p = {_p(c.change.p_value)}"
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
        scale = f"{_signed(c.scale_ppm)} ± {format_number(c.sigma_scale_ppm)} ppm"
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
        out.append(finding("BP-C09", level, f"{what}, p = {_p(o.change.p_value)}", variant=variant))
    return out


def _p(p: float) -> str:
    return "below 1e-12" if p < 1e-12 else f"{p:.1g}"


def _signed(value: float) -> str:
    return ("+" if value > 0 else "") + format_number(value)


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
    drawings = [
        PageDrawing(
            corners_overlay(
                file.rig.cameras[c.camera].image_size_px,
                c.pixels,
                c.residual_px,
                f"Camera {c.camera}: measured − predicted",
                labels=labels[c.camera],
            ),
            "Parallel arrows: the camera turned. Arrows around a centre: it rolled. Arrows away from a centre: focus or"
            " zoom changed. A single arrow: this point is wrong."
            if i == 0
            else "",
        )
        for i, c in enumerate(cameras)
    ]
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
    decimals = int(np.clip(1 - np.floor(np.log10(sigma)), 0, 6)) if sigma > 0 else 3
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
    in_mm = drift_chart(
        lines("mm"), "Drift at the screen", "mm", warn=limits.warn_mm, fail=limits.fail_mm, expires=until
    )
    drawings = [PageDrawing(in_mm), PageDrawing(drift_chart(lines("px"), "Drift in the picture", "px", expires=until))]
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
                rows.append(
                    (
                        name, one.label[i], *one.pixels[i].tolist(), *c.residual_px[k].tolist(), left,
                        float(one.measured_sigma_px[i]), float(one.calibration_sigma_px[i]),
                    )
                )  # fmt: skip
    words = [f"{o.change.subject}: {o.change.kind}, {size(o.px, o.mm)}." for o in others]
    return Section("Points", words, (), PageTable(heads, rows))


def _scene_section(file: RigFile, compared: Sequence[PixelComparison]) -> Section:
    things = rig_things(file.rig)
    marks: dict[str, Marker] = {}
    for one in compared:
        for label, xyz in zip(one.label, one.xyz, strict=True):
            marks.setdefault(label, Marker(label, xyz))
    return Section("The lab", (), scene_views([*things, *marks.values()], "Cameras, screens and points"))
