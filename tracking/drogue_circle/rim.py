"""Edge points of a rim with sub-pixel precision: the maximum of the slope along the gradient of a circle, on rays."""

from __future__ import annotations

from dataclasses import dataclass
from math import erf

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array, Bools
from tracking.drogue_circle.candidates import Picture, Window, crop_bounds

_STEP_PX = 0.5  # sampling along a ray
_LEAST_RAYS, _MOST_RAYS = 40, 256
_OBLIQUE = 0.6  # largest tangential slope, as a share of the radial one: the edge crosses the rim at up to 31 degrees
_MOST_BLUR = 1.2  # of the half width of the rays: a wider edge has no known height
_LEAST_SHARE = 0.25  # of the median slope of the rim: weaker maxima are not the rim
_LEAST_SLOPE = 3.0  # standard deviations of the slope's noise


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

    theta: Array  # (n,) rad
    radius_px: Array  # (n,) distance from the centre; nan where no edge is found
    slope: Array  # (n,) DN/px along the ray, positive in the direction of the polarity; nan there, too
    any_radius_px: Array  # (n,) as radius_px, but also in hidden sectors
    inside: Bools  # (n,) the ray lies inside the picture
    spacing_px: float  # between neighbouring rays at the rim
    shift_px: float = 0.0  # by which the radii are corrected for blur


@dataclass(frozen=True, slots=True)
class SmoothCrop:
    """A part of the picture after a Gaussian filter, with its place and the noise of a pixel."""

    values: NDArray[np.float32]  # (h, w) DN
    left: int
    top: int
    noise_dn: float  # 1 sigma of the filtered values
    blur_px: float


def median(values: Array | NDArray[np.float32]) -> float:
    """The upper median of values (n,), n > 0: np.median, at a fifth of its cost on the small arrays of one frame."""
    half = len(values) // 2
    return float(np.partition(values, half)[half])


def smooth_crop(picture: Picture, window: Window, blur_px: float) -> SmoothCrop:
    """The part of a picture in a window, filtered by a Gaussian."""
    top, bottom, left, right = crop_bounds(picture.shape, window)
    raw = picture[top:bottom, left:right].astype(np.float32)
    if min(raw.shape) < 5:
        return SmoothCrop(np.zeros((0, 0), np.float32), left, top, 0.0, blur_px)
    # Noise: median of the second difference along rows, which cancels gradients (Immerkaer 1996, one dimension).
    second = np.abs(raw[::2, 2:] - 2 * raw[::2, 1:-1] + raw[::2, :-2])
    noise = max(median(second.ravel()) / 0.6745 / np.sqrt(6.0), 0.3)
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
        return RimPoints(theta, none, none, none, np.zeros(n, dtype=bool), spacing)
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
    if good.any():
        good &= strength > _LEAST_SHARE * median(strength[good])
    a, b, c = slope[rows, best], strength, slope[rows, best + 2]
    bend = np.where(good, a - 2 * b + c, -1.0)
    vertex = np.clip(0.5 * (a - c) / np.minimum(bend, -1e-12), -0.5, 0.5)  # of a parabola through three slopes
    radius = base + offset[2:-2][best] + _STEP_PX * vertex
    # Blur moves the steepest place of a curved edge inwards by sigma^2 / (2 r) (Bouma et al. 2005).
    height_dn = polarity * (values[:, -1] - values[:, 0])[good]
    sigma = _edge_width(height_dn / strength[good], float(offset[-1]), crop.blur_px) if good.any() else crop.blur_px
    shift = sigma**2 / (2 * max(rim.radius_px, 1.0))
    radius += shift
    radius = np.where(good, radius, np.nan)
    strength = np.where(good, strength, np.nan)
    if hidden is None:
        return RimPoints(theta, radius, strength, radius, inside, spacing, shift)
    own = ~hidden[(rows * len(hidden)) // n]
    seen = np.where(own, radius, np.nan)
    return RimPoints(theta, seen, np.where(own, strength, np.nan), radius, inside, spacing, shift)


def _edge_width(ratios_px: Array, half_px: float, least_px: float) -> float:
    """Sigma of a blurred step, px, from its height within +- half_px over its largest slope, on n rays.

    The height is A erf(half / (sqrt(2) sigma)) and the slope A / (sqrt(2 pi) sigma); least_px: the filter's own sigma.
    """
    ratio = median(ratios_px) / np.sqrt(2 * np.pi)
    sigma = max(ratio, least_px)
    for _ in range(4):
        sigma = float(np.clip(ratio / erf(half_px / (np.sqrt(2) * sigma)), least_px, _MOST_BLUR * half_px))
    return sigma
