"""When the velocities jump: found from the motion on both sides, to its stated sigma."""

from __future__ import annotations

import numpy as np
import pytest

from tests.tracking.smoothing.test_fixed_interval import DT, JERK, drawn
from tracking.rigid_body.models.motion import process_noise
from tracking.smoothing.motion.jump_moments import JumpMoment, find_moment

STEP = 20  # that has the jump
INSIDE = slice(STEP - 1, STEP + 2)  # the steps that may have it
SIZE = np.array([0.45, 4.7])  # variances of the jump that `drawn` makes


def moment_of(seed: int, share: float) -> JumpMoment | None:
    """The moment found in a run whose velocities jump at this share of a step, without the spots of the open steps."""
    run = drawn(seed, 40, jump_at=STEP, moment=share)
    info = run.info
    info.information[INSIDE.start : INSIDE.stop - 1] = 0.0
    info.vector[INSIDE.start : INSIDE.stop - 1] = 0.0
    info.velocity_jump[INSIDE] = SIZE / 3
    return find_moment(run.ref, info, np.tile(JERK, (40, 1)), (INSIDE.start, INSIDE.stop - 1), SIZE)


def test_the_error_of_a_moment_is_as_stated():
    shares = np.random.default_rng(5).uniform(size=60)
    found = [moment_of(seed, share) for seed, share in enumerate(shares)]
    known = [(f, share) for f, share in zip(found, shares, strict=True) if f is not None]
    assert len(known) > 50
    errors = np.array([(f.step + 1) * DT - f.later_s - (STEP + share) * DT for f, share in known])
    over = errors / np.array([f.sigma_s for f, _ in known])
    assert np.sqrt(np.mean(over**2)) == pytest.approx(1.0, abs=0.35)
    assert np.abs(errors).max() < 0.2 * DT


def test_the_noise_of_a_jump_at_a_known_moment_is_that_of_drawn_jumps():
    rng = np.random.default_rng(3)
    later, spread, dt = 0.004, 0.001, 0.01
    jump, after = rng.normal(size=400_000), later + spread * rng.normal(size=400_000)
    drawn_cov = np.cov(jump * after, jump)
    pp, pv, _, vv, _, _ = process_noise(dt, 0.0, 1.0, 0.0, later, spread)
    np.testing.assert_allclose([pp, pv, vv], [drawn_cov[0, 0], drawn_cov[0, 1], drawn_cov[1, 1]], rtol=0.02)
