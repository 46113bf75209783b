"""Blobs of a picture that are darker, brighter or of a hue: contrast, connected pixels, centroid of the contrast."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array, robust_sigma
from tracking.detections import Detections
from tracking.noise import Picture


@dataclass(frozen=True, slots=True)
class BlobParameters:
    """Detection of a blob that is darker or brighter than its surroundings."""

    polarity: Literal["darker", "brighter"] = "darker"
    background_px: int = 61  # px: side of the square whose mean is the background; larger than the target
    close_px: int = 5  # px: gaps up to this width join parts of a blob; 0: none
    # With 6, parts of clouds are taken for the target: 25 false measurements per 1,000 frames, with 8 none
    # (second_checks point 93 40 blobs.threshold_sigma=6.0).
    threshold_sigma: float = 8.0  # least contrast in sigmas of the background's noise ...
    threshold_share: float = 0.3  # ... and as a share of the picture's largest contrast: shadows are fainter
    min_size_px: float = 3.0  # px: longest side of the blob's box; below it is noise
    max_size_px: float = 250.0  # px: above it is an edge of the scene


# A square of this share of background_px as well, for blobs of up to half of that: clouds change less within it.
_NARROW = 0.67
_EVERY = 4  # every 4th row and column is enough for the noise
# A target larger than the background's square has contrast along its edge only. Such an edge is as bright as the blob
# on its inner side and as the background on its outer one: both on this share of its surroundings.
_EDGE_SHARE, _AS_BLOB, _AS_BACKGROUND = 0.2, 0.3, 0.7  # the limits are shares of the peak of the contrast
# Power of slope over peak, the inverse of the width of an edge, in the order of blobs. The first is the target where
# nothing else is known, and a part of a cloud may have four times its sum of contrasts with edges twice as wide.
_SHARPNESS = 3
_RING_PX = 7  # side of the square that reaches the surroundings


def find_blobs(picture: Picture | NDArray[np.float32], parameters: BlobParameters) -> Detections:
    """The blobs of a picture (h, w), the strongest and sharpest first.

    flux is the sum and peak the maximum of the contrast, DN; the axes are the square roots of the second moments. The
    covariance of a centroid is that of the contrast's noise; errors of the outline are not part of it. Blobs that touch
    the picture's edge are left out, since their centroid is not that of the target.
    """
    narrow = round(_NARROW * parameters.background_px)
    limited = replace(parameters, max_size_px=min(parameters.max_size_px, narrow / 2))
    small, small_slope = _blobs_before(picture, limited, narrow)
    found, slope = _blobs_before(picture, parameters, parameters.background_px)
    apart = (np.linalg.norm(small.uv_px[:, None] - found.uv_px, axis=-1) > narrow / 4).all(axis=1)
    slope = np.concatenate([slope, small_slope[apart]])
    slope = slope[np.argsort(-np.concatenate([found.flux, small.flux[apart]]), kind="stable")]
    found = found[np.argsort(-found.flux, kind="stable")].joined(small[apart], len(slope))
    return found[np.argsort(-found.flux * (slope / found.peak) ** _SHARPNESS, kind="stable")]


def _blobs_before(
    picture: Picture | NDArray[np.float32], parameters: BlobParameters, square_px: int
) -> tuple[Detections, Array]:
    """The n blobs of a picture (h, w) before a background that is the mean of a square with this side.

    With the mean slope along the outline of each (n,), DN/px.
    """
    grey = picture.astype(np.float32)
    side = 2 * (square_px // 2) + 1
    sign = np.float32(-1 if parameters.polarity == "darker" else 1)
    background = cv2.blur(grey, (side, side), borderType=cv2.BORDER_REFLECT)
    contrast = sign * (grey - background)
    sample = contrast[::_EVERY, ::_EVERY]
    sigma = max(float(robust_sigma(sample - np.median(sample))), 0.3)  # 0.3 DN: rounding
    limit = max(parameters.threshold_sigma * sigma, parameters.threshold_share * float(contrast.max()))
    mask = _outlines(contrast, limit)
    if parameters.close_px > 1:
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (parameters.close_px, parameters.close_px))
        mask = np.asarray(cv2.morphologyEx(mask, cv2.MORPH_CLOSE, kernel), dtype=np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    left, top, wide, high = (stats[:, i] for i in (0, 1, 2, 3))
    longest = np.maximum(wide, high)
    h, w = picture.shape
    good = (longest >= parameters.min_size_px) & (longest <= parameters.max_size_px)
    good &= (left > 0) & (top > 0) & (left + wide < w) & (top + high < h)
    good &= np.bincount(labels[contrast > limit], minlength=count) > 0
    good[0] = False  # the background
    for row in np.flatnonzero(good & (longest >= parameters.background_px)).tolist():
        x0, y0 = max(int(left[row]) - _RING_PX, 0), max(int(top[row]) - _RING_PX, 0)
        part = slice(y0, int(top[row] + high[row]) + _RING_PX), slice(x0, int(left[row] + wide[row]) + _RING_PX)
        level = grey[part] if parameters.polarity == "brighter" else -grey[part]
        good[row] = not _is_an_edge(level, contrast[part], mask[part], np.asarray(labels[part] == row, np.uint8))
    rows = np.flatnonzero(good)
    if not len(rows):
        return Detections.none(), np.zeros(0)
    place = np.full(count, -1)
    place[rows] = np.arange(len(rows))
    v, u = np.nonzero(mask)
    of = place[labels[v, u]]
    u, v, of = u[of >= 0], v[of >= 0], of[of >= 0]
    # One level for all of a blob, which hides what is behind it: a slope of the background would move its centroid.
    behind = np.bincount(of, background[v, u]) / np.bincount(of)
    weight = np.maximum(sign * (grey[v, u] - behind[of]), 0.0)
    outline = cv2.erode(mask, np.ones((3, 3), np.uint8))[v, u] == 0
    steps = np.hypot(grey[v, u + 1] - grey[v, u - 1], grey[v + 1, u] - grey[v - 1, u]) / 2
    slope = np.bincount(of, steps * outline) / np.bincount(of, outline)
    return _moments(u.astype(float), v.astype(float), of, weight, len(rows), sigma, limit), slope


def _outlines(contrast: NDArray[np.float32], limit: float) -> NDArray[np.uint8]:
    """The pixels (h, w) of blobs whose peak is above the limit: those above it, and above half of the peak.

    Before a structured background the limit is near the peak: the pixels above it are a random part of the target.
    """
    mask = np.asarray(contrast > 0.5 * limit, dtype=np.uint8)
    count, labels = cv2.connectedComponents(mask, connectivity=8)
    inside = mask > 0
    of, values, peak = labels[inside].astype(np.int32), contrast[inside], np.zeros(count, np.float32)
    np.maximum.at(peak, of, values)
    mask[inside] = values > np.where(peak > limit, np.minimum(0.5 * peak, limit), np.inf)[of]
    return mask


def _is_an_edge(
    grey: NDArray[np.float32], contrast: NDArray[np.float32], mask: NDArray[np.uint8], own: NDArray[np.uint8]
) -> bool:
    """Whether a blob is a part of the edge of something larger, from the picture around it.

    grey (h, w): larger in a blob than beside it. mask: all blobs, own: this one. Holes of a blob are part of it: an
    outline that is seen whole has its centroid at the target's centre.
    """
    _, parts = cv2.connectedComponents(1 - own, connectivity=4)
    border = np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]])
    outside = np.isin(parts, np.unique(border[border > 0]))
    beside = cv2.dilate(mask, np.ones((3, 3), np.uint8)) > 0
    ring = (cv2.dilate(own, np.ones((_RING_PX, _RING_PX), np.uint8)) > 0) & ~beside & outside
    if not ring.any():
        return False
    inside = own > 0
    below = (float(grey[inside].mean()) - grey[ring]) / float(contrast[inside].max())
    return bool(np.mean(below < _AS_BLOB) > _EDGE_SHARE and np.mean(below > _AS_BACKGROUND) > _EDGE_SHARE)


def _moments(u: Array, v: Array, of: np.ndarray, weight: Array, n: int, sigma: float, limit: float) -> Detections:
    """Centroids and shapes of n blobs from their pixels (k,): coordinates, blob and contrast.

    The covariance has three parts: the noise of all pixels; pixels of the outline that noise moves across its level, so
    that their whole weight comes or goes; and pixels below the level, which are left out.
    """

    def summed(values: Array) -> Array:
        return np.asarray(np.bincount(of, values, n), dtype=float)

    flux = summed(weight)
    centre = np.stack([summed(weight * u), summed(weight * v)], -1) / flux[:, None]
    du, dv = u - centre[of, 0], v - centre[of, 1]
    peak = np.zeros(n)
    np.maximum.at(peak, of, weight)
    level = np.minimum(0.5 * peak, limit)
    # The integral of F (1 - F) across the outline is sigma / sqrt(pi), F the normal distribution of a pixel's contrast.
    comes_or_goes = weight - level[of] < sigma / np.sqrt(np.pi)
    variance = sigma**2 + np.where(comes_or_goes, level[of] ** 2, 0.0)
    shape = np.empty((n, 2, 2))
    spread = np.empty((n, 2, 2))
    for i, j, product in ((0, 0, du * du), (0, 1, du * dv), (1, 1, dv * dv)):
        shape[:, i, j] = shape[:, j, i] = summed(weight * product) / flux
        spread[:, i, j] = spread[:, j, i] = summed(variance * product) / flux**2
    values, vectors = np.linalg.eigh(shape + np.eye(2) / 12)  # 1/12 px^2: a pixel is a square
    angle = np.rad2deg(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]))
    # What is left out of a pixel of the outline is uniform up to the level. A disc of n pixels has 2 sqrt(pi n) of them
    # at the distance sqrt(n / pi) from its centre.
    sampling = (level / peak) ** 2 / 12 / np.sqrt(np.pi * np.bincount(of, minlength=n))
    return Detections(
        centre,
        spread + np.eye(2) * sampling[:, None, None],
        flux,
        peak,
        np.sqrt(values[:, 1]),
        np.sqrt(values[:, 0]),
        90.0 - (90.0 - angle) % 180.0,
    )


# A coloured target: the share of a hue in each pixel, and the blobs of it.
#
# The grey part of the light does not change the share, and it is linear in the light: shadows and white reflections are
# no targets, and pixels that the target covers in part have a part of its value. Source: ours; the plane of chroma is
# that of the hue in HSV (Smith 1978).

# Hue, degrees.
HUES = {"red": 0.0, "orange": 30.0, "yellow": 60.0, "green": 120.0, "cyan": 180.0, "blue": 240.0, "magenta": 300.0}
LEAST_CHROMA_DN = 25.0  # of the middle of a target: fainter colours are those of walls, wood and light
# px: 1 sigma of a centroid. A video has one colour for 2 x 2 pixels: .08 px for discs with a radius of 6 px, MJPG.
_SIGMA_COLOUR_PX = 0.1
_ACROSS = 1.7  # weight of the chroma across the hue: hues more than 30 degrees away have no share


def hue_of(bgr: tuple[float, float, float]) -> float | None:
    """Hue of a colour, degrees, 0 to 360; None for a grey one."""
    along, across = _chroma(np.array(bgr, dtype=np.float32)[None, None])
    if np.hypot(along, across)[0, 0] < LEAST_CHROMA_DN:
        return None
    return float(np.degrees(np.arctan2(across, along))[0, 0] % 360)


def share_of_hue(picture: NDArray[np.uint8], hue_deg: float) -> NDArray[np.float32]:
    """Chroma (h, w), DN, of a picture (h, w, 3), BGR, along a hue; 0 for other hues and for grey."""
    x, y = _chroma(picture.astype(np.float32))
    turn = np.radians(hue_deg)
    c, s = np.float32(np.cos(turn)), np.float32(np.sin(turn))
    along, across = c * x + s * y, c * y - s * x
    return np.asarray(np.maximum(along - np.float32(_ACROSS) * np.abs(across), 0), np.float32)


def find_coloured(picture: NDArray[np.uint8], hue_deg: float, parameters: BlobParameters) -> Detections:
    """The blobs of a hue in a picture (h, w, 3), BGR, strongest first; flux and peak are chroma, DN.

    Raises ValueError: the picture has no three channels of 8 bits.
    """
    if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
        raise ValueError(f"picture: expected (h, w, 3) of 8 bits, got {picture.shape} of {picture.dtype}")
    # The median removes single pixels: the chroma of a raster of colour filters is noisy.
    share = np.asarray(cv2.medianBlur(share_of_hue(picture, hue_deg), 3), np.float32)
    found = find_blobs(share, replace(parameters, polarity="brighter"))
    found = replace(found, cov_px2=found.cov_px2 + _SIGMA_COLOUR_PX**2 * np.eye(2))
    return found[found.peak >= LEAST_CHROMA_DN]


def has_colour(picture: NDArray[np.uint8]) -> bool:
    """Whether any pixel of a picture (h, w, 3) has the chroma of a target."""
    x, y = _chroma(picture.astype(np.float32))
    return bool(np.hypot(x, y).max() >= LEAST_CHROMA_DN)


def _chroma(bgr: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Components towards red, and 90 degrees from it, of colours (h, w, 3); 255 DN for a pure red."""
    blue, green, red = (bgr[..., i] for i in range(3))
    across = np.float32(np.sqrt(3) / 2) * (green - blue)
    return np.asarray(red - (green + blue) / 2, np.float32), np.asarray(across, np.float32)
