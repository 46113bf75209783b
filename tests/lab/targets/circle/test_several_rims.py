"""A drogue shows several rims next to each other: the acquired circle is one of them."""

from itertools import islice

import numpy as np

from studies.zhou2014 import approach
from tracking.drogue_circle.detectors import CircleParameters, classical_detector
from tracking.drogue_circle.tracker import Wanted, acquire

DRAWN = [("side", 601), ("side", 610), ("side", 631), ("side", 632), ("front", 624), ("overcast", 607)]


def test_an_acquired_circle_is_no_mixture_of_two_rims() -> None:
    """Small drogues in the first picture of an approach. A mixture of two rims is off by a tenth of the radius."""
    parameters = CircleParameters(min_radius_px=10.0)
    away = []
    for light, seed in DRAWN:
        drawn = next(islice(approach(seed, light, 400), 1))
        found = acquire(drawn.picture, classical_detector(parameters), parameters, Wanted()).found
        assert found is not None, (light, seed)
        off = np.abs(drawn.circles - found.centre_and_radius).max(axis=1).min()
        away.append(off / drawn.circles[0, 2])
    assert max(away) < 0.05
