"""A recording shows which single error of the pair's calibration it contradicts, and which ones it cannot separate."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geometry.pose import Pose
from geometry.uncertainty.rig_uncertainty import RigCovariance, perturbed_camera
from tests.tracking.binocular.scenes import MODEL, NOISE_PX, PAIR, images
from tracking.binocular.calibration_check import ClockOffset, LabelledFrame, check_calibration, labelled_by_each
from tracking.binocular.joint_fit import MarkerObservations
from tracking.binocular.marker_model import MatchParameters, StereoPair, project_markers

LEFT, RIGHT = PAIR.cameras


def approach(pair=PAIR, frames=25):
    """Labelled frames of a target that comes from 16 to 5 m, seen by a pair."""
    rng, out = np.random.default_rng(5), []
    for s in np.linspace(0, 1, frames):
        ypr = np.array([0.3 * np.sin(6 * s), 0.25 * np.cos(5 * s), 0.2 * np.sin(4 * s)])
        pose = Pose.from_ypr(ypr, np.array([0.25 + 0.3 * np.sin(5 * s), 0.3 * np.cos(7 * s), 16 - 11 * s]))
        uv = project_markers(pair, MODEL, pose)[0] + rng.normal(0, NOISE_PX, (2, len(MODEL), 2))
        cov = np.broadcast_to(NOISE_PX**2 * np.eye(2), (2, len(MODEL), 2, 2))
        out.append(LabelledFrame(MarkerObservations(uv, cov), pose))
    return out


def wrong_pair(camera, **change):
    """The pair with an error of one camera."""
    left, right = (perturbed_camera(c, change) if c.name == camera else c for c in PAIR.cameras)
    return StereoPair((left, right))


def turned_right_camera(axis, angle_deg):
    """The pair with the right camera turned about an axis through its own centre."""
    turn = Rotation.from_rotvec(np.deg2rad(angle_deg) * np.eye(3)["xyz".index(axis)]).as_matrix()
    place = RIGHT.camera_from_world
    return StereoPair((LEFT, replace(RIGHT, camera_from_world=Pose(turn @ place.rotation, turn @ place.translation))))


def longer_baseline(share):
    place = RIGHT.camera_from_world
    return StereoPair((LEFT, replace(RIGHT, camera_from_world=Pose(place.rotation, (1 + share) * place.translation))))


@pytest.mark.parametrize(
    ("pair", "name", "value", "alone"),
    [
        (longer_baseline(0.01), "baseline", -0.99, True),
        (turned_right_camera("z", 0.3), "roll between the cameras", -0.3, True),
        (turned_right_camera("y", 0.05), "yaw between the cameras", -0.05, False),
        (turned_right_camera("x", 0.05), "pitch between the cameras", -0.05, False),
        (wrong_pair("left", fx=5.5, fy=5.5), "focal length of left", -0.5, False),
        (wrong_pair("right", fx=-5.5, fy=-5.5), "focal length of right", 0.5, False),
        (wrong_pair("left", cx=2.0), "principal point cx of left", -2.0, False),
        (wrong_pair("right", cy=2.0), "principal point cy of right", -2.0, False),
    ],
)
def test_an_error_of_the_calibration_is_named_with_its_size(pair, name, value, alone):
    check = check_calibration(pair, MODEL, approach())
    assert check.significant
    named = {s.name: s for s in check.suspects}
    assert name in named
    assert len(named) == 1 or not alone
    assert named[name].value == pytest.approx(value, abs=5 * named[name].sigma + 0.02 * abs(value))
    assert check.left < 1.5


def test_a_right_calibration_is_not_suspected_and_what_it_would_not_show_is_stated():
    check = check_calibration(PAIR, MODEL, approach())
    assert not check.significant
    # Both focal lengths off by a third of the limit are hidden, by three times the limit they are named.
    share = check.hidden_focal_percent / 100
    for factor, shown in ((1 / 3, False), (3, True)):
        off = dict.fromkeys(("fx", "fy"), factor * share * LEFT.matrix[0, 0])
        wrong = StereoPair((perturbed_camera(LEFT, off), perturbed_camera(RIGHT, off)))
        found = check_calibration(wrong, MODEL, approach())
        assert found.certain is shown
        assert not shown or "focal length of both cameras" in {s.name for s in found.suspects}


def common_focal_sigma(pair, model, poses):
    """Bound of Cramer and Rao, %: of a common error of both focal lengths with all poses unknown, by differences."""

    def pixels(pose, share=0.0):
        off = dict.fromkeys(("fx", "fy"), share * LEFT.matrix[0, 0])
        changed = StereoPair(tuple(perturbed_camera(camera, off) for camera in pair.cameras))
        return project_markers(changed, model, pose)[0].ravel() / NOISE_PX

    information = 0.0
    for pose in poses:
        J = np.stack([(pixels(pose.plus(h)) - pixels(pose.plus(-h))) / 2e-5 for h in 1e-5 * np.eye(6)], axis=1)
        of_share = (pixels(pose, 1e-5) - pixels(pose, -1e-5)) / 2e-5
        left = of_share - J @ np.linalg.lstsq(J, of_share, rcond=None)[0]
        information += left @ left
    return 100 / np.sqrt(information)


def test_what_a_recording_does_not_show_of_both_focal_lengths_no_estimate_could():
    """The stated limit is the bound of the information: from depth within the target, and from cameras that are turned
    towards each other. Of a flat target that faces cameras side by side nothing shows.
    """
    frames = approach()
    poses = [frame.pose for frame in frames]
    check = check_calibration(PAIR, MODEL, frames)
    bound = common_focal_sigma(PAIR, MODEL, poses)
    assert check.hidden_focal_percent == pytest.approx(np.sqrt(20 * max(check.left, 1)) * bound, rel=0.05)
    R, eye = LEFT.camera_from_world.rotation, RIGHT.camera_from_world.inverse().translation
    beside = StereoPair((LEFT, replace(RIGHT, camera_from_world=Pose(R, -R @ eye))))
    flat = replace(MODEL, positions=MODEL.positions * [1, 1, 0])
    facing = [Pose(np.eye(3), pose.translation) for pose in poses]
    assert common_focal_sigma(beside, flat, facing) > 50 * bound
    assert common_focal_sigma(beside, MODEL, poses) > 1.5 * bound


def test_an_error_that_the_covariance_states_is_not_suspected():
    wrong = wrong_pair("right", rot_y_rad=np.deg2rad(0.05))
    stated = RigCovariance(("cameras.right.rot_y_rad",), np.array([[np.deg2rad(0.05) ** 2]]))
    assert not check_calibration(StereoPair(wrong.cameras, stated), MODEL, approach()).significant


def test_an_error_of_the_markers_places_that_is_stated_is_not_suspected_and_limits_what_is_known_of_the_baseline():
    off = np.random.default_rng(8).normal(0, 0.002, MODEL.positions.shape)
    stated = replace(MODEL, positions=MODEL.positions + off, sigma_m=0.002)
    frames = approach(frames=12)
    assert check_calibration(PAIR, replace(stated, sigma_m=0.0), frames).significant
    check = check_calibration(PAIR, stated, frames)
    assert not check.significant
    # A larger target is the same as a longer baseline: the sigma of its scale, in per cent.
    reach_m = np.linalg.norm(MODEL.positions - MODEL.positions.mean(axis=0))
    (baseline,) = (s for s in check.suspects if s.name == "baseline")
    assert baseline.sigma == pytest.approx(100 * 0.002 / reach_m, rel=0.15)


def test_too_few_frames_are_not_tested():
    assert check_calibration(PAIR, MODEL, approach(frames=4)) is None


def test_markers_are_labelled_in_each_picture_where_the_cameras_contradict_each_other():
    pose, rng = Pose.from_ypr(np.array([0.2, 0.1, 0.0]), np.array([0.2, 0.1, 8.0])), np.random.default_rng(3)
    wrong = wrong_pair("right", rot_x_rad=np.deg2rad(0.5))  # 10 px
    found = labelled_by_each(wrong, MODEL, images(pose, rng), None, MatchParameters())
    np.testing.assert_allclose(found.observed.uv_px, project_markers(PAIR, MODEL, pose)[0], atol=6 * NOISE_PX)


@pytest.mark.parametrize(
    ("sigmas", "jitter_significance", "shift_px", "significant"),
    [(6.0, 0.0, 0.2, True), (0.0, 9.0, 0.2, True), (4.0, 7.0, 0.2, False), (6.0, 9.0, 0.04, False)],
)
def test_an_offset_of_the_clocks_counts_where_it_is_certain_and_moves_the_images(
    sigmas, jitter_significance, shift_px, significant
):
    offset = ClockOffset(-1e-4 * sigmas, 1e-4, np.zeros(3), np.ones(3), 0.0, jitter_significance, shift_px, 50)
    assert offset.significant == significant
