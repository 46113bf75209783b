"""The page of a repeated experiment: its table beside the printed figures, and the curves."""

from __future__ import annotations

from html import escape
from pathlib import Path

import numpy as np
from markupsafe import Markup

from geometry.arrays import Array
from lab.files.text.atomic_write import atomic_write_text
from lab.report.html import environment
from lab.report.plot import svg
from lab.report.plot.svg import Line, Scale, Shade
from lab.study.experiment_huo2015 import Study

U_COLOUR, V_COLOUR = "#0072b2", "#d55e00"
_TRACK_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")  # told apart by all eyes


def write_study(study: Study, folder: Path) -> Path:
    """Write report.html of a study into a folder; returns its path."""
    rows = [
        (r.quantity, r.unit, *(_shown(v) for v in (r.paper, r.conventional, r.curve_switching, r.beampose)), r.note)
        for r in study.rows
    ]
    html = (
        environment()
        .get_template("study.html.j2")
        .render(
            seed=study.seed,
            frames=len(study.run.frame),
            noise=f"{study.run.noise_px:g}",
            rows=rows,
            figures=[(title, words, Markup(drawing)) for title, words, drawing in _figures(study)],
        )
    )
    path = folder / "report.html"
    atomic_write_text(html, path)
    return path


def _shown(value: float | None) -> str:
    return "–" if value is None else "0" if abs(value) < 1e-9 else f"{value:.3g}" if value < 1e-2 else f"{value:.4g}"


def _figures(study: Study) -> list[tuple[str, str, str]]:
    t, n = study.run.t_s, study.run.model
    shade = (Shade(study.bends, "predicted", "the trajectory bends"),)
    out = []
    spot_1 = next(i for i, (_, spot) in enumerate(n.views) if spot == "1")
    for name in ("stiff", "loose"):
        errors = [study.same_spots[f"{kind}, {name}"][:, spot_1] for kind in ("conventional", "curve switching")]
        y_range = svg.robust_range(np.concatenate(errors), 0.5)
        panels = [
            _panel(t, f"{kind}, {name}: predicted − true, spot 1", e, shade, y_range)
            for kind, e in zip(("conventional", "curve switching"), errors, strict=True)
        ]
        out.append(
            (
                f"Prediction by the conventional and the curve-switching filter, {name} (Figs. 5 and 6)",
                "Both are given the same noisy positions. After a bend the conventional filter needs long to come back"
                " when it trusts straight lines; a loose one hardly needs the switch.",
                "".join(panels),
            )
        )
    panels = []
    for i, (_, spot) in enumerate(n.views):
        if spot not in ("3", "6"):
            continue
        lines = tuple(
            Line(study.outside_px[f"{way}, {study.run.noise_px:g} px"][:, i], colour, way)
            for way, colour in (("quadratic", V_COLOUR), ("rigid", U_COLOUR))
        )
        panels.append(
            svg.time_panel(t, f"spot {spot}: distance from truth, {study.run.noise_px:g} px noise", "px", lines=lines)
        )
    out.append(
        (
            "Spots out of view (Figs. 7 and 12)",
            "Solved from the other spots by the paper's quadratic, and from the pose of all seen spots. Without noise"
            " both are right to rounding; the printed 0.05 px means an input noise of about 0.004 px.",
            "".join(panels),
        )
    )
    out.append(
        (
            "Trajectories (Fig. 8)",
            "As tracked by beampose; the frame is the picture, beyond it positions are solved.",
            "".join(_tracks(study, c) for c in range(len(n.camera_names))),
        )
    )
    panels = []
    for i, (camera, spot) in enumerate(n.views):
        e = study.trackers["beampose"].uv_px[:, i] - study.run.uv_px[:, i]
        outside = (Shade(study.run.in_view[:, i] == 0, "outside", "out of view"),)
        panels.append(_panel(t, f"spot {spot} ({camera}): estimate − true", e, outside, svg.robust_range(e, 0.5)))
    out.append(("Tracking error (Figs. 9 and 13)", "Measured in view, solved outside (shaded).", "".join(panels)))
    return out


def _panel(t: Array, title: str, error: Array, shades: tuple[Shade, ...], y_range: tuple[float, float]) -> str:
    lines = (Line(error[:, 0], U_COLOUR, "x (u)"), Line(error[:, 1], V_COLOUR, "y (v)"))
    return svg.time_panel(t, title, "px", lines=lines, shades=shades, y_range=y_range)


def _tracks(study: Study, camera: int) -> str:
    """The ways of one camera's spots over its picture."""
    model, uv = study.run.model, study.trackers["beampose"].uv_px
    views = np.flatnonzero(model.camera_of == camera)
    width, height = model.image_size_px[views[0]]
    all_u, all_v = uv[:, views, 0], uv[:, views, 1]
    lo = np.minimum([np.nanmin(all_u), np.nanmin(all_v)], 0.0) - 20
    hi = np.maximum([np.nanmax(all_u), np.nanmax(all_v)], [width, height]) + 20
    scale = 540 / (hi[0] - lo[0])
    X = Scale(lo[0], hi[0], 0, 540)
    Y = Scale(lo[1], hi[1], 20, 20 + scale * (hi[1] - lo[1]))
    out = [svg.text(0, 12, f"camera {model.camera_names[camera]}", "title")]
    x, y = X(np.array([0.0, width])), Y(np.array([0.0, height]))
    box = f'x="{x[0]:.1f}" y="{y[0]:.1f}" width="{x[1] - x[0]:.1f}" height="{y[1] - y[0]:.1f}"'
    out.append(f'<rect {box} fill="none" stroke="currentColor" stroke-width="1"/>')
    for v in views:
        colour = _TRACK_COLOURS[int(model.spot_of[v]) % len(_TRACK_COLOURS)]
        path = svg.line_path(X(uv[:, v, 0]), Y(uv[:, v, 1]))
        out.append(f'<path d="{path}" fill="none" stroke="{colour}" stroke-width="1.3"/>')
        k = int(np.flatnonzero(~np.isnan(uv[:, v, 0]))[0])
        out.append(
            svg.text(float(X(uv[k, v, 0])) + 5, float(Y(uv[k, v, 1])) - 5, model.views[v][1], "", f"fill:{colour}")
        )
    size = f"0 0 540 {Y.b + 5:.0f}"
    name = escape(f"tracks of camera {model.camera_names[camera]}")
    return f'<svg viewBox="{size}" role="img" aria-label="{name}">{"".join(out)}</svg>'
