"""The parts of the measurement: shapes, pixel integration, the fit's step, what the covariance is raised by."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import erf

from tests.tracking.rendering import Scene, Spot, bound, expected, expose
from tracking import ellipses
from tracking.centroid import refine
from tracking.gaussian_fit import Spots, least_squares
from tracking.moments import adaptive_moments
from tracking.noise import NoiseModel
from tracking.patches import Window, cut, profile

px = 1.0
NOISE = NoiseModel(1.5**2 + 1 / 12, 1 / 30)
sigmas = st.floats(0.3, 15)


def shape_of(major: float, minor: float, angle_deg: float) -> np.ndarray:
    a = np.radians(angle_deg)
    R = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    return ellipses.entries((R @ np.diag([major**2, minor**2]) @ R.T)[None])


@given(sigmas, sigmas, st.floats(-89.9, 90))
def test_axes_and_angle_come_back_from_the_covariance(a, b, angle):
    major, minor, found = ellipses.axes(shape_of(max(a, b), min(a, b), angle))
    assert major[0] == pytest.approx(max(a, b), rel=1e-6)
    assert minor[0] == pytest.approx(min(a, b), rel=1e-6, abs=1e-5)
    assert -90 < found[0] <= 90
    if abs(a - b) > 0.01 * max(a, b):
        assert abs((found[0] - angle + 90) % 180 - 90) < 1e-3


@given(sigmas, sigmas, st.floats(-90, 90), sigmas, sigmas, st.floats(-90, 90))
def test_closed_forms_agree_with_numpy(a, b, turn, c, d, other):
    S, T = shape_of(a, b, turn), shape_of(c, d, other)
    full = ellipses.matrices(S)
    np.testing.assert_allclose(ellipses.matrices(ellipses.inverse(S)), np.linalg.inv(full), rtol=1e-6, atol=1e-9)
    values = np.stack(ellipses.eigenvalues(S), axis=1)
    np.testing.assert_allclose(values, np.linalg.eigvalsh(full), rtol=1e-6, atol=1e-9)
    kept = ellipses.matrices(ellipses.kept_within(T, S, 0.4, 2.5))
    ratios = np.linalg.eigvals(np.linalg.inv(full) @ kept).real
    assert ratios.min() > 0.4 - 1e-6
    assert ratios.max() < 2.5 + 1e-6
    if (np.abs(np.log(np.linalg.eigvals(np.linalg.inv(full) @ ellipses.matrices(T)).real)) < np.log(2.4)).all():
        np.testing.assert_allclose(kept, ellipses.matrices(T))


@pytest.mark.parametrize(("sigma", "tolerance"), [(0.5, 6e-3), (0.8, 6e-4), (1.5, 3e-4), (3.0, 1e-4)])
@pytest.mark.parametrize("phase", [0.0, 0.23, 0.5])
def test_pixels_integrate_the_gaussian(sigma, tolerance, phase):
    """Round spots factorise, and the error function integrates each factor exactly."""
    image = np.zeros((21, 21), np.uint8)
    patches = cut(image, np.array([[10.0, 10.0]]), Window(10, 1), 255)
    value = profile(patches, slice(None), np.array([[10 + phase, 10.0]]), shape_of(sigma, sigma, 0)).value[0]
    edges = np.arange(22) - 0.5

    def share(centre: float) -> np.ndarray:
        return np.diff(0.5 * erf((edges - centre) / (sigma * np.sqrt(2))))

    exact = np.outer(share(10.0), share(10 + phase)).reshape(-1)
    assert np.abs(value - exact).max() < tolerance * exact.max()


def test_cells_of_two_pixels_are_means_of_four_and_know_clipped_and_missing_ones():
    image = np.arange(400, dtype=np.uint16).reshape(20, 20)
    image[6, 6] = 65535
    patches = cut(image, np.array([[4.5, 4.5]]), Window(3, 2), 65535)
    values, valid = patches.values.reshape(7, 7), patches.valid.reshape(7, 7)
    u, v = patches.origin[0] + [patches.du[-1], patches.dv[-1]]
    assert values[-1, -1] == pytest.approx(20 * v + u)  # a plane's mean is its value in the middle
    assert not patches.inside.reshape(7, 7)[0, 0]
    clipped = [(r, c) for r in range(7) for c in range(7) if not valid[r, c] and patches.inside.reshape(7, 7)[r, c]]
    assert len(clipped) == 1


def test_the_step_solves_the_weighted_problem():
    rng = np.random.default_rng(0)
    J, weight, y = rng.normal(size=(3, 5, 40)), rng.uniform(0, 2, (3, 40)), rng.normal(size=(3, 40))
    x, inverse, _, _ = least_squares(J, weight, y)
    for i in range(3):
        root = np.sqrt(weight[i])
        np.testing.assert_allclose(x[i], np.linalg.lstsq((J[i] * root).T, y[i] * root, rcond=None)[0], rtol=1e-6)
        np.testing.assert_allclose(inverse[i], np.linalg.inv((J[i] * weight[i]) @ J[i].T), rtol=1e-6, atol=1e-9)


def test_moments_come_close_and_the_fit_reaches_the_truth_without_noise():
    spot = Spot(40.3, 30.8, 20_000.0, 3.1, 1.7, 25.0)
    image = np.rint(expected(Scene([spot], (80, 60), 1000.0, (300.0, 200.0)))).astype(np.uint16)
    uv, shape = adaptive_moments(image, np.array([[40.0, 31.0]]), np.array([1000.0]))
    assert np.abs(uv - [40.3, 30.8]).max() < 0.1 * px
    plane = np.array([[1000.0, 0, 0]])
    fit = refine(image, Spots(uv, shape, np.array([6e5]), plane), NoiseModel(1.0, 1.0, 1000.0), 65535, 20.0)
    assert np.abs(fit.spots.uv - [40.3, 30.8]).max() < 2e-4 * px
    major, minor, angle = ellipses.axes(fit.spots.shape)
    assert (major[0], minor[0], angle[0]) == pytest.approx((3.1, 1.7, 25.0), abs=0.01)
    assert fit.spots.flux[0] == pytest.approx(spot.flux, rel=1e-3)


def fitted(scene: Scene, seed: int, spot: Spot, hot: tuple[int, int] | None = None):
    rng = np.random.default_rng(seed)
    image = expose(expected(scene, rng), scene, rng)
    if hot:
        image[hot[1], hot[0]] = 200
    start = np.rint([[spot.u, spot.v]])
    uv, shape = adaptive_moments(image, start, np.array([scene.background]))
    plane = np.array([[scene.background, 0, 0]])
    return refine(image, Spots(uv, shape, np.array([spot.flux]), plane), NOISE, 255, 20.0)


@pytest.mark.parametrize("hot", [(34, 30), (32, 27), (30, 31)])
def test_a_hot_pixel_beside_or_in_a_spot_does_not_pull_it(hot):
    spot = Spot(30.3, 29.6, 100.0, 2.2, 2.0)
    clean, marred = (fitted(Scene([spot], (64, 60)), 5, spot, h) for h in (None, hot))
    sigma = np.sqrt(np.diagonal(clean.cov_px2[0]))
    assert (np.abs(clean.spots.uv - marred.spots.uv) < 1.0 * sigma).all()
    assert marred.chi2[0] < 1.4


def test_a_flat_topped_spot_keeps_its_small_sigma_and_a_speckled_one_does_not():
    """A symmetric misfit cannot move the centre; a lopsided one does."""
    streak, plain = Spot(30.4, 30.2, 180.0, 1.8, 1.8, 20.0, streak=12.0), Spot(30.4, 30.2, 180.0, 2.5, 2.5)
    flat = fitted(Scene([streak], (64, 60)), 1, streak)
    speckled = fitted(Scene([plain], (64, 60), speckle=0.2), 1, plain)
    smooth = fitted(Scene([plain], (64, 60)), 1, plain)
    assert flat.chi2[0] > 1.2
    scene = Scene([streak], (64, 60))
    assert np.trace(flat.cov_px2[0]) < 1.5 * np.trace(bound(streak, scene, expected(scene)))
    assert np.trace(speckled.cov_px2[0]) > 9 * np.trace(smooth.cov_px2[0])


def test_a_candidate_that_wanders_off_is_given_up():
    image = np.full((80, 80), 20, np.uint8)
    image[:, 40:] = 200  # an edge, no spot
    plane = np.array([[20.0, 0, 0]])
    start = Spots(np.array([[40.0, 40.0]]), np.array([[4.0, 0, 4.0]]), np.array([4000.0]), plane)
    fit = refine(image, start, NOISE, 255, 5.0)
    assert np.isnan(fit.cov_px2).all()


@pytest.mark.parametrize(("sigma", "lock"), [(0.5, 5e-3), (0.8, 5e-4), (2.0, 2e-4)])
def test_centres_are_not_drawn_to_pixels(sigma, lock):
    """Without noise the error is a function of the phase in the pixel alone; 16 bit keep rounding out of it."""
    for phase in np.linspace(-0.5, 0.5, 9):
        spot = Spot(30 + phase, 30.2 - phase, 30_000.0, sigma, sigma)
        image = np.rint(expected(Scene([spot], (61, 61), 1000.0))).astype(np.uint16)
        uv, shape = adaptive_moments(image, np.rint([[spot.u, spot.v]]), np.array([1000.0]))
        start = Spots(uv, shape, np.array([spot.flux]), np.array([[1000.0, 0, 0]]))
        fit = refine(image, start, NoiseModel(100.0, 0.1, 1000.0), 65535, 20.0)
        assert np.abs(fit.spots.uv - [spot.u, spot.v]).max() < lock * px
