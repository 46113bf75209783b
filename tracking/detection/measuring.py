"""From peaks to spots: all steps after the search, and the criteria for a spot."""

from __future__ import annotations

from math import pi, sqrt
from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled, compiled_for_threads
from tracking.detection import ellipse
from tracking.detection.candidates import AT_U, AT_V, CONTRAST, HEIGHT, LEVEL, SCALE
from tracking.detection.candidates import WIDE as WIDE_PEAK
from tracking.detection.gaussian_fit import fit_all, least_variance
from tracking.detection.moments import CENTRE_SHARE, compact_height, find_moments, start_variance
from tracking.detection.pixels import Noise, Pixels, texture_variance, with_texture
from tracking.detection.quality import light_beside
from tracking.detection.regions import NARROWER, drop_duplicates
from tracking.detection.table import (
    ACCEPTED,
    ACTIVE,
    BACKGROUND,
    CELL_SIZE,
    CHI2,
    COLUMNS,
    COV_UV,
    EXPLAINED,
    EXPLAINED_HERE,
    FAR_WING,
    FLUX,
    GAIN,
    HELD,
    MISFIT,
    MOMENT_U,
    MOMENT_UU,
    MOMENT_UV,
    MOMENT_V,
    MOMENT_VV,
    NEAR_WING,
    PEAK,
    SCRATCH,
    SIGMA_FLUX,
    SLOPE_U,
    SLOPE_V,
    START,
    TEXTURE,
    UNEVEN,
    UU,
    UV,
    VAR_U,
    VAR_V,
    VV,
    WIDE,
    U,
    V,
)
from tracking.detection.table import LEVEL as FITTED_LEVEL

# Least decrease of chi-square by a spot, relative to threshold^2. The maximum of noise over positions and shapes is
# higher than at one position: with 1.0 a picture of 1280x1024 has 0.04 false points, with 1.1 fewer than 0.01.
_SPOT_GAIN = 1.1
_CHI2 = 1.3  # chi-square per degree of freedom above which the noise is larger than in the model, by this ratio
_SPOT_FLUX = (
    0.5  # least flux in its own sigmas, relative to the threshold; lower, because flux and shape are correlated
)
_ABOVE_GRAINS, _CLEAR_GAIN = 1.5, 2.0  # relative to what is needed of any spot
_LEAST_GAIN = 0.7  # decrease of chi-square relative to threshold^2 below which the fit stops early
_PART_APART = 2.0  # sigmas: fits that are nearer to each other are parts of one light
_MERGES = 2  # times at most that parts are joined
_LEAST_START = 2.0  # px^2: least variance of that start
_OUTGROWN = 4.0  # variance of the moments over that of the start above which they have left the light
_STEEPEST = 0.6065  # exp(-1/2): slope of a Gaussian at one sigma, in heights per sigma
_NARROWEST = 0.35  # px: width of a spot that the pixels do not resolve; with the pixel's own it is 0.45
_UNRESOLVED = 1.0  # px: of a wider fit the centre is known
_BESIDE = 3.0  # sigmas: least light of such a spot outside its two brightest pixels, which may be hot
_UNRESOLVED_GAIN = 2.0  # least decrease of its chi-square, relative to threshold^2: few pixels have longer tails
_WITHIN_PIXEL = 0.03  # px: error of the centre if the held width is a tenth of a pixel wrong
_IN_BACKGROUND = 6.0  # px: the background from the search, a median over 40 px, contains the light of a wider spot
_NOTHING = 1e12  # px^2: variance of the start of a candidate that has been joined to another one; the fit leaves it out
NARROW_PX = 1.0  # sigma: in wider spots the centre of a Gaussian does not depend on the place within a pixel
_FARTHEST = 0.5  # px: from the Gaussian's centre to that of the fit with wings


class DetectionLimits(NamedTuple):
    """tracking.parameters.DetectParameters for compiled code."""

    threshold_sigma: float
    saturation: float  # DN
    min_sigma: float  # px
    max_sigma: float  # px
    min_explained: float
    profile: Array  # (n,) of narrow spots: columns NEAR_WING to USUAL_VARIANCE of the table


@compiled_for_threads
def measure(
    image: Pixels,
    peaks: Array,
    chosen: Ints,
    noise: Noise,
    limits: DetectionLimits,
    table: Array,
    cells: Array,
    algebra: Array,
) -> None:
    """Measure the chosen peaks (n,) and write the results into table (n, COLUMNS)."""
    for k in range(chosen.shape[0]):
        peak, spot = peaks[chosen[k]], table[k]
        spot[MOMENT_U], spot[MOMENT_V], spot[BACKGROUND] = peak[AT_U], peak[AT_V], peak[LEVEL]
        spot[WIDE], spot[START], spot[HELD] = peak[WIDE_PEAK], start_variance(peak[SCALE]), 0.0
        spot[TEXTURE], spot[MISFIT] = peak[CONTRAST], 0.0
        for p in range(limits.profile.shape[0]):
            spot[NEAR_WING + p] = 0.0
    find_moments(image, table, cells)
    least = _LEAST_GAIN * limits.threshold_sigma**2
    fit_all(image, table, noise, limits.saturation, limits.max_sigma, least, False, True, cells, algebra)
    for _ in range(_MERGES):
        if not _merge_parts(table):
            break
        fit_all(image, table, noise, limits.saturation, limits.max_sigma, least, True, True, cells, algebra)
    restarted = np.zeros(chosen.shape[0], np.bool_)
    if _start_again(peaks, chosen, table, limits, restarted):
        fit_all(image, table, noise, limits.saturation, limits.max_sigma, least, True, False, cells, algebra)
        _drop_background(table, restarted)
    if _hold_unresolved(peaks, chosen, table, limits):
        fit_all(image, table, noise, limits.saturation, limits.max_sigma, least, True, False, cells, algebra)
        _judge_unresolved(image, table, noise, limits)
    for k in range(chosen.shape[0]):
        spot = table[k]
        here = with_texture(noise, spot[TEXTURE])
        accepted = _is_spot(image, spot, here, limits) or _is_compact(image, spot, here, limits, cells[SCRATCH])
        spot[ACCEPTED] = 1.0 if accepted else 0.0
    drop_duplicates(table)
    if limits.profile[0] > 0.0 or limits.profile[FAR_WING - NEAR_WING] > 0.0:
        _fit_wings(image, table, noise, limits, cells, algebra)


@compiled
def _fit_wings(
    image: Pixels, table: Array, noise: Noise, limits: DetectionLimits, cells: Array, algebra: Array
) -> None:
    """Fit the narrow spots again with the wings that they have in this camera; a Gaussian stays where that fails."""
    gaussian = table.copy()
    for k in range(table.shape[0]):
        spot = table[k]
        spot[ACTIVE] = 0.0
        det = spot[UU] * spot[VV] - spot[UV] ** 2
        if not spot[ACCEPTED] or np.isnan(spot[SIGMA_FLUX]) or spot[CELL_SIZE] > 1.0 or det > NARROW_PX**4:
            continue
        for p in range(limits.profile.shape[0]):
            spot[NEAR_WING + p] = limits.profile[p]
        spot[MOMENT_U], spot[MOMENT_V], spot[HELD], spot[ACTIVE] = spot[U], spot[V], 0.0, 1.0
        spot[MOMENT_UU], spot[MOMENT_UV], spot[MOMENT_VV] = ellipse.clip_eigenvalues(
            spot[UU], spot[UV], spot[VV], 2.0 * least_variance(spot), np.inf
        )
    fit_all(image, table, noise, limits.saturation, limits.max_sigma, 0.0, True, False, cells, algebra)
    for k in range(table.shape[0]):
        spot = table[k]
        if spot[NEAR_WING] + spot[FAR_WING] <= 0.0:
            continue
        away = max(abs(spot[U] - gaussian[k, U]), abs(spot[V] - gaussian[k, V]))
        unsure = max(spot[VAR_U], spot[VAR_V]) > _FARTHEST**2
        if not spot[FLUX] > 0.0 or not spot[PEAK] > 0.0 or unsure or away > _FARTHEST:
            for column in range(COLUMNS):
                spot[column] = gaussian[k, column]
        elif spot[UNEVEN] > 0.0:
            # What the shape leaves belongs to the place within the pixel, and is no noise.
            noise_share = (1.0 - gaussian[k, MISFIT]) * (gaussian[k, VAR_U] + gaussian[k, VAR_V])
            spot[MISFIT] = max(spot[MISFIT], 1.0 - noise_share / (spot[VAR_U] + spot[VAR_V]))


@compiled
def _start_again(peaks: Array, chosen: Ints, table: Array, limits: DetectionLimits, restarted: Bools) -> bool:
    """Give candidates whose moments or fits left their light a start from the peak and its scale; whether there are.

    Marks them in restarted (n,).

    On a sloping or textured background the window of the moments grows over the light beside a faint spot, or the fit
    over that beside a saturated one, or it shrinks to a grain of the light; then it explains little.
    """
    found = False
    for k in range(table.shape[0]):
        spot, peak = table[k], peaks[chosen[k]]
        spot[ACTIVE] = 0.0
        start = max(spot[START], _LEAST_START)
        poor = spot[EXPLAINED] < limits.min_explained
        major2 = ellipse.eigenvalues(spot[UU], spot[UV], spot[VV])[1]
        poor = poor and (major2 > _OUTGROWN**2 * start or major2 * _OUTGROWN < spot[START])
        if (spot[FLUX] > 0.0 and not poor) or spot[MOMENT_UU] >= _NOTHING or peak[WIDE_PEAK]:
            continue
        away = max(abs(spot[MOMENT_U] - peak[AT_U]), abs(spot[MOMENT_V] - peak[AT_V]))
        high = ellipse.eigenvalues(spot[MOMENT_UU], spot[MOMENT_UV], spot[MOMENT_VV])[1]
        if not poor and away * away < start and high < _OUTGROWN * start:
            continue
        spot[MOMENT_U], spot[MOMENT_V] = peak[AT_U], peak[AT_V]
        spot[MOMENT_UU], spot[MOMENT_UV], spot[MOMENT_VV] = start, 0.0, start
        spot[FLUX], spot[ACTIVE] = 2 * pi * start * peak[HEIGHT], 1.0
        restarted[k] = found = True
    return found


@compiled
def _drop_background(table: Array, restarted: Bools) -> None:
    """Reject restarted fits (n,) that follow the background: wider than the peak, or no maximum on the slope.

    The curvature of a wide reflection fits a faint wide spot. A spot is brighter than its surroundings on all sides.
    """
    for k in range(table.shape[0]):
        spot = table[k]
        if spot[FLUX] <= 0.0 or not restarted[k]:
            continue
        det = spot[UU] * spot[VV] - spot[UV] ** 2
        height = spot[FLUX] / (2 * pi * sqrt(det))
        a, b = spot[SLOPE_U], spot[SLOPE_V]
        rise = sqrt(a * a * spot[UU] + 2 * a * b * spot[UV] + b * b * spot[VV])  # of the background over one sigma
        wide = ellipse.eigenvalues(spot[UU], spot[UV], spot[VV])[1] > _OUTGROWN * spot[MOMENT_UU]
        if wide or height * _STEEPEST < rise:
            spot[FLUX] = 0.0


@compiled
def _hold_unresolved(peaks: Array, chosen: Ints, table: Array, limits: DetectionLimits) -> bool:
    """Give fits that have collapsed a start with a width that is held; whether there are any.

    The width of a spot that is narrower than a pixel follows from the light in the neighbouring pixels alone. Noise, or
    a top that is flatter than a Gaussian's, makes it zero, and then its place within the pixel is unknown.
    """
    found = False
    for k in range(table.shape[0]):
        spot, peak = table[k], peaks[chosen[k]]
        spot[ACTIVE] = 0.0
        if spot[FLUX] <= 0.0 or peak[WIDE_PEAK]:
            continue
        major, minor, _ = ellipse.axes(spot[UU], spot[UV], spot[VV])
        sigma = sqrt(max(spot[VAR_U], spot[VAR_V], 0.0))
        if major > _UNRESOLVED or (minor >= limits.min_sigma and sigma < 0.5 * max(major, 0.5)):
            continue
        spot[MOMENT_U], spot[MOMENT_V] = peak[AT_U], peak[AT_V]
        spot[MOMENT_UU], spot[MOMENT_UV], spot[MOMENT_VV] = _NARROWEST**2, 0.0, _NARROWEST**2
        spot[FLUX], spot[ACTIVE], spot[HELD] = 9.0 * peak[HEIGHT], 1.0, 1.0
        found = True
    return found


@compiled
def _judge_unresolved(image: Pixels, table: Array, noise: Noise, limits: DetectionLimits) -> None:
    """Reject fits with a held width that are weak or have no light beside two pixels; widen the others' covariance."""
    needed = _UNRESOLVED_GAIN * limits.threshold_sigma**2
    for k in range(table.shape[0]):
        spot = table[k]
        if not spot[HELD] or spot[FLUX] <= 0.0:
            continue
        spot[VAR_U], spot[VAR_V] = spot[VAR_U] + _WITHIN_PIXEL**2, spot[VAR_V] + _WITHIN_PIXEL**2
        if spot[GAIN] < needed or light_beside(image, spot, noise, _NARROWEST) < _BESIDE:
            spot[FLUX] = spot[UU] = spot[UV] = spot[VV] = 0.0


@compiled
def _merge_parts(table: Array) -> bool:
    """Join fits that are parts of one light into one start of another fit, ACTIVE; whether there are any.

    The sum of two equal Gaussians has two maxima only if they are more than two sigmas apart. Two fits that are nearer
    to each other and about equally wide were therefore not two lights, but speckle of one.
    """
    found = False
    for i in range(table.shape[0]):
        table[i, ACTIVE] = 0.0
    for i in range(table.shape[0]):
        spot = table[i]
        for j in range(i + 1, table.shape[0]):
            other = table[j]
            if not (spot[FLUX] > 0.0 and other[FLUX] > 0.0):
                continue
            own = (spot[UU] + 1 / 12) * (spot[VV] + 1 / 12) - spot[UV] ** 2
            its = (other[UU] + 1 / 12) * (other[VV] + 1 / 12) - other[UV] ** 2
            du, dv = other[U] - spot[U], other[V] - spot[V]
            if min(own, its) < NARROWER**4 * max(own, its):
                continue
            uu, uv, vv = 0.5 * (spot[UU] + other[UU]), 0.5 * (spot[UV] + other[UV]), 0.5 * (spot[VV] + other[VV])
            if ellipse.mahalanobis(du, dv, uu + 1 / 12, uv, vv + 1 / 12) < _PART_APART:
                share = other[FLUX] / (spot[FLUX] + other[FLUX])
                between = share * (1.0 - share)
                spot[MOMENT_U], spot[MOMENT_V] = spot[U] + share * du, spot[V] + share * dv
                spot[MOMENT_UU] = (1.0 - share) * spot[UU] + share * other[UU] + between * du * du
                spot[MOMENT_UV] = (1.0 - share) * spot[UV] + share * other[UV] + between * du * dv
                spot[MOMENT_VV] = (1.0 - share) * spot[VV] + share * other[VV] + between * dv * dv
                spot[U], spot[V] = spot[MOMENT_U], spot[MOMENT_V]
                spot[UU], spot[UV], spot[VV] = spot[MOMENT_UU], spot[MOMENT_UV], spot[MOMENT_VV]
                spot[FLUX], other[FLUX] = spot[FLUX] + other[FLUX], 0.0
                other[MOMENT_UU], other[MOMENT_UV], other[MOMENT_VV] = _NOTHING, 0.0, _NOTHING
                spot[ACTIVE], other[ACTIVE] = 1.0, 0.0
                found = True
    return found


@compiled
def _is_spot(image: Pixels, spot: Array, noise: Noise, limits: DetectionLimits) -> bool:
    if not spot[FLUX] > 0.0:
        return False
    major, minor, _ = ellipse.axes(spot[UU], spot[UV], spot[VV])
    sigma_u, sigma_v = sqrt(max(spot[VAR_U], 0.0)), sqrt(max(spot[VAR_V], 0.0))
    amplitude = spot[FLUX] / (2 * pi * (major * minor + 1 / 12))
    level = spot[BACKGROUND]
    if major > _IN_BACKGROUND:
        level = min(level, max(spot[FITTED_LEVEL], 0.5 * level))
    structure = limits.threshold_sigma * sqrt(texture_variance(noise, level))
    needed = _SPOT_GAIN * limits.threshold_sigma**2 * max(spot[CHI2] / _CHI2, 1.0)
    # Texture around a faint spot is not a misfit of the spot if that is clearly higher than the grains.
    clear = amplitude > _ABOVE_GRAINS * structure and spot[GAIN] > _CLEAR_GAIN * needed
    return (
        amplitude > structure
        and spot[GAIN] > needed
        and spot[FLUX] > _SPOT_FLUX * limits.threshold_sigma * spot[SIGMA_FLUX]
        and spot[PEAK] > 0.0
        and major <= limits.max_sigma
        and minor >= limits.min_sigma
        and (spot[EXPLAINED] >= limits.min_explained or (clear and spot[EXPLAINED_HERE] >= limits.min_explained))
        and max(sigma_u, sigma_v) < 0.5 * max(major, 0.5)
        and spot[U] > -0.5 - 3 * sigma_u
        and spot[V] > -0.5 - 3 * sigma_v
        and spot[U] < image.width - 0.5 + 3 * sigma_u
        and spot[V] < image.height - 0.5 + 3 * sigma_v
    )


@compiled
def _is_compact(image: Pixels, spot: Array, noise: Noise, limits: DetectionLimits, scratch: Array) -> bool:
    """Whether a candidate that is not a Gaussian is a compact light; if so, its row is filled from the moments."""
    uu, uv, vv = spot[MOMENT_UU], spot[MOMENT_UV], spot[MOMENT_VV]
    major, minor, _ = ellipse.axes(uu, uv, vv)
    # A candidate with a narrow fit is rejected: a hot pixel is compact and bright, too.
    narrow = min(minor, ellipse.axes(spot[UU], spot[UV], spot[VV])[1]) < limits.min_sigma
    if narrow or major > limits.max_sigma:
        return False
    if spot[GAIN] < limits.threshold_sigma**2:
        return False
    u, v = spot[MOMENT_U], spot[MOMENT_V]
    height = compact_height(image, u, v, (uu, uv, vv), noise, limits.threshold_sigma, scratch)
    if height <= 0.0:
        return False
    spot[U], spot[V], spot[UU], spot[UV], spot[VV] = u, v, uu, uv, vv
    spot[FLUX] = 2 * pi * sqrt(max(uu * vv - uv * uv, 0.0)) * height
    share = CENTRE_SHARE**2
    spot[VAR_U], spot[COV_UV], spot[VAR_V] = share * uu + 0.01, share * uv, share * vv + 0.01
    spot[PEAK], spot[SIGMA_FLUX], spot[MISFIT] = height, np.nan, 1.0
    return True
