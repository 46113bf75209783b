"""The study of Zhou (2014) shows what the documents state."""

from __future__ import annotations

import pytest

from studies.comparison import write_comparison
from studies.zhou2014 import compare_zhou2014, followed, hidden_run


@pytest.mark.slow
def test_the_study_has_our_figures_beside_the_papers(tmp_path):
    comparison = compare_zhou2014(5, stills=10, runs=2, frames=150)
    for light, paper in (("front", 92.2), ("side", 96.7), ("overcast", 96.7)):
        row = next(r for r in comparison.rows if r.quantity == f"tracked frames, {light}")
        assert row.paper == paper
        assert row.values[2] >= 99
    still = "centre of a still, 40 % hidden: median error"
    assert comparison.value(still, "beampose") < 0.2 < comparison.value(still, "HoughCircles")
    outcome = write_comparison(comparison, tmp_path / "study")
    page = (outcome.result / "report.html").read_text("utf-8")
    assert page.rstrip().endswith("</html>")
    assert ">nan<" not in page


@pytest.mark.slow
def test_eight_hidden_frames_are_predicted_within_two_pixels():
    runs = [hidden_run(900 + k) for k in range(5)]
    assert max(run.largest(run.ours_px) for run in runs) <= 2.0
    assert min(run.largest(run.printed_px) for run in runs) > 0.5


@pytest.mark.slow
def test_a_rendered_drogue_is_followed_past_a_probe():
    (ours,) = followed(9, "overcast", 150, forms=("sound",))
    assert ours.percent >= 99
