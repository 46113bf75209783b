"""`beampose plan`: visibility and expected uncertainty of a rig before it is built."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from calibration.budget import AXES, STATUS, expected_errors, group_of, plan_grid, poses_of
from geometry.arrays import Array
from geometry.pose_solver.visibility import assumed_range
from lab import number_format
from lab.calibrate.step import Solved, Step, run_step
from lab.errors import QUALITY_GATE_FAILED
from lab.files.rig.rig_file import TARGET, joint_covariance, load_rig_file
from lab.files.text.csv_text import write_table
from lab.findings.finding import Outcome
from lab.number_format import format_angle, format_cell, format_length, format_percent, format_vector
from lab.report.calibration.calibration_scene import rig_things, scene_views
from lab.report.page import KeyFigure, PageTable, Section
from lab.report.plot.maps import colours, heat_map, hex_colour
from lab.report.plot.svg import BLUE, figure, number, text, vertical_text
from lab.setup.plan_findings import (
    CORRELATION,
    TOTAL_CALIBRATION,
    Plan,
    PlanOptions,
    Range,
    advice,
    axis_words,
    budget_lines,
    findings,
    median_sigma,
    worst_first,
)

# Drawings of a plan: values on a grid as coloured cells, and shares as bars.

_LEFT, _TOP, _WIDE, _HIGH = 58.0, 24.0, 468.0, 224.0
_MAX_LABELLED_COLUMNS = 15  # with more columns the cells are too small for a number


def cell_map(
    values: Array, x: Array, y: Array, title: str, *, x_name: str, y_name: str, low_is_bad: bool = False
) -> str:
    """Values on a grid as coloured cells with their numbers.

    values (rows, columns): at y (rows,), increasing upwards, and x (columns,); nan is an empty cell with a cross. Deep
    colours mark bad values: large ones, or small ones with `low_is_bad`.
    """
    rows, columns = values.shape
    wide, high = _WIDE / columns, _HIGH / rows
    finite = values[np.isfinite(values)]
    lo, hi = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    if lo > 0 and hi > 6 * lo:  # logarithmic, otherwise a few large values would give all others the same colour
        share = np.log(values / lo) / np.log(hi / lo)
    else:
        share = (values - lo) / (hi - lo) if hi > lo else np.zeros_like(values)
    share = 0.12 + 0.76 * (1 - share if low_is_bad and hi > lo else share)  # avoids the ends of the colour scale
    out = [text(_LEFT, 15, title, "title")]
    for j in range(rows):
        top = _TOP + (rows - 1 - j) * high
        for i in range(columns):
            left = _LEFT + i * wide
            box = f'x="{left:.1f}" y="{top:.1f}" width="{wide:.1f}" height="{high:.1f}"'
            value = float(values[j, i])
            middle = (left + wide / 2, top + high / 2 + 3.5)
            if not np.isfinite(value):
                out.append(f'<rect {box} fill="none" stroke="var(--line)"/>{text(*middle, "×", "mid")}')
                continue
            fill = hex_colour(colours(np.array(share[j, i])))
            out.append(f'<rect {box} fill="{fill}" stroke="var(--line)" stroke-width="0.5"/>')
            if columns <= _MAX_LABELLED_COLUMNS:
                ink = "#fff" if share[j, i] > 0.5 else "#1c2126"
                shown = f"{value:.0f}" if value == round(value) else number_format.format_number(value)
                out.append(text(*middle, shown, "mid", f"fill:{ink}"))
    bottom = _TOP + _HIGH
    out += [
        text(_LEFT + (i + 0.5) * wide, bottom + 14, _plain(x[i]), "mid") for i in range(0, columns, -(-columns // 12))
    ]
    out += [
        text(_LEFT - 6, _TOP + (rows - 0.5 - j) * high + 3.5, _plain(y[j]), "end")
        for j in range(0, rows, -(-rows // 12))
    ]
    out.append(text(_LEFT + _WIDE / 2, bottom + 30, x_name, "mid"))
    out.append(vertical_text(12, _TOP + _HIGH / 2, y_name))
    return figure(540, bottom + 38, title, out)


def share_bars(parts: Sequence[tuple[str, float]], title: str) -> str:
    """Named shares (fractions; negative ones are drawn paler) as bars, in the given order."""
    left, wide, step = 132.0, 330.0, 22.0
    out = [text(8, 14, title, "title")]
    scale = wide / max(max((abs(s) for _, s in parts), default=1.0), 1e-9)
    for k, (name, share) in enumerate(parts):
        y = 26 + step * k
        size = max(abs(share) * scale, 0.5)
        pale = ' opacity="0.4"' if share < 0 else ""
        out.append(text(left - 8, y + 11, name, "end"))
        out.append(f'<rect x="{left}" y="{y}" width="{size:.1f}" height="14" fill="{BLUE}"{pale}/>')
        out.append(text(left + size + 6, y + 11, format_percent(share)))
    return figure(540, 30 + step * len(parts), title, out)


def _plain(value: float) -> str:
    return number(round(float(value), 4) + 0.0)


# Tables of a plan: plan.csv, a row for each pose, and effects.csv, a row for each error of the calibration.
#
# plan.csv: pose; x_m ... roll_deg, the grid; status (measured; vague: observable, but too uncertain for a run; not
# observable); spots_in_view; least_margin_px, smallest distance of a spot in view to its picture's edge;
# closest_spots_px; condition (no unit: ratio of the largest to the smallest singular value of the whitened Jacobian
# with columns of length 1); sigma_x_m ... sigma_roll_deg, from all errors; worst_position_m, worst_attitude_deg and
# their axes (in world; in body); for each contribution the same six sigmas from it alone (noise_x_m,
# camera_intrinsics_x_m, ...); margin_CAMERA_SPOT_px, the distance to the picture's edge, negative outside, empty
# without projection.
#
# effects.csv: parameter; group; sigma and its unit; median_x_m ... median_roll_deg, effect of this error alone on the
# pose, median over the observable poses; largest_x_m ..., the maximum. First a row for each camera, screen and beam
# (`cameras.left`) with all its errors of one group combined, without a sigma; then a row for each parameter, named as
# in the covariance blocks of rig.yaml. If a camera's pose comes from a resection, the errors of its lens include their
# effect on this pose. The errors of one camera's pose are correlated: each alone has a larger effect than all
# combined.


_DIRECTIONS = tuple(f"worst_{what}_axis_{a}" for what in ("position", "attitude") for a in "xyz")


def plan_columns(plan: Plan) -> tuple[str, ...]:
    """The columns of plan.csv."""
    return (
        "pose",
        *plan.options.ranges,
        "status",
        "spots_in_view",
        "least_margin_px",
        "closest_spots_px",
        "condition",
        *(f"sigma_{a}" for a in AXES),
        "worst_position_m",
        "worst_attitude_deg",
        *_DIRECTIONS,
        *(f"{c.replace(' ', '_')}_{a}" for c in plan.contributors for a in AXES),
        *(f"margin_{camera}_{spot}_px" for camera, spot in plan.views),
    )


def effect_columns() -> tuple[str, ...]:
    """The columns of effects.csv."""
    return ("parameter", "group", "sigma", "unit", *(f"{kind}_{a}" for kind in ("median", "largest") for a in AXES))


def _plan_rows(plan: Plan) -> Iterator[list[str]]:
    least = np.where(plan.seen, plan.margin_px, np.inf).min(axis=1)
    columns = [least[:, None], plan.closest_px[:, None], plan.condition[:, None], plan.sigma, plan.worst]
    columns += [plan.worst_axis.reshape(len(least), 6), plan.parts.reshape(len(least), -1), plan.margin_px]
    results = np.concatenate(columns, axis=1).tolist()
    spots = plan.seen.sum(axis=1).tolist()
    for i, (coordinates, numbers) in enumerate(zip(plan.coordinates.tolist(), results, strict=True)):
        texts = map(format_cell, numbers)
        yield [str(i), *map(format_cell, coordinates), STATUS[plan.status[i]], str(spots[i]), *texts]


def _effect_rows(plan: Plan) -> Iterator[list[str]]:
    for (thing, group, _), median, largest in zip(
        plan.errors.things, plan.thing_median, plan.thing_largest, strict=True
    ):
        yield [thing, group, "", "", *map(format_cell, [*median.tolist(), *largest.tolist()])]
    for name, sigma, median, largest in zip(
        plan.errors.move_names, plan.errors.move_sigmas, plan.effect_median, plan.effect_largest, strict=True
    ):
        if sigma > 0:
            numbers = [*median.tolist(), *largest.tolist()]
            yield [name, group_of(name), format_cell(float(sigma)), unit_of(name), *map(format_cell, numbers)]


def unit_of(name: str) -> str:
    """Unit of a rig parameter; 1 if it has none."""
    parameter = name.rsplit(".", 1)[1]
    if parameter.endswith("_per_m"):
        return "1/m"
    if parameter.endswith(("_m", "_rad")):
        return parameter.rsplit("_", 1)[1]
    return "px" if parameter in ("fx", "fy", "cx", "cy") else "rad" if parameter.startswith("tau") else "1"


# Report of a plan: visibility, expected sigmas over the range of poses, and the error budget.


_WORST_ROWS, _EFFECT_ROWS = 24, 20
_FINE = 41  # grid points along each side of a smooth map
# Pairs of coordinates with maps: horizontal and vertical axis.
_PLANES = (("yaw_deg", "pitch_deg"), ("x_m", "y_m"), ("x_m", "z_m"))


def page_of(plan: Plan) -> tuple[list[KeyFigure], list[Section]]:
    """Key figures and sections of the report."""
    return _key_figures(plan), [
        Section("What to improve first", advice(plan) or "No pose is observable: there is no error budget."),
        _budget(plan),
        *_maps(plan),
        _visibility(plan),
        _worst(plan),
        _effects(plan),
        _scene(plan),
        _assumptions(plan),
    ]


def _key_figures(plan: Plan) -> list[KeyFigure]:
    m, deg = median_sigma(plan)
    solved = plan.worst[plan.observable]
    top = solved.max(axis=0).tolist() if len(solved) else [np.nan, np.nan]
    lines = [line for line in budget_lines(plan) if line.name != CORRELATION]
    figures = [
        ("Measurable", format_percent(float(plan.measured.mean())), f"of {len(plan.status)} poses"),
        ("Attitude", format_angle(deg), f"median of 1 sigma; up to {format_angle(top[1])}"),
        ("Position", format_length(m), f"median of 1 sigma; up to {format_length(top[0])}"),
    ]
    if lines:
        share = f"{format_percent(lines[0].share_deg)} of the attitude's variance"
        figures.append(("Limited by", lines[0].name, share))
    return figures


def _budget(plan: Plan) -> Section:
    lines = budget_lines(plan)
    m, deg = median_sigma(plan)
    rows: list[list[object]] = [
        [
            line.name, line.source, 1e3 * line.sigma_deg, format_percent(line.share_deg), 1e3 * line.halved_deg,
            1e3 * line.sigma_m, format_percent(line.share_m), 1e3 * line.halved_m,
        ]
        for line in lines
    ]  # fmt: skip
    rows.append(["total", "", 1e3 * deg, "100 %", None, 1e3 * m, "100 %", None])
    heads = (
        "contribution", "source", "attitude sigma (mdeg)", "share", "total if halved (mdeg)", "position sigma (mm)",
        "share", "total if halved (mm)",
    )  # fmt: skip
    words = [
        "Sigmas along the worst direction of each pose, median over the observable poses. Shares are of the variance,"
        " mean over the poses; the sigma of a contribution is its share of the median, and contributions add as"
        " squares."
    ]
    if any(line.name == CORRELATION for line in lines):
        words.append(
            f"{CORRELATION[0].upper()}{CORRELATION[1:]}: from the covariance between groups, negative where errors"
            " cancel."
        )
    if any(line.name == TOTAL_CALIBRATION for line in lines):
        words.append(
            "The rig file comes from a joint calibration: its errors of lenses, poses and beams mostly cancel each"
            " other, so that shares of single groups have no meaning."
        )
    drawings = [
        share_bars([(x.name, x.share_deg) for x in lines], "Attitude: shares of the variance"),
        share_bars([(x.name, x.share_m) for x in lines], "Position: shares of the variance"),
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
    """Maps over two of the six coordinates: a fine one with the others at their middle, and the worst over them."""
    names, ranges = list(plan.options.ranges), list(plan.options.ranges.values())
    a, b = ranges[across], ranges[up]
    short = [n.split("_")[0] for n in names]
    axis_names = [f"{s} ({n.split('_')[1]})" for s, n in zip(short, names, strict=True)]
    x_name, y_name = axis_names[across], axis_names[up]
    fine = fine_map(plan, across, up)

    def smooth(k: int, what: str, unit: str) -> str:
        values, extent = 1e3 * fine[..., k], (a.first, a.last, b.first, b.last)
        title, free = f"{what} sigma ({unit}), other coordinates in the middle", {"y_down": False, "equal": False}
        return heat_map(values, extent, title, unit, x_name=x_name, y_name=y_name, limits=_limits(values), **free)

    def cells(values: Array, statistic: str, title: str, low_is_bad: bool = False) -> str:
        grid = _reduced(plan, values, across, up, statistic)
        return cell_map(grid, a.values(), b.values(), title, x_name=x_name, y_name=y_name, low_is_bad=low_is_bad)

    spots = plan.seen.sum(axis=1).astype(float)
    drawings = [
        smooth(1, "Attitude", "mdeg"),
        smooth(0, "Position", "mm"),
        cells(plan.worst[:, 1] * 1e3, "largest", "Attitude sigma (mdeg), maximum over the other coordinates"),
        cells(plan.worst[:, 0] * 1e3, "largest", "Position sigma (mm), maximum over the other coordinates"),
    ]
    words = ["1 sigma along the worst direction. Hatched or crossed: not observable."]
    fewest = _reduced(plan, spots, across, up, "least")
    if fewest.min() < fewest.max():
        drawings.append(cells(spots, "least", "Spots in view, minimum over the other coordinates", low_is_bad=True))
    else:
        words.append(
            f"The minimum number of spots in view is {fewest.min():.0f} everywhere, of {len(plan.views)} views."
        )
    if not plan.measured.all():
        share = np.where(plan.measured, 100.0, 0.0)
        drawings.append(cells(share, "mean", "Poses that can be measured (%)", low_is_bad=True))
    return Section(f"Over {short[across]} and {short[up]}", words, drawings)


def _limits(values: Array) -> tuple[float, float] | None:
    """Range of the colours: at least a quarter of the value, so that small variations are not exaggerated."""
    finite = values[np.isfinite(values)]
    if not finite.size or finite.max() > 1.25 * finite.min():
        return None
    return float(finite.min()), 1.25 * float(finite.min())


def fine_map(plan: Plan, across: int, up: int) -> Array:
    """Position (m) and attitude (deg) sigma (rows, columns, 2) over two coordinates, the others in the middle.

    Rows are values of coordinate `up`, columns of `across`.
    """
    fixed = {
        name: replace(r, count=_FINE) if i in (across, up) else Range(r.middle, r.middle, 1)
        for i, (name, r) in enumerate(plan.options.ranges.items())
    }
    fine = plan_grid(plan.rig, plan.errors, plan.sources, replace(plan.options, stated=fixed))
    values = fine.worst.reshape(_FINE, _FINE, 2)  # the later of the two coordinates varies along the second axis
    return np.swapaxes(values, 0, 1) if across < up else values


def _reduced(plan: Plan, values: Array, across: int, up: int, statistic: str) -> Array:
    """A statistic of values (k,) of all poses over the other coordinates: a map (`up`, `across`); nan: no value."""
    counts = [r.count for r in plan.options.ranges.values()]
    cube = np.moveaxis(values.reshape(counts), (up, across), (0, 1)).reshape(counts[up], counts[across], -1)
    empty = np.asarray(np.isnan(cube).all(axis=-1))
    safe = np.where(empty[..., None], 0.0, cube)
    functions: dict[str, Callable[..., Array]] = {"largest": np.nanmax, "least": np.nanmin, "mean": np.nanmean}
    return np.where(empty, np.nan, functions[statistic](safe, axis=-1))


def _visibility(plan: Plan) -> Section:
    rows: list[list[object]] = []
    for i, (camera, spot) in enumerate(plan.views):
        known = plan.margin_px[:, i][np.isfinite(plan.margin_px[:, i])]
        margins = [round(float(np.median(known))), round(float(known.min()))] if len(known) else [None, None]
        off = float(np.isnan(plan.margin_px[:, i]).mean())
        rows.append([camera, spot, format_percent(float(plan.seen[:, i].mean())), format_percent(off), *margins])
    words = (
        f"A spot is in view if it is at least {plan.options.edge_px:g} px inside of its picture. A margin is the"
        " distance to the picture's edge, negative outside."
    )
    heads = ("camera", "spot", "in view", "without projection", "median margin (px)", "smallest margin (px)")
    return Section("Visibility", words, (), PageTable(heads, rows))


def _worst(plan: Plan) -> Section:
    spots, rows = plan.seen.sum(axis=1), []
    for i in worst_first(plan, _WORST_ROWS):
        seen = plan.seen[i]
        margin = f"{plan.margin_px[i][seen].min():.0f}" if seen.any() else "–"
        c = plan.coordinates[i].tolist()
        rows.append(
            [
                format_vector(c[:3], 3), format_vector(c[3:], 1),
                STATUS[plan.status[i]], int(spots[i]), margin, format_angle(float(plan.worst[i, 1])),
                axis_words(plan.worst_axis[i, 1]), format_length(float(plan.worst[i, 0])),
                axis_words(plan.worst_axis[i, 0]),
                number_format.format_number(float(plan.condition[i])),
            ]
        )  # fmt: skip
    heads = (
        "x y z (m)", "yaw pitch roll (deg)", "status", "spots", "smallest margin (px)", "attitude", "about (body)",
        "position", "along (world)", "condition",
    )  # fmt: skip
    words = "Poses that are not observable first, then by attitude sigma. All poses are in plan.csv."
    return Section("Worst poses", words, (), PageTable(heads, rows))


def _effects(plan: Plan) -> Section:
    attitude = np.linalg.norm(plan.thing_median[:, 3:], axis=1)
    rows = []
    for i in np.argsort(-attitude, kind="stable").tolist()[:_EFFECT_ROWS]:
        thing, group, _ = plan.errors.things[i]
        kind, name = thing.split(".", 1)
        rows.append([f"{kind.removesuffix('s')} {name}", group, *(1e3 * plan.thing_median[i])])
    heads = ("part", "errors", *(f"{a.split('_')[0]} ({'mm' if a.endswith('_m') else 'mdeg'})" for a in AXES))
    words = (
        "Effect of the errors of one camera, screen or beam on the pose, median over the poses, the largest effects on"
        " the attitude first. If a camera's pose comes from a resection, the errors of its lens include their effect on"
        " this pose. effects.csv lists the effect of every parameter."
    )
    return Section("Effects of the calibration errors", words, (), PageTable(heads, rows))


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
        f"The coordinates of a spot have independent errors of {options.sigma_px:g} px (1 sigma). The pose is estimated"
        " as in a run, weighted by noise and calibration errors; errors are propagated to first order.",
    ]
    stated = [g for g, source in plan.sources.items() if source == "rig file"]
    if stated:
        words.append(f"From the rig file's covariance: {', '.join(stated)}.")
    if any(source == "assumed" for source in plan.sources.values()):
        words.append(
            f"Assumed sigmas where the rig file states none: focal length {e.focal_relative:g} (relative), principal"
            f" point {e.centre_px:g} px, distortion {e.distortion_px:g} px at the corners; pose of each camera by"
            f" resection on {e.dots} control points of its screen, surveyed to {e.dot_survey_m * 1e3:g} mm and measured"
            f" to {e.dot_px:g} px; screens {e.screen_position_m * 1e3:g} mm and {e.screen_rotation_deg:g}°; beams"
            f" {e.beam_direction_arcsec:g}″ and {e.beam_point_m * 1e3:g} mm. These errors are independent, except that"
            " the resection of a camera compensates part of the error of its lens."
        )
    return Section("Assumptions", words)


TABLE, EFFECTS = "plan.csv", "effects.csv"


_SENTENCES = (
    "This rig suits the range of poses.",
    "This rig can be built; note the warnings below.",
    "This rig does not suit the range of poses.",
)
_STEP = Step("plan", (TABLE,), failed_status=QUALITY_GATE_FAILED, sentences=_SENTENCES)


def plan_rig(rig_path: Path, out: Path, options: PlanOptions | None = None) -> Outcome[Plan]:
    """Plan a rig; write plan.csv, effects.csv and report.html into the folder `out`.

    Calibration errors come from the rig file's covariance, or from the options where the file states none. A rig that
    does not suit the range of poses has the exit status of a run that fails its quality gate. Raises InputError: for a
    rig that cannot be read, invalid options, or a folder with other files in it.
    """
    return run_step(_STEP, out, lambda: _solve(Path(rig_path), PlanOptions() if options is None else options))


def _solve(rig_path: Path, options: PlanOptions) -> Solved[Plan]:
    plan = plan_of(rig_path, options)
    sigma_m, sigma_deg = median_sigma(plan)

    def write(folder: Path) -> None:
        write_table(folder / TABLE, plan_columns(plan), _plan_rows(plan))
        write_table(folder / EFFECTS, effect_columns(), _effect_rows(plan))

    return Solved(
        name="plan",
        result=plan,
        findings=tuple(findings(plan)),
        figures=f"{format_percent(float(plan.measured.mean()))} of {len(plan.status)} poses can be measured, sigma of"
        f" the attitude {format_angle(sigma_deg)}, of the position {format_length(sigma_m)} (worst direction, median)",
        write=write,
        page=lambda: page_of(plan),
        day=datetime.date.today(),
        inputs=[rig_path],
        title=rig_path.stem if rig_path.stem != "rig" else rig_path.resolve().parent.name,
    )


def plan_of(rig_path: Path, options: PlanOptions) -> Plan:
    """The plan of a rig file. Raises InputError if the file cannot be read."""
    file = load_rig_file(Path(rig_path))
    stated = joint_covariance(file.rig, file.covariances, rig_path)
    target = file.covariances.get(TARGET)
    is_joint = target is not None and any(n.startswith(("cameras.", "screens.")) for n in target.names)
    errors, sources = expected_errors(file.rig, options.expected, stated, is_joint)
    return plan_grid(file.rig, errors, sources, options.about(assumed_range(file.rig).centre))
