"""Narrow spots with a sharp core and wings: their shape is found in their own pictures and corrects their centres."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from geometry.camera import SensorNoise
from lab.runs.frames.sensor_noise import CameraNoise
from tests.marks import further_slow
from tests.tracking.rendering import Scene, Spot, photograph
from tracking.detection.detect import find_spots
from tracking.detections import Detections
from tracking.noise import NoiseModel, SpotProfile
from tracking.noise_estimation.photon_transfer import estimate_noise
from tracking.parameters import DetectParameters

SIZE = (400, 320)
SENSOR = SensorNoise(gain_e_per_dn=30.0, read_noise_e=45.0)
GAUSSIANS = [((1.0, 0.5),), ((1.0, 0.6),), ((1.0, 0.8),)]
WINGED = [((0.5, 0.4), (0.5, 0.9)), ((0.6, 0.5), (0.3, 0.9), (0.1, 2.0)), ((0.8, 0.5), (0.2, 1.5))]  # shares, px


@cache
def recording(
    parts: tuple[tuple[float, float], ...], pictures: int = 3, moves: bool = True, spacing: float = 30.0
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Pictures of spots that are sums of Gaussians of one centre, and the centres; moves: in all pictures elsewhere."""
    rng = np.random.default_rng(5)
    u, v = np.meshgrid(np.arange(25.0, SIZE[0] - 20, spacing), np.arange(25.0, SIZE[1] - 20, spacing))
    grid = np.stack([u.ravel(), v.ravel()], axis=-1)
    heights = rng.uniform(90, 230, len(grid))
    core, shown, centres = min(s for _, s in parts), [], []
    places = grid + rng.uniform(-0.5, 0.5, grid.shape)
    for _ in range(pictures):
        if moves:
            places = grid + rng.uniform(-0.5, 0.5, grid.shape)
        spots = [
            Spot(*place, height * share * (core / s) ** 2, s, s)
            for place, height in zip(places, heights, strict=True)
            for share, s in parts
        ]
        shown.append(photograph(Scene(spots, SIZE), rng))
        centres.append(places)
    return shown, centres


def errors(found: list[Detections], centres: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors (n, 2), px; over their sigmas; true centres."""
    out = []
    for points, places in zip(found, centres, strict=True):
        rows = np.linalg.norm(points.uv_px[:, None] - places, axis=-1).argmin(axis=0)
        error = points.uv_px[rows] - places
        sigma = np.sqrt(points.cov_px2[rows][:, [0, 1], [0, 1]])
        near = np.linalg.norm(error, axis=1) < 0.7
        assert near.mean() > 0.98
        out.append((error[near], (error / sigma)[near], places[near]))
    joined = [np.concatenate(part) for part in zip(*out, strict=True)]
    return joined[0], joined[1], joined[2]


def amplitude(error: np.ndarray, places: np.ndarray) -> float:
    """Of the first harmonic, px, of the error over the place within a pixel; the mean of both coordinates."""
    waves = []
    for axis in (0, 1):
        turns = 2 * np.pi * places[:, axis]
        waves.append(np.hypot(*np.linalg.lstsq(np.column_stack([np.sin(turns), np.cos(turns)]), error[:, axis])[0]))
    return float(np.mean(waves))


@pytest.mark.parametrize("parts", further_slow((w,) for w in WINGED))
def test_with_their_profile_the_error_depends_less_on_the_place_within_a_pixel(parts):
    shown, centres = recording(parts)
    model = estimate_noise(shown).model
    single = [find_spots(p, noise=replace(model, profile=SpotProfile())) for p in shown]
    winged = [find_spots(p, noise=model) for p in shown]
    before, _, places = errors(single, centres)
    after, of_sigma, _ = errors(winged, centres)
    assert amplitude(after, places) < max(0.6 * amplitude(before, places), 0.006)
    assert np.sqrt(np.mean(after**2)) < np.sqrt(np.mean(before**2))
    assert 0.7 < np.sqrt(np.mean(of_sigma**2)) < 1.25


@pytest.mark.parametrize("parts", GAUSSIANS)
def test_gaussian_spots_stay_as_they_are(parts):
    shown, _ = recording(parts)
    assert estimate_noise(shown).model.profile == SpotProfile()


@pytest.mark.parametrize(
    "change", [{"spacing": 120.0, "pictures": 2}, {"spacing": 100.0, "moves": False, "pictures": 6}]
)
def test_few_spots_or_the_same_ones_in_all_pictures_stay_as_they_are(change):
    """What some places within the pixel do to the centres does not show in others."""
    shown, _ = recording(WINGED[0], **change)
    assert estimate_noise(shown).model.profile == SpotProfile()


def test_the_profile_leaves_what_is_wide_or_found_without_it():
    """All spots are found with it as without; those wider than a pixel are the same."""
    rng = np.random.default_rng(1)
    profile = SpotProfile(0.6, 0.6, 0.1, 0.1, (0.7, 0.0, 0.7), 0.02)
    widths = [0.5, 0.7, 1.6] * 3
    spots = [Spot(40.0 * (k + 1) + rng.uniform(), 60.0, 120.0, s, s) for k, s in enumerate(widths)]
    picture, noise = photograph(Scene(spots, SIZE), rng), NoiseModel.of(SENSOR)
    single, winged = find_spots(picture, noise=noise), find_spots(picture, noise=replace(noise, profile=profile))
    nearest = np.linalg.norm(single.uv_px[:, None] - winged.uv_px, axis=-1).argmin(axis=1)
    assert sorted(nearest) == list(range(len(single)))
    wide = np.sqrt(single.major_px * single.minor_px) > 1.0
    assert np.array_equal(single.uv_px[wide], winged.uv_px[nearest[wide]])
    assert not np.any(single.uv_px[~wide] == winged.uv_px[nearest[~wide]])


def test_what_it_leaves_of_the_light_is_in_the_sigma_and_belongs_to_the_place():
    picture, noise = recording(WINGED[0])[0][0], NoiseModel.of(SENSOR)
    profile = SpotProfile(0.5, 0.8)
    sure = find_spots(picture, noise=replace(noise, profile=profile))
    rest = find_spots(picture, noise=replace(noise, profile=replace(profile, uneven=0.2)))
    assert np.median(rest.cov_px2[:, 0, 0]) > 1.3 * np.median(sure.cov_px2[:, 0, 0])
    assert np.median(rest.misfit) > 0.2 > np.median(sure.misfit)


def test_a_camera_uses_it_with_stated_noise_as_well():
    shown = recording(WINGED[0])[0][:2]
    camera = CameraNoise("left", SENSOR)
    camera.estimate_from(shown)
    profile = camera.estimate.model.profile
    assert profile != SpotProfile()
    assert camera.model.profile == profile
    assert camera.as_mapping()["profile"]["near"] == profile.near
    single = find_spots(shown[0], DetectParameters(), replace(camera.model, profile=SpotProfile()))
    assert not np.array_equal(camera.detect(shown[0], DetectParameters()).uv_px, single.uv_px)
