"""The repeated experiment shows the effects of the paper, and its files are complete."""

from __future__ import annotations

import numpy as np
import pytest

from studies.comparison import write_comparison
from studies.huo2015 import NOISE_PX, comparison_of, prediction_errors, repeat_huo2015
from tests.lab.tables import rows_of

FRAMES = 200  # a bend, and spots 3 and 6 leave the picture


@pytest.fixture(scope="module")
def study():
    return repeat_huo2015(seed=3, frames=FRAMES)


def value(study, quantity, column):
    return comparison_of(study).value(quantity, column)


def test_without_noise_both_methods_are_exact_out_of_view(study):
    for way in ("quadratic", "rigid"):
        error = study.outside_px[f"{way}, 0 px"]
        assert np.isfinite(error).any(), "spots 3 and 6 leave the picture in this recording"
        assert np.nanmax(error) < 1e-6


def test_the_rigid_body_is_at_least_as_accurate_out_of_view_as_the_quadratic_equation(study):
    quadratic, rigid = (study.outside_px[f"{way}, {NOISE_PX:g} px"] for way in ("quadratic", "rigid"))
    assert np.sqrt(np.nanmean(rigid**2)) <= np.sqrt(np.nanmean(quadratic**2))


def test_a_filter_with_low_process_noise_recovers_from_a_bend_faster_with_a_restart(study):
    after = np.flatnonzero(study.run.turned)[0] + np.arange(2, 12)
    conventional, switching = (
        np.sqrt(np.nanmean(prediction_errors(study.run, 300.0, switch)[after] ** 2)) for switch in (False, True)
    )
    assert switching < 0.7 * conventional


def test_only_the_recognition_rate_of_the_paper_counts_out_of_view_estimates_as_wrong(study):
    rate = value(study, "recognition rate, eq. (15)", "beampose")
    identity = value(study, "right identity of spots in view", "beampose")
    outside = 100 * np.mean(study.run.in_view == 0)
    assert identity > 99.5
    assert rate == pytest.approx(identity * (100 - outside) / 100, abs=0.5)


def test_the_files_of_a_study_are_complete(tmp_path, study):
    outcome = write_comparison(comparison_of(study), tmp_path / "study")
    rows = rows_of(outcome.result / "figures.csv")
    assert list(rows[0]) == ["quantity", "unit", "paper", "conventional", "curve_switching", "beampose", "note"]
    assert [r["quantity"] for r in rows] == [r.quantity for r in study.rows]
    assert float(rows[0]["conventional"]) == pytest.approx(study.rows[0].values[0], rel=1e-5)
    page = (outcome.result / "report.html").read_text("utf-8")
    assert page.rstrip().endswith("</html>")
    assert "65.97" in page
    assert not any(word in page for word in ("http://", "https://", "nan"))
