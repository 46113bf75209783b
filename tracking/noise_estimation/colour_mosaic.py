"""Raw pictures of a colour camera: neighbouring pixels lie behind different colour filters.

A laser spot in such a picture lights one pixel in four (red, blue) or two (green), so that its centroid follows the
mosaic by up to a tenth of a pixel, and no residual shows it. The pictures must be converted to colour or grey first.
"""

from __future__ import annotations

import cv2
import numpy as np

from tracking.noise import Picture

BLOCK = 32  # px, even: side of the blocks that are compared
LEAST_CONTRAST = 0.03  # a smaller difference of two filters has no effect on a centroid
SAME_SIGN = 0.95  # share of the blocks with the same sign: texture has both
EQUAL = 0.25  # share of the larger difference up to which the two pixels of the other diagonal count as equal


def mosaic_contrast(picture: Picture) -> float:
    """Relative difference of two of the mosaic's four pixels in a picture (h, w); 0 if there is no colour mosaic.

    In each cell of 2 x 2 pixels of a Bayer mosaic the pixels of one diagonal have the same filter, green, and those of
    the other do not, red and blue. Different gains of even and odd columns or rows do not have this property. A light
    that has as much red as blue for the sensor hides the mosaic. Source: ours.
    """
    height, width = (n - n % BLOCK for n in picture.shape)
    if not height or not width:
        return 0.0
    size = width // BLOCK, height // BLOCK
    pixels = picture[:height, :width].astype(np.float32)
    a, b, c, d = (cv2.resize(pixels[i::2, j::2], size, interpolation=cv2.INTER_AREA) for i in (0, 1) for j in (0, 1))
    level = np.maximum((a + b + c + d) / 4, 1.0)
    first, second = ((a - d) / level).ravel(), ((b - c) / level).ravel()
    larger, smaller = (first, second) if abs(np.median(first)) > abs(np.median(second)) else (second, first)
    contrast = float(np.median(larger))
    alike = np.mean(np.sign(larger) == np.sign(contrast))
    bayer = abs(contrast) >= LEAST_CONTRAST and alike >= SAME_SIGN and abs(np.median(smaller)) < EQUAL * abs(contrast)
    return abs(contrast) if bayer else 0.0
