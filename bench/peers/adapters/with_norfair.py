"""norfair on points: greedy matching by distance to constant-velocity filters."""

from __future__ import annotations

from time import process_time

from norfair import Detection, OptimizedKalmanFilterFactory, Tracker

from bench.peers.rows import Tracked
from bench.peers.scenes import CAMERAS, Scene


def track(scene: Scene, gate_px: float = 25.0, frames_kept: int = 25, R: float = 4.0, Q: float = 0.1) -> Tracked:
    """One tracker per camera. R, Q: measurement and process noise of norfair."""
    start = process_time()
    trackers = [
        Tracker(
            distance_function="euclidean",  # as mean_euclidean for one point per detection, without its warnings
            distance_threshold=gate_px,
            hit_counter_max=frames_kept,
            initialization_delay=2,
            past_detections_length=0,
            filter_factory=OptimizedKalmanFilterFactory(R=R, Q=Q),
        )
        for _ in range(CAMERAS)
    ]
    rows = []
    for k, found in enumerate(scene.detections):
        for c, points in enumerate(found):
            for seen in trackers[c].update(detections=[Detection(points=p[None], data=k) for p in points]):
                last = seen.last_detection
                if last.data == k:
                    rows.append((k, c, seen.id, last.points[0, 0], last.points[0, 1]))
    return Tracked.of(rows, process_time() - start)
