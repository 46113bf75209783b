"""What a tracker is given, looked at before it is believed: points that are none are taken away, and nothing else.

A point that is not a number, or whose covariance is none, would spoil every sum that it enters; one spot detected twice
would share its label between the two and lose it. Both are left out here. What is wrong with the call itself (a step
back in time, cameras that do not fit the rig) is an error of the caller and said as one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled
from tracking.detections import UNMATCHED, Detections
from tracking.tracked_frame import TrackedFrame

# Two points of one picture nearer than this are one spot detected twice: two spots of a few px width that lie so near
# melt into one.
TWIN_PX = 0.05
LEAST_SIGMA_PX = 1e-4  # a hundredth of what the best centroids reach: a claim below it is zero, or in another unit
LARGEST_PX = 1e6  # no picture is so wide; what is farther away overflows squares
_FEW = 50  # points: of fewer all pairs are sooner looked at than sorted (3 us a picture, against 20)
_LOOK_BACK = 100  # points compared with each: more of them in a stripe of TWIN_PX is no picture of spots


@compiled
def twins(group: Ints, uv: Array, order: Ints, size: Array) -> Bools:
    """Which of m points are another one of their group, detected again; of two the one of the larger size (m,) goes.

    uv (m, 2), px; order (m,): the rows sorted by group, then u, then v. Of equal sizes the later in that order goes.
    """
    m = len(order)
    out = np.zeros(m, np.bool_)
    for i in range(m):
        a = order[i]
        for back in range(i - 1, max(-1, i - 1 - _LOOK_BACK), -1):
            b = order[back]
            if group[b] != group[a] or uv[a, 0] - uv[b, 0] >= TWIN_PX:
                break
            if out[b] or (uv[a, 0] - uv[b, 0]) ** 2 + (uv[a, 1] - uv[b, 1]) ** 2 >= TWIN_PX**2:
                continue
            if size[b] > size[a]:
                out[b] = True
            else:
                out[a] = True
                break
    return out


@compiled
def believable(uv_px: Array, cov_px2: Array) -> Bools:
    """Which points (m, 2) are numbers, with covariances (m, 2, 2) that are covariances."""
    least, largest = LEAST_SIGMA_PX**2, LARGEST_PX**2
    out = np.zeros(len(uv_px), np.bool_)
    for i in range(len(uv_px)):
        a, b, c = cov_px2[i, 0, 0], cov_px2[i, 0, 1], cov_px2[i, 1, 1]
        out[i] = (
            abs(uv_px[i, 0]) < LARGEST_PX and abs(uv_px[i, 1]) < LARGEST_PX  # not so for nan
            and least <= a < largest and least <= c < largest
            # Beyond this share of its largest value a covariance is singular but for rounding.
            and b * b < (1 - 1e-9) ** 2 * a * c
            and abs(b - cov_px2[i, 1, 0]) <= 1e-9 * (a + c)
        )  # fmt: skip
    return out


@compiled
def _few_and_fine(uv_px: Array, cov_px2: Array) -> bool:
    """Whether all points (m, 2) can be used, said without sorting them; False of more than a few without a look."""
    m = len(uv_px)
    if m > _FEW:
        return False
    good = believable(uv_px, cov_px2)
    for i in range(m):
        if not good[i]:
            return False
        for j in range(i):
            if (uv_px[i, 0] - uv_px[j, 0]) ** 2 + (uv_px[i, 1] - uv_px[j, 1]) ** 2 < TWIN_PX**2:
                return False
    return True


def usable_rows(found: Detections) -> Bools | None:
    """Which points of one picture a tracker may use; None: all of them."""
    # One type of array, or numba would compile anew for each.
    uv, cov = np.ascontiguousarray(found.uv_px, dtype=float), np.ascontiguousarray(found.cov_px2, dtype=float)
    if _few_and_fine(uv, cov):
        return None
    good: Bools = believable(uv, cov)
    rows = np.flatnonzero(good)
    some = uv[rows]
    size = cov[rows, 0, 0] + cov[rows, 1, 1]
    good[rows] = ~twins(np.zeros(len(rows), dtype=np.int64), some, np.lexsort((some[:, 1], some[:, 0])), size)
    return None if good.all() else good


@dataclass(frozen=True, slots=True)
class UsablePoints:
    """One frame's detections without what cannot be used."""

    found: tuple[Detections | None, ...]  # per camera; None without a picture
    rows: tuple[Ints | None, ...]  # per camera: which of the rows given are these; None: all of them

    @staticmethod
    def of(found: Sequence[Detections | None]) -> UsablePoints:
        """Leave out of each camera's detections what cannot be used. ValueError for an array of a wrong shape."""
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

    def as_given(self, tracked: TrackedFrame, camera_of: Ints) -> TrackedFrame:
        """The tracker's answer, its points' rows counted as they were given. camera_of (n,): of each view."""
        if all(rows is None for rows in self.rows):  # as nearly always
            return tracked
        point = tracked.point.copy()
        for camera, rows in enumerate(self.rows):
            mine = (camera_of == camera) & (point != UNMATCHED)
            if rows is not None:
                point[mine] = rows[point[mine]]
        return replace(tracked, point=point)


def check_step(dt_s: float, found: Sequence[Detections | None], cameras: Sequence[str], first: bool) -> None:
    """Raises ValueError unless a frame comes after the one before and has an entry for each camera.

    first: no frame was before, and 0 s have passed.
    """
    if not np.isfinite(dt_s) or dt_s < 0 or (dt_s == 0 and not first):
        raise ValueError(
            f"dt_s: expected the seconds since the frame before, more than 0 (0 for the first), got {dt_s!r};"
            " give frames in order of time, and all cameras of one instant together"
        )
    if len(found) != len(cameras):
        raise ValueError(
            f"found: expected detections, or None, of each of the cameras {', '.join(cameras)} in this order,"
            f" got {len(found)}"
        )


def _check_shapes(points: Detections) -> None:
    m = len(points)
    for name, shape in (("uv_px", (m, 2)), ("cov_px2", (m, 2, 2)), ("flux", (m,)), ("major_px", (m,))):
        if getattr(points, name).shape != shape:
            raise ValueError(f"{name}: expected shape {shape}, got {getattr(points, name).shape}")
