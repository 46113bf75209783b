"""Findings of a camera's calibration, each test with its figures, and its report."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.lens.fit.lens_models import folds_in_picture
from calibration.lens.fit.model_selection import OVERFIT, UNKNOWN_PX
from calibration.lens.fit.projection_map import Difference
from calibration.lens.intrinsics import Intrinsics
from geometry.arrays import Array
from lab.calibrate.camera.photos import VIDEO_SUFFIXES, PhotoSet, as_8_bit
from lab.findings.finding import Finding, Level, finding, level_above, passed
from lab.number_format import format_count, format_number
from lab.pictures.opencv import opened
from lab.pictures.picture_file import MissingPicture, read_picture
from lab.report.calibration.calibration_drawings import (
    corners_overlay,
    correlation_matrix,
    coverage_map,
    lens_model_chart,
    residual_field,
    residual_histogram,
    tilt_polar,
)
from lab.report.page import KeyFigure, PageDrawing, PageTable, Section
from lab.report.plot.maps import heat_map

_ENOUGH_VIEWS, _FEWEST_MORE = 15, 5  # photographs in all, and at least to add
_SLIGHT_MODEL_ERROR = 1.02  # factor on the sigmas from rival models below which it is not worth a remark
_UNDETERMINED = 0.002  # relative, of the difference in scale and of fx / fy: above it the two cannot be distinguished


@dataclass(frozen=True, slots=True)
class FindingLimits:
    """Thresholds of the findings; pairs are (warning, failure)."""

    noise_px: tuple[float, float] = (0.35, 1.0)  # of a corner; sharp photographs of flat boards give 0.03 to 0.25
    rejected: tuple[float, float] = (0.05, 0.3)  # share of the corners
    spread_deg: tuple[float, float] = (25.0, 8.0)  # largest angle between two boards
    filled: tuple[float, float] = (0.6, 0.25)  # share of the picture within some board
    aspect: tuple[float, float] = (0.005, 0.03)  # |fx/fy - 1|: pixels of today's sensors are square to 0.1 %
    off_centre: tuple[float, float] = (0.08, 0.2)  # principal point from the middle, share of the width or height
    focal: tuple[float, float] = (0.003, 0.02)  # relative sigma of the focal length
    overfit: tuple[float, float] = (1.5, OVERFIT)  # hold-out error over the noise
    views: int = 8
    p_value: float = 0.01  # of the halves' difference
    scatter_p_value: float = 0.05  # of the scatter between photographs
    origins_p_value: float = 0.02  # of the difference between photographs that the user names differently
    halves_px: float = 1.0  # a significant difference larger than this fails
    map_px: tuple[float, float] = (0.5, UNKNOWN_PX)  # projection uncertainty, 90 % quantile over the picture
    warp_m: float = 0.002  # a larger bend is not described by a quadratic surface
    model_factor: float = 2.0  # factor on the sigmas from rival models and correlated residuals
    board_px: float = 0.1  # change of directions by an unsolved deviation of the board
    stretch: float = 0.001  # relative scale difference of rows and columns: printers reach .1 %
    circle: float = 0.03  # relative difference from the stated diameter


LIMITS = FindingLimits()


def findings_of(c: Intrinsics) -> tuple[Finding, ...]:
    """All tests, in the order of the report."""
    found = [
        _lens(c),
        _noise(c),
        _rejected(c),
        _views_finding(c),
        _tilts(c),
        _coverage_finding(c),
        _focal(c),
        _aspect(c),
        _principal_point(c),
        _overfit(c),
        _halves(c),
        _origins(c),
        _scatter(c),
        _map(c),
        _model_uncertainty(c),
        _warp(c),
        _stretch(c),
        _points(c),
        _circles(c),
    ]
    return tuple(f for f in found if f is not None)


def board_and_model_texts(c: Intrinsics) -> list[str]:
    """What the findings say about the board and about the choice of lens model."""
    found = (_stretch(c), _points(c), _circles(c), _model_uncertainty(c))
    return [f.what for f in found if f is not None]


def next_photographs(c: Intrinsics) -> str:
    """What to photograph next, in one sentence, from what the photographs lack."""
    count = int(np.sum(c.table.counts(c.fit.used) > 0))
    wanted = max(_ENOUGH_VIEWS - count, _FEWEST_MORE)
    places = _listed(c.coverage.gaps)
    where = f"near the {places} of the picture" if places else "in every part of the picture up to its corners"
    tilt = "tilted by 20 to 45 deg to all sides"
    if c.coverage.spread_deg < LIMITS.spread_deg[0]:
        tilt += f" (so far {c.coverage.spread_deg:.0f} deg between any two)"
    turned = (
        ", half of them turned by 90 deg in its plane"
        if level_above(abs(c.fit.lens[0] / c.fit.lens[1] - 1), *LIMITS.aspect)
        else ""
    )
    sharp = ", sharp, on a stiff flat plate" if level_above(c.fit.sigma_px, *LIMITS.noise_px) else ""
    return f"Photograph next: {wanted} more, the board {where}, {tilt}{turned}{sharp}."


def _level_below(value: float, limits: tuple[float, float]) -> Level:
    """The level of a value that should be large."""
    return level_above(-value, -limits[0], -limits[1])


def _mm(c: Intrinsics, px: float) -> str:
    """A length in px, and in mm on the screen."""
    return f"{px:.3g} px ({format_number(px * c.map.usual_mm_per_px(), 2)} mm at {c.distance_m:.3g} m)"


def _listed(words: tuple[str, ...]) -> str:
    return " and ".join(filter(None, [", ".join(words[:-1]), *words[-1:]]))


def _lens(c: Intrinsics) -> Finding:
    if folds_in_picture(c.fit.lens, c.model.fisheye, c.table.image_size_px):
        return finding("BP-L10", Level.FAIL, f"{c.model.words}: the mapping folds inside the picture")
    return passed(f"Lens: {c.model.words}: {c.selection.why}.")


def _noise(c: Intrinsics) -> Finding:
    what = f"Corner residuals: {_mm(c, c.fit.sigma_px)} per coordinate (1 sigma; RMS {c.rms_px:.3g} px)."
    return finding("BP-L11", level_above(c.fit.sigma_px, *LIMITS.noise_px), what)


def _rejected(c: Intrinsics) -> Finding:
    lost = int(np.sum(~c.fit.used))
    share, dropped = lost / len(c.table), len(c.fit.dropped)
    what = f"{lost} of {len(c.table)} corners excluded ({share:.1%})"
    if dropped:
        what += f", among them {format_count(dropped, 'whole view')}"
    return finding("BP-L12", level_above(share, *LIMITS.rejected), what + ".")


def _views_finding(c: Intrinsics) -> Finding:
    count = int(np.sum(c.table.counts(c.fit.used) > 0))
    level = Level.WARN if count < LIMITS.views else Level.PASS
    return finding("BP-L13", level, f"{count} photographs used, {int(c.fit.used.sum())} corners.")


def _tilts(c: Intrinsics) -> Finding:
    what = f"The orientations of the boards differ by up to {c.coverage.spread_deg:.0f} deg."
    return finding("BP-L14", _level_below(c.coverage.spread_deg, LIMITS.spread_deg), what)


def _coverage_finding(c: Intrinsics) -> Finding:
    gaps = c.coverage.gaps
    level = max(_level_below(c.coverage.filled, LIMITS.filled), Level.WARN if gaps else Level.PASS)
    where = f"; none came near its {_listed(gaps)}, where directions are extrapolated" if gaps else ""
    return finding("BP-L15", level, f"Boards covered {c.coverage.filled:.0%} of the picture{where}.")


def _focal(c: Intrinsics) -> Finding:
    share = float(c.sigmas[0] / c.fit.lens[0])
    return finding(
        "BP-L16",
        level_above(share, *LIMITS.focal),
        f"Focal length {c.fit.lens[0]:.2f} ± {format_number(c.sigmas[0], 2)} px ({share:.2%}).",
        why="A pose's distance is uncertain by that share:"
        f" {format_number(1000 * share * c.distance_m, 2)} mm at {c.distance_m:.3g} m.",
    )


def _aspect(c: Intrinsics) -> Finding:
    fx, fy = c.fit.lens[:2]
    away = fx / fy - 1
    C = c.covariance[:2, :2] / np.outer([fx, fy], [fx, fy])
    sigma = float(np.sqrt(C[0, 0] + C[1, 1] - 2 * C[0, 1]))
    level = level_above(abs(away), *LIMITS.aspect)
    if level is not Level.FAIL and abs(away) < 2 * sigma:
        level = Level.PASS
    return finding("BP-L17", level, f"fx / fy = {fx / fy:.4f} ± {sigma:.1g}.")


def _principal_point(c: Intrinsics) -> Finding:
    size = np.array(c.table.image_size_px)
    away = c.fit.lens[2:4] - (size - 1) / 2
    share = float(np.max(np.abs(away) / size))
    level = level_above(share, *LIMITS.off_centre)
    what = (
        f"Principal point {away[0]:+.1f}, {away[1]:+.1f} px from the centre"
        f" (± {format_number(c.sigmas[2], 2)}, {format_number(c.sigmas[3], 2)})."
    )
    sure = bool(np.any(np.abs(away) > 2 * c.sigmas[2:4] + LIMITS.off_centre[0] * size))
    return finding("BP-L18", level, what, variant="" if sure else "uncertain")


def _overfit(c: Intrinsics) -> Finding:
    ratio = c.held_out_rms_px / c.fit.sigma_px
    what = f"Hold-out error: {_mm(c, c.held_out_rms_px)}, {ratio:.2f} times the corners' own noise."
    return finding("BP-L19", level_above(ratio, *LIMITS.overfit), what)


def _halves(c: Intrinsics) -> Finding:
    d = c.halves
    if d is None:
        what = "Half of the photographs do not determine the lens, so that two halves cannot be compared."
        return finding("BP-L20", Level.WARN, what)
    return finding(
        "BP-L21",
        _disagreement(d, LIMITS.p_value),
        f"Two halves of the photographs differ by {d.rms_px:.3g} px ({format_number(d.rms_mm, 2)} mm at"
        f" {c.distance_m:.3g} m), RMS over the picture; {d.expected_rms_px:.3g} px are expected from their sigmas"
        f" (p = {d.p_value:.2g}).",
    )


def _disagreement(d: Difference, p_value: float) -> Level:
    if d.p_value >= p_value:
        return Level.PASS
    return Level.FAIL if d.rms_px > LIMITS.halves_px else Level.WARN


def _origins(c: Intrinsics) -> Finding | None:
    if c.origins is None:
        return None
    d, (first, second) = c.origins.difference, c.origins.names
    return finding(
        "BP-L22",
        _disagreement(d, LIMITS.origins_p_value),
        f"The photographs {first!r} and {second!r} give lenses that differ by {d.rms_px:.3g} px, RMS over the picture;"
        f" {d.expected_rms_px:.3g} px are expected from their sigmas (p = {d.p_value:.2g}).",
    )


def _scatter(c: Intrinsics) -> Finding:
    alike = c.scatter.correlated
    what = (
        f"The lens parameters scatter from photograph to photograph by {c.scatter.factor:.2f} times what the corners'"
        " noise explains"
        + (f", of which common errors of neighbouring corners are {alike:.2f} times" if alike > 1 else "")
        + f" (p = {c.scatter.p_value:.2g}){'; the sigmas include it.' if c.correlated_noise > 1 else '.'}"
    )
    if alike == 1 and (c.correlated_noise == 1 or c.scatter.p_value >= LIMITS.scatter_p_value):
        return passed(what)
    return finding("BP-L23", Level.WARN, what)


def _map(c: Intrinsics) -> Finding:
    px, mm = c.map.sigma_px(c.covariance), c.map.sigma_mm(c.covariance)
    places = np.stack([np.nanquantile(m, [0.5, 0.9, 1.0]) for m in (px, mm)], axis=-1)
    half, most, worst = (f"{format_number(a, 2)} px ({format_number(b, 2)} mm" for a, b in places.tolist())
    return finding(
        "BP-L24",
        level_above(float(places[1, 0]), *LIMITS.map_px),
        f"The direction of a pixel is known to {half} at {c.distance_m:.3g} m) or better in half of the picture, to"
        f" {most}) in 90 %, and to {worst}) at the worst place (1 sigma).",
    )


def _model_uncertainty(c: Intrinsics) -> Finding | None:
    """Model error beyond the covariance of the parameters; None if there is no evidence of it."""
    d = c.model_uncertainty
    if d.factor < _SLIGHT_MODEL_ERROR:
        return None
    parts = []
    if d.left_px > 0:
        parts.append(f"correlated residuals over the picture of {d.left_px:.2g} px (p = {d.p_value:.1g})")
    if d.between_px > 0:
        parts.append(f"{d.between_px:.2g} px to the other models, by their probabilities")
    what = f"Uncertainty of the lens model: {' and '.join(parts)}; all sigmas have been multiplied by {d.factor:.2f}."
    return finding("BP-L01", Level.WARN if d.factor > LIMITS.model_factor or d.left_px > 0 else Level.PASS, what)


def _warp(c: Intrinsics) -> Finding | None:
    w = c.warp
    if w is None:
        return None
    what = f"The board is bent by {1000 * w.rise_m:.2f} mm (p = {w.p_value:.1g} for a flat board): {w.why}"
    if not w.corrected:
        change = (
            f" Solving for it would change directions by {format_number(w.change_px, 2)} px RMS." if w.change_px else ""
        )
        return passed(f"{what}; taken as flat.{change}")
    return finding("BP-L25", Level.WARN if w.rise_m > LIMITS.warp_m else Level.PASS, f"{what}; corrected.")


def _stretch(c: Intrinsics) -> Finding | None:
    """Whether the board's rows and columns are to scale; None if the photographs do not determine it."""
    s = None if c.board is None else c.board.stretch
    if s is None:
        return None
    what = (
        f"The board's rows are {100 * s.stretch:+.3f} ± {100 * s.sigma[0]:.1g} % longer than stated, if its columns"
        f" are right, and deviate from the right angle by"
        f" {np.degrees(s.lean_rad):+.3f} ± {np.degrees(s.sigma[1]):.1g} deg"
        f" (p = {s.p_value:.1g}): {s.why}"
    )
    if s.corrected:
        off = max(abs(s.stretch), abs(s.lean_rad))
        return finding("BP-L03", Level.WARN if off > LIMITS.stretch else Level.PASS, f"{what}; corrected.")
    aspect = c.fit.lens[0] / c.fit.lens[1]
    is_open = s.sigma[0] > _UNDETERMINED and abs(aspect - 1) > _UNDETERMINED
    if s.change_px > 0 and not is_open:
        level = Level.WARN if s.change_px > LIMITS.board_px else Level.PASS
        what += f"; taken as stated. Solving for it would change directions by {s.change_px:.2g} px RMS."
        return finding("BP-L03", level, what, variant="not solved for")
    return finding("BP-L02", Level.WARN if is_open else Level.PASS, f"{what}; taken as stated.")


def _points(c: Intrinsics) -> Finding | None:
    """Whether single points of the board are displaced; None if not."""
    p = None if c.board is None else c.board.points
    if p is None or not (p.corrected or np.any(p.off_m)):
        return None
    worst = int(np.argmax(np.linalg.norm(p.off_m[:, :2], axis=1)))
    off = 1000 * float(np.linalg.norm(p.off_m[worst, :2]))
    where = 1000 * c.table.board_points[worst, :2]
    what = (
        f"Points of the board are displaced by {1000 * p.rms_m:.2g} mm RMS, the worst, at {where[0]:.0f},"
        f" {where[1]:.0f} mm, by {off:.2g} mm (p = {p.p_value:.1g} for a correct board): {p.why}"
    )
    if p.corrected:
        return finding("BP-L04", Level.WARN, f"{what}; each was solved for.")
    return passed(f"{what}; taken as stated. Solving for them would change directions by {p.change_px:.2g} px RMS.")


def _circles(c: Intrinsics) -> Finding | None:
    """Size of the board's circles; None for other boards."""
    if c.table.circles is None:
        return None
    what = f"The circles have a diameter of {2000 * c.fit.radius_m:.3f} ± {2000 * c.fit.radius_sigma_m:.2g} mm"
    stated = c.table.circles.diameter_m
    if stated is None:
        alone = ", from the shift of their centroids alone" if c.table.circles.areas_px2 is None else ""
        return passed(f"{what}{alone}.")
    share = 2 * c.fit.radius_m / stated - 1
    what += f", {100 * share:+.1f} % against the {1000 * stated:.4g} mm stated."
    return finding("BP-L05", Level.WARN if abs(share) > LIMITS.circle else Level.PASS, what)


_WORST_VIEWS = 3  # views with the largest residuals that are shown as pictures, besides the median and the best


def page_of(r: Intrinsics, photos: PhotoSet, valid_until: str) -> tuple[list[KeyFigure], list[Section]]:
    """Key figures and sections of the report. valid_until: ISO date, empty: no expiry, or another text."""
    sections = [_numbers(r), _model(r), _uncertainty(r), _residuals(r, photos), _coverage(r), _views(r, photos)]
    return _key_figures(r, valid_until), sections


def _key_figures(r: Intrinsics, valid_until: str) -> list[KeyFigure]:
    px, mm = r.map.sigma_px(r.covariance), r.map.sigma_mm(r.covariance)
    at = f"at {format_number(r.distance_m)} m"
    held = r.held_out_rms_px * r.map.usual_mm_per_px()
    fx = f"{r.fit.lens[0]:.2f} ± {format_number(r.sigmas[0], 2)} px"
    both = (np.nanmedian, np.nanmax)
    usual, largest = (f"{format_number(of(px), 2)} px · {format_number(of(mm), 2)} mm" for of in both)
    held_out = f"{r.held_out_rms_px:.3f} px · {format_number(held, 2)} mm"
    return [
        ("focal length fx", fx, f"{r.sigmas[0] / r.fit.lens[0]:.2%}"),
        ("lens model", r.model.words, "the smallest expected error of directions"),
        ("direction of a pixel, median", usual, f"1 sigma, {at}"),
        ("direction, maximum", largest, f"1 sigma, {at}"),
        ("RMS of corners", f"{r.rms_px:.3f} px", f"per coordinate; {r.rms_2d_px:.3f} px per corner, as in OpenCV"),
        ("RMS in held-out photographs", held_out, f"per coordinate, {at}"),
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
    titles = [x.model.title + ("" if x.model.fisheye else " coefficients") for x in candidates]
    chart = lens_model_chart(titles, error, chosen, noise_px=noise)
    rows = []
    for x in r.selection.candidates:
        result = "chosen" if x.model == r.selection.chosen.model else x.refused or "larger error"
        residuals = np.nan if x.fit is None else x.fit.sigma_px
        rows.append((x.model.words, residuals, x.sigma_px, x.model_error_px, x.error_px, result))
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


def _extent(r: Intrinsics) -> tuple[float, float, float, float]:
    width, height = r.table.image_size_px
    return -0.5, width - 0.5, -0.5, height - 0.5


def _uncertainty(r: Intrinsics) -> Section:
    extent, at = _extent(r), f"at {format_number(r.distance_m)} m"
    drawings = [
        PageDrawing(
            heat_map(r.map.sigma_px(r.covariance), extent, "Uncertainty of a pixel's direction", "px"),
            "1 sigma along the worst direction, after the rotation of the camera that fits where corners were seen.",
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
        (name, _), mine = photos.views[v], t.view == v
        title, picture = f"{name} ({word}): RMS {rms[v]:.3f} px", _picture(photos, name)
        of_view = t.pixels[mine], residuals[mine]
        drawn = corners_overlay(t.image_size_px, *of_view, title, picture=picture, rejected=~used[mine])
        drawings.append(PageDrawing(drawn))
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
        distance_tilt = (np.nan, np.nan) if reason else (depth[v], r.coverage.tilt_deg[v])
        rows.append((name, f"{counts[v]} of {len(view)}", rms[v], *distance_tilt, note))
    rows += [(name, "none", np.nan, np.nan, np.nan, reason) for name, reason in photos.refused]
    heads = ("photograph", "corners used", "RMS (px)", "distance (m)", "tilt (deg)", "remarks")
    return Section("The photographs", photos.line() + ".", (), PageTable(heads, rows))
