"""Terms of surveyed points: residuals against independent computations, derivatives against finite differences."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.least_squares.adjustment import Poses, Vectors
from calibration.terms.surveyed import BoardOnScreenTerm, FrameTerm, PointTerm, SurfaceTerm, SurveyTerm, whitening
from geometry.arrays import numeric_jacobian
from geometry.camera import Camera
from geometry.pose import Pose
from geometry.rotations import exp

LENS = (-0.1, 0.02, 1e-3, -5e-4, 0.01)
WIDE = (0.02, -0.01, 0.003, -0.001)


def scene(seed=0):
    """Two cameras (the second a fisheye), two bent screens, six points 2 to 4 m before the cameras."""
    rng = np.random.default_rng(seed)
    intrinsics = np.zeros((2, 18))
    intrinsics[:, :4] = [[900.0, 905, 640, 500], [400.0, 402, 600, 520]]
    intrinsics[0, 4:9], intrinsics[1, 4:8] = LENS, WIDE
    cameras = [Pose(exp(0.2 * rng.normal(size=3)), 0.1 * rng.normal(size=3)) for _ in range(2)]
    screens = [Pose(exp(0.4 * rng.normal(size=3)), np.array([0, 0, 3.0])) for _ in range(2)]
    points = rng.uniform([-1, -1, 2], [1, 1, 4], (6, 3))
    return {
        "intrinsics": Vectors(intrinsics),
        "cameras": Poses.of(cameras),
        "screens": Poses.of(screens),
        "bow": Vectors(0.02 * rng.normal(size=(2, 3))),
        "points": Vectors(points),
    }


def correlated(rng, n, d):
    root = rng.normal(size=(n, d, d))
    return root @ np.swapaxes(root, -1, -2) + np.eye(d)


def terms(seed=0):
    rng = np.random.default_rng(seed + 100)
    camera_of, point_of = np.array([0, 1, 0, 1, 1]), np.array([0, 0, 2, 4, 5])
    screen_of = np.array([0, 1, 1, 0])
    return {
        "point": PointTerm(
            camera_of,
            point_of,
            rng.uniform(0, 1000, (5, 2)),
            whitening(correlated(rng, 5, 2)),
            np.array([False, True]),
        ),
        "surface": SurfaceTerm(screen_of, np.array([1, 2, 3, 5]), rng.uniform(0.5, 2, 4)),
        "survey": SurveyTerm(np.array([0, 3, 4]), rng.normal(size=(3, 3)), whitening(correlated(rng, 3, 3))),
        "frame": FrameTerm(
            np.array([0, 1]), scene(seed)["screens"].pose.plus(1e-4 * rng.normal(size=(2, 6))), sigma=1.0
        ),
    }


@pytest.mark.parametrize("kind", ["point", "surface", "survey", "frame"])
@pytest.mark.parametrize("seed", range(3))
def test_derivatives_equal_finite_differences_of_the_residuals(kind, seed):
    values, term = scene(seed), terms(seed)[kind]
    line = term.linearise(values)
    assert line.parts
    for part in line.parts:
        stack = values[part.stack]
        for element in range(len(stack)):

            def residuals(delta, part=part, stack=stack, element=element):
                move = np.zeros((len(stack), stack.dof))
                move[element] = delta
                return term.linearise({**values, part.stack: stack.plus(move)}).residuals

            expected = numeric_jacobian(residuals, np.zeros(stack.dof), 1e-5)
            mine = np.where((part.index == element)[:, None, None], part.jacobian, 0.0)
            scale = max(1.0, np.abs(mine).max())
            np.testing.assert_allclose(mine, expected, atol=2e-4 * scale if kind == "frame" else 1e-6 * scale)


def test_the_residual_of_a_point_is_predicted_minus_measured_pixel_in_sigmas():
    values, term = scene(), terms()["point"]
    row = values["intrinsics"].array[1]
    matrix = np.array([[row[0], 0, row[2]], [0, row[1], row[3]], [0, 0, 1]])
    camera = Camera("c", "s", (1280, 1024), matrix, WIDE, values["cameras"].pose[1], lens="fisheye")
    pixel = camera.project(values["points"].array[4])
    got = term.linearise(values).residuals[3]
    np.testing.assert_allclose(got, term.whiten[3] @ (pixel - term.pixels[3]), atol=1e-9)


def test_a_point_behind_the_camera_has_no_residual():
    values = scene()
    behind = values["points"].array * [1, 1, -1]
    line = terms()["point"].linearise({**values, "points": Vectors(behind)})
    assert np.isnan(line.residuals).all()


def test_points_on_a_bent_surface_have_no_height():
    values = scene()
    a, b, c = values["bow"].array[1]
    x, y = 0.7, -0.4
    point = values["screens"].pose[1].apply(np.array([x, y, a * x * x + b * x * y + c * y * y]))
    term = SurfaceTerm(np.array([1]), np.array([0]), np.array([1e-3]))
    line = term.linearise({**values, "points": Vectors(point[None])})
    np.testing.assert_allclose(line.residuals, 0, atol=1e-9)


def test_whitening_turns_a_covariance_into_the_identity():
    C = correlated(np.random.default_rng(3), 4, 3)
    W = whitening(C)
    np.testing.assert_allclose(W @ C @ np.swapaxes(W, -1, -2), np.broadcast_to(np.eye(3), (4, 3, 3)), atol=1e-12)


def test_the_frame_is_constrained_only_within_the_plane():
    values = scene()
    chosen = values["screens"].pose
    term = FrameTerm(np.array([0, 1]), chosen)
    R = chosen.rotation
    along_normal = np.concatenate([R[:, :, 2] * 0.01, np.tile([1e-3, -2e-3, 0], (2, 1))], axis=1)
    line = term.linearise({**values, "screens": Poses(chosen.plus(along_normal))})
    np.testing.assert_allclose(line.residuals * term.sigma, 0, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_derivatives_of_a_board_on_a_screen_equal_finite_differences(seed):
    rng = np.random.default_rng(seed)
    values = scene(seed)
    screens = values["screens"].pose
    lying = screens.plus(0.1 * rng.normal(size=(2, 6))) @ Pose(np.diag([1.0, -1, -1]), np.array([0.3, -0.2, 0.01]))
    values = {**values, "boards": Poses(lying)}
    term = BoardOnScreenTerm(
        np.array([1, 0]),
        np.array([1, 0]),
        rng.uniform(0, 0.3, (2, 3)),
        np.array([0.003, 0.004]),
        np.array([1.0, 0.5]),
        np.array([1.0, 2.0]),
    )
    line = term.linearise(values)
    for part in line.parts:
        stack = values[part.stack]
        for element in range(2):

            def residuals(delta, part=part, stack=stack, element=element):
                move = np.zeros((2, stack.dof))
                move[element] = delta
                return term.linearise({**values, part.stack: stack.plus(move)}).residuals

            expected = numeric_jacobian(residuals, np.zeros(stack.dof), 1e-5)
            mine = np.where((part.index == element)[:, None, None], part.jacobian, 0.0)
            np.testing.assert_allclose(mine, expected, atol=1e-8, err_msg=part.stack)


def test_a_board_flat_on_a_screen_at_its_offset_has_no_residual():
    values = {**scene(), "bow": Vectors(np.zeros((2, 3)))}
    middle = np.array([0.15, 0.1, 0.0])
    screen_from_board = Pose(np.diag([1.0, -1, -1]), np.array([0.4, 0.2, 0.003]))
    boards = values["screens"].pose[np.array([1])] @ screen_from_board
    term = BoardOnScreenTerm(
        np.array([1]), np.array([0]), middle[None], np.array([0.003]), np.array([1e-3]), np.array([1e-3])
    )
    np.testing.assert_allclose(term.linearise({**values, "boards": Poses(boards)}).residuals, 0, atol=1e-9)
