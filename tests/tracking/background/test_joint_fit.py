"""A light that hardly moves is separated from what stands behind it, and what that does to the light is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from geometry.arrays import Array
from tests.marks import further_slow
from tracking.background.behind_lights import BehindLights, Exposures, passing_lights
from tracking.background.joint_fit import JointFit, Modulation, fitted, mean_of
from tracking.detection.detect import find_spots
from tracking.detections import Detections
from tracking.noise import NoiseModel
from tracking.parameters import DetectParameters

SIDE, NOISE = 41, 0.8  # px, DN
MIDDLE = 0.5 * (SIDE - 1)
Y, X = (x.astype(float) for x in np.mgrid[:SIDE, :SIDE])
UV = np.column_stack([X.ravel(), Y.ravel()])
EDGE = 15.0 + 45.0 / (1 + np.exp(-3 * (X + 0.4 * Y - 1.4 * MIDDLE - 1.0)))  # DN, through the middle
WIDTH, HEIGHT = 2.4, 90.0  # px, DN
NONE = np.zeros((0, SIDE * SIDE))  # pictures without the light
OFF = np.array([0.5, -0.3])  # px: of the places that a search found


def places(length_px: float, pictures: int = 15) -> Array:
    """Places (pictures, 2) about the middle, on a line."""
    return MIDDLE + np.linspace(-0.5, 0.5, pictures)[:, None] * length_px * np.array([0.6, 0.8])


def pictures(at: Array, background: Array, modulated: float, seed: int = 1, width_px: float = WIDTH) -> Array:
    """(n, h, w), DN: a light whose share is modulated by the background, 1 where that is 60 DN."""
    rng = np.random.default_rng(seed)
    response = 1 - modulated + modulated * background / 60.0
    light = [HEIGHT * np.exp(-0.5 * ((X - u) ** 2 + (Y - v) ** 2) / width_px**2) for u, v in at]
    return np.array([background + response * one + NOISE * rng.standard_normal(X.shape) for one in light])


def fit_of(seen: Array, start: Array, empty: Array | None = None) -> JointFit | None:
    values = seen.reshape(len(seen), -1)
    variance = np.full(values.shape, NOISE**2)
    return fitted(UV, values, variance, start, 3.0, 0.7 * HEIGHT, mean_of(NONE if empty is None else empty, variance))


@pytest.mark.parametrize("modulated", [0.0, 0.6, 0.9])
@pytest.mark.parametrize("length_px", [1.5, 5.0, 20.0])
def test_a_light_that_moves_by_half_its_width_is_separated_from_an_edge_under_it(length_px, modulated):
    at = places(length_px)
    seen = pictures(at, EDGE, modulated)
    fit = fit_of(seen, at + OFF)
    assert fit is not None
    behind, _, _ = fit.behind(
        UV, seen.reshape(len(seen), -1), np.full((len(seen), len(UV)), NOISE**2), mean_of(NONE, NONE)
    )
    assert np.abs(fit.light.places.mean(axis=0) - MIDDLE).max() < 0.1
    assert np.abs(fit.light.places - at).max() < 0.2
    assert np.sqrt(np.mean((behind.reshape(X.shape) - EDGE) ** 2)) < 0.7
    share, variance = fit.modulated_share(60.0)
    assert abs(share - modulated) < max(3 * np.sqrt(variance), 0.1)


@pytest.mark.parametrize("times", [64.0, 257.0])
def test_a_fit_is_the_same_in_any_unit_of_the_grey_values(times):
    """Sums of 8x8 pixels, and pictures of 16 bits, have larger numbers for the same light."""
    at = places(3.0)
    seen = pictures(at, EDGE, 0.6).reshape(len(at), -1)
    variance = np.full(seen.shape, NOISE**2)
    once, scaled = (
        fitted(UV, f * seen, f**2 * variance, at + OFF, 3.0, f * 0.7 * HEIGHT, mean_of(NONE, variance))
        for f in (1.0, times)
    )
    assert once is not None
    assert scaled is not None
    assert scaled.light.places == pytest.approx(once.light.places, abs=1e-3)
    assert scaled.light.plain == pytest.approx(times * once.light.plain, rel=1e-3)


def test_a_light_at_rest_on_an_edge_is_not_separated_unless_some_pictures_show_the_edge_without_it():
    at = places(0.0)
    seen = pictures(at, EDGE, 0.6)
    assert fit_of(seen, at + OFF) is None
    empty = EDGE.ravel() + NOISE * np.random.default_rng(4).standard_normal((4, SIDE * SIDE))
    fit = fit_of(seen, at + OFF, empty)
    assert fit is not None
    assert np.abs(fit.light.places.mean(axis=0) - MIDDLE).max() < 0.05
    assert abs(fit.modulated_share(60.0)[0] - 0.6) < 0.1


def test_the_error_that_all_places_share_is_stated_and_not_much_larger_than_it_is():
    """In addition to their own noise, which the mean of n places has to 1 / n: it would count twice."""
    noise, at, mean2, stated = 4 * NOISE, places(12.0), [], []
    for seed in range(10):
        more = np.random.default_rng(100 + seed).standard_normal((len(at), SIDE, SIDE))
        seen = pictures(at, EDGE, 0.6, seed) + np.sqrt(noise**2 - NOISE**2) * more
        values = seen.reshape(len(seen), -1)
        variance = np.full(values.shape, noise**2)
        fit = fitted(UV, values, variance, at + OFF, 3.0, 0.7 * HEIGHT, mean_of(NONE, variance))
        assert fit is not None
        error = fit.light.places - at
        mean2.append(np.mean(error.mean(axis=0) ** 2))
        stated.append((fit.share + 1 / len(at)) * np.mean(error.var(axis=0, ddof=1)))
    assert 0.75 < np.mean(mean2) / np.mean(stated) < 1.4


def test_pictures_scaled_to_equal_light_of_the_room_show_lights_of_other_strengths():
    """A drift of the room's light by 30 % while the spot moves over a gentle slope: that is no modulation."""
    at, slope = places(8.0), 20.0 + 0.3 * (X - MIDDLE)
    room = np.linspace(0.85, 1.15, len(at))
    rng = np.random.default_rng(2)
    light = pictures(at, slope, 0.4, 1) - slope
    seen = slope + light / room[:, None, None] + 0.1 * NOISE * rng.standard_normal(light.shape)
    values = seen.reshape(len(seen), -1)
    variance = np.full(values.shape, NOISE**2)
    none = mean_of(NONE, variance)
    fit = fitted(UV, values, variance, at + OFF, 3.0, 0.7 * HEIGHT, none, strength=1 / room[:, None])
    assert fit is not None
    assert np.abs(fit.light.places - at).max() < 0.1
    share, variance = fit.modulated_share(20.0)
    assert abs(share - 0.4 * 20 / 60 / (0.6 + 0.4 * 20 / 60)) < max(3 * np.sqrt(variance), 0.1)
    alike = fitted(UV, values, variance, at + OFF, 3.0, 0.7 * HEIGHT, none)
    assert alike is None or np.abs(alike.light.places - at).max() > 0.2


def test_pictures_without_a_light_give_no_fit():
    seen = EDGE + NOISE * np.random.default_rng(3).standard_normal((15, SIDE, SIDE))
    assert fit_of(seen, places(3.0)) is None


def test_the_modulation_that_one_light_shows_helps_with_the_others():
    assert Modulation(0.5, 40.0).at(40.0)[0] == pytest.approx(0.5)
    assert Modulation(0.5, 40.0).at(10.0)[0] == pytest.approx(0.2)
    at = places(6.0)
    seen = np.rint(pictures(at, EDGE, 0.6))
    noise = NoiseModel(NOISE**2, 0.0, 15.0)
    even = np.rint(pictures(at, np.full(X.shape, 20.0), 0.6)).astype(np.uint8)
    found = [find_spots(p, DetectParameters(), noise) for p in even]
    box = np.array([[MIDDLE, MIDDLE, 9.0]])
    behind = BehindLights.of(Exposures(list(seen), np.ones(np.shape(seen)[:2]), noise, 40.0, 0.0), found, box)
    expected = 0.6 * 40 / 60 / (0.4 + 0.6 * 40 / 60)
    assert behind.modulation is not None
    assert behind.modulation.share == pytest.approx(expected, abs=0.1)
    assert np.abs(behind.level_dn - EDGE[behind.row, behind.column]).max() < 3.0
    nowhere = BehindLights.of(
        Exposures(list(seen), np.ones(np.shape(seen)[:2]), noise, 40.0, 0.0), found, np.array([[3.0, 3.0, 2.0]])
    )
    assert nowhere.modulation is None
    assert not nowhere.covers((SIDE, SIDE)).any()


@pytest.mark.parametrize(("modulated", "others"), [(0.0, 0.0), (0.6, 0.0), (0.6, 0.3)])
def test_lights_that_pass_over_edges_show_the_modulation_and_how_unlike_their_places_are(modulated, others):
    """Every other one lies on ground that modulates it by another share."""
    rng, side = np.random.default_rng(6), 240
    y, x = np.mgrid[:side, :side].astype(float)
    ground = (20.0 + 40.0 * (np.sin(x / 6) > 0)).astype(np.float32)
    at = np.array([[40.0 + 12 * k, 40.0 + 14 * (k % 5)] for k in range(12)])
    found, seen = [], []
    for k, (u, v) in enumerate(at):
        own = modulated - others * (k % 2)
        light = (1 - own + own * ground / 60) * HEIGHT * np.exp(-0.5 * ((x - u) ** 2 + (y - v) ** 2) / WIDTH**2)
        seen.append(ground + light + NOISE * rng.standard_normal(ground.shape))
        spot = Detections.at(np.array([[u, v]]) + OFF, np.eye(2)[None])
        found.append(replace(spot, major_px=np.array([2.6]), minor_px=np.array([2.3]), peak=np.array([80.0])))
    count = np.full(ground.shape, 11)
    pictures = Exposures(seen, np.ones(np.shape(seen)[:2]), NoiseModel(NOISE**2, 0.0, 15.0), 60.0, 0.0)
    fits = passing_lights(pictures, found, ground, count)
    box = np.array([[3.0, 3.0, 2.0]])
    shown = BehindLights.of(pictures, found, box, fits).modulation
    assert shown is not None
    assert shown.share == pytest.approx(modulated - 0.5 * others, abs=0.03 + 0.6 * others)
    assert (shown.unlike > 0.1) == (others > 0)
    even = np.full_like(ground, 30.0)
    assert not passing_lights(pictures, found, even, count)


@pytest.mark.parametrize("modulated", [0.0, 0.3])
def test_lights_on_ground_of_low_light_hardly_show_what_usual_ground_modulates(modulated):
    """A tenth as bright as usual: what is expected before any light is seen must not count as seen."""
    side, usual_dn = 160, 25.0
    y, x = np.mgrid[:side, :side].astype(float)
    ground = gaussian_filter(1.5 + 2.0 * (np.sin(x / 4 + y / 9) > 0), 0.5).astype(np.float32)
    for seed in range(5):
        rng = np.random.default_rng(seed)
        found, seen = [], []
        for k in range(12):
            u, v = np.array([25.0 + 10 * k, 30.0 + 20 * (k % 5)]) + rng.uniform(-1, 1, 2)
            light = 26.0 * (1 - modulated + modulated * ground / usual_dn)
            light *= np.exp(-0.5 * ((x - u) ** 2 + (y - v) ** 2) / 1.1**2)
            seen.append(ground + light + 0.5 * rng.standard_normal(ground.shape))
            spot = Detections.at(np.array([[u, v]]), np.eye(2)[None])
            found.append(replace(spot, major_px=np.array([1.1]), minor_px=np.array([1.1]), peak=np.array([24.0])))
        pictures = Exposures(seen, np.ones(np.shape(seen)[:2]), NoiseModel(0.25, 0.0, 0.0), usual_dn, 0.0)
        fits = passing_lights(pictures, found, ground, np.full(ground.shape, 11))
        shown = BehindLights.of(pictures, found, np.array([[3.0, 3.0, 2.0]]), fits).modulation
        assert shown is None or abs(shown.share - modulated) < 2.5 * shown.unlike


@pytest.mark.parametrize("modulated", [0.0, 0.8])
def test_lights_on_smooth_structure_are_modulated_by_as_much_as_they_show(modulated):
    """The errors of the mean look like fine structure that modulates: what is smooth shows nothing."""
    side, usual_dn = 160, 20.0
    y, x = np.mgrid[:side, :side].astype(float)
    off = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        structure = gaussian_filter(rng.standard_normal(x.shape), 8.0)
        ground = usual_dn + 3.0 * structure / structure.std()
        mean = (ground + 1.5 / 11**0.5 * rng.standard_normal(x.shape)).astype(np.float32)
        found, seen = [], []
        for k in range(12):
            u, v = np.array([25.0 + 10 * k, 30.0 + 20 * (k % 5)]) + rng.uniform(-1, 1, 2)
            light = 130.0 * (1 - modulated + modulated * ground / usual_dn)
            light *= np.exp(-0.5 * ((x - u) ** 2 + (y - v) ** 2) / 3.4**2)
            noise2 = 2.2 + 0.05 * light
            seen.append(ground + light + np.sqrt(noise2) * rng.standard_normal(x.shape))
            spot = Detections.at(np.array([[u, v]]) + 0.1, np.eye(2)[None])
            found.append(replace(spot, major_px=np.array([3.4]), minor_px=np.array([3.4]), peak=np.array([125.0])))
        pictures = Exposures(seen, np.ones(np.shape(seen)[:2]), NoiseModel(1.25, 0.05, 0.0), usual_dn, 0.0)
        fits = passing_lights(pictures, found, mean, np.full(x.shape, 11))
        shown = BehindLights.of(pictures, found, np.array([[3.0, 3.0, 2.0]]), fits).modulation
        off += [] if shown is None else [(shown.share - modulated) / shown.unlike]
    assert np.sqrt(np.mean(np.square(off or [0.0]))) < 2.0


@pytest.mark.parametrize("length_px", further_slow([3.0, 1.5]))
def test_a_light_that_flickers_by_a_percent_is_measured_as_precisely_as_one_that_does_not(length_px):
    """On texture as fine as the light, which the surface modulates in full."""
    rng = np.random.default_rng(8)
    squares: list[list[float]] = [[], []]
    for seed in range(10):
        grain = gaussian_filter(rng.standard_normal(X.shape), 3.0)
        ground = 20.0 * (1 + 0.04 * grain / np.std(grain))
        at, flicker = places(length_px), 0.01 * rng.standard_normal((15, 1, 1))
        steady = pictures(at, ground, 0.0, seed)
        light = HEIGHT * np.exp(-0.5 * ((X - at[:, :1, None]) ** 2 + (Y - at[:, 1:, None]) ** 2) / WIDTH**2)
        for own, share in zip(squares, (0 * flicker, flicker), strict=True):
            seen = steady + ((ground / 20.0) * (1 + share) - 1) * light
            fit = fit_of(seen, at + OFF)
            assert fit is not None
            own.append(float(np.mean((fit.light.places - at) ** 2)))
    still, flickers = np.sqrt(np.mean(squares, axis=1))
    assert flickers < 1.25 * still


def test_light_modulates_light_and_the_black_level_is_none():
    """The surface modulates the lights in full; 12 of its 30 grey values are there without light."""
    rng, at = np.random.default_rng(9), places(10.0)
    ground = 18.0 * (1 + 0.3 * np.sin(X / 4))
    noisy = [12.0 + ground / 18.0 * (18.0 + light) for light in pictures(at, 0 * X, 0.0, 3)]
    seen = [p + NOISE * rng.standard_normal(p.shape) for p in noisy]
    found = [Detections.at(uv[None] + OFF, np.eye(2)[None]) for uv in at]
    found = [replace(d, major_px=np.array([2.6]), minor_px=np.array([2.3]), peak=np.array([80.0])) for d in found]
    found = [replace(d, flux=np.array([1000.0])) for d in found]
    noise, box = NoiseModel(NOISE**2, 0.0, 30.0), np.array([[MIDDLE, MIDDLE, 9.0]])
    shown = [
        BehindLights.of(
            Exposures(seen, np.ones(np.shape(seen)[:2]), noise, 30.0 - black_dn, black_dn), found, box
        ).modulation
        for black_dn in (0.0, 12.0)
    ]
    more = [m.response(np.array([30.0, 33.6])) for m in shown if m is not None]  # a fifth more light
    assert more[-1] == pytest.approx([1.0, 1.2], abs=0.02)
    assert len(more) == 1 or more[0][1] < 1.17


def test_ground_whose_structure_is_no_more_than_its_noise_hardly_shows_how_it_modulates_a_light():
    """The background behind the light is known to its noise only; that modulates nothing."""
    off = []
    for seed in range(24):
        grain = gaussian_filter(np.random.default_rng([seed, 7]).standard_normal(X.shape), 1.0)
        ground = 50.0 + 0.2 * grain / grain.std()
        at = places(20.0)
        fit = fit_of(pictures(at, ground, 0.4, seed), at + OFF)
        assert fit is not None
        share, variance = fit.shown
        modulated = 0.4 * fit.level_dn / 60.0
        off.append((share - modulated / (0.6 + modulated)) / np.sqrt(variance))
    assert np.sqrt(np.mean(np.square(off))) < 1.5


def test_a_plane_says_less_of_an_edge_than_of_grain_that_is_as_strong():
    """Of an edge all pixels err from a plane together, of grain each by itself."""
    at = places(5.0)
    about = np.column_stack([UV, np.ones(len(UV))])
    rough = EDGE.ravel() - about @ np.linalg.lstsq(about, EDGE.ravel(), rcond=None)[0]
    grain = EDGE.mean() + np.random.default_rng(5).permutation(rough).reshape(EDGE.shape)
    of_edge, of_grain = (fit_of(pictures(at, ground, 0.3), at + OFF) for ground in (EDGE, grain))
    assert of_edge is not None
    assert of_grain is not None
    assert (of_edge.light.texture_dn > 2.0 * of_grain.light.texture_dn).all()


def test_a_light_on_an_even_square_is_placed_by_the_square_whatever_stands_beside_it():
    """The light of a hole of its own shape in the ground, and more of its own, is no explanation of the pictures."""
    inside = np.maximum(np.abs(X - MIDDLE), np.abs(Y - MIDDLE)) < 14.0
    off = []
    for seed in range(6):
        at = places(1.5)
        fit = fit_of(pictures(at, np.where(inside, 50.0, 10.0), 0.4, seed, 3.5), at + OFF)
        assert fit is not None
        off.append(fit.light.places - at)
    assert np.sqrt(np.mean(np.square(off))) < 0.026


def test_a_light_with_a_single_pixel_of_the_ground_beside_it_is_fitted_or_refused():
    """Near others, or in the mosaic of a colour camera, little of the ground is left."""
    at = places(0.0, 1)
    away = np.hypot(*(UV - at[0]).T)
    some = away < 1.9 * WIDTH
    some[np.argmin(np.abs(away - 2.6 * WIDTH))] = True
    values = pictures(at, 50.0 + 0 * X, 0.4).reshape(1, -1)[:, some]
    variance = np.full(values.shape, NOISE**2)
    fit = fitted(UV[some], values, variance, at, WIDTH, HEIGHT, (np.full(some.sum(), 50.0), 15 / variance[0]))
    assert fit is None or np.abs(fit.light.places - at).max() < 0.1
