"""Leave-one-out residuals, the derivatives of faults, and the statistics of correlated series."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.model_check.check import nis_band
from calibration.model_check.faults import FaultParameters, possible_faults
from calibration.model_check.linearised_frames import correlation_time, linearise
from geometry.arrays import evenly_spaced
from geometry.forward_model import SpotModel
from geometry.pose_solver.gauss_newton import fit_pose
from tests.calibration.model_check.model_scenes import one_camera, recorded, turned


def test_a_leave_one_out_residual_is_that_of_a_fit_without_the_spot():
    run, recording = recorded("smooth", 5, frames=40)
    frames = evenly_spaced(np.flatnonzero(recording.usable.sum(axis=1) == 6), 5)
    lin = linearise(run.model, recording, frames)
    residual, covariance = lin.leave_one_out_residuals()
    grouped, of_group = lin.leave_group_out(np.array([0, 3]), lin.residual)  # beam A, both its spots
    for left_out in ([2], [0, 3]):
        for i, k in enumerate(frames):
            rows = np.setdiff1d(np.arange(6), left_out)
            fit = fit_pose(
                run.model, rows, recording.uv_px[k, rows], recording.cov_px2[k, rows], recording.poses[int(k)]
            )
            assert fit is not None
            expected = recording.uv_px[k, left_out] - fit.projected_px[left_out]
            spread = fit.jacobian[left_out] @ fit.covariance @ np.swapaxes(fit.jacobian[left_out], -1, -2)
            got = residual[i, left_out] if len(left_out) == 1 else grouped[i]
            stated = covariance[i, left_out] if len(left_out) == 1 else of_group[i]
            np.testing.assert_allclose(got, expected, atol=1e-3)
            np.testing.assert_allclose(stated, spread + recording.cov_px2[k, left_out], rtol=1e-2, atol=1e-5)


@pytest.mark.parametrize("scene", ["smooth", "four-skew-beams"])
def test_the_directions_of_a_fault_give_its_effect_on_the_pixels(scene):
    run, recording = recorded(scene, 5, frames=60)
    parameters = FaultParameters.of(run.rig, run.model, None)
    lin = linearise(run.model, recording, np.arange(10, 50, 10))
    jacobian = parameters.jacobian(recording, lin)
    camera = one_camera(scene)
    angle = np.deg2rad(0.01)
    found = [
        fault
        for fault in possible_faults(run.rig, parameters)
        if (fault.component, fault.name, fault.kind) == ("camera", camera, "turned")
    ]
    assert len(found) == 1
    for axis in range(3):
        other = SpotModel.of(turned(camera, 0.01, axis)(run.rig))
        shift = other.project(lin.poses)[0] - run.model.project(lin.poses)[0]
        whitened = np.where(lin.used[..., None], (lin.W @ shift[..., None])[..., 0], 0.0)
        np.testing.assert_allclose(jacobian @ found[0].directions[:, axis] * angle, whitened, atol=2e-3)
        assert np.abs(whitened).max() > 0.5


def test_the_band_of_a_mean_nis_is_that_of_a_chi_square():
    """Bar-Shalom, Li & Kirubarajan (2001), sec. 5.4: chi-square tables, 100 degrees of freedom: 74.222 and 129.561."""
    assert nis_band(50) == pytest.approx((0.74222, 1.29561), rel=1e-4)


@pytest.mark.parametrize(("rho", "expected"), [(0.0, 1.0), (0.6, 4.0), (0.9, 19.0)])
def test_the_correlation_time_of_a_first_order_process_is_the_theoretical_one(rho, expected):
    """(1 + rho) / (1 - rho)."""
    noise = np.random.default_rng(5).standard_normal((20_000, 2))
    series = np.empty_like(noise)
    series[0] = 0
    for k in range(1, len(noise)):
        series[k] = rho * series[k - 1] + noise[k]
    series[::7] = np.nan
    assert correlation_time(series - np.nanmean(series, axis=0)) == pytest.approx(expected, rel=0.2)


def test_evenly_spaced_frames_include_both_ends_and_are_never_more_than_the_limit():
    frames = np.arange(1000)
    chosen = evenly_spaced(frames, 400)
    assert (chosen[0], chosen[-1], len(chosen)) == (0, 999, 400)
    assert len(evenly_spaced(frames[:7], 400)) == 7
