"""Detection of boards in rendered pictures with known truth and in real ones with known counts or reasons."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from bench.lenses import rendered
from bench.lenses.rendered import BOARDS
from calibration.boards import charuco_detection, chessboard_detection, circle_detection, corner_refinement
from calibration.boards.board_detection import find_board
from calibration.boards.board_types import Board, Chessboard, CircleGrid, parse
from calibration.boards.board_view import QUICK_SEARCH_FAILED, BoardView, NotFound
from calibration.least_squares.adjustment import Poses, Vectors
from calibration.terms.corners import single_camera
from geometry import rotations
from geometry.camera import FISHEYE, PERSPECTIVE, Camera, pinhole_numbers
from geometry.lens import padded
from geometry.pose import Pose
from lab.simulate.board_photo import BoardPhoto, PhotoSettings, photograph
from tests.marks import further_slow
from tests.paths import DATA

px = 1.0
CHESS, CHARUCO = "chessboard:9x6:25mm", "charuco:7x5:35mm:24mm:DICT_5X5_100"
CLEAN = PhotoSettings(blur_px=0.7, samples=16)


def camera(lens: str = PERSPECTIVE) -> Camera:
    f = 560.0 if lens == PERSPECTIVE else 420.0
    numbers = (-0.25, 0.08, 5e-4, -3e-4, 0.02) if lens == PERSPECTIVE else (0.03, -0.01, 0.002, -5e-4)
    matrix = np.array([[f, 0, 239.5], [0, f, 179.5], [0, 0, 1]])
    return Camera("c", "s", (480, 360), matrix, numbers, Pose.identity(), lens=lens)


def board_pose(board: Board, turn: tuple[float, float, float], distance: float = 1.9) -> Pose:
    """camera_from_board of a board turned about its middle, at a distance in multiples of its size."""
    R = rotations.exp(np.array(turn))
    return Pose(R, np.array([0, 0, distance * max(board.size_m)]) - R @ board.middle)


@cache
def shot(text: str, turn=(0.4, -0.3, 0.15), look: PhotoSettings = CLEAN, **more) -> tuple[Board, BoardPhoto]:
    board = parse(text)
    return board, photograph(board, camera(), board_pose(board, turn), look=look, **more)


def view_of(image, board: Board) -> BoardView:
    found = find_board(image, board)
    assert isinstance(found, BoardView), found
    return found


def reason_of(image, board: Board) -> str:
    found = find_board(image, board)
    assert isinstance(found, NotFound), "found"
    return found.reason


def rms(view: BoardView, photo: BoardPhoto) -> float:
    return float(np.sqrt(np.mean((view.pixels - photo.pixels[view.ids]) ** 2)))


def centroids(board: Board, turn: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """True centroids (n, 2), px, and areas of a board's circles in the picture, from finely sampled outlines."""
    assert isinstance(board, CircleGrid)
    angle = np.linspace(0, 2 * np.pi, 300, endpoint=False)
    ring = board.diameter_m / 2 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    out = camera().project(board_pose(board, turn).apply(board.points[:, None] + ring))
    before = np.roll(out, 1, axis=1)
    twice = before[..., 0] * out[..., 1] - out[..., 0] * before[..., 1]
    area = twice.sum(axis=1)
    return np.sum((before + out) * twice[..., None], axis=1) / (3 * area[:, None]), np.abs(area) / 2


# Accuracy ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "within"),
    [
        (CHESS, 0.012),
        (CHARUCO, 0.015),
        ("charuco:5x8:40mm:20mm:DICT_4X4_50:inverted:legacy", 0.012),
    ],
)
def test_points_are_detected_at_their_true_positions(text, within):
    board, photo = shot(text)
    view = view_of(photo.image, board)
    assert len(view) == len(board.ids)
    assert rms(view, photo) < within * px
    assert np.abs(np.mean(view.pixels - photo.pixels, axis=0)).max() < 0.015 * px  # no common shift
    assert view.notes == ()


@pytest.mark.parametrize("text", [CHESS, "circles:9x7:25mm", CHARUCO])
def test_errors_from_noise_and_blur_are_below_a_tenth_of_a_pixel(text):
    board, photo = shot(text, look=PhotoSettings(blur_px=1.2, noise_dn=4, gradient=0.4, samples=9), seed=3)
    view = view_of(photo.image, board)
    assert len(view) >= 0.9 * len(board.ids)
    assert rms(view, photo) < 0.1 * px


def test_a_bent_board_in_a_fisheye_picture_is_detected():
    board = parse(CHESS)
    lens = camera(FISHEYE)
    photo = photograph(board, lens, board_pose(board, (0.2, 0.3, 0.1), 1.0), np.array([0.3, -0.1, 0.2]), CLEAN)
    assert rms(view_of(photo.image, board), photo) < 0.04 * px


@pytest.mark.parametrize(
    ("text", "turn"),
    [
        ("circles:9x7:25mm", (0.4, -0.3, 0.15)),
        (
            "circles:7x5:30mm:18mm",
            (0.0, 0.95, 0.0),
        ),  # steep: the images of the centres are .1 px and more from the centroids
        ("acircles:4x11:20mm", (0.4, -0.3, 0.15)),
        ("acircles:5x8:25mm", (0.4, -0.3, 0.15)),
    ],
)
def test_centroids_and_areas_of_circles_are_correct(text, turn):
    board, photo = shot(text, turn=turn)
    view = view_of(photo.image, board)
    places, areas = centroids(board, turn)
    assert np.sqrt(np.mean((view.pixels - places) ** 2)) < 0.02 * px
    assert np.abs(np.mean(view.pixels - places, axis=0)).max() < 0.008 * px
    assert view.areas_px2 is not None
    np.testing.assert_allclose(np.sqrt(view.areas_px2 / areas), 1, atol=0.02)
    one = np.zeros(len(view), dtype=int)
    term = single_camera(view.pixels, board.points, board.middle, one, 1.0, False, areas_px2=view.areas_px2)
    values = {
        "intrinsics": Vectors(np.concatenate([pinhole_numbers(camera()), padded(camera().distortion)])[None]),
        "cameras": Poses.of([Pose.identity()]),
        "boards": Poses.of([board_pose(board, turn)]),
        "warp": Vectors(np.zeros((1, 3))),
    }
    assert 2 * term.radii_by_areas(values) == pytest.approx([board.diameter_m], rel=0.01)


@pytest.mark.parametrize("text", ["circles:9x7:30mm", "acircles:4x11:24mm"])
@pytest.mark.parametrize("at", [(0.0, 0.0), (-0.6, 0.3)])
@pytest.mark.parametrize("turn", [(0.1, 0.2, 0.3), (-0.2, 0.3, 2.0)])
def test_circles_of_a_board_close_to_a_wide_lens_are_found(text, at, turn):
    """Their rows are curved by more than the distance of neighbours: OpenCV's search for a grid needs straight ones."""
    board, R = parse(text), rotations.exp(np.array(turn))
    wide = replace(camera(FISHEYE), matrix=np.array([[165.0, 0, 239.5], [0, 165, 179.5], [0, 0, 1]]))
    middle = np.array([*at, 1.0]) * 0.75 * max(board.size_m)
    picture = photograph(board, wide, Pose(R, middle - R @ board.middle), look=CLEAN)
    view = view_of(picture.image, board)
    away = np.linalg.norm(picture.pixels - view.pixels[:, None], axis=2).min(axis=1)
    assert len(view.pixels) == len(board.points)
    assert np.max(away) < 1.5 * px  # of centroids from the pictures of centres


@pytest.mark.parametrize("blur", [0.6, 1.0, 1.8])
def test_blur_is_measured(blur):
    board, photo = shot(CHESS, look=PhotoSettings(blur_px=blur, noise_dn=2, samples=9))
    assert view_of(photo.image, board).blur_px == pytest.approx(np.hypot(blur, 12**-0.5), abs=0.1)


# The order of the points ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", [CHESS, "chessboard:5x5:30mm", "acircles:4x11:20mm", CHARUCO])
@pytest.mark.parametrize("roll", [0.0, -1.7, 3.0])
def test_the_first_point_is_the_same_for_every_roll_of_the_camera(text, roll):
    """5x5 corners look the same after half a turn; their rows point to the right."""
    board, photo = shot(text, turn=(0.25, 0.2, roll), look=PhotoSettings(samples=9))
    view = view_of(photo.image, board)
    miss = np.linalg.norm(view.pixels - photo.pixels[view.ids], axis=1).max()
    if text != "chessboard:5x5:30mm" or abs(roll) < 1.5:
        assert miss < 0.3 * px
    else:
        np.testing.assert_allclose(view.pixels, photo.pixels[::-1], atol=0.3 * px)


def test_corners_in_any_order_are_renumbered_correctly():
    """Releases of OpenCV differ in the order of the corners."""
    _, photo = shot(CHESS)
    true = photo.pixels.reshape(6, 9, 2)
    for given in (true, true[::-1], true[:, ::-1], true[::-1, ::-1]):
        np.testing.assert_array_equal(chessboard_detection.oriented(photo.image, given), true)


@pytest.mark.slow
def test_no_corner_that_is_fitted_beside_its_place_is_taken_for_measured():
    found = rendered.rendered_set("fisheye", BOARDS["chess"], 74001, 1)
    assert len(found.table) == 54
    # Three were 8 to 28 px off, with sigmas of 7 to 18 px.
    assert np.max(np.abs(found.table.pixels - found.truth)) < 0.05 * px


def test_a_charuco_board_near_a_wide_lens_is_found():
    """Its markers were not arranged as on the board for a pinhole, whose picture of a plane keeps lines straight."""
    numbers, matrix = (0.02, -0.004, 0.001, 0.0), np.array([[190.0, 0, 400], [0, 190, 300], [0, 0, 1]])
    wide = Camera("c", "s", (800, 600), matrix, numbers, Pose.identity(), lens=FISHEYE)
    board = parse("charuco:9x7:30mm:22mm:DICT_4X4_50")
    photo = photograph(board, wide, board_pose(board, (0.3, -0.2, 0.1), 0.3), look=CLEAN)
    view = view_of(photo.image, board)
    off = np.linalg.norm(view.pixels - photo.pixels[np.searchsorted(photo.ids, view.ids)], axis=1)
    assert len(view) > 40
    assert np.median(off) < 0.03 * px


@pytest.mark.parametrize(("across_px", "seed"), further_slow([(8, 3), (5, 1), (12, 0)]))
def test_a_blob_between_circles_is_not_taken_for_one_of_them(across_px, seed):
    """At a high threshold several small circles are one blob, whose middle was taken for that of a circle."""
    matrix = np.array([[950.0, 0, 640], [0, 950, 480], [0, 0, 1]])
    seen = Camera("c", "s", (1280, 960), matrix, (-0.2, 0.05, 0, 0, 0), Pose.identity())
    rng, board = np.random.default_rng(seed), parse("circles:9x7:30mm")
    R = rotations.exp(rng.uniform(-0.4, 0.4, 3))
    at = np.append(rng.uniform(-0.2, 0.2, 2), 1) * 950 * board.diameter_m / across_px
    look = PhotoSettings(blur_px=0.7, noise_dn=2.0, samples=36)
    photo = photograph(board, seen, Pose(R, at - R @ board.middle), look=look, seed=seed)
    off = np.min(np.linalg.norm(view_of(photo.image, board).pixels[:, None] - photo.pixels, axis=2), axis=1)
    assert off.max() < 0.2 * px


@pytest.mark.parametrize(("lens", "around"), further_slow([(PERSPECTIVE, 2.356), (PERSPECTIVE, 0.0), (FISHEYE, 1.571)]))
def test_oblique_circles_are_not_confused_with_their_neighbours(lens, around):
    """Which are nearer along the short axis than a circle's long one reaches: outlines were off by up to 2.7 px."""
    seen, board = replace(camera(lens), image_size_px=(1280, 960)), parse("acircles:4x11:24mm")
    seen.matrix[:2, 2] += 400, 300
    R = rotations.exp(np.deg2rad(66) * np.array([np.cos(around), np.sin(around), 0]))
    pose = Pose(R, np.array([0, 0, 0.25]) - R @ board.middle)
    photo = photograph(board, seen, pose, look=PhotoSettings(blur_px=0.7, noise_dn=2.0, samples=36), seed=1)
    points, step_m = pose.apply(board.points), 1e-6
    by_board = np.stack([seen.project(points + step_m * R[:, k]) - photo.pixels for k in (0, 1)], axis=-1) / step_m
    shapes = by_board * board.diameter_m / 2
    large = np.linalg.svd(shapes, compute_uv=False)[:, 1] > 3 * px
    off = shapes @ np.random.default_rng(1).uniform(-0.2, 0.2, (len(points), 2, 1))
    found = circle_detection.fit_ellipses(photo.image, (photo.pixels + off[..., 0])[large], shapes[large])
    share = found.areas / (np.pi * np.abs(np.linalg.det(shapes[large])))
    assert large.sum() > 15
    assert np.all(np.abs(share / np.median(share) - 1) < 0.05)


@pytest.mark.filterwarnings("error")
def test_circles_beside_one_without_an_ellipse_have_their_areas_without_a_warning():
    shapes = np.stack([4 * np.eye(2), np.full((2, 2), np.nan)])
    areas = circle_detection.Ellipses(np.zeros((2, 2)), shapes, np.ones(2), np.ones(2)).areas
    assert areas[0] == pytest.approx(4 * np.pi)
    assert np.isnan(areas[1])


def test_a_larger_circle_in_a_corner_becomes_the_first_point():
    board, photo = shot("circles:6x6:30mm", turn=(0.2, 0.2, 0.1))
    for corner in (0, 5, 30, 35):
        image = photo.image.copy()
        u, v = np.round(photo.pixels[corner]).astype(int)
        cv2.circle(image, (int(u), int(v)), 19, 35, -1, cv2.LINE_AA)
        assert np.linalg.norm(view_of(image, board).pixels[0] - [u, v]) < 1.5 * px


# Reasons for a failure ------------------------------------------------------------------------------------------


def test_an_empty_wall_and_an_unlit_picture_give_a_reason():
    wall = np.random.default_rng(0).integers(60, 190, (180, 240)).astype(np.uint8)
    assert "no chessboard found" in reason_of(wall, parse(CHESS))
    assert "no marker of DICT_5X5_100 found" in reason_of(wall, parse(CHARUCO))
    assert "circles" in reason_of(wall, parse("circles:9x7:25mm"))
    for text in (CHESS, CHARUCO, "circles:9x7:25mm"):
        assert "hardly any contrast" in reason_of(np.full((180, 240), 7, dtype=np.uint8), parse(text))


def test_the_reason_gives_the_actual_size_of_a_chessboard():
    board, photo = shot(CHESS)
    assert "9x6" in reason_of(photo.image, parse("chessboard:7x7:25mm"))
    assert reason_of(photo.image, parse("chessboard:8x6:25mm")).startswith(
        ("the chessboard continues", "a chessboard of 9x6 inner corners, not 8x6")
    )
    assert "only 9x6 of the 11x6" in reason_of(photo.image, parse("chessboard:11x6:25mm"))
    assert len(view_of(photo.image, parse("chessboard:6x9:25mm"))) == len(board.ids)  # the same board, held upright


@pytest.mark.filterwarnings("error")
def test_corners_without_any_contrast_give_no_warning():
    grid = np.stack(np.meshgrid(np.arange(8.0), np.arange(5.0)), axis=-1) * 20 + 60
    assert chessboard_detection._goes_on(np.full((300, 400), 255, np.uint8), grid) == []


def test_the_reason_gives_the_actual_size_or_kind_of_a_grid():
    _, photo = shot("circles:9x7:25mm")
    assert "9x7 circles, not 10x8" in reason_of(photo.image, parse("circles:10x8:25mm"))
    assert "continues" in reason_of(photo.image, parse("circles:8x7:25mm"))
    _, photo = shot("acircles:4x11:20mm")
    assert "write acircles instead of circles" in reason_of(photo.image, parse("circles:4x11:20mm"))


def test_the_reason_gives_the_difference_from_a_similar_charuco_board():
    _, photo = shot(CHARUCO)
    assert "fit 7x5 squares; exchange the two" in reason_of(photo.image, parse("charuco:5x7:35mm:24mm:DICT_5X5_100"))
    assert "of DICT_5X5_50 with numbers up to 16; check the dictionary" in reason_of(
        photo.image[180:], parse("charuco:7x5:35mm:24mm:DICT_6X6_250")
    )
    assert "not arranged as on this board; check the number of columns and rows" in reason_of(
        photo.image, parse("charuco:8x6:35mm:24mm:DICT_5X5_100")
    )


def test_an_inverted_or_legacy_charuco_board_is_detected_with_a_note():
    _, photo = shot("charuco:6x8:30mm:20mm:DICT_4X4_50:inverted:legacy")
    view = view_of(photo.image, parse("charuco:6x8:30mm:20mm:DICT_4X4_50"))
    assert rms(view, photo) < 0.05 * px
    assert len(view) == 35
    assert view.notes == (
        "the board is inverted (white markers)",
        "the board has OpenCV's older pattern (legacy)",
    )


def test_markers_of_another_size_than_stated_are_measured():
    _, photo = shot("charuco:7x5:35mm:24mm:DICT_5X5_100")
    (note,) = view_of(photo.image, parse("charuco:7x5:35mm:17mm:DICT_5X5_100")).notes
    assert note.startswith("markers measure 0.6")
    assert note.endswith("of a square, according to the text 0.49")


@pytest.mark.parametrize("thorough", [True, False])
@pytest.mark.parametrize("stated", [CHARUCO, CHARUCO + ":inverted"])
def test_two_charuco_boards_of_the_same_kind_in_one_picture_are_named(stated, thorough):
    _, photo = shot(CHARUCO)
    found = find_board(np.hstack([photo.image, photo.image]), parse(stated), thorough)
    assert isinstance(found, NotFound)
    assert "two boards of this kind are in the picture; cover one" in found.reason
    most_of_one = np.hstack([photo.image, photo.image[:, :190]])
    assert isinstance(find_board(most_of_one, parse(stated), thorough), BoardView)


@pytest.mark.parametrize("text", [CHARUCO, CHARUCO + ":inverted"])
def test_a_mirrored_picture_of_a_charuco_board_is_rejected(text):
    board, photo = shot(text)
    view_of(photo.image, board)
    assert "mirror" in reason_of(np.ascontiguousarray(photo.image[:, ::-1]), board)


def test_a_mirrored_board_of_4x4_bits_is_rejected_although_some_markers_resemble_others():
    board = parse("charuco:11x9:36mm:27mm:DICT_4X4_100")
    matrix = np.diag([5 / 3, 5 / 3, 1]) @ camera().matrix
    larger = replace(camera(), image_size_px=(800, 600), matrix=matrix, distortion=())
    photo = photograph(
        board, larger, board_pose(board, (0.2, 0.1, 0.1), 1.6), look=PhotoSettings(blur_px=0.7, samples=4)
    )
    mirrored = np.ascontiguousarray(photo.image[:, ::-1])
    assert len(charuco_detection.find_markers(mirrored, board.dictionary, board.markers).ids) >= 2
    assert "mirror" in reason_of(mirrored, board)


@pytest.mark.parametrize("text", [CHESS, "circles:9x7:25mm", CHARUCO])
def test_a_quick_search_finds_a_board_and_gives_no_reason(text):
    board, photo = shot(text)
    view = find_board(photo.image, board, thorough=False)
    assert isinstance(view, BoardView)
    assert rms(view, photo) < 0.04 * px
    wall = np.random.default_rng(0).integers(60, 190, (180, 240)).astype(np.uint8)
    assert find_board(wall, board, thorough=False) is QUICK_SEARCH_FAILED


def test_corners_of_a_mirrored_chessboard_are_not_in_mirrored_order():
    board, photo = shot(CHESS)
    grid = view_of(np.ascontiguousarray(photo.image[:, ::-1]), board).pixels.reshape(6, 9, 2)
    right, down = grid[0, 1] - grid[0, 0], grid[1, 0] - grid[0, 0]
    assert right[0] * down[1] - right[1] * down[0] > 0


def test_a_picture_out_of_focus_is_rejected_as_blurred():
    board, photo = shot(CHESS)
    blurred = cv2.GaussianBlur(photo.image, (0, 0), 9)
    assert "too blurred" in reason_of(blurred, board)
    board, photo = shot(CHARUCO)
    assert "blurred" in reason_of(cv2.GaussianBlur(photo.image, (0, 0), 5), board)


def test_a_part_of_a_chessboard_is_rejected_and_a_part_of_a_charuco_board_accepted():
    board, photo = shot(CHESS)
    image = photo.image.copy()
    image[:, : int(photo.pixels[2, 0])] = 110
    assert "only" in reason_of(image, board)
    board, photo = shot(CHARUCO)
    image = photo.image.copy()
    image[:, : int(photo.pixels[2, 0])] = 110
    view = view_of(image, board)
    assert 6 <= len(view) < len(board.ids)
    assert rms(view, photo) < 0.05 * px


def test_the_rest_of_a_board_is_found_from_a_part_with_wrong_corners_in_its_outer_line():
    """As OpenCV finds them at the rim of wide lenses."""
    board = parse(CHESS)
    photo = photograph(board, camera(FISHEYE), board_pose(board, (0.2, 0.8, 0.1), 1.1), look=CLEAN)
    true = photo.pixels.reshape(6, 9, 2)
    part = true[:5, 2:].copy()
    part[4, :3] += 0.6 * (part[3, 1:4] - part[4, :3])
    (whole,) = chessboard_detection._grown(photo.image, part, 6, 9)
    np.testing.assert_allclose(whole.pixels, true, atol=0.1)


def test_a_corner_that_starts_at_another_corner_is_measured_where_it_is():
    photo = shot("chessboard:9x6:30mm")[1]
    true = photo.pixels.reshape(6, 9, 2)
    start = true.copy()
    start[2, 0] = true[3, 1]
    np.testing.assert_allclose(corner_refinement.refined(photo.image, start).pixels, true, atol=0.05)


@pytest.mark.parametrize("text", [CHESS, CHARUCO, "circles:9x7:30mm"])
@pytest.mark.parametrize("roll", [0.15, np.pi + 0.15])
def test_each_point_has_the_noise_of_its_place_in_the_picture(text, roll):
    """Also where the board is upside down, so that its points are counted in another order than they were found."""
    board, photo = shot(text, turn=(0.4, -0.3, roll))
    noise = np.random.default_rng(3).normal(0, 0.5, photo.image.shape)
    noise[:, 240:] *= 8
    view = view_of(np.clip(np.round(photo.image + noise), 0, 255).astype(np.uint8), board)
    assert view.sigmas_px is not None
    quiet, noisy = view.pixels[:, 0] < 225, view.pixels[:, 0] > 255
    assert quiet.sum() > 5
    assert noisy.sum() > 5
    assert np.median(view.sigmas_px[noisy]) > 4 * np.median(view.sigmas_px[quiet])


def test_corners_found_in_another_order_keep_their_noise():
    board, photo = shot(CHESS)
    assert isinstance(board, Chessboard)
    image = np.clip(photo.image + np.random.default_rng(3).normal(0, 3, photo.image.shape), 0, 255).astype(np.uint8)
    true = photo.pixels.reshape(board.rows, board.columns, 2)
    views = [chessboard_detection._measured(image, grid, board) for grid in (true, true[::-1, ::-1])]
    assert all(isinstance(view, BoardView) for view in views)
    np.testing.assert_allclose(views[1].pixels, views[0].pixels, atol=0.01)
    np.testing.assert_allclose(views[1].sigmas_px, views[0].sigmas_px, rtol=0.01)


def test_a_picture_of_another_type_raises():
    with pytest.raises(ValueError, match="expected a grey picture"):
        find_board(np.zeros((100, 100, 3), dtype=np.uint8), parse(CHESS))


def test_edge_distance_is_that_of_the_nearest_parallel_edge():
    grid = np.stack(np.meshgrid(np.arange(4) * 30.0, np.arange(3) * 12.0), axis=-1)
    np.testing.assert_allclose(corner_refinement.edge_distance(grid, np.ones((3, 4), dtype=bool)), 12.0)


# Real pictures --------------------------------------------------------------------------------------------------


def counts(pattern: str, text: str) -> Counter[str]:
    """Number of real pictures per result."""
    files = sorted(DATA.glob(pattern))
    if not files:
        pytest.skip(f"the real pictures are not available: {pattern.split('/')[0]} is missing")
    out: Counter[str] = Counter()
    for path in files:
        found = find_board(np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), dtype=np.uint8), parse(text))
        out["found" if isinstance(found, BoardView) else found.reason] += 1
    return out


@pytest.mark.parametrize(
    ("pattern", "text", "found", "all_"),
    further_slow([
        ("chessboard_stereo_opencv/*.jpg", CHESS, 14, 14),
        ("charuco_aruco_stills/ch*.jpg", "charuco:5x7:40mm:20mm:DICT_6X6_250", 2, 2),
        ("chessboard_webcam_c920/*.jpg", "chessboard:9x7:24.4mm", 7, 7),
        ("chessboard_lowquality_400x300/*.png", CHESS, 13, 13),
        ("chessboard_portrait_cams/*/*.jpg", "chessboard:4x7:60mm", 13, 14),  # in one the board is seen edge-on
    ], fast=2),
)  # fmt: skip
def test_real_boards_are_found(pattern, text, found, all_):
    results = counts(pattern, text)
    assert (results["found"], sum(results.values())) == (found, all_)
    assert all(reason == "found" or reason.startswith("no chessboard found") for reason in results)


@pytest.mark.parametrize(
    ("pattern", "text", "words"),
    further_slow([  # synthetic pictures have the further reasons as well
        ("charuco_aruco_stills/chor*.jpg", "charuco:7x5:40mm:20mm:DICT_6X6_250", "they fit 5x7 squares"),
        ("charuco_aruco_stills/gb*.jpg", "chessboard:4x6:40mm", "no chessboard found"),
        ("circlegrid_robot_wrist/images/[02].png", "circles:9x10:20mm", "the grid continues to the right"),
        ("chessboard_stereo_opencv/left*.jpg", "chessboard:8x6:25mm", "the chessboard continues"),
        ("chessboard_webcam_c920/*4.jpg", "chessboard:9x6:25mm", "9x7 inner corners, not 9x6|beyond 9x6 inner"),
        ("charuco_aruco_stills/chor*.jpg", "charuco:5x7:40mm:20mm:DICT_5X5_100", "of DICT_6X6_50 with numbers up to"),
        ("charuco_aruco_stills/single*.jpg", "charuco:5x7:40mm:20mm:DICT_6X6_250", "another board"),
    ], fast=3),
)  # fmt: skip
def test_real_pictures_are_rejected_with_the_right_reason(pattern, text, words):
    results = counts(pattern, text)
    assert all(re.search(words, reason) for reason in results), results


def test_the_large_circle_of_the_robots_target_is_first_in_all_its_pictures():
    board = parse("circles:10x10:20mm")
    files = sorted((DATA / "circlegrid_robot_wrist" / "images").glob("*.png"))
    if not files:
        pytest.skip("the real pictures are not available: circlegrid_robot_wrist is missing")
    assert len(files) == 6
    for path in files:
        image = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
        view = view_of(image, board)
        (u, v), reach = np.round(view.pixels[0]).astype(int), int(0.4 * view.spacing_px)
        other = np.round(view.pixels[99]).astype(int)
        black_share = [
            np.mean(image[max(y - reach, 0) : y + reach, max(x - reach, 0) : x + reach] < 90)
            for x, y in ((u, v), other)
        ]
        assert black_share[0] > 1.8 * black_share[1]


def test_a_corner_of_a_board_close_to_a_fisheye_lens_is_not_moved_to_where_a_quadratic_has_it():
    """Squares of 22 to 170 px: the outermost corner is .34 squares from the quadratic of its row and of its column."""
    board = parse("chessboard:9x6:30mm")
    matrix = np.array([[315, 0, 479.5], [0, 315, 359.5], [0, 0, 1.0]])
    near = Camera("c", "s", (960, 720), matrix, (0.02, 0.0, 0.0, 0.0), Pose.identity(), lens=FISHEYE)
    R = rotations.exp(np.array([0.12, 0.33, -0.12]))
    at = Pose(R, np.array([-0.039, 0.021, 0.076]) - R @ board.middle)
    photo = photograph(board, near, at, look=PhotoSettings(samples=4))
    grid = photo.pixels.reshape(board.rows, board.columns, 2)
    found = corner_refinement.refined(photo.image, grid + 0.3).pixels
    assert np.max(np.linalg.norm(found - grid, axis=-1)) < 0.5  # 35 px if it is moved; its edges are strongly curved


@pytest.mark.slow
def test_the_slow_search_of_a_whole_picture_is_left_out_where_a_copy_shows_the_board(monkeypatch):
    """The classical detector finds nothing of this board of a fisheye lens: 1.4 s in 1280x960, .06 s in half of it."""
    photos: list[np.ndarray] = []
    board = parse(BOARDS["chess"])
    with monkeypatch.context() as rendering:
        rendering.setattr(rendered, "find_board", lambda photo, _: photos.append(photo) or find_board(photo, board))
        rendered.rendered_set("fisheye", BOARDS["chess"], 2709, views=1)
    searched: list[int] = []
    classic = cv2.findChessboardCorners
    monkeypatch.setattr(
        cv2, "findChessboardCorners", lambda p, *a, **k: searched.append(p.shape[1]) or classic(p, *a, **k)
    )
    assert isinstance(find_board(photos[0], board), BoardView)
    assert searched == [640]
