"""IDF1, identity switches and MOTA by py-motmetrics, both cameras pooled."""

from __future__ import annotations

from dataclasses import dataclass

import motmetrics
import numpy as np

from bench.peers.identity import NEAR_PX
from bench.peers.rows import Tracked
from bench.peers.scenes import CAMERA_OF, CAMERAS, DETECTED, Scene


@dataclass(frozen=True, slots=True)
class MultiObject:
    """Figures over all frames of a scene, including its start."""

    idf1: float  # harmonic mean of identity precision and recall for the best assignment of identities
    switches: int  # changes of the identity that is matched to a spot
    mota: float  # 1 - (misses + false rows + switches) / detected spots; may be below 0


def score_multi_object(scene: Scene, rows: Tracked) -> MultiObject:
    """A row may match a detected spot within NEAR_PX; predictions do not count."""
    accumulators = []
    for c in range(CAMERAS):
        of_camera = np.flatnonzero((rows.camera == c) & rows.measured)
        of_camera = of_camera[np.argsort(rows.frame[of_camera], kind="stable")]
        cut = np.searchsorted(rows.frame[of_camera], np.arange(len(scene) + 1))
        accumulator = motmetrics.MOTAccumulator(auto_id=True)
        for k in range(len(scene)):
            spots = np.flatnonzero((c == CAMERA_OF) & (scene.state[k] == DETECTED))
            here = of_camera[cut[k] : cut[k + 1]]
            gap2 = np.sum((scene.uv_px[k, spots][:, None] - rows.uv_px[here][None]) ** 2, axis=-1)
            gap2 = np.where(gap2 < NEAR_PX**2, gap2, np.nan)
            accumulator.update(spots.tolist(), rows.identity[here].tolist(), gap2)
        accumulators.append(accumulator)
    figures = motmetrics.metrics.create().compute_many(
        accumulators, metrics=["idf1", "num_switches", "mota"], names=["left", "right"], generate_overall=True
    )
    overall = figures.loc["OVERALL"]
    return MultiObject(float(overall["idf1"]), int(overall["num_switches"]), float(overall["mota"]))
