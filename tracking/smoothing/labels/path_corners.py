"""Continuation of a spot's path across a corner: a straight row of points that meets the path.

At a velocity jump the spot leaves its extrapolated path by many times its error, and a single point near by may be
false. But the spot continues straight, so the points of the next frames form a row, and the lines before and after the
corner meet at one moment between the frames. False points do neither. Source: ours.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Ints

ROW_FRAMES = 6  # in which a row is looked for
MIN_ROW = 4  # points of a row
SIGMAS = 4.0  # of a point from the extrapolation of its row
MEETING_SIGMAS = 5.0  # of the two lines at the corner, extrapolated there from two points each
MAX_SIGMA_PX = 2.0  # of the extrapolation; a path that is less straight says too little about where a row may begin
MIN_MOTION_PX = 1.0  # from the first to the last point of a row: a reflection makes a row, too, but one that rests
FASTER = 2.0  # a spot moves at most so many times as fast as ever on its labelled path
MIN_SPEED_LIMIT_PX = 10.0  # per frame, at the least


class Line(NamedTuple):
    """A straight path before a corner."""

    frame: int  # of its last point
    uv: Array  # (2,) px, that point
    velocity: Array  # (2,) px per frame of the direction in which the path is continued


class Limits(NamedTuple):
    """Of the rows of one spot."""

    sigma_px: float  # error of the extrapolation from two points by one frame
    speed_px: float  # largest speed, px per frame


PointsOf = Callable[[int], tuple[Ints, Array]]
"""Rows (m,) and places (m, 2), px, of the points of a frame that may belong to the spot."""


def after_corner(points_of: PointsOf, k: int, direction: int, line: Line, limits: Limits) -> dict[int, int]:
    """Row of the spot's point by frame, from frame k on, after a corner since the line's last point; {}: none is sure.

    direction: of time, 1 or -1. points_of gives none outside the recording. A second row that fits makes it unsure.
    """
    if limits.sigma_px > MAX_SIGMA_PX:
        return {}
    fitting = [row for row in _rows(points_of, k, direction, limits) if _meets(row, k, direction, line, limits)]
    if not fitting:
        return {}
    longest = max(fitting, key=len)
    if any(_disagree(longest, other) for other in fitting):
        return {}
    return {frame: row for frame, (row, _) in longest.items()}


_Row = dict[int, tuple[int, Array]]  # row and place by frame


def _rows(points_of: PointsOf, k: int, direction: int, limits: Limits) -> list[_Row]:
    """All straight rows of at least MIN_ROW points that begin in frame k."""
    frames = [k + direction * i for i in range(ROW_FRAMES)]
    points = [points_of(frame) for frame in frames]
    out = []
    for first, start in zip(*points[0], strict=True):
        for second, place in zip(*points[1], strict=True):
            if np.linalg.norm(place - start) > limits.speed_px:
                continue
            row: _Row = {frames[0]: (int(first), start), frames[1]: (int(second), place)}
            step, latest, at = place - start, 1, place
            for i in range(2, ROW_FRAMES):
                rows, places = points[i]
                if not len(rows):
                    continue
                ahead = i - latest
                away = np.linalg.norm(places - (at + ahead * step), axis=1)
                nearest = int(np.argmin(away))
                if away[nearest] <= SIGMAS * limits.sigma_px * ahead:
                    step, latest, at = (places[nearest] - at) / ahead, i, places[nearest]
                    row[frames[i]] = (int(rows[nearest]), at)
            if len(row) >= MIN_ROW and np.linalg.norm(at - start) >= MIN_MOTION_PX + SIGMAS * limits.sigma_px:
                out.append(row)
    return out


def _meets(row: _Row, k: int, direction: int, line: Line, limits: Limits) -> bool:
    """Whether the row and the line before the corner meet between the line's last point and frame k."""
    second = k + direction
    start, step = row[k][1], row[second][1] - row[k][1]
    gap = abs(k - line.frame)
    # After a time tau since the line's last point: line.uv + tau line.velocity = start - (gap - tau) step.
    apart = line.uv - start + gap * step
    change = line.velocity - step
    tau = float(np.clip(-(apart @ change) / max(float(change @ change), 1e-12), 0.0, gap))
    miss = float(np.linalg.norm(apart + tau * change))
    return miss <= MEETING_SIGMAS * limits.sigma_px * gap


def _disagree(one: _Row, other: _Row) -> bool:
    return any(frame in one and one[frame][0] != row for frame, (row, _) in other.items())
