"""Section 5.1 of Huo (2015): the table beside the published figures, and the curves."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array
from lab.report.plot.axes import axes, plot_area, svg_of
from lab.report.plot.scales import robust_range
from lab.report.plot.series import Line, Shade, time_panel
from lab.report.plot.svg import BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILLION, line_path, text
from lab.study.comparison import Comparison, Figure
from lab.study.experiment_huo2015 import METHOD_NAMES, Study, repeat_huo2015

U_COLOUR, V_COLOUR = BLUE, VERMILLION
_TRACK_COLOURS = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY)


def compare_huo2015(seed: int = 1, frames: int = 600) -> Comparison:
    """The table and the figures of section 5.1."""
    return comparison_of(repeat_huo2015(seed, frames))


def comparison_of(study: Study) -> Comparison:
    """The content of the page of a repeated experiment."""
    return Comparison(
        title="Huo, Yang & Yang (2015), section 5.1",
        setting=f"{len(study.run.frame)} frames · 100 Hz · three beams · {study.run.noise_px:g} px noise"
        f" (the paper states none) · 20 % clutter · seed {study.seed}",
        methods=METHOD_NAMES,
        rows=study.rows,
        explanation="Conventional and curve switching: the paper's tracker alone (no rigid-body check, occluded spots"
        " from their own filter, quadratic equation out of view), without and with eq. (6). Beampose: the default"
        " settings of method “spots”.",
        figures=tuple(Figure(*figure) for figure in _figures(study)),
        source="J. Huo, N. Yang, M. Yang, Optics and Precision Engineering 23(8), 2134 (2015),"
        " doi 10.3788/OPE.20152308.2134.",
    )


def _figures(study: Study) -> list[tuple[str, str, str]]:
    t, n = study.run.t_s, study.run.model
    shade = (Shade(study.bends, "predicted", "the trajectory bends"),)
    out = []
    spot_1 = next(i for i, (_, spot) in enumerate(n.views) if spot == "1")
    for name in ("stiff", "loose"):
        errors = [study.prediction_errors[f"{kind}, {name}"][:, spot_1] for kind in ("conventional", "curve switching")]
        y_range = robust_range(np.concatenate(errors), 0.5)
        panels = [
            _panel(t, f"{kind}, {name}: predicted − true, spot 1", e, shade, y_range)
            for kind, e in zip(("conventional", "curve switching"), errors, strict=True)
        ]
        out.append(
            (
                f"Prediction by the conventional and the curve-switching filter, {name} (Figs. 5 and 6)",
                "Both filters get the same noisy positions. After a bend the conventional filter needs many frames to"
                " converge if its process noise is small; with a large process noise switching has little effect.",
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
            time_panel(t, f"spot {spot}: distance from truth, {study.run.noise_px:g} px noise", "px", lines=lines)
        )
    out.append(
        (
            "Spots out of view (Figs. 7 and 12)",
            "Solved from the other spots by the paper's quadratic equation, and from the pose of all visible spots."
            " Without noise both are exact to rounding; the published 0.05 px corresponds to an input noise of about"
            " 0.004 px.",
            "".join(panels),
        )
    )
    out.append(
        (
            "Trajectories (Fig. 8)",
            "As tracked by beampose. The rectangle is the edge of the picture; positions outside are solved.",
            "".join(_tracks(study, c) for c in range(len(n.camera_names))),
        )
    )
    panels = []
    for i, (camera, spot) in enumerate(n.views):
        e = study.trackers["beampose"].uv_px[:, i] - study.run.uv_px[:, i]
        outside = (Shade(study.run.in_view[:, i] == 0, "outside", "out of view"),)
        panels.append(_panel(t, f"spot {spot} ({camera}): estimate − true", e, outside, robust_range(e, 0.5)))
    out.append(("Tracking error (Figs. 9 and 13)", "Measured in view, solved out of view (shaded).", "".join(panels)))
    return out


def _panel(t: Array, title: str, error: Array, shades: tuple[Shade, ...], y_range: tuple[float, float]) -> str:
    lines = (Line(error[:, 0], U_COLOUR, "x (u)"), Line(error[:, 1], V_COLOUR, "y (v)"))
    return time_panel(t, title, "px", lines=lines, shades=shades, y_range=y_range)


def _tracks(study: Study, camera: int) -> str:
    """The tracks of one camera's spots with the edge of its picture."""
    model, uv = study.run.model, study.trackers["beampose"].uv_px
    views = np.flatnonzero(model.camera_of == camera)
    size = np.array(model.image_size_px[views[0]], dtype=float)
    lo = np.minimum(np.nanmin(uv[:, views], axis=(0, 1)), 0.0) - 20
    hi = np.maximum(np.nanmax(uv[:, views], axis=(0, 1)), size) + 20
    p = plot_area((lo[0], hi[0]), (lo[1], hi[1]), equal=True, y_down=True, bottom=38)
    title = f"camera {model.camera_names[camera]}"
    out = axes(p, title, "u (px)", "v (px)", grid=False)
    (x0, y0), (x1, y1) = p.at(np.array([[0.0, 0.0], size])).tolist()
    box = f'x="{x0:.1f}" y="{y0:.1f}" width="{x1 - x0:.1f}" height="{y1 - y0:.1f}"'
    out.append(f'<rect {box} fill="none" stroke="currentColor" stroke-width="1"/>')
    for v in views:
        colour = _TRACK_COLOURS[int(model.spot_of[v]) % len(_TRACK_COLOURS)]
        at = p.at(uv[:, v])
        out.append(f'<path d="{line_path(at[:, 0], at[:, 1])}" fill="none" stroke="{colour}" stroke-width="1.3"/>')
        x, y = at[int(np.flatnonzero(~np.isnan(at[:, 0]))[0])].tolist()
        out.append(text(x + 5, y - 5, model.views[v][1], "", f"fill:{colour}"))
    return svg_of(p, f"tracks of {title}", out)
