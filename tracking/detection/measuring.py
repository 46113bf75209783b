"""From peaks to spots: all steps after the search, and what counts as a spot."""

from __future__ import annotations

from math import pi, sqrt
from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Ints
from geometry.compilation.jit import compiled, compiled_for_threads
from tracking.detection import candidates, ellipse
from tracking.detection.candidates import Noise, texture_variance
from tracking.detection.gaussian_fit import fit_all
from tracking.detection.moments import find_moments
from tracking.detection.pixels import Pixels
from tracking.detection.regions import in_a_region
from tracking.detection.saturated_spots import CENTRE_SHARE, height_of_compact
from tracking.detection.table import (
    ACTIVE,
    CHI2,
    COV_UV,
    EXPLAINED,
    FEW,
    FLUX,
    GAIN,
    GOOD,
    GROUND,
    MOMENT_U,
    MOMENT_UU,
    MOMENT_UV,
    MOMENT_V,
    MOMENT_VV,
    PEAK,
    SIGMA_FLUX,
    UU,
    UV,
    VAR_U,
    VAR_V,
    VV,
    WIDE,
    U,
    V,
)

AT_U, AT_V, LEVEL, WIDE_PEAK = candidates.AT_U, candidates.AT_V, candidates.LEVEL, candidates.WIDE
# Of threshold^2: by how much a spot lowers chi-square. The maximum of noise over places and shapes is higher than at
# one place: with 1.0 a picture of 1280x1024 has 0.04 false points, with 1.1 fewer than 0.01.
_SPOT_GAIN = 1.1
_CHI2 = 1.3  # per degree of freedom: where it is larger there is more noise, by so much, than the model says
_SPOT_FLUX = 0.5  # of the threshold: the flux in its own sigmas, which know of misfit; it goes together with the shape
_LEAST_GAIN = 0.7  # of what a spot must lower chi-square by: with less, the fit stops early
NARROWER = 0.5  # a spot narrower than so much of another one is not that one found again
_ONE_LIGHT = 1.5  # sigmas of a brighter spot: in its middle a second one is the same light


class DetectionLimits(NamedTuple):
    """tracking.parameters.DetectParameters for compiled code."""

    threshold_sigma: float
    saturation: float  # DN
    min_sigma: float  # px
    max_sigma: float  # px
    min_explained: float


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
    """Measure the chosen peaks (n,), into table (n, COLUMNS)."""
    for k in range(chosen.shape[0]):
        peak, spot = peaks[chosen[k]], table[k]
        spot[MOMENT_U], spot[MOMENT_V], spot[GROUND] = peak[AT_U], peak[AT_V], peak[LEVEL]
        spot[WIDE] = peak[WIDE_PEAK]
    find_moments(image, table, cells)
    least = _LEAST_GAIN * limits.threshold_sigma**2
    fit_all(image, table, noise, limits.saturation, limits.max_sigma, least, cells, algebra)
    for k in range(chosen.shape[0]):
        spot = table[k]
        spot[GOOD] = (
            1.0 if _is_spot(image, spot, noise, limits) or _is_compact(image, spot, noise, limits, cells[FEW]) else 0.0
        )
    _drop_doubles(table)


@compiled
def _is_spot(image: Pixels, spot: Array, noise: Noise, limits: DetectionLimits) -> bool:
    if not spot[FLUX] > 0.0:
        return False
    major, minor, _ = ellipse.axes(spot[UU], spot[UV], spot[VV])
    sigma_u, sigma_v = sqrt(max(spot[VAR_U], 0.0)), sqrt(max(spot[VAR_V], 0.0))
    amplitude = spot[FLUX] / (2 * pi * (major * minor + 1 / 12))
    return (
        amplitude > limits.threshold_sigma * sqrt(texture_variance(noise, spot[GROUND]))
        and spot[GAIN] > _SPOT_GAIN * limits.threshold_sigma**2 * max(spot[CHI2] / _CHI2, 1.0)
        and spot[FLUX] > _SPOT_FLUX * limits.threshold_sigma * spot[SIGMA_FLUX]
        and spot[PEAK] > 0.0
        and major <= limits.max_sigma
        and minor >= limits.min_sigma
        and spot[EXPLAINED] >= limits.min_explained
        and max(sigma_u, sigma_v) < 0.5 * max(major, 0.5)
        and spot[U] > -0.5 - 3 * sigma_u
        and spot[V] > -0.5 - 3 * sigma_v
        and spot[U] < image.width - 0.5 + 3 * sigma_u
        and spot[V] < image.height - 0.5 + 3 * sigma_v
    )


@compiled
def _is_compact(image: Pixels, spot: Array, noise: Noise, limits: DetectionLimits, few: Array) -> bool:
    """Whether a candidate that the fit does not explain is light all the same; then its row becomes the moments'."""
    uu, uv, vv = spot[MOMENT_UU], spot[MOMENT_UV], spot[MOMENT_VV]
    major, minor, _ = ellipse.axes(uu, uv, vv)
    # What the fit found to be narrow stays out: a hot pixel is compact and bright, too.
    narrow = min(minor, ellipse.axes(spot[UU], spot[UV], spot[VV])[1]) < limits.min_sigma
    if narrow or major > limits.max_sigma:
        return False
    if spot[GAIN] < limits.threshold_sigma**2:
        return False
    u, v = spot[MOMENT_U], spot[MOMENT_V]
    height = height_of_compact(image, u, v, (uu, uv, vv), noise, limits.threshold_sigma, few)
    if height <= 0.0:
        return False
    spot[U], spot[V], spot[UU], spot[UV], spot[VV] = u, v, uu, uv, vv
    spot[FLUX] = 2 * pi * sqrt(max(uu * vv - uv * uv, 0.0)) * height
    share = CENTRE_SHARE**2
    spot[VAR_U], spot[COV_UV], spot[VAR_V] = share * uu + 0.01, share * uv, share * vv + 0.01
    spot[PEAK], spot[SIGMA_FLUX] = height, np.nan
    return True


@compiled
def _brightest(table: Array) -> int:
    """The row with the most flux among those that are ACTIVE; -1: there is none."""
    best = -1
    for k in range(table.shape[0]):
        if table[k, ACTIVE] and (best < 0 or table[k, FLUX] > table[best, FLUX]):
            best = k
    return best


@compiled
def _drop_doubles(table: Array) -> None:
    """Drop spots in the middle of a brighter one of about their width: one light, found twice.

    Width matters: a laser spot on a wide diffuse reflection has less flux than that, and is no part of it.
    """
    for k in range(table.shape[0]):
        table[k, ACTIVE] = table[k, GOOD]
    i = _brightest(table)
    while i >= 0:
        spot = table[i]
        spot[ACTIVE] = 0.0
        uu, uv, vv = spot[UU] + 1 / 12, spot[UV], spot[VV] + 1 / 12
        area = uu * vv - uv * uv  # sigma^4, px^4
        for k in range(table.shape[0]):
            other = table[k]
            if other[ACTIVE]:
                du, dv = other[U] - spot[U], other[V] - spot[V]
                inside = vv * du * du - 2 * uv * du * dv + uu * dv * dv < _ONE_LIGHT**2 * area
                own = (other[UU] + 1 / 12) * (other[VV] + 1 / 12) - other[UV] ** 2
                if inside and own > NARROWER**4 * area:
                    other[GOOD] = other[ACTIVE] = 0.0
        i = _brightest(table)


@compiled
def write_out(table: Array, regions: Array, out: Array) -> int:
    """The spots that lie in a region (n, 3), brightest by flux first; returns how many.

    Columns of out (most, 10): u, v; cov uu, uv, vv; flux, peak, major, minor, angle.
    """
    for k in range(table.shape[0]):
        found = table[k, GOOD] and in_a_region(regions, table[k, U], table[k, V], 0.0)
        table[k, ACTIVE] = 1.0 if found else 0.0
    count = 0
    i = _brightest(table)
    while i >= 0:
        spot, row = table[i], out[count]
        spot[ACTIVE] = 0.0
        row[0], row[1], row[2], row[3] = spot[U], spot[V], spot[VAR_U], spot[COV_UV]
        row[4], row[5], row[6] = spot[VAR_V], spot[FLUX], spot[PEAK]
        row[7], row[8], row[9] = ellipse.axes(spot[UU], spot[UV], spot[VV])
        count += 1
        i = _brightest(table)
    return count
