"""Boards: positions of their points, their texts, and the printed pattern."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.boards.board_drawing import draw, ink_at
from calibration.boards.board_types import DICTIONARIES, Charuco, Chessboard, CircleGrid, parse

mm = 1e-3
TEXTS = [
    "chessboard:9x6:25mm",
    "circles:10x10:12mm",
    "acircles:4x11:20mm",
    "acircles:4x11:20mm:16mm",
    "charuco:5x7:40mm:20mm:DICT_4X4_50",
    "charuco:5x8:40mm:20mm:DICT_4X4_50:inverted",
    "charuco:6x8:40.5mm:20mm:DICT_APRILTAG_36h11:legacy",
    "charuco:5x8:40mm:30mm:DICT_5X5_100:inverted:legacy",
]


@pytest.mark.parametrize("text", TEXTS)
def test_parsing_and_describing_are_inverse(text):
    board = parse(text)
    assert board.describe() == text
    assert parse(board.describe()) == board


lengths = st.floats(0.5, 500.0).map(lambda v: round(v, 3))


@given(st.integers(3, 50), st.integers(3, 50), lengths, st.booleans())
def test_every_board_is_restored_from_its_text(columns, rows, length_mm, asymmetric):
    for board in (
        Chessboard(columns, rows, length_mm / 1000),
        CircleGrid(columns, rows, length_mm / 1000, asymmetric),
        Charuco(columns % 20 + 3, rows % 20 + 3, length_mm / 1000, 0.6 * length_mm / 1000, "DICT_6X6_1000"),
    ):
        again = parse(board.describe())
        np.testing.assert_allclose(again.points, board.points, rtol=0, atol=1e-12)
        assert (again.columns, again.rows) == (board.columns, board.rows)


@pytest.mark.parametrize(("text", "length"), [("25mm", 0.025), ("2.5cm", 0.025), ("0.025m", 0.025), ("25 MM", 0.025)])
def test_lengths_may_have_any_metric_unit(text, length):
    assert parse(f"chessboard:9x6:{text}").square_m == pytest.approx(length, rel=1e-15)


def test_points_run_row_by_row_from_the_first_corner():
    board = parse("chessboard:4x3:10mm")
    np.testing.assert_allclose(board.points[:5] / mm, [[0, 0, 0], [10, 0, 0], [20, 0, 0], [30, 0, 0], [0, 10, 0]])
    np.testing.assert_allclose(board.middle / mm, [15, 10, 0])
    assert board.size_m == pytest.approx((50 * mm, 40 * mm))


@pytest.mark.parametrize(("columns", "rows"), [(5, 7), (5, 8), (6, 8), (8, 5), (4, 5)])
@pytest.mark.parametrize("legacy", [False, True])
def test_charuco_corners_and_markers_are_placed_as_in_opencv(columns, rows, legacy):
    board = Charuco(columns, rows, 0.04, 0.03, "DICT_4X4_250", legacy=legacy)
    theirs = cv2.aruco.CharucoBoard(
        (columns, rows), 0.04, 0.03, cv2.aruco.getPredefinedDictionary(DICTIONARIES["DICT_4X4_250"])
    )
    theirs.setLegacyPattern(legacy)
    corners = np.array(theirs.getChessboardCorners()).reshape(-1, 3)
    first = np.array([0.04, 0.04, 0])  # OpenCV's frame starts at the outer corner
    np.testing.assert_allclose(board.points + first, corners, atol=1e-8)
    assert board.markers == len(theirs.getIds())
    # The picture that OpenCV prints, 40 px a square, against `ink_at` at the centres of the pixels.
    picture = theirs.generateImage((40 * columns, 40 * rows), marginSize=0) < 128
    v, u = np.indices(picture.shape)
    ours = ink_at(board, np.stack([u + 0.5, v + 0.5], axis=-1) / 1000 - 0.04) > 0.5
    assert np.mean(ours == picture) > 0.985  # OpenCV rounds a marker's cells of 30 / 6 px to whole pixels


@pytest.mark.parametrize("text", TEXTS)
def test_printed_shapes_and_ink_density_agree(text):
    board = parse(text)
    drawing = draw(board)
    rng = np.random.default_rng(0)
    at = rng.uniform(-0.05, 1.05, (4000, 2)) * np.array(drawing.size_m)
    ink = np.zeros(len(at))
    for layer in drawing.layers:
        for left, top, width, height in layer.rectangles:
            inside = np.all((at >= [left, top]) & (at < [left + width, top + height]), axis=1)
            ink[inside] = layer.is_black
        for x, y, r in layer.circles:
            ink[np.hypot(at[:, 0] - x, at[:, 1] - y) < r] = layer.is_black
    np.testing.assert_array_equal(ink_at(board, at - drawing.first_point), ink)
    assert 0.05 < ink.mean() < 0.95


@pytest.mark.parametrize(
    ("text", "symmetry"),
    [
        ("chessboard:9x6:25mm", 1),
        ("chessboard:9x7:25mm", 2),
        ("chessboard:7x7:25mm", 2),
        ("chessboard:6x6:25mm", 4),
        ("circles:9x7:25mm", 2),
        ("circles:7x7:25mm", 4),
        ("acircles:4x11:20mm", 1),
        ("acircles:4x10:20mm", 2),
        ("charuco:5x7:40mm:20mm:DICT_4X4_50", 1),
    ],
)
def test_the_printed_pattern_looks_the_same_after_as_many_rotations_as_its_kind_and_size_say(text, symmetry):
    board = parse(text)
    at = np.random.default_rng(1).uniform(-0.6, 0.6, (5000, 2)) * max(board.size_m)
    middle, ink = board.middle[:2], ink_at(board, at + board.middle[:2])
    turns = ([[1, 0], [0, 1]], [[0, -1], [1, 0]], [[-1, 0], [0, -1]], [[0, 1], [-1, 0]])
    same = sum(np.mean(ink_at(board, at @ np.array(turn).T + middle) == ink) > 0.999 for turn in turns)
    assert same == symmetry


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("chesboard:9x6:25mm", "did you mean 'chessboard'.*example: chessboard:9x6:25mm"),
        ("", "expected one of chessboard, circles, acircles, charuco"),
        ("chessboard:9x6", "expected 2 parts after 'chessboard', got 1; example"),
        ("chessboard:9x6:25mm:2", "expected 2 parts after 'chessboard', got 3"),
        ("circles:9x7:25mm:12mm:2", "expected 2 or 3 parts after 'circles', got 4"),
        ("circles:9x7:25mm:26mm", "expected circles smaller than the 25 mm between neighbours, got a diameter of 26mm"),
        ("acircles:4x11:20mm:30mm", "smaller than the 28.28 mm between neighbours"),
        ("chessboard:9by6:25mm", "expected columns x rows such as 9x6, got '9by6'"),
        ("chessboard:9x6:25", "expected a length with its unit such as 25mm, got '25'"),
        ("chessboard:2x6:25mm", "expected 3 to 200 inner corners along each side, got 2x6"),
        ("chessboard:9x6:25m", "expected a square of 0.1 mm to 10 m, got 25 m"),
        ("charuco:5x7:20mm:40mm:DICT_4X4_50", "expected markers smaller than the squares, got 40mm in 20mm"),
        ("charuco:5x7:40mm:20mm:DICT_4X5_50", "got 'DICT_4X5_50'; did you mean .*DICT_4X4_50"),
        ("charuco:5x7:40mm:20mm:FOO", "^.{1,220}$"),
        ("charuco:5x7:40mm:20mm:DICT_FOO", "there are DICT_4X4_50 .*DICT_7X7_, and DICT_APRILTAG_36h11$"),
        ("charuco:20x20:40mm:20mm:DICT_4X4_50", "need 200 markers, DICT_4X4_50 has 50; take a larger dictionary"),
        ("charuco:5x7:40mm:20mm:DICT_4X4_50:invert", "expected 'inverted' or 'legacy' at the end, got 'invert'"),
    ],
)
def test_an_invalid_text_gives_a_one_line_message_with_an_example(text, complaint):
    with pytest.raises(ValueError, match=complaint) as caught:
        parse(text)
    assert "\n" not in str(caught.value)
    assert ("example" in str(caught.value)) or (":9x6:" in str(caught.value)) or ("charuco:5x7" in str(caught.value))


def test_a_dictionary_name_may_be_in_any_case_and_without_its_prefix():
    assert parse("charuco:5x7:40mm:20mm:apriltag_36H11").dictionary == "DICT_APRILTAG_36h11"
