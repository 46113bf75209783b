"""Errors of the positions of invisible spots: occluded, or outside the picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.peers.identity import distances, first_labels
from bench.peers.rows import Tracked
from bench.peers.scenes import Scene


@dataclass(frozen=True, slots=True)
class Unseen:
    """Errors of the positions without a detection, for spots in one state; nan where there are none."""

    covered: float  # share of these spot-frames that have a position with the first label of the spot
    rms_px: float
    p95_px: float
    max_px: float


def score_unseen(scene: Scene, rows: Tracked, state: int) -> Unseen:
    """The errors in one scene; state: HIDDEN or OUTSIDE."""
    gap = distances(scene, rows)
    errors = [
        gap[~rows.measured & (rows.identity == label) & (scene.state[rows.frame, s] == state), s]
        for s, label in enumerate(first_labels(scene, rows))
        if label is not None
    ]
    error = np.concatenate([e[np.isfinite(e)] for e in errors]) if errors else np.zeros(0)
    total = int((scene.state == state).sum())
    if not len(error):
        return Unseen(0.0 if total else np.nan, np.nan, np.nan, np.nan)
    rms = float(np.sqrt(np.mean(error**2)))
    return Unseen(len(error) / total, rms, float(np.percentile(error, 95)), float(error.max()))
