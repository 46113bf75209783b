"""ByteTrack of the package `trackers`: it tracks boxes, so every point is the centre of a square."""

from __future__ import annotations

from time import process_time

import numpy as np
from supervision import Detections
from trackers import ByteTrackTracker

from bench.peers.rows import Tracked
from bench.peers.scenes import CAMERAS, Scene


def track(scene: Scene, half_px: float = 40.0, frames_kept: int = 25) -> Tracked:
    """One tracker per camera. half_px: half the side of the square, whose overlap is the gate."""
    start = process_time()
    trackers = [
        ByteTrackTracker(
            lost_track_buffer=frames_kept,
            frame_rate=30.0,  # at which the buffer counts frames
            minimum_consecutive_frames=2,
            minimum_iou_threshold=0.05,
        )
        for _ in range(CAMERAS)
    ]
    rows = []
    for k, found in enumerate(scene.detections):
        for c, points in enumerate(found):
            boxes = Detections(
                xyxy=np.hstack([points - half_px, points + half_px]).astype(np.float32),
                confidence=np.full(len(points), 0.95, np.float32),
                class_id=np.zeros(len(points), int),
            )
            named = trackers[c].update(boxes)
            if named.tracker_id is None:
                continue
            for box, identity in zip(named.xyxy, named.tracker_id, strict=True):
                if identity >= 0:
                    rows.append((k, c, int(identity), (box[0] + box[2]) / 2, (box[1] + box[3]) / 2))
    return Tracked.of(rows, process_time() - start)
