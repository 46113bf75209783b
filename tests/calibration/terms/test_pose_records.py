"""Recorded poses of a stand as a term of an adjustment."""

from __future__ import annotations

import numpy as np

from calibration.least_squares.adjustment import Poses
from calibration.terms.surveyed import RecordTerm
from geometry.arrays import numeric_jacobian
from geometry.pose import Pose


def test_the_jacobian_of_a_record_equals_finite_differences_also_far_from_it():
    rng = np.random.default_rng(1)
    recorded = Pose.from_ypr(rng.normal(size=(3, 3)), rng.normal(size=(3, 3)))
    now = recorded.plus(rng.normal(0, 0.3, (3, 6)))
    sigmas = rng.uniform(0.01, 0.1, (3, 6))
    term = RecordTerm("poses", np.arange(3), recorded, sigmas)
    J = term.linearise({"poses": Poses(now)}).parts[0].jacobian
    for k in range(3):

        def moved(d, k=k):
            delta = np.zeros((3, 6))
            delta[k] = d
            return term.linearise({"poses": Poses(now.plus(delta))}).residuals[k]

        np.testing.assert_allclose(J[k], numeric_jacobian(moved, np.zeros(6)), rtol=1e-5, atol=1e-4)


def test_numbers_not_recorded_or_held_fixed_give_no_residual():
    recorded = Pose.from_ypr(np.zeros((1, 3)), np.zeros((1, 3)))
    sigmas = np.array([[0.1, np.inf, 0.0, 0.1, 0.1, 0.1]])
    line = RecordTerm("poses", np.array([0]), recorded, sigmas).linearise(
        {"poses": Poses(recorded.plus(np.full((1, 6), 0.05)))}
    )
    assert line.residuals[0, 1] == line.residuals[0, 2] == 0.0
    assert line.residuals[0, 0] == 0.5
    assert not line.parts[0].jacobian[0, 1:3].any()
