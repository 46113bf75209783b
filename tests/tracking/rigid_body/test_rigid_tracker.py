"""The rigid tracker as a whole: labels, poses, and the probabilities and covariances of both."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from geometry.arrays import Array, numeric_jacobian
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from geometry.rig import Rig
from lab.simulate.points import PointRun, simulate_points
from tests.tracking.rigid_runs import (
    RIGID,
    Assessment,
    Pooled,
    around_jumps,
    assess,
    dt_of,
    found_in,
    prior_of,
    selected_frames,
    tracked,
    with_occlusions,
    without_pictures,
)
from tracking.detections import UNMATCHED, Detections
from tracking.parameters import TrackerParameters
from tracking.rigid_body.rigid_tracker import RigidTracker
from tracking.statuses import PoseStatus, SpotStatus, TrackedFrame


@cache
def recorded(
    scenario: str, seed: int, frames: int = 200, hide: tuple[str, int] | None = None, clutter: float | None = None
) -> PointRun:
    run = simulate_points(scenario, seed, frames=frames, clutter=clutter)
    return run if hide is None else with_occlusions(run, around_jumps(run, *hide, seed))


@cache
def answers(
    scenario: str, seed: int, frames: int = 200, hide: tuple[str, int] | None = None, clutter: float | None = None
) -> list[TrackedFrame]:
    return tracked(recorded(scenario, seed, frames, hide, clutter))


def found_again(run: PointRun, of: Assessment) -> list[int]:
    """For each blackout, the number of frames after it until every visible spot was labelled."""
    blackout = ~of.visible.any(axis=1)
    complete = np.all(of.right | ~of.visible, axis=1)
    ends = np.flatnonzero(blackout[:-1] & ~blackout[1:]) + 1
    return [int(np.argmax(complete[end:])) if complete[end:].any() else 999 for end in ends.tolist()]


# -- labels -----------------------------------------------------------------------------------------------------------

LABEL_CASES: list[tuple[str, tuple[str, int] | None, float | None, int]] = [
    ("smooth", None, None, 0),
    ("smooth", None, 1.0, 1),
    ("sharp-turns", None, None, 0),
    ("sharp-turns", None, 1.0, 3),
    ("sharp-turns", ("one", 10), None, 4),  # four spots of the frame after a velocity jump wait: nothing checks them
    ("sharp-turns", ("two", 10), None, 9),  # likewise, three of three frames
    ("sharp-turns", ("screen", 10), None, 4),
    ("sharp-turns", ("all", 3), None, 8),
    ("sharp-turns", ("all", 10), None, 12),
    ("very-fast", None, None, 22),  # of 1000: three spots of a screen at once, at an unexpected turn
    ("four-skew-beams", None, None, 2),
    ("two-cameras-per-screen", None, None, 3),
]


@pytest.mark.parametrize(("scenario", "hide", "clutter", "lost"), LABEL_CASES)
def test_spots_keep_their_labels_through_velocity_jumps_and_occlusions(scenario, hide, clutter, lost):
    """200 frames with about 1100 visible spots: hardly any is missed, and none is labelled wrongly."""
    of = assess(recorded(scenario, 7001, 200, hide, clutter), answers(scenario, 7001, 200, hide, clutter))
    assert of.missed() <= lost
    assert of.wrong == 0


@pytest.mark.parametrize("frames", [3, 10])
def test_after_a_blackout_at_a_velocity_jump_the_vehicle_is_found_within_three_frames(frames):
    for seed in (7001, 7002):
        run = recorded("sharp-turns", seed, 200, ("all", frames))
        delays = found_again(run, assess(run, answers("sharp-turns", seed, 200, ("all", frames))))
        assert len(delays) >= 3
        assert max(delays) <= 3


def test_a_velocity_jump_after_frames_with_one_screen_is_not_taken_for_an_occlusion_of_the_other():
    """Measured before this was checked: after one such jump a screen had no labels for the remaining 450 frames."""
    run = recorded("sharp-turns", 8102, 200, ("screen", 3))
    of = assess(run, answers("sharp-turns", 8102, 200, ("screen", 3)))
    assert run.turned[147]
    assert run.turned[149]
    assert not of.visible[148].all()
    assert of.missed() == 0
    assert np.nanmax(of.nees) / 6 < 6


def test_a_search_that_finds_nothing_better_does_not_change_the_noise_scale():
    """The wrong labels of a search during an occlusion have a misfit of ten: for 200 frames the scale was 3."""
    for seed in (8100, 8105):
        run = recorded("sharp-turns", seed, 100, ("screen", 10))
        tracker = RigidTracker(run.rig, RIGID, prior_of(run))
        for k in range(100):
            tracker.step(dt_of(run, k), found_in(run, k))
            assert tracker.noise_scale < 1.3


def test_false_points_on_an_occluded_screen_are_hardly_ever_labelled():
    """The hardest case: many false points, and no spot of the same screen that contradicts them."""
    run = simulate_points("smooth", 7003, frames=150, clutter=1.0)
    hide = np.zeros(run.in_view.shape, dtype=bool)
    hide[40:60, run.model.camera_of == 0] = True
    hide[90:120, run.model.camera_of == 1] = True
    run = with_occlusions(run, hide)
    frames = tracked(run)
    of = assess(run, frames)
    false_points = sum(len(run.detections[k][0]) for k in range(40, 60))
    assert false_points > 30
    # A known limit: two false points, 3.9 and 1.5 px from where the occluded screen's spots would be, are taken for
    # them, and the errors of these frames' poses are much larger than their sigmas.
    assert of.wrong <= 2
    for k, v in zip(*np.nonzero(of.labelled & ~of.right), strict=True):
        point = run.detections[k][run.model.camera_of[v]].uv_px[frames[k].point[v]]
        assert np.linalg.norm(point - run.uv_px[k, v]) < 4
    # When the second screen reappears, spots that nothing checks wait: for 8 frames, as measured.
    assert of.missed() <= 19


TWIN_NOISE_PX = 0.5


def test_an_uncertain_label_is_left_open_with_an_event():
    """With false points within the noise of every second spot some labels cannot be decided.

    Their rows are not measured, and an event reports them.
    """
    run = simulate_points("sharp-turns", 7004, frames=150, clutter=1.0, noise_px=TWIN_NOISE_PX)
    twins = replace(run, detections=tuple(tuple(_with_twins(run, k, c) for c in range(2)) for k in range(150)))
    frames = tracked(twins)
    left_open = 0
    for f in frames:
        p = f.label_probability
        assert p is not None
        labelled = f.point != UNMATCHED
        assert np.all(p[labelled] >= RIGID.min_label_probability)
        for v in np.flatnonzero(~labelled & ~np.isnan(p)):
            left_open += 1
            assert not f.status[v].measured
            assert any(e.kind == "undecided" and e.view == v for e in f.events)
        assert [s.measured for s in f.status] == labelled.tolist()
    assert left_open > 0


def _with_twins(run: PointRun, k: int, camera: int) -> Detections:
    """A picture's detections, half of them with a false point that is near enough to be taken for the spot."""
    rng = np.random.default_rng([7004, k, camera])
    d = run.detections[k][camera]
    twins = d.uv_px[rng.random(len(d)) < 0.5]
    uv = np.concatenate([d.uv_px, twins + 2 * TWIN_NOISE_PX * rng.normal(size=twins.shape)])
    return Detections.at(uv, np.tile(TWIN_NOISE_PX**2 * np.eye(2), (len(uv), 1, 1)))


def test_spots_outside_the_picture_have_the_status_out_of_view():
    run = recorded("smooth", 7001)
    outside, reported = 0, 0
    for k, f in enumerate(answers("smooth", 7001)):
        for v in np.flatnonzero((run.in_view[k] == 0) & ~np.isnan(run.uv_px[k, :, 0])):
            outside += 1
            reported += f.status[v] is SpotStatus.OUT_OF_VIEW
            assert np.linalg.norm(f.uv_px[v] - run.uv_px[k, v]) < 2.0
    assert outside > 20
    assert reported >= 0.9 * outside  # some are at the border


# -- poses ------------------------------------------------------------------------------------------------------------


def test_a_smooth_motion_is_predicted_to_slightly_more_than_the_noise():
    of = Pooled([assess(recorded("smooth", s), answers("smooth", s)) for s in (7001, 7002)])
    assert np.all(of.prediction_px() <= 0.17)


def test_poses_are_better_than_single_frames_and_their_covariances_are_right():
    of = Pooled([assess(recorded("smooth", s), answers("smooth", s)) for s in (7001, 7002)])
    assert of.over_bound(rotation=False) < 0.95
    assert of.over_bound() < 1.0  # 0.85 over many runs: test_..._many_runs
    assert 0.8 < of.nees(observable=True) < 1.25
    # Some 380 poses, whose neighbours are correlated: errors in sigmas are neither small nor large.
    assert 0.8 < of.nees() < 1.3


def test_the_covariances_of_velocity_and_rate_are_right():
    run, frames = recorded("smooth", 7001), answers("smooth", 7001)
    chi2 = []
    for k in range(30, 199):
        dt = run.t_s[k + 1] - run.t_s[k - 1]
        true = run.poses[k + 1].minus(run.poses[k - 1]) / dt  # accurate to 1e-4 of the rate for a motion below 1 Hz
        motion = frames[k].motion
        assert motion is not None
        error = np.concatenate([motion.velocity - true[:3], motion.rate - true[3:]])
        chi2.append(error @ np.linalg.solve(motion.covariance, error))
    assert 0.4 < np.mean(chi2) / 6 < 2.0  # neighbouring frames are correlated: some 20 of 169 are independent


def test_dropped_frames_make_longer_steps():
    run = recorded("smooth", 7002, 200)
    rng = np.random.default_rng(1)
    keep = np.flatnonzero(rng.random(200) < 0.7)
    sparse = selected_frames(run, keep)
    assert max(np.diff(sparse.t_s)) > 0.03
    of = assess(sparse, tracked(sparse))
    assert of.missed() <= 3
    assert of.wrong == 0
    assert 0.7 < Pooled([of]).nees() < 1.4


@pytest.mark.parametrize("camera", [0, 1])
@pytest.mark.parametrize("gap", [1, 20])
def test_a_camera_without_pictures_for_some_frames_does_no_harm(camera, gap):
    run = without_pictures(recorded("smooth", 7005), slice(60, 60 + gap), camera)
    frames = tracked(run)
    of = assess(run, frames)
    assert of.wrong == 0
    assert of.missed() <= 10  # at the end of 20 frames with one camera some labels wait: nothing checks them
    without_picture = run.model.camera_of == camera
    for k in range(60, 60 + gap):
        words = {s for s, b in zip(frames[k].status, without_picture, strict=True) if b}
        assert words <= {SpotStatus.NO_IMAGE, SpotStatus.OFF_SCREEN}
        assert frames[k].pose is not None
    assert np.nanmean(of.nees[60:]) / 6 < 1.6


# -- full occlusion ---------------------------------------------------------------------------------------------------


@cache
def long_occlusion() -> tuple[PointRun, list[TrackedFrame]]:
    """A vehicle fully occluded from frame 60 until its pose is lost; it reappears at 360.

    Its beams make unequal angles: with equal ones two beams in the picture would be a tie.
    """
    run = simulate_points("unequal-fan", 7006, frames=420)
    hide = np.zeros(run.in_view.shape, dtype=bool)
    hide[60:360] = True
    run = with_occlusions(run, hide)
    return run, tracked(run)


def test_while_fully_occluded_the_covariance_grows_with_every_frame_until_the_pose_is_lost():
    run, frames = long_occlusion()
    words = [f.pose_status for f in frames]
    assert words[59] is PoseStatus.MEASURED
    last = next(k for k in range(60, 360) if words[k] is PoseStatus.LOST)
    assert 70 < last < 300
    assert set(words[60:last]) == {PoseStatus.PREDICTED}
    assert set(words[last:360]) == {PoseStatus.LOST}
    P = [f.pose_covariance for f in frames[59:last]]
    # In every direction, not only along the axes. False points may be taken for a spot, but never for the vehicle.
    for before, after in pairwise(P):
        sigma = np.sqrt(np.diagonal(after))
        assert np.linalg.eigvalsh((after - before) / np.outer(sigma, sigma))[0] > -1e-6
    assert all(f.pose is None and f.pose_covariance is None for f in frames[last:360])
    of = assess(run, frames)
    assert of.wrong == 0
    assert np.nanmax(of.nees[60:last]) / 6 < 4


def test_a_vehicle_that_reappears_after_seconds_is_found_with_an_event():
    run, frames = long_occlusion()
    of = assess(run, frames)
    assert found_again(run, of)[0] <= 3
    events = [e.kind for k in range(60, 420) for e in frames[k].events if e.kind != "undecided"]
    assert events == ["reacquired"]
    assert np.all(of.right[364:] == of.visible[364:])
    assert np.mean(of.nees[370:]) / 6 < 1.6


def test_each_label_found_from_a_prior_alone_leaves_an_event():
    run, frames = recorded("smooth", 7001), answers("smooth", 7001)
    kinds = [(k, e.kind) for k, f in enumerate(frames) for e in f.events if e.kind != "undecided"]
    assert kinds == [(0, "labelled")]
    assert assess(run, frames).right[0].sum() == assess(run, frames).visible[0].sum()


def test_a_tie_at_the_start_leaves_all_labels_open_until_the_third_beam_decides_it():
    """Beams A and B alone look like B and C turned by 20 deg (tests/tracking/labelling/test_first_labels.py)."""
    run = simulate_points("static", 7007, frames=40, clutter=0.0)
    pose = Pose.from_ypr(np.deg2rad([12.0, 0, 0]), np.zeros(3))
    uv = run.model.project(pose)[0]
    third = np.isin([name for _, name in run.model.views], ["3", "6"])
    tracker = RigidTracker(run.rig, RIGID, PosePrior(Pose.identity(), 0.5, np.deg2rad(30)))
    rng = np.random.default_rng(7)
    frames = []
    for k in range(30):
        visible = ~third if k < 15 else np.ones(len(third), dtype=bool)
        found: list[Detections | None] = []
        for c in range(2):
            at = uv[visible & (run.model.camera_of == c)]
            at = at + 0.1 * rng.normal(size=at.shape)
            found.append(Detections.at(at, np.tile(0.01 * np.eye(2), (len(at), 1, 1))))
        frames.append(tracker.step(0.01 if k else 0.0, found))
    for f in frames[:15]:
        assert f.pose_status is PoseStatus.LOST
        assert np.all(f.point == UNMATCHED)
    ties = [(k, e) for k, f in enumerate(frames) for e in f.events if e.kind == "tie"]
    assert [k for k, _ in ties] == [0]
    assert ties[0][1].text.count("yaw") == 2
    decided = next(k for k, f in enumerate(frames) if f.pose_status is PoseStatus.MEASURED)
    assert 15 <= decided <= 17
    for f in frames[decided:]:
        assert f.pose is not None
        assert np.abs(f.pose.minus(pose)).max() < 0.02
        assert np.all(f.point != UNMATCHED)


def test_false_points_anywhere_are_not_taken_for_a_vehicle():
    run = simulate_points("smooth", 7008, frames=30, clutter=0.0)
    rng = np.random.default_rng(7008)

    def anywhere(camera: int) -> Detections:
        size = run.model.image_size_px[run.model.camera_of == camera][0]
        uv = rng.uniform(-0.5, size - 0.5, (5, 2))
        return Detections.at(uv, np.tile(0.01 * np.eye(2), (5, 1, 1)))

    tracker = RigidTracker(run.rig, RIGID, prior_of(run))
    frames = [tracker.step(dt_of(run, k), [anywhere(0), anywhere(1)]) for k in range(30)]
    assert {f.pose_status for f in frames} == {PoseStatus.LOST}


@pytest.mark.slow
def test_false_points_near_occluded_spots_are_hardly_ever_taken_for_a_vehicle():
    """With the prior of the run three to five of 30 x 6 points near occluded spots sometimes fit a pose by chance.

    Measured: 7 of 40 such runs have a measured pose (22 before a search's pose had to check its own labels).
    """
    found = 0
    for seed in range(7001, 7021):
        run = simulate_points("smooth", seed, frames=30, clutter=1.0)
        run = with_occlusions(run, np.ones(run.in_view.shape, dtype=bool))
        found += any(f.pose_status is PoseStatus.MEASURED for f in tracked(run))
    assert found <= 4


# -- invariance -------------------------------------------------------------------------------------------------------


def seen_from(world_from_old: Pose, rig: Rig) -> Rig:
    """The same rig in another world frame."""
    return replace(
        rig,
        screens={n: replace(s, world_from_screen=world_from_old @ s.world_from_screen) for n, s in rig.screens.items()},
        cameras={
            n: replace(c, camera_from_world=c.camera_from_world @ world_from_old.inverse())
            for n, c in rig.cameras.items()
        },
    )


three = st.tuples(*[st.floats(-3, 3)] * 3)


@settings(max_examples=3, deadline=None)
@given(turn=three, shift=three, seed=st.integers(0, 99))
def test_the_choice_of_the_world_frame_changes_nothing(turn, shift, seed):
    """With a jerk set by hand: the estimated one has a strength for each axis of the world."""
    run = simulate_points("sharp-turns", 7100 + seed, frames=40)
    if seed % 2:
        run = with_occlusions(run, around_jumps(run, "all", 3, seed))
    T = Pose(Rotation.from_rotvec(turn).as_matrix(), np.array(shift))
    rig = seen_from(T, run.rig)
    p = prior_of(run)
    by_hand = replace(RIGID, learn_jerk=False)
    here, there = tracked(run, by_hand), tracked(run, by_hand, rig=rig, prior=replace(p, centre=T @ p.centre))
    S = np.zeros((6, 6))
    S[:3, :3], S[3:, 3:] = T.rotation, np.eye(3)  # dt is in world, dtheta in the body
    for a, b in zip(here, there, strict=True):
        np.testing.assert_array_equal(a.point, b.point)
        assert a.status == b.status
        assert a.pose_status is b.pose_status
        if a.pose is None:
            continue
        sigma = np.sqrt(np.diagonal(b.pose_covariance))
        assert np.all(np.abs(b.pose.minus(T @ a.pose)) < 1e-6 + 1e-3 * sigma)
        turned = S @ a.pose_covariance @ S.T
        np.testing.assert_allclose((turned - b.pose_covariance) / np.outer(sigma, sigma), 0, atol=1e-4)
        np.testing.assert_allclose(a.uv_px, b.uv_px, atol=1e-3)
        v_sigma = np.sqrt(np.diagonal(b.motion.covariance))
        moved = np.concatenate([T.rotation @ a.motion.velocity, a.motion.rate])
        assert np.all(np.abs(moved - np.concatenate([b.motion.velocity, b.motion.rate])) < 1e-3 * v_sigma)


def test_the_order_of_the_detections_changes_nothing():
    run = recorded("sharp-turns", 7001, 200, ("all", 3))
    rng = np.random.default_rng(36)
    orders = [[rng.permutation(len(d)) for d in frame] for frame in run.detections]
    shuffled = replace(
        run,
        detections=tuple(
            tuple(d[o] for d, o in zip(f, fo, strict=True)) for f, fo in zip(run.detections, orders, strict=True)
        ),
        origin=tuple(tuple(d[o] for d, o in zip(f, fo, strict=True)) for f, fo in zip(run.origin, orders, strict=True)),
    )
    one, other = assess(run, answers("sharp-turns", 7001, 200, ("all", 3))), assess(shuffled, tracked(shuffled))
    np.testing.assert_array_equal(one.labelled, other.labelled)
    np.testing.assert_array_equal(one.right, other.right)
    np.testing.assert_allclose(one.errors, other.errors, atol=1e-7)


def test_two_frames_of_one_instant_are_refused():
    run = recorded("smooth", 7001)
    tracker = RigidTracker(run.rig, RIGID, prior_of(run))
    tracker.step(0.0, found_in(run, 0))
    with pytest.raises(ValueError, match="dt"):
        tracker.step(0.0, found_in(run, 1))


def test_an_occluded_spot_has_the_covariance_that_follows_from_the_pose():
    """J P J^T, with a numerical Jacobian of the projection."""
    run = recorded("sharp-turns", 7001, 200, ("one", 10))
    checked = 0
    for f in answers("sharp-turns", 7001, 200, ("one", 10)):
        for v in [v for v, s in enumerate(f.status) if s is SpotStatus.OCCLUDED]:
            assert f.pose is not None
            pose, view = f.pose, v

            def place(d: Array, pose: Pose = pose, view: int = view) -> Array:
                return np.asarray(run.model.project(pose.plus(d))[0][view])

            J = numeric_jacobian(place, np.zeros(6))
            np.testing.assert_allclose(f.cov_px2[v], J @ f.pose_covariance @ J.T, rtol=1e-4, atol=1e-7)
            np.testing.assert_allclose(f.uv_px[v], place(np.zeros(6)), atol=1e-9)
            checked += 1
    assert checked >= 10


def test_sigmas_three_times_too_small_are_corrected():
    run = recorded("smooth", 7001)
    optimistic = tuple(tuple(replace(d, cov_px2=d.cov_px2 / 9) for d in frame) for frame in run.detections)
    optimistic_run = replace(run, detections=optimistic)
    tracker = RigidTracker(run.rig, RIGID, prior_of(run))
    frames = [tracker.step(dt_of(run, k), found_in(optimistic_run, k)) for k in range(200)]
    assert tracker.noise_scale == pytest.approx(3.0, rel=0.2)
    of = assess(run, frames)
    assert np.nanmean(of.nees[100:]) / 6 < 1.6
    assert of.wrong == 0
    # The scale follows after nine frames; until then a gate of five sigmas misses some spots.
    assert np.sum(of.visible[20:] & ~of.right[20:]) <= 3


def test_a_jerk_set_by_hand_is_kept_and_one_that_is_too_small_makes_predictions_worse():
    run = recorded("smooth", 7002)
    stiff = TrackerParameters(learn_jerk=False, jerk_m_s3=0.01, jerk_rad_s3=0.01)
    of, adapted = assess(run, tracked(run, stiff)), assess(run, answers("smooth", 7002))
    worse = Pooled([of]).prediction_px() / Pooled([adapted]).prediction_px()
    assert np.all(worse > 1.0)  # slightly along u: velocity jumps are followed as manoeuvres
    assert np.max(worse) > 1.2


# -- many runs --------------------------------------------------------------------------------------------------------

SEEDS = range(8100, 8108)  # no parameter was chosen on them

# The least identity of the causal pass, which leaves labels open until the next frame confirms them. The goals of the
# project for the result of a run are those of the smoothing pass: tests/tracking/smoothing/test_smoother.py.
MANY: list[tuple[str, tuple[str, int] | None, float | None, float]] = [
    ("smooth", None, None, 0.9995),
    ("smooth", None, 1.0, 0.9995),
    ("sharp-turns", None, None, 0.9995),
    ("sharp-turns", None, 1.0, 0.9995),
    ("sharp-turns", ("one", 3), None, 0.997),
    ("sharp-turns", ("one", 10), None, 0.997),
    ("sharp-turns", ("two", 3), None, 0.992),
    ("sharp-turns", ("two", 10), None, 0.99),
    ("sharp-turns", ("screen", 3), None, 0.996),
    ("sharp-turns", ("screen", 10), None, 0.99),
    ("sharp-turns", ("all", 3), None, 0.99),
    ("sharp-turns", ("all", 10), None, 0.99),
    ("very-fast", None, None, 0.998),
]


@pytest.mark.slow
@pytest.mark.parametrize(("scenario", "hide", "clutter", "identity"), MANY)
def test_over_eight_runs_of_600_frames_few_labels_are_open_none_wrong_and_the_sigmas_right(
    scenario, hide, clutter, identity
):
    runs = [simulate_points(scenario, s, frames=600, clutter=clutter) for s in SEEDS]
    if hide is not None:
        runs = [with_occlusions(run, around_jumps(run, *hide, s)) for run, s in zip(runs, SEEDS, strict=True)]
    of = [assess(run, tracked(run)) for run in runs]
    pooled = Pooled(of)
    assert pooled.identity >= identity
    assert pooled.wrong_share <= 2e-4
    assert 0.85 < pooled.nees(observable=True) < 1.15
    # A corner while all spots are occluded, which the causal pass cannot know, has rare errors beyond the sigmas.
    assert pooled.nees() <= (2.0 if hide is not None and hide[0] == "all" else 1.5)
    if hide is not None and hide[0] == "all":
        assert max(d for run, j in zip(runs, of, strict=True) for d in found_again(run, j)) <= 3
    if scenario == "smooth" and clutter is None:
        assert np.all(pooled.prediction_px() <= 0.17)
        assert pooled.over_bound() <= 0.95


@pytest.mark.parametrize("camera", [0, 1])
def test_with_a_camera_missing_for_long_the_covariance_stays_right_and_tracking_recovers(camera):
    """Spots of one screen leave a direction open; linearised, they determined it wrongly over many frames."""
    run = simulate_points("smooth", 7005, frames=220)
    has_image = run.has_image.copy()
    has_image[100:160, camera] = False
    run = replace(run, has_image=has_image)
    frames = tracked(run)
    squares = []
    for k, frame in enumerate(frames):
        if frame.pose is not None and frame.pose_covariance is not None:
            d = run.poses[k].minus(frame.pose)
            squares.append(float(d @ np.linalg.solve(frame.pose_covariance, d)))
    # 6 expected; 30 once in 25,000 frames, and these are correlated.
    assert max(squares) < 80
    assert all(frame.pose_status is PoseStatus.MEASURED for frame in frames[165:])
