"""The lens models: against OpenCV, their Jacobians, their inverses, and the radius at which they fold."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from geometry import lens
from geometry.arrays import numeric_jacobian
from geometry.camera import Camera
from geometry.pose import Pose
from tests.geometry.scenes import LENSES

models = pytest.mark.parametrize("numbers", LENSES.values(), ids=[f"{n} numbers" for n in LENSES])
seeds = st.integers(0, 2**32 - 1)
# A strong barrel: r (1 - 0.3 r^2) stops growing at r^2 = 1 / 0.9.
BARREL = (-0.3, 0.0, 0.0, 0.0)


def disc(rng: np.random.Generator, n: int, radius: float) -> np.ndarray:
    """n points (n, 2), evenly spread over a disc."""
    r, a = radius * np.sqrt(rng.uniform(0, 1, n)), rng.uniform(-np.pi, np.pi, n)
    return np.column_stack([r * np.cos(a), r * np.sin(a)])


def radial(r: np.ndarray, numbers: tuple[float, ...]) -> np.ndarray:
    """The distorted radius r N(r^2) / D(r^2), written out."""
    k1, k2, _, _, k3, k4, k5, k6 = (*numbers, *([0.0] * 8))[:8]
    s = r**2
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # a point may be a pole
        return r * (1 + k1 * s + k2 * s**2 + k3 * s**3) / (1 + k4 * s + k5 * s**2 + k6 * s**3)


def first_fold_by_scan(numbers: tuple[float, ...], r_max: float, n: int) -> float:
    """The first radius at which the densely sampled distorted radius decreases, or jumps at a pole; inf if none."""
    r = np.linspace(0, r_max, n)
    bent = radial(r, numbers)
    back = np.flatnonzero(np.diff(bent) <= 0)
    return float(r[back[0]]) if len(back) else np.inf


@models
def test_distorted_points_equal_those_of_opencv(numbers):
    xy = disc(np.random.default_rng(1), 500, 0.8)
    expected, _ = cv2.projectPoints(
        np.column_stack([xy, np.ones(500)]), np.zeros(3), np.zeros(3), np.eye(3), np.array(numbers) if numbers else None
    )
    ours, _ = lens.distort(xy, lens.padded(numbers))
    np.testing.assert_allclose(ours, expected[:, 0], rtol=0, atol=1e-14)


@models
def test_the_jacobian_of_the_distortion_equals_finite_differences(numbers):
    for xy in disc(np.random.default_rng(2), 40, 0.8):
        _, J = lens.distort(xy, lens.padded(numbers))
        differences = numeric_jacobian(lambda p: lens.distort(p, lens.padded(numbers))[0], xy)
        np.testing.assert_allclose(J, differences, rtol=0, atol=1e-9)


@models
def test_undistort_is_the_inverse_of_distort(numbers):
    xy = disc(np.random.default_rng(3), 500, 0.8)
    bent, _ = lens.distort(xy, lens.padded(numbers))
    back = lens.undistort(bent, lens.padded(numbers), lens.fold_limit(numbers))
    np.testing.assert_allclose(back, xy, rtol=0, atol=1e-12)


def test_one_call_distorts_points_of_several_cameras():
    xy = disc(np.random.default_rng(4), len(LENSES), 0.6)
    stack = np.array([lens.padded(n) for n in LENSES.values()])
    together, J = lens.distort(xy, stack)
    for i, numbers in enumerate(LENSES.values()):
        alone, J_alone = lens.distort(xy[i], lens.padded(numbers))
        np.testing.assert_allclose(together[i], alone, rtol=0, atol=1e-15)
        np.testing.assert_allclose(J[i], J_alone, rtol=0, atol=1e-15)


def test_the_lenses_of_these_tests_do_not_fold_where_they_are_used():
    for numbers in LENSES.values():
        assert lens.fold_limit(numbers) > 0.8**2


def test_a_lens_without_distortion_never_folds():
    assert lens.fold_limit(()) == np.inf
    assert lens.fold_limit((0.0,) * 14) == np.inf


def test_a_pincushion_lens_never_folds():
    assert lens.fold_limit((0.2, 0.05, 0.0, 0.0, 0.01)) == np.inf


def test_the_fold_of_a_barrel_lens_is_the_zero_of_its_derivative():
    assert lens.fold_limit(BARREL) == pytest.approx(1 / 0.9, rel=1e-12)


def test_a_pole_of_the_rational_model_is_a_limit():
    # r / (1 - r^2 / 2) grows without bound up to r^2 = 2 and is negative beyond.
    assert lens.fold_limit((0.0, 0.0, 0.0, 0.0, 0.0, -0.5, 0.0, 0.0)) == pytest.approx(2.0, rel=1e-9)


@pytest.mark.parametrize("noise", [1e-12, 1e-20, 1e-80, 5e-324, -1e-20, -1e-80])
def test_a_leading_coefficient_of_rounding_size_does_not_change_the_fold(noise):
    assert lens.fold_limit((*BARREL, noise)) == pytest.approx(1 / 0.9, rel=1e-9)
    assert lens.fold_limit((-0.3, 0.0, 0.0, 0.0, noise, noise, noise, noise)) == pytest.approx(1 / 0.9, rel=1e-9)


coefficient = st.floats(-0.6, 0.6)


@settings(max_examples=120)
@given(k=st.tuples(coefficient, coefficient, coefficient), rational=st.tuples(coefficient, coefficient, coefficient))
def test_the_fold_is_the_first_decrease_of_a_densely_sampled_radius(k, rational):
    for denominators in ((0.0, 0.0, 0.0), rational):
        numbers = (k[0], k[1], 0.0, 0.0, k[2], *denominators)
        r_max, n = 4.0, 40_001
        found = np.sqrt(lens.fold_limit(numbers))
        sampled = first_fold_by_scan(numbers, r_max, n)
        # Samples may miss a place where the curve only just stops growing.
        assume(not found < r_max or _turns_clearly(found, numbers))
        if sampled == np.inf:
            assert found >= r_max * (1 - 1e-4)
        else:
            assert found == pytest.approx(sampled, abs=3 * r_max / n)


def _turns_clearly(radius: float, numbers: tuple[float, ...]) -> bool:
    near = radius + np.array([-1e-3, 0, 1e-3])
    before, at, after = radial(near, numbers)
    # A numerator near zero almost cancels a pole, whose peak is then narrower than a step.
    numerator = radial(near, (*numbers[:5], 0.0, 0.0, 0.0)) / near
    return (at - before) > 1e-9 and ((at - after) > 1e-9 or after < 0) and np.abs(numerator).min() > 1e-3


@settings(max_examples=60)
@given(k=st.tuples(coefficient, coefficient, coefficient), rational=st.tuples(coefficient, coefficient, coefficient))
def test_inside_the_fold_the_distorted_radius_increases(k, rational):
    numbers = (k[0], k[1], 0.0, 0.0, k[2], *rational)
    limit = min(np.sqrt(lens.fold_limit(numbers)), 3.0)
    r = np.linspace(0, limit * (1 - 1e-6), 5000)
    assert (np.diff(radial(r, numbers)) > 0).all()


@settings(max_examples=60)
@given(
    k=st.tuples(st.floats(-0.5, -0.05), st.floats(-0.1, 0.1), st.floats(-0.05, 0.05)),
    tangential=st.tuples(st.floats(-3e-3, 3e-3), st.floats(-3e-3, 3e-3)),
    seed=seeds,
)
@example(k=(-0.28125, 0.0, 0.012750228794406154), tangential=(0.0, 0.002), seed=5)  # almost folds; p2 makes it fold
def test_inside_the_fold_undistort_is_the_inverse_of_distort(k, tangential, seed):
    numbers = (k[0], k[1], *tangential, k[2])
    fold = lens.fold_limit(numbers)
    xy = disc(np.random.default_rng(seed), 50, 0.95 * min(np.sqrt(fold), 2.0))
    bent, _ = lens.distort(xy, lens.padded(numbers))
    back = lens.undistort(bent, lens.padded(numbers), fold)
    # Near the fold the inverse is steep: 1e-15 in the distorted point may become 1e-13 in the other.
    np.testing.assert_allclose(back, xy, rtol=0, atol=1e-11)


@pytest.mark.parametrize("numbers", [BARREL, (-0.4, 0.1, 1e-3, -1e-3, 0.0), LENSES[8], LENSES[14]])
def test_a_point_beyond_the_fold_is_never_projected_into_the_picture(numbers):
    """The polynomial alone would project far points into the picture for the barrel lenses (see the next test)."""
    camera = Camera(
        "c", "s", (1280, 1024), np.array([[600.0, 0, 639.5], [0, 600, 511.5], [0, 0, 1]]), numbers, Pose.identity()
    )
    angles = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    radii = np.geomspace(0.05, 50, 400)
    xy = radii[:, None, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    pixels = camera.project(np.concatenate([xy, np.ones((*xy.shape[:2], 1))], axis=-1))
    seen = camera.sees(pixels)
    assert seen.any()
    # Along every direction, all points beyond the first one outside the picture are outside too.
    gone = np.maximum.accumulate(~seen, axis=0)
    assert not (seen & gone).any()
    # Inside the picture the map is one to one: the ray of the pixel passes through the point.
    _, rays = camera.rays(pixels[seen])
    np.testing.assert_allclose(rays[:, :2] / rays[:, 2:], xy[seen], rtol=0, atol=1e-7)


def test_without_the_limit_a_barrel_lens_would_project_far_points_into_the_picture():
    """Shows that the test above can fail."""
    bent, _ = lens.distort(np.array([1.8, 0.0]), lens.padded(BARREL))
    assert abs(bent[0]) < 0.1


def test_a_pixel_outside_the_image_of_the_lens_has_no_ray():
    edge = radial(np.sqrt(1 / 0.9), BARREL)
    target = np.array([[edge * 1.001, 0.0], [edge * 0.999, 0.0], [5.0, 5.0], [np.nan, 0.0]])
    back = lens.undistort(target, lens.padded(BARREL), lens.fold_limit(BARREL))
    assert np.isfinite(back).all(axis=-1).tolist() == [False, True, False, False]


def test_an_empty_array_of_points_is_undistorted_to_an_empty_one():
    assert lens.undistort(np.zeros((0, 2)), lens.padded(BARREL), lens.fold_limit(BARREL)).shape == (0, 2)


def test_the_model_is_one_to_one_just_inside_the_fold_and_not_beyond():
    fold = lens.fold_limit(BARREL)
    xy = np.array([[np.sqrt(fold) * s, 0.0] for s in (1 - 1e-6, 1 + 1e-6, 1.5, 10)])
    _, J = lens.distort(xy, lens.padded(BARREL))
    assert lens.is_one_to_one(xy, J, np.asarray(fold)).tolist() == [True, False, False, False]
