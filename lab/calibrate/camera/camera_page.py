"""The report of a camera's calibration."""

from __future__ import annotations

import datetime
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.findings import Level
from calibration.lens.board_findings import circles_finding, doubt_finding, points_finding, stretch_finding
from calibration.lens.fit.lens_models import LensModel
from calibration.lens.intrinsics_result import Intrinsics
from geometry.arrays import Array
from lab.calibrate.camera.camera_outcome import CameraOutcome
from lab.calibrate.camera.photos import VIDEO_SUFFIXES
from lab.files.rig.camera_file import CameraFile
from lab.number_format import short
from lab.pictures.picture_file import Missing, decode
from lab.report.calibration.calibration_charts import lens_ladder, residual_histogram
from lab.report.calibration.calibration_drawings import corners_overlay, coverage_map, residual_field, tilt_polar
from lab.report.calibration.calibration_maps import correlation_matrix
from lab.report.calibration.calibration_page import (
    CalibrationReport,
    PageDrawing,
    PageTable,
    Section,
    provenance,
    telling_views,
    write_calibration_report,
)
from lab.report.plot.maps import heat_map

_WORST_VIEWS = 3  # of them as pictures, besides the median and the best


def write_page(outcome: CameraOutcome, file: CameraFile, day: datetime.date, folder: Path) -> Path:
    """Write report.html into the folder."""
    r = outcome.result
    used_paths = [outcome.photos.paths[name] for name, _ in outcome.photos.views]
    report = CalibrationReport(
        "Camera",
        f"{outcome.name}, {r.table.image_size_px[0]} x {r.table.image_size_px[1]} px",
        outcome.level,
        r.findings,
        _key_figures(r, file),
        [
            _numbers(r),
            _model(r),
            _uncertainty(r),
            _residuals(outcome),
            _coverage(r),
            _views(outcome),
        ],
        provenance(dict.fromkeys(used_paths), day),
    )
    return write_calibration_report(report, folder)


def _key_figures(r: Intrinsics, file: CameraFile) -> list[tuple[str, str, str]]:
    px, mm = r.map.sigma_px(r.covariance), r.map.sigma_mm(r.covariance)
    at = f"at {short(r.distance_m)} m"
    held = r.held.rms_px * _mm_per_px(r)
    until = file.calibration.valid_until if file.calibration else ""
    failed = r.verdict is Level.FAIL
    return [
        ("focal length fx", f"{r.fit.lens[0]:.2f} ± {short(r.sigmas[0], 2)} px", f"{r.sigmas[0] / r.fit.lens[0]:.2%}"),
        ("lens", r.model.words, "smallest that predicts new photographs as well as the best"),
        (
            "direction of a pixel, median",
            f"{short(np.nanmedian(px), 2)} px · {short(np.nanmedian(mm), 2)} mm",
            f"1 sigma, {at}",
        ),
        ("at the worst place", f"{short(np.nanmax(px), 2)} px · {short(np.nanmax(mm), 2)} mm", f"1 sigma, {at}"),
        ("corners' RMS", f"{r.rms_px:.3f} px", f"per coordinate; {r.rms_2d_px:.3f} px per corner, as OpenCV counts"),
        ("in photographs held out", f"{r.held.rms_px:.3f} px · {short(held, 2)} mm", f"per coordinate, {at}"),
        ("valid until", "must not be used" if failed else until or "no expiry date", ""),
    ]


def _mm_per_px(r: Intrinsics) -> float:
    return float(np.nanmedian(np.abs(np.linalg.det(r.map.mm_per_px))) ** 0.5)


def _numbers(r: Intrinsics) -> Section:
    free = r.fit.lens[r.model.free]
    rows = [
        (name, f"{value:.6g}", f"{sigma:.2g}", f"{abs(value) / sigma:.0f}")
        for name, value, sigma in zip(r.parameters, free.tolist(), r.sigmas.tolist(), strict=True)
    ]
    words = [
        "fx, fy, cx and cy are in pixels, the distortion numbers in OpenCV's order and units. Sigmas come from the"
        " corners' own scatter"
        + (
            f", raised by {r.correlated_noise:.2f} for what whole photographs scatter beyond it."
            if r.correlated_noise > 1
            else "."
        ),
        "Numbers that go together (dark squares) are uncertain together: their errors cancel in part, and only the"
        " whole covariance, as in camera.yaml, says how a pixel's direction is known.",
    ]
    drawing = PageDrawing(correlation_matrix(r.parameters, r.covariance), "How the errors of the numbers go together.")
    return Section("The numbers", words, [drawing], PageTable(("parameter", "value", "sigma", "value / sigma"), rows))


def _model(r: Intrinsics) -> Section:
    candidates = [x for x in r.ladder.candidates if x.held is not None]
    held = np.array([np.nan if x.held is None else x.held.rms_px for x in candidates])
    fitted = np.array([np.nan if x.fit is None else x.fit.sigma_px for x in candidates])
    # Of the difference to the best, which is far better known than each error alone.
    spread = np.array([x.standard_error_px2 for x in candidates]) / (2 * held)
    chosen = next(k for k, x in enumerate(candidates) if x.model == r.ladder.chosen.model)
    chart = lens_ladder([_label(x.model) for x in candidates], held, chosen, fit_rms_px=fitted, sigma_px=spread)
    rows = [
        (
            x.model.words,
            np.nan if x.fit is None else x.fit.sigma_px,
            np.nan if x.held is None else x.held.rms_px,
            "chosen" if x.model == r.ladder.chosen.model else x.refused or "errs more, or gains nothing",
        )
        for x in r.ladder.candidates
    ]
    words = [
        f"Each model was solved {len(r.held.folds)} times more, each time without some of the photographs, and then"
        " asked to predict those (only the board's place in them was solved for). Residuals of the photographs that a"
        " model was made from shrink with every coefficient; these do not.",
        f"Chosen: {r.model.words}: {r.ladder.why}.",
    ]
    if r.warp is not None:
        bend = ", ".join(f"{w:.3g} ± {s:.1g}" for w, s in zip(r.warp.warp, r.warp.sigma, strict=True))
        words.append(
            f"Board: {'corrected for its bend' if r.warp.corrected else 'taken as flat'} ({r.warp.why}). Its bend,"
            f" solved for: {bend} per metre along x², xy, y²: {1000 * r.warp.rise_m:.2f} mm from its lowest to its"
            " highest point."
        )
    words += [f.what for f in (stretch_finding(r), points_finding(r), circles_finding(r), doubt_finding(r)) if f]
    caption = (
        "Bars: error on photographs held out; whiskers: of the difference to the best; ticks: on those solved from."
    )
    table = PageTable(("model", "on its own photographs (px)", "on held-out ones (px)", "outcome"), rows)
    return Section("Which lens model", words, [PageDrawing(chart, caption)], table)


def _label(model: LensModel) -> str:
    return model.title if model.fisheye else f"{model.title} coefficients"


def _extent(r: Intrinsics) -> tuple[float, float, float, float]:
    width, height = r.table.image_size_px
    return -0.5, width - 0.5, -0.5, height - 0.5


def _uncertainty(r: Intrinsics) -> Section:
    extent, at = _extent(r), f"at {short(r.distance_m)} m"
    drawings = [
        PageDrawing(
            heat_map(r.map.sigma_px(r.covariance), extent, "Uncertainty of a pixel's direction", "px"),
            "1 sigma in its worst direction, after the best small turn of the camera.",
        ),
        PageDrawing(
            heat_map(r.map.sigma_mm(r.covariance), extent, f"The same on a screen {at}", "mm"),
            f"On a screen that faces the camera {at}.",
        ),
    ]
    words = [
        "What the lens' uncertainty does to a spot, all over the picture. It is the same in every frame: averaging does"
        " not remove it. A turn of the camera looks much like a shift of its lens and is solved for through the same"
        " lens when the camera is mounted; so the part that a turn undoes is left out here.",
    ]
    if r.halves is None:
        words.append("Two halves could not be compared: one of them does not determine the lens.")
    else:
        d = r.halves
        size = np.linalg.norm(d.moved_px, axis=-1)
        drawings.append(
            PageDrawing(
                heat_map(size, extent, "Two halves of the photographs: how far they differ", "px"),
                f"RMS {short(d.rms_px)} px ({short(d.rms_mm, 2)} mm {at}); expected from their sigmas"
                f" {short(d.expected_rms_px)} px (p = {d.p_value:.2g}).",
            )
        )
        words.append(
            "A covariance knows nothing of a wrong model. The second test does: every other photograph against the"
            " rest, solved apart. They should differ by what their sigmas let expect."
        )
    return Section("How well a pixel's direction is known", words, drawings)


def _residuals(outcome: CameraOutcome) -> Section:
    r = outcome.result
    t, used = r.table, r.fit.used
    found_less_model = -r.fit.residuals
    drawings = [
        PageDrawing(residual_field(t.image_size_px, t.pixels[used], found_less_model[used]), "Found less model."),
        PageDrawing(
            residual_histogram(found_less_model[used], sigma=r.fit.sigma_px),
            "Per coordinate, used corners; the curve is that of normal errors.",
        ),
    ]
    rms = _rms_per_view(r)
    for v, word in telling_views(rms, worst=_WORST_VIEWS):
        name, _ = outcome.photos.views[v]
        mine = t.view == v
        drawings.append(
            PageDrawing(
                corners_overlay(
                    t.image_size_px,
                    t.pixels[mine],
                    found_less_model[mine],
                    f"{name} ({word}): RMS {rms[v]:.3f} px",
                    picture=_picture(outcome, name),
                    rejected=~used[mine],
                )
            )
        )
    words = (
        "Single residuals are noise; what goes the same way all over a part of the picture (red) is what the model"
        " cannot bend. Corners that miss by more than 4.5 sigmas, and views whose corners miss three times as far as"
        " those of the median view, are left out."
    )
    return Section("What the model misses", words, drawings)


def _rms_per_view(r: Intrinsics) -> Array:
    """(V,): RMS per coordinate of the used corners; nan where a view was not used."""
    squared = np.sum(r.fit.residuals**2, axis=1) / 2
    return np.sqrt(r.table.mean_per_view(squared, r.fit.used))


def _picture(outcome: CameraOutcome, name: str) -> NDArray[np.uint8] | None:
    """The photograph for the eye, 8 bits; None where it can no longer be read."""
    path = outcome.photos.paths[name]
    if path.suffix.lower() in VIDEO_SUFFIXES:
        video = cv2.VideoCapture(str(path))
        video.set(cv2.CAP_PROP_POS_FRAMES, int(name.rpartition("#")[2]))
        good, frame = video.read()
        video.release()
        return np.asarray(frame, dtype=np.uint8) if good else None
    try:
        picture = decode(path.read_bytes(), outcome.photos.image_size_px)
    except OSError:
        return None
    if isinstance(picture, Missing):
        return None
    if picture.dtype == np.uint8:
        return np.asarray(picture, dtype=np.uint8)
    low, high = np.percentile(picture, [0.1, 99.9])
    return np.clip((picture - low) * (255.0 / max(high - low, 1.0)), 0, 255).astype(np.uint8)


def _coverage(r: Intrinsics) -> Section:
    t, used = r.table, r.fit.used
    outlines = [
        cv2.convexHull(t.pixels[used & (t.view == v)].astype(np.float32)).reshape(-1, 2).astype(float)
        for v in np.flatnonzero(t.counts(used) > 2)
    ]
    good = np.isfinite(r.coverage.tilt_deg)
    drawings = [
        PageDrawing(coverage_map(t.image_size_px, t.pixels[used], outlines_px=outlines), "Used corners and outlines."),
        PageDrawing(
            tilt_polar(r.coverage.tilt_deg[good], r.coverage.azimuth_deg[good]),
            "Boards tilted to all sides, by 20 deg and more, tell the focal length.",
        ),
    ]
    gaps = f" None came near the {', '.join(r.coverage.gaps)}." if r.coverage.gaps else ""
    words = (
        f"Boards covered {r.coverage.filled:.0%} of the picture, and their directions differ by up to"
        f" {r.coverage.spread_deg:.0f} deg.{gaps} Where no corner was, the lens is only extrapolated."
    )
    return Section("Where the boards were", words, drawings)


def _views(outcome: CameraOutcome) -> Section:
    r, counts = outcome.result, outcome.result.table.counts(outcome.result.fit.used)
    rms = _rms_per_view(r)
    depth = r.fit.poses.apply(r.table.middle)[:, 2]
    rows: list[tuple[object, ...]] = []
    for v, (name, view) in enumerate(outcome.photos.views):
        why = r.fit.dropped.get(v, "")
        note = f"left out: {why}" if why else "; ".join(view.notes)
        where = (np.nan, np.nan) if why else (float(depth[v]), float(r.coverage.tilt_deg[v]))
        rows.append((name, f"{counts[v]} of {len(view)}", float(rms[v]), *where, note))
    rows += [(name, "none", np.nan, np.nan, np.nan, reason) for name, reason in outcome.photos.refused]
    heads = ("photograph", "corners used", "RMS (px)", "distance (m)", "tilt (deg)", "remarks")
    return Section("The photographs", outcome.photos.line() + ".", (), PageTable(heads, rows))
