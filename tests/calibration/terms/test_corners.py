"""Corners of boards: the projection against OpenCV, the derivatives against finite differences."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from calibration.least_squares.adjustment import Poses, Vectors
from calibration.terms.corners import CornerTerm
from geometry.arrays import numeric_jacobian
from geometry.pose import Pose
from geometry.rotations import exp

LENS = np.array(
    [800.0, 810, 320, 240, -0.2, 0.1, 0.001, -0.002, 0.02, 0.01, 0.02, 0.003, 1e-3, -1e-3, 2e-3, 1e-3, 0.02, -0.01]
)
WIDE = np.array([400.0, 405, 330, 250, 0.02, -0.01, 0.003, 0.001, *[0.0] * 10])


def scene(rng: np.random.Generator, radii: tuple[float, float] | None = None) -> tuple[CornerTerm, dict]:
    """Two cameras (one of them fisheye) that see two bent boards in three placements.

    radii of the circles of both boards, m, 0 for corners; with radii the boards also have stretch and errors of points.
    """
    x, y = np.meshgrid(np.arange(5) * 0.03, np.arange(4) * 0.03)
    grid = np.stack([x.ravel(), y.ravel(), np.zeros(20)], axis=1)
    pairs = [(c, p) for c in range(2) for p in range(3)]
    count = len(pairs) * len(grid)
    term = CornerTerm(
        pixels=rng.uniform(0, 500, (count, 2)),
        points=np.tile(grid, (len(pairs), 1)),
        from_middle=np.tile(grid[:, :2] - [0.06, 0.045], (len(pairs), 1)),
        camera=np.repeat([c for c, _ in pairs], 20),
        placement=np.repeat([p for _, p in pairs], 20),
        board=np.repeat([p % 2 for _, p in pairs], 20),
        sigma_px=rng.uniform(0.1, 0.4, count),
        fisheye=np.array([False, True]),
        point=np.tile(np.arange(20), len(pairs)),
    )
    printed = {
        "radius": Vectors(np.array(radii or (0.0, 0.0))[:, None]),
        "stretch": Vectors(rng.normal(0, 0.02, (2, 2))),
        "print": Vectors(rng.normal(0, 1e-3, (20, 3))),
    }
    values = {
        "intrinsics": Vectors(np.array([LENS, WIDE])),
        "cameras": Poses(Pose(exp(rng.normal(0, 0.1, (2, 3))), rng.normal(0, 0.05, (2, 3)))),
        "boards": Poses(Pose(exp(rng.normal(0, 0.3, (3, 3))), np.array([0, 0, 0.5]) + rng.normal(0, 0.03, (3, 3)))),
        "warp": Vectors(rng.normal(0, 0.2, (2, 3))),
    }
    return term, values | (printed if radii else {})


@pytest.mark.parametrize(
    ("name", "radii"),
    [
        *[(name, None) for name in ("intrinsics", "cameras", "boards", "warp")],
        *[(n, (0.006, 0.0)) for n in ("intrinsics", "cameras", "boards", "warp", "stretch", "print")],
        ("radius", (0.006, 0.008)),
    ],
)
def test_derivatives_by_each_stack_equal_finite_differences(name, radii):
    term, values = scene(np.random.default_rng(1), radii)
    part = next(p for p in term.linearise(values).parts if p.stack == name)
    stack = values[name]

    def residuals(delta: np.ndarray) -> np.ndarray:
        moved = {**values, name: stack.plus(delta.reshape(len(stack), stack.dof))}
        return term.linearise(moved).residuals

    by_all = numeric_jacobian(residuals, np.zeros(len(stack) * stack.dof)).reshape(len(term), 2, len(stack), stack.dof)
    expected = by_all[np.arange(len(term)), :, part.index]
    scale = np.abs(expected).max(axis=(0, 1))
    np.testing.assert_allclose(part.jacobian / scale, expected / scale, atol=1e-6)
    others = by_all.copy()
    others[np.arange(len(term)), :, part.index] = 0
    assert np.all(others == 0)  # a corner depends on its own camera, placement and board alone


@pytest.mark.parametrize("camera", [0, 1])
def test_corners_project_to_the_pixels_of_opencv(camera):
    term, values = scene(np.random.default_rng(2))
    mine = (term.camera == camera) & (term.placement == 1)
    x, y = term.from_middle[mine].T
    a, b, c = values["warp"].array[1]
    bent = term.points[mine] + np.outer(a * x * x + b * x * y + c * y * y, [0, 0, 1])
    camera_from_board = values["cameras"].pose[camera] @ values["boards"].pose[1]
    rotation, translation = cv2.Rodrigues(camera_from_board.rotation)[0], camera_from_board.translation
    fx, fy, cx, cy, *d = values["intrinsics"].array[camera]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    if camera:
        expected, _ = cv2.fisheye.projectPoints(bent[:, None], rotation, translation, K, np.array(d[:4]))
    else:
        expected, _ = cv2.projectPoints(bent, rotation, translation, K, np.array(d))
    np.testing.assert_allclose(term.project(values)[mine], expected.reshape(-1, 2), atol=1e-9)


def test_a_residual_is_divided_by_its_own_corners_sigma():
    term, values = scene(np.random.default_rng(3))
    away = (term.project(values) - term.pixels) / term.sigma_px[:, None]
    np.testing.assert_allclose(term.linearise(values).residuals, away, atol=1e-12)


def test_a_circle_is_predicted_at_the_centroid_of_its_image():
    """Against the centroid of a polygon of 400 outline points projected by OpenCV."""
    term, values = scene(np.random.default_rng(4), (0.009, 0.012))
    values |= {"stretch": Vectors(np.zeros((2, 2))), "print": Vectors(np.zeros((20, 3)))}
    turn = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    placement, camera = 1, 0
    mine = (term.camera == camera) & (term.placement == placement)
    camera_from_board = values["cameras"].pose[camera] @ values["boards"].pose[placement]
    fx, fy, cx, cy, *d = values["intrinsics"].array[camera]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    a, b, c = values["warp"].array[1]
    expected, centres = [], []
    for place, middle in zip(term.points[mine], term.from_middle[mine], strict=True):
        step = 0.012 * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        x, y = (middle + step).T
        ring = np.column_stack([place[:2] + step, a * x * x + b * x * y + c * y * y])
        rotvec = cv2.Rodrigues(camera_from_board.rotation)[0]
        u, v = cv2.projectPoints(ring, rotvec, camera_from_board.translation, K, np.array(d))[0].reshape(-1, 2).T
        before = np.roll(u, 1) * v - u * np.roll(v, 1)
        centre = [np.sum((np.roll(w, 1) + w) * before) / (3 * before.sum()) for w in (u, v)]  # of a polygon
        expected.append(centre)
    flat = {**values, "radius": Vectors(np.zeros((2, 1)))}
    centres = term.project(flat)[mine]
    found = term.project(values)[mine]
    assert np.abs(found - centres).max() > 0.1  # px: the error if the circle is treated as a point
    np.testing.assert_allclose(found, expected, atol=3e-4)  # px
