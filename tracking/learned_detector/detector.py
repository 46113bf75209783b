"""Drogues found by a small fully convolutional network on an image pyramid, run by `cv2.dnn`.

The network was trained by lab/learned_detector/train.py on rendered drogues; no deep-learning library is needed to run
it. Per cell of STRIDE pixels it gives the logit of a centre, the offset of the centre and the log of the diameter.
Source: after Zhou (2020), section 1, whose network has 42 layers; ours has eight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking.drogue_circle.candidates import CircleCandidate, CircleDetector, Picture, Window, crop_bounds

Floats: TypeAlias = NDArray[np.float32]

WEIGHTS = Path(__file__).with_name("weights.onnx")
STRIDE = 4
SMALLEST_PX, LARGEST_PX = 8.0, 40.0  # diameters that one level of the pyramid finds
MIN_CONFIDENCE = 0.05  # of a candidate
MAX_CANDIDATES = 20
SAME_SHARE = 0.5  # of the larger diameter: two centres nearer than this are one drogue
_MARGIN_PX = 48  # around a window: the network sees 50 px on each side of a cell
_LEAST_SIDE_PX = 64

# Confidence by calibration: share of right candidates among those of a logit, a logistic curve fitted on validation
# pictures (bench/related_measurements/learned_detector.py --calibrate, seed 5).
CALIBRATION_SLOPE, CALIBRATION_OFFSET = 5.328, -2.623


@dataclass(frozen=True, slots=True)
class DrogueCandidate:
    """A drogue in a picture."""

    u_px: float  # centre of the rim's image
    v_px: float
    diameter_px: float
    confidence: float  # probability that it is a drogue, calibrated on rendered pictures


@cache
def _network() -> cv2.dnn.Net:
    try:
        return cv2.dnn.readNetFromONNX(str(WEIGHTS))
    except cv2.error as error:
        raise ValueError(
            f"{WEIGHTS}: the weights of the learned detector are damaged: install beampose again"
        ) from error


def find_drogues(
    picture: Picture,
    smallest_px: float = SMALLEST_PX,
    largest_px: float | None = None,
    min_confidence: float = MIN_CONFIDENCE,
) -> list[DrogueCandidate]:
    """Drogues of a picture (h, w), the most confident first.

    smallest_px, largest_px: range of the diameters; None: up to the picture's smaller side. 16-bit pictures are scaled
    by their largest value.

    Raises:
        ValueError: the picture is not grey, or the file of the weights is damaged.
    """
    if picture.ndim != 2:
        raise ValueError(f"picture: expected a grey picture (h, w), got the shape {picture.shape}")
    full = 255 if picture.dtype == np.uint8 else max(int(picture.max()), 1)
    grey = np.asarray(picture, dtype=np.float32) / np.float32(full)
    top = float(min(picture.shape)) if largest_px is None else largest_px
    found: list[tuple[float, float, float, float]] = []
    scale = SMALLEST_PX / max(smallest_px, SMALLEST_PX)
    while True:
        found += _of_level(grey, scale, min_confidence)
        if LARGEST_PX / scale >= top:
            break
        scale /= 2
    return _distinct(found)


def _of_level(grey: Floats, scale: float, min_confidence: float) -> list[tuple[float, float, float, float]]:
    """Confidence, u, v, diameter of the candidates of one level, in pixels of the picture."""
    height, width = (max(round(s * scale), 1) for s in grey.shape)
    level = grey if scale == 1 else cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)
    below, beside = -height % STRIDE, -width % STRIDE
    below, beside = max(below, _LEAST_SIDE_PX - height), max(beside, _LEAST_SIDE_PX - width)
    if below or beside:
        level = cv2.copyMakeBorder(level, 0, below, 0, beside, cv2.BORDER_REPLICATE)
    net = _network()
    net.setInput(np.ascontiguousarray(level, dtype=np.float32)[None, None])
    cells = net.forward()[0]
    logit = cells[0]
    peak = logit >= cv2.dilate(logit, np.ones((3, 3), np.uint8))
    confidence = 1 / (1 + np.exp(-(CALIBRATION_SLOPE * logit + CALIBRATION_OFFSET)))
    rows, columns = np.nonzero(peak & (confidence >= min_confidence))
    out = []
    for r, c in zip(rows.tolist(), columns.tolist(), strict=True):
        diameter = float(np.exp(cells[3, r, c]))
        if not SMALLEST_PX * 0.8 <= diameter <= LARGEST_PX * 1.25:
            continue
        u, v = (STRIDE * (k + 0.5 + float(cells[1 + i, r, c])) - 0.5 for i, k in enumerate((c, r)))
        at = [(x + 0.5) / scale - 0.5 for x in (u, v)]
        out.append((float(confidence[r, c]), at[0], at[1], diameter / scale))
    return out


def _distinct(found: Sequence[tuple[float, float, float, float]]) -> list[DrogueCandidate]:
    """The best of candidates that lie on each other, at most MAX_CANDIDATES."""
    kept: list[DrogueCandidate] = []
    for confidence, u, v, diameter in sorted(found, reverse=True):
        near = (np.hypot(u - k.u_px, v - k.v_px) < SAME_SHARE * max(diameter, k.diameter_px) for k in kept)
        if not any(near):
            kept.append(DrogueCandidate(u, v, diameter, confidence))
        if len(kept) == MAX_CANDIDATES:
            break
    return kept


def learned_detector(min_radius_px: float, max_radius_px: float | None = None) -> CircleDetector:
    """The detector for the trackers of circles; radii in px."""

    def detect(picture: Picture, window: Window | None) -> list[CircleCandidate]:
        if window is None:
            found = find_drogues(picture, 2 * min_radius_px, None if max_radius_px is None else 2 * max_radius_px)
            return [CircleCandidate(d.u_px, d.v_px, d.diameter_px / 2, d.confidence) for d in found]
        top, bottom, left, right = crop_bounds(picture.shape, window)
        top, left = max(top - _MARGIN_PX, 0), max(left - _MARGIN_PX, 0)
        crop = picture[top : bottom + _MARGIN_PX, left : right + _MARGIN_PX]
        if not crop.size:
            return []
        out = []
        for d in find_drogues(crop, 2 * window.min_radius_px, 2 * window.max_radius_px):
            u, v = d.u_px + left, d.v_px + top
            if np.hypot(u - window.u_px, v - window.v_px) <= window.gate_px:
                out.append(CircleCandidate(u, v, d.diameter_px / 2, d.confidence))
        return out

    return detect
