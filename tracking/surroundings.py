"""How many false points there are where spots are looked for, learnt as the run goes on."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Ints
from geometry.spots import SpotModel
from tracking.association import Frame

RADIUS_PX = 15.0  # of the discs around the expected spots in which false points are counted
AREA_PX2 = np.pi * RADIUS_PX**2
START_PER_PX2 = 2e-4  # the paper's 20 % of false points within 15 px of a spot
MEMORY = 300.0  # discs looked at


class ClutterNearSpots:
    """The density of false points, by camera: near spots as counted, or in the whole picture if that is more."""

    def __init__(self, model: SpotModel, least_per_px2: float) -> None:
        self._camera_of = model.camera_of
        cameras = len(model.camera_names)
        self._area = np.array(
            [np.prod(model.image_size_px[model.camera_of == c][0]) if np.any(model.camera_of == c) else np.inf
             for c in range(cameras)]
        )  # fmt: skip
        self._least = least_per_px2
        self._near = np.full(cameras, START_PER_PX2)

    def log_density(self, first: Ints) -> Array:
        """(n,) of each view, log of 1/px^2, in a frame whose cameras' detections begin at `first` (cameras + 1,)."""
        density = np.maximum(np.maximum(self._near, np.diff(first) / self._area), self._least)
        return np.log(density)[self._camera_of]

    def learn(self, frame: Frame, assigned: Ints, expected_px: Array, known: bool) -> None:
        """Count the points beside the expected spots (n, 2) that were not assigned (n,) to any."""
        if not known or not len(frame.uv):
            return
        free = np.ones(len(frame.uv), dtype=bool)
        free[assigned[(assigned >= 0) & (assigned < len(free))]] = False
        for c in range(len(self._near)):
            views = np.flatnonzero((self._camera_of == c) & ~np.isnan(expected_px[:, 0]))
            if not frame.has_image[c] or not len(views):
                continue
            points = frame.uv[frame.first[c] : frame.first[c + 1]][free[frame.first[c] : frame.first[c + 1]]]
            gap2 = np.sum((expected_px[views, None] - points[None]) ** 2, axis=-1)
            rate = np.count_nonzero(gap2 < RADIUS_PX**2) / (len(views) * AREA_PX2)
            share = len(views) / MEMORY
            self._near[c] += share * (rate - self._near[c])
