"""Validation of a tracker's input: drops invalid and duplicate detections, and rejects invalid calls.

A detection that is not finite, or whose covariance is not one, would invalidate every sum that it enters; a spot
detected twice would share its label probability between both detections and stay unlabelled. Both are dropped. An
invalid call (a step that is not positive, cameras that do not match the rig) is a ValueError.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled
from tracking.detections import UNMATCHED, Detections
from tracking.statuses import TrackedFrame

# Two points of one picture nearer than this are one spot detected twice: two different spots a few px wide and so near
# to each other merge into one detection.
DUPLICATE_PX = 0.05
LEAST_SIGMA_PX = 1e-4  # a hundredth of the best centroids' sigma: a smaller one is zero, or in another unit
LARGEST_PX = 1e6  # no picture is as wide; squares of larger coordinates may overflow
_FEW = 50  # points: up to this number comparing all pairs is faster than sorting (3 us per picture instead of 20)
_MAX_COMPARED = 100  # preceding points that each point is compared with, in a stripe of TWIN_PX


@compiled
def duplicates(group: Ints, uv: Array, order: Ints, size: Array) -> Bools:
    """Which of m points are duplicates of another point of their group; of two the one with the larger `size` (m,).

    uv (m, 2), px; order (m,): the rows sorted by group, then u, then v. Of equal sizes the later one in that order is
    the duplicate.
    """
    m = len(order)
    out = np.zeros(m, np.bool_)
    for i in range(m):
        a = order[i]
        for back in range(i - 1, max(-1, i - 1 - _MAX_COMPARED), -1):
            b = order[back]
            if group[b] != group[a] or uv[a, 0] - uv[b, 0] >= DUPLICATE_PX:
                break
            if out[b] or (uv[a, 0] - uv[b, 0]) ** 2 + (uv[a, 1] - uv[b, 1]) ** 2 >= DUPLICATE_PX**2:
                continue
            if size[b] > size[a]:
                out[b] = True
            else:
                out[a] = True
                break
    return out


@compiled
def are_valid(uv_px: Array, cov_px2: Array) -> Bools:
    """Which points (m, 2) are finite and have a valid covariance (m, 2, 2)."""
    least, largest = LEAST_SIGMA_PX**2, LARGEST_PX**2
    out = np.zeros(len(uv_px), np.bool_)
    for i in range(len(uv_px)):
        a, b, c = cov_px2[i, 0, 0], cov_px2[i, 0, 1], cov_px2[i, 1, 1]
        out[i] = (
            abs(uv_px[i, 0]) < LARGEST_PX and abs(uv_px[i, 1]) < LARGEST_PX  # false for nan
            and least <= a < largest and least <= c < largest
            # With a larger correlation the covariance is singular within rounding.
            and b * b < (1 - 1e-9) ** 2 * a * c
            and abs(b - cov_px2[i, 1, 0]) <= 1e-9 * (a + c)
        )  # fmt: skip
    return out


@compiled
def _few_and_valid(uv_px: Array, cov_px2: Array) -> bool:
    """Whether there are at most _FEW points (m, 2), all valid and without duplicates. Needs no sorting."""
    m = len(uv_px)
    if m > _FEW:
        return False
    good = are_valid(uv_px, cov_px2)
    for i in range(m):
        if not good[i]:
            return False
        for j in range(i):
            if (uv_px[i, 0] - uv_px[j, 0]) ** 2 + (uv_px[i, 1] - uv_px[j, 1]) ** 2 < DUPLICATE_PX**2:
                return False
    return True


def usable_rows(found: Detections) -> Bools | None:
    """Which points (n,) of one picture a tracker may use; None: all of them."""
    # One array type, because numba compiles every function again for each type.
    uv, cov = np.ascontiguousarray(found.uv_px, dtype=float), np.ascontiguousarray(found.cov_px2, dtype=float)
    if _few_and_valid(uv, cov):
        return None
    good: Bools = are_valid(uv, cov)
    rows = np.flatnonzero(good)
    some = uv[rows]
    size = cov[rows, 0, 0] + cov[rows, 1, 1]
    good[rows] = ~duplicates(np.zeros(len(rows), dtype=np.int64), some, np.lexsort((some[:, 1], some[:, 0])), size)
    return None if good.all() else good


@dataclass(frozen=True, slots=True)
class UsablePoints:
    """The valid detections of one frame."""

    found: tuple[Detections | None, ...]  # per camera; None without a picture
    rows: tuple[Ints | None, ...]  # per camera: their rows in the given detections; None: all of them

    @staticmethod
    def of(found: Sequence[Detections | None]) -> UsablePoints:
        """Drop invalid and duplicate detections of every camera. Raises ValueError: if an array has a wrong shape."""
        kept: list[Detections | None] = []
        rows: list[Ints | None] = []
        for points in found:
            good = None
            if points is not None:
                _check_shapes(points)
                good = usable_rows(points)
            kept.append(points if points is None or good is None else points[good])
            rows.append(None if good is None else np.flatnonzero(good))
        return UsablePoints(tuple(kept), tuple(rows))

    def with_given_rows(self, tracked: TrackedFrame, camera_of: Ints) -> TrackedFrame:
        """The tracked frame with `point` as rows of the given detections. camera_of (n,): the camera of each view."""
        if all(rows is None for rows in self.rows):  # the usual case
            return tracked
        point = tracked.point.copy()
        for camera, rows in enumerate(self.rows):
            mine = (camera_of == camera) & (point != UNMATCHED)
            if rows is not None:
                point[mine] = rows[point[mine]]
        return replace(tracked, point=point)


def check_step(dt_s: float, found: Sequence[Detections | None], cameras: Sequence[str], first: bool) -> None:
    """Check that a frame is later than the previous one and has one entry per camera.

    first: this is the first frame, for which dt_s may be 0. Raises ValueError: if dt_s or the number of entries is
    wrong.
    """
    if not np.isfinite(dt_s) or dt_s < 0 or (dt_s == 0 and not first):
        raise ValueError(
            f"dt_s: expected the seconds since the previous frame, more than 0 (0 for the first), got {dt_s!r};"
            " pass the frames in order of time, and all cameras of one instant together"
        )
    if len(found) != len(cameras):
        raise ValueError(
            f"found: expected detections, or None, for each of the cameras {', '.join(cameras)} in this order,"
            f" got {len(found)} entries"
        )


def _check_shapes(points: Detections) -> None:
    m = len(points)
    for name, shape in (("uv_px", (m, 2)), ("cov_px2", (m, 2, 2)), ("flux", (m,)), ("major_px", (m,))):
        if getattr(points, name).shape != shape:
            raise ValueError(f"{name}: expected shape {shape}, got {getattr(points, name).shape}")
