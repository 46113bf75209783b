"""The page of `beampose detect`: contact sheet, spots over frames, positions, sizes, signal to noise, sensor noise."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from geometry.arrays import Array
from lab.detect.contact_sheet import ContactSheet
from lab.detect.detect_charts import counts_chart, noise_chart, places_chart
from lab.detect.findings import SizeGroup
from lab.detect.picture_series import PictureSeries
from lab.files.text.atomic_write import atomic_write_text
from lab.number_format import format_number
from lab.pictures.picture_file import GreyPicture
from lab.report.calibration.calibration_page import PageDrawing, PageTable, Section, section_context
from lab.report.html import environment
from lab.report.plot.axes import BLUE, picture_uri
from lab.report.plot.series import Line, time_panel
from lab.versions import versions
from tracking.noise_estimation.levels import LevelVariances, level_variances

_MOST_KINDS = 4  # kinds of pictures (size and depth) whose noise is drawn
_MOST_SPOTS = 20  # spots that look most like a laser's
_MOST_ROWS = 20  # kinds of pictures whose noise is listed


def write_detect_page(series: PictureSeries, sheet: ContactSheet, folder: Path) -> Path:
    """Write report.html into a folder. Returns its path."""
    table = series.spots.table()
    groups = sorted(series.groups.values(), key=lambda g: -g.pictures)
    sections = [
        _sheet(sheet),
        _spots(series, table),
        *([_most_alike(table), _places(table, groups)] if len(table) else []),
        _noise(series, groups),
    ]
    context: dict[str, Any] = {
        "name": series.camera,
        "source": series.source,
        "key_figures": _key_figures(series, table, groups),
        "notes": series.notes,
        "sections": [section_context(section) for section in sections],
        "made": _made(series),
    }
    path = folder / "report.html"
    atomic_write_text(environment().get_template("detect.html.j2").render(context), path)
    return path


def _key_figures(series: PictureSeries, table: Array, groups: list[SizeGroup]) -> list[tuple[str, str, str]]:
    counts = np.array([n for _, n in series.spots.per_frame])
    bad = sum(map(len, series.unreadable.values()))
    each = f"{counts.min()} to {counts.max()}, median {np.median(counts):.0f}"
    figures = [
        ("Pictures", str(series.pictures), f"{bad} more cannot be read" if bad else groups[0].text()),
        ("Spots", str(series.spots.total), f"{each} in a picture" if series.pictures > 1 else "in the picture"),
    ]
    if len(table):
        low, middle, high = np.percentile(table[:, 3], [5, 50, 95])
        figures.append(
            (
                "Size",
                f"{format_number(middle)} px",
                f"1 sigma of the major axis; 90 %: {format_number(low)} to {format_number(high)}",
            )
        )
        low, middle, high = np.percentile(table[:, 5], [5, 50, 95])
        figures.append(
            (
                "Signal to noise",
                format_number(middle),
                f"matched filter, median; 90 %: {format_number(low)} to {format_number(high)}",
            )
        )
    model = groups[0].noise.model
    if model is not None:
        figures.append(
            (
                "Noise",
                f"{format_number(math.sqrt(model.floor_dn2))} DN",
                f"of a pixel at {format_number(model.black_dn)} DN",
            )
        )
    return figures


def _sheet(sheet: ContactSheet) -> Section:
    jpeg = cv2.imencode(".jpg", sheet.drawn(), [cv2.IMWRITE_JPEG_QUALITY, 82])[1].tobytes()
    picture = f'<img src="{picture_uri(jpeg, "jpeg")}" alt="contact sheet: pictures with the spots found in them">'
    caption = (
        "Evenly spaced pictures with stretched grey values. Rings: detected spots, numbered by brightness, in the order"
        " of the rows of a frame in detections.csv. Without compression loss: contact-sheet.png."
    )
    return Section("Contact sheet", (), [PageDrawing(picture, caption, wide=True)])


def _spots(series: PictureSeries, table: Array) -> Section:
    drawings = []
    if len(series.spots.per_frame) > 1:
        frame, count = np.array(series.spots.per_frame, dtype=float).T
        drawings.append(
            PageDrawing(
                time_panel(
                    frame, "Spots in each picture", "", lines=(Line(count, BLUE, "spots"),),
                    y_range=(0.0, max(float(count.max()) * 1.1, 1.0)), width=1100, height=150, time_name="frame",
                ),
                wide=True,
            )
        )  # fmt: skip
    if len(table):
        drawings += [
            PageDrawing(
                counts_chart([("major", table[:, 3]), ("minor", table[:, 4])], "Sizes", "half axis, 1 sigma (px)")
            ),
            PageDrawing(
                counts_chart(
                    [("signal to noise", table[:, 5])], "Signal to noise behind a matched filter", "ratio",
                    mark=series.parameters.threshold_sigma,
                ),
                "Flux over its noise, with the noise of the background only. Spots below the threshold (dashed line)"
                " are not detected.",
            ),
        ]  # fmt: skip
    description = (
        "Positions are centroids of the light."
        if series.spots.total
        else "No spot was found. Are the spots in the pictures? A lower threshold (--set detect.threshold_sigma=4)"
        " finds fainter spots, and more false ones."
    )
    return Section("Spots", description, drawings)


def _most_alike(table: Array) -> Section:
    """The spots that look most like a laser's: among many points of a room, the spot is one of the first."""
    best = table[np.argsort(-table[:, 7], kind="stable")[:_MOST_SPOTS]]
    heads = ("frame", "u (px)", "v (px)", "likeness", "signal to noise", "peak (DN)", "major (px)", "minor (px)")
    rows = [[int(row[0]), *row[[1, 2, 7, 5, 6, 3, 4]].tolist()] for row in best]
    description = (
        "Likeness, 0 to 1: how much of the light a round Gaussian explains, times the ratio of the axes, times the"
        " brightness of the core relative to that of a clipped pixel. All spots: detections.csv, column likeness."
    )
    return Section("Most like the spot of a laser", description, (), PageTable(heads, rows))


def _places(table: Array, groups: list[SizeGroup]) -> Section:
    width = max(g.size_px[0] for g in groups)
    height = max(g.size_px[1] for g in groups)
    description = (
        "All spots of all pictures. A spot that does not move while others do (a reflection, a hot pixel) appears as"
        " one dense dot."
    )
    return Section("Positions", description, [PageDrawing(places_chart(table[:, 1:3], (width, height)))])


def _noise(series: PictureSeries, groups: list[SizeGroup]) -> Section:
    rows: list[list[object]] = []
    for g in groups[:_MOST_ROWS]:
        e = g.noise.estimate
        if e is None:
            continue
        m = e.model
        rows.append(
            [
                g.text(), e.pictures, "in time" if e.temporal else "within pictures", m.black_dn,
                _with_sigma(math.sqrt(m.floor_dn2), e.floor_sigma / 2), _with_sigma(1 / m.slope_dn, e.slope_sigma),
                m.correlation, math.sqrt(m.compression_dn2), 100 * m.texture,
                "not seen" if e.saturation_dn is None else e.saturation_dn, e.step_dn,
            ]
        )  # fmt: skip
    heads = (
        "pictures", "estimated from", "differences", "background (DN)", "noise there (DN)", "electrons per DN",
        "correlation of pixels", "by compression (DN)", "texture (%)", "clips at (DN)", "grey step (DN)",
    )  # fmt: skip
    drawings = []
    for g in groups[:_MOST_KINDS]:
        measured = _levels(series.noise_pictures.get((g.size_px, g.bits), []), g)
        if g.noise.estimate is not None:
            drawings.append(PageDrawing(noise_chart(g.noise.estimate, measured, g.text()), _caption(measured)))
    description = [
        "The variance of a pixel is a linear function of the light: its value at the background is read noise, rounding"
        " and the background's own shot noise; its slope is one over the electrons per grey value.",
        "Where the pictures have few bright and stationary regions, the slope is that of usual sensors, with a large"
        " sigma.",
    ]
    return Section("Noise of the sensor", description, drawings, PageTable(heads, rows))


def _caption(measured: LevelVariances | None) -> str:
    """Explains the dots and lines of a noise chart."""
    line = "Line: the model in use, with its 1-sigma band."
    if measured is None or not len(measured.level):
        return f"{line} No grey level has enough pixels for a measurement."
    how = "from differences in time" if measured.temporal else "within pictures"
    return f"{line} Dots: measured {how}; triangles: larger variances, where the light itself changed."


def _levels(pictures: list[GreyPicture], group: SizeGroup) -> LevelVariances | None:
    """The variances by grey level that the estimate was made from; None for small pictures."""
    estimate = group.noise.estimate
    if not pictures or estimate is None or min(pictures[0].shape) < 32:
        return None
    top = float(np.iinfo(pictures[0].dtype).max) if estimate.saturation_dn is None else estimate.saturation_dn
    return level_variances(pictures, top, estimate.step_dn**2 / 12)


def _with_sigma(value: float, relative: float) -> str:
    """A value with the sigma of its logarithm: as a factor if that is large, else as a percentage."""
    return (
        f"{format_number(value)} ×/÷ {math.exp(relative):.2f}"
        if relative > 0.15
        else f"{format_number(value)} ± {100 * relative:.0f} %"
    )


def _made(series: PictureSeries) -> list[tuple[str, str]]:
    p = series.parameters
    own = versions()
    return [
        ("detection", f"threshold {p.threshold_sigma:g} sigma, at most {p.max_detections} spots in a picture"),
        ("beampose", f"{own['beampose']}, numpy {own['numpy']}, OpenCV {own['opencv-python-headless']}"),
    ]
