"""Recorded paths of a few spots in one or two pictures, with false points, for the tests of continuity."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geometry.arrays import Array, Bools, Ints
from tracking.smoothing.labels.view_path import PathContext
from tracking.smoothing.motion.run_detections import RunDetections

FRAMES, SIGMA_PX = 120, 0.05
GAP = slice(50, 75)


def filmed(
    uv: Array, visible: Bools, false_points: float, seed: int, cameras: Sequence[int] | None = None
) -> tuple[RunDetections, Ints]:
    """Detections in random order, with false points within 60 px of the spots; the spots' rows (T, n).

    uv (T, n, 2), px; cameras: of each view, all in one by default.
    """
    rng = np.random.default_rng(seed)
    camera = np.zeros(uv.shape[1], dtype=np.int64) if cameras is None else np.array(cameras)
    rows, places, first = np.full(uv.shape[:2], -1), [], []
    for k in range(FRAMES):
        of_frame, begins = [], [0]
        for c in range(int(camera.max()) + 1):
            seen = np.flatnonzero(visible[k] & (camera == c))
            points = uv[k, seen] + SIGMA_PX * rng.normal(size=(len(seen), 2))
            mine = uv[k, camera == c]
            near = mine + rng.uniform(-60, 60, mine.shape)
            points = np.concatenate([points, near[rng.random(len(mine)) < false_points]])
            order = rng.permutation(len(points))
            of_frame.append(points[order])
            rows[k, seen] = begins[-1] + np.argsort(order)[: len(seen)]
            begins.append(begins[-1] + len(points))
        places.append(np.concatenate(of_frame))
        first.append(begins)
    counts = [len(p) for p in places]
    m = sum(counts)
    every = RunDetections(
        np.concatenate(places), np.tile(SIGMA_PX**2 * np.eye(2), (m, 1, 1)), np.zeros(m),
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64), np.array(first, dtype=np.int64),
        np.ones((FRAMES, int(camera.max()) + 1), dtype=bool), np.full(m, np.nan),
        np.full(uv.shape[1], np.nan),
    )  # fmt: skip
    return every, rows


def context(
    uv: Array, sigma_px: float = 300.0, false_points: float = 0.0, cameras: Sequence[int] | None = None
) -> PathContext:
    """A very uncertain pose in all frames of the gap."""
    open_views = np.zeros(uv.shape[:2], dtype=bool)
    open_views[GAP] = True
    density = max(false_points / 120.0**2, 1e-6)
    spread = np.tile(sigma_px**2 * np.eye(2), (*uv.shape[:2], 1, 1))
    camera = np.zeros(uv.shape[1], dtype=np.int64) if cameras is None else np.array(cameras)
    none_static = np.full(2 * uv[..., 0].size, -np.inf)
    return PathContext(camera, uv + 50.0, spread, np.full(uv.shape[:2], np.log(density)), none_static, open_views)


def without(rows: Ints, *frames: slice) -> Ints:
    """The rows (T, n) with no labels in some frames."""
    out = rows.copy()
    for f in frames:
        out[f] = -1
    return out
