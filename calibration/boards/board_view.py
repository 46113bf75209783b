"""The result of searching a picture for a board: its points, or the reason why it was not found."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array, Ints

GreyImage = NDArray[np.uint8]  # (h, w)


@dataclass(frozen=True, slots=True)
class BoardView:
    """The points of a board in one picture, in ascending order of their numbers.

    With the printed side towards the viewer, rows run to the right and columns down: the order of the pixels is never
    that of a mirror image.
    """

    ids: Ints  # (n,), ascending: indices of the board's points
    pixels: Array  # (n, 2), distorted; of circles the centroids of their blobs, not the images of their centres
    spacing_px: float  # median distance of neighbouring points
    blur_px: float  # sigma of the edges, including the width of a pixel; nan where it could not be measured
    notes: tuple[str, ...] = ()  # remarks for the user about this picture
    areas_px2: Array | None = None  # (n,), areas of the blobs of circles; None for other boards
    sigmas_px: Array | None = None  # (n,): of a coordinate, from the noise of the picture; None: not measured

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True, slots=True)
class NotFound:
    """No usable view of the board in a picture, with the reason and the remedy."""

    reason: str


QUICK_SEARCH_FAILED = NotFound("no board found in a quick search")  # the cause was not determined
_MOST_BLUR = 0.2  # sigma of the edges in spacings: above it neighbouring points merge


def if_sharp(view: BoardView) -> BoardView | NotFound:
    """The view, or its rejection if it is blurred."""
    if not view.blur_px > _MOST_BLUR * view.spacing_px:
        return view
    return NotFound(
        f"too blurred: edges have a width of {view.blur_px:.1f} px (1 sigma) with points {view.spacing_px:.0f} px"
        " apart; focus, hold the board still or use a shorter exposure"
    )


def low_contrast(image: GreyImage) -> NotFound | None:
    """The rejection of a picture without contrast, or None."""
    below = np.cumsum(cv2.calcHist([image], [0], None, [256], [0, 256]).ravel()) / image.size
    low, high = np.searchsorted(below, [0.01, 0.99])
    if high - low >= 15:
        return None
    return NotFound(
        f"hardly any contrast: 98 % of the grey values are within {low:.0f} to {high:.0f}; put more light on the board"
    )


# Image pyramid: in smaller copies boards are found that are too large, blurred or noisy in the original.

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
