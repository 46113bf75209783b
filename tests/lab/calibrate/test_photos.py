"""Photographs of a board: the files that are read, and the reasons why pictures are refused."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration.boards.board_detection import NotFound, find_board
from calibration.boards.board_types import parse
from calibration.boards.board_view import QUICK_SEARCH_FAILED
from geometry.camera import Camera
from geometry.pose import Pose
from lab.calibrate.camera import photos as photos_module
from lab.calibrate.camera.photos import PhotoSet, as_8_bit, find_in_photos, load_photos, origins_of
from lab.errors import InputError
from lab.pictures import source
from lab.simulate.board_photo import PhotoSettings, photograph
from tests.marks import further_slow

BOARD = parse("chessboard:9x6:25mm")


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    camera = Camera("c", "s", (400, 300), np.array([[500.0, 0, 200], [0, 500, 150], [0, 0, 1]]), (), Pose.identity())
    at = Pose(np.eye(3), np.array([0, 0, 0.5]) - BOARD.middle)
    return photograph(BOARD, camera, at, look=PhotoSettings(samples=16)).image


def moved(picture: np.ndarray, k: int) -> np.ndarray:
    """Another photograph: the board is elsewhere in the picture."""
    return np.roll(picture, 2 * k, axis=1)


def test_pictures_of_every_kind_are_read_in_natural_order(tmp_path, picture):
    for k in (1, 2, 10):
        cv2.imwrite(str(tmp_path / f"shot-{k}.png"), moved(picture, k))
    cv2.imwrite(str(tmp_path / "shot-11.png"), 100 + moved(picture, 11).astype(np.uint16) * 7)  # 16 bits, 11 are used
    cv2.imwrite(str(tmp_path / "shot-12.jpg"), cv2.cvtColor(moved(picture, 12), cv2.COLOR_GRAY2BGR))
    (tmp_path / "shot-13.png").write_bytes(b"")
    steps = []
    photos = find_in_photos([tmp_path, tmp_path / "shot-1.png"], BOARD, lambda *step: steps.append(step))
    assert [name for name, _ in photos.views] == [f"shot-{k}" for k in ("1.png", "2.png", "10.png", "11.png", "12.jpg")]
    assert photos.refused == (("shot-13.png", "unreadable: the file is empty"),)
    assert photos.image_size_px == (400, 300)
    assert steps[-1] == (6, 6, "shot-13.png")
    first = photos.views[0][1].pixels
    for k, (_, view) in zip((1, 2, 10, 11, 12), photos.views, strict=True):
        np.testing.assert_allclose(view.pixels - first, [[2 * (k - 1), 0]] * len(first), atol=0.05)


def test_the_same_picture_twice_counts_once(tmp_path, picture):
    for name in "abc":
        cv2.imwrite(str(tmp_path / f"{name}.png"), picture)
    with pytest.raises(InputError, match=r"found in 1 of 3 pictures, 3 or more .*\(2 of 2.*the same picture as a"):
        find_in_photos([tmp_path], BOARD)


def test_a_picture_that_was_saved_again_or_taken_again_counts_once(tmp_path, picture):
    """JPEG of several qualities, more light, more noise; the first one is kept, and other pictures are not touched."""
    noise = np.random.default_rng(0).normal(0, 3, picture.shape)
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"{k}-a.png"), moved(picture, k))
        for quality in (90, 50):
            cv2.imwrite(str(tmp_path / f"{k}-b{quality}.jpg"), moved(picture, k), [cv2.IMWRITE_JPEG_QUALITY, quality])
        cv2.imwrite(str(tmp_path / f"{k}-c.png"), np.clip(moved(picture, k) * 1.1 + noise, 0, 255).astype(np.uint8))
    photos = find_in_photos([tmp_path], BOARD)
    assert [name for name, _ in photos.views] == ["0-a.png", "1-a.png", "2-a.png"]
    assert len(photos.refused) == 9
    for name, reason in photos.refused:
        assert re.match(rf"the same picture as {name[0]}-a.png, points within 0.0\d+ px: it would count twice", reason)


def test_the_error_for_mixed_sizes_names_the_pictures(tmp_path, picture):
    for k in range(2):
        cv2.imwrite(str(tmp_path / f"a{k}.png"), picture + np.uint8(k))
        cv2.imwrite(str(tmp_path / f"b{k}.png"), picture[:, ::2] + np.uint8(k))
    with pytest.raises(InputError, match=r"different sizes: 400x300 \(a0.png, a1.png\), 200x300 \(b0.png, b1.png\)"):
        find_in_photos([tmp_path / "*.png"], BOARD)


def test_pictures_of_another_size_than_most_are_named_and_left_out(tmp_path, picture):
    cv2.imwrite(str(tmp_path / "a.png"), picture[:, ::2])
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"b{k}.png"), moved(picture, k))
    photos = find_in_photos([tmp_path / "*.png"], BOARD)
    assert photos.image_size_px == (400, 300)
    assert len(photos.views) == 3
    assert photos.refused == (("a.png", "200x300 px, most pictures have 400x300: another camera or setting"),)


def test_a_path_without_pictures_is_refused_with_the_reason(tmp_path):
    for given, words in (
        ([], "no pictures given"),
        ([tmp_path], "holds no pictures"),
        ([tmp_path / "x.png"], "found nothing; check the path"),
        ([tmp_path / "*.png"], "no file matches"),
    ):
        with pytest.raises(InputError, match=words):
            load_photos(given)


def test_the_most_frequent_reason_is_reported(tmp_path, picture):
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"a{k}.png"), picture + np.uint8(k))
    with pytest.raises(
        InputError, match=r"found in none of 3 pictures; .*\(2 of 2, first a0.png\): .*9x6.*in 1 more the quick search"
    ):
        find_in_photos([tmp_path], parse("chessboard:7x7:25mm"))


def test_copies_of_a_picture_without_a_board_do_not_hide_the_reason(tmp_path):
    for name in "abcd":
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.full((300, 400), 90, dtype=np.uint8))
    with pytest.raises(InputError, match=r"\(1 of 1, first a.png\): hardly any contrast.*; 3 more are copies"):
        find_in_photos([tmp_path], BOARD)


@pytest.mark.parametrize("at_once", [1, 4])
def test_only_the_first_pictures_without_a_board_are_searched_thoroughly(at_once, tmp_path, picture, monkeypatch):
    """Once a picture shows the board, the others are searched thoroughly too, so that no board is missed."""
    monkeypatch.setattr(source, "THREADS", at_once)
    searches = []
    wall = np.random.default_rng(0).integers(60, 190, picture.shape).astype(np.uint8)

    def recorded(image, board, thorough=True):
        searches.append(thorough)
        if np.isin(image, wall).all() and image.std() > 35:  # the wall: its thorough search takes a second
            return NotFound("no chessboard seen") if thorough else QUICK_SEARCH_FAILED
        return find_board(image, board, thorough)

    monkeypatch.setattr(photos_module, "find_board", recorded)
    for k in range(4):
        cv2.imwrite(str(tmp_path / f"a{k}.png"), np.roll(wall, k))
    with pytest.raises(
        InputError, match=r"none of 4 pictures; .*\(2 of 2, first a0.png\).*in 2 more the quick search found no board"
    ):
        find_in_photos([tmp_path], BOARD)
    assert searches == [True, True, False, False]
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"b{k}.png"), moved(picture, k))
    searches.clear()
    found = find_in_photos([tmp_path], BOARD)
    assert searches == [True, True, False, False, False, True, True, True, True]
    assert [name for name, _ in found.views] == ["b0.png", "b1.png", "b2.png"]
    assert [name for name, _ in found.refused] == ["a0.png", "a1.png", "a2.png", "a3.png"]
    assert {reason for _, reason in found.refused} == {found.refused[0][1]}


@pytest.mark.parametrize("at_once", further_slow([4, 1, 2]))
def test_a_video_that_shows_a_charuco_board_now_and_then_has_the_reasons_of_three_frames_only(
    at_once, tmp_path, monkeypatch
):
    """However many frames are searched at a time."""
    monkeypatch.setattr(source, "THREADS", at_once)
    board = parse("charuco:5x4:40mm:30mm:DICT_4X4_50")
    camera = Camera("c", "s", (400, 300), np.array([[500.0, 0, 200], [0, 500, 150], [0, 0, 1]]), (), Pose.identity())
    seen = photograph(
        board, camera, Pose(np.eye(3), np.array([0, 0, 0.5]) - board.middle), look=PhotoSettings(samples=9)
    ).image
    wall = np.random.default_rng(0).integers(60, 190, seen.shape).astype(np.uint8)
    for k in range(12):
        cv2.imwrite(str(tmp_path / f"{k}.png"), moved(seen, k) if k % 4 == 3 else np.roll(wall, k))
    threads = cv2.getNumThreads()
    found = find_in_photos([tmp_path], board)
    assert [name for name, _ in found.views] == ["3.png", "7.png", "11.png"]
    quick = [name for name, reason in found.refused if reason == QUICK_SEARCH_FAILED.reason]
    assert quick == ["2.png", "5.png", "6.png", "8.png", "9.png", "10.png"]
    assert "(3 of 3, first 0.png)" in found.line()
    assert cv2.getNumThreads() == threads


def test_the_source_of_a_picture_follows_from_folder_video_or_name(picture):
    def origins(*paths):
        names = [str(k) for k in range(len(paths))]
        where = {name: Path(path) for name, path in zip(names, paths, strict=True)}
        return origins_of(PhotoSet(BOARD, (400, 300), tuple((n, picture) for n in names), (), where))

    assert origins("left01.jpg", "left12.jpg", "right01.jpg") == ("left", "left", "right")
    assert origins("IMG_0001_a.jpg", "IMG_0002_a.jpg", "IMG_0001_b.jpg") == ("IMG_a", "IMG_a", "IMG_b")
    assert origins("cam0_001.png", "cam0_002.png", "cam1_001.png") == ("cam0", "cam0", "cam1")
    assert origins("cam_0.mp4", "cam_0.mp4", "cam_1.mp4") == ("cam_0.mp4", "cam_0.mp4", "cam_1.mp4")
    assert origins("l/01.png", "l/02.png", "r/01.png") == ("l/", "l/", "r/")


def test_a_picture_of_16_bits_uses_all_grey_values_of_8_bits_but_for_a_thousandth_at_each_end():
    """Linear between: a step of grey values is the same everywhere, whatever the camera's range."""
    ramp = np.tile(np.linspace(900, 4900, 1001).round().astype(np.uint16), (4, 1))
    ramp[0, 0], ramp[0, -1] = 0, 65535
    shown = as_8_bit(ramp)[1].astype(int)
    np.testing.assert_allclose(shown, np.linspace(0, 255, 1001), atol=1)
    assert as_8_bit(ramp)[0, [0, -1]].tolist() == [0, 255]
