"""The rim of a drogue in a picture: its edge points, and the circle fitted to them."""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace
from math import erf

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import MEDIAN_TO_SIGMA, NORMAL_MEDIAN, Array, Bools, symmetric, upper_median
from tracking.drogue_circle.detectors import CircleCandidate, Window, crop_bounds
from tracking.noise import Picture

# Edge points of a rim with sub-pixel precision: the maximum of the slope along the gradient of a circle, on rays.

_STEP_PX = 0.5  # sampling along a ray
_LEAST_RAYS, _MOST_RAYS = 40, 256  # one per pixel of the circumference between these
_OBLIQUE = 0.6  # largest tangential slope, as a share of the radial one: the edge crosses the rim at up to 31 degrees
_MOST_BLUR = 1.2  # of the half width of the rays: a wider edge has no known height
_LEAST_SLOPE = 3.0  # standard deviations of the slope's noise
# Slopes beside the rim: over so many radii, at most so many px, from the rays' ends; averaged over so much of the rim.
_BESIDE, _BESIDE_PX, _ALONG_PX = 0.3, 3.0, 5.0
# Share of the median slope of the rim: a part of a side that is steeper, less the mean, is another edge.
_ANOTHER_PART = 0.3
_LEAST_COMMON_PX = 0.03  # a smaller common shift of all edges is not fitted
CORRELATED_PX = 3.5  # length of rim over which the filter's noise is correlated


@dataclass(frozen=True, slots=True)
class Rim:
    """A closed curve r(theta) about a centre: a circle and the first-order term of an ellipse."""

    u_px: float
    v_px: float
    radius_px: float
    cos2_px: float = 0.0  # r(theta) = radius + cos2 cos(2 theta) + sin2 sin(2 theta)
    sin2_px: float = 0.0

    def radius_at(self, theta: Array) -> Array:
        """Distance (n,) of the curve from the centre, px, in the directions theta (n,), rad from +u towards +v."""
        if not (self.cos2_px or self.sin2_px):
            return np.full(theta.shape, self.radius_px)
        return self.radius_px + self.cos2_px * np.cos(2 * theta) + self.sin2_px * np.sin(2 * theta)


@dataclass(frozen=True, slots=True)
class RimPoints:
    """The edge on each of n rays at equal angles."""

    about: Rim  # whose centre the rays start at
    theta: Array  # (n,) rad
    radius_px: Array  # (n,) distance from the centre; nan where no edge is found
    slope: Array  # (n,) DN/px along the ray, positive in the direction of the polarity; nan there, too
    any_radius_px: Array  # (n,) as radius_px, but also in hidden sectors
    spacing_px: float  # between neighbouring rays at the rim
    blur_px: float = 0.0  # sigma of the blurred edge
    common_px: float = 0.0  # shift of all edges by a slope inside the target, whose size is not known; 0: none
    noise_px: float = 0.0  # error of the usual edge by the noise of the picture
    beside_gap: Bools | None = None  # (n,) edges that fit, but are left out since an occluder may end next to them

    @property
    def precision(self) -> Array:
        """(n,) error of the usual edge over that of each, nan without one: noise and texture move it by 1 / slope."""
        return self.slope / upper_median(self.slope[np.isfinite(self.slope)])


@dataclass(frozen=True, slots=True)
class SmoothCrop:
    """A part of the picture after a Gaussian filter, with its place and the noise of a pixel."""

    values: NDArray[np.float32]  # (h, w) DN
    left: int
    top: int
    noise_dn: float  # 1 sigma of the filtered values
    blur_px: float


def smooth_crop(picture: Picture, window: Window, blur_px: float) -> SmoothCrop:
    """The part of a picture in a window, filtered by a Gaussian."""
    top, bottom, left, right = crop_bounds(picture.shape, window)
    raw = picture[top:bottom, left:right].astype(np.float32)
    if min(raw.shape) < 5:
        return SmoothCrop(np.zeros((0, 0), np.float32), left, top, 0.0, blur_px)
    # Noise: median of the second difference along rows, which cancels gradients (Immerkaer 1996, one dimension).
    second = np.abs(raw[::2, 2:] - 2 * raw[::2, 1:-1] + raw[::2, :-2])
    noise = max(upper_median(second) / NORMAL_MEDIAN / np.sqrt(6.0), 0.3)
    filtered = noise / (2 * np.sqrt(np.pi) * blur_px)  # white noise behind a Gaussian filter
    smooth = np.asarray(cv2.GaussianBlur(raw, (0, 0), blur_px), np.float32)
    return SmoothCrop(smooth, left, top, float(filtered), blur_px)


def rim_points(crop: SmoothCrop, rim: Rim, half_px: float, polarity: int, hidden: Bools | None = None) -> RimPoints:
    """The best edge on each ray within +- half_px of a rim.

    polarity: +1 brighter outside, -1 brighter inside. hidden: sectors (k,) of equal angles without edges of the rim.
    Maxima near the rim are preferred (Gaussian weight of half_px).
    """
    n = int(np.clip(round(2 * np.pi * rim.radius_px), _LEAST_RAYS, _MOST_RAYS))
    theta = 2 * np.pi * np.arange(n) / n
    spacing = 2 * np.pi * rim.radius_px / n
    none = np.full(n, np.nan)
    height, width = crop.values.shape
    if not height:
        return RimPoints(rim, theta, none, none, none, spacing)
    offset = np.arange(-half_px - _STEP_PX, half_px + 1.5 * _STEP_PX, _STEP_PX)
    base = rim.radius_at(theta)
    distance = base[:, None] + offset
    x = (rim.u_px - crop.left + distance * np.cos(theta)[:, None]).astype(np.float32)
    y = (rim.v_px - crop.top + distance * np.sin(theta)[:, None]).astype(np.float32)
    inside = np.all((x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1), axis=1)
    values = cv2.remap(crop.values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    slope = (polarity / (2 * _STEP_PX)) * (values[:, 2:] - values[:, :-2])  # at offset[1:-1]
    across = (np.roll(values, -1, axis=0) - np.roll(values, 1, axis=0))[:, 1:-1] / (2 * spacing)
    middle = slope[:, 1:-1]
    peak = (middle >= slope[:, :-2]) & (middle > slope[:, 2:]) & (np.abs(across[:, 1:-1]) < _OBLIQUE * middle)
    least = _LEAST_SLOPE * crop.noise_dn / (np.sqrt(2) * crop.blur_px)  # sigma of the slope of filtered white noise
    weight = np.exp(-0.5 * (offset[2:-2] / half_px) ** 2)
    score = np.where(peak & (middle > least), middle * weight, 0.0)
    best = np.argmax(score, axis=1)
    rows = np.arange(n)
    strength = middle[rows, best]
    good = inside & (score[rows, best] > 0)
    a, b, c = slope[rows, best], strength, slope[rows, best + 2]
    bend = np.where(good, a - 2 * b + c, -1.0)
    vertex = np.clip(0.5 * (a - c) / np.minimum(bend, -1e-12), -0.5, 0.5)  # of a parabola through three slopes
    radius = base + offset[2:-2][best] + _STEP_PX * vertex
    # Blur moves the steepest place of a curved edge inwards by sigma^2 / (2 r) (Bouma et al. 2005).
    height_dn = polarity * (values[:, -1] - values[:, 0])[good]
    sigma = _edge_width(height_dn / strength[good], float(offset[-1]), crop.blur_px) if good.any() else crop.blur_px
    shift = sigma**2 / (2 * max(rim.radius_px, 1.0))
    radius = np.where(good, radius + shift, np.nan)
    strength = np.where(good, strength, np.nan)
    common = 0.0
    if good.any() and half_px == _PASSES[-1][0]:  # the passes before need no such precision
        height = np.sqrt(2 * np.pi) * sigma * strength
        half, width = float(offset[-1]), np.sqrt(sigma**2 - _STEP_PX**2 / 3)  # without the difference of the slopes
        step = upper_median(height[good])
        tail = 0.5 * step * (1 - erf(half / (np.sqrt(2) * width)))
        density = step / (np.sqrt(2 * np.pi) * width) * np.exp(-0.5 * (half / width) ** 2)
        # Without what the blurred step still rises at the ends, of an edge that is not in the middle between them.
        moved = np.where(good, radius - shift - base, 0.0)[:, None]
        rises = density * moved * (1 + np.array([-0.5, 0.5]) * moved * half / width**2)
        ends = polarity * values[:, [0, -1]] + [-tail, tail] + rises
        away, inner = _beside(crop, rim, theta, polarity, ends, strength)
        radius -= sigma**2 * away / height
        common = abs(sigma**2 * inner / upper_median(height[good]))
        common = common if common > _LEAST_COMMON_PX else 0.0
    # The second derivative of filtered white noise over the third one of the edge at its steepest place.
    noise = np.sqrt(0.75) * crop.noise_dn / crop.blur_px**2 * sigma**2
    noise = noise / upper_median(strength[good]) if good.any() else 0.0
    own = True if hidden is None else ~hidden[(rows * len(hidden)) // n]
    seen, slopes = np.where(own, radius, np.nan), np.where(own, strength, np.nan)
    return RimPoints(rim, theta, seen, slopes, radius, spacing, sigma, common, noise)


def _beside(
    crop: SmoothCrop, rim: Rim, theta: Array, polarity: int, ends_dn: Array, slope: Array
) -> tuple[Array, float]:
    """Slope outside the rays less that inside (n,), DN/px, the latter as a difference to its mean; and that mean.

    A step of height A between slopes a and b, blurred by sigma, is steepest at (b - a) sigma^2 / A from the step:
    before clouds that moves a side of the rim, or all of it. Inside, a mean slope may also be another edge of the
    target. Source: ours; the derivative of the blurred profile is zero there.
    ends_dn: (n, 2) grey values at the rays' inner and outer end, half a step beyond the last pass's half width.
    slope: (n,) DN/px, of the edges; nan without one.
    """
    good = np.isfinite(slope)
    steep = upper_median(slope[good])
    length = min(_BESIDE_PX, _BESIDE * rim.radius_px)
    distance = rim.radius_at(theta)[:, None] + (_PASSES[-1][0] + _STEP_PX + length) * np.array([-1.0, 1.0])
    x = (rim.u_px - crop.left + distance * np.cos(theta)[:, None]).astype(np.float32)
    y = (rim.v_px - crop.top + distance * np.sin(theta)[:, None]).astype(np.float32)
    far = polarity * cv2.remap(crop.values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    slopes = (ends_dn - far) * [1.0, -1.0] / length
    wide = 2 * round(_ALONG_PX * len(theta) / (4 * np.pi * max(rim.radius_px, 1.0))) + 1
    means = np.mean(slopes[good], axis=0)
    edge = np.abs(slopes - means) > _ANOTHER_PART * steep
    mean = _along_rim(np.concatenate([slopes - means * [1.0, 0.0], edge], axis=1), wide)
    away = np.where(mean[:, 2:] > 0, 0.0, mean[:, :2])
    # A Wiener filter: what is mostly noise is left out. The median of a squared normal error is .455 of its variance.
    noise = 0.455 * 2 * (crop.noise_dn / length) ** 2 * min(CORRELATED_PX / _ALONG_PX, 1.0)
    away *= np.maximum(1 - noise / np.maximum(np.median(away[good] ** 2, axis=0), 1e-12), 0.0)
    return away[:, 1] - away[:, 0], float(means[0])


def _along_rim(values: Array | Bools, count: int) -> Array:
    """Means of values (n, k) of the rays over `count` neighbours around the rim."""
    n = len(values)
    return np.asarray(cv2.blur(np.tile(values, (3, 1)).astype(np.float32), (1, count))[n : 2 * n], float)


def _edge_width(ratios_px: Array, half_px: float, least_px: float) -> float:
    """Sigma of a blurred step, px, from its height within +- half_px over its largest slope, on n rays.

    The height is A erf(half / (sqrt(2) sigma)) and the slope A / (sqrt(2 pi) sigma); least_px: the filter's own sigma.
    """
    ratio = upper_median(ratios_px) / np.sqrt(2 * np.pi)
    sigma = max(ratio, least_px)
    for _ in range(4):
        sigma = float(np.clip(ratio / erf(half_px / (np.sqrt(2) * sigma)), least_px, _MOST_BLUR * half_px))
    return sigma


# Robust geometric fit of a circle, or of a slightly oblique one, to the edge points of a rim, with covariance.


_TUKEY = 4.685  # Tukey's biweight, 95 % efficiency for normal errors
_LEAST_SIGMA_PX = 0.02  # of an edge point: interpolation, and pixels that are not points
_MODEL_SIGMA_PX = 0.005  # of the fit: rims are not exact circles
# Length of rim with one period of the errors that show the power of one turn, and least number of these in the rim. Of
# 800 circles of four kinds NEES / 2 is 1.08, 1.02 and .99 with 30, 40 and 50 px.
_PERIOD_PX, _LEAST_PERIODS = 40.0, 4.0
_SAME_FOR_ALL = np.linspace(0.0, 1.0, 11)  # shares of the variance of the usual edge that no slope changes
_BLUR_SIGMA = 0.5  # 1 sigma of the correction for blur, as a share of it
_ELLIPSE_COVERAGE = 0.7  # share of the rim that determines an ellipse
_ELLIPSE_F = 8.0  # F value of its two parameters, above which they are kept
_ELLIPSE_LEFT = 0.95  # of the squares of the residuals: with more, that value is not reached with any number of points
_LEAST_DETERMINANT = 1e-6  # of the normalised normal matrix: see `_solved`
_ON_RIM_PX = 0.5  # least distance from the rim at which an edge counts as on it
SECTORS = 32  # parts of a rim whose visibility is stated
_GAP_SIGMAS, _END_SIGMAS = 1.0, 3.5  # half length of a gap of the rim, and of its ends, in sigmas of the blurred edge
_FAR_PX = 0.15  # a last pass that moves the rim by more is repeated: edges depend on where their rays begin and end
_ENOUGH_PX = 0.3  # a pass that moves the rim by less is not repeated
_PASSES = ((4.0, 2.0), (2.5, 1.0), (2.0, 0.0))  # half width of the rays and least scale of the residuals, px


@dataclass(frozen=True, slots=True)
class RimFit:
    """A circle fitted to the rim."""

    rim: Rim
    covariance_px2: Array  # (3, 3) of u, v, radius
    coverage: float  # share of the whole rim with edge points that fit
    rms_px: float  # of these points
    beside_gaps: float  # share of the whole rim with such points that the fit leaves out, since they are next to gaps
    polarity: int
    score: float  # coverage, reduced by residuals
    sectors: Array  # (SECTORS,) share of the rays of a sector whose edge lies on the rim, hidden ones too
    # Share of the covariance that is not the picture's noise: texture and background move rims of the next ones alike.
    lasting: float = 0.0

    @property
    def centre_and_radius(self) -> Array:
        """(3,) u, v, radius, px."""
        return np.array([self.rim.u_px, self.rim.v_px, self.rim.radius_px])

    def is_equal(self, other: RimFit) -> bool:
        """Whether two fits are the same circle, to a twentieth of a pixel."""
        away = np.abs(self.centre_and_radius - other.centre_and_radius)
        return bool(self.polarity == other.polarity and away.max() < 0.05)


def fit_rim(
    crop: SmoothCrop, coarse: CircleCandidate, min_coverage: float, hidden: Bools | None = None, sure: bool = False
) -> RimFit | None:
    """Fit a coarse circle to the rim near it. None: too little of a rim is there.

    A candidate of unknown polarity is fitted with both, and the better one is returned. hidden: sectors (k,) of equal
    angles, from +u towards +v, whose edges belong to an occluder. sure: the coarse circle is accurate to a pixel,
    so that the wider passes are left out.
    """
    if coarse.polarity == 0:
        both = [fit_rim(crop, replace(coarse, polarity=p), min_coverage, hidden) for p in (1, -1)]
        return max((f for f in both if f is not None), key=lambda f: f.score, default=None)
    rim = Rim(coarse.u_px, coarse.v_px, coarse.radius_px)
    least = 0.7 * min_coverage
    for half_px, scale_px in () if sure else _PASSES[:-1]:
        points = rim_points(crop, rim, min(half_px, 0.4 * rim.radius_px), coarse.polarity, hidden)
        fitted = _solve(points, scale_px, oblique=False)
        if fitted is None or np.mean(fitted[1] > 0) < least or not _is_near(fitted[0], coarse):
            return None
        moved = np.hypot(fitted[0].u_px - rim.u_px, fitted[0].v_px - rim.v_px)
        rim = fitted[0]
        if moved < _ENOUGH_PX:
            break
    points = rim_points(crop, rim, _PASSES[-1][0], coarse.polarity, hidden)
    circle = _solve(points, 0.0, oblique=False)
    if circle is not None and np.abs(np.subtract(astuple(circle[0])[:3], astuple(rim)[:3])).max() > _FAR_PX:
        rim = circle[0]
        points = rim_points(crop, rim, _PASSES[-1][0], coarse.polarity, hidden)
        circle = _solve(points, 0.0, oblique=False)
    if circle is None:
        return None
    solved = _oblique_fit(crop, circle, points, coarse.polarity, hidden)
    rim, points, weight = solved or _without_ends(points, circle, oblique=False)
    return _described(rim, points, weight, coarse, min_coverage)


def _is_near(rim: Rim, coarse: CircleCandidate) -> bool:
    moved = float(np.hypot(rim.u_px - coarse.u_px, rim.v_px - coarse.v_px))
    return moved < max(6.0, 0.3 * coarse.radius_px) and abs(rim.radius_px / coarse.radius_px - 1) < 0.35


def _design(points: RimPoints, oblique: bool) -> Array:
    """Derivatives (n, 3 to 6) of the edges along the rays by u, v, radius, cos2 and sin2, and by the common shift.

    A common slope inside the target moves an edge by the inverse of its own height, more than the mean radius. Heights
    are means over a sixteenth of the rim: their own noise would determine the shift too well, and as too small.
    """
    theta, slope = points.theta, points.slope
    columns = [np.cos(theta), np.sin(theta), np.ones_like(theta)]
    columns += [np.cos(2 * theta), np.sin(2 * theta)] if oblique else []
    if points.common_px:
        seen = np.isfinite(slope)
        mean = _along_rim(np.stack([np.where(seen, slope, 0.0), seen], axis=1), len(theta) // 16)
        mean = np.where(seen, mean[:, 0] / np.maximum(mean[:, 1], 1e-6), np.nan)
        columns += [np.nanmean(mean) / mean - 1]
    return np.stack(columns, axis=-1)


def _prior(points: RimPoints, sigma_px: float, count: int) -> Array:
    """Information (count, count) before the fit, over that of a point of sigma_px: the size of the common shift."""
    out = np.zeros((count, count))
    if points.common_px:
        out[-1, -1] = (sigma_px / points.common_px) ** 2
    return out


def _solve(points: RimPoints, least_scale_px: float, oblique: bool) -> tuple[Rim, Array] | None:
    """Iteratively reweighted least squares with Tukey's weights. Returns the rim and the weights (n,) of the points.

    The points are distances from the old centre along rays; to first order the shift of the centre is linear in them,
    and the second-order term, the square of the tangential shift over twice the radius, is subtracted.
    """
    found, rim = np.flatnonzero(np.isfinite(points.radius_px)), points.about
    A = _design(points, oblique)[found]
    count = A.shape[1]
    if len(found) < 3 * count:
        return None
    cosine, sine = A[:, 0], A[:, 1]
    observed = points.radius_px[found]
    start = np.array([0.0, 0.0, rim.radius_px, rim.cos2_px, rim.sin2_px])[: 5 if oblique else 3]
    start = np.append(start, np.zeros(count - len(start)))
    if not oblique:  # a robust start: median radius
        start[2] = rim.radius_px + float(np.clip(np.median(observed - rim.radius_px), -2.0, 2.0))
    x, weight = start, np.ones(len(found))
    for _ in range(12):
        bend = (x[0] * sine - x[1] * cosine) ** 2 / (2 * max(x[2], 1.0))
        residual = observed - A @ x + bend
        scale = max(MEDIAN_TO_SIGMA * upper_median(np.abs(residual)), least_scale_px / _TUKEY, _LEAST_SIGMA_PX)
        weight = np.maximum(1 - (residual / (_TUKEY * scale)) ** 2, 0.0) ** 2
        prior = _prior(points, scale, count)
        normal = (A * weight[:, None]).T @ A + prior
        # The columns have entries of the size of 1: a small determinant means an arc too short for the parameters.
        if np.linalg.det(normal) < _LEAST_DETERMINANT * max(float(weight.sum()), 1e-9) ** count:
            return None
        step = np.linalg.solve(normal, A.T @ (weight * residual) - prior @ x)
        x = x + step
        if np.abs(step).max() < (1e-3 if least_scale_px == 0 else 0.03):
            break
    if not 1.0 < x[2] < 2 * rim.radius_px:
        return None
    full = np.zeros(len(points.theta))
    full[found] = weight
    return Rim(rim.u_px + float(x[0]), rim.v_px + float(x[1]), *map(float, x[2 : 5 if oblique else 3])), full


def _without_ends(points: RimPoints, fitted: tuple[Rim, Array], oblique: bool) -> tuple[Rim, RimPoints, Array]:
    """A fit without the edges next to gaps of the rim, if it is possible; with its points and weights.

    The blurred corner of rim and occluder moves the edges near it, to one side: within 1 sigma of blur by .3 px, and
    still at 3 sigma by .1 px (rings of 20 to 45 px, a fifth hidden by a plate).
    """
    gap, reach = (max(round(k * points.blur_px / points.spacing_px), 1) for k in (_GAP_SIGMAS, _END_SIGMAS))
    missing = _along_rim((fitted[1] == 0)[:, None], 2 * gap + 1) > 0.99
    near = _along_rim(missing, 2 * (gap + reach) + 1)[:, 0] > 0
    own = near & (fitted[1] > 0)
    if own.any():
        trimmed = replace(points, radius_px=np.where(near, np.nan, points.radius_px), beside_gap=own)
        again = _solve(trimmed, 0.0, oblique)
        if again is not None:
            return again[0], trimmed, again[1]
    return fitted[0], points, fitted[1]


def _oblique_fit(
    crop: SmoothCrop, circle: tuple[Rim, Array], points: RimPoints, polarity: int, hidden: Bools | None
) -> tuple[Rim, RimPoints, Array] | None:
    """The fit with the two parameters of an ellipse, if they explain the residuals better than chance does."""
    before = _sum_of_squares(circle[0], points, circle[1])
    once = _solve(points, 1.0, oblique=True)
    if once is None or np.hypot(once[0].cos2_px, once[0].sin2_px) > 0.25 * circle[0].radius_px:
        return None
    if _sum_of_squares(once[0], points, circle[1]) > _ELLIPSE_LEFT * before:
        return None
    again = rim_points(crop, once[0], 2.0, polarity, hidden)
    final = _solve(again, 0.0, oblique=True)
    if final is None or np.mean(final[1] > 0) < _ELLIPSE_COVERAGE:
        return None
    together = max(CORRELATED_PX / max(again.spacing_px, 0.3), 1.0)  # points with one error
    independent = max(float(np.count_nonzero(final[1])) / together - 5, 1.0)
    gained = before / max(_sum_of_squares(final[0], again, final[1]), 1e-12) - 1
    return _without_ends(again, final, oblique=True) if 0.5 * gained * independent > _ELLIPSE_F else None


def _sum_of_squares(rim: Rim, points: RimPoints, weight: Array | Bools) -> float:
    """Mean square of the residuals of the points with weight, px^2."""
    away = _residuals(rim, points)[weight > 0]
    return float(np.mean(away**2)) if away.size else np.inf


def _residuals(rim: Rim, points: RimPoints) -> Array:
    """Residuals (n,) of the last step; nan without an edge. The rays start at the rim's old centre, at most 1e-2 px
    from the new one after three passes."""
    return points.radius_px - rim.radius_at(points.theta)


def _described(
    rim: Rim, points: RimPoints, weight: Array, coarse: CircleCandidate, min_coverage: float
) -> RimFit | None:
    """The fit with its covariance; None where it covers too little of the rim.

    rim: of equal weights, which choose the edges. The circle is that with weights of their precision.
    """
    good = weight > 0
    fits = good if points.beside_gap is None else good | points.beside_gap
    coverage = float(np.mean(fits))
    if coverage < min_coverage:
        return None
    oblique = bool(rim.cos2_px or rim.sin2_px)
    precision = _precision(points.precision, _residuals(rim, points), good)
    A = (_design(points, oblique) * precision[:, None])[good]
    away = _residuals(points.about, points) * precision
    prior = _prior(points, float(np.std(away[good])), A.shape[1])
    weighted = A * weight[good, None]
    x = np.linalg.solve(weighted.T @ A + prior, weighted.T @ away[good])
    away[good] -= A @ x
    power = _error_power(np.where(good, away, 0.0), good, points.spacing_px, A)
    covariance = np.asarray(power * np.linalg.inv(A.T @ A + prior), float)
    lasting = max(1 - points.noise_px**2 * max(CORRELATED_PX / points.spacing_px, 1.0) / power, 0.0)
    covariance = symmetric(covariance[:3, :3]) + _MODEL_SIGMA_PX**2 * np.eye(3)
    covariance[2, 2] += (_BLUR_SIGMA * points.blur_px**2 / (2 * max(rim.radius_px, 1.0))) ** 2 + points.common_px**2
    rms = float(np.sqrt(_sum_of_squares(rim, replace(points, radius_px=points.any_radius_px), fits)))
    on_rim = np.abs(points.any_radius_px - rim.radius_at(points.theta)) < max(3 * rms, _ON_RIM_PX)
    sector = np.arange(len(on_rim)) * SECTORS // len(on_rim)
    sectors = np.bincount(sector, on_rim, SECTORS) / np.maximum(np.bincount(sector, minlength=SECTORS), 1)
    beside = coverage - float(np.mean(good))
    before = np.array(astuple(points.about)[: 5 if oblique else 3])
    best, score = Rim(*(before + x[: len(before)]).tolist()), coverage / (1 + rms)
    return RimFit(best, covariance, coverage, rms, beside, coarse.polarity, score, sectors, lasting)


def _precision(by_slope: Array, residuals: Array, good: Bools) -> Array:
    """(n,): of each edge, from that by its slope: a share of the variance is the same for all, by maximum likelihood.

    Interpolation and texture of the same slope move edges of any height alike. Errors of textured rims grow with the
    power -.5 of the slope, not -1: weights of 1 / slope gave NEES / 2 of 1.7 where the contrast is low.
    """
    noise2 = 1 / by_slope**2
    variance = _SAME_FOR_ALL[:, None] + (1 - _SAME_FOR_ALL[:, None]) * noise2[good]
    deviance = np.log(np.mean(residuals[good] ** 2 / variance, axis=1)) + np.mean(np.log(variance), axis=1)
    same = _SAME_FOR_ALL[np.argmin(deviance)]
    return np.asarray(1 / np.sqrt(same + (1 - same) * noise2))


def _error_power(away: Array, good: Bools, spacing_px: float, design: Array) -> float:
    """Variance of an edge point, px^2, times the number of neighbours that count as one: of the errors (n,) of a fit.

    It is the power of the errors at one period per turn, which moves a centre. The fit leaves nothing there: it is
    that of more periods, with weights that fall to .6 where one is _PERIOD_PX long; with gaps in the rim, the fit takes
    up a part of these as well (design: (m, 3 to 6) of the good points). Estimated like this, a variance is
    divided by its degrees of freedom less 2, as that of Student's distribution. At least 1.8 points 1 px apart count as
    one, measured: white noise behind the Gaussian filter has the correlation exp(-d^2 / 4 sigma^2), whose sum is 3.5,
    but the errors of pixels and interpolation are less correlated.
    """
    count = np.count_nonzero(good)
    spectrum = np.abs(np.fft.rfft(away)) ** 2 / count
    periods = np.arange(len(spectrum))
    shown = max(len(away) * spacing_px / _PERIOD_PX, _LEAST_PERIODS)
    share = np.exp(-0.5 * (periods / shown) ** 2) * (periods >= 2)
    fitted = np.zeros((len(away), design.shape[1]))
    fitted[good] = np.linalg.qr(design)[0]
    left = np.sum(share) - share @ np.sum(np.abs(np.fft.rfft(fitted, axis=0)) ** 2, axis=1) / count
    freedom = 2 * share.sum() ** 2 / (share @ share) * count / len(away)
    power = float(share @ spectrum / left * freedom / max(freedom - 2, 1.0))
    return max(power, max(1.8 / spacing_px, 1.0) * max(float(away @ away) / count, _LEAST_SIGMA_PX**2))
