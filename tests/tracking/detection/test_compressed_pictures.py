"""JPEG pictures of a quiet sensor: compression rounds away the noise of the background, and the details of a spot."""

import cv2
import numpy as np
import pytest

from tests.tracking.rendering import Scene, Spot, photograph
from tracking.detection.detect import find_spots
from tracking.noise_estimation.photon_transfer import NoiseEstimate, estimate_noise

SIZE = (520, 400)
GAIN, READ = 80.0, 0.15  # electrons per DN; DN


def compressed(picture: np.ndarray, quality: int) -> np.ndarray:
    data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)


def recording(quality: int, peak: float, count: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Pictures, and the places (n, 2) of the spots in each, anywhere within the blocks of the compression."""
    rng = np.random.default_rng(quality)
    pictures, places = [], []
    for _ in range(count):
        u, v = np.meshgrid(np.arange(40.0, 490, 60), np.arange(40.0, 370, 60))
        at = np.stack([u.ravel(), v.ravel()], axis=-1) + rng.uniform(-6, 6, (u.size, 2))
        scene = Scene([Spot(x, y, peak, 2.2, 1.8) for x, y in at], SIZE, 22.0, (8.0, 0.0), gain=GAIN, read=READ)
        pictures.append(compressed(photograph(scene, rng), quality))
        places.append(at)
    return pictures, places


def found(estimate: NoiseEstimate, pictures: list[np.ndarray], places: list[np.ndarray]) -> tuple[float, float, float]:
    """Recall, rms(error / sigma) per coordinate, and false points per picture."""
    right, squares, false = 0, [], 0
    for picture, at in zip(pictures, places, strict=True):
        points = find_spots(picture, noise=estimate.model)
        gap = np.linalg.norm(points.uv_px[:, None] - at, axis=-1)
        rows, seen = gap.argmin(axis=0), gap.min(axis=0) < 2.5
        off = (points.uv_px[rows] - at)[seen]
        squares.append(np.einsum("ni,nij,nj->n", off, np.linalg.inv(points.cov_px2[rows][seen]), off) / 2)
        right, false = right + int(seen.sum()), false + int((gap.min(axis=1) > 6).sum())
    total = sum(len(at) for at in places)
    return right / total, float(np.sqrt(np.mean(np.concatenate(squares)))), false / len(pictures)


@pytest.mark.parametrize("quality", [82, 88, 94])
@pytest.mark.parametrize("peak", [8.0, 80.0])
def test_spots_are_found_and_their_sigmas_are_correct(quality, peak):
    pictures, places = recording(quality, peak, 8)
    estimate = estimate_noise(pictures)
    recall, scatter, false = found(estimate, pictures, places)
    assert recall > 0.98
    assert 0.6 < scatter < 1.45
    assert false < 1.5


@pytest.mark.parametrize("quality", [82, 88, 94])
def test_the_noise_is_that_of_a_pixel_of_the_background(quality):
    rng = np.random.default_rng(1)
    flat = Scene([], SIZE, 22.0, (8.0, 0.0), gain=GAIN, read=READ)
    pictures = [compressed(photograph(flat, rng), quality) for _ in range(6)]
    true = max(float(np.stack(pictures).var(axis=0, ddof=1).mean()), 1 / 12)
    assert 1 / 1.4 < float(estimate_noise(pictures).model.variance(22.0)) / true < 1.4
