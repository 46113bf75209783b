"""The tables of a run's report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np

from geometry.arrays import Array
from geometry.rotations import ypr_jacobian
from lab.number_format import format_angle, format_length, format_number, format_percent, median
from lab.report.page import KeyFigure
from lab.report.run.report_data import ReportData
from tracking.statuses import PoseStatus, SpotStatus

# The report's tables of errors against truth, as lab.runs.verdict.score gives them; a missing number is a dash.

Errors: TypeAlias = Mapping[str, Any]


def part(errors: object, *names: str) -> Errors:
    """A block within blocks, without texts, which no table shows; empty where it is not there."""
    for name in names:
        errors = errors.get(name) if isinstance(errors, Mapping) else None
    return {k: v for k, v in errors.items() if not isinstance(v, str)} if isinstance(errors, Mapping) else {}


def truth_figures(e: Errors | None) -> list[KeyFigure]:
    """The key figures of the errors against truth."""
    keys = []
    if s := part(e, "spots"):
        outside = part(s, "out_of_view_px")
        largest = f"RMS; largest {pixels(outside.get('max'))}" if outside else "no spot was out of view"
        keys += [
            ("right in view", format_percent(s.get("in_view_identity")), "of visible spots"),
            ("wrong labels", counted(s.get("wrong_labels")), "measured rows"),
            ("prediction error", pixels(part(s, "prediction_px", "smooth").get("rms")), "RMS, straight parts"),
            ("out-of-view error", pixels(outside.get("rms")), largest),
        ]
    if measured := part(e, "pose", "measured"):
        rotation, position = (part(measured, name).get("rms") for name in ("rotation_deg", "position_m"))
        notes = ["RMS, measured poses"] * 2
        if causal := part(e, "pose_causal", "measured"):
            turn, shift = (part(causal, name).get("rms") for name in ("rotation_deg", "position_m"))
            notes = [f"RMS, smoothed; causal {value}" for value in (format_angle(turn), format_length(shift))]
        keys += [
            ("rotation error", format_angle(rotation), notes[0]),
            ("position error", format_length(position), notes[1]),
            ("NEES", format_number(measured.get("nees_mean")), "mean; 6 if σ is correct"),
        ]
    return keys


def pixel_rows(e: Errors | None) -> list[tuple[str, ...]]:
    """Errors in the picture: name, rows, RMS u, RMS v, 99th percentile and largest distance (px), meaning."""
    kinds = (
        ("prediction", ("prediction_px", "smooth"), "one frame ahead, without starts of tracks and bends"),
        ("prediction, matched", ("prediction_px", "straight"), "rows with status matched, without starts of tracks"),
        ("prediction at turns", ("prediction_px", "turned"), "rows with status turned"),
        ("prediction at bends", ("prediction_px", "bends"), "where the true path bends by more than 2 px"),
        (
            "prediction at the start",
            ("prediction_px", "start"),
            "the first two frames of a track: the speed is not yet known",
        ),
        ("measured place", ("measured_px",), "of correctly labelled spots"),
        ("out of view", ("out_of_view_px",), "computed from the other spots"),
        ("occluded", ("occluded_px",), "the estimate while no detection was accepted"),
    )
    return [
        (name, counted(x.get("rows")), *(format_number(x.get(k)) for k in ("rms_u", "rms_v", "p99", "max")), meaning)
        for name, place, meaning in kinds
        if (x := part(e, "spots", *place))
    ]


def error_rows(e: Errors | None) -> list[tuple[str, str, str]]:
    """Name, value and meaning of the other errors against truth."""
    out = _label_rows(part(e, "spots"))
    for block, kind, name in (
        ("pose", "measured", "measured"),
        ("pose", "predicted", "predicted"),
        ("pose_causal", "measured", "measured, causal"),
    ):
        out += _pose_rows(part(e, block, kind), name)
    out += _motion_rows(part(e, "motion_vs_differences"), "")
    return out + _motion_rows(part(e, "motion_causal_vs_differences"), ", causal")


def _label_rows(s: Errors) -> list[tuple[str, str, str]]:
    if not s:
        return []
    share, wrong = format_percent(s.get("wrong_label_share")), counted(s.get("wrong_labels"))
    right = format_percent(s.get("in_view_identity"))
    out = [
        ("right identity in view", right, "of visible spots, found under their own name"),
        ("wrong labels", f"{wrong} ({share})", "of all measured rows"),
    ]
    for block, name in ((part(s, "re_entries"), "re-entries kept"), (part(s, "after_hiding"), "kept after occlusion")):
        if block.get("total"):
            late = f", at most {block['max_delay_frames']} frames late" if block.get("max_delay_frames") else ""
            out.append((name, f"{block.get('kept')} of {block['total']}{late}", "found again under the same name"))
    rate = part(s, "recognition_rate_eq15").get
    return [
        *out,
        ("recognition rate, eq. (15)", format_percent(rate("paper")), "all rows; spots out of view count as wrong"),
        ("… in view only", format_percent(rate("in_view")), "of the rows with a visible spot"),
        ("… all, within 3 px", format_percent(rate("all_within_tolerance")), "of all rows, measured or solved"),
    ]


def _pose_rows(x: Errors, name: str) -> list[tuple[str, str, str]]:
    out = []
    for what, of, unit, axes, shown in (
        ("rotation", "rotation", "deg", "about the body's axes", format_angle),
        ("position", "position", "m", "along the world's axes", format_length),
    ):
        if x:
            each = ", ".join(f"{k} {shown(v)}" for k, v in part(x, f"{of}_rms_{unit}").items())
            largest = shown(part(x, f"{of}_{unit}").get("max"))
            value = f"RMS {each}; largest {largest}"
            out.append((f"{what}, {name} poses", value, f"{axes}, {counted(x.get('rows'))} frames"))
    if x.get("nees_mean") is not None and x.get("nees_mean_95") is not None:
        low, high = (format_number(v) for v in x["nees_mean_95"])
        meaning = f"6 expected; {low} to {high} in 95 % of runs of independent frames"
        out.append((f"NEES, {name} poses", format_number(x["nees_mean"]), meaning))
    return out


def _motion_rows(x: Errors, causal: str) -> list[tuple[str, str, str]]:
    out = []
    left_out = x.get("rows_at_bends_left_out")
    bends = f", without {left_out} frames at bends" if left_out else ""
    for name, what, unit in (("velocity_m_s", "velocity", "mm/s"), ("rate_rad_s", "angular rate", "mrad/s")):
        if block := part(x, name):
            axes = ", ".join(f"{k} {format_number(1000 * v)} {unit}" for k, v in part(block, "rms_axes").items())
            value = f"RMS {axes}; largest {format_number(1000 * block.get('max', np.nan))} {unit}"
            out.append((f"{what}{causal}", value, f"against differences of the true poses{bends}"))
    return out


# The tables of a report: key figures, spots, labels, and frames without a picture.


def pixels(value: float | None) -> str:
    """A distance in the picture."""
    return "\u2013" if value is None or not np.isfinite(value) else f"{format_number(value)} px"


def _rms(values: Array) -> float | None:
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(values**2))) if values.size else None


def counted(value: int | None) -> str:
    """A count; a dash for none."""
    return "\u2013" if value is None else str(value)


def key_figures(m: ReportData) -> list[KeyFigure]:
    """The key figures from the results alone."""
    n = len(m.spots.frames)
    p = m.poses
    measured = p.has(PoseStatus.MEASURED)
    span = float(m.t_s[-1] - m.t_s[0]) if n else 0.0
    expected = m.spots.has(SpotStatus.MATCHED, SpotStatus.TURNED, SpotStatus.OCCLUDED)
    found = float(m.spots.measured.sum() / expected.sum()) if expected.any() else None
    sigma_m = median(np.linalg.norm(p.sigma_position_m[measured], axis=1))
    yaw_note, position_note = "median of measured poses", "median of √(σx²+σy²+σz²)"
    if m.causal is not None:
        causal = m.causal.has(PoseStatus.MEASURED)
        yaw_note = f"median, smoothed; causal {format_angle(median(m.causal.sigma_ypr_deg[causal, 0]))}"
        causal_m = median(np.linalg.norm(m.causal.sigma_position_m[causal], axis=1))
        position_note = f"median, smoothed; causal {format_length(causal_m)}"
    return [
        ("frames", f"{n:,}".replace(",", "\u202f"), f"{format_number(span)} s" if m.time_name != "frame" else ""),
        ("pose measured", format_percent(float(measured.mean()) if len(measured) else None), "of all frames"),
        ("spots found", format_percent(found), "of the spots expected in view"),
        ("σ of yaw", format_angle(median(p.sigma_ypr_deg[measured, 0])), yaw_note),
        ("σ of position", format_length(sigma_m), position_note),
        ("residual", pixels(median(p.rms_px[measured])), "median RMS of the pose"),
    ]


def spot_rows(m: ReportData) -> tuple[list[str], list[list[str]]]:
    """Heads and rows of the table of views: counts of each status, and errors."""
    heads = ["camera", "spot", *(str(s).replace("_", " ") for s in SpotStatus)]
    heads += ["median σ (px)", "measured \u2212 predicted, RMS (px)"]
    if m.residual_px is not None:
        heads += ["residual RMS (px)", "mean residual u, v (px)"]
    doubtful = np.isfinite(m.spots.label_probability)
    if doubtful.any():
        heads.append("label left open")
    listed = part(m.errors, "spots").get("per_spot")
    scored = {(v.get("camera"), v.get("spot")): v for v in listed or () if isinstance(v, Mapping)}
    if scored:
        heads += ["right in view", "wrong labels", "out-of-view RMS (px)"]
    rows = []
    innovation = m.innovation_px
    for j, (camera, spot) in enumerate(m.spots.views):
        counts = [int(m.spots.has(s)[:, j].sum()) for s in SpotStatus]
        sigma = np.where(m.spots.measured[:, j], m.spots.sigma_px[:, j].max(axis=1), np.nan)
        row = [camera, spot, *(str(c) if c else "·" for c in counts)]
        row += [format_number(median(sigma)), format_number(_rms(np.linalg.norm(innovation[:, j], axis=1)))]
        if m.residual_px is not None:
            r = m.residual_px[:, j]
            r = r[np.isfinite(r).all(axis=1)]
            mean = ", ".join(f"{x:+.3f}".replace("-", "\u2212") for x in r.mean(axis=0)) if len(r) else "\u2013"
            row += [format_number(_rms(np.linalg.norm(r, axis=1))), mean]
        if doubtful.any():
            row.append(str(int((doubtful & ~m.spots.measured)[:, j].sum()) or "·"))
        if scored:
            own = scored.get((camera, spot))
            row += [
                format_percent(part(own).get("identity")),
                counted(part(own).get("wrong_labels")),
                format_number(part(own, "out_of_view_error_px").get("rms")),
            ]
        rows.append(row)
    return heads, rows


def label_counts(m: ReportData) -> list[str]:
    """How many labels were doubtful or changed, in words; without those that no label was."""
    left_open = int((np.isfinite(m.spots.label_probability) & ~m.spots.measured).sum())
    kinds, again = m.summary.event_counts, m.summary.found_again
    if again is None:  # older results; here the searches of the causal pass count as well
        again = kinds.get("reacquired", 0)
    counts = [
        (left_open, "left open: no label was likely enough"),
        (kinds.get("undecided", 0), "intervals in which a label was undecided"),
        (kinds.get("changed", 0), "changed by the smoothing pass, which also uses later frames"),
        (kinds.get("tie", 0), "ties, in which two labellings were equally likely"),
        (kinds.get("relabelled", 0), "times all spots were labelled again during the run"),
        (again, "times the vehicle was found again after it was lost"),
    ]
    return [f"{count} {words}" for count, words in counts if count]


def no_image_ranges(m: ReportData) -> list[tuple[str, str]]:
    """Camera, and its frame numbers without a usable picture as ranges."""
    out = []
    for camera in m.spots.cameras:
        spans = m.summary.no_image.get(camera)
        if spans is None:
            frames = m.spots.frames.tolist()
            spans = [(frames[a], frames[b - 1]) for a, b in m.spots.without_picture(camera)]
        if spans:
            words = [str(a) if a == b else f"{a}\u2013{b}" for a, b in spans[:60]]
            more = f" … and {len(spans) - 60} more ranges" if len(spans) > 60 else ""
            total = sum(b - a + 1 for a, b in spans)
            out.append((camera, f"{', '.join(words)}{more} ({total} in all)"))
    return out


# The uncertainty budget of a run: noise of the frames, and the systematic part from the calibration.


AVERAGED = 100  # frames of the example
HEADS = ("", "one frame", "noise part", "calibration part", f"mean of {AVERAGED} frames", "mean of infinitely many")


def budget_rows(m: ReportData) -> list[tuple[str, ...]]:
    """A row per component of the pose: medians of the 1-sigma uncertainty over the measured frames.

    Empty where the results state no systematic part. Noise is assumed independent from frame to frame, as stated by the
    covariances of the frames.
    """
    measured = m.poses.has(PoseStatus.MEASURED) & np.all(np.isfinite(m.poses.systematic), axis=(-2, -1))
    if not measured.any():
        return []
    R = m.poses.world_from_body.rotation[measured]
    total, systematic = (_variances(R, C[measured]) for C in (m.poses.covariance, m.poses.systematic))
    noise = np.maximum(total - systematic, 0.0)
    columns = [total, noise, systematic, noise / AVERAGED + systematic, systematic]
    sigmas = np.sqrt(np.median(columns, axis=1)).T
    shown = (*[format_length] * 3, *[format_angle] * 3)
    names = ("x", "y", "z", "yaw", "pitch", "roll")
    return [(name, *map(text, row.tolist())) for name, text, row in zip(names, shown, sigmas, strict=True)]


def _variances(R: Array, covariance: Array) -> Array:
    """Variances (F, 6), m^2 and deg^2, of x, y, z, yaw, pitch, roll from R (F, 3, 3) and covariances (F, 6, 6)."""
    J = np.rad2deg(ypr_jacobian(R))
    angles = J @ covariance[:, 3:, 3:] @ np.swapaxes(J, -1, -2)
    both = [np.diagonal(c, axis1=-2, axis2=-1) for c in (covariance[:, :3, :3], angles)]
    return np.concatenate(both, axis=1)


def words(m: ReportData) -> str:
    """How to read the systematic part."""
    if m.run is None or m.run.covariance is not None:
        return (
            "Noise differs from frame to frame, so averaging over frames reduces it. Errors of the calibration are the"
            " same in every frame at the same pose: averaging does not reduce them, only a better calibration does. In"
            " differences between two similar poses most of them cancel. covariance.csv contains the sum of both,"
            " systematic.csv the calibration part."
        )
    return (
        "The rig file states no covariance of its calibration: the sigmas contain the noise of the pictures only."
        " Errors of the calibration are additional and the same in every frame, so averaging over frames does not"
        " reduce them. `beampose calibrate rig` writes the covariance."
    )
