"""Online estimate of the density of false points near the expected spots."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Ints
from geometry.forward_model import SpotModel
from tracking.rigid_body.association.frame_detections import CLUTTER_RADIUS_PX

AREA_PX2 = np.pi * CLUTTER_RADIUS_PX**2
START_PER_PX2 = 2e-4  # the paper's 20 % of false points within 15 px of a spot
MEMORY = 300.0  # discs: time constant of the estimate
MIN_COUNT = 0.5  # false points that a picture without any is assumed to have


class ClutterNearSpots:
    """Density of false points by camera: as counted near spots, or that of the whole picture if it is higher."""

    def __init__(self, model: SpotModel, min_per_px2: float) -> None:
        self._camera_of = model.camera_of
        cameras = len(model.camera_names)
        self._area = np.array(
            [np.prod(model.image_size_px[model.camera_of == c][0]) if np.any(model.camera_of == c) else np.inf
             for c in range(cameras)]
        )  # fmt: skip
        self._min = min_per_px2
        self._near = np.full(cameras, START_PER_PX2)

    def log_density(self, first: Ints) -> tuple[Array, Array]:
        """Log density (n,) of false points near each view's spot, 1/px^2; its log ratio (n,) to the whole picture's.

        first (cameras + 1,): where the rows of each camera begin among the frame's detections.
        """
        whole = np.maximum(np.diff(first), MIN_COUNT) / self._area
        density = np.maximum(np.maximum(self._near, whole), self._min)
        return np.log(density)[self._camera_of], np.log(density / whole)[self._camera_of]

    def update(self, false_points: Array, discs: Array) -> None:
        """Take one frame: false points (cameras,) within CLUTTER_RADIUS_PX of so many expected spots (cameras,)."""
        share = discs / MEMORY
        self._near += share * (false_points / (np.maximum(discs, 1.0) * AREA_PX2) - self._near)
