"""From peaks to spots: all steps after the search, and the criteria for a spot."""

from __future__ import annotations

from math import pi, sqrt
from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled, compiled_for_threads
from tracking.detection import ellipse
from tracking.detection.gaussian_fit import fit_all, least_variance
from tracking.detection.moments import (
    CENTRE_SHARE,
    at_half_height,
    compact_height,
    find_moments,
    light_ends,
    start_variance,
)
from tracking.detection.pixels import Noise, Pixels, pixel, texture_variance, with_texture
from tracking.detection.quality import light_beside
from tracking.detection.regions import NARROWER, drop_duplicates
from tracking.detection.table import SCRATCH, Candidate, Candidates, Peak, Peaks

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
_SATURATED = 0.97  # of the saturation: compression rounds a flat top
_LARGEST_CORE = 16  # px: half side of the square in which a saturated light is higher than half of its peak
_OUTGROWN = 4.0  # variance of the moments over that of the start above which they have left the light
# Most light around a compact light, relative to its height: anywhere, and in an even place. Around a grain of speckle
# there is more.
_CLEAR, _EVEN = 0.5, 0.25
_STEEPEST = 0.6065  # exp(-1/2): slope of a Gaussian at one sigma, in heights per sigma
_NARROWEST = 0.35  # px: width of a spot that the pixels do not resolve; with the pixel's own it is 0.45
_UNRESOLVED = 1.0  # px: of a wider fit the centre is known
_STRETCHED = 3.0  # px: beside an edge a fit that collapses across it becomes up to so long
_BESIDE = 3.0  # sigmas: least light of such a spot outside its two brightest pixels, which may be hot
_UNRESOLVED_GAIN = 2.0  # least decrease of its chi-square, relative to threshold^2: few pixels have longer tails
_WITHIN_PIXEL = 0.03  # px: error of the centre if the held width is a tenth of a pixel wrong
_IN_BACKGROUND = 6.0  # px: the background from the search, a median over 40 px, contains the light of a wider spot
_NOTHING = 1e12  # px^2: variance of the start of a candidate that has been joined to another one; the fit leaves it out
NARROW_PX = 1.0  # sigma: in wider spots the centre of a Gaussian does not depend on the place within a pixel
_FARTHEST = 0.5  # px: from the Gaussian's centre to that of the fit with wings


class Wings(NamedTuple):
    """The usual light of narrow spots, as in CANDIDATE."""

    near: float
    near_variance: float
    far: float
    uneven: float
    uu: float
    uv: float
    vv: float
    variance: float


class DetectionLimits(NamedTuple):
    """tracking.parameters.DetectParameters for compiled code."""

    threshold_sigma: float
    saturation: float  # DN
    min_sigma: float  # px
    max_sigma: float  # px
    min_explained: float
    wings: Wings  # of narrow spots


@compiled_for_threads
def measure(
    image: Pixels,
    peaks: Peaks,
    chosen: Ints,
    noise: Noise,
    limits: DetectionLimits,
    table: Candidates,
    cells: Array,
    algebra: Array,
) -> None:
    """Measure the chosen peaks (n,) and write the results into table (n,)."""
    for k in range(chosen.shape[0]):
        peak, spot = peaks[chosen[k]], table[k]
        spot["moment_u"], spot["moment_v"], spot["background"] = peak["u"], peak["v"], peak["level"]
        spot["wide"], spot["start"], spot["held"] = peak["wide"], start_variance(peak["scale"]), 0.0
        spot["texture"], spot["misfit"] = peak["contrast"], 0.0
        _set_wings(spot, Wings(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    find_moments(image, table, cells)
    least = _LEAST_GAIN * limits.threshold_sigma**2
    fit_all(image, table, noise, limits.saturation, limits.max_sigma, least, False, True, cells, algebra)
    for _ in range(_MERGES):
        if not _merge_parts(table):
            break
        fit_all(image, table, noise, limits.saturation, limits.max_sigma, least, True, True, cells, algebra)
    restarted = np.zeros(chosen.shape[0], np.bool_)
    if _start_again(image, peaks, chosen, table, limits, restarted):
        fit_all(image, table, noise, limits.saturation, limits.max_sigma, least, True, False, cells, algebra)
        _drop_background(table, restarted)
    if _hold_unresolved(peaks, chosen, table, limits):
        fit_all(image, table, noise, limits.saturation, limits.max_sigma, least, True, False, cells, algebra)
        _judge_unresolved(image, table, noise, limits)
    for k in range(chosen.shape[0]):
        spot = table[k]
        here = with_texture(noise, spot["texture"])
        accepted = _is_spot(image, spot, here, limits)
        if not (accepted and _is_as_wide(spot)):
            core = _is_core(image, peaks[chosen[k]], table[k : k + 1], here, limits, cells[SCRATCH])
            accepted = accepted or core
        accepted = accepted or _is_compact(image, spot, here, limits, _CLEAR, cells[SCRATCH])
        spot["accepted"] = 1.0 if accepted else 0.0
    drop_duplicates(table)
    if limits.wings.near > 0.0 or limits.wings.far > 0.0:
        _fit_wings(image, table, noise, limits, cells, algebra)


@compiled
def _set_wings(spot: Candidate, wings: Wings) -> None:
    spot["near_wing"], spot["near_variance"], spot["far_wing"] = wings.near, wings.near_variance, wings.far
    spot["uneven"], spot["usual_variance"] = wings.uneven, wings.variance
    spot["usual_uu"], spot["usual_uv"], spot["usual_vv"] = wings.uu, wings.uv, wings.vv


@compiled
def _fit_wings(
    image: Pixels, table: Candidates, noise: Noise, limits: DetectionLimits, cells: Array, algebra: Array
) -> None:
    """Fit the narrow spots again with the wings that they have in this camera; a Gaussian stays where that fails."""
    gaussian = table.copy()
    for k in range(table.shape[0]):
        spot = table[k]
        spot["active"] = 0.0
        det = spot["uu"] * spot["vv"] - spot["uv"] ** 2
        if not spot["accepted"] or np.isnan(spot["sigma_flux"]) or spot["cell_size"] > 1.0 or det > NARROW_PX**4:
            continue
        _set_wings(spot, limits.wings)
        spot["moment_u"], spot["moment_v"], spot["held"], spot["active"] = spot["u"], spot["v"], 0.0, 1.0
        spot["moment_uu"], spot["moment_uv"], spot["moment_vv"] = ellipse.clip_eigenvalues(
            spot["uu"], spot["uv"], spot["vv"], 2.0 * least_variance(spot), np.inf
        )
    fit_all(image, table, noise, limits.saturation, limits.max_sigma, 0.0, True, False, cells, algebra)
    for k in range(table.shape[0]):
        spot = table[k]
        if spot["near_wing"] + spot["far_wing"] <= 0.0:
            continue
        away = max(abs(spot["u"] - gaussian[k]["u"]), abs(spot["v"] - gaussian[k]["v"]))
        unsure = max(spot["var_u"], spot["var_v"]) > _FARTHEST**2
        if not spot["flux"] > 0.0 or not spot["peak"] > 0.0 or unsure or away > _FARTHEST:
            table[k] = gaussian[k]
        elif spot["uneven"] > 0.0:
            # What the shape leaves belongs to the place within the pixel, and is no noise.
            noise_share = (1.0 - gaussian[k]["misfit"]) * (gaussian[k]["var_u"] + gaussian[k]["var_v"])
            spot["misfit"] = max(spot["misfit"], 1.0 - noise_share / (spot["var_u"] + spot["var_v"]))


@compiled
def _start_again(
    image: Pixels,
    peaks: Peaks,
    chosen: Ints,
    table: Candidates,
    limits: DetectionLimits,
    restarted: Bools,
) -> bool:
    """Give candidates whose moments or fits left their light a start from the peak and its scale; whether there are.

    Marks them in restarted (n,). A saturated light starts from its pixels above half of its height.

    On a sloping or textured background the window of the moments grows over the light beside a faint spot, or the fit
    over that beside a saturated one, or it shrinks to a grain of the light; then it explains little.
    """
    found = False
    for k in range(table.shape[0]):
        spot, peak = table[k], peaks[chosen[k]]
        spot["active"] = 0.0
        start = max(spot["start"], _LEAST_START)
        poor = spot["explained"] < limits.min_explained
        major2 = ellipse.eigenvalues(spot["uu"], spot["uv"], spot["vv"])[1]
        poor = poor and (major2 > _OUTGROWN**2 * start or major2 * _OUTGROWN < spot["start"])
        if (spot["flux"] > 0.0 and not poor) or spot["moment_uu"] >= _NOTHING or peak["wide"]:
            continue
        away = max(abs(spot["moment_u"] - peak["u"]), abs(spot["moment_v"] - peak["v"]))
        high = ellipse.eigenvalues(spot["moment_uu"], spot["moment_uv"], spot["moment_vv"])[1]
        if not poor and away * away < start and high < _OUTGROWN * start:
            continue
        spot["moment_u"], spot["moment_v"] = peak["u"], peak["v"]
        spot["moment_uu"], spot["moment_uv"], spot["moment_vv"] = start, 0.0, start
        spot["flux"], spot["active"] = 2 * pi * start * peak["height"], 1.0
        if pixel(image, int(peak["u"]), int(peak["v"])) >= _SATURATED * limits.saturation:
            at_half_height(image, peak, _LARGEST_CORE, spot)
        restarted[k] = found = True
    return found


@compiled
def _drop_background(table: Candidates, restarted: Bools) -> None:
    """Reject restarted fits (n,) that follow the background: wider than the peak, or no maximum on the slope.

    The curvature of a wide reflection fits a faint wide spot. A spot is brighter than its surroundings on all sides.
    """
    for k in range(table.shape[0]):
        spot = table[k]
        if spot["flux"] <= 0.0 or not restarted[k]:
            continue
        det = spot["uu"] * spot["vv"] - spot["uv"] ** 2
        height = spot["flux"] / (2 * pi * sqrt(det))
        a, b = spot["slope_u"], spot["slope_v"]
        # Of the background over one sigma.
        rise = sqrt(a * a * spot["uu"] + 2 * a * b * spot["uv"] + b * b * spot["vv"])
        wide = ellipse.eigenvalues(spot["uu"], spot["uv"], spot["vv"])[1] > _OUTGROWN * spot["moment_uu"]
        if wide or height * _STEEPEST < rise:
            spot["flux"] = 0.0


@compiled
def _hold_unresolved(peaks: Peaks, chosen: Ints, table: Candidates, limits: DetectionLimits) -> bool:
    """Give fits that have collapsed a start with a width that is held; whether there are any.

    The width of a spot that is narrower than a pixel follows from the light in the neighbouring pixels alone. Noise, or
    a top that is flatter than a Gaussian's, makes it zero, and then its place within the pixel is unknown.
    """
    found = False
    for k in range(table.shape[0]):
        spot, peak = table[k], peaks[chosen[k]]
        spot["active"] = 0.0
        if spot["flux"] <= 0.0 or peak["wide"]:
            continue
        major, minor, _ = ellipse.axes(spot["uu"], spot["uv"], spot["vv"])
        sigma = sqrt(max(spot["var_u"], spot["var_v"], 0.0))
        stretched = minor < limits.min_sigma and major < _STRETCHED and peak["scale"] <= 1.0
        resolved = major > _UNRESOLVED or (minor >= limits.min_sigma and sigma < 0.5 * max(major, 0.5))
        if resolved and not stretched:
            continue
        spot["moment_u"], spot["moment_v"] = peak["u"], peak["v"]
        spot["moment_uu"], spot["moment_uv"], spot["moment_vv"] = _NARROWEST**2, 0.0, _NARROWEST**2
        spot["flux"], spot["active"], spot["held"] = 9.0 * peak["height"], 1.0, 1.0
        found = True
    return found


@compiled
def _judge_unresolved(image: Pixels, table: Candidates, noise: Noise, limits: DetectionLimits) -> None:
    """Reject fits with a held width that are weak or have no light beside two pixels; widen the others' covariance."""
    needed = _UNRESOLVED_GAIN * limits.threshold_sigma**2
    for k in range(table.shape[0]):
        spot = table[k]
        if not spot["held"] or spot["flux"] <= 0.0:
            continue
        spot["var_u"], spot["var_v"] = spot["var_u"] + _WITHIN_PIXEL**2, spot["var_v"] + _WITHIN_PIXEL**2
        if spot["gain"] < needed or light_beside(image, spot, noise, _NARROWEST) < _BESIDE:
            spot["flux"] = spot["uu"] = spot["uv"] = spot["vv"] = 0.0


@compiled
def _merge_parts(table: Candidates) -> bool:
    """Join fits that are parts of one light into one start of another fit, active; whether there are any.

    The sum of two equal Gaussians has two maxima only if they are more than two sigmas apart. Two fits that are nearer
    to each other and about equally wide were therefore not two lights, but speckle of one.
    """
    found = False
    for i in range(table.shape[0]):
        table[i]["active"] = 0.0
    for i in range(table.shape[0]):
        spot = table[i]
        for j in range(i + 1, table.shape[0]):
            other = table[j]
            if not (spot["flux"] > 0.0 and other["flux"] > 0.0):
                continue
            own = (spot["uu"] + 1 / 12) * (spot["vv"] + 1 / 12) - spot["uv"] ** 2
            its = (other["uu"] + 1 / 12) * (other["vv"] + 1 / 12) - other["uv"] ** 2
            du, dv = other["u"] - spot["u"], other["v"] - spot["v"]
            if min(own, its) < NARROWER**4 * max(own, its):
                continue
            uu, uv, vv = (
                0.5 * (spot["uu"] + other["uu"]),
                0.5 * (spot["uv"] + other["uv"]),
                0.5 * (spot["vv"] + other["vv"]),
            )
            if ellipse.mahalanobis(du, dv, uu + 1 / 12, uv, vv + 1 / 12) < _PART_APART:
                share = other["flux"] / (spot["flux"] + other["flux"])
                between = share * (1.0 - share)
                spot["moment_u"], spot["moment_v"] = spot["u"] + share * du, spot["v"] + share * dv
                spot["moment_uu"] = (1.0 - share) * spot["uu"] + share * other["uu"] + between * du * du
                spot["moment_uv"] = (1.0 - share) * spot["uv"] + share * other["uv"] + between * du * dv
                spot["moment_vv"] = (1.0 - share) * spot["vv"] + share * other["vv"] + between * dv * dv
                spot["u"], spot["v"] = spot["moment_u"], spot["moment_v"]
                spot["uu"], spot["uv"], spot["vv"] = spot["moment_uu"], spot["moment_uv"], spot["moment_vv"]
                spot["flux"], other["flux"] = spot["flux"] + other["flux"], 0.0
                other["moment_uu"], other["moment_uv"], other["moment_vv"] = _NOTHING, 0.0, _NOTHING
                spot["active"], other["active"] = 1.0, 0.0
                found = True
    return found


@compiled
def _is_spot(image: Pixels, spot: Candidate, noise: Noise, limits: DetectionLimits) -> bool:
    if not spot["flux"] > 0.0:
        return False
    major, minor, _ = ellipse.axes(spot["uu"], spot["uv"], spot["vv"])
    sigma_u, sigma_v = sqrt(max(spot["var_u"], 0.0)), sqrt(max(spot["var_v"], 0.0))
    amplitude = spot["flux"] / (2 * pi * (major * minor + 1 / 12))
    level = spot["background"]
    if major > _IN_BACKGROUND:
        level = min(level, max(spot["level"], 0.5 * level))
    structure = limits.threshold_sigma * sqrt(texture_variance(noise, level))
    needed = _SPOT_GAIN * limits.threshold_sigma**2 * max(spot["chi2"] / _CHI2, 1.0)
    # Texture around a faint spot is not a misfit of the spot if that is clearly higher than the grains.
    clear = amplitude > _ABOVE_GRAINS * structure and spot["gain"] > _CLEAR_GAIN * needed
    return (
        amplitude > structure
        and spot["gain"] > needed
        and spot["flux"] > _SPOT_FLUX * limits.threshold_sigma * spot["sigma_flux"]
        and spot["peak"] > 0.0
        and major <= limits.max_sigma
        and minor >= limits.min_sigma
        and (spot["explained"] >= limits.min_explained or (clear and spot["explained_here"] >= limits.min_explained))
        and max(sigma_u, sigma_v) < 0.5 * max(major, 0.5)
        and spot["u"] > -0.5 - 3 * sigma_u
        and spot["v"] > -0.5 - 3 * sigma_v
        and spot["u"] < image.width - 0.5 + 3 * sigma_u
        and spot["v"] < image.height - 0.5 + 3 * sigma_v
    )


@compiled
def _is_as_wide(spot: Candidate) -> bool:
    """Whether a fit is about as wide as the light from which it started."""
    major2 = ellipse.eigenvalues(spot["uu"], spot["uv"], spot["vv"])[1]
    return bool(major2 <= _OUTGROWN**2 * max(spot["start"], _LEAST_START))


@compiled
def _is_core(
    image: Pixels, peak: Peak, spot: Candidates, noise: Noise, limits: DetectionLimits, scratch: Array
) -> bool:
    """Whether the pixels above half of a peak are a compact light in an even place; if so, they fill its row.

    Over an edge beside a light the window of its moments grows, and a fit too: what it then describes is the edge.
    spot (1,): the candidate.
    """
    before, start = spot.copy(), max(spot[0]["start"], _LEAST_START)
    at_half_height(image, peak, _LARGEST_CORE, spot[0])
    wide2, found = 0.5 * (spot[0]["moment_uu"] + spot[0]["moment_vv"]), spot[0]["flux"] != before[0]["flux"]
    as_wide = not peak["wide"] and found and start < _OUTGROWN * wide2 and wide2 < _OUTGROWN * start
    compact = as_wide and _is_compact(image, spot[0], noise, limits, _EVEN, scratch)
    if compact and light_ends(image, spot[0], _EVEN * spot[0]["peak"], scratch):
        return True
    spot[0] = before[0]
    return False


@compiled
def _is_compact(
    image: Pixels, spot: Candidate, noise: Noise, limits: DetectionLimits, most: float, scratch: Array
) -> bool:
    """Whether a candidate that is not a Gaussian is a compact light; if so, its row is filled from the moments.

    most: as in `compact_height`.
    """
    uu, uv, vv = spot["moment_uu"], spot["moment_uv"], spot["moment_vv"]
    major, minor, _ = ellipse.axes(uu, uv, vv)
    # A candidate with a narrow fit is rejected: a hot pixel is compact and bright, too.
    narrow = min(minor, ellipse.axes(spot["uu"], spot["uv"], spot["vv"])[1]) < limits.min_sigma
    if narrow or major > limits.max_sigma:
        return False
    if spot["gain"] < limits.threshold_sigma**2:
        return False
    u, v = spot["moment_u"], spot["moment_v"]
    height = compact_height(image, u, v, (uu, uv, vv), noise, limits.threshold_sigma, most, scratch)
    if height <= 0.0:
        return False
    spot["u"], spot["v"], spot["uu"], spot["uv"], spot["vv"] = u, v, uu, uv, vv
    spot["flux"] = 2 * pi * sqrt(max(uu * vv - uv * uv, 0.0)) * height
    share = CENTRE_SHARE**2
    spot["var_u"], spot["cov_uv"], spot["var_v"] = share * uu + 0.01, share * uv, share * vv + 0.01
    spot["peak"], spot["sigma_flux"], spot["misfit"] = height, np.nan, 1.0
    return True
