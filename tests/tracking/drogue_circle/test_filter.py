"""The filter of the circle: textbook equations, and what is wrong with the printed ones."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.stats import norm

from tests.tracking.drogue_circle.discs import BLUR_PX, covered, discs, rounded
from tracking.drogue_circle.kalman import FilterBank, MotionModel, motion_models, printed_coefficient, printed_step
from tracking.drogue_circle.occlusion import disc_cells, first_appearance
from tracking.kalman import process_noise, propagate, transition, update

SIGMA = np.array([0.3, 0.3, 0.05])


def test_the_process_noise_is_that_of_an_acceleration_constant_in_a_step():
    a = np.random.default_rng(0).normal(0, SIGMA, (200_000, 3))
    moved = np.concatenate([0.5 * 4 * a, 2 * a], axis=1)  # dt = 2: dt^2/2 and dt
    np.testing.assert_allclose(process_noise(SIGMA, 2.0), np.cov(moved.T), atol=0.01)


@pytest.mark.parametrize("dt", [1.0, 3.0])
def test_a_jerk_constant_in_a_step_acts_on_place_rate_and_acceleration(dt):
    """Of any size and along any axis; the place after many short steps of the motion is the same."""
    jerk = np.array([0.02, 0.05, 0.01])
    place, rate, acceleration = np.zeros(3), np.zeros(3), np.zeros(3)
    steps = 20_000
    for _ in range(steps):
        acceleration = acceleration + jerk * dt / steps
        rate = rate + acceleration * dt / steps
        place = place + rate * dt / steps
    noise = MotionModel(np.zeros(3), jerk).noise(dt)
    moved = np.stack([place, rate, acceleration])  # 1 sigma of each state, all of one jerk
    for axis in range(3):
        rows = [axis, 3 + axis, 6 + axis]
        np.testing.assert_allclose(noise[np.ix_(rows, rows)], np.outer(moved[:, axis], moved[:, axis]), rtol=1e-3)


def test_a_measurement_counts_as_in_the_information_form():
    rng = np.random.default_rng(1)
    root = rng.normal(size=(6, 6))
    x, P, z, R = rng.normal(size=6), root @ root.T, rng.normal(size=3), np.diag([0.2, 0.3, 0.1])
    H = np.eye(3, 6)
    got_x, got_P = update(x, P, z, R)
    want_P = np.linalg.inv(np.linalg.inv(P) + H.T @ np.linalg.inv(R) @ H)
    np.testing.assert_allclose(got_P, want_P, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(got_x, x + want_P @ H.T @ np.linalg.solve(R, z - x[:3]), rtol=1e-9)


def test_a_bank_of_one_filter_is_that_filter():
    models = motion_models((0.3,), (), 0.15)
    z, R = np.array([10.0, 20.0, 5.0]), 0.01 * np.eye(3)
    bank = FilterBank.started(z, R, 2.0, models).predicted(1.0).updated(z + 1, R, 0.95)
    P = np.zeros((6, 6))
    P[:3, :3], P[3:, 3:] = R, np.diag([2.0, 2.0, 0.3]) ** 2
    Q = process_noise(np.array([0.3, 0.3, 0.045]), 1.0)
    x, P = update(*propagate(np.array([*z, 0, 0, 0]), P, transition(1.0, 3), Q), z + 1, R)
    got_x, got_P = bank.state()
    np.testing.assert_allclose(got_x, x, rtol=1e-9)
    np.testing.assert_allclose(got_P, P, rtol=1e-9, atol=1e-12)


def test_a_steady_acceleration_is_extrapolated():
    bank = FilterBank.started(np.array([0.0, 0, 20]), 1e-4 * np.eye(3), 2.0, motion_models((0.02, 0.3), (0.003,), 0.15))
    for k in range(1, 31):
        bank = bank.predicted(1.0).updated(np.array([0.05 * k**2, 0.0, 20.0]), 1e-4 * np.eye(3), 0.95)
    ahead = bank.predicted(8.0).state()[0]
    assert ahead[0] == pytest.approx(0.05 * 38**2, abs=0.3)  # constant rates would miss it by 3 px


def test_the_printed_coefficient_is_zero_one_frame_after_an_occlusion_begins():
    areas = [1000.0, 1000.0, 500.0, 500.0, 1000.0]
    gamma = [printed_coefficient(now, before) for before, now in pairwise(areas)]
    assert gamma == [0.0, 0.5, 0.0, 1.0]
    assert printed_coefficient(0.0, 0.0) == 1.0


def test_as_printed_a_clear_target_is_not_filtered():
    x, P = np.zeros(6), np.eye(6)
    z = np.array([3.0, -2.0, 1.0])
    after, _ = printed_step(x, P, 1.0, z, 0.0, 0.5)  # gamma = 0: R = 0
    np.testing.assert_allclose(after[:3], z, atol=1e-9)


def test_the_occlusion_coefficient_is_the_hidden_share_of_the_area():
    cells = disc_cells(discs([(80.0, 60.0, 30.0)]), 80.0, 60.0, 30.0)
    appearance = first_appearance(*cells)
    for seed in range(1, 9):
        appearance = appearance.updated(*disc_cells(discs([(80.0, 60.0, 30.0)], seed=seed), 80.0, 60.0, 30.0))
    half = disc_cells(covered(discs([(80.0, 60.0, 30.0)]), (0, 80), (0, 120)), 80.0, 60.0, 30.0)
    whole = disc_cells(covered(discs([(80.0, 60.0, 30.0)]), (0, 160), (0, 120)), 80.0, 60.0, 30.0)
    assert appearance.coefficient(*cells) < 0.05
    assert appearance.coefficient(*half) == pytest.approx(0.5, abs=0.06)
    assert appearance.coefficient(*whole) > 0.9
    sectors = appearance.hidden_sectors(*half)  # the left half: angles beyond 90 degrees on both sides
    assert not sectors[:7].any()
    assert sectors[9:23].all()


def seen_clear(radius, first=0):
    """The appearance after ten clear frames of a disc that grows by .02 px in each, and its last radius."""
    appearance = first_appearance(*disc_cells(discs([(80.0, 60.0, radius)], seed=first), 80.0, 60.0, radius))
    for k in range(1, 10):
        radius += 0.02
        cells = disc_cells(discs([(80.0, 60.0, radius)], seed=first + k), 80.0, 60.0, radius)
        appearance = appearance.updated(*cells)
    return appearance, radius


@pytest.mark.parametrize("radius", [16.0, 30.0, 45.0])
@pytest.mark.parametrize("columns", [(0, 68), (0, 80), (76, 88)])
def test_the_blurred_outline_of_an_occluder_hides_half_of_its_width(radius, columns):
    """To .02 of the area, .06 of a small one: before, each cell that the outline touches was hidden (.03 to .13)."""
    appearance, radius = seen_clear(radius)
    light = discs([(80.0, 60.0, radius)], noise=0.0).astype(float)
    edges = np.array(columns) - 0.5
    x = np.arange(160.0)
    plate = norm.cdf((x - edges[0]) / BLUR_PX) - norm.cdf((x - edges[1]) / BLUR_PX)
    picture = rounded(light + plate * (60.0 - light) + np.random.default_rng(5).normal(0, 1.5, light.shape))
    fine = np.linspace(-1, 1, 2001) * radius
    chords = 2 * np.sqrt(radius**2 - fine**2)
    hidden = chords[(80 + fine > edges[0]) & (80 + fine < edges[1])].sum() / chords.sum()
    assert appearance.coefficient(*disc_cells(picture, 80.0, 60.0, radius)) == pytest.approx(
        hidden, abs=0.02 if radius > 20 else 0.06
    )


@pytest.mark.parametrize("radius", [14.8, 24.8])
def test_a_target_that_grows_looks_as_before(radius):
    """Before, the filter of the cells changed by a pixel at once, at 15 and 25 px: .07 and more of a clear target."""

    def picture(radius, seed):
        y, x = np.mgrid[:120, :160]
        away = np.hypot(x - 80.0, y - 60.0)
        light = 150 - 60 * norm.cdf((away - radius) / 0.8) - 80 * norm.cdf((0.55 * radius - away) / 0.8)
        return rounded(light + np.random.default_rng(seed).normal(0, 1.0, light.shape))

    appearance = first_appearance(*disc_cells(picture(radius, 0), 80.0, 60.0, radius))
    for k in range(1, 40):
        radius += 0.02
        cells = disc_cells(picture(radius, k), 80.0, 60.0, radius)
        assert appearance.coefficient(*cells) < 0.04
        appearance = appearance.updated(*cells)


def test_a_probe_that_comes_slowly_does_not_become_part_of_the_appearance():
    disc = [(80.0, 60.0, 30.0)]
    appearance = first_appearance(*disc_cells(discs(disc), 80.0, 60.0, 30.0))
    for k in range(10):
        appearance = appearance.updated(*disc_cells(discs(disc, seed=k), 80.0, 60.0, 30.0))
    for k in range(130):  # half a pixel per frame, then at rest over the left half
        cells = disc_cells(covered(discs(disc, seed=k), (0, min(50 + k // 2, 80)), (0, 120)), 80.0, 60.0, 30.0)
        appearance = appearance.updated(*cells)
    assert appearance.coefficient(*cells) == pytest.approx(0.5, abs=0.06)


def test_an_approach_and_a_small_change_of_the_light_are_no_occlusions():
    appearance = first_appearance(*disc_cells(discs([(80.0, 60.0, 30.0)]), 80.0, 60.0, 30.0))
    larger = disc_cells(discs([(80.0, 60.0, 45.0)]), 80.0, 60.0, 45.0)
    brighter = disc_cells(discs([(80.0, 60.0, 30.0)]) + np.uint8(6), 80.0, 60.0, 30.0)
    assert appearance.coefficient(*larger) < 0.05
    assert appearance.coefficient(*brighter) < 0.05
