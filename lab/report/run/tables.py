"""The tables of a report: key figures, spots, labels, and frames without a picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array
from lab.number_format import format_angle, format_length, format_number, format_percent
from lab.report.plot.thinning import true_ranges
from lab.report.run.report_data import ReportData
from lab.report.run.truth_errors import ViewErrors
from tracking.statuses import PoseStatus, SpotStatus


@dataclass(frozen=True, slots=True)
class KeyFigure:
    """One key figure."""

    name: str
    value: str
    note: str = ""


def pixels(value: float | None) -> str:
    """A distance in the picture."""
    return "\u2013" if value is None or not np.isfinite(value) else f"{format_number(value)} px"


def _median(values: Array) -> float | None:
    values = values[np.isfinite(values)]
    return float(np.median(values)) if values.size else None


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
    sigma_m = _median(np.linalg.norm(p.sigma_position_m[measured], axis=1))
    yaw_note, position_note = "median of measured poses", "median of √(σx²+σy²+σz²)"
    if m.causal is not None:
        causal = m.causal.has(PoseStatus.MEASURED)
        yaw_note = f"median, smoothed; causal {format_angle(_median(m.causal.sigma_ypr_deg[causal, 0]))}"
        causal_m = _median(np.linalg.norm(m.causal.sigma_position_m[causal], axis=1))
        position_note = f"median, smoothed; causal {format_length(causal_m)}"
    return [
        KeyFigure(
            "frames", f"{n:,}".replace(",", "\u202f"), f"{format_number(span)} s" if m.time_name != "frame" else ""
        ),
        KeyFigure("pose measured", format_percent(float(measured.mean()) if len(measured) else None), "of all frames"),
        KeyFigure("spots found", format_percent(found), "of the spots expected in view"),
        KeyFigure("σ of yaw", format_angle(_median(p.sigma_ypr_deg[measured, 0])), yaw_note),
        KeyFigure("σ of position", format_length(sigma_m), position_note),
        KeyFigure("residual", pixels(_median(p.rms_px[measured])), "median RMS of the pose"),
    ]


def spot_rows(m: ReportData) -> tuple[list[str], list[list[str]]]:
    """Heads and rows of the table of views: counts of each status, and errors."""
    heads = ["camera", "spot", *(str(s).replace("_", " ") for s in SpotStatus), "median σ (px)", "innovation RMS (px)"]
    if m.residual_px is not None:
        heads += ["residual RMS (px)", "mean residual u, v (px)"]
    doubtful = np.isfinite(m.spots.label_probability)
    if doubtful.any():
        heads.append("label left open")
    spots = None if m.errors is None else m.errors.spots
    scored = {} if spots is None else {(v.camera, v.spot): v for v in spots.per_spot}
    if scored:
        heads += ["right in view", "wrong labels", "out-of-view RMS (px)"]
    rows = []
    innovation = m.innovation_px
    for j, (camera, spot) in enumerate(m.spots.views):
        counts = [int(m.spots.has(s)[:, j].sum()) for s in SpotStatus]
        sigma = np.where(m.spots.measured[:, j], m.spots.sigma_px[:, j].max(axis=1), np.nan)
        row = [camera, spot, *(str(c) if c else "·" for c in counts)]
        row += [format_number(_median(sigma)), format_number(_rms(np.linalg.norm(innovation[:, j], axis=1)))]
        if m.residual_px is not None:
            r = m.residual_px[:, j]
            r = r[np.isfinite(r).all(axis=1)]
            mean = ", ".join(f"{x:+.3f}".replace("-", "\u2212") for x in r.mean(axis=0)) if len(r) else "\u2013"
            row += [format_number(_rms(np.linalg.norm(r, axis=1))), mean]
        if doubtful.any():
            row.append(str(int((doubtful & ~m.spots.measured)[:, j].sum()) or "·"))
        if scored:
            own = scored.get((camera, spot), ViewErrors(camera, spot))
            outside = own.out_of_view_error_px
            row += [
                format_percent(own.identity),
                counted(own.wrong_labels),
                format_number(None if outside is None else outside.rms),
            ]
        rows.append(row)
    return heads, rows


def label_words(m: ReportData) -> str:
    """How many labels were doubtful or changed, in one sentence; empty where there were none."""
    left_open = int((np.isfinite(m.spots.label_probability) & ~m.spots.measured).sum())
    kinds, again = m.summary.event_counts, m.summary.found_again
    if again is None:  # older results; here the searches of the causal pass count as well
        again = kinds.get("reacquired", 0)
    counts = [
        (left_open, "left open: no label was likely enough"),
        (kinds.get("changed", 0), "changed by the smoothing pass, which also uses later frames"),
        (kinds.get("tie", 0), "ties, in which two labellings were equally likely"),
        (kinds.get("relabelled", 0), "times all spots were labelled again during the run"),
        (again, "times the vehicle was found again after it was lost"),
    ]
    parts = [f"{count} {words}" for count, words in counts if count]
    return f"Labels: {'; '.join(parts)}." if parts else ""


def no_image_ranges(m: ReportData) -> list[tuple[str, str]]:
    """Camera, and its frame numbers without a usable picture as ranges."""
    out = []
    for camera in m.spots.cameras:
        own = [j for j, (c, _) in enumerate(m.spots.views) if c == camera]
        gone = np.any(m.spots.has(SpotStatus.NO_IMAGE)[:, own], axis=1)
        spans = m.summary.no_image.get(camera)
        if spans is None:
            spans = [(int(m.spots.frames[a]), int(m.spots.frames[b - 1])) for a, b in true_ranges(gone)]
        if spans:
            words = [str(a) if a == b else f"{a}\u2013{b}" for a, b in spans[:60]]
            more = f" … and {len(spans) - 60} more ranges" if len(spans) > 60 else ""
            total = sum(b - a + 1 for a, b in spans)
            out.append((camera, f"{', '.join(words)}{more} ({total} in all)"))
    return out
