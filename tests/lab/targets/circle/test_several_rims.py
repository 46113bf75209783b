"""A drogue shows several rims next to each other: the acquired circle is one of them."""

from itertools import islice

import numpy as np
import pytest

from studies.zhou2014 import approach
from tracking.drogue_circle.detectors import CircleParameters, classical_detector
from tracking.drogue_circle.tracker import Wanted, acquire


@pytest.mark.parametrize(
    ("light", "seed"), [("side", 601), ("side", 610), ("side", 631), ("side", 632), ("front", 624), ("overcast", 607)]
)
def test_an_acquired_circle_is_no_mixture_of_two_rims(light: str, seed: int) -> None:
    """A small drogue in the first picture of an approach. A mixture of two rims is off by a tenth of the radius."""
    drawn = next(islice(approach(seed, light, 400), 1))
    parameters = CircleParameters(min_radius_px=10.0)
    search = acquire(drawn.picture, classical_detector(parameters), parameters, Wanted())
    assert search.found is not None
    away = np.abs(drawn.circles - search.found.centre_and_radius).max(axis=1)
    assert away.min() < 0.05 * drawn.circles[0, 2]
