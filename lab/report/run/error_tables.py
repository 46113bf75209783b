"""The report's tables of errors against truth."""

from __future__ import annotations

from lab.number_format import format_angle, format_length, format_number, format_percent
from lab.report.run.tables import KeyFigure, counted, pixels
from lab.report.run.truth_errors import MotionErrors, PoseSpread, SpotErrors, TruthErrors


def truth_figures(e: TruthErrors | None) -> list[KeyFigure]:
    """The key figures of the errors against truth."""
    keys = []
    if e is not None and e.spots is not None:
        s, smooth = e.spots, e.spots.prediction_px.get("smooth")
        outside = s.out_of_view_px
        keys += [
            KeyFigure("right in view", format_percent(s.in_view_identity), "of visible spots"),
            KeyFigure("wrong labels", counted(s.wrong_labels), "measured rows"),
            KeyFigure("prediction error", pixels(None if smooth is None else smooth.rms), "RMS without true bends"),
            KeyFigure(
                "out-of-view error",
                pixels(None if outside is None else outside.rms),
                f"RMS; largest {pixels(outside.max)}" if outside else "no spot was out of view",
            ),
        ]
    if e is not None and e.pose is not None and (measured := e.pose.measured) is not None:
        causal = None if e.pose_causal is None else e.pose_causal.measured
        notes = ["RMS, measured poses"] * 2
        if causal is not None:
            shown = format_angle(causal.rotation_deg.rms), format_length(causal.position_m.rms)
            notes = [f"RMS, smoothed; causal {value}" for value in shown]
        keys += [
            KeyFigure("rotation error", format_angle(measured.rotation_deg.rms), notes[0]),
            KeyFigure("position error", format_length(measured.position_m.rms), notes[1]),
            KeyFigure("NEES", format_number(measured.nees_mean), "mean; 6 if σ is correct"),
        ]
    return keys


def pixel_rows(e: TruthErrors | None) -> list[tuple[str, ...]]:
    """Errors in the picture: name, rows, RMS u, RMS v, 99th percentile and largest distance (px), meaning."""
    if e is None or e.spots is None:
        return []
    s, prediction = e.spots, e.spots.prediction_px.get
    kinds = (
        ("prediction", prediction("smooth"), "one frame ahead, without starts of tracks and true bends"),
        ("prediction, matched", prediction("straight"), "rows with status matched, without starts of tracks"),
        ("prediction at turns", prediction("turned"), "rows with status turned"),
        ("prediction at true bends", prediction("bends"), "where the true path bends by more than 2 px"),
        ("prediction at the start", prediction("start"), "the first two frames of a track: the speed is not yet known"),
        ("measured place", s.measured_px, "of correctly labelled spots"),
        ("out of view", s.out_of_view_px, "computed from the other spots"),
        ("occluded", s.occluded_px, "the estimate while no detection was accepted"),
    )
    return [
        (name, counted(x.rows), *(format_number(v) for v in (x.rms_u, x.rms_v, x.p99, x.max)), meaning)
        for name, x, meaning in kinds
        if x is not None
    ]


def error_rows(e: TruthErrors | None) -> list[tuple[str, str, str]]:
    """Name, value and meaning of the other errors against truth."""
    if e is None:
        return []
    out = [] if e.spots is None else _label_rows(e.spots)
    for block, name, causal in (
        (e.pose, "measured", ""),
        (e.pose, "predicted", ""),
        (e.pose_causal, "measured", ", causal"),
    ):
        spread = None if block is None else block.measured if name == "measured" else block.predicted
        if spread is not None:
            out += _pose_rows(spread, name + causal)
    return out + _motion_rows(e.motion_vs_differences, "") + _motion_rows(e.motion_causal_vs_differences, ", causal")


def _label_rows(s: SpotErrors) -> list[tuple[str, str, str]]:
    out = [
        ("right identity in view", format_percent(s.in_view_identity), "of visible spots, found under their own name"),
        ("wrong labels", f"{counted(s.wrong_labels)} ({format_percent(s.wrong_label_share)})", "of all measured rows"),
    ]
    for block, name in ((s.re_entries, "re-entries kept"), (s.after_hiding, "kept after occlusion")):
        if block.total:
            late = f", at most {block.max_delay_frames} frames late" if block.max_delay_frames else ""
            out.append((name, f"{block.kept} of {block.total}{late}", "found again under the same name"))
    rate = s.recognition_rate_eq15.get
    return [
        *out,
        ("recognition rate, eq. (15)", format_percent(rate("paper")), "all rows; spots out of view count as wrong"),
        ("… in view only", format_percent(rate("in_view")), "of the rows with a visible spot"),
        ("… all, within 3 px", format_percent(rate("all_within_tolerance")), "of all rows, measured or solved"),
    ]


def _pose_rows(x: PoseSpread, name: str) -> list[tuple[str, str, str]]:
    turns = ", ".join(f"{k} {format_angle(v)}" for k, v in x.rotation_rms_deg.items())
    shifts = ", ".join(f"{k} {format_length(v)}" for k, v in x.position_rms_m.items())
    largest = format_angle(x.rotation_deg.max), format_length(x.position_m.max)
    out = [
        (f"rotation, {name} poses", f"RMS {turns}; largest {largest[0]}", f"about the body's axes, {x.rows} frames"),
        (f"position, {name} poses", f"RMS {shifts}; largest {largest[1]}", f"along the world's axes, {x.rows} frames"),
    ]
    if x.nees_mean is not None and x.nees_mean_95 is not None:
        low, high = (format_number(v) for v in x.nees_mean_95)
        meaning = f"6 expected; {low} to {high} in 95 % of runs of independent frames"
        out.append((f"NEES, {name} poses", format_number(x.nees_mean), meaning))
    return out


def _motion_rows(x: MotionErrors | None, causal: str) -> list[tuple[str, str, str]]:
    out = []
    if x is not None:
        bends = f", without {x.rows_at_bends_left_out} frames at bends" if x.rows_at_bends_left_out else ""
        for block, what, unit in ((x.velocity_m_s, "velocity", "mm/s"), (x.rate_rad_s, "angular rate", "mrad/s")):
            if block is not None:
                axes = ", ".join(f"{k} {format_number(1000 * v)} {unit}" for k, v in block.rms_axes.items())
                value = f"RMS {axes}; largest {format_number(1000 * block.max)} {unit}"
                out.append((f"{what}{causal}", value, f"against differences of the true poses{bends}"))
    return out
