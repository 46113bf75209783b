"""Multiple hypotheses: exact updates, weights, merging and pruning, branching with manoeuvres."""

from __future__ import annotations

import numpy as np
import pytest

from geometry.arrays import Array, Ints
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from lab.simulate.scenarios import RIGS
from tracking.rigid_body.association.frame_detections import (
    BLENDED,
    NOT_SEARCHED,
    DetectionModel,
    FrameDetections,
    Observation,
    ViewTable,
)
from tracking.rigid_body.hypotheses.branching import branch
from tracking.rigid_body.hypotheses.hypothesis_set import (
    MAX_CHILDREN,
    MAX_HYPOTHESES,
    PRUNE_NATS,
    Children,
    Dynamics,
    Hypotheses,
    State,
    add_child,
    empty_children,
    iterated_update,
    prune_and_merge,
)
from tracking.rigid_body.models.motion import ANY_MOMENT, STATE, predicted
from tracking.rigid_body.models.occlusion import MISSED

RIG = RIGS["fan"]()
MODEL = SpotModel.of(RIG)
N, GROUPS = len(MODEL), 2
VIEW_TABLE = ViewTable.of(RIG, MODEL)
NO_CALIBRATION_ERRORS = np.zeros((N, 2, 2))
NO_CLOCKS = np.zeros((2, 3))
DETECTION_MODEL = DetectionModel(0.98, 0.01)
DYNAMICS = Dynamics(np.repeat([400.0, 3600.0], 3), np.array([0.2, 0.5]) ** 2, np.array([2.0, 5.0]) ** 2, 0.02)
DT, SIGMA_PX = 0.01, 0.1
P_START = np.diag(np.repeat([2e-4, 1e-4, 0.02, 0.02, 1.0, 3.0], 3) ** 2)


def rotation_of(pose: Pose) -> Array:
    return np.ascontiguousarray(pose.rotation)


def a_frame(uv: Array, seen: Ints) -> FrameDetections:
    """A frame that shows the spots of these views at uv (n, 2), px, sorted by camera, and nothing else."""
    rows = [v for c in range(2) for v in seen if MODEL.camera_of[v] == c]
    first = np.array([0, *np.cumsum([np.sum(MODEL.camera_of[seen] == c) for c in range(2)])], dtype=np.int64)
    cov = np.tile(SIGMA_PX**2 * np.eye(2), (len(rows), 1, 1))
    m, clutter = len(rows), np.full(N, np.log(2e-4))
    return FrameDetections(
        uv[rows].reshape(-1, 2), cov, np.zeros(m), first, np.ones(2, dtype=bool), clutter,
        np.full(m, -np.inf), np.full(m, np.nan), np.full(N, np.nan), np.zeros(N), np.zeros(m),
    )  # fmt: skip


def observed(frame: FrameDetections) -> Observation:
    return Observation(
        MODEL.numbers, VIEW_TABLE, DETECTION_MODEL, NO_CALIBRATION_ERRORS, frame, NO_CALIBRATION_ERRORS,
        NO_CLOCKS, False,
    )  # fmt: skip


def rows_in(seen: Ints) -> Ints:
    """(n,) the row of each view in `a_frame` of the same views, MISSED for the others."""
    order = [v for c in range(2) for v in seen if MODEL.camera_of[v] == c]
    return np.array([order.index(v) if v in order else MISSED for v in range(N)], dtype=np.int64)


def one_hypothesis(pose: Pose, m: Array, P: Array) -> Hypotheses:
    return Hypotheses(
        rotation_of(pose)[None], pose.translation[None], m[None], P[None], np.zeros(1), np.full((1, N + GROUPS), 0.97)
    )


def children_of(weights: list[float], assigned: list[Ints], poses: list[Pose], P: Array = P_START) -> Children:
    out, count = empty_children(N, GROUPS), 0
    for w, a, pose in zip(weights, assigned, poses, strict=True):
        state = State(rotation_of(pose), pose.translation, np.zeros(12), P)
        count, _ = add_child(out, count, state, w, np.full(N + GROUPS, 0.9), a, False, 0)
    assert count == min(len(weights), MAX_CHILDREN)
    return out


@pytest.mark.parametrize("seen", [[0], [1, 4], [0, 1, 2, 3, 4, 5]], ids=["one spot", "two", "all"])
def test_an_iterated_update_finds_the_most_probable_pose_and_its_likelihood(seen):
    rng = np.random.default_rng(len(seen))
    pose = Pose.from_ypr(np.deg2rad([7.0, 0, 0]), np.zeros(3))
    views = np.array(seen)
    A = rng.normal(size=(STATE, 40)) * np.repeat([3e-3, 2e-3, 0.2, 0.3, 2.0, 5.0], 3)[:, None] / np.sqrt(40)
    P = A @ A.T
    true = pose.plus(np.linalg.cholesky(P[:6, :6]) @ rng.normal(size=6))
    uv = MODEL.project(true)[0] + SIGMA_PX * rng.normal(size=(N, 2))
    prior = State(rotation_of(pose), pose.translation, np.zeros(12), P)
    obs = observed(a_frame(uv, views))
    (R, t, m, P_after), log_likelihood, misfit, count = iterated_update(obs, prior, rows_in(views), prior.R, prior.t)
    assert count == len(seen)

    def cost(at: Pose) -> float:
        away, y = at.minus(pose), (uv - MODEL.project(at)[0])[views].ravel()
        return float(away @ np.linalg.solve(P[:6, :6], away) + y @ y / SIGMA_PX**2)

    found = Pose(R, t)
    assert misfit == pytest.approx(cost(found), rel=1e-6)
    sigma = np.sqrt(np.diagonal(P_after)[:6])
    for d in np.vstack([np.diag(sigma), -np.diag(sigma)]):
        assert cost(found.plus(0.1 * d)) > misfit - 1e-3  # it has converged to a hundredth of a sigma
    J = MODEL.project(found)[1][views].reshape(-1, 6)
    S = J @ P[:6, :6] @ J.T + SIGMA_PX**2 * np.eye(len(J))
    assert log_likelihood == pytest.approx(-0.5 * (misfit + np.linalg.slogdet(2 * np.pi * S)[1]), abs=1e-3)
    K = P[:, :6] @ J.T @ np.linalg.inv(S)
    scale = np.sqrt(np.diagonal(P))
    np.testing.assert_allclose((P_after - P + K @ J @ P[:6]) / np.outer(scale, scale), 0, atol=1e-4)
    m_expected = P[6:, :6] @ np.linalg.solve(P[:6, :6], found.minus(pose))
    np.testing.assert_allclose((m - m_expected) / scale[6:], 0, atol=0.02)


@pytest.mark.parametrize("sigma", [0.01, 0.1, 0.5, 2.0])
def test_no_prediction_however_vague_makes_a_likelihood_exceed_that_of_a_perfect_fit(sigma):
    """The iteration need not converge then; measured before its steps were halved: +6000 nats."""
    rng = np.random.default_rng(3)
    for trial in range(60):
        pose = Pose.from_ypr(np.deg2rad([7.0, 0, 0]) + rng.normal(0, 0.05, 3), rng.normal(0, 0.05, 3))
        away = pose.plus(rng.normal(0, min(sigma, 0.3), 6))
        P = np.diag(np.repeat([sigma, sigma, 4.0, 6.0, 30.0, 100.0], 3) ** 2)
        views = np.array([trial % N]) if trial % 2 else np.array([0, 1 + trial % (N - 1)])
        uv = MODEL.project(Pose.from_ypr(np.deg2rad([7.0, 0, 0]), np.zeros(3)))[0]
        if np.isnan(MODEL.project(away)[0][views]).any():
            continue
        prior = State(rotation_of(away), away.translation, np.zeros(12), P)
        obs = observed(a_frame(uv, views))
        (_, _, _, P_after), log_likelihood, misfit, _ = iterated_update(obs, prior, rows_in(views), prior.R, prior.t)
        perfect = -len(views) * np.log(2 * np.pi * SIGMA_PX**2)
        assert misfit >= 0
        assert log_likelihood <= perfect
        assert np.linalg.eigvalsh(P_after)[0] > 0


def test_an_assignment_is_impossible_if_its_pose_does_not_project_its_spot():
    """The beam misses the screen there: the spot must not be left out as if it had not been assigned."""
    away = Pose.from_ypr(np.array([np.pi, 0.0, 0.0]), np.zeros(3))
    prior = State(rotation_of(away), away.translation, np.zeros(12), P_START)
    obs = observed(a_frame(MODEL.project(Pose.identity())[0], np.array([0])))
    result = iterated_update(obs, prior, rows_in(np.array([0])), prior.R, prior.t)
    assert (result.log_likelihood, result.spots) == (-np.inf, 1)


def test_a_frame_without_spots_leaves_the_prediction_as_it_is():
    pose = Pose.from_ypr(np.array([0.1, 0.0, 0.0]), np.zeros(3))
    prior = State(rotation_of(pose), pose.translation, np.zeros(12), P_START)
    obs = observed(a_frame(np.zeros((N, 2)), np.zeros(0, dtype=np.int64)))
    state, *numbers = iterated_update(obs, prior, np.full(N, MISSED), prior.R, prior.t)
    np.testing.assert_array_equal(state.R, prior.R)
    np.testing.assert_array_equal(state.t, prior.t)
    np.testing.assert_array_equal(state.P, P_START)
    assert numbers == [0.0, 0.0, 0]


HERE = Pose.identity()
NEAR, FAR = HERE.plus(np.full(6, 1e-6)), HERE.plus(np.array([0.02, 0, 0, 0, 0.01, 0]))
ALL_SEEN = np.arange(N)
ONE_LESS = np.where(np.arange(N) == 2, MISSED, np.arange(N))


def test_the_probability_of_a_label_is_the_sum_over_the_hypotheses_that_agree():
    blended = np.where(np.arange(N) == 4, 4 + BLENDED, np.arange(N))
    weights = np.log([0.6, 0.3, 0.1])
    _, places, probability, _ = prune_and_merge(
        children_of(list(weights), [ALL_SEEN, ONE_LESS, blended], [HERE, FAR, NEAR]), len(weights)
    )
    assert places[0] == 0
    expected = np.ones(N)
    expected[2] = 0.7  # a blended detection is still that point of light
    np.testing.assert_allclose(probability, expected, rtol=1e-12)


def test_other_hypotheses_widen_the_covariance_by_their_distance_and_their_probability():
    children = children_of(list(np.log([0.8, 0.2])), [ALL_SEEN, ONE_LESS], [HERE, FAR])
    d = FAR.minus(HERE)
    np.testing.assert_allclose(prune_and_merge(children, 2)[3], 0.2 * np.outer(d, d), atol=1e-15)
    alone = children_of([0.0], [ALL_SEEN], [HERE])
    np.testing.assert_array_equal(prune_and_merge(alone, 1)[3], 0)


def test_hypotheses_with_the_same_labels_and_states_are_merged_with_both_weights():
    children = children_of(list(np.log([0.3, 0.4, 0.3])), [ALL_SEEN, ONE_LESS, ALL_SEEN], [HERE, HERE, NEAR])
    staying, places, _, _ = prune_and_merge(children, 3)
    assert sorted(places.tolist()) in ([0, 1], [1, 2])
    share = np.exp(staying.log_weight)
    np.testing.assert_allclose(sorted(share / share.sum()), [0.4, 0.6], rtol=1e-9)
    # The same labels with another pose are another hypothesis.
    assert len(prune_and_merge(children_of([0.0, 0.0], [ALL_SEEN, ALL_SEEN], [HERE, FAR]), 2)[1]) == 2


def test_the_likeliest_hypotheses_are_kept_and_very_unlikely_ones_dropped():
    poses = [HERE.plus(np.array([0.01 * k, 0, 0, 0, 0, 0])) for k in range(12)]
    children = children_of([-0.5 * k for k in range(12)], [ALL_SEEN] * 12, poses)
    staying, places, _, _ = prune_and_merge(children, 12)
    assert places.tolist() == list(range(MAX_HYPOTHESES))
    np.testing.assert_allclose(staying.log_weight, -0.5 * np.arange(MAX_HYPOTHESES))
    children = children_of([0.0, -PRUNE_NATS - 1.0], [ALL_SEEN] * 2, [HERE, FAR])
    assert prune_and_merge(children, 2)[1].tolist() == [0]


def test_if_there_is_no_room_a_better_child_replaces_the_worst():
    poses = [HERE] * MAX_CHILDREN
    children = children_of([float(-k) for k in range(MAX_CHILDREN)], [ALL_SEEN] * MAX_CHILDREN, poses)
    state, p_visible = State(np.eye(3), np.zeros(3), np.zeros(12), P_START), np.full(N + GROUPS, 0.5)
    full = MAX_CHILDREN
    assert add_child(children, full, state, -1000.0, p_visible, ONE_LESS, True, 7) == (full, -1)
    assert children.hypotheses.log_weight.min() == 1.0 - full
    count, place = add_child(children, full, state, -0.5, p_visible, ONE_LESS, True, 7)
    assert count == full
    assert children.hypotheses.log_weight.min() == 2.0 - full
    assert children.hypotheses.log_weight[place] == -0.5
    assert children.parent[place] == 7
    assert children.manoeuvre[place]


def branched(jump: Array, seen: Ints = ALL_SEEN) -> tuple[Children, int, Pose]:
    """A frame after a jump (6,) of the velocities: children, their number, and the true pose."""
    rng = np.random.default_rng(3)
    pose = Pose.from_ypr(np.deg2rad([7.0, 0, 0]), np.zeros(3))
    m = np.repeat([0.3, 0.5, 0.0, 0.0], 3)
    R, t, _, _, _ = predicted(
        rotation_of(pose), pose.translation, m + np.append(jump, np.zeros(6)), P_START, DT, np.zeros(6), np.zeros(2),
        np.zeros(2), *ANY_MOMENT,
    )  # fmt: skip
    uv = MODEL.project(Pose(R, t))[0] + SIGMA_PX * rng.normal(size=(N, 2))
    old = one_hypothesis(pose, m, P_START)
    obs = observed(a_frame(uv, seen))
    out, count = branch(obs, obs, DYNAMICS, DT, old)
    return out, count, Pose(R, t)


def test_a_steady_vehicle_is_not_tried_with_a_manoeuvre():
    children, count, true = branched(np.zeros(6))
    staying, places, probability, _ = prune_and_merge(children, count)
    assert not children.manoeuvre[:count].any()
    np.testing.assert_array_equal(children.assigned[places[0]], rows_in(ALL_SEEN))
    assert np.all(probability > 0.999)
    error = true.minus(Pose(staying.R[0], staying.t[0]))
    assert error @ np.linalg.solve(staying.P[0, :6, :6], error) < 22.5  # 99.9 % of six degrees


def test_a_velocity_jump_is_followed_by_a_manoeuvre_with_the_right_labels():
    children, count, true = branched(np.array([0.3, 0, -0.3, 1.2, -0.8, 0.5]))
    staying, places, probability, _ = prune_and_merge(children, count)
    assert children.manoeuvre[places[0]]
    np.testing.assert_array_equal(children.assigned[places[0]], rows_in(ALL_SEEN))
    assert np.all(probability > 0.99)
    error = true.minus(Pose(staying.R[0], staying.t[0]))
    assert error @ np.linalg.solve(staying.P[0, :6, :6], error) < 22.5


def test_the_covariance_of_an_occluded_vehicle_covers_a_manoeuvre():
    children, count, _ = branched(np.zeros(6), seen=np.zeros(0, dtype=np.int64))
    staying, places, _, _ = prune_and_merge(children, count)
    assert np.all(children.assigned[places[0]] <= MISSED)
    old = one_hypothesis(HERE, np.zeros(12), P_START)
    P = predicted(old.R[0], old.t[0], old.m[0], P_START, DT, DYNAMICS.jerk, np.zeros(2), np.zeros(2), *ANY_MOMENT)[3]
    grew = np.diagonal(staying.P[0])[6:12] - np.diagonal(P)[6:12]
    assert np.all(grew > 0.04 * np.repeat(DYNAMICS.velocity_jump, 3))


def test_views_without_a_picture_are_not_searched():
    rng = np.random.default_rng(4)
    pose = Pose.from_ypr(np.deg2rad([7.0, 0, 0]), np.zeros(3))
    left = np.flatnonzero(MODEL.camera_of == 0)
    uv = MODEL.project(pose)[0] + SIGMA_PX * rng.normal(size=(N, 2))
    frame = a_frame(uv, left)._replace(has_image=np.array([True, False]))
    old = one_hypothesis(pose, np.zeros(12), P_START)
    out, count = branch(observed(frame), observed(frame), DYNAMICS, DT, old)
    best = prune_and_merge(out, count)[1][0]
    assert np.all(out.assigned[best][MODEL.camera_of == 1] == NOT_SEARCHED)
    assert np.all(out.assigned[best][left] >= 0)
