"""The threshold of a place comes from that place: not from what stands elsewhere in the picture."""

import numpy as np
import pytest

from tracking.detection.detect import find_spots
from tracking.noise import guess_noise
from tracking.noise_estimation.photon_transfer import estimate_noise

WALL = 180.0


def board(height: int, width: int, square: int) -> np.ndarray:
    """A board of black and white squares."""
    v, u = np.mgrid[:height, :width]
    return np.where((u // square + v // square) % 2, 200.0, 12.0)


def room(seed: int, peak: float, at: tuple[float, float] = (410.3, 240.6), sigma: float = 3.0) -> np.ndarray:
    """An even wall with a spot, between a board, cables and a black frame that fill half of the picture."""
    rng = np.random.default_rng(seed)
    scene = np.full((480, 640), WALL)
    scene[:, :300] = board(480, 300, 22)
    for row in range(20, 480, 60):
        scene[row : row + 3, 520:] = 40.0
    scene[:, 515:520] = 15.0
    v, u = np.mgrid[:480, :640]
    scene += peak * np.exp(-0.5 * ((u - at[0]) ** 2 + (v - at[1]) ** 2) / sigma**2)
    return np.clip(np.rint(scene + rng.normal(0, 1.1, scene.shape)), 0, 255).astype(np.uint8)


def is_found(picture: np.ndarray, at: tuple[float, float] = (410.3, 240.6)) -> bool:
    found = find_spots(picture, noise=estimate_noise([picture]).model)
    return bool((np.linalg.norm(found.uv_px - at, axis=1) < 1.0).any())


@pytest.mark.parametrize("peak", [12.0, 30.0, 70.0])
@pytest.mark.parametrize("seed", range(3))
def test_a_spot_on_an_even_wall_is_found_beside_a_board_and_cables(seed, peak):
    picture = room(seed, peak)
    assert is_found(picture[190:290, 340:490].copy(), (70.3, 50.6))  # nothing but the wall
    assert is_found(picture)


def test_a_spot_on_a_white_square_of_a_board_is_found():
    """Everything around the square has the contrast of the board; the square itself is even."""
    rng = np.random.default_rng(5)
    v, u = np.mgrid[:480, :640]
    scene = board(480, 640, 40) + 45.0 * np.exp(-0.5 * ((u - 340.3) ** 2 + (v - 220.4) ** 2) / 2.0**2)
    picture = np.clip(np.rint(scene + rng.normal(0, 1.1, scene.shape)), 0, 255).astype(np.uint8)
    assert is_found(picture, (340.3, 220.4))


def test_objects_do_not_count_as_noise_of_the_sensor():
    """Black squares at zero are no background that is clipped, and edges are no noise."""
    rng = np.random.default_rng(8)
    scene = board(300, 400, 25)
    scene[scene < 100] = 0.0
    picture = np.clip(np.rint(scene + rng.normal(0, 2.0, scene.shape)), 0, 255).astype(np.uint8)
    for floor in (guess_noise(picture).floor_dn2, estimate_noise([picture]).model.floor_dn2):
        assert floor < 2.0 * 2.0**2


@pytest.mark.parametrize("sigma", [0.6, 1.5])
def test_a_picture_clipped_at_black_keeps_its_noise(sigma):
    rng = np.random.default_rng(9)
    picture = np.clip(np.rint(rng.normal(0.5 * sigma, sigma, (400, 500))), 0, 255).astype(np.uint8)
    assert 0.7 * sigma**2 < estimate_noise([picture]).model.variance(0.5 * sigma) < 1.5 * sigma**2 + 0.1
