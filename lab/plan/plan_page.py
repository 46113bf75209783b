"""The page of a plan: what is in view, what sigma to expect where, and what makes it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from calibration.findings import Finding, verdict
from geometry.arrays import Array
from lab import number_format
from lab.number_format import angle, length, percent
from lab.plan.plan_drawings import cell_map, share_bars
from lab.plan.plan_findings import JOINED, TOGETHER, advice, axis_words, budget_lines, median_sigma, worst_first
from lab.plan.plan_grid import AXES, STATUS, Plan, plan_grid
from lab.plan.plan_options import Range, poses_of
from lab.report.calibration.calibration_page import (
    CalibrationReport,
    PageDrawing,
    PageTable,
    Section,
    provenance,
    write_calibration_report,
)
from lab.report.calibration.calibration_scene import rig_things, scene_views
from lab.report.plot.maps import heat_map

_WORST_ROWS, _EFFECT_ROWS = 24, 20
_FINE = 41  # places along each side of a smooth map
# Pairs of coordinates with a map: first across, second up.
_PLANES = (("yaw_deg", "pitch_deg"), ("x_m", "y_m"), ("x_m", "z_m"))


def write_plan_page(plan: Plan, found: Sequence[Finding], rig_path: Path, folder: Path) -> Path:
    """Write report.html of a plan into a folder; returns its path."""
    report = CalibrationReport(
        kind="Plan",
        name=rig_path.stem if rig_path.stem != "rig" else rig_path.resolve().parent.name,
        verdict=verdict(found),
        findings=found,
        key_figures=_key_figures(plan),
        sections=[
            Section("What to improve first", advice(plan) or "No pose can be solved: there is nothing to weigh yet."),
            _budget(plan),
            *_maps(plan),
            _sight(plan),
            _worst(plan),
            _effects(plan),
            _scene(plan),
            _assumptions(plan),
        ],
        made=provenance([rig_path]),
    )
    return write_calibration_report(report, folder)


def _key_figures(plan: Plan) -> list[tuple[str, str, str]]:
    m, deg = median_sigma(plan)
    solved = plan.worst[plan.observable]
    top = solved.max(axis=0).tolist() if len(solved) else [np.nan, np.nan]
    lines = [line for line in budget_lines(plan) if line.name != JOINED]
    figures = [
        ("Measurable", percent(float(plan.measured.mean())), f"of {len(plan.status)} poses"),
        ("Attitude", angle(deg), f"median of 1 sigma; up to {angle(top[1])}"),
        ("Position", length(m), f"median of 1 sigma; up to {length(top[0])}"),
    ]
    if lines:
        figures.append(("Limited by", lines[0].name, f"{percent(lines[0].share_deg)} of the attitude's variance"))
    return figures


def _budget(plan: Plan) -> Section:
    lines = budget_lines(plan)
    m, deg = median_sigma(plan)
    rows: list[list[object]] = [
        [
            line.name, line.source, 1e3 * line.sigma_deg, percent(line.share_deg), 1e3 * line.halved_deg,
            1e3 * line.sigma_m, percent(line.share_m), 1e3 * line.halved_m,
        ]
        for line in lines
    ]  # fmt: skip
    rows.append(["all together", "", 1e3 * deg, "100 %", None, 1e3 * m, "100 %", None])
    heads = (
        "contributor", "from", "attitude sigma (mdeg)", "share", "all if halved (mdeg)", "position sigma (mm)",
        "share", "all if halved (mm)",
    )  # fmt: skip
    words = [
        "Sigmas along the direction in which each pose is known worst: the median over the poses that can be solved."
        " Shares are of the variance, mean over the poses; a part's sigma is its share of the median, and parts add as"
        " squares."
    ]
    if any(line.name == JOINED for line in lines):
        words.append(f"{JOINED[0].upper()}{JOINED[1:]}: covariance between groups, below zero where errors cancel.")
    if any(line.name == TOGETHER for line in lines):
        words.append(
            "The rig file comes from a joint calibration: its errors of lenses, places and beams cancel each other in"
            " large part, so that single shares would say nothing."
        )
    drawings = [
        PageDrawing(share_bars([(x.name, x.share_deg) for x in lines], "Attitude: shares of the variance")),
        PageDrawing(share_bars([(x.name, x.share_m) for x in lines], "Position: shares of the variance")),
    ]
    return Section("Error budget", words, drawings if lines else (), PageTable(heads, rows))


def _maps(plan: Plan) -> list[Section]:
    ranges, names = plan.options.ranges, list(plan.options.ranges)
    if not plan.observable.any():
        return []
    return [
        _plane(plan, names.index(across), names.index(up))
        for across, up in _PLANES
        if ranges[across].count >= 3 and ranges[up].count >= 3
    ]


def _plane(plan: Plan, across: int, up: int) -> Section:
    """Maps over two of the six coordinates: a fine one with the others at their middle, and the worst of the others."""
    names, ranges = list(plan.options.ranges), list(plan.options.ranges.values())
    a, b = ranges[across], ranges[up]
    short = [n.split("_")[0] for n in names]
    axis_names = [f"{s} ({n.split('_')[1]})" for s, n in zip(short, names, strict=True)]
    x_name, y_name = axis_names[across], axis_names[up]
    fine = fine_map(plan, across, up)

    def smooth(k: int, what: str, unit: str) -> PageDrawing:
        values = 1e3 * fine[..., k]
        extent = (a.first, a.last, b.first, b.last)
        title = f"{what} sigma ({unit}), the others in the middle of their ranges"
        return PageDrawing(
            heat_map(
                values, extent, title, unit, x_name=x_name, y_name=y_name, y_down=False, equal=False,
                limits=_limits(values),
            )
        )  # fmt: skip

    def cells(values: Array, how: str, title: str, dark_is_low: bool = False) -> PageDrawing:
        grid = _gathered(plan, values, across, up, how)
        return PageDrawing(
            cell_map(grid, a.values(), b.values(), title, x_name=x_name, y_name=y_name, dark_is_low=dark_is_low)
        )

    spots = plan.seen.sum(axis=1).astype(float)
    drawings = [
        smooth(1, "Attitude", "mdeg"),
        smooth(0, "Position", "mm"),
        cells(plan.worst[:, 1] * 1e3, "largest", "Attitude sigma (mdeg), the worst of all others"),
        cells(plan.worst[:, 0] * 1e3, "largest", "Position sigma (mm), the worst of all others"),
    ]
    words = ["1 sigma along the worst direction. Hatched or crossed: no pose there can be solved."]
    fewest = _gathered(plan, spots, across, up, "least")
    if fewest.min() < fewest.max():
        drawings.append(cells(spots, "least", "Spots in view, the fewest of all others", dark_is_low=True))
    else:
        words.append(
            f"Everywhere here some pose sees no more than {fewest.min():.0f} spots, of {len(plan.views)} views."
        )
    if not plan.measured.all():
        share = np.where(plan.measured, 100.0, 0.0)
        drawings.append(cells(share, "mean", "Poses that can be measured (%)", dark_is_low=True))
    return Section(f"Over {short[across]} and {short[up]}", words, drawings)


def _limits(values: Array) -> tuple[float, float] | None:
    """The range of the colours: never less than a quarter of the value, so that what hardly varies looks so."""
    finite = values[np.isfinite(values)]
    if not finite.size or finite.max() > 1.25 * finite.min():
        return None
    return float(finite.min()), 1.25 * float(finite.min())


def fine_map(plan: Plan, across: int, up: int) -> Array:
    """Position (m) and attitude (deg) sigma (rows, columns, 2) over two coordinates, the others in the middle.

    Rows run over coordinate `up`, columns over `across`.
    """
    fixed: dict[str, Any] = {
        name: replace(r, count=_FINE) if i in (across, up) else Range(r.middle, r.middle, 1)
        for i, (name, r) in enumerate(plan.options.ranges.items())
    }
    fine = plan_grid(plan.rig, plan.errors, plan.sources, replace(plan.options, **fixed))
    values = fine.worst.reshape(_FINE, _FINE, 2)  # the later of the two coordinates runs along the second axis
    return np.swapaxes(values, 0, 1) if across < up else values


def _gathered(plan: Plan, values: Array, across: int, up: int, how: str) -> Array:
    """Values (k,) of all poses as a map (rows of `up`, columns of `across`); nan where there is none."""
    counts = [r.count for r in plan.options.ranges.values()]
    cube = np.moveaxis(values.reshape(counts), (up, across), (0, 1)).reshape(counts[up], counts[across], -1)
    empty = np.asarray(np.isnan(cube).all(axis=-1))
    safe = np.where(empty[..., None], 0.0, cube)
    ways: dict[str, Callable[..., Array]] = {"largest": np.nanmax, "least": np.nanmin, "mean": np.nanmean}
    return np.where(empty, np.nan, ways[how](safe, axis=-1))


def _sight(plan: Plan) -> Section:
    rows: list[list[object]] = []
    for i, (camera, spot) in enumerate(plan.views):
        known = plan.margin_px[:, i][np.isfinite(plan.margin_px[:, i])]
        margins = [round(float(np.median(known))), round(float(known.min()))] if len(known) else [None, None]
        off = float(np.isnan(plan.margin_px[:, i]).mean())
        rows.append([camera, spot, percent(float(plan.seen[:, i].mean())), percent(off), *margins])
    words = (
        f"A spot is in view where it lies {plan.options.edge_px:g} px or more inside its picture. Margins are to the"
        " picture's edge, negative outside: by so much a lens or a pose of the camera must give way."
    )
    heads = ("camera", "spot", "in view", "without projection", "median margin (px)", "least margin (px)")
    return Section("What is in view", words, (), PageTable(heads, rows))


def _worst(plan: Plan) -> Section:
    spots, rows = plan.seen.sum(axis=1), []
    for i in worst_first(plan, _WORST_ROWS):
        seen = plan.seen[i]
        margin = f"{plan.margin_px[i][seen].min():.0f}" if seen.any() else "–"
        c = plan.coordinates[i].tolist()
        rows.append(
            [
                _three(c[:3], 3), _three(c[3:], 1),
                STATUS[plan.status[i]], int(spots[i]), margin, angle(float(plan.worst[i, 1])),
                axis_words(plan.worst_axis[i, 1]), length(float(plan.worst[i, 0])), axis_words(plan.worst_axis[i, 0]),
                number_format.short(float(plan.condition[i])),
            ]
        )  # fmt: skip
    heads = (
        "x y z (m)", "yaw pitch roll (deg)", "status", "spots", "least margin (px)", "attitude", "about (body)",
        "position", "along (world)", "condition",
    )  # fmt: skip
    words = "Those that cannot be solved first, then by attitude sigma. All poses are in plan.csv."
    return Section("Worst poses", words, (), PageTable(heads, rows))


def _three(values: Sequence[float], decimals: int) -> str:
    return "  ".join(f"{v + 0.0:g}" for v in np.round(values, decimals).tolist()).replace("-", "−")


def _effects(plan: Plan) -> Section:
    size = np.linalg.norm(plan.thing_median[:, 3:], axis=1)
    rows: list[list[object]] = []
    for i in np.argsort(-size, kind="stable").tolist()[:_EFFECT_ROWS]:
        thing, group, _ = plan.errors.things[i]
        kind, name = thing.split(".", 1)
        rows.append([f"{kind.removesuffix('s')} {name}", group, *(float(v) * 1e3 for v in plan.thing_median[i])])
    heads = ("of", "errors", *(f"{a.split('_')[0]} ({_milli(a)})" for a in AXES))
    words = (
        "What the errors of one camera, screen or beam do to the pose, median over the poses, the largest"
        " effects on the attitude first. A lens's errors take its camera's pose along where that is to come from a"
        " resection. The effect of every single number is in effects.csv."
    )
    return Section("What each calibration error does", words, (), PageTable(heads, rows))


def _milli(axis: str) -> str:
    return "mm" if axis.endswith("_m") else "mdeg"


def _scene(plan: Plan) -> Section:
    middle = np.array([[r.middle for r in plan.options.ranges.values()]])
    drawings = scene_views(rig_things(plan.rig, poses_of(middle)[0]), "The rig, vehicle in the middle of the range")
    return Section("The rig", (), drawings)


def _assumptions(plan: Plan) -> Section:
    options, e = plan.options, plan.options.expected
    ranges = "; ".join(
        f"{n.split('_')[0]} {r.first:g} to {r.last:g} {n.split('_')[1]} ({r.count})" if r.count > 1
        else f"{n.split('_')[0]} {r.middle:g} {n.split('_')[1]}"
        for n, r in options.ranges.items()
    )  # fmt: skip
    words = [
        f"Poses (world_from_body): {ranges}.",
        f"A spot's coordinates err by {options.sigma_px:g} px (1 sigma), independently. The pose is taken to be solved"
        " as a run does it, with noise and calibration errors weighed together; errors are carried to first order.",
    ]
    told = [g for g, source in plan.sources.items() if source == "rig file"]
    if told:
        words.append(f"From the rig file's covariance: {', '.join(told)}.")
    if any(source == "assumed" for source in plan.sources.values()):
        words.append(
            f"Assumed, where the rig file states nothing: focal lengths to {e.focal_relative:g} of themselves,"
            f" principal points to {e.centre_px:g} px, distortion to {e.distortion_px:g} px at the corners; each"
            f" camera's pose by resection on {e.dots} dots of its screen, surveyed to {e.dot_survey_m * 1e3:g} mm"
            f" and seen to {e.dot_px:g} px; screens to {e.screen_position_m * 1e3:g} mm and"
            f" {e.screen_rotation_deg:g}°; beams to {e.beam_direction_arcsec:g}″ and"
            f" {e.beam_point_m * 1e3:g} mm. Independent of each other, except that a"
            " lens's error is partly taken up by its camera's resection."
        )
    return Section("What was assumed", words)
