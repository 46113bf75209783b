"""What a picture shows of a board: its points, or the reason why not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array, Ints

GreyImage = NDArray[np.uint8]  # (h, w)


@dataclass(frozen=True, slots=True)
class BoardView:
    """The points of a board in one picture, in the order of their numbers.

    Rows of the board run to the right and columns down when its printed side is looked at: the pixels are never in the
    order of a mirror image.
    """

    ids: Ints  # (n,), ascending: which of the board's points
    pixels: Array  # (n, 2), distorted; of circles the centroids of their blobs, not the images of their centres
    spacing_px: float  # median distance of neighbouring points
    blur_px: float  # sigma of the edges, a pixel's own width included; nan where it could not be measured
    contrast_dn: float  # light minus dark
    notes: tuple[str, ...] = ()  # what the user should know of this picture
    areas_px2: Array | None = None  # (n,), of the blobs that circles are seen as; None for other boards

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True, slots=True)
class NotFound:
    """There is no usable view of the board in a picture: why, and what to do."""

    reason: str


NO_CLOSE_LOOK = NotFound("no board at a quick look")  # its cause was not looked for
BLUR_LIMIT = 0.2  # sigma of the edges in spacings: beyond it neighbouring corners run together


def too_blurred(blur: float, apart: float) -> NotFound:
    """The refusal of a view out of focus or moving. blur: sigma of its edges, apart: its points' spacing; px."""
    return NotFound(
        f"too blurred: edges are smeared by {blur:.1f} px (1 sigma) with points {apart:.0f} px apart; focus,"
        " hold the board still or expose for a shorter time"
    )


def low_contrast(image: GreyImage) -> NotFound | None:
    """The refusal of a picture that shows nothing at all, or None."""
    low, high = np.percentile(image, [1, 99])
    if high - low >= 15:
        return None
    return NotFound(
        f"hardly any contrast: nearly all grey values lie from {low:.0f} to {high:.0f}; more light on the board"
    )
