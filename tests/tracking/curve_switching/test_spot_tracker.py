"""The curve-switching tracker on simulated points: identities, predictions, and the statuses of spots not in view."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest

from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from lab.simulate.points import PointRun, simulate_points
from lab.simulate.scenarios import RIGS, SCENARIOS, Clutter, Occlusion
from tests.marks import further_slow
from tracking.curve_switching.out_of_view import CoplanarViews, quadratic_positions
from tracking.curve_switching.spot_tracker import SpotTracker
from tracking.curve_switching.vehicle import Tracks
from tracking.detections import UNMATCHED, Detections
from tracking.parameters import TrackerParameters
from tracking.statuses import PoseStatus, SpotStatus, TrackedFrame

PAPER = TrackerParameters(rigid_check=False, estimate="prediction", out_of_view="quadratic")  # the paper's method
START_FRAMES = 2  # frames before the first rate is known
TURN_FRAMES = 2  # the frame after a bend, and the next one, whose rate is a mean over the bend


def new_tracker(run: PointRun, parameters: TrackerParameters) -> SpotTracker:
    p = run.prior
    centre = Pose.from_ypr(np.deg2rad(p.yaw_pitch_roll_deg), np.array(p.position_m))
    return SpotTracker(run.rig, parameters, PosePrior(centre, p.within_m, float(np.deg2rad(p.within_deg))))


def track(run: PointRun, parameters: TrackerParameters | None = None) -> list[TrackedFrame]:
    tracker = new_tracker(run, TrackerParameters() if parameters is None else parameters)
    return [
        tracker.step(
            float(run.t_s[k] - run.t_s[k - 1]) if k else 0.0,
            [d if run.has_image[k, c] else None for c, d in enumerate(run.detections[k])],
        )
        for k in range(len(run.frame))
    ]


@dataclass(frozen=True)
class Tracked:
    """A recording and the tracker's results: F frames, n views."""

    run: PointRun
    frames: list[TrackedFrame]

    @property
    def status(self) -> np.ndarray:
        return np.array([f.status for f in self.frames])

    @property
    def uv_px(self) -> np.ndarray:
        return np.array([f.uv_px for f in self.frames])

    @property
    def predicted_px(self) -> np.ndarray:
        return np.array([f.predicted_px for f in self.frames])

    @property
    def point(self) -> np.ndarray:
        return np.array([f.point for f in self.frames])

    @property
    def taken(self) -> np.ndarray:
        """(F, n): the true origin of the detection assigned to each view; -9 without one."""
        out = np.full(self.point.shape, -9)
        for k, v in zip(*np.nonzero(self.point != UNMATCHED), strict=True):
            out[k, v] = self.run.origin[k][self.run.model.camera_of[v]][self.point[k, v]]
        return out

    @property
    def right(self) -> np.ndarray:
        return self.taken == np.arange(self.point.shape[1])

    def identity(self) -> float:
        """Share of the visible spots that have the right label."""
        shining = self.run.in_view == 1
        return float((self.right & shining).sum() / shining.sum())

    def prediction_rms(self) -> np.ndarray:
        """RMS prediction error per axis, px, over spots in view, except at the start and at bends."""
        bend = np.zeros(len(self.frames), dtype=bool)
        for later in range(TURN_FRAMES):
            bend[later:] |= self.run.turned[: len(bend) - later]
        use = (self.run.in_view == 1) & ~bend[:, None]
        use[:START_FRAMES] = False
        gap = (self.predicted_px - self.run.uv_px)[use]
        return np.sqrt(np.nanmean(gap**2, axis=0))


@cache
def tracked(scenario: str, seed: int, frames: int) -> Tracked:
    run = simulate_points(scenario, seed, frames=frames)
    return Tracked(run, track(run))


# -- identity and prediction ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("scenario", "identity", "rms_px"), further_slow([("sharp-turns", 0.995, 0.40), ("smooth", 0.999, 0.30)])
)
@pytest.mark.parametrize("seed", further_slow([21, 22]))
def test_identity_and_prediction_error_reach_the_projects_goals(scenario, identity, rms_px, seed):
    """20 % clutter, 0.1 px noise, 250 frames."""
    t = tracked(scenario, seed, 250)
    assert t.identity() >= identity
    assert t.prediction_rms().max() <= rms_px


@pytest.mark.slow
@pytest.mark.parametrize(("scenario", "identity", "rms_px"), [("smooth", 0.999, 0.30), ("sharp-turns", 0.995, 0.40)])
def test_identity_and_prediction_error_reach_the_goals_over_eight_runs_of_600_frames(scenario, identity, rms_px):
    runs = [tracked(scenario, seed, 600) for seed in range(31, 39)]
    assert np.mean([t.identity() for t in runs]) >= identity
    assert np.sqrt(np.mean([t.prediction_rms() ** 2 for t in runs], axis=0)).max() <= rms_px


@pytest.mark.parametrize("scenario", ["four-skew-beams", "two-cameras-per-screen", "fast", "static"])
def test_spots_of_other_rigs_and_speeds_keep_their_labels(scenario):
    assert tracked(scenario, 23, 100).identity() >= 0.995


def test_the_papers_method_alone_tracks_smooth_motion():
    run = simulate_points("smooth", 25, frames=150)
    t = Tracked(run, track(run, PAPER))
    assert t.identity() >= 0.99


def test_spots_far_from_their_prediction_at_a_bend_are_turned():
    """Within r1 = 10 px of its prediction a spot is `matched`, beyond that it is `turned`; all of them are found."""
    t = tracked("sharp-turns", 21, 250)
    gap = np.linalg.norm(t.predicted_px - t.run.uv_px, axis=-1)
    near, far = t.right & (gap < 9.5), t.right & (gap > 10.5)
    assert far.sum() > 30
    assert set(t.status[near]) == {SpotStatus.MATCHED}
    assert set(t.status[far]) == {SpotStatus.TURNED}


# -- poses ------------------------------------------------------------------------------------------------------------


def test_the_covariance_of_measured_poses_is_correct():
    """The expected NEES is 6; without correlations the mean of 500 poses scatters by 0.2."""
    nees = []
    for scenario in ("smooth", "sharp-turns"):
        t = tracked(scenario, 21, 250)
        for k, f in enumerate(t.frames):
            if f.pose_status is PoseStatus.MEASURED:
                error = t.run.poses[k].minus(f.pose)
                nees.append(error @ np.linalg.solve(f.pose_covariance, error))
    assert len(nees) > 480
    assert 5.0 < np.mean(nees) < 7.0


def test_the_fields_of_a_frame_agree_with_each_other():
    t = tracked("smooth", 21, 250)
    for f in t.frames:
        matched = sum(s.measured for s in f.status)
        if f.pose_status is PoseStatus.MEASURED:
            assert 3 <= f.spots_used <= matched
            assert f.rms_px < 1.0
        for s, p, g in zip(f.status, f.point, f.gain, strict=True):
            assert s.measured == (p != UNMATCHED)
            assert s.measured or np.isnan(g)


# -- statuses ---------------------------------------------------------------------------------------------------------


def with_hidden(run: PointRun, hide: dict[int, set[int]]) -> PointRun:
    """The recording without the detections of some views. hide: frame -> views."""
    detections, origin = list(run.detections), list(run.origin)
    in_view = run.in_view.copy()
    for k, views in hide.items():
        keep = [~np.isin(o, list(views)) for o in run.origin[k]]
        detections[k] = tuple(d[rows] for d, rows in zip(run.detections[k], keep, strict=True))
        origin[k] = tuple(o[rows] for o, rows in zip(run.origin[k], keep, strict=True))
        in_view[k, list(views)] = np.where(in_view[k, list(views)] == 1, 2, in_view[k, list(views)])
    return replace(run, detections=tuple(detections), origin=tuple(origin), in_view=in_view)


def test_a_hidden_spot_is_occluded_and_the_others_give_its_position():
    run = with_hidden(simulate_points("smooth", 26, frames=60, clutter=0.0), {k: {1} for k in range(30, 40)})
    t = Tracked(run, track(run))
    assert set(t.status[30:40, 1]) == {SpotStatus.OCCLUDED}
    assert set(t.status[40:, 1]) == {SpotStatus.MATCHED}
    assert np.abs(t.uv_px[30:40, 1] - run.uv_px[30:40, 1]).max() < 1.5
    others = [v for v in range(len(run.model)) if v != 1 and run.in_view[30:40, v].all()]
    assert np.all(t.status[30:40][:, others] == SpotStatus.MATCHED)


def test_a_spot_outside_the_image_is_out_of_view_and_known_to_a_pixel():
    t = tracked("smooth", 21, 250)
    outside = ~t.run.model.in_picture(t.run.uv_px, margin_px=2.0) & np.isfinite(t.run.uv_px[..., 0])
    assert outside.sum() > 20
    assert set(t.status[outside]) == {SpotStatus.OUT_OF_VIEW}
    gap = np.linalg.norm(t.uv_px - t.run.uv_px, axis=-1)[outside]
    assert np.sqrt(np.mean(gap**2)) < 1.0
    inside = t.run.model.in_picture(t.run.uv_px) & (t.status == SpotStatus.OUT_OF_VIEW)
    margin = ~t.run.model.in_picture(t.run.uv_px, margin_px=-2.0)
    assert not np.any(inside & ~margin)


def test_a_missing_picture_is_no_image_and_its_spots_are_estimated():
    """One camera has no pictures for five frames: the pose is predicted from the other one's spots and the motion."""
    run = simulate_points("static", 27, frames=30)
    gone = run.has_image.copy()
    gone[10:15, 0] = False
    run = replace(run, has_image=gone)
    t = Tracked(run, track(run))
    left = run.model.camera_of == 0
    assert set(t.status[10:15][:, left].ravel()) == {SpotStatus.NO_IMAGE}
    assert np.isfinite(t.uv_px[10:15]).all()
    assert set(t.status[10:15][:, ~left].ravel()) == {SpotStatus.MATCHED}
    assert {t.frames[k].pose_status for k in range(10, 15)} == {PoseStatus.PREDICTED}
    assert {f.pose_status for f in t.frames[15:]} == {PoseStatus.MEASURED}


def test_the_pose_of_a_frame_without_pictures_is_predicted():
    run = simulate_points("smooth", 28, frames=40)
    gone = run.has_image.copy()
    gone[[15, 20, 21, 22]] = False
    run = replace(run, has_image=gone)
    t = Tracked(run, track(run))
    for k in (15, 20, 21, 22):
        f = t.frames[k]
        assert f.pose_status is PoseStatus.PREDICTED
        assert np.all(f.point == UNMATCHED)
        assert set(f.status) <= {SpotStatus.NO_IMAGE, SpotStatus.OFF_SCREEN}
        error = run.poses[k].minus(f.pose)
        assert error @ np.linalg.solve(f.pose_covariance, error) < 40  # 6 on average
    # The covariance grows while there are no pictures.
    sizes = [np.trace(t.frames[k].pose_covariance[:3, :3]) for k in (19, 20, 21, 22)]
    assert np.all(np.diff(sizes) > 0)
    assert {f.pose_status for f in t.frames[23:]} == {PoseStatus.MEASURED}


def test_a_beam_that_misses_its_screen_is_off_screen():
    """Yaw from 0 to 12 deg and back, with a screen that beam C misses beyond 6 deg."""
    yaw = np.deg2rad(12.0) * np.sin(np.linspace(0, np.pi, 80))
    poses = [Pose.from_ypr(np.array([y, 0.0, 0.0]), np.zeros(3)) for y in yaw]
    rig = RIGS["fan"]()
    reach = 2.5 * np.tan(np.deg2rad(20.0 + 6.0))  # of C at 6 deg, along the screen's x
    rig = replace(rig, screens={**rig.screens, "left": replace(rig.screens["left"], size_m=(2 * reach, 3.0))})
    tracker = SpotTracker(rig, TrackerParameters(), PosePrior(poses[0], 0.2, 0.2))
    model, rng = tracker.model, np.random.default_rng(41)
    c = model.views.index(("left", "3"))
    frames = []
    for pose in poses:
        uv = model.project(pose)[0]
        rows = [np.flatnonzero((model.camera_of == n) & model.in_picture(uv)) for n in range(2)]
        found = [Detections.at(uv[r] + rng.normal(0, 0.1, (len(r), 2)), np.tile(0.01 * np.eye(2), (len(r), 1, 1)))
                 for r in rows]  # fmt: skip
        frames.append(tracker.step(0.01 if frames else 0.0, found))
    off = np.array([f.status[c] is SpotStatus.OFF_SCREEN for f in frames])
    beside = yaw > np.deg2rad(6.0)
    clear = np.abs(yaw - np.deg2rad(6.0)) > np.deg2rad(0.05)  # at the edge either status is right
    assert beside.any()
    np.testing.assert_array_equal(off[clear], beside[clear])
    assert np.isnan([f.uv_px[c] for f, o in zip(frames, off, strict=True) if o]).all()
    assert frames[-1].status[c] is SpotStatus.MATCHED  # after the beam has returned to the screen


def test_before_the_labels_are_found_all_spots_are_lost():
    run = simulate_points("static", 29, frames=10)
    gone = run.has_image.copy()
    gone[:4] = False
    t = Tracked(run, track(replace(run, has_image=gone)))
    assert set(t.status[:4].ravel()) == {SpotStatus.LOST}
    assert {f.pose_status for f in t.frames[:4]} == {PoseStatus.LOST}
    assert np.isnan(t.uv_px[:4]).all()
    assert [f.pose for f in t.frames[:4]] == [None] * 4
    assert {f.pose_status for f in t.frames[4:]} == {PoseStatus.MEASURED}
    assert [e.kind for e in t.frames[4].events] == ["labelled"]


def test_after_many_frames_without_pictures_the_pose_is_lost():
    run = simulate_points("smooth", 30, frames=500, clutter=0.0)
    gone = run.has_image.copy()
    gone[20:] = False
    t = Tracked(run, track(replace(run, has_image=gone)))
    poses = [f.pose_status for f in t.frames]
    assert poses[25] is PoseStatus.PREDICTED
    assert poses[-1] is PoseStatus.LOST
    last = poses.index(PoseStatus.LOST, 20)
    assert set(poses[last:]) == {PoseStatus.LOST}  # it stays lost without new detections
    assert set(t.status[-1]) == {SpotStatus.LOST}
    assert np.isnan(t.uv_px[-1]).all()


# -- blackouts, wrong points ------------------------------------------------------------------------------------------


def test_after_a_blackout_of_ten_frames_the_spots_are_found_again():
    t = tracked("blackout", 23, 200)
    occluded = (t.run.in_view == 2).any(axis=1) & ~(t.run.in_view == 1).any(axis=1)
    assert occluded[150:160].all()
    assert t.identity() >= 0.99
    after = [f.pose_status for f in t.frames[165:]]
    assert after.count(PoseStatus.MEASURED) >= len(after) - 1
    for k in range(165, 200):
        if t.frames[k].pose_status is PoseStatus.MEASURED:
            assert np.abs(t.run.poses[k].minus(t.frames[k].pose)).max() < 0.02


def test_clutter_is_not_matched_in_a_blackout():
    scenario = replace(SCENARIOS["blackout"], occlusion=Occlusion(blackout_every=60, blackout_frames=10),
                       clutter=Clutter(per_spot=0.2, per_image=3.0))  # fmt: skip
    wrong = 0
    for seed in (31, 32):
        run = simulate_points(scenario, seed, frames=120)
        t = Tracked(run, track(run))
        wrong += int(((t.point != UNMATCHED) & ~t.right)[60:70].sum())
        assert t.identity() >= 0.98
    assert wrong <= 1


@pytest.mark.parametrize("view", [0, 4])
def test_a_false_point_in_place_of_a_spot_is_dropped_and_the_others_give_the_position(view):
    """For five frames the spot is hidden and a false point lies 6 px beside it."""
    run = simulate_points("static", 33, frames=30, clutter=0.0)
    hidden = with_hidden(run, {k: {view} for k in range(10, 15)})
    camera = int(run.model.camera_of[view])
    detections, origin = list(hidden.detections), list(hidden.origin)
    for k in range(10, 15):
        d = detections[k][camera]
        false = run.uv_px[k, view] + [6.0, 0.0]
        more = Detections.at(np.vstack([d.uv_px, false]), np.tile(0.01 * np.eye(2), (len(d) + 1, 1, 1)))
        detections[k] = tuple(more if c == camera else x for c, x in enumerate(detections[k]))
        origin[k] = tuple(np.append(o, -1) if c == camera else o for c, o in enumerate(origin[k]))
    run = replace(hidden, detections=tuple(detections), origin=tuple(origin))
    t = Tracked(run, track(run))
    assert set(t.status[10:15, view]) == {SpotStatus.OCCLUDED}
    assert np.abs(t.uv_px[10:15, view] - run.uv_px[10:15, view]).max() < 1.0
    assert any(e.kind == "dropped" and e.view == view for f in t.frames[10:15] for e in f.events)
    unchecked = Tracked(run, track(run, TrackerParameters(rigid_check=False)))
    assert SpotStatus.MATCHED in set(unchecked.status[10:15, view])  # without the check the false point is matched


def test_a_tie_is_reported_once_with_both_candidates_and_none_is_chosen():
    run = simulate_points("static", 34, frames=5, clutter=0.0)
    rig = run.rig
    two = replace(rig, beams={n: b for n, b in rig.beams.items() if n != "B"},
                  spots={n: s for n, s in rig.spots.items() if s.beam != "B"})  # fmt: skip
    tracker = SpotTracker(two, TrackerParameters(), PosePrior(run.poses[0], 0.5, np.pi))
    uv = tracker.model.project(run.poses[0])[0]
    found = [Detections.at(uv[tracker.model.camera_of == c], np.tile(0.01 * np.eye(2), (2, 1, 1))) for c in range(2)]
    frames = [tracker.step(0.01 if k else 0.0, found) for k in range(5)]
    assert {f.pose_status for f in frames} == {PoseStatus.LOST}
    events = [e for f in frames for e in f.events]
    assert [e.kind for e in events] == ["tie"]
    assert events[0].text.count("yaw") == 2


# -- invariance -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scenario", ["sharp-turns", "blackout"])
def test_the_order_of_the_detections_does_not_change_the_results(scenario):
    run = simulate_points(scenario, 35, frames=80, clutter=0.5)
    rng = np.random.default_rng(36)
    orders = [[rng.permutation(len(d)) for d in frame] for frame in run.detections]
    shuffled = replace(
        run,
        detections=tuple(
            tuple(d[o] for d, o in zip(f, fo, strict=True)) for f, fo in zip(run.detections, orders, strict=True)
        ),
        origin=tuple(tuple(d[o] for d, o in zip(f, fo, strict=True)) for f, fo in zip(run.origin, orders, strict=True)),
    )
    one, other = Tracked(run, track(run)), Tracked(shuffled, track(shuffled))
    np.testing.assert_array_equal(one.status, other.status)
    np.testing.assert_array_equal(one.taken, other.taken)
    np.testing.assert_allclose(one.uv_px, other.uv_px, atol=1e-6)
    np.testing.assert_allclose(one.predicted_px, other.predicted_px, atol=1e-6)


def test_processing_a_run_twice_gives_identical_results():
    run = simulate_points("sharp-turns", 37, frames=60)
    for a, b in zip(track(run), track(run), strict=True):
        np.testing.assert_array_equal(a.uv_px, b.uv_px)
        assert a.status == b.status
        assert a.events == b.events


def test_later_frames_do_not_change_earlier_results():
    long, short = tracked("sharp-turns", 21, 250), simulate_points("sharp-turns", 21, frames=40)
    for a, b in zip(long.frames[:40], track(short), strict=True):
        np.testing.assert_array_equal(a.uv_px, b.uv_px)


def test_the_prediction_does_not_depend_on_the_frames_own_detections():
    """Frame 20 with other points: its prediction is the same, its positions differ."""
    run = simulate_points("smooth", 38, frames=21, clutter=0.0)
    moved = list(run.detections)
    moved[20] = tuple(Detections.at(d.uv_px + 0.5, d.cov_px2) for d in moved[20])
    a, b = track(run)[20], track(replace(run, detections=tuple(moved)))[20]
    np.testing.assert_array_equal(a.predicted_px, b.predicted_px)
    assert np.nanmin(np.abs(a.uv_px - b.uv_px)) > 0.1


@pytest.mark.parametrize("scenario", ["smooth", "sharp-turns", "blackout", "hidden-in-turn"])
def test_all_spots_have_a_position_and_a_covariance_unless_lost_or_off_screen(scenario):
    t = tracked(scenario, 23 if scenario == "blackout" else 21, 200 if scenario == "blackout" else 250)
    without = np.isin(t.status, [SpotStatus.LOST, SpotStatus.OFF_SCREEN])
    np.testing.assert_array_equal(np.isnan(t.uv_px).any(axis=-1), without)
    cov = np.array([f.cov_px2 for f in t.frames])
    np.testing.assert_array_equal(np.isnan(cov).any(axis=(-1, -2)), without)
    assert np.all(np.linalg.eigvalsh(cov[~without]) > 0)
    for f in t.frames:
        if f.pose is not None:
            assert np.isfinite(f.pose.rotation).all()
            assert np.linalg.eigvalsh(f.pose_covariance)[0] > 0


def test_no_detection_is_assigned_to_two_spots():
    for scenario in ("smooth", "sharp-turns", "hidden-in-turn"):
        t = tracked(scenario, 21, 250)
        for point in t.point:
            for c in range(2):
                taken = point[(t.run.model.camera_of == c) & (point != UNMATCHED)]
                assert len(set(taken.tolist())) == len(taken)


def test_a_detection_of_two_merged_spots_is_assigned_to_one_of_them():
    """A fourth beam a tenth of a millimetre beside A: their spots merge into one detection."""
    run = simulate_points("static", 42, frames=30, clutter=0.0)
    rig, a = run.rig, run.rig.beams["A"]
    beams = {**rig.beams, "D": replace(a, name="D", point=a.point + np.array([0.0, 0.0, 1e-4]))}
    more = {"7": replace(rig.spots["1"], name="7", beam="D"), "8": replace(rig.spots["4"], name="8", beam="D")}
    tracker = SpotTracker(replace(rig, beams=beams, spots={**rig.spots, **more}), TrackerParameters(),
                          PosePrior(run.poses[0], 0.1, 0.1))  # fmt: skip
    camera_of = tracker.model.camera_of
    for k in range(30):
        f = tracker.step(0.01 if k else 0.0, run.detections[k])
        assert f.pose_status is PoseStatus.MEASURED
        for c in range(2):
            taken = f.point[(camera_of == c) & (f.point != UNMATCHED)].tolist()
            assert sorted(taken) == [0, 1, 2]  # each point once, though there are four spots


def test_with_the_papers_method_positions_outside_the_image_are_those_of_its_quadratic():
    run = simulate_points("smooth", 21, frames=120, clutter=0.0)
    t = Tracked(run, track(run, PAPER))
    coplanar = CoplanarViews.of(run.model)
    compared = 0
    for f in t.frames:
        seen = np.where(np.array([s.measured for s in f.status])[:, None], f.uv_px, np.nan)
        solved = quadratic_positions(run.rig, run.model, coplanar, seen)
        for v in np.flatnonzero([s is SpotStatus.OUT_OF_VIEW for s in f.status]):
            if np.isfinite(solved[v]).all():
                np.testing.assert_allclose(f.uv_px[v], solved[v], atol=1e-9)
                compared += 1
    assert compared > 10


def test_estimated_accelerations_improve_the_predictions_of_a_spot_at_rest():
    """Assumed 5000 px/s^2, actually none: after two seconds the prediction is better than one detection."""
    run = simulate_points("static", 43, frames=300, clutter=0.0)
    late = slice(200, 300)
    rms = []
    for estimated in (True, False):
        t = Tracked(run, track(run, TrackerParameters(learn_sigma_a=estimated)))
        rms.append(np.sqrt(np.mean((t.predicted_px - run.uv_px)[late] ** 2)))
    assert rms[0] < run.noise_px < rms[1]


def test_the_time_between_frames_may_vary():
    """Frames dropped in both cameras: dt doubles, and the rates are per second, not per frame."""
    run = simulate_points("smooth", 39, frames=120)
    keep = np.sort(np.random.default_rng(40).choice(120, 90, replace=False))
    some = {name: getattr(run, name)[keep] for name in ("frame", "t_s", "uv_px", "in_view", "has_image", "turned")}
    frames = {name: tuple(getattr(run, name)[k] for k in keep) for name in ("detections", "origin")}
    thinned = replace(run, poses=run.poses[keep], **some, **frames)
    t = Tracked(thinned, track(thinned))
    assert t.identity() >= 0.995
    assert t.prediction_rms().max() < 0.6


def test_innovations_of_their_stated_size_leave_the_estimated_accelerations_as_they_are():
    """Those of twice the size raise them, those of half the size lower them."""
    n, all_views = 20_000, np.ones(20_000, dtype=bool)

    def change(size: float) -> float:
        tracks = replace(Tracks.none(n, 100.0), alive=all_views)  # covariance of the predicted place: 1 px^2
        z = size * np.sqrt(1.25) * np.random.default_rng(1).standard_normal((n, 2))
        tracks.update(z, np.tile(0.25 * np.eye(2), (n, 1, 1)), all_views, all_views, ~all_views, TrackerParameters())
        return float(np.mean(np.log(tracks.sigma_a / 100.0)))

    assert abs(change(1.0)) < 0.02 * change(2.0)
    assert change(0.5) < -0.1 * change(2.0)
