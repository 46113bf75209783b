"""How many false points there are where spots are looked for, learnt as the run goes on."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Ints
from geometry.forward_model import SpotModel

RADIUS_PX = 15.0  # of the discs around the expected spots in which false points are counted
AREA_PX2 = np.pi * RADIUS_PX**2
START_PER_PX2 = 2e-4  # the paper's 20 % of false points within 15 px of a spot
MEMORY = 300.0  # discs looked at
LEAST_COUNT = 0.5  # false points that a picture is taken to have when it shows none


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

    def log_density(self, first: Ints) -> tuple[Array, Array]:
        """(n,) of each view, log of 1/px^2, in a frame whose cameras' detections begin at `first` (cameras + 1,): of
        false points near spots, and the log of how much denser they are there than in the whole picture.
        """
        whole = np.maximum(np.diff(first), LEAST_COUNT) / self._area
        density = np.maximum(np.maximum(self._near, whole), self._least)
        return np.log(density)[self._camera_of], np.log(density / whole)[self._camera_of]

    def learn(self, near: Array, discs: Array) -> None:
        """Of one frame: how many false points (cameras,) lay within RADIUS_PX of how many expected spots (cameras,)."""
        share = discs / MEMORY
        self._near += share * (near / (np.maximum(discs, 1.0) * AREA_PX2) - self._near)
