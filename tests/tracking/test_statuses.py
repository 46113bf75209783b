"""The meanings of the spot statuses, by tracker method."""

from __future__ import annotations

import pytest

from tracking.statuses import SpotStatus


@pytest.mark.parametrize("status", SpotStatus)
def test_only_the_meanings_for_the_spots_method_name_the_papers_matching_steps(status):
    for meaning in (status.meaning, status.meaning_for("rigid")):
        assert "step" not in meaning
        assert "search" not in meaning
    named = status in (SpotStatus.MATCHED, SpotStatus.TURNED, SpotStatus.OCCLUDED)
    assert ("step" in status.meaning_for("spots")) == named


def test_an_unknown_tracker_method_is_rejected():
    with pytest.raises(ValueError, match="tracker method: expected one of rigid, spots, got 'best'"):
        SpotStatus.LOST.meaning_for("best")
