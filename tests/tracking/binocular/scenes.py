"""Drogues in front of two cameras, as detected points."""

from __future__ import annotations

import numpy as np

from lab.targets.stereo.simulated_recording import drogue_markers, simulated_pair
from studies.zhou2020 import random_pose
from tracking.binocular.marker_model import MarkerImages, project_markers

PAIR = simulated_pair(1100.0, (1280, 1024))
MODEL = drogue_markers()
NOISE_PX = 0.1


def images(pose, rng, hidden=((), ()), false=0):
    """Candidates of both pictures in random order, with hidden markers and false points near the target."""
    pixels = project_markers(PAIR, MODEL, pose)[0]
    out = []
    for c in range(2):
        seen = np.setdiff1d(np.arange(len(MODEL)), hidden[c])
        uv = pixels[c, seen] + rng.normal(0, NOISE_PX, (len(seen), 2))
        uv = np.vstack([uv, pixels[c].mean(axis=0) + rng.uniform(-150, 150, (false, 2))])
        uv = rng.permutation(uv)
        cov = np.broadcast_to(NOISE_PX**2 * np.eye(2), (len(uv), 2, 2))
        out.append(MarkerImages(uv, cov, np.full(len(uv), np.nan), np.zeros(len(uv), dtype=np.int64)))
    return tuple(out)


def pose_at(distance, seed):
    return random_pose(distance, np.random.default_rng(seed))
