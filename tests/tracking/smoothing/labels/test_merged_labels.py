"""Which frames take the labels that the tracker gives backward in time."""

from __future__ import annotations

import numpy as np

from tracking.smoothing.recording import BackwardLabels, merged


def test_weak_frames_take_labels_of_four_spots_that_are_two_more_or_the_first_ones():
    """For every number of causal and of backward labels, of six spots that two cameras each see."""
    spot_of = np.tile(np.arange(6), 2)
    for causal_count in range(7):
        for count in range(7):
            for weak, measured in ((True, True), (True, False), (False, True)):
                causal = np.where(np.arange(12) % 6 < causal_count, 1, -1)[None]
                backward = BackwardLabels(1, 12)
                backward.assigned[0] = np.where(np.arange(12) % 6 < count, 2, -1)
                backward.measured[0] = measured
                out = merged(causal, backward, np.array([weak]), spot_of)
                taken = weak and measured and count >= 4 and (causal_count == 0 or count - causal_count >= 2)
                np.testing.assert_array_equal(out, backward.assigned if taken else causal)
