"""The experiment of Fu (2016): the robust filter resists the disturbance, and nothing else changes."""

from __future__ import annotations

import numpy as np
import pytest

from studies.fu2016 import DISTURBANCES, compare_fu2016, estimate, peaks, quiet_rms, simulate


@pytest.fixture(scope="module")
def study():
    return compare_fu2016(seed=3, recordings=1, pictures=13)


@pytest.mark.parametrize("disturbance", DISTURBANCES[1:])
def test_the_disturbance_changes_the_measurements_from_6_to_8_s_only(disturbance):
    quiet, disturbed = simulate(3, 0, "none"), simulate(3, 0, disturbance)
    changed = np.any(quiet.measured != disturbed.measured, axis=1)
    assert np.array_equal(quiet.states, disturbed.states)
    assert not changed[(quiet.t_s < 5.95) | (quiet.t_s > 8.05)].any()
    assert changed[(quiet.t_s > 6.05) & (quiet.t_s < 7.95)].all()


@pytest.mark.parametrize("disturbance", DISTURBANCES[1:])
def test_the_student_t_filter_has_a_fifth_of_the_standard_filters_peaks(disturbance):
    recording = simulate(3, 1, disturbance)
    robust, standard = (np.array(peaks(recording, estimate(recording, n))) for n in ("Student-t", "standard"))
    assert np.all(robust[:2] <= 0.2 * standard[:2])


def test_without_a_disturbance_the_student_t_filter_costs_little_accuracy():
    recording = simulate(3, 1, "none")
    robust, standard = (np.array(quiet_rms(recording, estimate(recording, n))) for n in ("Student-t", "standard"))
    assert np.all(robust <= 1.2 * standard)


def test_the_table_has_the_paper_beside_ours_and_says_what_is_not_observed(study):
    assert study.value("burst: peak error, position", "standard") > 5 * study.value(
        "burst: peak error, position", "Student-t"
    )
    notes = {row.quantity: row.note for row in study.rows}
    assert notes["observed directions, eq. (4): y, z, yaw, pitch"].endswith("not observed: x, velocity x")
    assert notes["observed directions, eq. (5): y, z and two bearings"].endswith("not observed: yaw, pitch")
    assert {row.paper for row in study.rows} >= {0.1, 1.0}


def test_an_unknown_disturbance_is_refused():
    with pytest.raises(ValueError, match="expected one of none, burst, smooth bias, got 'gust'"):
        simulate(1, 0, "gust")
