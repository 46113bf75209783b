"""Raw pictures of a colour camera are recognised, and nothing else is taken for them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from geometry.arrays import Array
from tracking.noise import Picture
from tracking.noise_estimation.grey_values import mosaic_contrast

SIZE = (300, 410)


def filtered(cell: list[list[float]], background: float = 60.0, texture: float = 0.1, noise: float = 3.0) -> Picture:
    """A textured screen, with a gradient and a spot, behind filters that repeat every two pixels."""
    rng = np.random.default_rng(3)
    smooth = cv2.GaussianBlur(rng.standard_normal(SIZE), (0, 0), 0.7)
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    light = background * (1 + texture * smooth / smooth.std()) * (0.6 + 0.8 * x / SIZE[1])
    light = light + 150 * np.exp(-0.5 * ((x - 200) ** 2 + (y - 100) ** 2) / 2.0**2)
    filters = np.tile(np.array(cell), (SIZE[0] // 2, SIZE[1] // 2))
    return np.clip(np.rint(light * filters + noise * rng.standard_normal(SIZE)), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("turns", range(4))  # RGGB, GRBG, BGGR, GBRG
def test_a_bayer_mosaic_is_recognised_in_every_order(turns):
    cell: Array = np.rot90([[0.8, 1.0], [1.0, 0.6]], turns)
    assert mosaic_contrast(filtered(cell.tolist())) == pytest.approx(0.2 / 0.85, rel=0.1)


@pytest.mark.parametrize(
    "cell",
    [
        [[1.0, 1.0], [1.0, 1.0]],  # grey
        [[1.0, 0.9], [1.0, 0.9]],  # two amplifiers, one for every second column
        [[1.0, 1.0], [0.9, 0.9]],  # interlaced
    ],
)
def test_grey_pictures_have_no_mosaic(cell):
    assert mosaic_contrast(filtered(cell)) == 0.0


def test_pictures_without_light_and_tiny_ones_have_no_mosaic():
    assert mosaic_contrast(filtered([[0.8, 1.0], [1.0, 0.6]], background=0.0)) == 0.0
    assert mosaic_contrast(np.zeros((20, 500), dtype=np.uint16)) == 0.0
    assert mosaic_contrast(np.zeros((64, 64), dtype=np.uint8)) == 0.0
