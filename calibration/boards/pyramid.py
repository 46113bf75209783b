"""Image pyramid: in smaller copies boards are found that are too large, blurred or noisy in the original."""

from __future__ import annotations

import cv2
import numpy as np

from calibration.boards.board_view import GreyImage
from geometry.arrays import Array

_LEAST_PX = 250  # longer side: boards cannot be found in smaller copies


def scales(image: GreyImage) -> list[float]:
    """Scales of the pyramid: 1, 1/2, 1/4, 1/8, as far as the copies are large enough."""
    return [s for s in (1.0, 0.5, 0.25, 0.125) if s == 1.0 or s * max(image.shape) >= _LEAST_PX]


def scaled(image: GreyImage, scale: float) -> GreyImage:
    """The picture reduced by averaging over areas."""
    if scale == 1.0:
        return image
    size = (int(image.shape[1] * scale), int(image.shape[0] * scale))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def at_full_size(pixels: Array, scale: float) -> Array:
    """Pixel coordinates of a smaller copy in the original. The centre of the first 2x2 block is at 0.5."""
    return (pixels + 0.5) / scale - 0.5
