"""`calibrate pair` on the real stereo photographs of shared/data, against OpenCV and the board's own size."""

import cv2
import numpy as np
import pytest

from calibration.boards.board_detection import find_board
from lab.calibrate.camera.pair import calibrate_pair_folder
from lab.files.rig.board_file import load_board_or_text
from lab.files.rig.pair_file import load_pair_file
from lab.pictures.picture_file import read_picture
from tests.paths import DATA
from tracking.binocular.joint_fit import triangulate
from tracking.binocular.marker_model import StereoPair

PHOTOS = DATA / "chessboard_stereo_opencv"
SQUARE_M = 0.025

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not PHOTOS.is_dir(), reason="no real photographs: shared/data is not part of the project"),
]


@pytest.fixture(scope="module")
def outcome(tmp_path_factory):
    out = tmp_path_factory.mktemp("pair") / "out"
    return calibrate_pair_folder(PHOTOS / "left*.jpg", PHOTOS / "right*.jpg", "chessboard:9x6:25mm", out)


@pytest.fixture(scope="module")
def corners():
    """Corners (2, 54, 2) of each pair of photographs."""
    board = load_board_or_text("chessboard:9x6:25mm")
    out = []
    for number in range(1, 8):
        views = [
            find_board(read_picture(PHOTOS / f"{side}{number:02d}.jpg", None), board) for side in ("left", "right")
        ]
        if all(hasattr(v, "pixels") and len(v.pixels) == 54 for v in views):
            out.append(np.stack([v.pixels for v in views]))
    return out


def test_the_baseline_is_that_of_opencvs_stereo_calibration(outcome, corners):
    board = np.zeros((54, 3), np.float32)
    board[:, :2] = np.mgrid[0:9, 0:6].T.reshape(-1, 2) * SQUARE_M
    objects = [board] * len(corners)
    left, right = ([c[k].astype(np.float32).reshape(-1, 1, 2) for c in corners] for k in (0, 1))
    first, second = (cv2.calibrateCamera(objects, p, (640, 480), None, None) for p in (left, right))
    found = cv2.stereoCalibrate(
        objects, left, right, first[1], first[2], second[1], second[2], (640, 480), flags=0
    )  # fmt: skip
    assert outcome.result.baseline_m == pytest.approx(float(np.linalg.norm(found[6])), abs=0.0005)
    assert max(outcome.result.rms_px) < 0.2


def test_triangulated_corners_are_on_the_squares_of_the_board(outcome, corners):
    file = load_pair_file(outcome.out / "pair.yaml")
    pair = StereoPair(tuple(file.cameras.values()), file.covariance)
    sides, flat = [], []
    for uv in corners:
        cov = np.broadcast_to(0.1**2 * np.eye(2), (2, 54, 2, 2))
        grid = triangulate(pair, uv, cov).points.reshape(6, 9, 3)
        sides += [np.linalg.norm(np.diff(grid, axis=a), axis=-1).ravel() - SQUARE_M for a in (0, 1)]
        points = grid.reshape(-1, 3) - grid.reshape(-1, 3).mean(axis=0)
        flat.append(np.linalg.svd(points, compute_uv=False)[2] / np.sqrt(len(points)))
    sides = np.concatenate(sides)
    assert abs(sides.mean()) < 1e-4  # 0.4 % of a square
    assert sides.std() < 5e-4
    assert np.mean(flat) < 1e-3
