"""The region of poses that a prior allows: its volume, and which poses lie in it."""

from __future__ import annotations

import numpy as np
import pytest

from geometry.pose import Pose
from geometry.pose_prior import PosePrior

CENTRE = Pose.from_ypr(np.array([0.4, -0.2, 0.1]), np.array([1.0, -2.0, 0.5]))


def test_the_volume_of_small_turns_is_that_of_a_ball_of_rotation_vectors_and_of_all_turns_8_pi_squared():
    cube = 3 * np.log(2 * PosePrior(CENTRE, 0.3, 1e-3).half_width_m)
    small = PosePrior(CENTRE, 0.3, 0.01)
    ball = 4 / 3 * np.pi * small.largest_turn_rad**3
    assert small.log_volume - cube == pytest.approx(np.log(ball), abs=1e-3)
    assert PosePrior(CENTRE, 0.3, np.pi).log_volume - cube == pytest.approx(np.log(8 * np.pi**2))


@pytest.mark.parametrize("within_rad", [0.05, 1.0, 2.5])
def test_poses_are_contained_up_to_the_largest_turn_and_the_largest_distance_along_each_axis(within_rad):
    prior = PosePrior(CENTRE, 0.3, within_rad)
    axis = np.array([0.6, 0.0, 0.8])
    for share, inside in ((0.999, True), (1.001, False)):
        turned = CENTRE.plus(np.concatenate([np.zeros(3), share * prior.largest_turn_rad * axis]))
        moved = CENTRE.plus(np.array([0.0, -share * prior.half_width_m, 0, 0, 0, 0]))
        assert bool(prior.contains(turned)) is inside
        assert bool(prior.contains(moved)) is inside
    assert not prior.contains(Pose(np.full((3, 3), np.nan), CENTRE.translation))
