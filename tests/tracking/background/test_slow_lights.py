"""Spots in front of boards: found on edges, also where they hardly move, with sigmas that follow the background."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from geometry.arrays import Array
from tests.marks import further_slow
from tests.tracking.rendering import round_lights
from tracking.background.behind_lights import BehindLights, Exposures, _lights_of
from tracking.background.estimation import PICTURES, static_background
from tracking.background.lights_on_edges import with_lights_on_edges
from tracking.background.slow_lights import light_at
from tracking.background.static_background import StaticBackground
from tracking.detection.detect import find_spots
from tracking.detections import Detections
from tracking.noise import NoiseModel, Picture
from tracking.noise_estimation.photon_transfer import NoiseEstimate, estimate_noise
from tracking.parameters import DetectParameters

SIZE, CELL = (320, 400), 40
BLACK, WHITE, NOISE = 14.0, 70.0, 0.8  # DN
USUAL = DetectParameters(saturation_dn=255.0)
Y, X = np.mgrid[: SIZE[0], : SIZE[1]]
BOARD = BLACK + (WHITE - BLACK) / (1 + np.exp(-3 * np.sin(np.pi * X / CELL) * np.sin(np.pi * Y / CELL) * CELL / 4))


def board_pictures(paths: Array, sigma_px: float, modulated: float, seed: int, board: Array = BOARD) -> list[Picture]:
    """Pictures of spots at places (pictures, spots, 2), whose light the board modulates by this share."""
    rng = np.random.default_rng(seed)
    response = 1 - modulated * (1 - board / WHITE)
    pictures = []
    for at in paths:
        light = round_lights(SIZE, at, 90.0, sigma_px)
        pictures.append(np.clip(np.rint(board + response * light + NOISE * rng.standard_normal(SIZE)), 0, 255))
    return [p.astype(np.uint8) for p in pictures]


def background_of(pictures: list[Picture]) -> tuple[StaticBackground, NoiseEstimate]:
    estimate = estimate_noise(pictures[:2] + pictures[-2:])
    some = pictures[:: len(pictures) // PICTURES][:PICTURES]
    background = static_background(some, estimate.model, estimate.texture_shift, USUAL)
    assert background is not None
    return background, estimate


def found_in_all(pictures: list[Picture]) -> list[Detections]:
    background, estimate = background_of(pictures)
    out = [background.found_in(p, USUAL, estimate.texture_shift) for p in pictures]
    return [d for d in out if d is not None]


def errors(found: list[Detections], paths: Array) -> tuple[Array, Array]:
    """Distances (pictures, spots), px, of the nearest points to the spots, and their sigmas."""
    gap = np.array([[np.hypot(*(d.uv_px - at).T).min() for at in spots] for d, spots in zip(found, paths, strict=True)])
    nearest = [
        [int(np.hypot(*(d.uv_px - at).T).argmin()) for at in spots] for d, spots in zip(found, paths, strict=True)
    ]
    sigma = np.array([
        np.sqrt(0.5 * np.trace(d.cov_px2[rows], axis1=1, axis2=2)) for d, rows in zip(found, nearest, strict=True)
    ])  # fmt: skip
    return gap, sigma


def over_edges(pictures: int, length_px: float) -> Array:
    """Places (pictures, 4, 2) of spots that move by a length across edges of the board."""
    along = np.linspace(-0.5, 0.5, pictures)[:, None] * length_px * np.array([0.8, 0.6])
    return np.array([[80.0, 60.0], [180.0, 121.0], [300.0, 201.0], [199.0, 260.0]]) + along[:, None]


@pytest.mark.parametrize("length_px", further_slow([12.0, 25.0]))
def test_a_spot_that_moves_by_a_few_of_its_widths_over_an_edge_is_found_in_each_picture(length_px):
    paths = over_edges(45, length_px)
    gap, _ = errors(found_in_all(board_pictures(paths, 2.0, 0.0, 1)), paths)
    assert gap.max() < 0.5


@pytest.mark.parametrize("modulated", further_slow([0.0, 0.6, 0.3], fast=2))
def test_the_sigmas_follow_the_edges_whether_or_not_they_modulate_the_spots(modulated):
    paths = over_edges(45, 160.0)
    gap, sigma = errors(found_in_all(board_pictures(paths, 2.0, modulated, 2)), paths)
    even = sigma < np.quantile(sigma, 0.3)
    assert gap.max() < 0.15
    assert np.median(sigma[even]) < 0.03
    assert np.median(sigma[even]) < 0.3 * sigma.max()
    assert np.sqrt(np.mean((gap[even] / sigma[even]) ** 2) / 2) == pytest.approx(1.0, abs=0.25)
    assert np.sqrt(np.mean((gap / sigma) ** 2) / 2) < 1.25


@pytest.mark.parametrize("white", further_slow([40.0, 70.0]))
def test_spots_that_stay_in_front_of_bright_squares_are_measured_in_the_difference(white):
    """The squares resemble wide lights at rest, over which spots pass in all pictures; little else shows the board."""
    board = 4 + (white - 4) * (BOARD - BLACK) / (WHITE - BLACK)
    paths = np.array([[60.0, 60.0], [100.0, 100.0], [140.0, 60.0], [180.0, 100.0], [220.0, 140.0]])
    paths = paths + np.linspace(-0.5, 0.5, 45)[:, None, None] * [24.0, 18.0]
    gap, sigma = errors(found_in_all(board_pictures(paths, 3.0, 0.3, 6, board)), paths)
    assert gap.max() < 0.3
    assert np.sqrt(np.mean((gap / sigma) ** 2) / 2) < 1.25


@pytest.mark.parametrize("away_px", further_slow([4.0, 5.0]))
def test_a_narrow_light_beside_an_edge_that_becomes_brighter_and_moves_is_found(away_px):
    """A single picture does not show it beside the edge, and the background contains half of its light."""
    rng, board = np.random.default_rng(3), 33 + 31 * (BOARD - BLACK) / (WHITE - BLACK)
    at_rest = np.array([80.0, 120.0, 160.0, 240.0, 60.0, 100.0, 60.0, 140.0]).reshape(2, 4).T + np.array([away_px, 0.0])
    brighter = np.arange(45) % 3 == 1  # not in the pictures that the background is made from
    paths = at_rest + 0.3 * brighter[:, None, None]
    pictures = []
    for at, peak in zip(paths, np.where(brighter, 18.0, 9.0), strict=True):
        light = board + round_lights(SIZE, at, float(peak), 1.1) + rng.standard_normal(SIZE)
        pictures.append(np.clip(np.rint(light), 0, 255).astype(np.uint8))
    found = found_in_all(pictures)
    gap, sigma = errors([d for d, own in zip(found, brighter, strict=True) if own], paths[brighter])
    assert gap.max() < 1.0
    assert np.sqrt(np.mean((gap / sigma) ** 2) / 2) < 1.25


def test_a_wide_bright_spot_is_no_person_in_front_of_the_board():
    lamps = np.broadcast_to(np.array([[340.0, 40.0], [350.0, 280.0], [40.0, 280.0], [200.0, 40.0]]), (45, 4, 2))
    paths = np.concatenate([over_edges(45, 120.0)[:, :1] + [60.0, 60.0], lamps], axis=1)
    gap, _ = errors(found_in_all(board_pictures(paths, 9.0, 0.3, 3)), paths[:, :1])
    assert gap.max() < 3.0


def test_a_light_at_rest_is_marked_if_others_move():
    lamp = np.broadcast_to(np.array([60.0, 100.0]), (45, 1, 2))
    for length_px, marked in ((60.0, True), (0.0, False)):
        paths = np.concatenate([over_edges(45, length_px), lamp], axis=1)
        for d in found_in_all(board_pictures(paths, 2.0, 0.0, 4)):
            at = np.hypot(*(d.uv_px - lamp[0, 0]).T) < 1
            assert np.count_nonzero(at) == 1
            assert bool(d.at_rest is not None and d.at_rest[at].any()) == marked


@pytest.mark.parametrize(("length_px", "largest_px"), further_slow([(3.0, 0.15), (160.0, 0.06), (25.0, 0.15)], fast=2))
def test_a_board_that_modulates_spots_by_half_does_not_shift_them(length_px, largest_px):
    """Whether they stay near its edges, or pass over them."""
    paths = over_edges(45, length_px)
    gap, sigma = errors(found_in_all(board_pictures(paths, 2.0, 0.6, 5)), paths)
    assert np.sqrt(np.mean(gap**2)) < largest_px
    assert np.sqrt(np.mean((gap / sigma) ** 2) / 2) < 1.25


@pytest.mark.parametrize("apart_px", further_slow([9.0, 14.0]))
def test_two_spots_that_stay_near_each_other_on_an_edge_are_not_taken_for_one_light(apart_px):
    """Their joint places form one path, over which one wide light could move."""
    slow = over_edges(45, 12.0)
    paths = np.concatenate([slow[:, :2], slow[:, :2] + [apart_px, 0.25 * apart_px]], axis=1)
    gap, sigma = errors(found_in_all(board_pictures(paths, 2.0, 0.5, 8)), paths)
    assert np.sqrt(np.mean(gap**2)) < 0.15
    assert np.sqrt(np.mean((gap / sigma) ** 2) / 2) < 1.5


@pytest.mark.parametrize("modulated", [0.0, 0.6])
def test_spots_on_black_and_on_white_have_the_noise_of_the_light_there(modulated):
    """20 electrons per grey value: a seventh of the photon noise of white is left on black."""
    rng, along = np.random.default_rng(7), np.arange(45.0)[:, None, None]
    wall = np.where(X < 200, WHITE, BLACK) * np.ones(SIZE)
    start = np.array([[x, y] for x in (60.0, 120.0, 260.0, 320.0) for y in (40.0, 120.0, 200.0)])
    paths, lamps = start + along * np.array([0.7, 1.3]), np.array([[x, 290.0] for x in (60.0, 150.0, 250.0, 340.0)])
    pictures = []
    for at in paths:
        light = round_lights(SIZE, np.concatenate([at, lamps]), 60.0, 2.0)
        electrons = 20 * (wall - 4 + (1 - modulated * (1 - wall / WHITE)) * light)
        pictures.append(np.clip(np.rint(rng.poisson(electrons) / 20 + 4), 0, 255).astype(np.uint8))
    ratio: list[list[float]] = [[], []]
    for found, at in zip(found_in_all(pictures), paths, strict=True):
        for i, place in enumerate(at):
            near = int(np.hypot(*(found.uv_px - place).T).argmin())
            assert found.place_px2 is not None
            noise_px2 = found.variance_px2[near] - found.place_px2[near]
            ratio[i // 6].append(np.sum((found.uv_px[near] - place) ** 2) / 2 / noise_px2)
    assert np.mean(ratio, axis=1) == pytest.approx(1.15, abs=0.35)


@pytest.mark.parametrize("away_px", [2.5, 5.0, 8.0])
@pytest.mark.parametrize("angle_deg", [0, 90])
def test_a_spot_that_rests_beside_an_edge_is_found_although_nothing_moves(away_px, angle_deg):
    """The only light of the recording, in its middle between two corners of the board; on its white and black side."""
    at = [80.0 + away_px, 60.0] if angle_deg == 0 else [60.0, 80.0 + away_px]
    paths = np.broadcast_to(np.array([at]), (15, 1, 2))
    gap, sigma = errors(found_in_all(board_pictures(paths, 2.0, 0.3, 5)), paths)
    assert gap.max() < 0.5
    assert (gap / sigma).max() < 4.0


def test_lights_at_rest_state_errors_by_print_of_their_own_size_and_none_on_even_paper():
    """The print, not the lights, has misfits: they are no grain of the light. A fit takes up print under a light."""
    rng = np.random.default_rng(6)
    paper = np.full(SIZE, 60, np.uint8)
    for row in range(20, SIZE[0], 16):
        cv2.putText(paper, "beams on a wall", (6, row), cv2.FONT_HERSHEY_SIMPLEX, 0.45, 15, 1, cv2.LINE_AA)
    page = cv2.GaussianBlur(paper, (0, 0), 0.7).astype(float)
    at = np.array([[x, y] for y in range(30, 300, 50) for x in (20, 60, 100, 180, 260, 340)])
    at = at + rng.uniform(-5, 5, at.shape)
    light = round_lights(SIZE, at, 60.0, 1.6)
    expected = page + (1 - 0.4 * (1 - page / 60)) * light
    pictures = [np.rint(expected + NOISE * rng.standard_normal(SIZE)).astype(np.uint8) for _ in range(15)]
    found = found_in_all(pictures)
    gap, sigma = errors(found, np.broadcast_to(at, (15, *at.shape)))
    even = at[:, 0] > 150
    assert 0.5 < np.sqrt(np.mean((gap[:, even] / sigma[:, even]) ** 2) / 2) < 1.25
    assert sigma[:, even].max() < 0.06
    near = gap[:, ~even] < 3.2  # found
    assert np.mean(near) > 0.7
    assert np.sqrt(np.mean((gap[:, ~even][near] / sigma[:, ~even][near]) ** 2) / 2) < 1.5
    assert (gap[:, ~even][near] / sigma[:, ~even][near]).max() < 5.0


def test_the_light_of_a_spot_is_the_normal_density_of_its_ellipse_times_its_flux():
    """The light falls on pixels with a side of 1 px, whose variance of 1/12 px^2 widens it."""
    turn, major, minor, flux = np.radians(30.0), 4.0, 1.5, 7000.0
    spot = replace(
        Detections.at(np.array([[20.3, 31.8]]), np.eye(2)[None]), flux=np.array([flux]), major_px=np.array([major]),
        minor_px=np.array([minor]), angle_deg=np.array([30.0]),
    )  # fmt: skip
    axes = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    covariance = axes @ np.diag([major**2 + 1 / 12, minor**2 + 1 / 12]) @ axes.T
    u, v = (x.ravel() for x in np.meshgrid(np.arange(40), np.arange(60)))
    expected = flux * multivariate_normal([20.3, 31.8], covariance).pdf(np.column_stack([u, v]))
    np.testing.assert_allclose(light_at(spot, u, v), expected, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(light_at(spot.joined(spot, 2), u, v), 2 * expected, rtol=1e-4, atol=1e-6)


def speckled_pictures(paths: Array, sigma_px: float, contrast: float, seed: int) -> list[Picture]:
    """Pictures of spots at places (pictures, spots, 2) on a slightly textured screen that gives their light a grain."""
    rng = np.random.default_rng(seed)
    grain = [cv2.GaussianBlur(rng.standard_normal(SIZE), (0, 0), 1.2) for _ in range(2)]
    screen, response = 20 * (1 + 0.018 * grain[0] / grain[0].std()), np.exp(contrast * grain[1] / grain[1].std())
    mean = [screen + response * round_lights(SIZE, at, 60.0, sigma_px) for at in paths]
    return [np.rint(m + 0.5 * rng.standard_normal(SIZE)).clip(0, 255).astype(np.uint8) for m in mean]


@pytest.mark.parametrize("step_px", further_slow([5.0, 3.0, 8.0]))
def test_a_speckled_spot_that_makes_one_step_of_about_its_width_is_found_where_it_is(step_px):
    """Half of the recording before the step, half after it: both places have light in common that never moves."""
    paths = np.array([[100.3, 60.2], [180.3, 140.2], [260.3, 220.2], [59.3, 260.2]]) + np.zeros((46, 1, 2))
    paths[23:] += step_px * np.array([0.6, 0.8])
    found = found_in_all(speckled_pictures(paths, 3.5, 0.16, 5))
    near = [
        [np.count_nonzero(np.hypot(*(d.uv_px - at).T) < 7.0) for at in s] for d, s in zip(found, paths, strict=True)
    ]
    gap, sigma = errors(found, paths)
    assert np.mean(np.array(near) == 1) > 0.95
    assert gap.max() < 1.0
    assert np.mean(gap < 3.5 * sigma) > 0.95


@pytest.mark.parametrize("away_px", further_slow([6.0, 12.0, 8.0], fast=2))
@pytest.mark.parametrize("modulated", [0.0, 0.5])
def test_a_spot_at_rest_on_an_even_square_is_one_point_whose_sigma_is_not_that_of_the_edge_beside_it(
    away_px, modulated
):
    """An edge that the light hid would be seen on both sides of it."""
    across, along = np.array([40.0, 80.0, 160.0, 280.0]) + away_px, np.array([140.0, 60.0, 180.0, 100.0])
    at = np.concatenate([np.column_stack([across, along]), np.column_stack([along[:3], across[:3]])])
    paths = np.broadcast_to(at, (45, *at.shape))
    found = found_in_all(board_pictures(paths, 1.4, modulated, 9))
    gap, sigma = errors(found, paths)
    assert (gap / sigma).max() < 4.0
    assert sigma.max() < 0.3
    for d in found[::15]:
        assert [np.count_nonzero(np.hypot(*(d.uv_px - place).T) < 1.4) for place in at] == [1] * len(at)


def test_a_spot_at_rest_that_a_wide_object_contains_is_not_found_a_second_time():
    """No Gaussian explains the object; without straight structures the spot in it is found again."""
    at = np.array([[100.0, 60.0], [180.0, 140.0]]) + 6.0
    pictures = board_pictures(np.broadcast_to(at, (15, *at.shape)), 1.4, 0.3, 12)
    background, _ = background_of(pictures)
    spots = background.lights.found
    spots = spots[np.array([int(np.hypot(*(spots.uv_px - place).T).argmin()) for place in at])]
    square = replace(spots[:1], uv_px=at[:1] - 6.0, flux=np.array([3e4]), chi2=np.array([300.0]))
    square = replace(square, major_px=np.array([12.0]), minor_px=np.array([12.0]))
    mean = np.mean(pictures, axis=0).astype(np.float32)
    found = with_lights_on_edges(mean, spots.joined(square, 3), background.noise, USUAL, background.steps, 255.0)
    assert [np.count_nonzero(np.hypot(*(found.uv_px - place).T) < 1.4) for place in at] == [1, 1]


def test_a_spot_that_only_the_difference_shows_is_found_where_the_pictures_are_searched():
    """What an edge leaves may look like the part that the places of a light have in common."""
    paths = np.broadcast_to(np.array([80.0 + 3.5, 60.0]), (45, 1, 2)) + np.arange(45.0)[:, None, None] * [0.0, 0.4]
    pictures = board_pictures(paths, 1.0, 0.3, 13)
    background, estimate = background_of(pictures)
    searched = replace(background, unknown=np.array([[80.0, 65.0, 13.0]]))
    for picture, at in zip(pictures[:30], paths, strict=False):
        found = searched.found_in(picture, USUAL, estimate.texture_shift)
        assert found is not None
        assert np.hypot(*(found.uv_px - at[0]).T).min() < 0.3


@pytest.mark.parametrize("sigma_px", further_slow([3.0, 4.5]))
def test_a_wide_spot_that_single_pictures_show_in_part_is_measured_in_the_difference(sigma_px):
    """It rests on black between edges, then on an edge; its fit in one picture takes a part of its light."""
    first, last = np.array([101.0, 62.0]), np.array([123.0, 57.0])
    share = np.clip((np.arange(45.0) - 22) / 8, 0, 1)[:, None, None]
    paths = first + share * (last - first) + np.zeros((45, 1, 2))
    gap, sigma = errors(found_in_all(board_pictures(paths, sigma_px, 0.6, 14)), paths)
    assert gap.max() < 0.5
    assert sigma.max() < 0.5
    assert np.sqrt(np.mean((gap / sigma) ** 2) / 2) < 1.25


@pytest.mark.parametrize(("start", "length_px"), further_slow([(25, 1.4), (10, 1.0), (15, 1.0)]))
def test_a_narrow_spot_that_moves_by_its_width_is_one_point(start, length_px):
    """The places that it has in the recording overlap: that part of its light looks like a light at rest."""
    share = np.clip((np.arange(45.0) - start) / 15, 0, 1)[:, None, None] * length_px
    first = np.array([[62.3, 60.4], [141.6, 102.2], [180.8, 140.7], [220.1, 180.6], [300.5, 100.3]])
    paths = first + share * np.array([-0.6, 0.8])
    found = found_in_all(board_pictures(paths, 0.5, 0.3, 15))
    gap, _ = errors(found, paths)
    assert gap.max() < 0.2
    for d, at in zip(found, paths, strict=True):
        bright = [d.flux[np.hypot(*(d.uv_px - place).T) < 2.0] for place in at]
        assert [np.count_nonzero(flux > 0.2 * flux.max()) for flux in bright] == [1] * len(at)


# Even paper with printed dots.
DOTTED = 30.0 + round_lights(SIZE, [[40.0 * k, 30.0] for k in range(1, 9)], 60.0, 2.0)


def test_a_wide_spot_that_swings_over_a_printed_mark_is_measured_in_front_of_it():
    """Such a mark is no part of the spot: a fit of the spot shows the background with it."""
    t = np.concatenate([np.zeros(12), np.linspace(0, 4 * np.pi, 33)])
    paths = np.array([200.0, 150.0]) + 26.0 * np.sin(t)[:, None, None] * np.array([0.5, -0.85])
    board = DOTTED.copy()
    board[140:160, 176:206] += 55.0
    board[144:156, 186:196] -= 50.0
    gap, _ = errors(found_in_all(board_pictures(paths, 6.0, 0.5, 21, cv2.GaussianBlur(board, (0, 0), 0.7))), paths)
    assert gap.max() < 0.1


@pytest.mark.parametrize(
    ("length_px", "peak"), further_slow([(0.4, 22.0), (0.4, 40.0), (0.5, 40.0), (0.6, 40.0)], fast=2)
)
def test_a_spot_that_creeps_while_others_move_fast_is_not_taken_for_a_lamp(length_px, peak):
    along = np.linspace(-0.5, 0.5, 45)[:, None]
    paths, fast = [200.3, 100.4] + length_px * along * [0.4, 0.9], [200.0, 220.0] + 250.0 * along * [1.0, 0.0]
    rng = np.random.default_rng(23)
    pictures = []
    for a, b in zip(paths, fast, strict=True):
        light = DOTTED + round_lights(SIZE, [a], peak, 1.1) + round_lights(SIZE, [b], 90.0, 1.1)
        pictures.append(np.rint(light + NOISE * rng.standard_normal(SIZE)).astype(np.uint8))
    gap, sigma = errors(found_in_all(pictures), paths[:, None])
    assert (gap / sigma).max() < 4.5


@pytest.mark.parametrize("more_px", [0.0, 20.0])
def test_a_light_that_moves_by_its_width_is_fitted_also_where_more_moves_beside_it(more_px):
    """The box around all that moves, a faint shadow beside the light, too, may be as wide as it likes."""
    paths = np.where(np.arange(15) < 7, 0.0, 2.0)[:, None, None] * [0.6, 0.8] + [200.0, 100.0]
    pictures = board_pictures(paths, 1.5, 0.5, 24, DOTTED)
    noise = NoiseModel(NOISE**2, 0.0, 0.0)
    found = [find_spots(p, USUAL, noise, np.array([[200.0, 100.0, 9.0]])) for p in pictures]
    seen = Exposures(pictures, np.ones((15, SIZE[0])), noise, 30.0, 0.0)
    behind = BehindLights.of(seen, found, np.array([[200.0 + more_px, 100.0, 9.0 + more_px]]))
    assert len(behind.lights) == 1
    assert np.abs(behind.level_dn - 30.0).max() < 5.0


@pytest.mark.parametrize("length_px", [10.0, 30.0])
@pytest.mark.parametrize("level_dn", [0.0, 0.1])
def test_pictures_that_a_light_has_left_are_not_taken_for_some_that_show_it(length_px, level_dn):
    """It moves over a path of some of its widths; the room's light is not the same in all pictures."""
    rng, there = np.random.default_rng(5), np.arange(15) % 3 != 1
    paths = np.where(there, 0.0, 500.0)[:, None] + [200.0, 100.0] + length_px * rng.uniform(-0.5, 0.5, (15, 2))
    pictures = [p + level_dn * (k % 4) for k, p in enumerate(board_pictures(paths[:, None], 2.0, 0.5, 24, DOTTED))]
    noise = NoiseModel(NOISE**2, 0.0, 0.0)
    box = np.array([[200.0, 100.0, 0.5 * length_px + 8.0]])
    found = [find_spots(p.astype(np.uint8), USUAL, noise, box) for p in pictures]
    found = [d if there[k] else d[:0] for k, d in enumerate(found)]
    seen = Exposures(pictures, np.ones((15, SIZE[0])), noise, 30.0, 0.0)
    behind = BehindLights.of(seen, found, box)
    assert [len(fit.light.places) for _, fit in behind.lights] == [10]
    assert np.abs(behind.level_dn - DOTTED[behind.row, behind.column]).max() < 5.0


@pytest.mark.parametrize(
    ("at", "apart_px"),
    further_slow([
        ((180.0, 121.0), 12.0), ((300.0, 201.0), 16.0), ((300.0, 201.0), 12.0), ((199.0, 250.0), 12.0),
        ((180.0, 121.0), 16.0), ((199.0, 250.0), 16.0), ((161.0, 140.0), 16.0),
    ]),
)  # fmt: skip
def test_two_lights_that_move_by_their_width_beside_each_other_are_measured_on_edges(at, apart_px):
    """Each of them is in some of the pixels around the other one."""
    moved = np.repeat([0.0, 1.6, 3.6], 15)[:, None, None] * np.array([-0.4, 0.9])
    paths = np.array([at, np.subtract(at, np.multiply(apart_px, (0.4, 0.9)))]) + moved
    gap, sigma = errors(found_in_all(board_pictures(paths, 1.9, 0.4, 25)), paths)
    assert gap.max() < 0.15
    assert (gap / sigma).max() < 4.5


def test_pictures_that_show_two_and_four_lights_of_a_box_have_no_picture_of_the_number_between():
    def points(n: int) -> Detections:
        return Detections.at(
            np.column_stack([20.0 + 6 * np.arange(n), np.full(n, 30.0)]), np.tile(np.eye(2), (n, 1, 1))
        )

    found = [points(n) for n in (2, 4, 2, 4)]
    lights = _lights_of(None, [replace(d, flux=np.ones(len(d))) for d in found], np.array([30.0, 30.0, 20.0]))
    assert lights == []
