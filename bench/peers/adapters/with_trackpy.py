"""trackpy: linking by Crocker and Grier, with the velocity of the nearest neighbour as prediction."""

from __future__ import annotations

import warnings
from time import process_time

import trackpy

from bench.peers.linking import named_rows, points_table
from bench.peers.rows import Tracked
from bench.peers.scenes import CAMERAS, Scene


def track(scene: Scene, gate_px: float = 25.0, frames_kept: int = 20) -> Tracked:
    """Both cameras, one after the other."""
    trackpy.quiet()
    rows = []
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Could not generate velocity field")  # as in every first frame
        start = process_time()
        for c in range(CAMERAS):
            predictor = trackpy.predict.NearestVelocityPredict()
            linked = predictor.link_df(points_table(scene, c), search_range=gate_px, memory=frames_kept)
            rows += named_rows(linked.rename(columns={"particle": "piece"}), c)
        spent_s = process_time() - start
    return Tracked.of(rows, spent_s)
