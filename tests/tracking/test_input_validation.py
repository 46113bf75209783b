"""Detections that are none, too many, or not in order: the tracker passes them over, and never makes a wrong pose."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geometry.arrays import Array, Ints
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from lab.simulate.points import CLUTTER, PointRun, simulate_points
from tracking.curve_switching.spot_tracker import SpotTracker
from tracking.detections import UNMATCHED, Detections
from tracking.input_validation import TWIN_PX, usable_rows
from tracking.parameters import TrackerParameters
from tracking.rigid_body.rigid_tracker import RigidTracker
from tracking.statuses import PoseStatus
from tracking.tracked_frame import TrackedFrame

# A pose's squared error over its claimed variance, divided by six: more than this once in 300000 poses.
NEES = 6.0
BAD = 20  # the first bad frame
Spoil = Callable[[int, int, Detections], tuple[Detections | None, Ints]]  # frame, camera, points -> points, their rows


@cache
def recording() -> PointRun:
    return simulate_points("smooth", 3, frames=40)


def new_tracker(run: PointRun, kind: type[RigidTracker | SpotTracker] = RigidTracker) -> RigidTracker | SpotTracker:
    p = run.prior
    centre = Pose.from_ypr(np.deg2rad(p.yaw_pitch_roll_deg), np.array(p.position_m))
    return kind(run.rig, TrackerParameters(), PosePrior(centre, p.within_m, float(np.deg2rad(p.within_deg))))


class Outcome:
    """What a tracker made of a recording, against the truth."""

    def __init__(self, run: PointRun, spoil: Spoil) -> None:
        tracker = new_tracker(run)
        self.frames: list[TrackedFrame] = []
        self.wrong, self.nees, self.seconds = 0, np.full(len(run.frame), np.nan), np.zeros(len(run.frame))
        self.found = np.zeros(len(run.frame), dtype=int)  # right labels
        for k in range(len(run.frame)):
            given_rows = [spoil(k, c, d) for c, d in enumerate(run.detections[k])]
            clock = time.process_time()
            out = tracker.step(0.0 if k == 0 else float(run.t_s[k] - run.t_s[k - 1]), [g[0] for g in given_rows])
            self.seconds[k] = time.process_time() - clock
            self.frames.append(out)
            for view in np.flatnonzero(out.point != UNMATCHED):
                camera = run.model.camera_of[view]
                row = given_rows[camera][1][out.point[view]]
                right = row >= 0 and run.origin[k][camera][row] == view
                self.found[k] += right
                self.wrong += not right
            if out.pose is not None:
                error = run.poses[k].minus(out.pose)
                self.nees[k] = error @ np.linalg.solve(out.pose_covariance, error) / 6


def rows_of(points: Detections) -> Ints:
    return np.arange(len(points))


def changed(points: Detections, rows: Sequence[int], uv: object = None, cov: object = None) -> Detections:
    """Some rows with another place or covariance."""
    new_uv, new_cov = points.uv_px.copy(), points.cov_px2.copy()
    if uv is not None:
        new_uv[list(rows)] = uv
    if cov is not None:
        new_cov[list(rows)] = cov
    return replace(points, uv_px=new_uv, cov_px2=new_cov)


def more(points: Detections, uv: Array, rows: Ints, rng: np.random.Generator) -> tuple[Detections, Ints]:
    """With further points of that claim, in random order; rows: which of the old ones each repeats, -1 none."""
    uv = np.concatenate([points.uv_px, uv])
    order = rng.permutation(len(uv))
    cov = np.tile(points.cov_px2[:1] if len(points) else 0.01 * np.eye(2), (len(uv), 1, 1))
    return Detections.at(uv[order], cov), np.concatenate([rows_of(points), rows])[order]


NO_PLACES = {"nan": np.nan, "infinite": np.inf, "beyond all": 1e200, "a billion px away": [1e9, -1e9]}
NO_COVARIANCES = {
    "nan": np.nan,
    "infinite": np.inf,
    "zero": 0.0,
    "negative": -0.01 * np.eye(2),
    "more than fully correlated": [[0.01, 0.02], [0.02, 0.01]],
    "fully correlated": [[0.01, 0.01], [0.01, 0.01]],
    "lopsided": [[0.01, 0.0], [0.005, 0.01]],
    "a claim that no camera can make": 1e-18 * np.eye(2),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("how", [*(("uv", k) for k in NO_PLACES), *(("cov", k) for k in NO_COVARIANCES)], ids=str)
def test_a_point_that_is_none_is_passed_over_and_all_others_keep_their_labels(how):
    """One point of each camera in five frames running: the others are labelled, by the rows that they were given in."""
    run, (field, name) = recording(), how
    value = NO_PLACES[name] if field == "uv" else NO_COVARIANCES[name]

    def spoil(k: int, camera: int, d: Detections) -> tuple[Detections, Ints]:
        rows = [0] if BAD <= k < BAD + 5 and len(d) else []
        return changed(d, rows, **{field: value}), rows_of(d)

    outcome = Outcome(run, spoil)
    assert outcome.wrong == 0
    assert np.nanmax(outcome.nees) < NEES
    expected = np.count_nonzero(run.in_view == 1, axis=1)
    for k in range(BAD, BAD + 5):
        expected[k] -= sum(origin[0] != CLUTTER for origin in run.origin[k])
    np.testing.assert_array_equal(outcome.found, expected)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("what", ["nan", "no points", "no pictures"])
def test_frames_of_which_nothing_can_be_used_are_bridged_and_never_measured(what):
    run = recording()

    def spoil(k: int, camera: int, d: Detections) -> tuple[Detections | None, Ints]:
        if not BAD <= k < BAD + 5:
            return d, rows_of(d)
        if what == "nan":
            return changed(d, range(len(d)), uv=np.nan, cov=np.nan), rows_of(d)
        return Detections.none() if what == "no points" else None, rows_of(d)

    outcome = Outcome(run, spoil)
    assert [f.pose_status for f in outcome.frames[BAD : BAD + 5]] == [PoseStatus.PREDICTED] * 5
    assert outcome.wrong == 0
    assert np.nanmax(outcome.nees) < NEES
    assert (outcome.found[BAD + 5 :] == np.count_nonzero(run.in_view == 1, axis=1)[BAD + 5 :]).all()


@pytest.mark.parametrize("apart_px", [0.0, 0.9 * TWIN_PX])
def test_spots_detected_twice_in_every_frame_keep_their_labels(apart_px):
    """Without the guard the two share the label's probability, and 238 of 240 labels are left open."""
    run, rng = recording(), np.random.default_rng(1)

    def spoil(k: int, camera: int, d: Detections) -> tuple[Detections, Ints]:
        direction = rng.standard_normal((len(d), 2))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return more(d, d.uv_px + apart_px * direction, rows_of(d), rng)

    outcome = Outcome(run, spoil)
    assert outcome.wrong == 0
    assert outcome.found.sum() == np.count_nonzero(run.in_view == 1)
    # the place of a twin is off by less than half the noise of 0.1 px, which its covariance does not know of
    assert np.nanmean(outcome.nees) < 1.5


@pytest.mark.parametrize("frames", [[BAD], range(BAD, BAD + 15)])
def test_ten_thousand_false_points_in_a_picture_cost_milliseconds_and_mislead_nobody(frames):
    """10 ms a frame were measured on one core, for both cameras; the spots are still found among them."""
    run, rng = recording(), np.random.default_rng(2)

    def spoil(k: int, camera: int, d: Detections) -> tuple[Detections, Ints]:
        if k not in frames:
            return d, rows_of(d)
        size = run.model.image_size_px[run.model.camera_of == camera][0]
        return more(d, rng.uniform(-0.5, size - 0.5, (10_000, 2)), np.full(10_000, -1), rng)

    new_tracker(run).step(0.0, run.detections[0])  # compiled code is loaded before the clock runs
    outcome = Outcome(run, spoil)
    shining = np.count_nonzero(run.in_view == 1, axis=1)
    clean = ~np.isin(run.frame, frames)
    assert outcome.seconds[~clean].max() < 0.3
    np.testing.assert_array_equal(outcome.found[clean], shining[clean])
    assert (
        outcome.wrong <= 1
    )  # with one false point in 130 px^2, some lie nearer to where a spot should be than it does
    assert outcome.found[~clean].sum() >= 0.95 * shining[~clean].sum()
    assert np.nanmax(outcome.nees) < NEES


def crowd(bright: bool | None, frames: range, run: PointRun) -> Spoil:
    """400 false points per picture; spots brighter than they, darker than most, or of unknown brightness."""
    rng = np.random.default_rng(3)

    def spoil(k: int, camera: int, d: Detections) -> tuple[Detections, Ints]:
        if k not in frames:
            return d, rows_of(d)
        size = run.model.image_size_px[run.model.camera_of == camera][0]
        points, rows = more(d, rng.uniform(-0.5, size - 0.5, (400, 2)), np.full(400, -1), rng)
        if bright is None:
            return points, rows
        flux = np.where(rows >= 0, 1000.0 if bright else 100.0, rng.uniform(1, 900, len(rows)))
        order = np.argsort(-flux)
        return replace(points, flux=flux)[order], rows[order]

    return spoil


def test_four_hundred_false_points_from_the_first_picture_on_do_not_hide_brighter_spots():
    run = recording()
    outcome = Outcome(run, crowd(True, range(40), run))
    assert outcome.wrong == 0
    assert outcome.found.sum() == np.count_nonzero(run.in_view == 1)
    assert np.nanmax(outcome.nees) < NEES


@pytest.mark.parametrize("bright", [False, None], ids=["dark spots", "no brightness"])
def test_a_start_that_drowns_in_false_points_gives_no_pose_rather_than_a_wrong_one(bright):
    """Before, of 40 such frames the second gave a pose that four of the sixty brightest false points fit by chance."""
    run = recording()
    outcome = Outcome(run, crowd(bright, range(2), run))
    assert all(f.pose_status is PoseStatus.LOST for f in outcome.frames[:2])
    assert outcome.wrong == 0
    assert outcome.found[2:].sum() >= 0.95 * np.count_nonzero(run.in_view[2:] == 1)
    if bright is None:
        assert outcome.seconds[1] < 0.3  # such a search cannot succeed, and is not begun


def test_a_tie_of_the_first_frame_gives_neither_labels_nor_a_pose():
    """Two spots of a beam are hidden in turn, and two poses remain that explain the other four equally well."""
    run = recording()
    first = [
        d[np.flatnonzero(np.isin(o, seen))]
        for d, o, seen in zip(run.detections[0], run.origin[0], ([1, 2], [3, 4]), strict=True)
    ]
    out = new_tracker(run).step(0.0, first)
    assert "tie" in [e.kind for e in out.events]
    assert out.pose is None
    assert (out.point == UNMATCHED).all()


@pytest.mark.parametrize("dt_s", [0.0, -0.01, np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("kind", [RigidTracker, SpotTracker])
def test_a_step_that_is_not_forward_in_time_is_rejected(kind, dt_s):
    run = recording()
    tracker = new_tracker(run, kind)
    tracker.step(0.0, run.detections[0])
    with pytest.raises(ValueError, match=r"^dt_s: expected the seconds since the previous frame, more than 0 .*, got "):
        tracker.step(dt_s, run.detections[1])
    # The rejected step has not changed the tracker.
    assert tracker.step(0.01, run.detections[1]).pose_status is PoseStatus.MEASURED


def test_a_million_seconds_later_the_vehicle_is_searched_anew():
    run = recording()
    tracker = new_tracker(run)
    for k in range(10):
        tracker.step(0.01 * (k > 0), run.detections[k])
    # A million metres away no spot is on a screen, and no label doubts that: 15 frames of doubt were measured.
    for k in range(10, 30):
        out = tracker.step(1e6 if k == 10 else 0.01, run.detections[k])
        if out.pose is not None:
            sigma = np.sqrt(np.diagonal(out.pose_covariance))
            assert (np.abs(run.poses[k].minus(out.pose)) < 6 * sigma).all()
    assert out.pose_status is PoseStatus.MEASURED


def test_arrays_and_cameras_that_do_not_fit_are_refused():
    run = recording()
    points = run.detections[0][0]
    with pytest.raises(ValueError, match=r"found: expected detections, or None, of each of the cameras left, right"):
        new_tracker(run).step(0.0, [points])
    for field, shape in (("cov_px2", (len(points), 2)), ("flux", (len(points) + 1,))):
        with pytest.raises(ValueError, match=f"{field}: expected shape"):
            new_tracker(run).step(0.0, [replace(points, **{field: np.ones(shape)}), None])


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 120))
@settings(max_examples=20, deadline=None, derandomize=True)
def test_of_points_that_crowd_one_place_those_kept_are_apart_and_those_gone_had_a_neighbour(seed, count):
    uv = np.random.default_rng(seed).uniform(0, 0.6, (count, 2))
    points = Detections.at(uv, np.tile(0.01 * np.eye(2), (count, 1, 1)))
    good = usable_rows(points)
    kept = np.ones(count, dtype=bool) if good is None else good
    gap = np.linalg.norm(uv[:, None] - uv[None], axis=-1)
    assert (gap[kept][:, kept][~np.eye(kept.sum(), dtype=bool)] >= TWIN_PX).all()
    assert (gap[~kept][:, kept].min(axis=1) < TWIN_PX).all() if not kept.all() else True
