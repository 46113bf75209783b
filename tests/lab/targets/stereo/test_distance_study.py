"""The repeated experiment of Zhou (2020), and the calibration of a simulated pair against its truth."""

import numpy as np
import pytest

from bench.related_measurements.stereo import DISTANCES_M, simulated_calibration
from lab.targets.stereo.simulated_recording import simulated_pair
from studies.comparison import write_comparison
from studies.zhou2020 import BASELINE_M, FOCAL_PX, SIZE_PX, compare_zhou2020, distance_errors


def test_the_error_of_single_points_is_the_formula_for_parallel_cameras():
    e = distance_errors(10.0, 12, 0.1, np.random.default_rng(1))
    formula = 10.0**2 * 0.1 * np.sqrt(2) / (FOCAL_PX * BASELINE_M)  # Z^2 sigma_d / (f b), 30 mm
    assert e.bound[1] == pytest.approx(formula, rel=0.05)
    assert e.bound[2] < 0.4 * e.bound[1]  # seven markers of known geometry


@pytest.mark.slow
def test_the_study_shows_smaller_errors_than_the_paper_at_every_distance(tmp_path):
    study = compare_zhou2020(seed=2, trials=25)
    for distance in DISTANCES_M:
        row = next(r for r in study.rows if r.quantity == f"distance error at {distance:g} m, RMS")
        assert row.values[2] < row.paper
    assert study.value("centroid of a marker, RMS", "joint fit") < 0.05
    assert study.value("seven markers: rotation, RMS", "joint fit") < 0.5
    assert (write_comparison(study, tmp_path / "out").result / "report.html").is_file()


@pytest.mark.slow
def test_the_covariance_of_a_simulated_pair_covers_its_errors():
    true, nees = simulated_pair(FOCAL_PX, SIZE_PX, BASELINE_M), []
    for seed in range(4):
        found = simulated_calibration(np.random.default_rng(seed), pairs=12)
        error = true.cameras[1].camera_from_world.minus(found.cameras[1].camera_from_world)
        C = found.covariance.matrix[-6:, -6:]
        nees.append(error @ np.linalg.solve(C, error))
    assert 0.3 < np.mean(nees) / 6 < 2.2  # sigma of the mean: 0.29
