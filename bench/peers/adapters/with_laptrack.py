"""laptrack: assignment from frame to frame, then of track ends across gaps; offline, without a motion model."""

from __future__ import annotations

from time import process_time

from laptrack import LapTrack

from bench.peers.linking import named_rows, points_table
from bench.peers.rows import Tracked
from bench.peers.scenes import CAMERAS, Scene


def track(scene: Scene, gate_px: float = 45.0, gap_px: float = 150.0, frames_kept: int = 20) -> Tracked:
    """Both cameras, one after the other. gap_px: largest distance of the start of a track from the end of another."""
    start = process_time()
    rows = []
    for c in range(CAMERAS):
        tracker = LapTrack(
            metric="sqeuclidean",
            cutoff=gate_px**2,
            gap_closing_metric="sqeuclidean",
            gap_closing_cutoff=gap_px**2,
            gap_closing_max_frame_count=frames_kept,
            splitting_cutoff=False,
            merging_cutoff=False,
        )
        table, _, _ = tracker.predict_dataframe(
            points_table(scene, c),
            coordinate_cols=["x", "y"],
            frame_col="frame",
            only_coordinate_cols=False,
            index_offset=0,
        )
        linked = table.reset_index()[["frame", "track_id", "x", "y"]]
        rows += named_rows(linked.rename(columns={"track_id": "piece"}), c)
    return Tracked.of(rows, process_time() - start)
