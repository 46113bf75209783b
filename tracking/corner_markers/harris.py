"""Corners by the Harris method, with the response and the window of Fu (2016).

Source: Fu et al. (2016), eqs. (6) and (7); the response det(M) / (tr(M) + epsilon) is Noble's form, "Finding corners",
Image and Vision Computing 6(2), 1988, of Harris & Stephens (1988).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from geometry.arrays import Array
from tracking.noise import Picture

GROUND_PERCENTILE = 95.0  # of the window's edge: above the noise of the sky, below a neighbouring lamp
LEAST_LIGHT_DN = 12.0  # of a lamp above it


@dataclass(frozen=True, slots=True)
class HarrisParameters:
    """Finding corners in one picture."""

    window_px: int = 5  # side of the Gaussian window; the paper: 5
    threshold_sigma: float = 40.0  # least response, in multiples of its median, which noise and sky determine
    threshold_share: float = 0.01  # ... and as a share of the largest response
    most: int = 60  # corners that are kept; the strongest
    bright: bool = True  # only corners brighter than their surroundings: markers are lamps
    centroid_px: int = 3  # half side of the window in which a lamp's centroid is measured


@dataclass(frozen=True, slots=True)
class Corners:
    """n corners of a picture, strongest first."""

    uv_px: Array  # (n, 2) centroid of the light around the corner
    response: Array  # (n,) eq. (7), DN^2

    def __len__(self) -> int:
        return len(self.uv_px)


def harris_response(picture: Picture, window_px: int = 5) -> Array:
    """The response det(M) / (tr(M) + epsilon) of every pixel (h, w), DN^2.

    M is the window's mean of the products of the first derivatives; eq. (6) prints the elements without the mean.
    """
    grey = picture.astype(np.float32)
    du = cv2.Sobel(grey, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
    dv = cv2.Sobel(grey, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8)
    side = (window_px, window_px)
    uu, uv, vv = (cv2.GaussianBlur(product, side, 0) for product in (du * du, du * dv, dv * dv))
    return np.asarray((uu * vv - uv * uv) / (uu + vv + 1e-6), dtype=float)


def harris_corners(picture: Picture, parameters: HarrisParameters | None = None) -> Corners:
    """The corners of a picture (h, w): local maxima of the response above the threshold."""
    p = HarrisParameters() if parameters is None else parameters
    response = harris_response(picture, p.window_px)
    limit = max(p.threshold_sigma * float(np.median(response)), p.threshold_share * float(response.max()), 1e-9)
    peaks = (response >= cv2.dilate(response, np.ones((p.window_px, p.window_px)))) & (response > limit)
    margin = p.centroid_px + 1
    peaks[:margin], peaks[-margin:], peaks[:, :margin], peaks[:, -margin:] = False, False, False, False
    v, u = np.nonzero(peaks)
    order = np.argsort(-response[v, u], kind="stable")
    v, u = v[order], u[order]
    places, good = _centroids(picture, u, v, p.centroid_px)
    if p.bright:
        places, u, v = places[good], u[good], v[good]
    return Corners(places[: p.most], response[v, u][: p.most])


def _centroids(picture: Picture, u: np.ndarray, v: np.ndarray, half: int) -> tuple[Array, np.ndarray]:
    """Centroids (n, 2) of the light above the window's edge, and whether the middle is brighter than the edge.

    The level is a high percentile of the edge: a lamp in front of a darker body has bright sky on one side only. Where
    the middle is not brighter, the corner's own pixel is its place.
    """
    offsets = np.arange(-half, half + 1)
    windows = picture[(v[:, None, None] + offsets[:, None]), (u[:, None, None] + offsets)].astype(float)
    edge = np.ones((len(offsets), len(offsets)), dtype=bool)
    edge[1:-1, 1:-1] = False
    ground = np.percentile(windows[:, edge], GROUND_PERCENTILE, axis=1)
    light = np.maximum(windows - ground[:, None, None], 0.0)
    total = light.sum(axis=(1, 2))
    good = (windows[:, half, half] > ground + LEAST_LIGHT_DN) & (total > 0)
    safe = np.where(total > 0, total, 1.0)
    du = (light * offsets).sum(axis=(1, 2)) / safe
    dv = (light * offsets[:, None]).sum(axis=(1, 2)) / safe
    centre = np.stack([u, v], -1).astype(float)
    return np.where(good[:, None], centre + np.stack([du, dv], -1), centre), good
