"""Markers are labelled by geometry, not by their order; what cannot be decided is not reported as measured."""

from itertools import combinations

import numpy as np
import pytest

from geometry import rotations
from geometry.camera import Camera
from geometry.pose import Pose
from geometry.uncertainty.rig_uncertainty import RigCovariance, perturbed_camera
from studies.zhou2020 import random_pose
from tests.marks import further_slow
from tests.tracking.binocular.scenes import MODEL, NOISE_PX, PAIR, images, pose_at
from tracking.binocular.acquisition import matching_pairs, mirrored
from tracking.binocular.calibration_check import FittedFrame, clock_offset
from tracking.binocular.joint_fit import MarkerObservations, fit_pose
from tracking.binocular.marker_model import (
    MarkerImages,
    MarkerModel,
    MatchParameters,
    SegmentationParameters,
    StereoPair,
    project_markers,
)
from tracking.binocular.pose_tracker import AMBIGUOUS, NO_PICTURES, TOO_FEW, BinocularTracker
from tracking.statuses import PoseStatus

P = MatchParameters()


# The least and the largest value of each parameter, and numbers just beyond them.
ENDS = [
    (SegmentationParameters, "gamma", (1e-9, 5), (0, 5.01)),
    *((SegmentationParameters, n, (0, 51), (-1, 52)) for n in ("opening_px", "closing_px")),
    (SegmentationParameters, "median_px", (0, 1, 51), (-1, 2, 50, 53)),
    (SegmentationParameters, "min_area_px2", (0, 39_999), (-1e-9, 40_000)),
    (SegmentationParameters, "sigma_floor_px", (1e-9, 10), (0, 10.01)),
    (SegmentationParameters, "max_markers", (3, 200), (2, 201)),
    *((MatchParameters, n, (1e-9, 999_999), (0, 1e6)) for n in ("epipolar_sigmas", "gate_sigmas", "outlier_chi2")),
    *((MatchParameters, n, (1e-9, 999_999), (0, 1e6)) for n in ("acceleration_m_s2", "turn_rad_s2")),
    (MatchParameters, "epipolar_floor_px", (0, 100), (-1e-9, 100.1)),
    (MatchParameters, "area_factor", (1.01, 100), (1, 100.1)),
    (MatchParameters, "detection_probability", (0.5, 0.99), (0.49, 1)),
    (MatchParameters, "min_markers", (3, 100), (2, 101)),
    (MatchParameters, "lead_nats", (0, 100), (-1e-9, 100.1)),
    (MatchParameters, "max_pose_chi2_p", (0, 0.99), (-1e-9, 1)),
    (MatchParameters, "max_predicted_frames", (0, 100_000), (-1, 100_001)),
]


@pytest.mark.parametrize(("kind", "name", "good", "bad"), ENDS)
def test_a_parameter_may_have_the_ends_of_its_range_and_nothing_beyond(kind, name, good, bad):
    for value in good:
        assert getattr(kind(**{name: value}), name) == value
    for value in bad:
        with pytest.raises(ValueError, match=f"{name}: expected"):
            kind(**{name: value})


def consistent(pose, frame):
    delta = pose.minus(frame.pose)
    return delta @ np.linalg.solve(frame.covariance, delta) < 40  # chi-square with 6 dof: p = 5e-7


@pytest.mark.parametrize("case", further_slow([[(), ()], [(0,), ()], [(2,), (5,)], [(1, 4), (1, 4)]], fast=3))
def test_hidden_and_false_markers_do_not_mislabel_the_others(case):
    rng = np.random.default_rng(1)
    pose = pose_at(9, 1)
    frame = BinocularTracker(PAIR, MODEL, P).step(0.0, images(pose, rng, case, false=3))
    assert frame.status is PoseStatus.MEASURED, frame.reason
    assert consistent(pose, frame)
    assert all((frame.index[c, list(case[c])] == -1).all() for c in (0, 1))


@pytest.mark.parametrize("distance", [7, pytest.param(16, marks=pytest.mark.slow)])
def test_any_four_of_seven_markers_are_enough_at_the_start(distance):
    rng = np.random.default_rng(11)
    found = 0
    for i, shown in enumerate(combinations(range(7), 4)):
        if distance == 7 and i % 6:  # the slow test has all of them
            continue
        pose, hidden = pose_at(distance, i), tuple(set(range(7)) - set(shown))
        frame = BinocularTracker(PAIR, MODEL, P).step(0.0, images(pose, rng, (hidden, hidden)))
        assert frame.status is PoseStatus.MEASURED or frame.reason == AMBIGUOUS, (shown, frame.reason)
        assert consistent(pose, frame)
        found += frame.status is PoseStatus.MEASURED
    assert found >= 5


# Two recordings of four of seven discs (f 1000 px, baseline 1 m): sigma and images, px, quaternion and place, m. Of
# the first, four other discs explain all images (chi-square 40 of 10). Of the second, the right pose lies beside its
# mirrored one, where whole Gauss-Newton steps go to and fro.
TURNS = np.deg2rad([4, 58, 99, 161, 214, 259, 322])
RIM = np.column_stack([0.34 * np.cos(TURNS), 0.34 * np.sin(TURNS), [0, 0.1, 0.03, 0.09, 0, 0.07, 0.12]])
FOUR = [
    (
        0.062,
        [[597.649, 448.212], [627.244, 433.115], [614.093, 454.377], [619.498, 423.139]],
        [[562.966, 419.166], [570.543, 429.309], [557.383, 450.458], [540.952, 444.331]],
        ([0.980929, 0.077348, -0.035697, -0.174706], [-0.570289, -0.830277, 20.0]),
    ),
    (
        0.045,
        [[657.507, 420.244], [635.568, 410.663], [649.611, 452.803], [633.208, 455.17]],
        [[560.057, 451.303], [562.606, 406.666], [584.41, 416.518], [576.376, 449.06]],
        ([0.993241, 0.052207, 0.097512, 0.035202], [-0.027399, -0.692839, 15.0]),
    ),
]


@pytest.mark.parametrize(("sigma", "left", "right", "true"), FOUR)
def test_four_markers_that_lie_almost_as_four_others_do_are_not_taken_for_these(sigma, left, right, true):
    matrix = np.array([[1000, 0, 639.5], [0, 1000, 479.5], [0, 0, 1]])
    R = rotations.exp(np.deg2rad([0.2, -0.4, 0.3]))
    pair = StereoPair(
        (
            Camera("left", "", (1280, 960), matrix, (), Pose.identity()),
            Camera("right", "", (1280, 960), matrix, (), Pose(R, -R @ [1.0, 0.0, 0.0])),
        )
    )
    model = MarkerModel(tuple("1234567"), RIM, np.zeros(7, int), np.full(7, np.nan))
    cov = np.broadcast_to(sigma**2 * np.eye(2), (4, 2, 2))
    seen = tuple(MarkerImages(np.array(uv), cov, np.full(4, np.nan), np.zeros(4, int)) for uv in (left, right))
    frame = BinocularTracker(pair, model, P).step(0.0, seen)
    assert frame.status is PoseStatus.MEASURED
    assert consistent(Pose.from_quaternion(np.array(true[0]), np.array(true[1])), frame)


def test_three_markers_are_enough_for_a_target_that_is_followed():
    rng, pose = np.random.default_rng(12), pose_at(8, 12)
    for hidden in ((0, 1, 2, 3), (1, 3, 5, 6), (0, 2, 4, 5)):
        tracker = BinocularTracker(PAIR, MODEL, P)
        tracker.step(0.0, images(pose, rng))
        frame = tracker.step(0.04, images(pose, rng, (hidden, hidden)))
        assert frame.status is PoseStatus.MEASURED, frame.reason
        assert consistent(pose, frame)


def test_candidates_match_along_the_epipolar_line_only():
    rng = np.random.default_rng(2)
    left, right = images(pose_at(9, 2), rng)
    pairs = matching_pairs(PAIR, (left, right), P)
    assert (pairs.sum(axis=1) >= 1).all()
    moved = MarkerImages(right.uv_px + np.array([0.0, 8.0]), right.cov_px2, right.area_px2, right.colour)
    assert matching_pairs(PAIR, (left, moved), P).sum() < pairs.sum()
    other = MarkerImages(right.uv_px, right.cov_px2, right.area_px2, right.colour + 1)
    assert not matching_pairs(PAIR, (left, other), P).any()


def test_a_recording_is_followed_through_frames_without_markers():
    rng, tracker = np.random.default_rng(3), BinocularTracker(PAIR, MODEL, P)
    poses = Pose.from_ypr(np.linspace([0, 0, 0], [0.3, 0.1, 0.2], 12), np.linspace([0.2, 0, 10], [0.4, 0.1, 9.5], 12))
    none = MarkerImages.none()
    for i in range(12):
        pictures = (none, none) if i in (6, 7) else images(poses[i], rng, false=1)
        frame = tracker.step(i / 25, pictures)
        assert frame.status is (PoseStatus.PREDICTED if i in (6, 7) else PoseStatus.MEASURED)
        assert consistent(poses[i], frame)
    assert frame.predicted_px.shape == (2, 7, 2)


def test_one_blind_camera_still_measures_with_a_larger_covariance():
    rng, pose = np.random.default_rng(4), pose_at(6, 4)
    both = BinocularTracker(PAIR, MODEL, P).step(0.0, images(pose, rng))
    one = BinocularTracker(PAIR, MODEL, P).step(0.0, (images(pose, rng)[0], None))
    assert one.status is PoseStatus.MEASURED, one.reason
    assert consistent(pose, one)
    assert np.trace(one.covariance[:3, :3]) > 4 * np.trace(both.covariance[:3, :3])


def test_too_few_markers_and_no_pictures_are_lost_with_their_reason():
    rng, pose = np.random.default_rng(5), pose_at(9, 5)
    two = images(pose, rng, hidden=((0, 1, 2, 3, 4), (0, 1, 2, 3, 4)))
    frame = BinocularTracker(PAIR, MODEL, P).step(0.0, two)
    assert (frame.status, frame.reason, frame.pose) == (PoseStatus.LOST, TOO_FEW, None)
    assert BinocularTracker(PAIR, MODEL, P).step(0.0, (None, None)).reason == NO_PICTURES


@pytest.mark.parametrize("seeds", [(0,), pytest.param(range(1, 40), marks=pytest.mark.slow)])
def test_points_without_a_target_give_no_measured_pose(seeds):
    for seed in seeds:
        rng = np.random.default_rng(seed)
        left, right = (rng.uniform(300, 700, (9, 2)) for _ in range(2))
        cov = np.broadcast_to(0.01 * np.eye(2), (9, 2, 2))
        pictures = tuple(MarkerImages(u, cov, np.full(9, np.nan), np.zeros(9, dtype=np.int64)) for u in (left, right))
        frame = BinocularTracker(PAIR, MODEL, P).step(0.0, pictures)
        assert frame.status is not PoseStatus.MEASURED


def test_a_flat_far_target_has_two_attitudes_and_the_covariance_covers_both():
    flat = MarkerModel(MODEL.names, MODEL.positions * [1, 1, 0], MODEL.colour, MODEL.radius_m)
    rng, seen = np.random.default_rng(6), 0
    for i in range(2):
        pose = random_pose(60.0, np.random.default_rng(i))
        uv = project_markers(PAIR, flat, pose)[0] + rng.normal(0, 0.1, (2, 7, 2))
        cov = np.broadcast_to(0.01 * np.eye(2), (7, 2, 2))
        pictures = tuple(MarkerImages(u, cov, np.full(7, np.nan), np.zeros(7, dtype=np.int64)) for u in uv)
        frame = BinocularTracker(PAIR, flat, P).step(0.0, pictures)
        if frame.status is PoseStatus.MEASURED or frame.reason == AMBIGUOUS:
            assert consistent(pose, frame)
        seen += frame.reason == AMBIGUOUS
    assert seen >= 1


def test_the_mirrored_pose_has_nearly_the_same_images_of_a_flat_target_and_twice_mirrored_is_the_start():
    flat = MarkerModel(MODEL.names, MODEL.positions * [1, 1, 0], MODEL.colour, MODEL.radius_m)
    pose = random_pose(60.0, np.random.default_rng(3))
    other = mirrored(PAIR, flat, pose)
    assert np.linalg.det(other.rotation) == pytest.approx(1)
    apart = project_markers(PAIR, flat, pose)[0] - project_markers(PAIR, flat, other)[0]
    assert np.abs(apart).max() < 0.6  # px; the target is 11 px wide
    np.testing.assert_allclose(mirrored(PAIR, flat, other).rotation, pose.rotation, atol=1e-9)


def recording(delay_s, seed=7):
    """Fitted frames of a target that moves up and sideways at about 1 m/s, 25 Hz; right picture late."""
    rng, out = np.random.default_rng(seed), []
    cov = np.broadcast_to(NOISE_PX**2 * np.eye(2), (2, 7, 2, 2))
    for t in np.arange(40) / 25:
        poses = [
            Pose.from_ypr(
                np.array([0.3 * np.sin(2 * s), 0.1, 0.2]), np.array([0.2 + 0.5 * np.sin(3 * s), 0.9 * s - 0.2, 8.0])
            )
            for s in (t, t + delay_s)
        ]
        pixels = np.stack([project_markers(PAIR, MODEL, pose)[0][c] for c, pose in enumerate(poses)])
        observed = MarkerObservations(pixels + rng.normal(0, NOISE_PX, pixels.shape), cov)
        out.append(FittedFrame(t, fit_pose(PAIR, MODEL, observed, poses[0]), observed))
    return out


def test_an_offset_of_the_clocks_is_measured_from_residuals_that_grow_with_velocity():
    late = clock_offset(PAIR, MODEL, recording(0.003))
    assert late.significant
    assert late.offset_s == pytest.approx(0.003, abs=4 * late.sigma_s)
    none = clock_offset(PAIR, MODEL, recording(0.0))
    assert not none.significant
    assert abs(none.offset_s) < 5 * none.sigma_s


def test_two_equal_targets_are_ambiguous_until_one_is_followed():
    rng = np.random.default_rng(8)
    one = Pose.from_ypr(np.array([0.2, 0.1, 0.0]), np.array([-1.2, 0.0, 9.0]))
    two = Pose.from_ypr(np.array([-0.1, 0.0, 0.1]), np.array([1.5, 0.2, 9.5]))

    def both():
        pairs = zip(images(one, rng), images(two, rng), strict=True)
        return tuple(
            MarkerImages(*(np.concatenate([getattr(a, n), getattr(b, n)]) for n in MarkerImages.__slots__))
            for a, b in pairs
        )

    frame = BinocularTracker(PAIR, MODEL, P).step(0.0, both())
    assert frame.status is not PoseStatus.MEASURED
    tracker = BinocularTracker(PAIR, MODEL, P)
    tracker.step(0.0, images(one, rng))
    followed = tracker.step(0.04, both())
    assert followed.status is PoseStatus.MEASURED, followed.reason
    assert consistent(one, followed)


@pytest.mark.parametrize("seed", further_slow([45, 30]))
def test_a_wrong_calibration_gives_no_turned_pose_of_half_of_the_markers(seed):
    """Each picture alone shows the whole target; a pose of some markers that agrees in both is another one."""
    names = [f"cameras.{c.name}.{p}" for c in PAIR.cameras for p in ("fx", "fy", "cx", "cy")]
    names += [f"cameras.{PAIR.cameras[1].name}.rot_{a}_rad" for a in "xyz"]
    covariance = RigCovariance(tuple(names), np.diag([0.2**2] * 8 + [1e-8] * 3))
    pair = StereoPair((perturbed_camera(PAIR.cameras[0], {"cx": -2.0}), PAIR.cameras[1]), covariance)
    rng = np.random.default_rng(seed)
    angles, place = rng.uniform(-0.3, 0.3, 3), [rng.uniform(-1, 1), rng.uniform(-0.7, 0.7), rng.uniform(12, 20)]
    pose = Pose.from_ypr(angles, np.array(place))
    frame = BinocularTracker(pair, MODEL, P).step(0.0, images(pose, rng))
    assert frame.status is not PoseStatus.MEASURED or np.abs(pose.minus(frame.pose)[3:]).max() < 0.3
