"""Invalid, duplicate or too many detections: the tracker ignores them and never reports a wrong pose."""

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
from tests.marks import further_slow
from tracking.curve_switching.spot_tracker import SpotTracker
from tracking.detections import UNMATCHED, Detections
from tracking.input_validation import DUPLICATE_PX, usable_rows
from tracking.parameters import TrackerParameters
from tracking.rigid_body.rigid_tracker import RigidTracker
from tracking.statuses import PoseStatus, TrackedFrame

NEES = 6.0  # limit of a pose's squared Mahalanobis error divided by six: exceeded once in 300000 correct poses
BAD = 20  # the first modified frame
Modify = Callable[[int, int, Detections], tuple[Detections | None, Ints]]  # frame, camera, points -> points, their rows


@cache
def recording() -> PointRun:
    return simulate_points("smooth", 3, frames=40)


def new_tracker(run: PointRun, kind: type[RigidTracker | SpotTracker] = RigidTracker) -> RigidTracker | SpotTracker:
    p = run.prior
    centre = Pose.from_ypr(np.deg2rad(p.yaw_pitch_roll_deg), np.array(p.position_m))
    return kind(run.rig, TrackerParameters(), PosePrior(centre, p.within_m, float(np.deg2rad(p.within_deg))))


class TrackedRun:
    """A tracker's results on a modified recording, compared with the truth."""

    def __init__(self, run: PointRun, modify: Modify) -> None:
        tracker = new_tracker(run)
        self.frames: list[TrackedFrame] = []
        self.wrong, self.nees, self.seconds = 0, np.full(len(run.frame), np.nan), np.zeros(len(run.frame))
        self.found = np.zeros(len(run.frame), dtype=int)  # number of right labels
        for k in range(len(run.frame)):
            given_rows = [modify(k, c, d) for c, d in enumerate(run.detections[k])]
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
    """The points with another position or covariance in some rows."""
    new_uv, new_cov = points.uv_px.copy(), points.cov_px2.copy()
    if uv is not None:
        new_uv[list(rows)] = uv
    if cov is not None:
        new_cov[list(rows)] = cov
    return replace(points, uv_px=new_uv, cov_px2=new_cov)


def more(points: Detections, uv: Array, rows: Ints, rng: np.random.Generator) -> tuple[Detections, Ints]:
    """The points and further ones of the same covariance, in random order; rows: the point that each repeats, or -1."""
    uv = np.concatenate([points.uv_px, uv])
    order = rng.permutation(len(uv))
    cov = np.tile(points.cov_px2[:1] if len(points) else 0.01 * np.eye(2), (len(uv), 1, 1))
    return Detections.at(uv[order], cov), np.concatenate([rows_of(points), rows])[order]


INVALID_POSITIONS = {"nan": np.nan, "infinite": np.inf, "overflow": 1e200, "a billion px away": [1e9, -1e9]}
INVALID_COVARIANCES = {
    "nan": np.nan,
    "infinite": np.inf,
    "zero": 0.0,
    "negative": -0.01 * np.eye(2),
    "more than fully correlated": [[0.01, 0.02], [0.02, 0.01]],
    "fully correlated": [[0.01, 0.01], [0.01, 0.01]],
    "asymmetric": [[0.01, 0.0], [0.005, 0.01]],
    "impossibly small": 1e-18 * np.eye(2),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "how", [*(("uv", k) for k in INVALID_POSITIONS), *(("cov", k) for k in INVALID_COVARIANCES)], ids=str
)
def test_an_invalid_point_is_ignored_and_all_others_keep_their_labels(how):
    """One point of each camera in five consecutive frames: the others are labelled, with their original rows."""
    run, (field, name) = recording(), how
    value = INVALID_POSITIONS[name] if field == "uv" else INVALID_COVARIANCES[name]

    def modify(k: int, camera: int, d: Detections) -> tuple[Detections, Ints]:
        rows = [0] if BAD <= k < BAD + 5 and len(d) else []
        return changed(d, rows, **{field: value}), rows_of(d)

    outcome = TrackedRun(run, modify)
    assert outcome.wrong == 0
    assert np.nanmax(outcome.nees) < NEES
    expected = np.count_nonzero(run.in_view == 1, axis=1)
    for k in range(BAD, BAD + 5):
        expected[k] -= sum(origin[0] != CLUTTER for origin in run.origin[k])
    np.testing.assert_array_equal(outcome.found, expected)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("what", ["nan", "no points", "no pictures"])
def test_poses_of_frames_without_usable_points_are_predicted(what):
    run = recording()

    def modify(k: int, camera: int, d: Detections) -> tuple[Detections | None, Ints]:
        if not BAD <= k < BAD + 5:
            return d, rows_of(d)
        if what == "nan":
            return changed(d, range(len(d)), uv=np.nan, cov=np.nan), rows_of(d)
        return Detections.none() if what == "no points" else None, rows_of(d)

    outcome = TrackedRun(run, modify)
    assert [f.pose_status for f in outcome.frames[BAD : BAD + 5]] == [PoseStatus.PREDICTED] * 5
    assert outcome.wrong == 0
    assert np.nanmax(outcome.nees) < NEES
    assert (outcome.found[BAD + 5 :] == np.count_nonzero(run.in_view == 1, axis=1)[BAD + 5 :]).all()


@pytest.mark.parametrize("apart_px", [0.0, 0.9 * DUPLICATE_PX])
def test_spots_detected_twice_in_every_frame_keep_their_labels(apart_px):
    """Without the check both share the label's probability, and 238 of 240 spots stay unlabelled."""
    run, rng = recording(), np.random.default_rng(1)

    def modify(k: int, camera: int, d: Detections) -> tuple[Detections, Ints]:
        direction = rng.standard_normal((len(d), 2))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return more(d, d.uv_px + apart_px * direction, rows_of(d), rng)

    outcome = TrackedRun(run, modify)
    assert outcome.wrong == 0
    assert outcome.found.sum() == np.count_nonzero(run.in_view == 1)
    # A duplicate is off by less than half the noise of 0.1 px, which its covariance does not include.
    assert np.nanmean(outcome.nees) < 1.5


@pytest.mark.parametrize("frames", [[BAD], range(BAD, BAD + 15)])
def test_ten_thousand_false_points_in_a_picture_cost_milliseconds_and_give_no_wrong_pose(frames):
    """10 ms per frame were measured on one core, for both cameras; the spots are found among them."""
    run, rng = recording(), np.random.default_rng(2)

    def modify(k: int, camera: int, d: Detections) -> tuple[Detections, Ints]:
        if k not in frames:
            return d, rows_of(d)
        size = run.model.image_size_px[run.model.camera_of == camera][0]
        return more(d, rng.uniform(-0.5, size - 0.5, (10_000, 2)), np.full(10_000, -1), rng)

    new_tracker(run).step(0.0, run.detections[0])  # loads the compiled code before the time is measured
    outcome = TrackedRun(run, modify)
    shining = np.count_nonzero(run.in_view == 1, axis=1)
    clean = ~np.isin(run.frame, frames)
    assert outcome.seconds[~clean].max() < 0.3
    np.testing.assert_array_equal(outcome.found[clean], shining[clean])
    # With one false point in 130 px^2, some lie nearer to a spot's predicted position than the spot.
    assert outcome.wrong <= 1
    assert outcome.found[~clean].sum() >= 0.95 * shining[~clean].sum()
    assert np.nanmax(outcome.nees) < NEES


def crowd(bright: bool | None, frames: range, run: PointRun) -> Modify:
    """400 false points per picture; the spots are brighter, dimmer than most, or of unknown brightness."""
    rng = np.random.default_rng(3)

    def modify(k: int, camera: int, d: Detections) -> tuple[Detections, Ints]:
        if k not in frames:
            return d, rows_of(d)
        size = run.model.image_size_px[run.model.camera_of == camera][0]
        points, rows = more(d, rng.uniform(-0.5, size - 0.5, (400, 2)), np.full(400, -1), rng)
        if bright is None:
            return points, rows
        flux = np.where(rows >= 0, 1000.0 if bright else 100.0, rng.uniform(1, 900, len(rows)))
        order = np.argsort(-flux)
        return replace(points, flux=flux)[order], rows[order]

    return modify


def test_brighter_spots_are_found_among_four_hundred_false_points():
    run = recording()
    outcome = TrackedRun(run, crowd(True, range(40), run))
    assert outcome.wrong == 0
    assert outcome.found.sum() == np.count_nonzero(run.in_view == 1)
    assert np.nanmax(outcome.nees) < NEES


@pytest.mark.parametrize("bright", further_slow([False, None]), ids=["dim spots", "no brightness"])
def test_a_start_with_too_many_false_points_gives_no_pose(bright):
    """Without the limit, four of the sixty brightest false points fitted a pose by chance in one of 40 frames."""
    run = recording()
    outcome = TrackedRun(run, crowd(bright, range(2), run))
    assert all(f.pose_status is PoseStatus.LOST for f in outcome.frames[:2])
    assert outcome.wrong == 0
    assert outcome.found[2:].sum() >= 0.95 * np.count_nonzero(run.in_view[2:] == 1)
    if bright is None:
        assert outcome.seconds[1] < 0.3  # such a search cannot succeed and is not started


def test_a_tie_of_the_first_frame_gives_neither_labels_nor_a_pose():
    """One spot per camera is hidden, and two poses explain the other four equally well."""
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


def test_after_a_gap_of_a_million_seconds_the_labels_are_searched_again():
    run = recording()
    tracker = new_tracker(run)
    for k in range(10):
        tracker.step(0.01 * (k > 0), run.detections[k])
    # The predicted pose is a million metres away, where no spot is on a screen. Measured: 15 frames until the search.
    for k in range(10, 30):
        out = tracker.step(1e6 if k == 10 else 0.01, run.detections[k])
        if out.pose is not None:
            sigma = np.sqrt(np.diagonal(out.pose_covariance))
            assert (np.abs(run.poses[k].minus(out.pose)) < 6 * sigma).all()
    assert out.pose_status is PoseStatus.MEASURED


def test_arrays_of_a_wrong_shape_and_missing_cameras_are_rejected():
    run = recording()
    points = run.detections[0][0]
    with pytest.raises(ValueError, match=r"found: expected detections, or None, for each of the cameras left, right"):
        new_tracker(run).step(0.0, [points])
    for field, shape in (("cov_px2", (len(points), 2)), ("flux", (len(points) + 1,))):
        with pytest.raises(ValueError, match=f"{field}: expected shape"):
            new_tracker(run).step(0.0, [replace(points, **{field: np.ones(shape)}), None])


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 120))
@settings(max_examples=20, deadline=None, derandomize=True)
def test_kept_points_are_no_duplicates_and_dropped_points_had_one(seed, count):
    uv = np.random.default_rng(seed).uniform(0, 0.6, (count, 2))
    points = Detections.at(uv, np.tile(0.01 * np.eye(2), (count, 1, 1)))
    good = usable_rows(points)
    kept = np.ones(count, dtype=bool) if good is None else good
    gap = np.linalg.norm(uv[:, None] - uv[None], axis=-1)
    assert (gap[kept][:, kept][~np.eye(kept.sum(), dtype=bool)] >= DUPLICATE_PX).all()
    assert (gap[~kept][:, kept].min(axis=1) < DUPLICATE_PX).all() if not kept.all() else True
