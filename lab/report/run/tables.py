"""The numbers of a report: key figures, the table of spots, errors against truth, and what summary.json says."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from geometry.arrays import Array
from lab.number_format import angle, length, percent, short
from lab.report.plot.svg import runs
from lab.report.run.report_data import ReportData
from tracking.statuses import PoseStatus, SpotStatus


@dataclass(frozen=True, slots=True)
class Key:
    """One key figure."""

    name: str
    value: str
    note: str = ""


def pixels(value: float | None) -> str:
    """A distance in the picture."""
    return "\u2013" if value is None or not np.isfinite(value) else f"{short(value)} px"


def at(tree: Any, *path: str) -> Any:
    """A value deep in nested mappings; None where any step is missing."""
    for name in path:
        tree = tree.get(name) if isinstance(tree, dict) else None
    return tree


def _median(values: Array) -> float | None:
    values = values[np.isfinite(values)]
    return float(np.median(values)) if values.size else None


def _rms(values: Array) -> float | None:
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(values**2))) if values.size else None


def key_figures(m: ReportData) -> list[Key]:
    """What a reader wants to know first, from the results themselves."""
    n = len(m.spots.frames)
    p = m.poses
    measured = p.has(PoseStatus.MEASURED)
    span = float(m.t_s[-1] - m.t_s[0]) if n else 0.0
    wanted = m.spots.has(SpotStatus.MATCHED, SpotStatus.TURNED, SpotStatus.OCCLUDED)
    seen = m.spots.measured.sum() / wanted.sum() if wanted.any() else None
    sigma_m = _median(np.linalg.norm(p.sigma_position_m[measured], axis=1))
    yaw_note, position_note = "median of measured poses", "median of √(σx²+σy²+σz²)"
    if m.causal is not None:
        then = m.causal.has(PoseStatus.MEASURED)
        yaw_then = _median(m.causal.sigma_ypr_deg[then, 0])
        position_then = _median(np.linalg.norm(m.causal.sigma_position_m[then], axis=1))
        yaw_note = f"median, smoothed; causal {angle(yaw_then)}"
        position_note = f"median, smoothed; causal {length(position_then)}"
    return [
        Key("frames", f"{n:,}".replace(",", "\u202f"), f"{short(span)} s" if m.time_name != "frame" else ""),
        Key("pose measured", percent(float(measured.mean()) if len(measured) else None), "of all frames"),
        Key("spots found", percent(None if seen is None else float(seen)), "of those that should be in view"),
        Key("σ of yaw", angle(_median(p.sigma_ypr_deg[measured, 0])), yaw_note),
        Key("σ of position", length(sigma_m), position_note),
        Key("residual", pixels(_median(p.rms_px[measured])), "median RMS of the pose"),
    ]


def truth_figures(e: dict[str, Any] | None) -> list[Key]:
    """The same, against truth; `e` as lab.runs.score.score.score gives it."""
    if e is None:
        return []
    keys = []
    if at(e, "spots"):
        outside = at(e, "spots", "out_of_view_px")
        keys += [
            Key("right in view", percent(at(e, "spots", "in_view_identity")), "of visible spots"),
            Key("wrong labels", _count(at(e, "spots", "wrong_labels")), "measured rows"),
            Key("prediction error", pixels(at(e, "spots", "prediction_px", "smooth", "rms")), "RMS, true bends apart"),
            Key(
                "out-of-view error",
                pixels(at(outside, "rms")),
                f"RMS; largest {pixels(at(outside, 'max'))}" if outside else "none was out of view",
            ),
        ]
    if at(e, "pose", "measured"):
        notes = {"rotation_deg": "RMS, measured poses", "position_m": "RMS, measured poses"}
        for name, shown in (("rotation_deg", angle), ("position_m", length)):
            causal = at(e, "pose_causal", "measured", name, "rms")
            if causal is not None:
                notes[name] = f"RMS, smoothed; causal {shown(causal)}"
        keys += [
            Key("rotation error", angle(at(e, "pose", "measured", "rotation_deg", "rms")), notes["rotation_deg"]),
            Key("position error", length(at(e, "pose", "measured", "position_m", "rms")), notes["position_m"]),
            Key("NEES", short(at(e, "pose", "measured", "nees_mean")), "mean; 6 if σ is true"),
        ]
    return keys


def _count(value: Any) -> str:
    return "\u2013" if value is None else str(value)


def spot_rows(m: ReportData) -> tuple[list[str], list[list[str]]]:
    """Heads and rows of the table of views: statuses, and what their errors are."""
    heads = ["camera", "spot", *(str(s).replace("_", " ") for s in SpotStatus), "median σ (px)", "innovation RMS (px)"]
    if m.residual_px is not None:
        heads += ["residual RMS (px)", "mean residual u, v (px)"]
    doubtful = np.isfinite(m.spots.label_probability)
    if doubtful.any():
        heads.append("label left open")
    scored = {(r["camera"], r["spot"]): r for r in at(m.errors, "spots", "per_spot") or ()}
    if scored:
        heads += ["right in view", "wrong labels", "out-of-view RMS (px)"]
    rows = []
    innovation = m.innovation_px
    for j, (camera, spot) in enumerate(m.spots.views):
        counts = [int(m.spots.has(s)[:, j].sum()) for s in SpotStatus]
        sigma = np.where(m.spots.measured[:, j], m.spots.sigma_px[:, j].max(axis=1), np.nan)
        row = [camera, spot, *(str(c) if c else "·" for c in counts)]
        row += [short(_median(sigma)), short(_rms(np.linalg.norm(innovation[:, j], axis=1)))]
        if m.residual_px is not None:
            r = m.residual_px[:, j]
            r = r[np.isfinite(r).all(axis=1)]
            mean = ", ".join(f"{x:+.3f}".replace("-", "\u2212") for x in r.mean(axis=0)) if len(r) else "\u2013"
            row += [short(_rms(np.linalg.norm(r, axis=1))), mean]
        if doubtful.any():
            row.append(str(int((doubtful & ~m.spots.measured)[:, j].sum()) or "·"))
        if scored:
            own = scored.get((camera, spot), {})
            row += [
                percent(own.get("identity")),
                _count(own.get("wrong_labels")),
                short(at(own, "out_of_view_error_px", "rms")),
            ]
        rows.append(row)
    return heads, rows


def pixel_rows(errors: dict[str, Any] | None) -> list[tuple[str, ...]]:
    """Errors in the picture: what, rows, RMS u, RMS v, 99th percentile and largest distance (px), meaning."""
    kinds = (
        ("prediction", ("prediction_px", "smooth"), "one frame ahead; starts and true bends apart"),
        ("prediction, matched", ("prediction_px", "straight"), "rows that the first search found; starts apart"),
        ("prediction at turns", ("prediction_px", "turned"), "rows that the second search found"),
        ("prediction at true bends", ("prediction_px", "bends"), "where the true path bends by more than 2 px"),
        ("prediction at the start", ("prediction_px", "start"), "the first two frames of a track: no speed is known"),
        ("measured place", ("measured_px",), "of the spots that were found right"),
        ("out of view", ("out_of_view_px",), "solved from the other beams"),
        ("occluded", ("occluded_px",), "the estimate while no detection was accepted"),
    )
    out = []
    for name, path, meaning in kinds:
        block = at(errors, "spots", *path)
        if block:
            numbers = [short(block.get(k)) for k in ("rms_u", "rms_v", "p99", "max")]
            out.append((name, str(block.get("rows", "")), *numbers, meaning))
    return out


def error_rows(errors: dict[str, Any] | None) -> list[tuple[str, str, str]]:
    """Name, value and meaning of the other errors against truth."""
    out: list[tuple[str, str, str]] = []
    s = at(errors, "spots")
    if s:
        rate = s.get("recognition_rate_eq15") or {}
        out += [
            ("right identity in view", percent(s.get("in_view_identity")), "of visible spots found as themselves"),
            (
                "wrong labels",
                f"{s.get('wrong_labels')} ({percent(s.get('wrong_label_share'))})",
                "of all measured rows",
            ),
        ]
        for name, what in (("re_entries", "re-entries kept"), ("after_hiding", "kept after hiding")):
            block = s.get(name) or {}
            if block.get("total"):
                delay = block.get("max_delay_frames")
                late = "" if not delay else f", at most {delay} frames late"
                out.append((what, f"{block['kept']} of {block['total']}{late}", "found again under the same name"))
        out += [
            ("recognition rate, eq. (15)", percent(rate.get("paper")), "all rows; what is out of view counts as wrong"),
            ("… in view only", percent(rate.get("in_view")), "of the rows with a visible spot"),
            ("… all, within 3 px", percent(rate.get("all_within_tolerance")), "seen or solved alike"),
        ]
    kinds = [("pose", "measured", ""), ("pose", "predicted", ""), ("pose_causal", "measured", ", causal")]
    for which, name, causal in kinds:
        block = at(errors, which, name)
        if not block:
            continue
        name += causal
        turns = ", ".join(f"{k} {angle(v)}" for k, v in block["rotation_rms_deg"].items())
        shifts = ", ".join(f"{k} {length(v)}" for k, v in block["position_rms_m"].items())
        rows = f"{block['rows']} frames"
        largest = angle(block["rotation_deg"]["max"]), length(block["position_m"]["max"])
        out += [
            (f"rotation, {name} poses", f"RMS {turns}; largest {largest[0]}", f"about the body's axes, {rows}"),
            (f"position, {name} poses", f"RMS {shifts}; largest {largest[1]}", f"along the world's axes, {rows}"),
        ]
        if block.get("nees_mean") is not None:
            low, high = (short(x) for x in block["nees_mean_95"])
            meaning = f"6 expected; {low} to {high} in 95 % of runs of independent frames"
            out.append((f"NEES, {name} poses", short(block["nees_mean"]), meaning))
    return out + _motion_rows(errors)


def _motion_rows(errors: dict[str, Any] | None) -> list[tuple[str, str, str]]:
    """Velocity and rate against differences of the true poses."""
    out = []
    for block_name, causal in (("motion_vs_differences", ""), ("motion_causal_vs_differences", ", causal")):
        for name, what, unit in (("velocity_m_s", "velocity", "mm/s"), ("rate_rad_s", "angular rate", "mrad/s")):
            block = at(errors, block_name, name)
            if not block:
                continue
            axes = ", ".join(f"{k} {short(1000 * v)} {unit}" for k, v in block["rms_axes"].items())
            bends = at(errors, block_name, "rows_at_bends_left_out")
            meaning = "against differences of the true poses" + (f", {bends} frames at bends apart" if bends else "")
            out.append((f"{what}{causal}", f"RMS {axes}; largest {short(1000 * block['max'])} {unit}", meaning))
    return out


def label_words(m: ReportData) -> str:
    """What became of doubtful labels, in one sentence; empty where there were none."""
    left_open = int((np.isfinite(m.spots.label_probability) & ~m.spots.measured).sum())
    counts = at(m.summary, "counts", "events")
    kinds = counts if isinstance(counts, dict) else {}
    # Searches of the causal pass are events too, where the smoothing pass knows the vehicle throughout.
    again = at(m.summary, "counts", "found_again")
    again = kinds.get("reacquired") if again is None else again
    said = [
        (left_open, "left open: no label was likely enough to be given"),
        (kinds.get("changed"), "changed by the smoothing pass, which knows what came after"),
        (kinds.get("tie"), "ties, in which two labellings were as likely"),
        (kinds.get("relabelled"), "times all spots were named anew in the midst of the track"),
        (again, "times the vehicle was found again after it was lost"),
    ]
    parts = [f"{count} {words}" for count, words in said if isinstance(count, int) and count]
    return f"Labels: {'; '.join(parts)}." if parts else ""


def flattened(tree: Any, name: str = "") -> list[tuple[str, str]]:
    """Names with dots and plain values of nested mappings, for a table."""
    if isinstance(tree, dict):
        return [row for key, value in tree.items() for row in flattened(value, f"{name}.{key}" if name else str(key))]
    if isinstance(tree, list) and any(isinstance(x, dict) for x in tree):
        return [row for i, value in enumerate(tree) for row in flattened(value, f"{name}[{i}]")]
    if isinstance(tree, list):
        return [(name, ", ".join(_plain(x) for x in tree))]
    return [(name, _plain(tree))]


def _plain(value: Any) -> str:
    if value is None:
        return "not set"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def no_image_ranges(m: ReportData) -> list[tuple[str, str]]:
    """Camera, and the frame numbers without a usable picture, written as ranges."""
    out = []
    for camera in m.spots.cameras:
        own = [j for j, (c, _) in enumerate(m.spots.views) if c == camera]
        gone = np.any(m.spots.has(SpotStatus.NO_IMAGE)[:, own], axis=1)
        listed = at(m.summary, "counts", "no_image", camera)
        if isinstance(listed, list):
            spans = [(int(r[0]), int(r[-1])) for r in listed if isinstance(r, list) and r]
        else:
            spans = [(int(m.spots.frames[a]), int(m.spots.frames[b - 1])) for a, b in runs(gone)]
        if spans:
            words = [str(a) if a == b else f"{a}\u2013{b}" for a, b in spans[:60]]
            more = f" … and {len(spans) - 60} more ranges" if len(spans) > 60 else ""
            total = sum(b - a + 1 for a, b in spans)
            out.append((camera, f"{', '.join(words)}{more} ({total} in all)"))
    return out
