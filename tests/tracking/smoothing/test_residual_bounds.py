"""Upper bounds of the spots' variances: how the residuals vary with the errors that belong to places."""

from __future__ import annotations

import numpy as np
import pytest

from tracking.smoothing.single_frame_poses import most_of_places


@pytest.mark.parametrize("factor", [0.02, 0.2, 1.0])
def test_spots_on_edges_and_on_even_ground_show_how_much_of_the_predicted_errors_is_true(factor):
    rng = np.random.default_rng(1)
    share = rng.choice([0.05, 0.5, 0.95], 400)
    bounds = []
    for _ in range(40):
        ratio = 0.5 * rng.chisquare(2, 400) * (1 - share * (1 - factor))
        bounds.append(most_of_places(ratio, share, np.ones(400)))
    assert np.mean(np.array(bounds) >= 0.95 * factor) > 0.85
    assert np.median(bounds) < min(2.0 * factor + 0.02, 1.01)


def test_few_independent_places_allow_all_of_them():
    share, ratio = np.full(400, 0.9), np.full(400, 0.3)
    assert most_of_places(ratio, share, np.full(400, 1 / 400)) == 1.0
