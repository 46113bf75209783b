"""Network adjustments against truth: values, covariances, exchanged dots, boards, wrong surveys."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.screens.network import ControlPoints, PointObservations, classify_outliers
from calibration.screens.network_start import NotConnectedError
from calibration.screens.screens import (
    ApproximatePosition,
    ScreenSetup,
    calibrate,
    diagnose_survey,
    misfit_of,
    pointing_sigmas_m,
    spot_sigmas,
    wrong_unit,
)
from geometry.pose import Pose
from geometry.rig import Rig
from lab.calibrate.screens.screen_page import near_findings, network_findings
from lab.findings.finding import Level
from tests.calibration.screens.networks import corners_of, fixed_to, lab, look_at, lying_on, measured, without_dots

PLAIN = [ScreenSetup(), ScreenSetup()]
POSE = ("x_m", "y_m", "z_m", "rot_x_rad", "rot_y_rad", "rot_z_rad")


def block(fit, *things):
    names = fit.covariance.names
    rows = [names.index(f"{t}.{p}") for t in things for p in POSE]
    return fit.covariance.matrix[np.ix_(rows, rows)]


def camera_errors(fit, truth):
    return np.concatenate(
        [fit.rig.cameras[n].camera_from_world.minus(c.camera_from_world) for n, c in truth.cameras.items()]
    )


def plane_errors(fit, truth, name):
    """Errors of a screen's plane: height at its origin and tilts about x, y, with their covariance (3, 3)."""
    found, true = fit.rig.screens[name].world_from_screen, truth.screens[name].world_from_screen
    normal = true.rotation[:, 2] * np.sign(true.rotation[:, 2] @ found.rotation[:, 2])
    height = (found.translation - true.translation) @ normal
    tilt = found.rotation.T @ normal  # in the found frame: (theta_y, -theta_x, 1) of the remaining rotation
    T = np.zeros((3, 6))
    T[0, :3] = found.rotation[:, 2]
    T[1, 3] = T[2, 4] = 1.0
    C = T @ block(fit, f"screens.{name}") @ T.T
    return np.array([height, tilt[1], -tilt[0]]), C


def scores(seeds):
    """Per seed: squared errors over variances of the cameras (12) and of both planes (3 + 3), and the NEES of each."""
    truth, cameras, planes, nees_c, nees_p = lab(), [], [], [], []
    for seed in seeds:
        fit = calibrate(measured(seed), PLAIN).fit
        e, C = camera_errors(fit, truth), block(fit, "cameras.left", "cameras.right")
        cameras.append(e**2 / np.diagonal(C))
        nees_c.append(e @ np.linalg.solve(C, e) / 12)
        for name in truth.screens:
            e, C = plane_errors(fit, truth, name)
            planes.append(e**2 / np.diagonal(C))
            nees_p.append(e @ np.linalg.solve(C, e) / 3)
    return np.array(cameras), np.array(planes), np.array(nees_c), np.array(nees_p)


def test_cameras_and_screens_are_estimated_within_their_sigmas():
    cameras, planes, nees_c, nees_p = scores(range(12))
    # 144 and 72 numbers: a share of 68 % within one sigma has a sigma of 6 %, as errors of a seed are correlated.
    assert 0.5 < np.mean(cameras < 1) < 0.86
    assert 0.5 < np.mean(planes < 1) < 0.86
    assert 0.55 < np.mean(nees_c) < 1.6
    assert 0.5 < np.mean(nees_p) < 1.7


@pytest.mark.slow
def test_coverage_and_normalised_errors_over_200_networks():
    cameras, planes, nees_c, nees_p = scores(range(200))
    share = np.mean(cameras < 1, axis=0)
    assert np.all((share > 0.58) & (share < 0.78))  # each of 12: 0.683 +- 0.033 at 1 sigma, 3 sigmas wide
    assert 0.65 < np.mean(cameras < 1) < 0.72
    assert 0.64 < np.mean(planes < 1) < 0.73
    assert abs(np.mean(nees_c) - 1) < 2 * np.sqrt(2 / 12 / 200)
    assert abs(np.mean(nees_p) - 1) < 2 * np.sqrt(2 / 3 / 400)


def test_surfaces_and_cameras_are_known_more_accurately_than_a_single_dot():
    result = calibrate(measured(0), PLAIN)
    assert max(np.max(spot_sigmas(result, k)) for k in range(2)) < 3e-4
    assert max(pointing_sigmas_m(result).values()) < 3e-4
    assert all(f.level == Level.PASS for f in network_findings(result))
    assert result.fit.variance_factor == 1.0


def test_exchanged_names_are_identified_and_do_not_bias_the_camera():
    network = measured(1)
    of = network.point_observations.point_of.copy()
    of[[2, 5]] = of[[5, 2]]
    result = calibrate(replace(network, point_observations=replace(network.point_observations, point_of=of)), PLAIN)
    words = [f.what for f in network_findings(result) if f.level == Level.WARN]
    assert len(words) == 1
    assert "camera 'left': dots 'L6' and 'L3' are exchanged" in words[0]
    clean = calibrate(network, PLAIN)
    sigmas = np.sqrt(np.diagonal(block(clean.fit, "cameras.left", "cameras.right")))
    # Without two dots of twelve the result changes slightly.
    assert np.all(np.abs(camera_errors(result.fit, clean.fit.rig)) < 2 * sigmas)


def test_a_dot_with_the_name_of_another_one_is_identified():
    network = measured(1)
    pixels = network.point_observations.pixels.copy()
    pixels[3] = pixels[7] + 0.1
    result = calibrate(replace(network, point_observations=replace(network.point_observations, pixels=pixels)), PLAIN)
    (wrong,) = classify_outliers(result.network, result.fit)
    assert (wrong.dot, wrong.at_place_of, wrong.swapped) == ("L4", "L8", False)


def test_a_wrong_point_of_light_is_excluded_and_its_error_given_in_metres():
    network = measured(1)
    pixels = network.point_observations.pixels.copy()
    pixels[3] += [25.0, 5.0]
    result = calibrate(replace(network, point_observations=replace(network.point_observations, pixels=pixels)), PLAIN)
    (wrong,) = classify_outliers(result.network, result.fit)
    assert wrong.dot == "L4"
    assert wrong.at_place_of == ""
    assert wrong.error_px == pytest.approx(np.hypot(25, 5), abs=1.0)
    assert 0.05 < np.linalg.norm(wrong.error_m) < 0.3  # 25 px at 4.4 m and 1180 px: 95 mm, more at oblique view


def test_a_dot_surveyed_off_its_screen_is_reported_with_its_height():
    network = measured(1)
    xyz = network.control_points.xyz.copy()
    xyz[3, 0] += 0.02
    result = calibrate(replace(network, control_points=replace(network.control_points, xyz=xyz)), PLAIN)
    assert any("dot 'L4' is +20" in f.what for f in network_findings(result))


def test_sigmas_that_are_too_small_are_increased():
    network = measured(2)
    rng = np.random.default_rng(0)
    pixels = network.point_observations.pixels + 0.6 * rng.normal(size=network.point_observations.pixels.shape)
    rough = replace(network, point_observations=replace(network.point_observations, pixels=pixels))
    rough = replace(rough, control_points=replace(rough.control_points, covariance=rough.control_points.covariance / 9))
    result = calibrate(rough, PLAIN)
    assert result.fit.variance_factor > 2
    assert any(f.level >= Level.WARN and "larger than their sigmas" in f.what for f in network_findings(result))


def test_a_board_seen_by_two_cameras_connects_one_without_dots_to_the_world():
    rig = lab()
    extra = replace(rig.cameras["left"], name="extra", camera_from_world=look_at((1.2, -0.6, 1.2), (-2.5, 0.0, 0.0)))
    whole = Rig(rig.screens, {**rig.cameras, "extra": extra}, {}, {})
    network = replace(measured(3), rig=whole)
    towards = np.array([[0.0, 0, -1], [1, 0, 0], [0, -1, 0]])
    turns = [(0.0, 0.0), (0.3, 0.1), (-0.3, 0.2), (0.1, -0.4)]
    boards = [
        Pose(towards, np.array([-0.9 + 0.2 * i, -0.2, 0.4])).plus(np.array([0, 0, 0, a, b, 0]))
        for i, (a, b) in enumerate(turns)
    ]
    corners = corners_of(whole, boards)
    assert set(corners.camera) == {0, 2}
    result = calibrate(replace(network, corners=corners, placements=tuple("abcd")), PLAIN)
    e = result.fit.rig.cameras["extra"].camera_from_world.minus(extra.camera_from_world)
    C = block(result.fit, "cameras.extra")
    assert e @ np.linalg.solve(C, e) < 22.5  # chi-square of 6 at 0.1 %
    assert np.median(result.fit.corners.sigma_px) == pytest.approx(0.1, rel=0.15)
    centre = (
        extra.camera_from_world.inverse().translation
        - result.fit.rig.cameras["extra"].camera_from_world.inverse().translation
    )
    assert np.linalg.norm(centre) < 0.01


def test_unconnected_cameras_are_reported():
    network = measured(3)
    some = network.point_observations.camera_of == 0
    s = network.point_observations
    lone = PointObservations(s.camera_of[some], s.point_of[some], s.pixels[some], s.sigma_px[some])
    with pytest.raises(
        NotConnectedError, match=r"camera 'right' is not connected with the others \('left' have a pose\)"
    ):
        calibrate(replace(network, point_observations=lone), PLAIN)


def test_a_board_fixed_to_the_screen_gives_its_plane_without_a_survey():
    rig = lab()
    one = Rig({"left": rig.screens["left"]}, {"left": rig.cameras["left"]}, {}, {})
    board = lying_on(one.screens["left"], -0.1, 0.1)
    network = replace(
        without_dots(measured(0)),
        rig=one,
        corners=corners_of(one, [board], 0.05),
        placements=("board",),
        fixed=fixed_to([0], [0]),
    )
    result = calibrate(network, [ScreenSetup()], held_screen=0)
    found = result.fit.rig
    camera_from_screen = found.cameras["left"].camera_from_world @ found.screens["left"].world_from_screen
    true = one.cameras["left"].camera_from_world @ one.screens["left"].world_from_screen
    np.testing.assert_allclose(camera_from_screen.rotation[:, 2], true.rotation[:, 2], atol=2e-3)
    n = true.rotation[:, 2]
    assert abs((camera_from_screen.translation - true.translation) @ n) < 2e-3
    assert "cameras.left.x_m" in result.fit.covariance.names


def test_a_screen_without_measurements_is_reported():
    network = measured(0)
    off = replace(
        network,
        control_points=replace(
            network.control_points, screen_of=np.where(network.control_points.screen_of == 1, -1, 0)
        ),
    )
    with pytest.raises(NotConnectedError, match="screen 'right': expected three or more surveyed dots"):
        calibrate(off, PLAIN)


def near_truth(error=0.1):
    return {
        k: ApproximatePosition(c.camera_from_world.inverse().translation + error, 0.5)
        for k, c in enumerate(lab().cameras.values())
    }


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda xyz: xyz[:, [0, 2, 1]], "the survey with its columns y and z exchanged"),
        pytest.param(
            lambda xyz: 1000 * xyz,
            "the survey times 0.001 (metres were expected and millimetres written)",
            marks=pytest.mark.slow,
        ),
        pytest.param(lambda xyz: xyz * [1, -1, 1], "the survey with the sign of y reversed", marks=pytest.mark.slow),
    ],
)
def test_approximate_camera_positions_reveal_exchanged_axes_and_wrong_units(spoil, words):
    network = measured(1, control_points=5)
    spoilt = replace(network, control_points=replace(network.control_points, xyz=spoil(network.control_points.xyz)))
    result = calibrate(spoilt, PLAIN, near_truth())
    assert any(f.level == Level.FAIL for f in near_findings(result, near_truth()))
    tried: list[tuple[int, int]] = []
    found = diagnose_survey(
        spoilt, PLAIN, near_truth(), None, misfit_of(result, near_truth()), lambda *done: tried.append(done)
    )
    assert tried == [(k, len(tried)) for k in range(len(tried))]
    assert tried
    assert found[0].words == words
    assert found[0].factor < 2 < found[1].factor


def test_a_correct_survey_passes():
    result = calibrate(measured(1), PLAIN, near_truth())
    assert misfit_of(result, near_truth()) < 1.5
    assert all(f.level == Level.PASS for f in near_findings(result, near_truth()))


@pytest.mark.parametrize(("extent", "words"), [(2900.0, "millimetres"), (114.0, "inches"), (9.5, "feet"), (2.6, "")])
def test_a_size_reveals_the_unit(extent, words):
    assert words in wrong_unit(extent, 2.9)
    assert bool(wrong_unit(extent, 2.9)) == bool(words)


def test_collinear_dots_give_no_camera_pose():
    network = measured(0)
    t = np.linspace(-1, 1, len(network.control_points))
    line = np.stack([np.full_like(t, -2.5), t, 0.3 * t], axis=1)
    control_points = ControlPoints(
        network.control_points.names, line, network.control_points.covariance, network.control_points.screen_of
    )
    pixels = np.concatenate([c.project(line[12 * k : 12 * k + 12]) for k, c in enumerate(network.rig.cameras.values())])
    with pytest.raises(NotConnectedError, match="all lie on one line"):
        calibrate(
            replace(
                network,
                control_points=control_points,
                point_observations=replace(network.point_observations, pixels=np.nan_to_num(pixels)),
            ),
            PLAIN,
        )
