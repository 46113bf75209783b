"""Can this run be trusted? The evidence in a few lines; and the model check: does the rig fit the recording?"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from geometry.arrays import Array, Bools, true_ranges
from lab.findings.finding import Finding, Level, first_sentence, verdict
from lab.number_format import format_count, format_number, format_percent, format_with_sigma
from lab.report.plot import svg
from lab.report.run.report_data import ReportData
from lab.report.run.tables import label_counts
from lab.report.summary import day_of, findings_in, mappings
from lab.runs.verdict.quality import GOOD_MEASURED
from tracking.statuses import PoseStatus

HEADS = (
    "spot", "camera", "frames", "mean u (px)", "mean v (px)", "u, v in σ", "calibration sigma (px)", "scatter",
    "NIS/2 (95 %)", "outliers",
)  # fmt: skip
CLOCKS = "BP-M09"
_LONGEST = 0.1  # length of the longest arrow, as a share of the image width
_SIGNIFICANT = 3.0  # sigmas of chance and calibration: radius of the circles


@dataclass(frozen=True, slots=True)
class ModelFit:
    """The content of the section."""

    sentence: str  # the answer to the question
    findings: tuple[Finding, ...]
    rows: tuple[tuple[str, ...], ...]  # under HEADS: views, then cameras, then beams
    drawings: tuple[str, ...]  # SVG, one per camera
    tested: bool = True
    frames: int | None = None  # that the answer rests on


def model_fit(block: Mapping[str, Any] | None) -> ModelFit | None:
    """The section from the block `model_check` of summary.json; None without one."""
    if block is None:
        return None
    findings = findings_in(block.get("findings"))
    rows = []
    for kind, prefix in (("views", ""), ("cameras", "all of camera "), ("beams", "all of beam ")):
        for g in mappings(block.get(kind)):
            name = str(g.get("name"))
            camera, spot = name.rsplit("/", 1) if kind == "views" and "/" in name else ("", f"{prefix}{name}")
            rows.append((spot, camera, *_numbers(g)))
    sizes = block.get("image_sizes_px")
    drawings = [
        drawn
        for i, (camera, size) in enumerate(sizes.items() if isinstance(sizes, Mapping) else ())
        if (drawn := _drawing(i, str(camera), size, mappings(block.get("views"))))
    ]
    used = block.get("frames_for_diagnosis")
    return ModelFit(
        _sentence(block, findings),
        findings,
        tuple(rows),
        tuple(drawings),
        bool(block.get("tested")),
        used if isinstance(used, int) else None,
    )


def _sentence(block: Mapping[str, Any], findings: tuple[Finding, ...]) -> str:
    if not block.get("tested"):
        return f"Not tested: {block.get('why_not') or 'no reason is given'}."
    findings = tuple(f for f in findings if f.code != CLOCKS)  # of clocks that were estimated: no deviations
    used = f"{block.get('frames_for_diagnosis')} frames, evenly spaced"
    if not findings:
        return f"Yes: no deviation of a camera, screen, beam or clock was found ({used})."
    if verdict(findings) is Level.PASS:
        return f"Nearly: the deviations found are within the stated uncertainty ({used})."
    return f"Probably not ({used}):"


def _float(value: Any) -> float:
    return float(value) if isinstance(value, int | float) else float("nan")


def _pair(group: Mapping[str, Any], name: str) -> Array:
    """Two numbers of a group; nan where they are missing."""
    value = group.get(name)
    return np.array([_float(v) for v in value] if isinstance(value, list) and len(value) == 2 else [np.nan, np.nan])


def _numbers(g: Mapping[str, Any]) -> tuple[str, ...]:
    mean, sigma, sigmas = _pair(g, "mean_px"), _pair(g, "sigma_of_mean_px"), _pair(g, "mean_sigmas")
    allowed = _pair(g, "calibration_px")
    means = [format_with_sigma(m, s, signed=True) for m, s in zip(mean.tolist(), sigma.tolist(), strict=True)]
    nis = g.get("nis")
    nis_text = "–"
    if isinstance(nis, Mapping):
        low, high = format_number(_float(nis.get("low"))), format_number(_float(nis.get("high")))
        nis_text = f"{format_number(_float(nis.get('mean')))} ({low} to {high})"
    share = _float(g.get("outliers"))
    return (
        str(g.get("frames")),
        *means,
        ", ".join(f"{s:+.2f}".replace("-", "\u2212") for s in sigmas) if np.isfinite(sigmas).all() else "–",
        f"{format_number(allowed[0], 2)}, {format_number(allowed[1], 2)}" if np.any(allowed > 0) else "–",
        format_number(_float(g.get("scatter"))),
        nis_text,
        "–" if not np.isfinite(share) else f"{100 * share:.2g} %",
    )


def _drawing(index: int, camera: str, size: Any, views: list[Mapping[str, Any]]) -> str:
    """Mean residuals as arrows over the image, with circles of 3 sigma of chance and calibration together."""
    own = [v for v in views if str(v.get("name")).rpartition("/")[0] == camera]
    place = np.array([_pair(v, "place_px") for v in own]).reshape(-1, 2)
    mean = np.array([_pair(v, "mean_px") for v in own]).reshape(-1, 2)
    chance = np.array([np.hypot(_pair(v, "sigma_of_mean_px"), _pair(v, "calibration_px")) for v in own]).reshape(-1, 2)
    known = np.isfinite(place).all(axis=1) & np.isfinite(mean).all(axis=1)
    if not known.any() or not (isinstance(size, list) and len(size) == 2):
        return ""
    plane = svg.image_area((int(size[0]), int(size[1])))
    longest = float(np.linalg.norm(mean[known], axis=1).max())
    factor = svg.round_size(_LONGEST * float(size[0]) / max(longest, 1e-6))
    left, top, wide, high = plane.box
    clip = f"clip-residuals-{index}"
    parts = [
        svg.heading(plane, f"camera {camera}: mean residual of each spot"),
        f'<clipPath id="{clip}"><rect x="{left:.1f}" y="{top:.1f}" width="{wide:.1f}" height="{high:.1f}"/></clipPath>',
        f'<g clip-path="url(#{clip})">',
    ]
    scale = abs(plane.X.b - plane.X.a) / abs(plane.X.hi - plane.X.lo)
    for v, at, r, s, good in zip(own, place, mean, chance, known, strict=True):
        if not good:
            continue
        radius = _SIGNIFICANT * float(np.sqrt(np.mean(s**2)))
        start, end = plane.at(at[None]), plane.at((at + factor * r)[None])
        colour = svg.VERMILLION if np.linalg.norm(r) > radius else svg.BLUE
        spot = str(v.get("name")).rpartition("/")[2]
        words = escape(f"spot {spot}: {format_number(r[0], 2, True)}, {format_number(r[1], 2, True)} px")
        parts.append(
            f'<g><title>{words}</title><circle cx="{start[0, 0]:.1f}" cy="{start[0, 1]:.1f}"'
            f' r="{min(radius * factor * scale, 2000.0):.1f}" fill="none" stroke="var(--soft)" stroke-dasharray="3 3"/>'
            f'<path d="{svg.segments(start, end)}" stroke="{colour}" stroke-width="2"/>'
            f'<path d="{svg.dots(start, 3)}" fill="{colour}"/>'
            f"{svg.text(start[0, 0] + 7, start[0, 1] - 7, spot, 'label')}</g>"
        )
    times = f"{factor:,.0f}".replace(",", "\u202f") if factor >= 1 else svg.number(factor)
    parts += ["</g>", svg.frame(plane)]
    parts.append(svg.note(plane, f"arrows magnified {times} times; longest {format_number(longest, 2)} px"))
    return svg.svg_of(plane, f"mean residuals in camera {camera}", parts)


_MODEL = "Fit of rig and recording"
_LARGE = 1.5  # residuals over their stated sigma from which a camera or beam is pointed out
_SURE, _MOST, _DOUBTFUL = 0.99, 0.95, 0.9  # probability of a label: sure; share of sure labels; doubtful below


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
    level = Level.FAIL if not measured.any() else Level.WARN if measured.mean() < GOOD_MEASURED else Level.PASS
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
    words = "the residuals do not fit the rig" if worst > Level.PASS else "deviations within the stated uncertainty"
    words = words if fit.findings else "the residuals agree with the calibrated rig"
    words += f" ({format_count(fit.frames, 'frame')} tested)" if fit.frames is not None else ""
    found = "; ".join(first_sentence(f.what) for f in fit.findings[:2])
    found += "; and more" if len(fit.findings) > 2 else ""
    return Evidence(worst, _MODEL, f"{words}: {found}" if found else words)


def _residuals(m: ReportData) -> list[Evidence]:
    """The residuals by camera and by beam: median, px, and RMS over the size expected from the stated sigmas."""
    if m.residual_px is None or m.run is None or not m.residual_share:
        why = "not known without the run folder's rig or a measured pose, nor for cameras with clocks of their own"
        return [Evidence(None, "Residuals", why)]
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
    level = Level.PASS if sure >= _MOST and p[k, j] >= _DOUBTFUL else Level.WARN
    return Evidence(level, "Labels", words, time_link(m, int(k), int(k)), f"frame {m.spots.frames[k]}")


def _ambiguous(m: ReportData) -> Evidence:
    parts = label_counts(m)
    if not parts:
        return Evidence(Level.PASS, "Ambiguous", "nothing")
    left_open = np.isfinite(m.spots.label_probability) & ~m.spots.measured
    frames: list[int] = np.flatnonzero(left_open.any(axis=1)).tolist()
    place = [(time_link(m, k, k), f"first: frame {m.spots.frames[k]}") for k in frames[:1]]
    return Evidence(Level.WARN, "Ambiguous", "; ".join(parts), *(place[0] if place else ()))
