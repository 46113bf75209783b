"""Measurement of corners against the exact light of blurred edges, and the shape of grids against the projection."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from calibration.boards.board_types import Chessboard, parse
from calibration.boards.corner_refinement import _crossing, _weights_of_others, refined
from calibration.boards.grid_shape import _ratio, local_shape
from geometry import rotations
from geometry.arrays import Array
from geometry.camera import FISHEYE, PERSPECTIVE, Camera
from geometry.pose import Pose
from tests.marks import further_slow

px = 1.0
SIZE = (640, 480)
LENSES = {
    "pinhole": (PERSPECTIVE, 500.0, ()),
    "barrel": (PERSPECTIVE, 500.0, (-0.3, 0.12, 5e-4, -3e-4, -0.02)),
    "pincushion": (PERSPECTIVE, 500.0, (0.25, 0.05, -5e-4, 3e-4, 0.0)),
    "fisheye": (FISHEYE, 215.0, (0.03, -0.01, 0.002, -5e-4)),
}
CELLS = 4  # per pixel and axis, of the rendered light


def camera(lens: str) -> Camera:
    kind, f, numbers = LENSES[lens]
    matrix = np.array([[f, 0, 322.0], [0, f * 1.001, 236.0], [0, 0, 1]])
    return Camera("c", "s", SIZE, matrix, numbers, Pose.identity(), lens=kind)


def placed(board: Chessboard, near: Camera, turn: tuple[float, float, float], seen_px: float) -> Pose:
    """camera_from_board of a board turned about its middle, which would be `seen_px` wide if it were not turned."""
    R = rotations.exp(np.array(turn))
    z = near.matrix[0, 0] * max(board.size_m) / seen_px
    return Pose(R, np.array([0.1 * z, -0.08 * z, z]) - R @ board.middle)


def true_grid(board: Chessboard, near: Camera, at: Pose, across: float = 0.0, down: float = 0.0) -> Array:
    """Pixels (rows, columns, 2) of the points of the board, each moved by parts of a square."""
    moved = board.points + board.square_m * np.array([across, down, 0.0])
    return near.project(at.apply(moved)).reshape(board.rows, board.columns, 2)


def light_without_noise(board: Chessboard, near: Camera, at: Pose, sigma_px: float) -> Array:
    """Grey values (h, w): a pixel is the mean of CELLS^2 cells, a cell the share of the squares on which it lies.

    The plane of the board is that of rays through the corners of cells, so that this shares no code with
    `board_photo`, and is finer: corners are where the camera model has them to 1e-4 px RMS.
    """
    grid = true_grid(board, near, at)
    low, high = np.floor(grid.min(axis=(0, 1))) - 16, np.ceil(grid.max(axis=(0, 1))) + 17
    (left, top), (right, bottom) = np.maximum(low, 0).astype(int), np.minimum(high, SIZE).astype(int)
    out = np.full(SIZE[::-1], 120.0, dtype=np.float32)
    u, v = (np.arange(a * CELLS, b * CELLS + 1) / CELLS - 0.5 for a, b in ((left, right), (top, bottom)))
    rows = []
    for first in range(0, len(v) - 1, 40 * CELLS):  # rays of all cells at once are too many
        part = np.stack(np.meshgrid(u, v[first : first + 40 * CELLS + 1]), axis=-1)
        direction = near.rays(part)[1] @ at.rotation
        origin = -at.rotation.T @ at.translation
        xy = origin[:2] - origin[2] / direction[..., 2:] * direction[..., :2]
        wave = [_mean_of_wave(xy[..., k] / board.square_m) for k in (0, 1)]
        rows.append((wave[0] * wave[1]).astype(np.float32))
    cells = cv2.GaussianBlur(np.concatenate(rows), (0, 0), CELLS * sigma_px)
    mean = cells.reshape(bottom - top, CELLS, right - left, CELLS).mean(axis=(1, 3))
    out[top:bottom, left:right] += 85 * mean
    return out


def _mean_of_wave(x: Array) -> Array:
    """Mean of the square wave of period 2 in cells with corners x (h + 1, w + 1), along their longer extent."""
    a, b = (x[:-1] + x[1:]) / 2, (x[:, :-1] + x[:, 1:]) / 2
    across, down = np.diff(a, axis=1), np.diff(b, axis=0)
    longer = np.where(np.abs(across) > np.abs(down), across, down)
    middle = (a[:, :-1] + a[:, 1:]) / 2
    other = np.where(np.abs(across) > np.abs(down), down, across)
    nodes, weights = np.polynomial.legendre.leggauss(3)
    total = np.zeros(middle.shape)
    for node, weight in zip(nodes, weights, strict=True):
        half = (middle + node * other / 2) / 2
        ends = [half + side * longer / 4 for side in (-1, 1)]
        area = [1 - np.abs(2 * (end - np.floor(end)) - 1) for end in ends]
        total += weight / 2 * (area[1] - area[0]) / longer
    return total


@pytest.mark.parametrize("n", range(1, 12))
def test_each_point_of_a_polynomial_is_given_by_the_others(n):
    """Of a quadratic from four points on, of a cubic by the curves of third order from five on."""
    x = np.arange(n) - 0.3 * n
    weights = _weights_of_others(n)
    if n < 4:
        assert np.isnan(weights).all()
        return
    assert not np.diagonal(weights, axis1=1, axis2=2).any()
    np.testing.assert_allclose(weights @ (0.7 + x - 0.2 * x**2), np.tile(0.7 + x - 0.2 * x**2, (2, 1)), atol=1e-9)
    if n >= 5:
        np.testing.assert_allclose(weights[1] @ x**3, x**3, atol=1e-9)


@pytest.mark.parametrize(
    ("lens", "turn", "seen_px"),
    further_slow([
        ("pinhole", (0.5, 0.6, -0.4), 180.0), ("pincushion", (0.3, -0.4, 0.2), 300.0),
        ("fisheye", (0.5, 0.6, -0.4), 180.0), ("pinhole", (0.3, -0.4, 0.2), 300.0),
        ("barrel", (0.2, 0.5, 0.3), 330.0), ("fisheye", (0.2, 0.5, 0.3), 330.0),
    ], fast=3),
)  # fmt: skip
def test_corners_without_noise_are_where_the_board_is(lens, turn, seen_px):
    """Under any lens, with wide and narrow squares, whose edges cross aslant, and near a wide lens."""
    board = parse("chessboard:9x6:30mm")
    assert isinstance(board, Chessboard)
    near = camera(lens)
    at = placed(board, near, turn, seen_px)
    grid = true_grid(board, near, at)
    picture = light_without_noise(board, near, at, 0.7)  # not rounded to grey values, which no picture of a file is
    off = refined(picture, grid + 0.2).pixels - grid
    outward = grid - near.matrix[:2, 2]
    outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
    assert np.sqrt(np.mean(off**2)) < 0.0002 * px
    assert np.max(np.abs(off)) < 0.001 * px
    assert abs(np.mean(np.sum(off * outward, axis=-1))) < 0.0001 * px  # which lengthens the focal length


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("hidden", [0, 20])
def test_the_curvature_of_a_grid_is_that_of_the_projection(lens, hidden):
    """Along both lines of the board through each corner, 1/px; of lines that are straight it is zero."""
    board = parse("chessboard:9x6:30mm")
    assert isinstance(board, Chessboard)
    near = camera(lens)
    at = placed(board, near, (0.3, -0.4, 0.2), 300.0)
    known = np.ones((board.rows, board.columns), dtype=bool)
    known.flat[np.random.default_rng(1).choice(known.size, hidden, replace=False)] = False
    grid = np.where(known[..., None], true_grid(board, near, at), np.nan)
    shape = local_shape(grid, known, SIZE)[known]
    h = 0.05
    for k, (across, down) in enumerate(((h, 0.0), (0.0, h))):
        before, here, after = (true_grid(board, near, at, s * across, s * down)[known] for s in (-1, 0, 1))
        step = (after - before) / (2 * h)
        assert np.max(np.linalg.norm(shape[:, k] - step, axis=1)) < 0.5 * px  # of 30
        along = step / np.linalg.norm(step, axis=1, keepdims=True)
        normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
        x, y = along.T
        true = np.sum((before + after - 2 * here) / (2 * h**2 * np.sum(step**2, axis=1))[:, None] * normal, axis=1)
        found = np.einsum("nk,nkc,nc->n", np.stack([x * x, x * y, y * y], axis=1), shape[:, 2:], normal)
        assert np.max(np.abs(found - true)) < (2e-5 if hidden == 0 else 1e-4)  # of up to 1.5e-3


def test_a_few_corners_have_the_steps_of_all_and_are_straight():
    grid = np.full((6, 9, 2), np.nan)
    grid[2, 3:6] = [[100, 80], [120, 81], [140, 82]]
    shape = local_shape(grid, np.isfinite(grid[..., 0]), SIZE)
    np.testing.assert_allclose(shape[2, 3:6, 0], [[20, 1]] * 3, atol=1e-9)
    assert not shape[:, :, 2:].any()


@pytest.mark.parametrize("cosine", [-0.9, -0.5, 0.0, 0.3, 0.8])
def test_the_light_of_two_blurred_edges_is_that_of_the_bivariate_normal_distribution(cosine):
    """And its derivatives those of differences."""
    e = np.stack(np.meshgrid(np.linspace(-2.5, 2.5, 6), np.linspace(-2.5, 2.5, 6)), axis=0).reshape(1, 2, -1)
    mean, by = _crossing(e, np.array([cosine]))
    normal = multivariate_normal(cov=[[1, cosine], [cosine, 1]])
    once = normal.cdf(e[0].T), normal.cdf(-e[0].T)
    np.testing.assert_allclose(mean[0], 2 * (once[0] + once[1]) - 1, atol=3e-4)
    h = 1e-4
    for k in (0, 1):
        moved = np.zeros((1, 2, 1))
        moved[:, k] = h
        slope = [_crossing(e + s * moved, np.array([cosine]))[0] for s in (-1, 1)]
        np.testing.assert_allclose(by[0, k], (slope[1] - slope[0])[0] / (2 * h), atol=2e-3)


@pytest.mark.parametrize(("lens", "blur_px"), further_slow([("fisheye", 0.7), ("pinhole", 2.0)]))
def test_the_scatter_of_each_corner_is_its_stated_sigma(lens, blur_px):
    """Of wide and narrow squares, sharp and out of focus, and with five times the noise in half of the picture."""
    board = parse("chessboard:9x6:30mm")
    assert isinstance(board, Chessboard)
    near = camera(lens)
    at = placed(board, near, (0.5, 0.6, -0.4), 330.0)
    grid = true_grid(board, near, at)
    light = light_without_noise(board, near, at, blur_px)
    middle = round(float(np.median(grid[..., 0])))
    rng = np.random.default_rng(5)
    off, sigmas = [], []
    for _ in range(40):
        noise = rng.normal(0, 1, light.shape)
        noise[:, middle:] *= 5
        found = refined((light + noise).astype(np.float32), grid + 0.2)
        off.append(found.pixels - grid)
        sigmas.append(found.sigmas_px)
    z = np.array(off) / np.array(sigmas)[..., None]
    typical = np.median(sigmas, axis=0)
    assert typical.max() > 6 * typical.min()
    for half in (grid[..., 0] < middle - 12, grid[..., 0] > middle + 12):
        assert half.sum() > 15
        # 1200 numbers and more: their RMS is known to 2 %, and the sigmas of narrow squares to some percent
        assert np.sqrt(np.mean(z[:, half] ** 2)) == pytest.approx(1, abs=0.1)
    by_corner = np.sqrt(np.mean(z**2, axis=(0, 3)))  # each from 80 numbers, known to 8 %
    assert np.all((by_corner > 0.65) & (by_corner < 1.4))


def test_the_bend_of_lines_by_a_lens_has_the_derivatives_of_its_series():
    """On both sides of where a short series takes over."""
    z = np.array([-0.3, -0.02, -0.0099, -1e-3, 0.0, 1e-3, 0.0099, 0.02, 0.3])
    atan = np.polynomial.Polynomial((-1.0) ** np.arange(40) / (2 * np.arange(40) + 1))
    for order, values in enumerate(_ratio(z)):
        np.testing.assert_allclose(values, atan.deriv(order)(z), atol=1e-9)
