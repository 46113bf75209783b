"""Report of a drift check."""

from __future__ import annotations

import datetime
from collections.abc import Sequence

import numpy as np

from geometry.arrays import Array
from lab.calibrate.drift_check.drift_comparison import PixelComparison
from lab.calibrate.drift_check.drift_findings import describe_change, size
from lab.calibrate.drift_check.drift_result import (
    CameraDrift,
    DriftLimits,
    DriftResult,
    HistoryRow,
    OtherChange,
    is_weak,
)
from lab.files.rig.rig_file import RigFile
from lab.number_format import format_number
from lab.report.calibration.calibration_charts import DriftLine, drift_chart
from lab.report.calibration.calibration_drawings import corners_overlay
from lab.report.calibration.calibration_page import KeyFigure, PageDrawing, PageTable, Section
from lab.report.calibration.calibration_scene import Marker, rig_things, scene_views


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
