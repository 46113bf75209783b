"""Zhou (2014): table 1 beside our figures, and the measurements that the paper does not print."""

from __future__ import annotations

import numpy as np

from lab.drogue_circle.experiment import (
    BLUR_PX,
    HIDDEN,
    NOISE_DN,
    RADII_PX,
    HiddenRun,
    StillErrors,
    cost_ratio,
    hidden_run,
    still_errors,
)
from lab.drogue_circle.lights import PAPER_PERCENT, LightResult, followed
from lab.report.plot.axes import axes, frame, plot_area, svg_of
from lab.report.plot.series import Line, Shade, time_panel
from lab.report.plot.svg import BLUE, GREEN, VERMILLION, line_path, text
from lab.study.comparison import Comparison, ComparisonRow, Figure

METHODS = ("HoughCircles", "as printed", "beampose")
STILLS, RUNS, FRAMES = 40, 8, 150  # stills of each hidden share; runs with a full occlusion; frames of each light
_NAMES = (("opencv", "HoughCircles", GREEN), ("printed", "as printed", VERMILLION), ("ours", "beampose", BLUE))


def compare_zhou2014(seed: int = 1, stills: int = STILLS, runs: int = RUNS, frames: int = FRAMES) -> Comparison:
    """The table and the figures of Zhou (2014). With more pictures: bench/related_measurements/circle.py."""
    errors = still_errors(seed, stills)
    hidden = [hidden_run(1000 * seed + k) for k in range(runs)]
    lights = {light: followed(seed, light, frames) for light in PAPER_PERCENT}
    cost = cost_ratio(seed)
    return Comparison(
        title="Zhou, Sun, Bing & Yang (2014): tracking of an aerial refuelling drogue",
        setting=f"{len(errors.hidden)} stills · {runs} full occlusions · {frames} rendered frames of each light ·"
        f" seed {seed}",
        methods=METHODS,
        rows=(*_light_rows(lights), *_still_rows(errors), *_hidden_rows(hidden), _cost_row(*cost)),
        explanation="HoughCircles: OpenCV, strongest circle of the whole picture. As printed: the equations of the"
        " paper, with whole pixels as centres and eqs. (4) to (6). Beampose: corrected equations, rim fit, bank of"
        " filters. All get the same pictures. The paper's own pictures are not published: its column is its table 1,"
        " measured on a cart; ours are rendered.",
        figures=(
            Figure(
                "Errors of the centre",
                f"Stills with a radius of {RADII_PX[0]:g} to {RADII_PX[1]:g} px, up to {100 * HIDDEN[-1]:g} % of the"
                f" rim hidden on one side, blur of {BLUR_PX[0]:g} to {BLUR_PX[1]:g} px and noise of {NOISE_DN[0]:g} to"
                f" {NOISE_DN[1]:g} DN.",
                _distribution(errors),
            ),
            Figure(
                "Eight fully hidden frames",
                "Error of the reported centre. Shaded: the target is hidden. As printed, a clear target is not filtered"
                " (R = 0), so that the rates have the noise of whole pixels and the prediction leaves the target.",
                "".join(_hidden_panel(run, k) for k, run in enumerate(hidden[:2])),
            ),
        ),
        source="X. Zhou, X. Sun, Y. Bing, B. Yang, Journal of Data Acquisition and Processing 29(6), 1041 (2014), in"
        " Chinese.",
    )


def _light_rows(lights: dict[str, list[LightResult]]) -> list[ComparisonRow]:
    rows = []
    for light, (ours, printed) in lights.items():
        paper = PAPER_PERCENT[light]
        note = f"{ours.frames} frames; tracked: centre within a tenth of the radius"
        rows.append(ComparisonRow(f"tracked frames, {light}", "%", paper, (None, printed.percent, ours.percent), note))
    for light, (ours, printed) in lights.items():
        medians = [float(np.median(r.errors_px)) if len(r.errors_px) else None for r in (printed, ours)]
        rows.append(
            ComparisonRow(f"centre, {light}: median error", "px", None, (None, *medians), "of the tracked frames")
        )
    return rows


def _still_rows(errors: StillErrors) -> list[ComparisonRow]:
    rows = []
    for hidden in HIDDEN:
        medians = tuple(_or_none(errors.median(name, hidden)) for name, _, _ in _NAMES)
        name = f"centre of a still, {100 * hidden:g} % hidden: median error"
        rows.append(ComparisonRow(name, "px", None, medians))
    lost = tuple(100 * errors.failures(name) for name, _, _ in _NAMES)
    rows.append(ComparisonRow("stills without a centre within 8 px", "%", None, lost))
    nees = (float(np.nanmean(errors.nees_centre)) / 2, float(np.nanmean(errors.nees)) / 3)
    note = "1: the covariance is right; the paper has no covariance of its measurements"
    rows.append(ComparisonRow("centre of a still: NEES / 2", "", None, (None, None, nees[0]), note))
    rows.append(ComparisonRow("circle of a still: NEES / 3", "", None, (None, None, nees[1])))
    return rows


def _hidden_rows(runs: list[HiddenRun]) -> list[ComparisonRow]:
    printed = np.array([run.largest(run.printed_px) for run in runs])
    ours = np.array([run.largest(run.ours_px) for run in runs])
    rows = []
    for name, summary in (("median", np.median), ("largest", np.max)):
        values = (None, _or_none(float(summary(printed))), _or_none(float(summary(ours))))
        rows.append(ComparisonRow(f"8 hidden frames, largest error: {name} of the runs", "px", None, values))
    return rows


def _cost_row(ours_ms: float, opencv_ms: float) -> ComparisonRow:
    note = "1280 x 1024 px, process time, one thread; HoughCircles on the whole picture"
    return ComparisonRow("cost of a frame, HoughCircles = 1", "", None, (1.0, None, ours_ms / opencv_ms), note)


def _or_none(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _distribution(errors: StillErrors) -> str:
    """Share of the stills (%) with an error below a limit, by method; logarithm of the limit along x."""
    p = plot_area((-2.5, 1.0), (0.0, 100.0), height=300)
    out = axes(p, "Share of the stills with a smaller error", "error of the centre, log10 of px", "%")
    for i, (name, label, colour) in enumerate(_NAMES):
        values = np.sort(np.where(np.isfinite(getattr(errors, name)), getattr(errors, name), 1e3))
        x = np.clip(np.log10(np.maximum(values, 1e-9)), -2.5, 1.0)
        y = 100 * (np.arange(len(values)) + 1) / len(values)
        at = p.at(np.stack([x, y], axis=-1)[x < 1.0])
        out.append(f'<path d="{line_path(at[:, 0], at[:, 1])}" fill="none" stroke="{colour}" stroke-width="1.6"/>')
        out.append(text(p.box[0] + 10, p.box[1] + 18 + 16 * i, label, "", f"fill:{colour};font-weight:600"))
    return svg_of(p, "Share of the stills with a smaller error", [*out, frame(p)])


def _hidden_panel(run: HiddenRun, number: int) -> str:
    return time_panel(
        run.frame, f"Run {number + 1}: error of the centre, blue: beampose, orange: as printed", "px",
        lines=(Line(run.ours_px, BLUE, "beampose"), Line(run.printed_px, VERMILLION, "as printed")),
        shades=(Shade(run.hidden > 0, "predicted", "hidden"),), y_range=(0.0, 12.0), time_name="frame",
    )  # fmt: skip
