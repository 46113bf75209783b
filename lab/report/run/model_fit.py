"""The report's section on the model check: does the rig fit the recording? From summary.json alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from geometry.arrays import Array
from lab.findings.finding import Finding, Level, verdict
from lab.number_format import format_number, format_with_sigma
from lab.report.plot import svg

HEADS = (
    "spot", "camera", "frames", "mean u (px)", "mean v (px)", "u, v in σ", "calibration sigma (px)", "scatter",
    "NIS/2 (95 %)", "outliers",
)  # fmt: skip
CLOCKS = "BP-M09"
_LONGEST = 0.1  # length of the longest arrow, as a share of the image width
_SIGNIFICANT = 3.0  # sigmas of chance and calibration: radius of the circles
_TEXTS = ("what", "why", "remedy", "code")


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
    findings = tuple(
        Finding(
            Level.__members__.get(str(f.get("level")), Level.WARN),
            **{name: str(f.get(name) or "") for name in _TEXTS},  # type: ignore[arg-type]
        )
        for f in _mappings(block.get("findings"))
    )
    rows = []
    for kind, prefix in (("views", ""), ("cameras", "all of camera "), ("beams", "all of beam ")):
        for g in _mappings(block.get(kind)):
            name = str(g.get("name"))
            camera, spot = name.rsplit("/", 1) if kind == "views" and "/" in name else ("", f"{prefix}{name}")
            rows.append((spot, camera, *_numbers(g)))
    sizes = block.get("image_sizes_px")
    drawings = [
        drawn
        for i, (camera, size) in enumerate(sizes.items() if isinstance(sizes, Mapping) else ())
        if (drawn := _drawing(i, str(camera), size, _mappings(block.get("views"))))
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


def _mappings(value: Any) -> list[Mapping[str, Any]]:
    return [v for v in value if isinstance(v, Mapping)] if isinstance(value, list) else []


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


def _signed(value: float) -> str:
    return "–" if not np.isfinite(value) else ("+" if value > 0 else "") + format_number(value, 2)


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
        words = escape(f"spot {spot}: {_signed(r[0])}, {_signed(r[1])} px")
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
