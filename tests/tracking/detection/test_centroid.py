"""The steps of the measurement: shapes, pixel integration, the step of the fit, correction of the covariance."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import erf

from tests.tracking.rendering import Scene, Spot, bound, expected, expose
from tracking.detection import ellipse
from tracking.detection.ellipse import exponential, gaussian_window
from tracking.detection.gaussian_fit import fit_all
from tracking.detection.moments import find_moments
from tracking.detection.normal_equations import accumulate, solve_normal
from tracking.detection.pixels import CLIPPED, OUTSIDE, Noise, Pixels, Window, read_window, window_around
from tracking.detection.table import (
    ALGEBRA,
    CANDIDATE,
    CELL_ROWS,
    LIGHT,
    MOST_CELLS,
    NORMAL,
    RESIDUAL,
    RIGHT_SIDE,
    USE,
    VECTORS,
    WEIGHT,
)

px = 1.0
NOISE = Noise(1.5**2 + 1 / 12, 1 / 30, 0.0, 0.0, 0.0, 0.0)
sigmas = st.floats(0.3, 15)
FITTED = ("u", "v", "uu", "uv", "vv", "flux", "level", "slope_u", "slope_v")


def shape_of(major: float, minor: float, angle_deg: float) -> tuple[float, float, float]:
    a = np.radians(angle_deg)
    R = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    C = R @ np.diag([major**2, minor**2]) @ R.T
    return C[0, 0], C[0, 1], C[1, 1]


def matrix(shape: tuple[float, float, float]) -> np.ndarray:
    return np.array([[shape[0], shape[1]], [shape[1], shape[2]]])


def workspace() -> tuple[np.ndarray, np.ndarray]:
    cells = np.zeros((CELL_ROWS, MOST_CELLS))
    cells[USE] = 1.0
    return cells, np.zeros((ALGEBRA, 9, 10))


def candidate(*fitted: float) -> np.void:
    table = np.zeros(1, CANDIDATE)
    for name, value in zip(FITTED, fitted, strict=True):
        table[name] = value
    return table[0]


def numbers(spot: np.void, *names: str) -> np.ndarray:
    return np.array([spot[name] for name in names])


def pixels(image: np.ndarray) -> Pixels:
    return Pixels(image.view(np.uint8), image.itemsize, image.shape[1], image.shape[0])


@given(sigmas, sigmas, st.floats(-89.9, 90))
def test_axes_and_angle_are_recovered_from_the_covariance(a, b, angle):
    major, minor, found = ellipse.axes(*shape_of(max(a, b), min(a, b), angle))
    assert major == pytest.approx(max(a, b), rel=1e-6)
    assert minor == pytest.approx(min(a, b), rel=1e-6, abs=1e-5)
    assert -90 < found <= 90
    if abs(a - b) > 0.01 * max(a, b):
        assert abs((found - angle + 90) % 180 - 90) < 1e-3


@given(sigmas, sigmas, st.floats(-90, 90), sigmas, sigmas, st.floats(-90, 90))
def test_closed_forms_agree_with_numpy(a, b, turn, c, d, other):
    S, T = shape_of(a, b, turn), shape_of(c, d, other)
    full = matrix(S)
    np.testing.assert_allclose(matrix(ellipse.inverse(*S)), np.linalg.inv(full), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(ellipse.eigenvalues(*S), np.linalg.eigvalsh(full), rtol=1e-6, atol=1e-9)
    raised = ellipse.clip_eigenvalues(*S, 1.0, 9.0)
    np.testing.assert_allclose(
        np.linalg.eigvalsh(matrix(raised)), np.clip(np.linalg.eigvalsh(full), 1, 9), rtol=1e-6, atol=1e-9
    )
    ratios = np.linalg.eigvals(np.linalg.inv(full) @ matrix(ellipse.clip_in_metric(T, S, 0.4, 2.5))).real
    assert ratios.min() > 0.4 - 1e-6
    assert ratios.max() < 2.5 + 1e-6
    if (np.abs(np.log(np.linalg.eigvals(np.linalg.inv(full) @ matrix(T)).real)) < np.log(2.4)).all():
        np.testing.assert_allclose(ellipse.clip_in_metric(T, S, 0.4, 2.5), T, rtol=1e-9, atol=1e-12)


@given(sigmas, sigmas, st.floats(-90, 90), st.floats(-30, 30), st.floats(-30, 30), st.sampled_from([1.0, 2.0, 4.0]))
def test_a_window_of_a_gaussian_is_the_exponential_at_each_point(a, b, turn, u0, v0, step):
    A = np.linalg.inv(matrix(shape_of(a, b, turn)))
    window = np.zeros(3 * 40)
    gaussian_window((A[0, 0], A[0, 1], A[1, 1]), u0, v0, step, 40, window)
    v, u = np.meshgrid(v0 + step * np.arange(3), u0 + step * np.arange(40), indexing="ij")
    d = np.stack([u.ravel(), v.ravel()])
    np.testing.assert_allclose(window, np.exp(-0.5 * np.einsum("ik,ij,jk->k", d, A, d)), rtol=1e-9, atol=1e-100)


def test_the_exponential_has_the_precision_of_floating_point_numbers():
    x = np.concatenate([np.linspace(-699, 699, 20_001), [0.0, -1e-300, 1e-9]])
    np.testing.assert_allclose([exponential(float(a)) for a in x], np.exp(x), rtol=5e-16)
    assert exponential(-1e9) == exponential(-700.0) < 1e-300


@pytest.mark.parametrize(
    ("sigma", "tolerance"),
    [(0.25, 1e-4), (0.42, 1e-4), (0.5, 1e-4), (0.8, 1e-4), (0.95, 4e-4), (1.5, 3e-4), (3.0, 1e-4)],
)
@pytest.mark.parametrize("phase", [0.0, 0.23, 0.5])
def test_pixels_integrate_the_gaussian(sigma, tolerance, phase):
    """Round spots factorise, so the error function gives the exact integral."""
    cells, algebra = workspace()
    spot = candidate(10 + phase, 10.0, sigma**2, 0.0, sigma**2, 1.0, 0.0, 0.0, 0.0)
    accumulate(Window(0, 0, 21, 21, 1), spot, NOISE, cells, algebra)
    edges = np.arange(22) - 0.5

    def share(centre: float) -> np.ndarray:
        return np.diff(0.5 * erf((edges - centre) / (sigma * np.sqrt(2))))

    exact = np.outer(share(10.0), share(10 + phase)).reshape(-1)
    assert np.abs(cells[LIGHT, :441] - exact).max() < tolerance * exact.max()


def test_cells_of_two_pixels_are_means_of_four_and_have_states_for_clipped_and_missing_pixels():
    image = np.arange(400, dtype=np.uint16).reshape(20, 20)
    image[6, 6] = 65535
    window = window_around(4.5, 4.5, 3, 3, 2)
    values, state = np.zeros(49), np.zeros(49)
    read_window(pixels(image), window, 65535.0, values, state)
    u, v = window.left + 6 * 2 + 0.5, window.top + 6 * 2 + 0.5
    assert values[-1] == pytest.approx(20 * v + u)  # the mean of a plane is its value at the centre
    assert state[0] == OUTSIDE
    assert (state == CLIPPED).sum() == 1


@pytest.mark.parametrize("minor", [0.5, 1.2, 2.0])
def test_the_normal_equations_agree_with_numerical_derivatives(minor):
    """With derivatives with respect to the nine parameters the decrease of chi-square is the same."""
    rng = np.random.default_rng(0)
    spot = candidate(9.7, 10.4, *shape_of(2.1, minor, 30.0), 900.0, 12.0, 0.1, -0.2)
    window, (cells, algebra) = Window(2, 3, 17, 15, 1), workspace()
    n = 17 * 15
    cells[0, :n] = rng.uniform(0, 50, n)
    J = np.zeros((9, n))
    for p, name in enumerate(FITTED):
        sides = []
        for sign in (1, -1):
            moved = spot.copy()
            moved[name] += sign * 1e-4
            accumulate(window, moved, NOISE, cells, algebra)
            sides.append(-cells[RESIDUAL, :n])
        J[p] = (sides[0] - sides[1]) / 2e-4
    accumulate(window, spot, NOISE, cells, algebra)
    weight, rest = cells[WEIGHT, :n].copy(), cells[RESIDUAL, :n].copy()
    step = np.linalg.solve((J * weight) @ J.T, (J * weight) @ rest)
    X = np.zeros((9, 10))
    X[:, 0] = algebra[VECTORS, RIGHT_SIDE, :9]
    assert solve_normal(algebra[NORMAL], X, 1, np.zeros((9, 10)))
    gain = X[:, 0] @ algebra[VECTORS, RIGHT_SIDE, :9]
    assert gain == pytest.approx(step @ ((J * weight) @ rest), rel=3e-3)


def start(spot: Spot, background: float) -> np.ndarray:
    table = np.zeros(1, CANDIDATE)
    table["moment_u"], table["moment_v"], table["background"] = np.rint(spot.u), np.rint(spot.v), background
    return table


def test_without_noise_the_moments_are_close_to_the_truth_and_the_fit_reaches_it():
    spot = Spot(40.3, 30.8, 20_000.0, 3.1, 1.7, 25.0)
    image = pixels(np.rint(expected(Scene([spot], (80, 60), 1000.0, (300.0, 200.0)))).astype(np.uint16))
    cells, algebra = workspace()
    table = start(spot, 1000.0)
    find_moments(image, table, cells)
    assert np.abs(numbers(table[0], "moment_u", "moment_v") - [40.3, 30.8]).max() < 0.1 * px
    fit_all(image, table, Noise(1.0, 1.0, 1000.0, 0.0, 0.0, 0.0), 65535.0, 20.0, 0.0, False, True, cells, algebra)
    assert np.abs(numbers(table[0], "u", "v") - [40.3, 30.8]).max() < 2e-4 * px
    assert ellipse.axes(*numbers(table[0], "uu", "uv", "vv")) == pytest.approx((3.1, 1.7, 25.0), abs=0.01)
    assert table[0]["flux"] == pytest.approx(spot.flux, rel=1e-3)


def fitted(scene: Scene, seed: int, spot: Spot, hot: tuple[int, int] | None = None) -> np.ndarray:
    rng = np.random.default_rng(seed)
    image = expose(expected(scene, rng), scene, rng)
    if hot:
        image[hot[1], hot[0]] = 200
    cells, algebra = workspace()
    table = start(spot, scene.background)
    find_moments(pixels(image), table, cells)
    fit_all(pixels(image), table, NOISE, 255.0, 20.0, 0.0, False, True, cells, algebra)
    return table[0]


@pytest.mark.parametrize("hot", [(34, 30), (32, 27), (30, 31)])
def test_a_hot_pixel_beside_or_in_a_spot_does_not_shift_it(hot):
    spot = Spot(30.3, 29.6, 100.0, 2.2, 2.0)
    clean, with_hot_pixel = (fitted(Scene([spot], (64, 60)), 5, spot, h) for h in (None, hot))
    sigma = np.sqrt(numbers(clean, "var_u", "var_v"))
    assert (np.abs(numbers(clean, "u", "v") - numbers(with_hot_pixel, "u", "v")) < 1.0 * sigma).all()
    assert with_hot_pixel["chi2"] < 1.4


def test_a_flat_topped_spot_keeps_its_small_sigma_and_a_speckled_one_does_not():
    """A symmetric misfit does not shift the centre; an asymmetric one does."""
    streak, plain = Spot(30.4, 30.2, 180.0, 1.8, 1.8, 20.0, streak=12.0), Spot(30.4, 30.2, 180.0, 2.5, 2.5)
    flat = fitted(Scene([streak], (64, 60)), 1, streak)
    speckled = fitted(Scene([plain], (64, 60), speckle=0.2), 1, plain)
    smooth = fitted(Scene([plain], (64, 60)), 1, plain)
    assert flat["chi2"] > 1.2
    scene = Scene([streak], (64, 60))
    assert numbers(flat, "var_u", "var_v").sum() < 1.5 * np.trace(bound(streak, scene, expected(scene)))
    assert numbers(speckled, "var_u", "var_v").sum() > 9 * numbers(smooth, "var_u", "var_v").sum()
    assert abs(smooth["cov_uv"]) < smooth["var_u"]


def test_a_candidate_that_diverges_is_rejected():
    image = np.full((80, 80), 20, np.uint8)
    image[:, 40:] = 200  # an edge without a spot
    cells, algebra = workspace()
    table = start(Spot(40.0, 40.0, 1.0), 20.0)
    table["moment_uu"], table["moment_uv"], table["moment_vv"], table["flux"] = 4.0, 0.0, 4.0, 4000.0
    fit_all(pixels(image), table, NOISE, 255.0, 5.0, 0.0, False, True, cells, algebra)
    assert table[0]["flux"] == 0.0


@settings(max_examples=40)
@given(st.integers(0, 10**6))
def test_the_solution_of_the_normal_equations_agrees_with_numpy(seed):
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(9, 40)) * 10.0 ** rng.uniform(-4, 4, (9, 1))
    N, X = np.zeros((9, 10)), np.zeros((9, 10))
    N[:, :9], X[:, :2] = half @ half.T, half @ rng.normal(size=(40, 2))
    right = X[:, :2].copy()
    assert solve_normal(N, X, 2, np.zeros((9, 10)))
    np.testing.assert_allclose(X[:, :2], np.linalg.solve(N[:, :9], right), rtol=1e-5, atol=1e-12)


@pytest.mark.parametrize(("sigma", "lock"), [(0.5, 5e-4), (0.8, 5e-4), (1.0, 5e-4), (2.0, 2e-4)])
def test_centres_are_not_biased_towards_pixel_centres(sigma, lock):
    """Without noise the error depends only on the phase within the pixel; 16 bits make rounding negligible."""
    for phase in np.linspace(-0.5, 0.5, 9):
        spot = Spot(30 + phase, 30.2 - phase, 30_000.0, sigma, sigma)
        image = pixels(np.rint(expected(Scene([spot], (61, 61), 1000.0))).astype(np.uint16))
        cells, algebra = workspace()
        table = start(spot, 1000.0)
        find_moments(image, table, cells)
        fit_all(image, table, Noise(100.0, 0.1, 1000.0, 0.0, 0.0, 0.0), 65535.0, 20.0, 0.0, False, True, cells, algebra)
        assert np.abs(numbers(table[0], "u", "v") - [spot.u, spot.v]).max() < lock * px
