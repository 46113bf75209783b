"""The figures of a report, each from arrays to SVG text."""

from __future__ import annotations

import numpy as np

from geometry import rotations
from geometry.arrays import Array
from lab.report import svg
from lab.report.material import Material
from lab.report.svg import Band, Line, Shade
from lab.score import normalised_squares
from tracking.statuses import PoseStatus, SpotStatus

U_COLOUR, V_COLOUR = svg.BLUE, svg.VERMILLION


def pose_shades(m: Material) -> tuple[Shade, ...]:
    """Where the pose was predicted or lost."""
    return (
        Shade(m.poses.has(PoseStatus.PREDICTED), "predicted", "pose predicted, not measured"),
        Shade(m.poses.has(PoseStatus.LOST), "lost", "pose lost"),
    )


def pose_figure(m: Material) -> str:
    """Attitude and position over time beside their uncertainty: a row for each of the six numbers."""
    p = m.poses
    if not p.known.any():
        return ""
    t = p.t_s if m.time_name != "frame" else p.frames.astype(float)
    shades = pose_shades(m)
    errors = _angle_and_position_errors(m)
    out = []
    names = ("yaw", "pitch", "roll", "x", "y", "z")
    angles = np.degrees(np.unwrap(np.radians(p.yaw_pitch_roll_deg), axis=0)) if p.known.all() else p.yaw_pitch_roll_deg
    values = np.concatenate([angles, p.world_from_body.translation], axis=1)
    sigmas = np.concatenate([p.sigma_ypr_deg, p.sigma_position_m], axis=1)
    measured = p.has(PoseStatus.MEASURED)
    for i, name in enumerate(names):
        big, small, factor = ("deg", "mdeg", 1000.0) if i < 3 else ("m", "mm", 1000.0)
        value, sigma = values[:, i], sigmas[:, i]
        last = i == len(names) - 1
        height = 128 if last else 104
        out.append(
            svg.time_panel(
                t,
                name,
                big,
                lines=(Line(value, svg.BLUE, name, 1.3),),
                bands=(Band(value - 3 * sigma, value + 3 * sigma, svg.SKY, "\u00b13\u03c3", 0.45),),
                shades=shades,
                # Of the bands only those of measured poses count: a long prediction would flatten the rest.
                y_range=svg.plain_range(
                    np.concatenate([value, (value - 3 * sigma)[measured], (value + 3 * sigma)[measured]])
                ),
                height=height,
                with_time=last,
                time_name=m.time_name,
            )
        )
        shown = sigma[measured] if measured.any() else sigma
        if np.nanmax(shown, initial=0.0) > (1.0 if i < 3 else 0.1):
            small, factor = big, 1.0
        limit = 1.25 * svg.robust_range(3 * factor * shown)[1]
        lines: tuple[Line, ...] = ()
        if errors is not None:
            lines = (Line(factor * errors[:, i], svg.VERMILLION, f"{name}: estimate minus truth", 0.9),)
            limit = max(limit, svg.robust_range(factor * errors[measured, i])[1]) if measured.any() else limit
        s = factor * sigma
        out.append(
            svg.time_panel(
                t,
                f"{name}: \u00b1\u03c3, \u00b13\u03c3" + (" and error" if errors is not None else ""),
                small,
                lines=lines,
                bands=(
                    Band(-3 * s, 3 * s, svg.SKY, "\u00b13\u03c3", 0.35),
                    Band(-s, s, svg.BLUE, "\u00b1\u03c3", 0.35),
                ),
                shades=shades,
                y_range=(-limit, limit),
                height=height,
                with_time=last,
                time_name=m.time_name,
            )
        )
    return "".join(out)


def _angle_and_position_errors(m: Material) -> Array | None:
    """(F, 6): yaw, pitch, roll (deg, wrapped) and x, y, z (m), estimate minus truth."""
    if m.truth is None or m.truth.world_from_body is None:
        return None
    true = m.truth.world_from_body
    ypr = m.poses.yaw_pitch_roll_deg - np.degrees(rotations.ypr_from_matrix(true.rotation))
    ypr = (ypr + 180.0) % 360.0 - 180.0
    shift = m.poses.world_from_body.translation - true.translation
    return np.concatenate([np.where(np.isfinite(shift[:, :1]), ypr, np.nan), shift], axis=1)


def nees_figure(m: Material) -> str:
    """The squared pose error in units of its covariance, over time."""
    delta = m.pose_errors
    if delta is None:
        return ""
    nees = normalised_squares(delta, m.poses.covariance)
    if not np.isfinite(nees).any():
        return ""
    t = m.poses.t_s if m.time_name != "frame" else m.poses.frames.astype(float)
    n = np.ones(len(nees))
    usual = nees[np.isfinite(nees)]
    top = max(25.0, min(float(usual.max()) * 1.08, 2.0 * float(np.percentile(usual, 99))))
    # chi-squared with 6 degrees of freedom lies in 1.237 .. 14.449 in 95 of 100 frames
    return svg.time_panel(
        t,
        "NEES: squared pose error over its covariance; mean 6 where the stated uncertainty is true, band: 95 %",
        "",
        lines=(Line(nees, svg.BLUE, "NEES", 0.8), Line(6.0 * n, svg.GREEN, "6, the mean to expect", 1.4, "6 4")),
        bands=(Band(1.237 * n, 14.449 * n, svg.GREEN, "95 % of a true covariance's frames", 0.15),),
        shades=pose_shades(m),
        y_range=(0.0, top),
        width=1090,
        height=140,
        time_name=m.time_name,
    )


def view_shades(m: Material, j: int) -> tuple[Shade, ...]:
    """Where a view's position is not measured."""
    status = (SpotStatus.OUT_OF_VIEW, "outside"), (SpotStatus.OCCLUDED, "predicted"), (SpotStatus.NO_IMAGE, "lost")
    shades = [Shade(m.spots.has(s)[:, j], css, f"{s}: {s.meaning}") for s, css in status]
    return (*shades, Shade(m.spots.has(SpotStatus.LOST)[:, j], "lost", "lost"))


def error_grid(m: Material, columns: tuple[tuple[str, Array], ...], at_least_px: float = 0.5) -> str:
    """For each view a row of panels over time with u and v of the given errors (F, V, 2), px; one scale per column."""
    out = []
    shown = [j for j in range(len(m.spots.views)) if any(np.isfinite(e[:, j]).any() for _, e in columns)]
    ranges = [svg.robust_range(e[:, shown], at_least_px) if shown else (-1.0, 1.0) for _, e in columns]
    for j in shown:
        camera, spot = m.spots.views[j]
        last = j == shown[-1]
        for (name, errors), y_range in zip(columns, ranges, strict=True):
            out.append(
                svg.time_panel(
                    m.t_s,
                    f"spot {spot} ({camera}): {name}",
                    "px",
                    lines=(
                        Line(errors[:, j, 0], U_COLOUR, f"spot {spot}, u: {name}", 0.9),
                        Line(errors[:, j, 1], V_COLOUR, f"spot {spot}, v: {name}", 0.9),
                    ),
                    shades=view_shades(m, j),
                    y_range=y_range,
                    height=128 if last else 104,
                    with_time=last,
                    time_name=m.time_name,
                )
            )
    return "".join(out)


def truth_columns(m: Material) -> tuple[tuple[str, Array], ...]:
    """Prediction error and tracking error (the paper's Figs. 5 to 7, 9, 12 and 13)."""
    if m.truth is None or m.truth.uv_px is None:
        return ()
    return (
        ("predicted \u2212 true", m.spots.predicted_px - m.truth.uv_px),
        ("estimate \u2212 true", m.spots.uv_px - m.truth.uv_px),
    )


def residual_columns(m: Material) -> tuple[tuple[str, Array], ...]:
    """Innovation, and residual where the rig is known."""
    columns: tuple[tuple[str, Array], ...] = (("measured \u2212 predicted", m.innovation_px),)
    if m.residual_px is not None:
        columns += (("measured \u2212 from the pose", m.residual_px),)
    return columns


def rms_figure(m: Material) -> str:
    """The pose solution's residual over time, and how the residuals are spread."""
    p = m.poses
    if not np.isfinite(p.rms_px).any():
        return ""
    t = p.t_s if m.time_name != "frame" else p.frames.astype(float)
    top = min(1.08 * float(np.nanmax(p.rms_px)), 4.0 * float(np.nanpercentile(p.rms_px, 99)))
    over_time = svg.time_panel(
        t,
        "residual of the pose, RMS over the spots used",
        "px",
        lines=(Line(p.rms_px, svg.BLUE, "rms_px of attitude.csv", 0.9),),
        shades=pose_shades(m),
        y_range=(0.0, max(top, 1e-6)),
        height=150,
        time_name=m.time_name,
    )
    if m.residual_px is not None:
        # Six numbers are fitted to the 2 n coordinates of a frame; of their noise a share 1 - 6 / 2n is left.
        n = 2.0 * np.isfinite(m.residual_px[..., 0]).sum(axis=1)
        left = np.sum(np.maximum(n - 6, 0)[n > 0]) / max(np.sum(n), 1.0)
        return over_time + svg.histogram(
            (m.residual_px / m.spots.sigma_px).ravel(),
            "residual over its stated \u03c3; curve: what the fit of six numbers leaves",
            "\u03c3",
            curve=float(np.sqrt(left)),
        )
    return over_time + svg.histogram(p.rms_px, "residual of the pose, RMS", "px")
