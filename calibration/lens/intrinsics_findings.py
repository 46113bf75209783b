"""Findings of a camera's calibration: each test with its figures, their meaning and the remedy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.findings import Finding, Level, unless_pass
from calibration.lens.board_findings import circles_finding, model_uncertainty_finding, points_finding, stretch_finding
from calibration.lens.fit.lens_models import folds_in_picture
from calibration.lens.fit.model_selection import OVERFIT, UNKNOWN_PX
from calibration.lens.fit.projection_map import Difference
from calibration.lens.intrinsics_result import Intrinsics

_TILTED = "tilt the board by 20 to 45 deg to all sides and photograph it at two or three distances"
_ENOUGH_VIEWS, _FEWEST_MORE = 15, 5  # photographs in all, and at least to add
_MORE = "take more photographs, the board tilted by 20 to 45 deg to all sides and moved into the picture's corners"


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
    p_value: float = 0.01  # of the halves' difference, and of the scatter between photographs
    origins_p_value: float = 0.02  # of the difference between photographs that the user names differently
    halves_px: float = 1.0  # a significant difference larger than this fails
    map_px: tuple[float, float] = (0.5, UNKNOWN_PX)  # projection uncertainty, 90 % quantile over the picture
    warp_m: float = 0.002  # a larger bend is not described by a quadratic surface


LIMITS = FindingLimits()


def findings_of(c: Intrinsics, limits: FindingLimits = LIMITS) -> tuple[Finding, ...]:
    """All tests, in the order of the report."""
    found = [
        _lens(c),
        _noise(c, limits),
        _rejected(c, limits),
        _views(c, limits),
        _tilts(c, limits),
        _coverage(c, limits),
        _focal(c, limits),
        _aspect(c, limits),
        _principal_point(c, limits),
        _overfit(c, limits),
        _halves(c, limits),
        _origins(c, limits),
        _scatter(c),
        _map(c, limits),
        model_uncertainty_finding(c),
        _warp(c, limits),
        stretch_finding(c),
        points_finding(c),
        circles_finding(c),
    ]
    return tuple(f for f in found if f is not None)


def next_photographs(c: Intrinsics, limits: FindingLimits = LIMITS) -> str:
    """What to photograph next, in one sentence, from what the photographs lack."""
    count = int(np.sum(c.table.counts(c.fit.used) > 0))
    wanted = max(_ENOUGH_VIEWS - count, _FEWEST_MORE)
    places = " and ".join(filter(None, [", ".join(c.coverage.gaps[:-1]), *c.coverage.gaps[-1:]]))
    where = f"near the {places} of the picture" if places else "in every part of the picture up to its corners"
    tilt = "tilted by 20 to 45 deg to all sides"
    if c.coverage.spread_deg < limits.spread_deg[0]:
        tilt += f" (so far {c.coverage.spread_deg:.0f} deg between any two)"
    turned = (
        ", half of them turned by 90 deg in its plane"
        if _level(abs(c.fit.lens[0] / c.fit.lens[1] - 1), limits.aspect)
        else ""
    )
    sharp = ", sharp, on a stiff flat plate" if _level(c.fit.sigma_px, limits.noise_px) else ""
    return f"Photograph next: {wanted} more, the board {where}, {tilt}{turned}{sharp}."


def _level(value: float, limits: tuple[float, float]) -> Level:
    """Level by (warning, failure) limits: ascending for values that should be small, descending for large ones."""
    warn, fail = limits
    sign = 1.0 if fail > warn else -1.0
    return Level.FAIL if sign * value > sign * fail else Level.WARN if sign * value > sign * warn else Level.PASS


def _two(value: float) -> str:
    """Two significant digits without an exponent: 0.29, 3.9, 240."""
    if not np.isfinite(value) or value == 0:
        return f"{value:g}"
    digits = 1 - int(np.floor(np.log10(abs(value))))
    return f"{round(value, digits):.{max(digits, 0)}f}"


def _mm(c: Intrinsics, px: float) -> str:
    """A length in px, and in mm on the screen."""
    per_px = float(np.nanmedian(np.abs(np.linalg.det(c.map.mm_per_px))) ** 0.5)
    return f"{px:.3g} px ({_two(px * per_px)} mm at {c.distance_m:.3g} m)"


def _lens(c: Intrinsics) -> Finding:
    if folds_in_picture(c.fit.lens, c.model.fisheye, c.table.image_size_px):
        return Finding(
            Level.FAIL,
            f"{c.model.words}: the mapping folds inside the picture",
            "Two directions would map to the same pixel.",
            _MORE,
            code="BP-L10",
        )
    why = c.selection.why
    return Finding(Level.PASS, f"Lens: {c.model.words}: {why}.")


def _noise(c: Intrinsics, limits: FindingLimits) -> Finding:
    return unless_pass(
        _level(c.fit.sigma_px, limits.noise_px),
        f"Corner residuals: {_mm(c, c.fit.sigma_px)} per coordinate (1 sigma; RMS {c.rms_px:.3g} px).",
        "Sharp photographs of a flat board give 0.03 to 0.25 px. Larger residuals mean blur, a board that is not flat"
        " or not as stated, or a lens that no available model describes.",
        "See the residuals below; fix the board to glass or a thick plate, hold it still, light it well, and check"
        " its measures.",
        code="BP-L11",
    )


def _rejected(c: Intrinsics, limits: FindingLimits) -> Finding:
    lost = int(np.sum(~c.fit.used))
    share = lost / len(c.table)
    dropped = len(c.fit.dropped)
    text = f"{lost} of {len(c.table)} corners excluded ({share:.1%})"
    if dropped:
        text += f", among them {dropped} whole view{'s' if dropped > 1 else ''}"
    return unless_pass(
        _level(share, limits.rejected),
        text + ".",
        "A corner more than 4.5 sigmas from the model counts as an outlier; with so many outliers the other corners"
        " are doubtful too.",
        "See the views marked below; photograph them again, sharp and without glare.",
        code="BP-L12",
    )


def _views(c: Intrinsics, limits: FindingLimits) -> Finding:
    count = int(np.sum(c.table.counts(c.fit.used) > 0))
    return unless_pass(
        Level.WARN if count < limits.views else Level.PASS,
        f"{count} photographs used, {int(c.fit.used.sum())} corners.",
        "With few photographs neither the lens model nor its errors can be checked.",
        "Take 15 to 30 photographs.",
        code="BP-L13",
    )


def _tilts(c: Intrinsics, limits: FindingLimits) -> Finding:
    return unless_pass(
        _level(c.coverage.spread_deg, limits.spread_deg),
        f"The orientations of the boards differ by up to {c.coverage.spread_deg:.0f} deg.",
        "Without tilted boards the focal length can hardly be separated from the distance.",
        _TILTED[0].upper() + _TILTED[1:] + ".",
        code="BP-L14",
    )


def _coverage(c: Intrinsics, limits: FindingLimits) -> Finding:
    gaps = c.coverage.gaps
    level = max(_level(c.coverage.filled, limits.filled), Level.WARN if gaps else Level.PASS)
    where = f"; none came near its {_listed(gaps)}" if gaps else ""
    return unless_pass(
        level,
        f"Boards covered {c.coverage.filled:.0%} of the picture{where}.",
        "In areas without corners the lens model is extrapolated, and the uncertainty map is valid only if the model"
        " is.",
        "Add photographs with the board in these areas, cut off by the border of the picture if the board allows it.",
        code="BP-L15",
    )


def _listed(words: tuple[str, ...]) -> str:
    return words[0] if len(words) == 1 else ", ".join(words[:-1]) + " and " + words[-1]


def _focal(c: Intrinsics, limits: FindingLimits) -> Finding:
    share = float(c.sigmas[0] / c.fit.lens[0])
    return unless_pass(
        _level(share, limits.focal),
        f"Focal length {c.fit.lens[0]:.2f} ± {_two(c.sigmas[0])} px ({share:.2%}).",
        "A pose's distance is uncertain by that share:"
        f" {_two(1000 * share * c.distance_m)} mm at {c.distance_m:.3g} m.",
        f"Take more photographs; {_TILTED}.",
        code="BP-L16",
    )


def _aspect(c: Intrinsics, limits: FindingLimits) -> Finding:
    fx, fy = c.fit.lens[:2]
    away = fx / fy - 1
    C = c.covariance[:2, :2] / np.outer([fx, fy], [fx, fy])
    sigma = float(np.sqrt(C[0, 0] + C[1, 1] - 2 * C[0, 1]))
    level = _level(abs(away), limits.aspect)
    if level is not Level.FAIL and abs(away) < 2 * sigma:
        level = Level.PASS
    return unless_pass(
        level,
        f"fx / fy = {fx / fy:.4f} ± {sigma:.1g}.",
        "Pixels are square on nearly every sensor: two focal lengths mean that the spacing of the board's rows or"
        " columns differs from the stated one, that the pictures were stretched, or that the views do not determine"
        " them.",
        "Measure the board along both directions; photograph it turned by 90 deg as well; check the scaling of the"
        " pictures.",
        code="BP-L17",
    )


def _principal_point(c: Intrinsics, limits: FindingLimits) -> Finding:
    size = np.array(c.table.image_size_px)
    away = c.fit.lens[2:4] - (size - 1) / 2
    share = float(np.max(np.abs(away) / size))
    sure = bool(np.any(np.abs(away) > 2 * c.sigmas[2:4] + limits.off_centre[0] * size))
    level = _level(share, limits.off_centre)
    return unless_pass(
        level,
        f"Principal point {away[0]:+.1f}, {away[1]:+.1f} px from the centre"
        f" (± {_two(c.sigmas[2])}, {_two(c.sigmas[3])}).",
        "A large offset indicates a cropped or shifted picture"
        + (" (the uncertainty does not explain it)." if sure else "; here the views hardly determine it."),
        "Check that the pictures are not cropped; photograph the board turned by 90 deg in its plane as well.",
        code="BP-L18",
    )


def _overfit(c: Intrinsics, limits: FindingLimits) -> Finding:
    ratio = c.held_out_rms_px / c.fit.sigma_px
    return unless_pass(
        _level(ratio, limits.overfit),
        f"Hold-out error: {_mm(c, c.held_out_rms_px)}, {ratio:.2f} times the corners' own noise.",
        "The lens is fitted to the noise of its own photographs.",
        _MORE[0].upper() + _MORE[1:] + ".",
        code="BP-L19",
    )


def _halves(c: Intrinsics, limits: FindingLimits) -> Finding:
    d = c.halves
    if d is None:
        return Finding(
            Level.WARN,
            "Half of the photographs do not determine the lens, so that two halves cannot be compared.",
            "Errors of the model, which the covariance does not contain, remain undetected.",
            _MORE[0].upper() + _MORE[1:] + ".",
            code="BP-L20",
        )
    return unless_pass(
        _disagreement(d, limits, limits.p_value),
        f"Two halves of the photographs differ by {d.rms_px:.3g} px ({_two(d.rms_mm)} mm at {c.distance_m:.3g} m), RMS"
        f" over the picture; {d.expected_rms_px:.3g} px are expected from their sigmas (p = {d.p_value:.2g}).",
        "A larger difference than expected means that the lens model, the board or the corners have errors that noise"
        " does not explain.",
        "Use a stiffer board, check its measures, take more and more varied photographs; if the photographs are from"
        " two cameras, or focus or zoom was changed, calibrate each set separately.",
        code="BP-L21",
    )


def _disagreement(d: Difference, limits: FindingLimits, p_value: float) -> Level:
    if d.p_value >= p_value:
        return Level.PASS
    return Level.FAIL if d.rms_px > limits.halves_px else Level.WARN


def _origins(c: Intrinsics, limits: FindingLimits) -> Finding | None:
    if c.origins is None:
        return None
    d, (first, second) = c.origins.difference, c.origins.names
    return unless_pass(
        _disagreement(d, limits, limits.origins_p_value),
        f"The photographs {first!r} and {second!r} give lenses that differ by {d.rms_px:.3g} px, RMS over the picture;"
        f" {d.expected_rms_px:.3g} px are expected from their sigmas (p = {d.p_value:.2g}).",
        "The photographs seem to be from two cameras, or focus or zoom was changed in between.",
        "Calibrate each set separately; fix focus and zoom before the first photograph.",
        code="BP-L22",
    )


def _scatter(c: Intrinsics) -> Finding:
    if c.correlated_noise == 1:
        return Finding(
            Level.PASS,
            f"The lens parameters scatter from photograph to photograph by {c.scatter.factor:.2f} times what the"
            f" corners' noise explains (p = {c.scatter.p_value:.2g}).",
        )
    return Finding(
        Level.WARN,
        f"The lens parameters scatter from photograph to photograph by {c.scatter.factor:.2f} times what the corners'"
        f" noise explains (p = {c.scatter.p_value:.1g}); the sigmas include it.",
        "Errors of the corners within one photograph are correlated: a board that bends, blur, glare, or a lens that"
        " no available model describes.",
        "Use a stiffer board, hold it still, and take more photographs.",
        code="BP-L23",
    )


def _map(c: Intrinsics, limits: FindingLimits) -> Finding:
    px, mm = c.map.sigma_px(c.covariance), c.map.sigma_mm(c.covariance)
    (half, most, worst), (half_mm, most_mm, worst_mm) = (np.nanquantile(m, [0.5, 0.9, 1.0]) for m in (px, mm))
    return unless_pass(
        _level(float(most), limits.map_px),
        f"The direction of a pixel is known to {_two(half)} px ({_two(half_mm)} mm at {c.distance_m:.3g} m) or better"
        f" in half of the picture, to {_two(most)} px ({_two(most_mm)} mm) in 90 %, and to {_two(worst)} px"
        f" ({_two(worst_mm)} mm) at the worst place (1 sigma).",
        "Every spot at such a place has this error, the same in all frames: averaging does not reduce it.",
        "Add photographs with the board where the uncertainty map is worst.",
        code="BP-L24",
    )


def _warp(c: Intrinsics, limits: FindingLimits) -> Finding | None:
    w = c.warp
    if w is None:
        return None
    text = f"The board is bent by {1000 * w.rise_m:.2f} mm (p = {w.p_value:.1g} for a flat board): {w.why}"
    if not w.corrected:
        change = f" Solving for it would change directions by {_two(w.change_px)} px RMS." if w.change_px else ""
        return Finding(Level.PASS, f"{text}; taken as flat.{change}")
    return unless_pass(
        Level.WARN if w.rise_m > limits.warp_m else Level.PASS,
        text + "; corrected.",
        "A board bent this much is no longer the smooth surface that the correction assumes, and may bend differently"
        " each time it is held.",
        "Glue it to glass or a thick plate.",
        code="BP-L25",
    )
