"""Marker candidates in a colour picture: Zhou (2020), section 2, with centroids to a few hundredths of a pixel.

The paper brightens the left picture by gamma 0.8, gives the right one the histogram of the left, segments in HSV,
cleans the mask by a median filter, an opening and a closing, and takes the centroid of each contour. Such a centroid
carries the errors of its pixels' edges, and the cleaning removes markers of less than 4 px. Ours (`coverage`) weights
each pixel of the unchanged picture with the share of the marker's colour in it, which is linear in the light: partly
covered pixels and defocus do not shift it. Its contrast, in sigmas of the background, decides what is no marker, so the
mask needs no cleaning.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array, Bools
from tracking.binocular.marker_model import MarkerImages, SegmentationParameters

Bytes = NDArray[np.uint8]
Planes = tuple[Bytes, Bytes, Bytes]  # (h, w) each of hue, saturation and value
_MARGIN_PX = 3  # around a region: partly covered pixels, with defocus up to a sigma of 1.5 px
_RING_PX = 4  # around that: background
_MARGIN = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _MARGIN_PX + 1, 2 * _MARGIN_PX + 1))
_NEIGHBOURS = np.ones((3, 3), np.uint8)
_FEWEST_RING = 12  # pixels of background for its colour and its covariance
_FEWEST_INNER = 9  # pixels inside a marker for the variance of its shading
_LEAST_VARIANCE_DN2 = 1.0  # of a pixel of the background: rounding and a little noise
_LEAST_CONTRAST2 = 25.0  # squared distance of marker and background in sigmas of the background
_MOST_REGIONS = 3  # times the largest number of markers: regions that are measured, the largest first
_CONTOUR_SIGMA = 0.29  # of the place of an edge that is rounded to whole pixels, px


@dataclass(frozen=True, slots=True)
class ColourRange:
    """A colour in HSV. Raises ValueError: a range is empty or beyond its scale."""

    name: str
    hue_deg: tuple[float, float]  # 0 to 360; from the first to the second, through 0 if the first is larger
    saturation: tuple[float, float] = (0.35, 1.0)  # 0 to 1
    value: tuple[float, float] = (0.2, 1.0)  # 0 to 1

    def __post_init__(self) -> None:
        if not all(0 <= h <= 360 for h in self.hue_deg):
            raise ValueError(f"hue_deg: expected 0 to 360, got {list(self.hue_deg)}")
        for name in ("saturation", "value"):
            low, high = getattr(self, name)
            if not 0 <= low < high <= 1:
                raise ValueError(f"{name}: expected two rising numbers from 0 to 1, got {[low, high]}")

    def mask(self, hsv: Planes) -> Bytes:
        """255 where a picture, (h, w) each of OpenCV's hue (0 to 179), saturation and value, has the colour, else 0."""
        low, high = (self.hue_deg[0] / 2, self.hue_deg[1] / 2)
        out = _within(hsv[0], low, 180.0 if low > high else high)
        if low > high:
            out |= _within(hsv[0], 0.0, high)
        for plane, (first, last) in zip(hsv[1:], (self.saturation, self.value), strict=True):
            out &= _within(plane, 255 * first, 255 * last)
        return out


def _within(plane: Bytes, low: float, high: float) -> Bytes:
    """255 where a plane (h, w) is within two limits, rounded outwards, else 0."""
    return np.asarray(cv2.inRange(plane, int(np.floor(low)), int(np.ceil(high))), dtype=np.uint8)


def brightened(picture: Bytes, gamma: float) -> Bytes:
    """A picture (h, w, 3) after 255 (g / 255)^gamma."""
    table = np.round(255 * (np.arange(256) / 255) ** gamma).astype(np.uint8)
    return np.asarray(cv2.LUT(picture, table), dtype=np.uint8)


def is_grey(picture: Bytes) -> bool:
    """Whether the three channels of a picture (h, w, 3) are equal."""
    blue, green, red = cv2.split(picture)
    return cv2.norm(blue, green, cv2.NORM_INF) == 0 and cv2.norm(green, red, cv2.NORM_INF) == 0


def in_hsv(picture: Bytes) -> Planes:
    """Hue (0 to 179), saturation and value, (h, w) each, of a picture (h, w, 3), BGR."""
    hue, saturation, value = (np.asarray(p, np.uint8) for p in cv2.split(cv2.cvtColor(picture, cv2.COLOR_BGR2HSV)))
    return hue, saturation, value


def specified(hsv: Planes, reference: Planes) -> Planes:
    """A picture in HSV whose value channel gets the histogram of the reference's.

    The printed method does not name the channel. With the value alone, hue and saturation stay, on which the
    segmentation rests.
    """
    own, wanted = (np.cumsum(cv2.calcHist([p[2]], [0], None, [256], [0, 256])) for p in (hsv, reference))
    levels = np.searchsorted(wanted / wanted[-1], own / own[-1] - 1e-12)
    value = cv2.LUT(hsv[2], np.minimum(levels, 255).astype(np.uint8))
    return hsv[0], hsv[1], np.asarray(value, dtype=np.uint8)


def prepared(left: Bytes | None, right: Bytes | None, p: SegmentationParameters) -> tuple[Planes | None, Planes | None]:
    """Both pictures as the segmentation sees them, HSV: the left one brightened, the right one with its histogram."""
    bright = None if left is None else in_hsv(brightened(left, p.gamma))
    if right is None:
        return bright, None
    if bright is None or not p.specify_histogram:
        return bright, in_hsv(brightened(right, p.gamma))
    return bright, specified(in_hsv(right), bright)


def colour_mask(hsv: Planes, colour: ColourRange, p: SegmentationParameters) -> Bytes:
    """The cleaned mask (h, w) of a colour in a prepared picture, 0 or 255."""
    mask = colour.mask(hsv)
    if p.median_px > 1:
        mask = np.asarray(cv2.medianBlur(mask, p.median_px), dtype=np.uint8)
    for size, operation in ((p.opening_px, cv2.MORPH_OPEN), (p.closing_px, cv2.MORPH_CLOSE)):
        if size > 1:
            kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
            mask = np.asarray(cv2.morphologyEx(mask, operation, kernel), dtype=np.uint8)
    return mask


def marker_candidates(
    picture: Bytes, as_seen: Planes, colours: Sequence[ColourRange], p: SegmentationParameters
) -> MarkerImages:
    """The regions of the colours in a picture (h, w, 3), BGR, with centroids, covariances and areas.

    as_seen: the prepared picture, for the segmentation; centroids are measured in the unchanged one. Regions at the
    edge of the picture are left out: their centroids are not those of the markers.
    """
    masks = [colour_mask(as_seen, colour, p) for colour in colours]
    anywhere = masks[0] if len(masks) == 1 else np.max(masks, axis=0)
    regions: list[tuple[float, int, NDArray[Any]]] = []  # area, colour, outline
    for index, mask in enumerate(masks):
        outlines, nested = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
        outer = [] if nested is None else nested[0, :, 3] < 0  # the others are holes
        for outline in (o for o, is_outer in zip(outlines, outer, strict=True) if is_outer):
            # Pixels on the outline count in whole: Pick's theorem.
            area = cv2.contourArea(outline) + 0.5 * len(outline) + 1 if len(outline) > 1 else 1.0
            if p.min_area_px2 <= area <= p.max_area_px2:
                regions.append((area, index, outline))
    regions.sort(key=lambda region: -region[0])
    rows = [
        (index, *found)
        for _, index, outline in regions[: _MOST_REGIONS * p.max_markers]
        if (found := _measured(picture, anywhere, outline, p)) is not None
    ]
    rows.sort(key=lambda row: -row[3])
    rows = rows[: p.max_markers]
    if not rows:
        return MarkerImages.none()
    colour, uv_px, covariances, areas = zip(*rows, strict=True)
    return MarkerImages(np.array(uv_px), np.array(covariances), np.array(areas), np.array(colour, dtype=np.int64))


def _measured(
    picture: Bytes, anywhere: Bytes, outline: NDArray[Any], p: SegmentationParameters
) -> tuple[Array, Array, float] | None:
    """Centroid (2,), covariance (2, 2) and area of the region within an outline; None where it is no marker.

    anywhere (h, w): not 0 in the regions of all colours.
    """
    x, y, w, h = cv2.boundingRect(outline)
    height, width = anywhere.shape
    if x == 0 or y == 0 or x + w == width or y + h == height:
        return None
    margin = _MARGIN_PX + _RING_PX
    left, top = max(x - margin, 0), max(y - margin, 0)
    box = (slice(top, y + h + margin), slice(left, x + w + margin))
    filled = np.zeros(anywhere[box].shape, np.uint8)
    cv2.drawContours(filled, [outline], -1, 1, cv2.FILLED, offset=(-left, -top))
    own = filled > 0
    measured = None
    if p.centroid == "coverage":
        others = (anywhere[box] > 0) & ~own
        near = cv2.dilate(filled, _MARGIN) > 0
        ring = ~near & (cv2.dilate(others.astype(np.uint8), _MARGIN) == 0)
        if ring.sum() >= _FEWEST_RING and not (near & others).any():
            measured = _coverage_centroid(picture[box].astype(float), filled, near, ring)
            if measured is None:
                return None
    uv, cov, size = _contour_centroid(own, len(outline)) if measured is None else measured
    return uv + np.array([left, top]), cov + p.sigma_floor_px**2 * np.eye(2), size


def _contour_centroid(own: Bools, edge_px: int) -> tuple[Array, Array, float]:
    """Centroid (2,), covariance (2, 2) and area of a region within its outer contour of edge_px pixels: the paper's.

    An edge is known to a whole pixel, uniformly: its n pixels shift the centroid by 0.29 px over the root of n.
    """
    v, u = np.nonzero(own)
    sigma = _CONTOUR_SIGMA * np.sqrt(2.0 / edge_px)
    return np.array([u.mean(), v.mean()]), sigma**2 * np.eye(2), float(len(u))


def _coverage_centroid(patch: Array, own: Bytes, near: Bools, ring: Bools) -> tuple[Array, Array, float] | None:
    """Centroid (2,), covariance (2, 2) and area, px^2, of a region by the share of its colour in each pixel.

    patch (h, w, 3): DN; own: 1 in the region. The share is the linear discriminant (Fisher 1936) between the core of
    the region and a ring of background around it: it ignores those changes of colour that occur in the background
    itself, such as the edge of the target against the sky. near: the region with its partly covered pixels. None where
    the region does not differ from its background by more than noise. Source: ours.
    """
    core = cv2.erode(own, _NEIGHBOURS) > 0
    outside = patch[ring]
    background = outside.mean(axis=0)
    apart = patch[core if core.any() else own > 0].mean(axis=0) - background
    around = outside - background
    spread = around.T @ around / (len(around) - 1) + _LEAST_VARIANCE_DN2 * np.eye(3)
    direction: Array = np.linalg.solve(spread, apart).astype(float)
    contrast = float(direction @ apart)
    if contrast < _LEAST_CONTRAST2:
        return None
    share: Array = (patch - background) @ (direction / contrast)
    at = np.argwhere(near)[:, ::-1]
    own_share = share[near]
    weight = float(own_share.sum())
    if weight < 1.0:
        return None
    centre = own_share @ at / weight
    arm = at - centre
    # Shading inside the marker is no noise of the sensor: its variance counts where it is larger than the ring's.
    inner = cv2.erode(own, _NEIGHBOURS, iterations=2) > 0  # without partly covered pixels
    shading = float(share[inner].var()) if inner.sum() >= _FEWEST_INNER else 0.0
    variance = max(float(share[ring].var()), shading, 1e-8)
    cov = variance * (arm.T @ arm) / weight**2
    return centre, cov, weight
