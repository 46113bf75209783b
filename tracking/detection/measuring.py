"""From peaks to spots: all steps after the search, and what counts as a spot."""

from __future__ import annotations

from math import pi, sqrt
from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Ints
from geometry.compiled import compiled
from tracking.detection import ellipse
from tracking.detection.candidates import Noise, Peaks
from tracking.detection.compact import CENTRE_SHARE, height_of_compact
from tracking.detection.gaussian_fit import Work, fit_all
from tracking.detection.moments import find_moments
from tracking.detection.normal_equations import FLUX, LEVEL, UU, UV, VV, U, V
from tracking.detection.pixels import Pixels
from tracking.detection.regions import in_a_region
from tracking.detection.quality import COLUMNS, COV_UV, EXPLAINED, GAIN, PEAK, SIGMA_FLUX, VAR_U, VAR_V

NARROWER = 0.5  # a spot narrower than so much of another one is not that one found again
_ONE_LIGHT = 1.5  # sigmas of a brighter spot: in its middle a second one is the same light


class Limits(NamedTuple):
    """tracking.parameters.DetectParameters for compiled code."""

    threshold_sigma: float
    saturation: float  # DN
    min_sigma: float  # px
    max_sigma: float  # px
    min_explained: float


class Found(NamedTuple):
    """Room for the measurement of candidates."""

    uv: Array  # (most, 2) px, of the moments
    level: Array  # (most,) DN
    wide: Ints  # (most,)
    shape: Array  # (most, 3) px^2, of the moments
    flux: Array  # (most,) DN, of the moments
    span: Ints  # (most,) px: largest cells used
    spots: Array  # (most, 9) of the fit
    quality: Array  # (most, COLUMNS)
    active: Ints  # (most,)
    start: Array  # (most, 3)
    good: Ints  # (most,)

    @staticmethod
    def of(most: int) -> Found:
        """Room for so many."""

        def whole() -> Ints:
            return np.zeros(most, np.int64)

        def room(columns: int) -> Array:
            return np.zeros((most, columns))

        return Found(
            room(2), np.zeros(most), whole(), room(3), np.zeros(most), whole(), room(9), room(COLUMNS), whole(), room(3),
            whole(),
        )  # fmt: skip


@compiled
def measure(
    image: Pixels, peaks: Peaks, chosen: Ints, noise: Noise, limits: Limits, found: Found, work: Work, few: Array
) -> None:
    """Measure the chosen peaks (n,): the first n rows of `found`; found.good is 1 where one is a spot."""
    n = chosen.shape[0]
    for k in range(n):
        i = chosen[k]
        found.uv[k, 0], found.uv[k, 1] = peaks.uv[i, 0], peaks.uv[i, 1]
        found.level[k], found.wide[k] = peaks.level[i], peaks.wide[i]
    uv, shape, flux, spots = found.uv[:n], found.shape[:n], found.flux[:n], found.spots[:n]
    find_moments(
        image, uv, found.level[:n], found.wide[:n], shape, flux, found.span[:n], work.cells.values, work.cells.state, few
    )
    for k in range(n):
        spots[k, U], spots[k, V], spots[k, UU], spots[k, UV] = uv[k, 0], uv[k, 1], shape[k, 0], shape[k, 1]
        spots[k, VV], spots[k, FLUX], spots[k, LEVEL] = shape[k, 2], max(flux[k], 1.0), found.level[k]
        spots[k, LEVEL + 1] = spots[k, LEVEL + 2] = 0.0
    fit_all(
        image, spots, noise, limits.saturation, limits.max_sigma, work, found.active[:n], found.start[:n],
        found.span[:n], found.quality[:n],
    )  # fmt: skip
    for k in range(n):
        found.good[k] = _is_spot(image, spots[k], found.quality[k], limits)
        if not found.good[k]:
            found.good[k] = _is_compact(image, found, k, noise, limits, few)
    _drop_doubles(spots, found.good, found.active, n)


@compiled
def _is_spot(image: Pixels, spot: Array, quality: Array, limits: Limits) -> bool:
    if not spot[FLUX] > 0.0:
        return False
    major, minor, _ = ellipse.axes(spot[UU], spot[UV], spot[VV])
    sigma_u, sigma_v = sqrt(max(quality[VAR_U], 0.0)), sqrt(max(quality[VAR_V], 0.0))
    return (
        quality[GAIN] > limits.threshold_sigma**2
        and quality[PEAK] > 0.0
        and major <= limits.max_sigma
        and minor >= limits.min_sigma
        and quality[EXPLAINED] >= limits.min_explained
        and max(sigma_u, sigma_v) < 0.5 * max(major, 0.5)
        and spot[U] > -0.5 - 3 * sigma_u
        and spot[V] > -0.5 - 3 * sigma_v
        and spot[U] < image.width - 0.5 + 3 * sigma_u
        and spot[V] < image.height - 0.5 + 3 * sigma_v
    )


@compiled
def _is_compact(image: Pixels, found: Found, k: int, noise: Noise, limits: Limits, few: Array) -> bool:
    """Whether a candidate that the fit does not explain is light all the same; then its row becomes the moments'."""
    spot, out = found.spots[k], found.quality[k]
    uu, uv, vv = found.shape[k, 0], found.shape[k, 1], found.shape[k, 2]
    major, minor, _ = ellipse.axes(uu, uv, vv)
    # What the fit found to be narrow stays out: a hot pixel is compact and bright, too.
    if minor < limits.min_sigma or major > limits.max_sigma:
        return False
    if ellipse.axes(spot[UU], spot[UV], spot[VV])[1] < limits.min_sigma:
        return False
    height = height_of_compact(
        image, found.uv[k, 0], found.uv[k, 1], (uu, uv, vv), noise, limits.threshold_sigma, few
    )
    if height <= 0.0:
        return False
    spot[U], spot[V], spot[UU], spot[UV], spot[VV] = found.uv[k, 0], found.uv[k, 1], uu, uv, vv
    spot[FLUX] = 2 * pi * sqrt(max(uu * vv - uv * uv, 0.0)) * height
    share = CENTRE_SHARE**2
    out[VAR_U], out[COV_UV], out[VAR_V], out[PEAK] = share * uu + 0.01, share * uv, share * vv + 0.01, height
    out[SIGMA_FLUX] = np.nan
    return True


@compiled
def _drop_doubles(spots: Array, good: Ints, done: Ints, n: int) -> None:
    """Drop spots in the middle of a brighter one of about their width: one light, found twice.

    Width matters: a laser spot on a wide diffuse reflection has less flux than that, and is no part of it.
    """
    for k in range(n):
        done[k] = 0 if good[k] else 1
    for _ in range(n):
        i = -1
        for k in range(n):
            if not done[k] and (i < 0 or spots[k, FLUX] > spots[i, FLUX]):
                i = k
        if i < 0:
            return
        done[i] = 1
        uu, uv, vv = spots[i, UU] + 1 / 12, spots[i, UV], spots[i, VV] + 1 / 12
        area = uu * vv - uv * uv  # sigma^4, px^4
        for k in range(n):
            if done[k]:
                continue
            du, dv = spots[k, U] - spots[i, U], spots[k, V] - spots[i, V]
            inside = vv * du * du - 2 * uv * du * dv + uu * dv * dv < _ONE_LIGHT**2 * area
            own = (spots[k, UU] + 1 / 12) * (spots[k, VV] + 1 / 12) - spots[k, UV] ** 2
            if inside and own > NARROWER**4 * area:
                good[k], done[k] = 0, 1


@compiled
def write_out(found: Found, n: int, regions: Array, out: Array) -> int:
    """The spots among the first n candidates that lie in a region, brightest by flux first; returns how many.

    Columns of out (most, 10): u, v; cov uu, uv, vv; flux, peak, major, minor, angle.
    """
    count = 0
    for k in range(n):
        found.active[k] = found.good[k] and in_a_region(regions, found.spots[k, U], found.spots[k, V], 0.0)
    while count < n:
        i = -1
        for k in range(n):
            if found.active[k] and (i < 0 or found.spots[k, FLUX] > found.spots[i, FLUX]):
                i = k
        if i < 0:
            break
        found.active[i] = 0
        spot, quality, row = found.spots[i], found.quality[i], out[count]
        row[0], row[1], row[2], row[3] = spot[U], spot[V], quality[VAR_U], quality[COV_UV]
        row[4], row[5], row[6] = quality[VAR_V], spot[FLUX], quality[PEAK]
        row[7], row[8], row[9] = ellipse.axes(spot[UU], spot[UV], spot[VV])
        count += 1
    return count
