"""Stone Soup: a Kalman filter per target and a 2-D assignment of the points of each frame, as in its tutorials."""

from __future__ import annotations

import datetime
from collections.abc import Iterator
from time import process_time
from typing import Any

import numpy as np
from stonesoup.dataassociator.neighbour import GNNWith2DAssignment
from stonesoup.deleter.time import UpdateTimeStepsDeleter
from stonesoup.hypothesiser.distance import DistanceHypothesiser
from stonesoup.initiator.simple import MultiMeasurementInitiator
from stonesoup.measures import Mahalanobis
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
from stonesoup.predictor.kalman import KalmanPredictor
from stonesoup.tracker.simple import MultiTargetTracker
from stonesoup.types.detection import Detection
from stonesoup.types.state import GaussianState
from stonesoup.updater.kalman import KalmanUpdater

from bench.peers.rows import Tracked
from bench.peers.scenes import CAMERAS, Scene

SIGMA_PX, SIGMA_RATE = 0.3, 12.0  # px and px per frame: of a measurement, and of the velocity of a new target
FIRST_TIME = datetime.datetime(2024, 1, 1)  # Stone Soup uses dates; a frame is one second


def track(scene: Scene, q: float = 3.0, frames_kept: int = 25, gate_sigmas: float = 5.0) -> Tracked:
    """Both cameras, one after the other. q: diffusion of the constant-velocity model, px^2 per frame^3."""
    start = process_time()
    rows = []
    names: dict[str, int] = {}
    for c in range(CAMERAS):
        for k, (time, targets) in enumerate(_tracker(scene, c, q, frames_kept, gate_sigmas)):
            for target in targets:
                last = target[-1]
                hypothesis = getattr(last, "hypothesis", None)
                if hypothesis and last.timestamp == time:
                    u, v = hypothesis.measurement.state_vector
                    rows.append((k, c, names.setdefault(target.id, len(names)), float(u), float(v)))
    return Tracked.of(rows, process_time() - start)


def _tracker(scene: Scene, camera: int, q: float, frames_kept: int, gate_sigmas: float) -> MultiTargetTracker:
    measured = LinearGaussian(4, (0, 2), SIGMA_PX**2 * np.eye(2))
    predictor = KalmanPredictor(CombinedLinearGaussianTransitionModel([ConstantVelocity(q)] * 2))
    updater = KalmanUpdater(measured)
    hypothesiser = DistanceHypothesiser(predictor, updater, Mahalanobis(), missed_distance=gate_sigmas)
    variances = [SIGMA_PX**2, SIGMA_RATE**2] * 2
    initiator = MultiMeasurementInitiator(
        GaussianState([[640], [0], [512], [0]], np.diag(variances)),
        UpdateTimeStepsDeleter(2),
        GNNWith2DAssignment(hypothesiser),
        updater,
        measured,
        min_points=3,
    )

    def detector() -> Iterator[tuple[datetime.datetime, set[Any]]]:
        for k, found in enumerate(scene.detections):
            time = FIRST_TIME + datetime.timedelta(seconds=k)
            points = found[camera]
            yield time, {Detection(p[:, None], timestamp=time, measurement_model=measured) for p in points}

    deleter = UpdateTimeStepsDeleter(frames_kept)
    return MultiTargetTracker(initiator, deleter, detector(), GNNWith2DAssignment(hypothesiser), updater)
