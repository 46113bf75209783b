"""Pictures without a target: nothing is acquired."""

import numpy as np
import pytest

from bench.related_measurements.renderers import second_renderer as render
from tracking.drogue_circle.detectors import CircleParameters, classical_detector
from tracking.drogue_circle.tracker import Wanted, acquire


@pytest.mark.parametrize(("kind", "seed", "at"), [("trees", 172002, 100), ("cloud", 172004, 0)])
def test_round_crowns_of_trees_and_shreds_of_cloud_are_no_targets(kind: str, seed: int, at: int) -> None:
    rng = np.random.default_rng(seed)
    width, height = render.SIZE
    scene = render.background(kind, rng, (width + 110, height + 110))[at : at + height, at : at + width]
    rng.uniform(0, 1, 2)
    p = CircleParameters()
    assert acquire(render.draw(scene, None, 0, 0, 0, rng), classical_detector(p), p, Wanted()).found is None
