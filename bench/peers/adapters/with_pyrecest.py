"""PyRecEst: three fixed targets per camera, associated by JPDA or by a global nearest neighbour.

Its trackers have neither births nor deaths; therefore, unlike the others, they get the true labels of frame 0.
"""

from __future__ import annotations

import logging
import warnings
from dataclasses import replace
from time import process_time
from typing import Any

import numpy as np
from pyrecest.distributions import GaussianDistribution
from pyrecest.filters import GlobalNearestNeighbor, JointProbabilisticDataAssociationFilter, KalmanFilter

from bench.peers.rows import Tracked
from bench.peers.scenes import CAMERA_OF, CAMERAS, Scene
from geometry.arrays import Array

SIGMA_PX, SIGMA_RATE = 0.3, 12.0  # px and px per frame: of a measurement, and of the velocity at frame 0
NEAR_PX = 3.0  # largest distance of the detection that is assigned to an estimate
DETECTED, CLUTTER_PER_PX2 = 0.93, 4e-5


def track(scene: Scene, association: str = "jpda", q: float = 2.0) -> Tracked:
    """Both cameras, one after the other. association: jpda or gnn; q: white acceleration, px per frame^2."""
    logging.getLogger("pyrecest").setLevel(logging.CRITICAL)  # one line per target and frame
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        start = process_time()
        estimates = [_estimates(scene, c, association, q) for c in range(CAMERAS)]
        spent_s = process_time() - start
    return _named(scene, estimates, spent_s)


def _estimates(scene: Scene, camera: int, association: str, q: float) -> list[Array]:
    """The positions (3, 2), px, of the three targets after every frame."""
    F = np.kron(np.eye(2), [[1.0, 1.0], [0.0, 1.0]])
    Q = np.kron(np.eye(2), q**2 * np.array([[0.25, 0.5], [0.5, 1.0]]))
    H = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0]])
    R = SIGMA_PX**2 * np.eye(2)
    first = np.diag([SIGMA_PX**2, SIGMA_RATE**2] * 2)
    start = scene.start_px[camera == CAMERA_OF]
    prior = [KalmanFilter(GaussianDistribution(np.array([u, 0, v, 0]), first)) for u, v in start]
    silent: dict[str, Any] = {"log_prior_estimates": False, "log_posterior_estimates": False}
    if association == "jpda":
        chances = {"detection_probability": DETECTED, "clutter_intensity": CLUTTER_PER_PX2}
        tracker = JointProbabilisticDataAssociationFilter(initial_prior=prior, association_param=chances, **silent)
    else:
        tracker = GlobalNearestNeighbor(initial_prior=prior, **silent)
    out = []
    for k, found in enumerate(scene.detections):
        if k:
            tracker.predict_linear(F, Q)
        if len(found[camera]):
            tracker.update_linear(found[camera].T, H, R)
        out.append(np.asarray(tracker.get_point_estimate()).reshape(4, -1)[[0, 2]].T)
    return out


def _named(scene: Scene, estimates: list[list[Array]], spent_s: float) -> Tracked:
    """Rows with the detections assigned to the estimates; without one the estimate is a prediction."""
    rows, measured = [], []
    for c, of_camera in enumerate(estimates):
        for k, positions in enumerate(of_camera):
            points = scene.detections[k][c]
            for i, position in enumerate(positions):
                gap = np.linalg.norm(points - position, axis=1)
                near = len(gap) > 0 and bool(gap.min() < NEAR_PX)
                rows.append((k, c, 3 * c + i, *(points[gap.argmin()] if near else position)))
                measured.append(near)
    return replace(Tracked.of(rows, spent_s), measured=np.array(measured))
