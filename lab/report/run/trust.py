"""Can this run be trusted? The evidence in a few lines."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools
from lab.findings.finding import Level, first_sentence, verdict
from lab.number_format import format_count, format_number, format_percent
from lab.report.plot.svg import true_ranges
from lab.report.run.model_fit import ModelFit
from lab.report.run.report_data import ReportData
from lab.report.summary import day_of
from tracking.statuses import PoseStatus

_MODEL = "Fit of rig and recording"
_LARGE = 1.5  # residuals over their stated sigma from which a camera or beam is pointed out
_SURE, _MOST, _DOUBTFUL = 0.99, 0.95, 0.9  # probability of a label: sure; share of sure labels; doubtful below
_AMBIGUOUS = (
    ("tie", "ties of two labellings"),
    ("undecided", "intervals with an undecided label"),
    ("changed", "labels changed by the smoothing pass"),
    ("relabelled", "times all spots were labelled again"),
)


@dataclass(frozen=True, slots=True)
class Evidence:
    """One line of evidence."""

    level: Level | None  # None: not known
    name: str
    text: str
    link: str = ""  # an address within the page that shows the place in the plots
    link_text: str = ""

    @property
    def word(self) -> str:
        """The level in the table: pass, check, fail or unknown."""
        return "unknown" if self.level is None else self.level.word


def time_link(m: ReportData, first: int, last: int) -> str:
    """The address within the page that enlarges the frames first..last (indices) with some frames around them."""
    margin = max(10, (last - first) // 2)
    a, b = max(first - margin, 0), min(last + margin, len(m.t_s) - 1)
    return f"#t={m.t_s[a]:.9g},{m.t_s[b]:.9g}&at={m.t_s[first]:.9g}" if b > a else ""


def evidence(m: ReportData, fit: ModelFit | None) -> list[Evidence]:
    """The lines: poses, calibration, model check, residuals by camera and by beam, labels, what was ambiguous."""
    lines = [_poses(m), _calibration(m), _model(fit), *_residuals(m), _labels(m), _ambiguous(m)]
    return [line for line in lines if line is not None]


def _poses(m: ReportData) -> Evidence | None:
    measured = m.poses.has(PoseStatus.MEASURED)
    if not len(measured):
        return Evidence(Level.FAIL, "Poses", "the results have no frames")
    gaps = true_ranges(~measured)
    if not gaps:
        return Evidence(Level.PASS, "Poses", f"measured in all {len(measured)} frames")
    first, stop = max(gaps, key=lambda gap: gap[1] - gap[0])
    gap = format_count(stop - first, "frame")
    words = f"measured in {format_percent(float(measured.mean()))} of the frames; longest gap {gap}"
    level = Level.FAIL if not measured.any() else Level.WARN if measured.mean() < _SURE else Level.PASS
    return Evidence(level, "Poses", words, time_link(m, first, stop - 1), f"frame {m.poses.frames[first]}")


def _calibration(m: ReportData) -> Evidence:
    state = m.summary.calibration
    if not state:
        return Evidence(None, "Calibration", "date and verdict are not stated in rig.yaml (block `calibration`)")
    verdict = str(state.get("verdict", "without a verdict"))
    words = f"{verdict}, of {state.get('date', 'an unknown day')}"
    recorded = None if m.run is None else m.run.recorded
    day, until = day_of(state.get("date")), day_of(state.get("valid_until"))
    if day and recorded:
        age = (recorded - day).days
        words += f", {abs(age)} days {'before' if age >= 0 else 'after'} the recording"
    elif day:
        words += "; its age is unknown, as run.yaml has no `recorded`"
    words += f"; valid until {until.isoformat()}" if until else ""
    late = bool(until and recorded and recorded > until)
    level = Level.FAIL if verdict == "FAIL" or late else Level.PASS if verdict == "PASS" else Level.WARN
    return Evidence(level, "Calibration", words)


def _model(fit: ModelFit | None) -> Evidence:
    """Whether the residuals agree with the rig as calibrated."""
    if fit is None:
        return Evidence(None, _MODEL, "the results have no model check")
    if not fit.tested:
        return Evidence(None, _MODEL, fit.sentence[:1].lower() + fit.sentence[1:].rstrip("."))
    worst = verdict(fit.findings)
    words = "the residuals agree with the calibrated rig"
    if fit.findings:
        words = (
            "deviations within the stated uncertainty" if worst is Level.PASS else "the residuals do not fit the rig"
        )
    words += f" ({format_count(fit.frames, 'frame')} tested)" if fit.frames is not None else ""
    found = "; ".join(first_sentence(f.what) for f in fit.findings[:2]) + (
        "; and more" if len(fit.findings) > 2 else ""
    )
    return Evidence(worst, _MODEL, f"{words}: {found}" if found else words)


def _residuals(m: ReportData) -> list[Evidence]:
    """The residuals by camera and by beam: median, px, and RMS over the size expected from the stated sigmas."""
    if m.residual_px is None or m.run is None or not m.residual_share:
        return [
            Evidence(
                None,
                "Residuals",
                "not known without the run folder's rig or a measured pose, nor for cameras with clocks of their own",
            )
        ]
    beams = {name: spot.beam for name, spot in m.run.rig.spots.items()}
    out = []
    for name, groups in (
        ("Residuals by camera", [camera for camera, _ in m.spots.views]),
        ("Residuals by beam", [beams.get(spot, "?") for _, spot in m.spots.views]),
    ):
        parts, largest = [], 0.0
        for group in dict.fromkeys(groups):
            own = [j for j, g in enumerate(groups) if g == group]
            r, sigma = m.residual_px[:, own], m.spots.sigma_px[:, own]
            if np.isfinite(r).any():
                ratio = float(np.sqrt(np.nanmean((r / sigma) ** 2) / m.residual_share))
                parts.append(f"{group} {format_number(_median(r), 2)} px ({format_number(ratio, 2)} × expected)")
                largest = max(largest, ratio)
        if parts:
            out.append(Evidence(Level.WARN if largest > _LARGE else Level.PASS, name, ", ".join(parts)))
    return out or [Evidence(None, "Residuals", "no frame has a measured pose")]


def _median(r: Array) -> float:
    """The median length of vectors (..., 2) with nan: a few spots that merge with false ones do not change it."""
    return float(np.nanmedian(np.linalg.norm(r, axis=-1)))


def _labels(m: ReportData) -> Evidence:
    p = m.spots.label_probability
    given: Bools = np.isfinite(p) & m.spots.measured
    if not given.any():
        return Evidence(None, "Labels", "the results state no probabilities of labels")
    sure = float((p[given] >= _SURE).mean())
    where = np.where(given, p, np.inf)
    k, j = np.unravel_index(int(np.argmin(where)), where.shape)
    words = f"{format_percent(sure)} of {int(given.sum())} are right with a probability of at least {_SURE:g}"
    if p[k, j] >= _SURE:
        return Evidence(Level.PASS, "Labels", words)
    words += f"; lowest {format_number(float(p[k, j]), 3)}, spot {m.spots.views[j][1]}"
    link = time_link(m, int(k), int(k))
    return Evidence(
        Level.PASS if sure >= _MOST and p[k, j] >= _DOUBTFUL else Level.WARN,
        "Labels",
        words,
        link,
        f"frame {m.spots.frames[k]}",
    )


def _ambiguous(m: ReportData) -> Evidence:
    left_open = np.isfinite(m.spots.label_probability) & ~m.spots.measured
    counts = [(int(left_open.sum()), "detections left without a label")]
    counts += [(m.summary.event_counts.get(kind, 0), words) for kind, words in _AMBIGUOUS]
    counts.append((m.summary.found_again or 0, "times the vehicle was lost and found again"))
    parts = [f"{count} {words}" for count, words in counts if count]
    if not parts:
        return Evidence(Level.PASS, "Ambiguous", "nothing")
    frames = np.flatnonzero(left_open.any(axis=1))
    if len(frames):
        k = int(frames[0])
        return Evidence(
            Level.WARN, "Ambiguous", "; ".join(parts), time_link(m, k, k), f"first: frame {m.spots.frames[k]}"
        )
    return Evidence(Level.WARN, "Ambiguous", "; ".join(parts))
