"""Report of a camera calibration."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.lens.fit.lens_models import LensModel
from calibration.lens.intrinsics_result import Intrinsics
from geometry.arrays import Array
from lab.calibrate.camera.camera_findings import board_and_model_texts
from lab.calibrate.camera.photos import VIDEO_SUFFIXES, PhotoSet, as_8_bit
from lab.number_format import format_number
from lab.pictures.opencv import opened
from lab.pictures.picture_file import MissingPicture, read_picture
from lab.report.calibration.calibration_charts import correlation_matrix, lens_model_chart, residual_histogram
from lab.report.calibration.calibration_drawings import corners_overlay, coverage_map, residual_field, tilt_polar
from lab.report.page import (
    KeyFigure,
    PageDrawing,
    PageTable,
    Section,
)
from lab.report.plot.maps import heat_map

_WORST_VIEWS = 3  # views with the largest residuals that are shown as pictures, besides the median and the best


def page_of(r: Intrinsics, photos: PhotoSet, valid_until: str) -> tuple[list[KeyFigure], list[Section]]:
    """Key figures and sections of the report. valid_until: ISO date, empty: no expiry, or another text."""
    sections = [_numbers(r), _model(r), _uncertainty(r), _residuals(r, photos), _coverage(r), _views(r, photos)]
    return _key_figures(r, valid_until), sections


def _key_figures(r: Intrinsics, valid_until: str) -> list[KeyFigure]:
    px, mm = r.map.sigma_px(r.covariance), r.map.sigma_mm(r.covariance)
    at = f"at {format_number(r.distance_m)} m"
    held = r.held_out_rms_px * r.map.usual_mm_per_px()
    return [
        (
            "focal length fx",
            f"{r.fit.lens[0]:.2f} ± {format_number(r.sigmas[0], 2)} px",
            f"{r.sigmas[0] / r.fit.lens[0]:.2%}",
        ),
        ("lens model", r.model.words, "the smallest expected error of directions"),
        (
            "direction of a pixel, median",
            f"{format_number(np.nanmedian(px), 2)} px · {format_number(np.nanmedian(mm), 2)} mm",
            f"1 sigma, {at}",
        ),
        (
            "direction, maximum",
            f"{format_number(np.nanmax(px), 2)} px · {format_number(np.nanmax(mm), 2)} mm",
            f"1 sigma, {at}",
        ),
        ("RMS of corners", f"{r.rms_px:.3f} px", f"per coordinate; {r.rms_2d_px:.3f} px per corner, as in OpenCV"),
        (
            "RMS in held-out photographs",
            f"{r.held_out_rms_px:.3f} px · {format_number(held, 2)} mm",
            f"per coordinate, {at}",
        ),
        ("valid until", valid_until or "no expiry date", ""),
    ]


def _numbers(r: Intrinsics) -> Section:
    free = r.fit.lens[r.model.free]
    rows = [
        (name, f"{value:.6g}", f"{sigma:.2g}", f"{abs(value) / sigma:.0f}")
        for name, value, sigma in zip(r.parameters, free.tolist(), r.sigmas.tolist(), strict=True)
    ]
    words = [
        "fx, fy, cx and cy are in pixels, the distortion coefficients in OpenCV's order and units. Sigmas follow from"
        " the scatter of the corners"
        + (
            f" and of the photographs, which is {r.correlated_noise:.2f} times what the corners explain."
            if r.correlated_noise > 1
            else "."
        ),
        "Errors of correlated parameters (saturated colours) partly cancel: the uncertainty of a pixel's direction"
        " follows only from the full covariance in camera.yaml.",
    ]
    drawing = PageDrawing(correlation_matrix(r.parameters, r.covariance), "Correlations of the parameters.")
    return Section("Parameters", words, [drawing], PageTable(("parameter", "value", "sigma", "value / sigma"), rows))


def _model(r: Intrinsics) -> Section:
    candidates = [x for x in r.selection.candidates if np.isfinite(x.error_px)]
    error = np.array([x.error_px for x in candidates])
    noise = np.array([x.sigma_px for x in candidates])
    chosen = next(k for k, x in enumerate(candidates) if x.model == r.selection.chosen.model)
    chart = lens_model_chart([_label(x.model) for x in candidates], error, chosen, noise_px=noise)
    rows = [
        (
            x.model.words,
            np.nan if x.fit is None else x.fit.sigma_px,
            x.sigma_px,
            x.model_error_px,
            x.error_px,
            "chosen" if x.model == r.selection.chosen.model else x.refused or "larger error",
        )
        for x in r.selection.candidates
    ]
    words = [
        "The expected error of a direction where corners were seen: the part that noise and the scatter between"
        " photographs leave, which grows with the number of coefficients, and the difference to the other models,"
        " weighted with the probabilities that these are right. Residuals, which decrease with every coefficient, do"
        " not decide. A model that leaves directions unknown in a part of the picture is not used.",
        f"Chosen: {r.model.words}: {r.selection.why}.",
    ]
    if r.warp is not None:
        bend = ", ".join(f"{w:.3g} ± {s:.1g}" for w, s in zip(r.warp.warp, r.warp.sigma, strict=True))
        words.append(
            f"Board: {'corrected for its bend' if r.warp.corrected else 'assumed flat'} ({r.warp.why}). Estimated bend:"
            f" {bend} per metre for x², xy, y²; {1000 * r.warp.rise_m:.2f} mm between the lowest and the highest point."
        )
    words += board_and_model_texts(r)
    caption = "Bars: expected error of a direction; ticks: the part from noise and scatter between photographs."
    heads = ("model", "residuals (px)", "noise (px)", "other models (px)", "expected error (px)", "result")
    table = PageTable(heads, rows)
    return Section("Selection of the lens model", words, [PageDrawing(chart, caption)], table)


def _label(model: LensModel) -> str:
    return model.title if model.fisheye else f"{model.title} coefficients"


def _extent(r: Intrinsics) -> tuple[float, float, float, float]:
    width, height = r.table.image_size_px
    return -0.5, width - 0.5, -0.5, height - 0.5


def _uncertainty(r: Intrinsics) -> Section:
    extent, at = _extent(r), f"at {format_number(r.distance_m)} m"
    drawings = [
        PageDrawing(
            heat_map(r.map.sigma_px(r.covariance), extent, "Uncertainty of a pixel's direction", "px"),
            "1 sigma along the worst direction, after the best-fitting small rotation of the camera.",
        ),
        PageDrawing(
            heat_map(r.map.sigma_mm(r.covariance), extent, f"The same on a screen {at}", "mm"),
            f"On a screen that faces the camera {at}.",
        ),
    ]
    words = [
        "Effect of the lens uncertainty on a spot, over the picture. It is the same in every frame and is not reduced"
        " by averaging. The part that a rotation of the camera compensates is left out: the attitude of the mounted"
        " camera is estimated with this lens and takes up that part.",
    ]
    if r.halves is None:
        words.append("The two halves of the photographs cannot be compared: one of them does not determine the lens.")
    else:
        d = r.halves
        size = np.linalg.norm(d.moved_px, axis=-1)
        drawings.append(
            PageDrawing(
                heat_map(size, extent, "Difference between the two halves of the photographs", "px"),
                f"RMS {format_number(d.rms_px)} px ({format_number(d.rms_mm, 2)} mm {at}); expected from the sigmas"
                f" {format_number(d.expected_rms_px)} px (p = {d.p_value:.2g}).",
            )
        )
        words.append(
            "The covariance does not contain errors of the lens model. A second test does: every other photograph and"
            " the rest are calibrated separately and should differ only by as much as their sigmas allow."
        )
    return Section("Uncertainty of a pixel's direction", words, drawings)


def _residuals(r: Intrinsics, photos: PhotoSet) -> Section:
    t, used = r.table, r.fit.used
    residuals = -r.fit.residuals  # measured minus model
    drawings = [
        PageDrawing(residual_field(t.image_size_px, t.pixels[used], residuals[used]), "Measured minus model."),
        PageDrawing(
            residual_histogram(residuals[used], sigma=r.fit.sigma_px),
            "Per coordinate, used corners; the curve is the normal distribution.",
        ),
    ]
    rms = _rms_per_view(r)
    for v, word in representative_views(rms, worst=_WORST_VIEWS):
        name, _ = photos.views[v]
        mine = t.view == v
        drawings.append(
            PageDrawing(
                corners_overlay(
                    t.image_size_px,
                    t.pixels[mine],
                    residuals[mine],
                    f"{name} ({word}): RMS {rms[v]:.3f} px",
                    picture=_picture(photos, name),
                    rejected=~used[mine],
                )
            )
        )
    words = (
        "Single residuals are noise; a common direction in a part of the picture (red) is an error of the lens model."
        " Corners with residuals beyond 4.5 sigma, and views with residuals three times those of the median view, are"
        " excluded."
    )
    return Section("Residuals", words, drawings)


def representative_views(rms_px: Array, worst: int = 4) -> list[tuple[int, str]]:
    """Indices of the views to show as pictures, each with its rank: the worst ones, the median and the best.

    rms_px (n,): nan for an unused view, which is never shown. worst: number of the worst views.
    """
    rms = np.asarray(rms_px, dtype=float)
    order = [int(i) for i in np.argsort(rms, kind="stable") if np.isfinite(rms[i])]
    named = [(i, "worst" if k == 0 else f"{k + 1}. worst") for k, i in enumerate(order[::-1][:worst])]
    if order:
        named += [(order[len(order) // 2], "median"), (order[0], "best")]
    shown: dict[int, str] = {}
    for i, word in named:
        shown.setdefault(i, word)
    return list(shown.items())


def _rms_per_view(r: Intrinsics) -> Array:
    """RMS (V,) per coordinate of the used corners of each view; nan for an unused view."""
    squared = np.sum(r.fit.residuals**2, axis=1) / 2
    return np.sqrt(r.table.mean_per_view(squared, r.fit.used))


def _picture(photos: PhotoSet, name: str) -> NDArray[np.uint8] | None:
    """The photograph as 8 bits for display; None if it can no longer be read."""
    path = photos.paths[name]
    if path.suffix.lower() in VIDEO_SUFFIXES:
        video = opened(str(path))
        video.set(cv2.CAP_PROP_POS_FRAMES, int(name.rpartition("#")[2]))
        good, frame = video.read()
        video.release()
        return np.asarray(frame, dtype=np.uint8) if good else None
    picture = read_picture(path, photos.image_size_px)
    return None if isinstance(picture, MissingPicture) else as_8_bit(picture)


def _coverage(r: Intrinsics) -> Section:
    t, used = r.table, r.fit.used
    outlines = [
        cv2.convexHull(t.pixels[used & (t.view == v)].astype(np.float32)).reshape(-1, 2).astype(float)
        for v in np.flatnonzero(t.counts(used) > 2)
    ]
    known = np.isfinite(r.coverage.tilt_deg)
    drawings = [
        PageDrawing(coverage_map(t.image_size_px, t.pixels[used], outlines_px=outlines), "Used corners and outlines."),
        PageDrawing(
            tilt_polar(r.coverage.tilt_deg[known], r.coverage.azimuth_deg[known]),
            "Boards tilted by 20 deg and more in all directions determine the focal length.",
        ),
    ]
    gaps = f" No board was near the {', '.join(r.coverage.gaps)}." if r.coverage.gaps else ""
    words = (
        f"The boards cover {r.coverage.filled:.0%} of the picture, and their directions differ by up to"
        f" {r.coverage.spread_deg:.0f} deg.{gaps} Where there are no corners, the lens model is extrapolated."
    )
    return Section("Coverage by the boards", words, drawings)


def _views(r: Intrinsics, photos: PhotoSet) -> Section:
    counts, rms = r.table.counts(r.fit.used), _rms_per_view(r)
    depth = r.fit.poses.apply(r.table.middle)[:, 2]
    rows: list[tuple[object, ...]] = []
    for v, (name, view) in enumerate(photos.views):
        reason = r.fit.dropped.get(v, "")
        note = f"excluded: {reason}" if reason else "; ".join(view.notes)
        distance_tilt = (np.nan, np.nan) if reason else (float(depth[v]), float(r.coverage.tilt_deg[v]))
        rows.append((name, f"{counts[v]} of {len(view)}", float(rms[v]), *distance_tilt, note))
    rows += [(name, "none", np.nan, np.nan, np.nan, reason) for name, reason in photos.refused]
    heads = ("photograph", "corners used", "RMS (px)", "distance (m)", "tilt (deg)", "remarks")
    return Section("The photographs", photos.line() + ".", (), PageTable(heads, rows))
