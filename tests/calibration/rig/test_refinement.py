"""What the covariance of a refined rig claims, against the true errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bench import refine as bench
from bench.random_scenes.projection import spot_pixels
from calibration.rig.refinement import refine
from geometry.uncertainty.chi_square import chi2_limit


@pytest.mark.parametrize("draw", [0, 1, 3])
def test_directions_that_many_precise_spots_determine_are_as_right_as_is_claimed_while_parts_are_turned(draw):
    """Two beams: most turns stay uncertain by 1 to 3 mrad, and spots of 0.005 px know other directions to 1e-4 of that.

    A turn moves spots by its square, too. Without this NEES is 17, 7 and 7 per number.
    """
    noise_px, sigmas = 0.005, bench.Sigmas(clocks=0.0)
    lab, (scene,), _ = bench.campaign(527, 40, recordings=1)
    rng = np.random.default_rng(draw)
    exact, labelled = spot_pixels(lab.rig, scene.poses), bench.with_true_labels(scene)
    noisy = np.where(labelled.seen[..., None], exact + noise_px * rng.normal(size=exact.shape), np.nan)
    cov = np.broadcast_to(noise_px**2 * np.eye(2), labelled.cov_px2.shape).copy()
    known = bench.drawn_rig(rng, lab.rig, sigmas)
    found = refine(known, bench.rig_covariance(known, sigmas), [replace(labelled, uv_px=noisy, cov_px2=cov)])
    nees, count = bench.rig_nees(found, lab.rig)
    assert nees * count < chi2_limit(1e-3, count)
    assert np.max(found.gain) > 1e6
