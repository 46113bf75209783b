"""Residuals of fitted spots: noise samples from the brightest pixels of the pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools
from tracking.detections import Detections
from tracking.noise import Picture

_REACH = 2.2  # sigmas of a spot within which its residuals are used
_RING = 3.4  # sigmas of a spot within which it is fitted, with the background
_FREE = 9  # parameters of the fit of a spot
_MOST_SPOTS = 20  # per picture: the brightest
_SMALLEST_PX = 0.9  # sigma: in narrower spots the mean of a Gaussian over a pixel is not a Gaussian
_BLURRED = 0.1  # share of a spot's peak whose grain the lens blurs into the wings
_MOST_SIDE = 15  # pixels used along a side of the window
_LARGEST_PX = 12.0  # sigma: wider spots have more pixels than needed


@dataclass(frozen=True, slots=True)
class SpotResiduals:
    """m pixels of fitted spots."""

    level: Array  # (m,), DN, fitted
    light: Array  # (m,), DN, part of it above the local background
    grainy: Array  # (m,), DN, light whose grain affects this pixel: the lens blurs the core's grain into the wings
    square: Array  # (m,), DN^2: squared residual, corrected for the fit's degrees of freedom


def residuals_of_spots(pictures: Sequence[Picture], found: Sequence[Detections], top_dn: float) -> SpotResiduals:
    """Squared residuals of the detections in pictures (h, w). top_dn: grey value at which the sensor clips.

    The shapes are those of the detections, which come from a first noise model; amplitude, background plane and small
    corrections of the shape are fitted with equal weights, so the result hardly depends on the first model.
    """
    parts = []
    for picture, points in zip(pictures, found, strict=True):
        fits = (points.major_px < _LARGEST_PX) & (points.minor_px > _SMALLEST_PX) & np.isfinite(points.peak)
        good = np.flatnonzero(fits)[:_MOST_SPOTS]
        for i in good:
            part = _residuals(picture, points, int(i), top_dn) if _is_isolated(points, int(i)) else None
            if part is not None:
                parts.append(part)
    joined = np.concatenate(parts, axis=1) if parts else np.zeros((4, 0))
    return SpotResiduals(*joined)


def _is_isolated(points: Detections, i: int) -> bool:
    """Whether no other spot reaches into the window of this one."""
    distance = np.hypot(*(points.uv_px - points.uv_px[i]).T)
    distance[i] = np.inf
    return bool(np.all(distance > _RING * (points.major_px[i] + points.major_px) + 2))


def _residuals(picture: Picture, points: Detections, i: int, top_dn: float) -> Array | None:
    """(4, m) level, light, grainy light, squared residual of one spot's core; None: at the border, or clipped."""
    major, minor = float(points.major_px[i]), float(points.minor_px[i])
    u, v = points.uv_px[i]
    half = int(np.ceil(_RING * np.hypot(major, 0.3))) + 1
    left, upper = round(float(u)) - half, round(float(v)) - half
    side = 2 * half + 1
    if left < 0 or upper < 0 or left + side > picture.shape[1] or upper + side > picture.shape[0]:
        return None
    values = picture[upper : upper + side, left : left + side].astype(float)
    if values.max() >= top_dn:
        return None
    stride = max(side // _MOST_SIDE, 1)  # a subset of the pixels is enough for a wide spot
    values = values[::stride, ::stride]
    du, dv = np.meshgrid(np.arange(side)[::stride] + left - u, np.arange(side)[::stride] + upper - v)
    angle = np.radians(points.angle_deg[i])
    along, across = du * np.cos(angle) + dv * np.sin(angle), -du * np.sin(angle) + dv * np.cos(angle)
    r2 = along**2 / (major**2 + 1 / 12) + across**2 / (minor**2 + 1 / 12)
    shape = np.exp(-0.5 * r2)
    inside: Bools = r2 < _RING**2
    A = np.stack([shape, np.ones_like(shape), du, dv, shape * along, shape * across], axis=-1)
    A = np.concatenate([A, (shape * np.stack([along**2, along * across, across**2])).transpose(1, 2, 0)], axis=-1)
    x = np.linalg.lstsq(A[inside], values[inside], rcond=None)[0]
    fitted = A @ x
    core = r2 < _REACH**2
    count = int(inside.sum())
    if count <= _FREE + 6 or x[0] <= 0:
        return None
    square = (values - fitted) ** 2 * count / (count - _FREE)
    light = np.maximum(fitted - (x[1] + x[2] * du + x[3] * dv), 0.0)[core]
    return np.stack([fitted[core], light, light + _BLURRED * light.max(), square[core]])
