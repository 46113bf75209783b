"""What `calibrate pair` answers if the photographs do not give a pair."""

from __future__ import annotations

from dataclasses import replace

import pytest

from calibration.lens.fit.lens_models import LensModel
from calibration.lens.intrinsics import Intrinsics, IntrinsicsOptions, calibrate_intrinsics
from calibration.pair import PairError, calibrate_pair
from lab.calibrate.camera.pair import findings_of, next_pairs, range_sigmas
from lab.findings.finding import Level, verdict
from tests.calibration.lens.lens_scenes import Scene, photographs

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
