"""Turns of a run whose cameras have clocks of their own: when they are, to their stated sigmas, and instants."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from geometry.arrays import Array
from tests.tracking.smoothing.test_fixed_interval import DT, JERK, Run, drawn
from tracking.rigid_body.association.frame_detections import BLENDED
from tracking.rigid_body.models.motion import process_noise
from tracking.smoothing.motion.fixed_interval import smoothed
from tracking.smoothing.motion.instants import TOGETHER, Instants
from tracking.smoothing.motion.run_detections import Delays, RunDetections, Turn, WholeRun
from tracking.smoothing.motion.timed_run import _bounded, _near_unobserved, _observed
from tracking.smoothing.motion.turns import (
    TURN_NATS,
    TurnSearch,
    resolved_nats,
    successions,
    unresolved,
    velocity_jumps,
)

FRAMES, STEP = 40, 20  # that has the jump
SIZE = np.array([0.45, 4.7])  # variances of the jump that `drawn` makes


def search_in(run: Run) -> TurnSearch:
    """The likelihood of turns in a run of poses, a frame every DT."""
    frames = len(run.info.dt)
    density = np.ascontiguousarray(run.jerk)
    return TurnSearch(run.ref, run.info, density, np.zeros((frames, 2)), np.cumsum(run.info.dt), DT)


def found_in(seed: int, share: float) -> tuple[Turn | None, float]:
    """The turn found in a run whose velocities jump at this share of a step, and when they do."""
    run = drawn(seed, FRAMES, jump_at=STEP, moment=share)
    search = search_in(run)
    start_s = float(search.t_s[STEP] - 0.5 * DT)
    return search.improved(Turn(start_s, DT, DT, SIZE), []), float(search.t_s[STEP - 1] + share * DT)


def test_the_error_of_a_turn_is_as_stated_and_a_part_of_a_frame():
    found = [found_in(seed, share) for seed, share in enumerate(np.random.default_rng(5).uniform(size=30))]
    known = [(turn, at_s) for turn, at_s in found if turn is not None]
    assert len(known) == 30
    errors = np.array([turn.middle_s - at_s for turn, at_s in known])
    over = errors / np.array([turn.length_s for turn, _ in known]) * np.sqrt(12)
    assert 0.1 < np.sqrt(np.mean(over**2)) < 1.0
    assert np.abs(errors).max() < 0.2 * DT
    assert all(turn.length_s < DT for turn, _ in known)


@pytest.mark.slow
def test_poses_at_a_turn_without_spots_have_the_errors_that_they_state():
    """As the moment of a jump: the spots of both frames beside its step are missing, as in a gap of two frames."""
    nees, errors = [], []
    for seed, share in enumerate(np.random.default_rng(5).uniform(size=60)):
        run = drawn(seed, FRAMES, jump_at=STEP, moment=share)
        open_frames = slice(STEP - 1, STEP + 1)
        run.info.information[open_frames], run.info.vector[open_frames] = 0.0, 0.0
        search = search_in(run)
        turn = search.improved(Turn(float(search.t_s[STEP] - 0.5 * DT), DT, DT, SIZE), [])
        if turn is None:
            continue
        at_s = float(search.t_s[STEP - 1] + share * DT)
        assert turn.begin_s <= at_s <= turn.end_s
        errors.append(turn.middle_s - at_s)
        out = smoothed(*search.of_part([turn], slice(None)), search.density)
        for k in (STEP - 1, STEP):
            away = out.x[k, :6] - run.true[k, :6]
            nees.append(away @ np.linalg.solve(out.pose_P[k], away) / 6)
    assert len(errors) > 50
    assert np.mean(nees) == pytest.approx(1.0, abs=0.35)
    assert np.abs(errors).max() < 0.2 * DT


GAP = slice(STEP - 8, STEP + 8)


@pytest.mark.parametrize("seed", range(4))
def test_a_corner_in_a_gap_is_not_excluded_where_nearby_motion_is_much_faster(seed):
    """Jumps of the fastest motion's size in each step are less likely than none, and smaller ones are needed."""
    run = drawn(seed, FRAMES, jump_at=STEP, without_spots=GAP, jerk=0.1 * JERK)
    search, most, every = search_in(run), np.tile(1e5 * SIZE, (FRAMES, 1)), slice(None)

    def in_gap(share: float) -> tuple[float, float]:
        """Likelihood, and NEES/6 of the poses."""
        hidden = np.zeros((FRAMES, 2))
        hidden[GAP] = share * most[GAP]
        here = replace(search, hidden=hidden)
        out = smoothed(*here.of_part([], every), search.density)
        away = (out.x[:, :6] - run.true[:, :6])[GAP]
        nees = np.sum(away * np.linalg.solve(out.pose_P[GAP], away[..., None])[..., 0], axis=1)
        return here.nats([], every, search.density), float(np.mean(nees)) / 6

    assert in_gap(1.0)[0] < in_gap(0.0)[0] - 5
    assert in_gap(0.0)[1] > 20
    assert search.gap_share(GAP, most, []) == (False, 1.0)
    assert in_gap(1.0)[1] < 2


def test_a_gap_of_steady_motion_excludes_all_but_small_jumps():
    found = [
        search_in(drawn(seed, FRAMES, without_spots=GAP, jerk=0.1 * JERK)).gap_share(
            GAP, np.tile(1e2 * SIZE, (FRAMES, 1)), []
        )
        for seed in range(6)
    ]
    assert all(excluded for excluded, _ in found)
    assert max(share for _, share in found) < 1e-3


def test_two_turns_may_be_one_smooth_turn_only_where_the_spots_do_not_exclude_it():
    search = search_in(drawn(8, FRAMES, jump_at=STEP, moment=0.5))
    middle = float(search.t_s[STEP] - 0.5 * DT)
    turns = [Turn(middle, 0.1 * DT, 0.1 * DT, SIZE), Turn(middle + 2 * DT, 0.1 * DT, 0.1 * DT, 1e-4 * SIZE)]
    assert unresolved(turns, DT) == [turns]
    assert search.one_for(turns, turns) is None
    information = search.info.information.copy()
    information[STEP : STEP + 2] = 0.0
    vector = np.where(information.any(axis=2), search.info.vector, 0.0)
    less = replace(search, info=search.info._replace(information=information, vector=vector))
    one = less.one_for(turns, turns)
    assert one is not None
    assert one.begin_s <= middle
    assert one.end_s >= middle + 2 * DT


def test_turns_far_apart_do_not_resemble_a_smooth_one():
    turns = [Turn(k * DT, DT, DT, SIZE) for k in (5, 10, 12, 15.5, 20)]
    assert unresolved(turns, DT) == [turns[1:3]]


def test_a_turn_that_takes_some_frames_may_begin_and_end_between_spots():
    search = search_in(drawn(8, FRAMES))
    vector = search.info.vector.copy()
    vector[[STEP - 3, STEP + 3]] = 0.0
    search = replace(search, info=search.info._replace(vector=vector))
    turn = Turn(float(search.t_s[STEP]), 5.0 * DT, 5.0 * DT, SIZE)
    wider = search.to_next_spots(turn)
    assert (wider.begin_s, wider.end_s) == pytest.approx((search.t_s[STEP - 4], search.t_s[STEP + 4]))
    assert search.to_next_spots(turn._replace(likely_s=0.1 * DT)).length_s == turn.length_s
    beyond = turn._replace(middle_s=float(search.t_s[-1]) + 5 * DT)
    assert search.to_next_spots(beyond).length_s >= beyond.length_s


def test_a_settled_turn_stays_where_it_is():
    run = drawn(3, FRAMES, jump_at=STEP, moment=0.3)
    search = search_in(run)
    first = search.improved(Turn(float(search.t_s[STEP] - 0.5 * DT), DT, DT, SIZE), [])
    assert first is not None
    second = search.improved(first, [])
    assert second is not None
    assert second.settled
    third = search.improved(second, [])
    assert third is not None
    assert abs(third.middle_s - first.middle_s) < 0.02 * DT


def test_a_turn_of_steady_motion_is_dropped():
    search = search_in(drawn(4, FRAMES))
    turn = Turn(float(search.t_s[STEP] - 0.5 * DT), DT, DT, SIZE)
    assert search.improved(turn, []) is None
    density = search.without([turn], [turn])
    assert density is not None
    np.testing.assert_array_equal(density, search.density)


@pytest.mark.parametrize("times", [100.0, 1000.0])
def test_a_corner_smaller_than_the_fastest_motion_is_not_dropped(times):
    """A new turn has the size of the fastest motion; slow corners were less likely with that than without a turn."""
    search = search_in(drawn(6, FRAMES, jump_at=STEP))
    weak = replace(search, info=search.info._replace(information=search.info.information * 1e-5))
    weak = replace(weak, info=weak.info._replace(vector=search.info.vector * 1e-5))
    new = Turn(float(search.t_s[STEP] - 0.5 * DT), DT, DT, times * SIZE)
    every = slice(None)
    assert weak.nats([new], every, weak.density) < weak.nats([], every, weak.density) + TURN_NATS
    assert weak.without([new], [new]) is None
    found = weak.improved(new, [])
    assert found is not None
    assert np.all(found.size < 0.1 * new.size)


def test_a_stronger_jerk_replaces_turns_of_a_swing_but_not_a_corner():
    strong = np.tile(JERK, (FRAMES, 1))
    strong[STEP - 6 : STEP + 6] *= 1e4
    swing = search_in(drawn(6, FRAMES, jerk=strong))
    calm = replace(swing, density=np.tile(JERK, (FRAMES, 1)))
    turns = [Turn(float(calm.t_s[k] - 0.5 * DT), DT, DT, 0.1 * SIZE) for k in range(STEP - 5, STEP + 6, 2)]
    assert len(successions(turns, DT)) == 1
    density = calm.without(turns, turns)
    assert density is not None
    assert density[STEP].min() > 10 * JERK.max()
    corner = search_in(drawn(6, FRAMES, jump_at=STEP))
    turn = Turn(float(corner.t_s[STEP] - 0.5 * DT), DT, DT, SIZE)
    assert corner.without([turn], [turn]) is None


def test_a_jerk_counts_beside_turns_unless_the_spots_exclude_it():
    """Turns side by side explain few spots about as well as a smooth motion that is none of them."""
    run = drawn(6, FRAMES, jump_at=STEP)
    search, at = search_in(run), float(run.info.dt[: STEP + 1].sum() - 0.5 * DT)
    turns = [Turn(at, 0.1 * DT, 0.1 * DT, SIZE), Turn(at + 2 * DT, 0.1 * DT, 0.1 * DT, 1e-4 * SIZE)]
    assert search.without(turns, turns, -resolved_nats(turns, DT)) is None
    weak = replace(search, info=search.info._replace(information=1e-3 * search.info.information))
    weak = replace(weak, info=weak.info._replace(vector=1e-3 * search.info.vector))
    assert weak.without(turns[:1], turns[:1]) is None
    density = weak.without(turns[:1], turns[:1], -resolved_nats(turns[:1], DT))
    assert density is not None
    assert density[STEP].max() > 10 * search.density[STEP].max()


def test_a_jerk_in_place_of_turns_is_that_of_the_axis_that_turns():
    """A turntable turns about one axis; the same jerk of all six would be less likely than the turns."""
    axis, strong = 5, np.tile(JERK, (FRAMES, 1))
    strong[STEP - 6 : STEP + 6, axis] *= 1e6
    calm = replace(search_in(drawn(6, FRAMES, jerk=strong)), density=np.tile(JERK, (FRAMES, 1)))
    turns = [Turn(float(calm.t_s[k] - 0.5 * DT), DT, DT, SIZE) for k in range(STEP - 5, STEP + 6, 2)]
    density = calm.without(turns, turns)
    assert density is not None
    others = np.delete(np.arange(6), axis)
    assert density[STEP, axis] > 100 * density[STEP, others].max()


@pytest.mark.parametrize("seed", range(3))
def test_the_likelihood_of_more_turns_is_that_of_the_whole_part(seed):
    """Only their steps are filtered again."""
    search = search_in(drawn(seed, FRAMES, jump_at=STEP, moment=0.4))
    at, part = float(search.t_s[STEP] - 0.4 * DT), slice(3, FRAMES - 2)
    known = [Turn(at - 3 * DT, 2 * DT, 2 * DT, 0.3 * SIZE)]
    run = search.with_turns(known, part)
    own, beside = Turn(at, 0.2 * DT, 0.2 * DT, SIZE), Turn(at + 2 * DT, DT, DT, SIZE)
    overlapping, beyond = (Turn(at + apart * DT, 2 * DT, 2 * DT, SIZE) for apart in (-2, 17))
    for more in ([], [own], [own, beside], [overlapping], [beyond]):
        whole = search.nats([*known, *more], part, search.density)
        assert run.nats(more) == pytest.approx(whole, abs=1e-3), more


def covariance_after(jump: Array, moment: Array, dt: Array) -> Array:
    """Covariance (2, 2) of position and velocity of an axis after steps with these jumps."""
    P = np.zeros((2, 2))
    for variance, (later, spread), step in zip(jump, moment, dt, strict=True):
        F = np.array([[1.0, step], [0.0, 1.0]])
        pp, pv, _, vv, _, _ = process_noise(step, 0.0, variance, 0.0, later, spread)
        P = F @ P @ F.T + np.array([[pp, pv], [pv, vv]])
    return P


@pytest.mark.parametrize(("middle", "length"), [(0.011, 0.002), (0.012, 0.013), (0.0205, 0.003)])
def test_a_turn_adds_the_same_however_the_time_is_divided(middle, length):
    """White acceleration over its length, which ends `later` before the end."""
    turn = Turn(middle, length, length, np.array([2.0, 1.0]))
    for t_s in (np.array([0.0, 0.03]), np.array([0.0, 0.004, 0.01, 0.0115, 0.02, 0.021, 0.03])):
        jump, moment = velocity_jumps([turn], t_s)
        assert jump.sum(axis=0) == pytest.approx([2.0, 1.0])
        P = covariance_after(jump[1:, 0], moment[1:], np.diff(t_s))
        later = 0.03 - middle
        expected = 2.0 * np.array([[later**2 + length**2 / 12, later], [later, 1.0]])
        np.testing.assert_allclose(P, expected, rtol=1e-9)


def test_a_turn_of_a_whole_step_is_a_jump_at_an_unknown_moment():
    jump, moment = velocity_jumps([Turn(0.015, 0.01, 0.01, SIZE)], np.array([0.0, 0.01, 0.02]))
    assert jump[2] == pytest.approx(SIZE)
    np.testing.assert_allclose(
        process_noise(0.01, 0.0, 1.0, 0.0, *moment[2]), process_noise(0.01, 0.0, 1.0, 0.0, -1.0, 0.0)
    )


def test_the_noise_of_a_jump_at_a_known_moment_is_that_of_drawn_jumps():
    rng = np.random.default_rng(3)
    later, spread, dt = 0.004, 0.001, 0.01
    jump, after = rng.normal(size=400_000), later + spread * rng.normal(size=400_000)
    drawn_cov = np.cov(jump * after, jump)
    pp, pv, _, vv, _, _ = process_noise(dt, 0.0, 1.0, 0.0, later, spread)
    np.testing.assert_allclose([pp, pv, vv], [drawn_cov[0, 0], drawn_cov[0, 1], drawn_cov[1, 1]], rtol=0.02)


def test_each_labelled_spot_is_at_its_own_instant_among_those_of_the_frames():
    rng = np.random.default_rng(7)
    frames, n = 30, 4
    begin, after = np.arange(frames + 1) * n, rng.uniform(-0.6, 0.6, frames * n) * DT
    uv, cov = rng.normal(size=(frames * n, 2)), np.tile(np.eye(2), (frames * n, 1, 1))
    seen = RunDetections(
        uv, cov, np.zeros(frames * n), begin, np.tile([0, n], (frames, 1)), np.ones((frames, 1), bool),
        np.ones(frames * n), np.ones(n),
    )  # fmt: skip
    assigned = np.array([rng.permutation(n) for _ in range(frames)])
    assigned[rng.random(assigned.shape) < 0.2] = -1
    assigned[5, 1] = 2 + BLENDED
    used = np.arange(frames) != 11
    delays = Delays(after, np.full(frames * n, 1e-6), np.zeros(frames * n), np.zeros((frames, 1, 3)))
    views = np.zeros(n)
    dt = np.r_[0.0, np.full(frames - 1, DT)]
    instants = Instants.of(WholeRun(views, seen, cov[:n], dt, 0.0, True, delays), assigned, used)
    t_s = np.cumsum(dt)
    np.testing.assert_allclose(instants.t_s[instants.of_frame], t_s, atol=1e-15)
    assert np.diff(instants.t_s).min() > 0.4 * TOGETHER * DT
    np.testing.assert_array_equal(instants.frame[instants.of_frame], np.arange(frames))
    own, whole = instants.run.delays, instants.run.detections
    assert own is not None
    assert np.abs(own.after_s).max() <= TOGETHER * DT
    found = {}
    for f, view in np.argwhere(instants.assigned >= 0).tolist():
        row = whole.begin[f] + instants.assigned[f, view] % BLENDED
        blended = bool(instants.assigned[f, view] >= BLENDED)
        found[view, tuple(whole.uv[row])] = float(instants.t_s[f] + own.after_s[row]), blended
    expected = {}
    for k, view in np.argwhere((assigned >= 0) & used[:, None]).tolist():
        row = begin[k] + assigned[k, view] % BLENDED
        expected[view, tuple(uv[row])] = t_s[k] + after[row], bool(assigned[k, view] >= BLENDED)
    assert found.keys() == expected.keys()
    for key, (at_s, blended) in expected.items():
        assert found[key] == (pytest.approx(at_s, abs=1e-12), blended)


def test_turns_side_by_side_need_more_evidence_the_more_there_are():
    """Five within a smooth turn of seven frames followed it to 55 nats. Motion in between shows corners one by one."""

    def needed(apart: float, count: int) -> float:
        turns = [Turn(apart * DT * i, 0.1 * DT, 0.1 * DT, SIZE) for i in range(count)]
        return resolved_nats(turns, DT)

    assert needed(1.3, 5) == 2.5 * needed(1.3, 2)
    assert needed(3.0, 5) == needed(1.3, 2) == needed(1.3, 1)


def test_a_jump_beside_a_gap_may_be_in_the_gap():
    """Half-frame steps; frames 5 and 6 have no pose. The steps within a frame of these are open, too."""
    t_s = 0.5 * DT * np.arange(24)
    measured = (t_s < 4.9 * DT) | (t_s > 6.1 * DT)
    steps = _near_unobserved(measured, t_s, DT)
    begin = np.append(t_s[:1], t_s[:-1])
    assert not steps[t_s < 4.4 * DT].any()
    assert steps[(t_s > 4.9 * DT) & (begin < 7.4 * DT)].all()
    assert not steps[begin > 7.6 * DT].any()
    assert not _near_unobserved(np.ones(24, dtype=bool), t_s, DT).any()


def test_before_the_first_measured_frame_and_after_the_last_nothing_shows_a_jump():
    measured = np.zeros(12, dtype=bool)
    measured[[3, 5, 8]] = True
    np.testing.assert_array_equal(np.flatnonzero(_observed(measured, 1)), [3, 4, 5, 6, 7, 8])
    np.testing.assert_array_equal(np.flatnonzero(_observed(measured, 0)), [3, 5, 8])


def test_beside_a_gap_frames_without_a_pose_show_no_jump_however_slow_a_camera_is():
    """A swing began in a gap, and the frames before the slow camera's next picture were taken for steady."""
    measured = np.zeros(40, dtype=bool)
    measured[[2, 5, 8, 11, 26, 29, 32, 35]] = True
    bounded = _bounded(measured, 3)
    np.testing.assert_array_equal(np.flatnonzero(bounded), [*range(2, 12), *range(26, 36)])
