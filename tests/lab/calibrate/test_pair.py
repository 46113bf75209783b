"""`calibrate pair` from photographs to files, and what it answers if the photographs do not give a pair."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration.lens.fit.lens_models import LensModel
from calibration.lens.intrinsics import Intrinsics, IntrinsicsOptions, calibrate_intrinsics
from calibration.pair import PairError, calibrate_pair
from geometry.camera import Camera
from geometry.pose import Pose
from lab.calibrate.camera.pair import findings_of, next_pairs, range_sigmas
from lab.files.rig.board_file import load_board_or_text
from lab.files.rig.pair_file import load_pair_file
from lab.findings.finding import Level, verdict
from lab.simulate.board_photo import PhotoSettings, photograph
from tests.calibration.lens.lens_scenes import Scene, photographs
from tests.lab.command import typed
from tests.lab.tables import rows_of

NAMES = ("left", "right")


@pytest.fixture(scope="module")
def singles() -> tuple[Intrinsics, Intrinsics]:
    """Two cameras with photographs of different places of the board."""
    options = IntrinsicsOptions(lens=LensModel(4), warp=False)
    left, right = (calibrate_intrinsics(photographs(Scene(views=6), seed), options) for seed in (1, 2))
    return left, right


def test_photographs_that_are_not_of_one_instant_fail_with_what_to_photograph_next(singles):
    numbers = list(range(6))
    pair = calibrate_pair(NAMES, singles, (numbers, numbers))
    assert verdict(findings_of(pair, NAMES)) is Level.FAIL
    assert next_pairs(pair, NAMES).startswith("Photograph next: 9 more pairs, the board at rest and in both pictures")


def test_too_few_pairs_are_refused_with_what_to_photograph_next(singles):
    with pytest.raises(PairError, match=r"got 2;.*photograph 15 pairs or more, the board at rest and in both"):
        calibrate_pair(NAMES, singles, ([0, 1, 2], [1, 2, 7]))


@pytest.mark.parametrize(
    ("share", "level"), [(0.0019, Level.PASS), (0.0021, Level.WARN), (0.019, Level.WARN), (0.021, Level.FAIL)]
)
def test_a_pair_is_judged_by_how_well_it_determines_distances(singles, share, level):
    """Of a point 20 baselines ahead; twice the sigmas of the calibration are twice the sigma of the distance."""
    pair = calibrate_pair(NAMES, singles, (list(range(6)), list(range(6))))
    distance_m, sigma_m = range_sigmas(pair)[2]
    assert distance_m == pytest.approx(20 * pair.baseline_m)
    matrix = pair.covariance.matrix * (share * distance_m / sigma_m) ** 2
    judged = replace(pair, covariance=replace(pair.covariance, matrix=matrix))
    assert [f.level for f in findings_of(judged, NAMES) if f.code == "BP-Q03"] == [level]


BOARD, BASELINE_M, PAIRS = "chessboard:9x6:25mm", 0.12, 9


def photographs_of_a_pair(folder: Path) -> None:
    """Photographs left/00.png ... and right/00.png ... of a board that is turned by up to half a radian."""
    board, rng = load_board_or_text(BOARD), np.random.default_rng(5)
    matrix = np.array([[640.0, 0.0, 319.5], [0.0, 640.0, 239.5], [0.0, 0.0, 1.0]])
    for k in range(PAIRS):
        turned = Pose.from_ypr(np.deg2rad(rng.uniform(-25, 25, 3)), np.zeros(3))
        at = np.array([0.5 * BASELINE_M, 0.0, 0.55]) + rng.uniform(-0.04, 0.04, 3)
        seen = Pose(turned.rotation, at - turned.rotation @ board.middle)
        for name, shift_m in (("left", 0.0), ("right", BASELINE_M)):
            camera = Camera(name, "", (640, 480), matrix, (), Pose(np.eye(3), np.array([-shift_m, 0.0, 0.0])))
            picture = photograph(board, camera, seen, look=PhotoSettings(noise_dn=1.0, samples=64), seed=k).image
            (folder / name).mkdir(exist_ok=True)
            cv2.imwrite(str(folder / name / f"{k:02d}.png"), picture)


def test_photographs_of_two_cameras_give_their_distance_to_its_sigma(tmp_path):
    photographs_of_a_pair(tmp_path)
    command = ["calibrate", "pair", str(tmp_path / "left"), str(tmp_path / "right"), "--board", BOARD, "--lens", "0"]
    done = typed(*command, "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    pair = load_pair_file(tmp_path / "out" / "pair.yaml")
    right = pair.cameras["right"].camera_from_world
    row = pair.covariance.names.index("cameras.right.x_m")
    sigma_m = float(np.sqrt(pair.covariance.matrix[row, row]))
    assert abs(right.translation[0] + BASELINE_M) < 4 * sigma_m
    assert sigma_m < 1e-3
    assert len(rows_of(tmp_path / "out" / "pairs.csv")) == PAIRS
    assert "Pair" in (tmp_path / "out" / "report.html").read_text()
