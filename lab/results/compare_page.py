"""Tables and page of a comparison."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lab.files.text.atomic_write import atomic_folder, check_output_folder, earlier_results
from lab.files.text.csv_text import write_table
from lab.files.text.json_text import write_json
from lab.findings.finding import Done, Verdict
from lab.number_format import format_number, format_percent, format_with_sigma
from lab.packages import versions
from lab.report.page import Page, PageDrawing, PageTable, Section, made_with
from lab.report.page import write_page as write_report
from lab.report.plot import svg
from lab.report.plot.series import Band, Line, Shade, time_panel
from lab.results.compare import (
    AxisStatistic,
    Comparison,
    StillStand,
    alignment_rows,
    compare,
    judged,
    lines_of,
    undetermined_lines,
)
from tracking.comparison.frame_alignment import PARAMETERS

# The tables of a comparison: differences.csv, allan.csv and comparison.json.

SCHEMA = "beampose/comparison/1"
SUMMARY = "comparison.json"
DIFFERENCES = (
    "frame", "t_s", "reference_t_s", "dx_m", "dy_m", "dz_m", "rotation_x_deg", "rotation_y_deg", "rotation_z_deg",
    "dyaw_deg", "dpitch_deg", "droll_deg", "sigma_dx_m", "sigma_dy_m", "sigma_dz_m", "sigma_rotation_x_deg",
    "sigma_rotation_y_deg", "sigma_rotation_z_deg", "chi2", "used",
)  # fmt: skip
ALLAN = ("angle", "tau_s", "deviation_deg", "low_deg", "high_deg", "slope", "degrees_of_freedom")


def write_tables(comparison: Comparison, folder: Path) -> None:
    """Write the tables into a folder. Raises InputError."""
    found = comparison.differences
    degrees = np.rad2deg
    place, turn = found.values[:, :3], degrees(found.values[:, 3:])
    sigmas = np.concatenate([found.sigmas[:, :3], degrees(found.sigmas[:, 3:])], axis=1)
    numbers = np.column_stack([place, turn, degrees(found.ypr), sigmas, found.chi2])
    rows: list[list[object]] = []
    for i, number in enumerate(comparison.frames.tolist()):
        cells = ["" if not np.isfinite(v) else f"{v:.9g}" for v in numbers[i].tolist()]
        times = (f"{comparison.t_s[i]:.12g}", f"{found.reference_t_s[i]:.16g}" if found.known[i] else "")
        rows.append([number, *times, *cells, int(comparison.used[i])])
    write_table(folder / "differences.csv", DIFFERENCES, rows)
    if comparison.still is not None:
        rows = []
        for name, a in comparison.still.of_result:
            columns = np.stack([a.tau_s, a.deviation, a.low, a.high, a.slope, a.freedom], axis=1)
            rows += [[name, *(f"{v:.6g}" for v in row)] for row in columns.tolist()]
        write_table(folder / "allan.csv", ALLAN, rows)
    write_json(_summary(comparison), folder / SUMMARY)


def _summary(comparison: Comparison) -> dict[str, Any]:
    return {
        "schema": SCHEMA,
        "result": str(comparison.result),
        "other": str(comparison.other),
        "versions": versions(),
        "verdict": Verdict((judged(comparison),)).as_mapping(),
        "frames": {
            "result": len(comparison.frames),
            "in_common": int(comparison.differences.known.sum()),
            "used": int(comparison.used.sum()),
        },
        "alignment": _alignment_row(comparison),
        "statistics": {
            a.name.replace(" ", "_") + f"_{a.unit}": {
                "mean": [a.figures.mean, a.figures.mean_sigma],
                "rms": [a.figures.rms, a.figures.rms_sigma],
                "median": [a.figures.median, a.figures.median_sigma],
                "largest": a.figures.largest,
                "largest_frame": int(comparison.frames[a.figures.largest_index]),
            }
            for a in comparison.axes
        },
        "chi_square": {"per_degree_of_freedom": comparison.noise.factor, "sigma": comparison.noise.sigma},
        "notes": list(comparison.notes),
    }


def _alignment_row(comparison: Comparison) -> dict[str, Any] | None:
    e = comparison.estimate
    if e is None:
        return None
    a = e.alignment
    estimated = [name for name, free in zip(PARAMETERS, e.free.tolist(), strict=True) if free]
    return {
        "offset_s": a.offset_s,
        "rate": a.rate,
        "middle_s": a.middle_s,
        "world": a.world.tolist(),
        "body": a.body.tolist(),
        "lever_m": a.lever_m.tolist(),
        "translation_m": a.translation_m.tolist(),
        "estimated": estimated,
        "sigmas": dict(zip(PARAMETERS, e.sigmas.tolist(), strict=True)),
        "covariance": e.covariance.tolist(),
        "undetermined": {
            "clocks": list(e.determined.undetermined),
            "world_axes": e.determined.world_axes.tolist(),
            "lever_axes": e.determined.lever_axes.tolist(),
            "other_offsets_s": list(e.other_offsets),
        },
    }


# The report of a comparison.


_SENTENCES = ("The two motions agree.", "The two motions differ, or too little was compared.")  # by level
_COLOURS = (svg.BLUE, svg.ORANGE, svg.GREEN)


def write_page(comparison: Comparison, folder: Path) -> Path:
    """Write report.html into a folder. Returns its path."""
    sections = [_alignment(comparison), _curves(comparison), _table(comparison), _allan(comparison.still)]
    found = judged(comparison)
    of_two = "reference" if comparison.is_reference else "other result"
    page = Page(
        "comparison",
        f"{comparison.result.name} and {comparison.other.name}",
        "result against a reference" if comparison.is_reference else "two results",
        [s for s in sections if s is not None],
        _key_figures(comparison),
        [*undetermined_lines(comparison.estimate), *comparison.notes],
        [("result", str(comparison.result)), (of_two, str(comparison.other)), made_with("numpy", "scipy")],
        (found,),
        _SENTENCES[found.level],
    )
    return write_report(page, folder)


def _key_figures(comparison: Comparison) -> list[tuple[str, str, str]]:
    found = comparison.differences
    common = int(found.known.sum())
    excluded = int((found.known & ~comparison.used).sum())
    figures = [("Frames", str(common), f"of {len(comparison.frames)} measured; {excluded} excluded as outliers")]
    for first, title in (("position", "Position"), ("rotation", "Rotation")):
        axes = [a for a in comparison.axes if a.name.startswith(first)]
        if axes:
            rms = float(np.sqrt(sum(a.figures.rms**2 for a in axes)))
            unit = axes[0].unit
            each = ", ".join(f"{a.name[-1]} {format_number(a.figures.rms)}" for a in axes)
            figures.append((title, f"{format_number(rms)} {unit}", f"RMS of the difference; {each}"))
    c = comparison.noise
    share = f"per degree of freedom; {format_percent(c.within)} within the 95 % limit"
    figures.append(("Chi-square", format_with_sigma(c.factor, c.sigma), share))
    return figures


def _alignment(comparison: Comparison) -> Section:
    if comparison.estimate is None:
        return Section("Alignment", "Nothing was aligned: the poses are compared frame by frame as they are.")
    e = comparison.estimate
    words = [
        "Estimated by weighted least squares without outliers: reference attitude = world rotation × result attitude ×"
        " body rotation; reference position = world rotation × (result position + result attitude × lever arm) +"
        " translation. Rotations are rotation vectors; sigmas are standard deviations.",
        f"The sigmas allow for correlated residuals (largest factor {format_number(e.correlation)} over the stated"
        " covariances). A sigma covers only what the motion determines.",
        *undetermined_lines(e),
    ]
    return Section("Alignment", words, (), PageTable(("quantity", "value", "unit"), alignment_rows(comparison)))


def _curves(comparison: Comparison) -> Section:
    outliers = comparison.differences.known & ~comparison.used
    shades = (Shade(outliers, "predicted", "excluded as outlier"),) if outliers.any() else ()
    # Two columns: x, y, z of the position on the left, those of the rotation beside them.
    order = sorted(range(len(comparison.axes)), key=lambda k: (k % 3, k) if k < 6 else (k, k))
    drawings = [_curve(comparison, comparison.axes[k], k, shades) for k in order]
    words = (
        "Result minus reference, after the alignment. Bands: two stated sigmas of the difference. Rotations are about"
        " the axes of the reference's body; yaw, pitch and roll are differences of the angles. Triangles mark values"
        f" beyond the axis{', yellow columns frames that were excluded as outliers' if shades else ''}."
    )
    return Section("Differences over time", words, drawings)


def _curve(comparison: Comparison, axis: AxisStatistic, k: int, shades: tuple[Shade, ...]) -> str:
    used = np.where(comparison.used, axis.values, np.nan)
    usual = np.nan if axis.sigmas is None else 2 * float(np.nanmedian(axis.sigmas))
    low, high = y_range = svg.robust_range(np.append(used, usual))
    bands: tuple[Band, ...] = ()
    if axis.sigmas is not None:
        below, above = (np.clip(side * axis.sigmas, low, high) for side in (-2, 2))
        bands = (Band(below, above, svg.GREY, "two stated sigmas"),)
    lines = (Line(axis.values, _COLOURS[k % 3], axis.name),)
    return time_panel(comparison.t_s, axis.name, axis.unit, lines=lines, bands=bands, shades=shades, y_range=y_range)


def _table(comparison: Comparison) -> Section:
    rows: list[list[object]] = []
    for a in comparison.axes:
        f = a.figures
        sigma = np.nan if a.sigmas is None else float(a.sigmas[f.largest_index])
        rows.append(
            [
                a.name, a.unit, format_with_sigma(f.mean, f.mean_sigma), format_with_sigma(f.rms, f.rms_sigma),
                format_with_sigma(f.median, f.median_sigma), format_with_sigma(f.largest, sigma),
                int(comparison.frames[f.largest_index]),
            ]
        )  # fmt: skip
    c, t = comparison.noise, comparison.total
    words = [
        "Mean, RMS and median size with sigmas of a block bootstrap, which allows for correlated errors; largest size"
        " with the stated sigma of its frame. Outliers are left out.",
        f"Chi-square per degree of freedom against the stated noise: {format_with_sigma(c.factor, c.sigma)};"
        f" {format_percent(c.within)} of {c.times} frames are within the 95 % limit.",
    ]
    if t is not None:
        words.append(
            f"Against the stated noise and calibration errors together: {format_with_sigma(t.factor, t.sigma)}. The"
            " alignment absorbs the common part of the calibration errors, so that this figure is below 1."
        )
    heads = ("difference", "unit", "mean", "RMS", "median size", "largest", "at frame")
    return Section("Statistics", words, (), PageTable(heads, rows))


def _allan(still: StillStand | None) -> Section | None:
    if still is None:
        return None
    words = [
        "Overlapping Allan deviation of the result's angles over the longest time without motion,"
        f" {format_number(still.first_s)} s to {format_number(still.last_s)} s ({still.count} frames), with 95 %"
        " limits. Slope −1/2: white noise, averaging helps; 0: flicker noise; +1/2: random walk, longer averages are"
        " worse.",
        "A smoothed result has correlated errors at short times: there its deviation is below that of single frames.",
    ]
    rows = [
        [name, a.tau_s[k], 1e3 * a.deviation[k], 1e3 * a.low[k], 1e3 * a.high[k], a.slope[k]]
        for name, a in still.of_result
        for k in range(len(a.tau_s))
    ]
    heads = ("angle", "averaging time (s)", "deviation (mdeg)", "lower limit", "upper limit", "slope")
    return Section("Stationary stand", words, [PageDrawing(_allan_chart(still), wide=True)], PageTable(heads, rows))


def _allan_chart(still: StillStand) -> str:
    """Deviations over averaging time, both axes logarithmic."""
    title = "Allan deviation"
    taus = np.concatenate([a.tau_s for _, a in still.of_result])
    values = 1e3 * np.concatenate([np.concatenate([a.low, a.high]) for _, a in still.of_result])
    values = values[values > 0]
    if not len(values):
        return ""
    x0, x1 = np.log10([taus.min() / 1.3, taus.max() * 1.3]).tolist()
    y0, y1 = np.log10([values.min() / 1.3, values.max() * 1.3]).tolist()
    p = svg.plot_area((x0, x1), (y0, y1), width=720, height=320)
    out = [*svg.axes(p, title, "averaging time (s)", "deviation (mdeg)", x_log=True, y_log=True)]
    left, top, wide, _ = p.box
    for i, (name, a) in enumerate(still.of_result):
        good = a.low > 0
        x = np.log10(a.tau_s[good])
        places, low, high = (p.at(np.stack([x, np.log10(1e3 * y[good])], -1)) for y in (a.deviation, a.low, a.high))
        colour = _COLOURS[i]
        out.append(f'<path class="line" d="{svg.line_path(places[:, 0], places[:, 1])}" stroke="{colour}"/>')
        out.append(f'<path d="{svg.segments(low, high)}" stroke="{colour}" fill="none"/>')
        out.append(f'<path d="{svg.dots(places, 3)}" fill="{colour}"/>')
        out.append(svg.text(left + wide - 8, top + 16 + 16 * i, name, "end", f"fill:{colour};font-weight:600"))
    out.append(svg.note(p, "bars: 95 % confidence limits"))
    return svg.svg_of(p, title, [*out, svg.frame(p)])


# One comparison from folders and files to an output folder.


def compare_and_write(
    result: Path, other: Path | None, reference: Path | None, out: Path | None, **options: Any
) -> Done[Comparison]:
    """Compare, and write tables and report where `out` is given. The options: `lab.results.compare.compare`.

    Raises InputError: the input cannot be compared, or `out` cannot be written.
    """
    own = earlier_results(SUMMARY)
    if out is not None:
        check_output_folder(out, own)
    found = compare(result, other, reference, **options)
    lines = tuple(lines_of(found))
    if out is None:
        return Done(found, lines)
    with atomic_folder(out, own) as folder:
        write_tables(found, folder)
        write_page(found, folder)
    return Done(found, (*lines, f"report: {out / 'report.html'}"))
