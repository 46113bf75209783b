"""The estimated clocks and frames scatter as their covariance says; what the motion does not show is reported."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from geometry import rotations
from tests.tracking.comparison.motions import TRUTH, recordings, smooth
from tracking.comparison.estimation import (
    Free,
    NotComparableError,
    estimate_alignment,
    offset_candidates,
    speeds_correlation,
)
from tracking.comparison.frame_alignment import (
    BODY,
    LEVER,
    TIME,
    TRANSLATION,
    WORLD,
    Alignment,
    PoseSeries,
    jacobians,
    residuals,
)


def minus(one: Alignment, other: Alignment) -> np.ndarray:
    """The delta (14,) for which other.plus(delta) is the one."""
    return np.concatenate([
        [one.offset_s - other.offset_s, one.rate - other.rate],
        rotations.log(one.world @ other.world.T),
        rotations.log(other.body.T @ one.body),
        one.lever_m - other.lever_m,
        one.translation_m - other.translation_m,
    ])  # fmt: skip


def nees(found: list, truth: Alignment = TRUTH) -> float:
    """The mean squared error in units of the covariance, per parameter."""
    each = []
    for e in found:
        used = np.diag(e.covariance) > 0
        error = minus(truth, e.alignment)[used]
        each.append(error @ np.linalg.solve(e.covariance[np.ix_(used, used)], error) / used.sum())
    return float(np.mean(each))


def angles_only(motion: PoseSeries) -> PoseSeries:
    return PoseSeries(motion.t_s, motion.rotation, None, motion.covariance)


def places_only(motion: PoseSeries) -> PoseSeries:
    return PoseSeries(motion.t_s, None, motion.position_m, motion.covariance)


def test_errors_of_all_fourteen_parameters_agree_with_their_covariance():
    found = [estimate_alignment(*recordings(seed), offset_s=0.1) for seed in range(6)]
    assert all(e.free.all() and not e.determined.undetermined for e in found)
    # 6 x 14 squared normal errors: a mean of 1 with a standard deviation of 0.15. The slow test has 60 recordings.
    assert 0.6 < nees(found) < 1.4
    assert 0.85 < np.mean([e.scale for e in found]) < 1.15


@pytest.mark.slow
@pytest.mark.parametrize("reference_step_s", [0.02, 0.025, 0.005, 0.1])
def test_errors_agree_with_the_covariance_at_any_rate_of_the_reference(reference_step_s):
    found = [
        estimate_alignment(*recordings(100 + seed, reference_step_s=reference_step_s), offset_s=0.1)
        for seed in range(60)
    ]
    assert 0.8 < nees(found) < 1.25


def test_angles_alone_determine_clocks_and_rotations():
    found = []
    for seed in range(8):
        result, reference = recordings(seed)
        found.append(estimate_alignment(result, angles_only(reference), offset_s=0.1))
    assert all(e.free[TIME].all() and e.free[WORLD].all() and e.free[BODY].all() for e in found)
    assert not found[0].free[LEVER].any()
    truth = replace(TRUTH, lever_m=np.zeros(3), translation_m=np.zeros(3))
    assert 0.6 < nees(found, truth) < 1.4


def test_places_alone_determine_clocks_world_and_lever_arm():
    found = []
    for seed in range(4):
        result, reference = recordings(seed)
        found.append(estimate_alignment(result, places_only(reference), offset_s=0.1))
    assert not found[0].free[BODY].any()
    assert 0.5 < nees(found, replace(TRUTH, body=np.eye(3))) < 1.5


def test_an_unknown_offset_of_days_is_found_without_help():
    truth = replace(TRUTH, offset_s=1.7e9 + 4.321)
    e = estimate_alignment(*recordings(3, truth=truth))
    assert e.alignment.offset_s - truth.offset_s == pytest.approx(0.0, abs=6e-5)
    assert e.other_offsets == ()


@pytest.mark.slow
def test_noise_of_a_reference_does_not_pull_the_offset_to_half_a_sample():
    # Slow motion: 0.2 sigma of the reference per sample. Interpolation at half a sample has the smallest noise.
    truth = replace(TRUTH, offset_s=0.0)

    def slow(t):
        return smooth(t / 8)

    found = [
        estimate_alignment(
            *recordings(seed, slow, truth=truth, reference_step_s=0.02, reference_sigmas=(3e-3, 1e-2), frames=600),
            Free(rate=False),
            offset_s=0.0,
        )
        for seed in range(12)
    ]
    errors = np.array([(e.alignment.offset_s - truth.offset_s) / e.sigmas[0] for e in found])
    assert abs(errors.mean()) < 1.0
    assert np.mean(errors**2) < 2.5


def test_one_outlier_in_twelve_hardly_changes_the_result():
    result, reference = recordings(5)
    rng = np.random.default_rng(7)
    bad = rng.choice(len(reference), len(reference) // 12, replace=False)
    rotation, position = reference.rotation.copy(), reference.position_m.copy()
    rotation[bad] = rotation[bad] @ rotations.exp(rng.normal(0, 0.2, (len(bad), 3)))
    position[bad] += rng.normal(0, 0.3, (len(bad), 3))
    e = estimate_alignment(result, PoseSeries(reference.t_s, rotation, position, reference.covariance))
    error = minus(TRUTH, e.alignment)
    assert np.all(np.abs(error) < 5 * e.sigmas)
    assert 0.5 < e.inliers.mean() < 0.95
    assert e.scale < 2.5


def test_correlated_errors_widen_the_sigmas():
    rng = np.random.default_rng(2)
    result, reference = recordings(6)
    white = rng.standard_normal((len(result), 3))
    slow = np.stack([np.convolve(white[:, k], np.ones(15) / np.sqrt(15), "same") for k in range(3)], -1)
    drifting = PoseSeries(
        result.t_s, smooth(result.t_s)[0] @ rotations.exp(1e-4 * slow), result.position_m, result.covariance
    )
    e = estimate_alignment(drifting, reference, offset_s=0.1)
    assert e.correlation > 1.5


def test_a_stationary_stand_determines_neither_clock_nor_axes():
    def still(t):
        return smooth(np.zeros_like(t) + 0.4)

    e = estimate_alignment(*recordings(1, still))
    assert set(e.determined.undetermined) == {"offset_s", "rate"}
    assert len(e.determined.world_axes) == 3
    assert len(e.determined.lever_axes) == 3
    assert e.sigmas[0] == 0.0
    assert e.alignment.offset_s == pytest.approx(0.0, abs=1e-12)  # the last digits depend on the processor
    assert 0.7 < e.scale < 1.3  # the differences are still those of the noise


def test_rotation_about_one_axis_leaves_one_direction_open():
    def turntable(t):
        return smooth(t, (1, 0, 0), places=0.0)

    e = estimate_alignment(*recordings(1, turntable), offset_s=0.1)
    axis = TRUTH.world @ np.array([0, 0, 1.0])
    assert e.determined.undetermined == ()
    assert len(e.determined.world_axes) == len(e.determined.lever_axes) == 1
    assert abs(e.determined.world_axes[0] @ axis) == pytest.approx(1.0, abs=1e-4)
    assert abs(e.determined.lever_axes[0, 2]) == pytest.approx(1.0, abs=1e-3)
    assert 0.7 < e.scale < 1.3


def test_a_steady_turn_does_not_show_the_time_offset():
    def steady(t):
        return rotations.exp(np.outer(t, [0, 0, 0.2])), np.zeros((len(t), 3))

    result, reference = recordings(1, steady)
    e = estimate_alignment(result, angles_only(reference))
    assert "offset_s" in e.determined.undetermined


def test_a_periodic_motion_has_an_ambiguous_offset():
    def swing(t):
        return rotations.exp(np.outer(0.2 * np.sin(2 * np.pi * t), [0, 0, 1.0])), np.zeros((len(t), 3))

    result, reference = recordings(1, swing)
    e = estimate_alignment(result, angles_only(reference))
    shifts = [(o - e.alignment.offset_s) / 0.5 for o in e.other_offsets]
    assert shifts
    assert all(abs(s - round(s)) < 0.05 for s in shifts)  # half periods: the axis may point either way


def test_recordings_without_common_times_or_content_are_refused():
    result, reference = recordings(1)
    with pytest.raises(NotComparableError, match="one has only attitudes"):
        estimate_alignment(angles_only(result), places_only(reference))
    with pytest.raises(NotComparableError, match="fewer than 8 common times"):
        estimate_alignment(result, reference, Free(offset=False), offset_s=1e4)

    def still(t):
        return smooth(np.zeros_like(t))

    with pytest.raises(NotComparableError):
        estimate_alignment(*recordings(1, still, truth=replace(TRUTH, offset_s=1e6)))


def test_the_jacobian_is_the_derivative_of_the_residuals():
    quiet = {"result_sigmas": (0.0, 0.0), "reference_sigmas": (0.0, 0.0)}
    result, reference = recordings(1, **quiet, reference_step_s=0.005, step_s=0.005, frames=400)
    found = residuals(result, reference, TRUTH)
    J, with_reference = jacobians(result, reference, TRUTH, found.compared)
    middle = slice(20, -20)
    for k in range(14):
        delta = np.zeros(14)
        delta[k] = 1e-5
        change = (
            residuals(result, reference, TRUTH.plus(delta)).values
            - residuals(result, reference, TRUTH.plus(-delta)).values
        )
        for analytic in (J, with_reference):
            np.testing.assert_allclose(analytic[middle, :, k], change[middle] / 2e-5, atol=2e-3)


def test_plus_and_minus_are_inverse():
    delta = np.linspace(-0.3, 0.4, 14)
    np.testing.assert_allclose(minus(TRUTH.plus(delta), TRUTH), delta, atol=1e-12)
    assert TRANSLATION.stop == 14


def test_candidates_of_the_offset_are_the_largest_maxima_down_to_half_of_the_largest():
    """Of a reference whose rates are mostly noise: the largest correlation is then small itself."""
    result, reference = recordings(2, reference_sigmas=(1e-4, 0.02))
    offset, r = speeds_correlation(result, reference)
    assert 0.1 < r.max() < 0.7
    maxima = [
        i for i in range(len(r)) if r[i] == r[max(i - 1, 0) : i + 2].max() and (i + 1 == len(r) or r[i] > r[i + 1])
    ]
    best = sorted(maxima, key=lambda i: -r[i])[:6]
    expected = [offset[i] for i in best if r[i] >= 0.5 * r.max()]
    assert len(expected) > 1
    np.testing.assert_array_equal(offset_candidates(result, reference), expected)
