"""The experiment of Fu (2016) with pictures: Harris corners, RANSAC, the pose of five lamps, and the filter on it.

From 6 to 8 s the pictures are blurred, with more false lights and more hidden lamps. The filter predicts where the
lamps are searched, so a wrong pose would also spoil the next search.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geometry.arrays import Array, Bools
from geometry.pose import Pose
from geometry.rotations import ypr_jacobian
from lab.unscented.experiment_fu2016 import DT_S, simulate
from lab.unscented.tanker_pictures import CLEAR, GUST, marker_model, pose_of, render
from tracking.corner_markers.harris import harris_corners
from tracking.corner_markers.matching import MarkerMatch, MatchParameters, match_markers
from tracking.detections import UNMATCHED
from tracking.unscented.fu2016 import SPREAD, X0, Q, process
from tracking.unscented.robust import student_t_update
from tracking.unscented.ukf import predict, update

START_SIGMA = np.array([0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.1, 0.1])  # of X0, from GPS and INS: m, m/s, rad
POSED = [0, 1, 2, 6, 7]  # the numbers of the state that a pose measures
SEARCH_SIGMAS, SEARCH_PX, MOST_SEARCH_PX = 4.0, 3.0, 60.0  # radius of the search around a predicted lamp
WRONG_PX = 3.0  # a matched corner farther from its lamp has the wrong label


@dataclass(frozen=True, slots=True)
class PictureRun:
    """T pictures through the whole chain."""

    t_s: Array  # (T,)
    error: Array  # (T, 8) of the filter's states
    single: Array  # (T, 5) error of the pose of a single picture: x, y, z, m; yaw, pitch, rad; nan without one
    gust: Bools  # (T,)
    wrong: Bools  # (T,) a lamp has a wrong label
    sigma: Array  # (T, 8) the filter's


def run_pictures(seed: int, robust: bool, steps: int | None = None) -> PictureRun:
    """One recording of pictures; the same ones for both filters. steps: the first ones only."""
    recording = simulate(seed, 0, "none")
    rng, search = np.random.default_rng([seed, 71]), np.random.default_rng([seed, 72])
    model = marker_model()
    T = len(recording.t_s) if steps is None else steps
    x, P = X0, np.diag(START_SIGMA**2)
    error, single, sigma = np.full((T, 8), np.nan), np.full((T, 5), np.nan), np.full((T, 8), np.nan)
    wrong = np.zeros(T, dtype=bool)
    for k in range(T):
        state = recording.states[k]
        picture = render(state, GUST if recording.disturbed[k] else CLEAR, rng)
        if k:
            x, P = predict(x, P, process(DT_S), Q, SPREAD)
        corners = harris_corners(picture)
        expected = pose_of(x)
        parameters = replace(MatchParameters(), gate_px=_search_radius(x, P))
        match = match_markers(model, corners.uv_px, expected, search, parameters)
        if match is not None:
            z, R = _measured(match)
            rule = student_t_update if robust else update
            step = rule(x, P, z, lambda states: states[:, POSED], R, SPREAD)
            x, P = step.x, step.P
            single[k] = z - state[POSED]
            wrong[k] = _is_wrong(match, corners.uv_px, pose_of(state))
        error[k], sigma[k] = x - state, np.sqrt(np.diagonal(P))
    return PictureRun(recording.t_s[:T], error, single, recording.disturbed[:T], wrong, sigma)


def _search_radius(x: Array, P: Array) -> float:
    """px: how far a lamp may be from its predicted place."""
    _, J = marker_model().project(pose_of(x))
    order = [0, 1, 2, 7, 6]  # a turn about body y is the pitch, one about z the yaw, for small angles
    columns = J[..., [0, 1, 2, 4, 5]]
    spread = columns @ P[np.ix_(order, order)] @ np.swapaxes(columns, -1, -2)
    largest = float(np.sqrt(np.linalg.eigvalsh(spread)[:, 1].max()))
    return min(SEARCH_SIGMAS * largest + SEARCH_PX, MOST_SEARCH_PX)


def _measured(match: MarkerMatch) -> tuple[Array, Array]:
    """x, y, z, yaw, pitch (5,) of a pose, and their covariance."""
    pose = match.fit.world_from_body
    T = np.zeros((5, 6))
    T[:3, :3] = np.eye(3)
    T[3:, 3:] = ypr_jacobian(pose.rotation)[:2]
    return np.concatenate([pose.translation, pose.ypr[:2]]), T @ match.fit.covariance @ T.T


def _is_wrong(match: MarkerMatch, corners_px: Array, truth: Pose) -> bool:
    places, _ = marker_model().project(truth)
    matched = match.rows != UNMATCHED
    return bool(np.any(np.linalg.norm(corners_px[match.rows[matched]] - places[matched], axis=1) > WRONG_PX))
