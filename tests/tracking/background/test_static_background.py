"""Faint spots on a textured screen are found where only the noise limits them, and nothing else is taken for a spot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest

from geometry.arrays import Array
from tests.marks import further_slow
from tests.tracking.rendering import round_lights
from tracking.background import estimation, mean_pictures
from tracking.background.estimation import PICTURES, EqualLight, static_background
from tracking.background.static_background import StaticBackground
from tracking.detection.detect import find_spots
from tracking.detections import Detections
from tracking.noise import NoiseModel, Picture
from tracking.noise_estimation.photon_transfer import NoiseEstimate, estimate_noise
from tracking.noise_estimation.texture import is_limited_by_texture
from tracking.noise_estimation.texture_shift import TextureShift
from tracking.parameters import DetectParameters

SIZE = (360, 480)
LEVEL, NOISE, TEXTURE = 20.0, 0.8, 0.04  # DN, DN, share of the level
USUAL = DetectParameters()


def reflectance(seed: int, texture: float, grain_px: float = 0.6) -> Array:
    smooth = cv2.GaussianBlur(np.random.default_rng(seed).standard_normal(SIZE), (0, 0), grain_px)
    return np.asarray(1 + texture * smooth / smooth.std())


def light_of(centres: Array, peak: float, sigma_px: float = 1.2) -> Array:
    return round_lights(SIZE, centres, peak, sigma_px)


def path(pictures: int, spots: int, speed_px: float, seed: int) -> Array:
    """Centres (pictures, spots, 2) of spots that move straight on, far from each other and inside the picture."""
    rng = np.random.default_rng(seed)
    start = np.stack([np.linspace(60, 400, spots), rng.uniform(60, 120, spots)], axis=-1)
    direction = np.stack([rng.uniform(-0.15, 0.15, spots), np.ones(spots)], axis=-1)
    return np.asarray(start + speed_px * np.arange(pictures)[:, None, None] * direction)


@dataclass
class Recording:
    pictures: list[Picture]
    centres: Array  # (pictures, spots, 2)
    estimate: NoiseEstimate

    @property
    def model(self) -> NoiseModel:
        return self.estimate.model

    @staticmethod
    def of(
        centres: Array, peak: float, seed: int = 3, scale: float = 1.0, light: Array | None = None,
        texture: float = TEXTURE, grain_px: float = 0.6,
    ) -> Recording:  # fmt: skip
        """scale: grey values per DN of an 8-bit picture; light (pictures,): of the background, relative to LEVEL."""
        rng, screen = np.random.default_rng(seed + 1000), reflectance(seed, texture, grain_px)
        light = np.ones(len(centres)) if light is None else light
        kind = np.uint8 if scale == 1 else np.uint16
        pictures = []
        for at, share in zip(centres, light, strict=True):
            expected = screen * (LEVEL * share + light_of(at, peak))
            noisy = scale * (expected + NOISE * np.sqrt(share) * rng.standard_normal(SIZE))
            pictures.append(np.clip(np.rint(noisy), 0, np.iinfo(kind).max).astype(kind))
        return Recording(pictures, centres, estimate_noise(pictures[:2] + pictures[-2:]))

    def background(self) -> StaticBackground | None:
        return static_background(
            self.pictures[:: max(len(self.pictures) // PICTURES, 1)][:PICTURES], self.model,
            self.estimate.texture_shift, USUAL,
        )  # fmt: skip

    def found_in(self, background: StaticBackground, k: int) -> Detections:
        found = background.found_in(self.pictures[k], USUAL, self.estimate.texture_shift)
        assert found is not None
        return found

    def usual(self, k: int) -> Detections:
        """What the picture alone shows."""
        found = find_spots(self.pictures[k], USUAL, self.model)
        return self.estimate.texture_shift.added_to(found, self.model)


def judged(recording: Recording, background: StaticBackground, frames: range) -> tuple[float, float, float]:
    """Recall of the spots in these frames, points per picture in the difference that are none, rms error in sigmas."""
    hits, false, square = [], 0, []
    for k in frames:
        truth = recording.centres[k]
        found = recording.found_in(background, k)
        further = background.spots_in(recording.pictures[k], USUAL, TextureShift.none())
        false += sum(float(np.min(np.hypot(*(truth - p).T))) > 4 for p in further.uv_px)
        for centre in truth:
            gap = found.uv_px - centre
            i = int(np.argmin(np.hypot(*gap.T)))
            hits.append(np.hypot(*gap[i]) < 1.5)
            if hits[-1]:
                square.append(gap[i] @ np.linalg.solve(found.cov_px2[i], gap[i]) / 2)
    return float(np.mean(hits)), false / len(frames), float(np.sqrt(np.mean(square)))


@pytest.mark.parametrize("scale", further_slow([1, 16, 200]))
def test_spots_that_the_texture_hides_are_found(scale):
    recording = Recording.of(path(45, 6, 4.0, 1), 4.5, scale=scale)
    assert is_limited_by_texture(recording.model)
    background = recording.background()
    assert background is not None
    recall, false, error = judged(recording, background, range(45))
    plain = [find_spots(p, USUAL, recording.model).uv_px for p in recording.pictures]
    alone = np.mean([
        np.min(np.hypot(*(found - c).T), initial=9) < 1.5
        for found, at in zip(plain, recording.centres, strict=True) for c in at
    ])  # fmt: skip
    assert alone < 0.7
    assert recall > 0.97
    assert false < 0.1
    assert 0.85 < error < 1.3


def test_the_light_of_the_room_may_change():
    light = np.linspace(0.6, 1.8, 45)
    recording = Recording.of(path(45, 6, 4.0, 2), 6.0, light=light, texture=0.1)
    background = recording.background()
    assert background is not None
    recall, false, _ = judged(recording, background, range(45))
    assert recall > 0.9
    assert false < 0.3


@pytest.mark.parametrize("pictures", [6, 15, 40])
def test_the_means_of_noise_scatter_as_stated(pictures):
    noise = np.random.default_rng(pictures).normal(LEVEL, NOISE, (pictures, 200, 300)).astype(np.float32)
    for passed in (False, True):
        scatter = [float(mean.var()) * pictures / NOISE**2 for mean in mean_pictures.means_of(list(noise), passed)]
        assert scatter == pytest.approx([mean_pictures.LOWER_VARIANCE, mean_pictures.MIDDLE_VARIANCE], rel=0.1)


def test_constant_light_is_constant_though_the_noise_of_a_picture_is_in_the_mean_that_contains_it():
    """Texture fainter than the noise, in large pictures, which measure their light precisely."""
    rng, size = np.random.default_rng(2), (720, 960)
    screen = LEVEL + 0.3 * cv2.GaussianBlur(rng.standard_normal(size), (0, 0), 1.5) * 5
    pictures = [np.rint(screen + NOISE * rng.standard_normal(size)).astype(np.uint8) for _ in range(30)]
    lower, mean = mean_pictures.means_of(pictures[::2])
    model = NoiseModel(NOISE**2, 0.0, LEVEL)
    for fixed in (lower, mean):
        background = StaticBackground.of_mean(fixed, pictures[::2], model, USUAL).with_light(pictures[::2])
        shown = [background.shown.in_picture(p) for p in pictures]
        assert {None if s is None else s[0] for s in shown} == {1.0}


@pytest.mark.parametrize(("peak", "sigma_px"), further_slow([(150.0, 1.1), (40.0, 1.6)]))
@pytest.mark.parametrize("grain_px", further_slow([1.5, 0.6, 2.5]))
def test_lights_at_rest_have_errors_of_their_places_which_their_own_light_hides(peak, sigma_px, grain_px):
    """Texture under a light is in its fit; what is left shows nothing of it."""
    square, (u, v) = [], np.meshgrid(np.arange(40.0, 460, 60), np.arange(160.0, 340, 60))
    for seed in range(3):
        still = np.stack([u.ravel(), v.ravel()], axis=-1)
        still += np.random.default_rng(seed).uniform(-0.5, 0.5, still.shape)
        recording = Recording.of(path(15, 3, 4.0, seed) - [0.0, 40.0], 60.0, seed=seed, grain_px=grain_px)
        lit = reflectance(seed, TEXTURE, grain_px) * light_of(still, peak, sigma_px)
        pictures = [np.rint(p + lit).astype(np.uint8) for p in recording.pictures]
        estimate = estimate_noise(pictures[:2] + pictures[-2:], black_dn=0.0)
        recording = replace(recording, pictures=pictures, estimate=estimate)
        background = recording.background()
        assert background is not None
        found = recording.found_in(background, 0)
        for centre in still:
            gap = found.uv_px - centre
            i = int(np.argmin(np.hypot(*gap.T)))
            square.append(gap[i] @ np.linalg.solve(found.cov_px2[i], gap[i]) / 2)
    assert 0.6 < np.mean(square) < 1.5


def test_a_camera_that_was_knocked_shows_no_further_spots():
    recording = Recording.of(path(45, 6, 4.0, 3), 4.5)
    background = recording.background()
    assert background is not None
    knocked = np.roll(recording.pictures[20], (3, -4), axis=(0, 1))
    assert not len(background.spots_in(knocked, USUAL, TextureShift.none()))


def test_somebody_in_front_of_the_screen_adds_no_points():
    recording = Recording.of(path(45, 6, 4.0, 4), 6.0, texture=0.12)
    background = recording.background()
    assert background is not None
    other = recording.pictures[22].copy()
    rng = np.random.default_rng(5)
    other[60:200, 200:290] = np.rint(14 + NOISE * rng.standard_normal((140, 90))).astype(np.uint8)
    found = background.spots_in(other, USUAL, TextureShift.none()).uv_px
    covered = np.all((found > [195, 55]) & (found < [295, 205]), axis=1)
    assert not covered.any()
    visible = [c for c in recording.centres[22] if abs(c[0] - 245) > 110]  # farther than the surroundings reach
    assert len(visible) >= 3
    assert all(np.min(np.hypot(*(found - c).T), initial=9) < 1.5 for c in visible)


def test_spots_that_rest_for_a_part_of_the_recording_are_found_there_and_not_shifted_when_they_leave():
    centres = path(45, 6, 0.0, 6)
    centres[20:, :, 1] += 3.0 * np.arange(1, 26)[:, None]
    recording = Recording.of(centres, 4.0)
    background = recording.background()
    assert background is not None
    recall, false, _ = judged(recording, background, range(20))
    assert recall > 0.9
    assert false < 0.1
    gaps = []
    for k in range(20, 26):
        found = recording.found_in(background, k)
        for centre in recording.centres[k]:
            gap = found.uv_px - centre
            gaps += list(gap[np.hypot(*gap.T) < 2.5])
    assert len(gaps) > 20
    assert abs(np.mean([g[1] for g in gaps])) < 0.1


def test_bright_spots_need_no_background():
    assert Recording.of(path(45, 6, 4.0, 7), 180.0).background() is None


@pytest.mark.parametrize(("better", "used", "asked"), [({6, 7, 11}, True, 15), ({6, 7}, False, 15), ({7}, False, 5)])
def test_all_pictures_decide_where_few_show_one_better_spot(better, used, asked, monkeypatch):
    """Objects that hide spots in some places, which a spot passes in one of the five pictures that decide at first."""
    recording, calls = Recording.of(path(45, 6, 4.0, 7), 180.0), []

    def better_in(background: StaticBackground, picture: Picture, shift: TextureShift) -> int:
        calls.append(next(k for k, p in enumerate(recording.pictures[::3]) if p is picture))
        return int(calls[-1] in better)

    monkeypatch.setattr(estimation, "_better_in", better_in)
    assert (recording.background() is not None) == used
    assert len(calls) == len(set(calls)) == asked  # no picture twice
    assert calls[:5] == [0, 3, 6, 9, 12]


def test_lights_that_do_not_move_stay_as_the_picture_shows_them():
    centres = path(45, 6, 4.0, 8)
    still = np.broadcast_to(np.array([[240.0, 300.0], [100.0, 250.0]]), (45, 2, 2))
    recording = Recording.of(centres, 4.5)
    lit = light_of(still[0], 40.0)
    flicker = np.random.default_rng(9).uniform(0.8, 1.2, 45)
    pictures = [np.rint(p + f * lit).astype(np.uint8) for p, f in zip(recording.pictures, flicker, strict=True)]
    recording = Recording(pictures, centres, recording.estimate)
    background = recording.background()
    assert background is not None
    brightest = int(np.argmax(flicker))
    usual, found = recording.usual(brightest), recording.found_in(background, brightest)
    for at in still[0]:
        rows = [d.uv_px[np.hypot(*(d.uv_px - at).T) < 2] for d in (usual, found)]
        assert len(rows[0]) == 1
        np.testing.assert_allclose(rows[0], rows[1], atol=0.02)


def test_a_bright_board_that_the_search_takes_for_a_light_shifts_spots_at_its_edges_only():
    recording = Recording.of(path(45, 6, 4.0, 1), 4.5)
    u, v = 200, 150
    board = np.zeros(SIZE)
    board[v - 14 : v + 15, u - 20 : u + 21] = 1.5 * LEVEL
    board[v - 14 : v - 4, u + 6 : u + 21] = 0.0
    some = [np.rint(p + board).astype(np.uint8) for p in recording.pictures]
    background = replace(recording, pictures=some).background()
    assert background is not None
    shifts = background.shifts_px
    assert shifts is not None
    assert np.any(np.linalg.norm(background.lights.found.uv_px - [u, v], axis=1) < 8)
    rows = np.s_[v + 2 : v + 8]
    inside, edge, screen = shifts[rows, u - 13 : u + 14], shifts[rows, u + 20], float(np.median(shifts))
    assert np.quantile(inside, 0.9) < 2 * screen
    assert edge.min() > 3 * screen


def test_few_pictures_or_different_ones_make_no_background():
    recording = Recording.of(path(45, 6, 4.0, 9), 4.5)
    p, model, shift = recording.pictures, recording.model, recording.estimate.texture_shift
    assert static_background(p[:8], model, shift, USUAL) is None
    assert static_background([], model, shift, USUAL) is None
    assert static_background([*p[:14], p[14][:-8]], model, shift, USUAL) is None
    background = recording.background()
    assert background is not None
    assert background.found_in(recording.pictures[0][:-8], USUAL, TextureShift.none()) is None


def test_of_large_pictures_as_many_are_used_as_may_be_in_memory(monkeypatch):
    pictures = [np.full((64, 64), k, np.uint16) for k in range(15)]
    monkeypatch.setattr(mean_pictures, "MOST_BYTES", 10 * pictures[0].nbytes)
    used = [int(p[0, 0]) for p in mean_pictures.usable(pictures)]
    assert len(used) == len(set(used)) == 10
    assert (used[0], used[-1]) == (0, 14)


def test_the_points_stay_sorted_and_limited():
    recording = Recording.of(path(45, 6, 4.0, 10), 4.5)
    background = recording.background()
    assert background is not None
    few = DetectParameters(max_detections=4)
    found = background.found_in(recording.pictures[5], few, TextureShift.none())
    assert found is not None
    assert len(found) == 4
    assert np.all(np.diff(found.flux) <= 0)


def contrast_of(pictures: Sequence[Picture], room: Array) -> Array:
    return np.array([(p[room > 50].mean() - p[room < 50].mean()) / 60 for p in pictures])


@pytest.mark.parametrize(("periods", "fitting", "largest_dn"), [(0.0, 14, 0.2), (1.7, 12, 0.5), (3.0, 12, 0.5)])
def test_pictures_in_other_light_are_made_equal_and_black_ones_are_left_out(periods, fitting, largest_dn):
    """The light differs from picture to picture, and from row to row where lamps flicker while a sensor reads them."""
    rng = np.random.default_rng(5)
    room = 20.0 + 60.0 * (cv2.GaussianBlur(rng.random(SIZE), (0, 0), 2) > 0.5)
    rows = np.arange(SIZE[0])[:, None] / SIZE[0]
    lights = [1 + 0.12 * np.sin(0.9 * k + 2 * np.pi * periods * rows) for k in range(15)]
    pictures = [np.rint(light * room + rng.normal(0, 1, SIZE)).astype(np.uint8) for light in lights]
    pictures[4] = np.zeros_like(pictures[4])
    light = EqualLight.of(pictures, NoiseModel(1.0, 0.0, 0.0), USUAL)
    assert fitting <= len(light.pictures) <= 14
    contrast = contrast_of(light.equal, room)
    assert np.std(contrast) < 0.02  # before: .08 without bands
    assert np.std([p.mean() for p in light.equal]) < largest_dn  # before: 3
    spread = np.std([p - light.mean for p in light.equal], axis=0)
    assert np.sqrt(np.mean(spread**2)) < 1.6  # DN; before: 4
    np.testing.assert_allclose(light.strength.mean(axis=1) * contrast_of(light.pictures, room), contrast, rtol=0.03)


def test_pictures_in_one_light_stay_as_they_are():
    rng = np.random.default_rng(5)
    room = 20.0 + 60.0 * (rng.random(SIZE) > 0.5)
    pictures = [np.rint(room + rng.normal(0, 1, SIZE)).astype(np.uint8) for _ in range(9)]
    light = EqualLight.of(pictures, NoiseModel(1.0, 0.0, 0.0), USUAL)
    assert all(a is b for a, b in zip(light.equal, pictures, strict=True))
    assert set(light.strength.ravel()) == {1.0}
