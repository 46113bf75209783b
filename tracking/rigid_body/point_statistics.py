"""Online estimates about the points in the pictures: density of clutter, static points, and the spots' usual sizes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geometry.arrays import Ints
from geometry.forward_model import SpotModel
from tracking.detections import Detections
from tracking.parameters import TrackerParameters
from tracking.rigid_body.association.frame_detections import BLENDED, FrameDetections
from tracking.rigid_body.clutter import ClutterNearSpots
from tracking.rigid_body.frame_summary import FrameSummary
from tracking.rigid_body.static_points import (
    DECAY,
    SURE_LOG_DENSITY,
    PicturePoints,
    no_places,
    static_log_density,
    update_places,
)

SIZE_GAIN = 0.1  # weight of one frame in the usual size of a spot


class PointStatistics:
    """What is known of the points in the pictures of all cameras."""

    def __init__(self, model: SpotModel, parameters: TrackerParameters) -> None:
        self._parameters = parameters
        self._camera = np.ascontiguousarray(model.camera_of)
        self._clutter = ClutterNearSpots(model, parameters.labels.clutter_per_px2)
        self._static = no_places(len(model.camera_names))
        self._usual_size_px = np.full(len(model), np.nan)

    def frame(self, found: Sequence[Detections | None], noise_scale: float, first: bool) -> FrameDetections:
        """All cameras' detections in one list, with the errors and densities that are known so far.

        noise_scale: ratio of the spots' errors to their stated sigmas. first: no pose has been measured yet.
        """
        counts = [0 if f is None else len(f) for f in found]
        first_rows = np.zeros(len(found) + 1, dtype=np.int64)
        np.cumsum(counts, out=first_rows[1:])
        some = [f for f in found if f is not None]
        major = np.zeros(0)
        if some:
            uv = np.concatenate([f.uv_px for f in some])
            major = np.concatenate([f.major_px for f in some])
            # Contiguous in any case: numba compiles each function once per memory layout.
            cov = np.ascontiguousarray(np.concatenate([f.cov_px2 for f in some]) * noise_scale**2)
            cov[:, [0, 1], [0, 1]] += self._parameters.sigma_model_px**2
            blend = np.where(np.isnan(major), 0.0, self._parameters.blend_px)
        else:
            uv, cov, blend = np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0)
        has_image = np.array([f is not None for f in found])
        static = static_log_density(self._static, uv, cov, first_rows)
        if any(f.at_rest is not None for f in some):
            at_rest = np.concatenate([np.zeros(len(f)) if f.at_rest is None else f.at_rest for f in some]) > 0
            static[at_rest] = np.maximum(static[at_rest], SURE_LOG_DENSITY)
        log_clutter, log_excess = self._clutter.log_density(first_rows)
        if first:
            # The excess of clutter near spots must not make points without any spot evidence of a vehicle.
            log_clutter, log_excess = log_clutter - log_excess, np.zeros_like(log_excess)
        return FrameDetections(
            uv, cov, blend, first_rows, has_image, log_clutter, static, major, self._usual_size_px, log_excess
        )

    def update(self, frame: FrameDetections, assigned: Ints, summary: FrameSummary, measured: bool) -> None:
        """Take a frame with a pose and its assignment (n,); measured: its spots determine the pose."""
        self._clutter.update(summary.false_points, summary.discs)
        if measured:
            labels = np.where(assigned >= 0, assigned % BLENDED, -1)
            points = PicturePoints(frame.uv, frame.cov, frame.first, frame.has_image)
            update_places(self._static, points, labels, summary.expected_px, self._camera, DECAY)
        for v in np.flatnonzero(summary.use):
            size = frame.size_px[assigned[v]]
            if np.isfinite(size):
                old = self._usual_size_px[v]
                self._usual_size_px[v] = size if np.isnan(old) else old + SIZE_GAIN * (size - old)
