"""The classical detector: gradient votes in the window around a prediction, or in a pyramid of the whole picture."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from tracking.drogue_circle.candidates import CircleCandidate, CircleDetector, Picture, Window, crop_bounds
from tracking.drogue_circle.gradient_votes import centre_votes, centres, edge_pixels, radii_of
from tracking.drogue_circle.parameters import CircleParameters

_CENTRES_OF_WINDOW, _CENTRES_OF_LEVEL = 3, 12
_RADII_OF_CENTRE = 3
_LEAST_SIDE = 32  # px: smaller levels of the pyramid are not searched


def classical_detector(p: CircleParameters) -> CircleDetector:
    """The detector of Zhou (2014) in its corrected form; see `gradient_votes`."""

    def detect(picture: Picture, window: Window | None) -> list[CircleCandidate]:
        return whole_picture(picture, p) if window is None else in_window(picture, window, p)

    return detect


def in_window(picture: Picture, window: Window, p: CircleParameters) -> list[CircleCandidate]:
    """Candidates with a centre within the gate of the predicted one, best supported first."""
    top, bottom, left, right = crop_bounds(picture.shape, window)
    if min(bottom - top, right - left) < 8:
        return []
    edges = edge_pixels(picture[top:bottom, left:right], p.blur_px)
    if not len(edges):
        return []
    u, v, gate = window.u_px - left, window.v_px - top, window.gate_px
    low, high = np.floor([v - gate, u - gate]).astype(int) - 1, np.ceil([v + gate, u + gate]).astype(int) + 2
    area = (int(low[0]), int(high[0]), int(low[1]), int(high[1]))
    radii = (window.min_radius_px, window.max_radius_px)
    rows, columns = centres(centre_votes(edges, radii, area), 4 * _CENTRES_OF_WINDOW)
    out: list[CircleCandidate] = []
    used = 0
    for row, column in zip((rows + area[0]).tolist(), (columns + area[2]).tolist(), strict=True):
        if np.hypot(column - u, row - v) < gate and used < _CENTRES_OF_WINDOW:
            used += 1
            out += radii_of(edges, column, row, radii, _RADII_OF_CENTRE)
    moved = [replace(c, u_px=c.u_px + left, v_px=c.v_px + top) for c in out]
    return sorted(moved, key=lambda c: -c.score)


def whole_picture(picture: Picture, p: CircleParameters) -> list[CircleCandidate]:
    """Candidates anywhere in the picture, best supported first.

    Every level of the pyramid is searched for circles of the same radii in its own pixels, an octave each: the cost is
    4/3 of that of the first level. Centres outside the picture are not searched.
    """
    largest = p.max_radius_px or 0.5 * min(picture.shape[:2])
    scale = 1
    level: Picture = picture
    out: list[CircleCandidate] = []
    band = p.min_radius_px
    while band * scale <= largest and min(level.shape[:2]) >= _LEAST_SIDE:
        top = min(2 * band, largest / scale)
        edges = edge_pixels(level, p.blur_px)
        if len(edges):
            area = (0, level.shape[0], 0, level.shape[1])
            for row, column in zip(*centres(centre_votes(edges, (band, top), area), _CENTRES_OF_LEVEL), strict=True):
                for c in radii_of(edges, float(column), float(row), (band, top), _RADII_OF_CENTRE):
                    away = 0.5 * (scale - 1)  # the centre of the first pixel of a level, in pixels of the picture
                    out.append(
                        replace(
                            c,
                            u_px=c.u_px * scale + away,
                            v_px=c.v_px * scale + away,
                            radius_px=c.radius_px * scale,
                        )
                    )
        scale *= 2
        level = _reduced(picture, scale)
    return sorted(out, key=lambda c: -c.score)


def _reduced(picture: Picture, scale: int) -> Picture:
    """The picture with a side of 1 / scale, means of blocks."""
    smaller = np.asarray(cv2.resize(picture, None, fx=1 / scale, fy=1 / scale, interpolation=cv2.INTER_AREA))
    return smaller.astype(np.uint8) if picture.dtype == np.uint8 else smaller.astype(np.uint16)
