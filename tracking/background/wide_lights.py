"""Lights wider than those that are fitted in pictures themselves: in front of the background of sums of pixels.

In sums of 8x8 pixels a wide light is as wide as a usual spot in a picture, and moves by as many pixels: all that
static_background.py does for spots holds for it. Source: ours.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from tracking.background.estimation import MOSTLY
from tracking.background.static_background import StaticBackground
from tracking.detection.detect import WIDE_PX, for_wide, wide_of_squares
from tracking.detections import Detections
from tracking.noise import NoiseModel, Picture
from tracking.noise_estimation.texture_shift import TextureShift
from tracking.parameters import DetectParameters
from tracking.squares import noise_of_squares, squares_of

_WIDEST_PX = 8 * WIDE_PX  # as wide as the widest spot, in sums of pixels
# Variance over that of sums of independent pixels. In sums there is so little noise that what a light's tails leave far
# from it would be as large, and no picture would fit the background.
_UNMODELLED = 64.0
_OVER, _CHANGES = (7, 7), 3.0  # sums: 56 px; sigmas: light is found from 6 on, in its middle
_LEAST_MOVE = 0.5  # widths, along u or v: a lamp that flickers stays in its place
_NO_TEXTURE = TextureShift.none()  # but for what the background shows itself


@dataclass(frozen=True, slots=True)
class WideLights:
    """The background of sums of a camera's pixels, and the wide light that moves in front of it."""

    background: StaticBackground
    excluded_px: float  # sigma of one that max_sigma_px excludes; 0: none moves

    @staticmethod
    def of(
        pictures: Sequence[Picture], model: NoiseModel, parameters: DetectParameters,
        make: Callable[..., StaticBackground | None],
    ) -> WideLights | None:  # fmt: skip
        """From pictures spread over a recording; make: `static_background`.

        None: it makes no background of them, or nothing wide changes and max_sigma_px admits nothing wide.
        """
        every = for_wide(replace(parameters, max_sigma_px=_WIDEST_PX), pictures[0])
        of_sums = noise_of_squares(replace(model, correlation=_UNMODELLED * model.correlation), pictures[0])
        squares = [squares_of(p) for p in pictures]
        if parameters.max_sigma_px <= WIDE_PX and not _changes_widely(squares, of_sums):
            return None
        background = make(squares, of_sums, _NO_TEXTURE, every, False, True)
        if background is None:
            return None
        excluded = Detections.none()
        for picture, sums in zip(pictures, squares, strict=True):
            parts = background.parts(sums, every, _NO_TEXTURE)
            moving = Detections.none() if parts is None else wide_of_squares(parts[0], picture)
            excluded = excluded.joined(moving[moving.major_px > parameters.max_sigma_px][:1], len(pictures))
        often = len(excluded) > MOSTLY * len(pictures)
        width = float(np.median(excluded.major_px)) if often else np.inf
        far = often and bool((np.ptp(excluded.uv_px, axis=0) > _LEAST_MOVE * width).any())
        return WideLights(background, width if far else 0.0)

    def in_picture(self, picture: Picture, parameters: DetectParameters) -> Detections | None:
        """The lights of a picture with a sigma of WIDE_PX to max_sigma_px, those that move and those at rest.

        None: the picture and the background do not fit.
        """
        found = self.background.found_in(squares_of(picture), for_wide(parameters, picture), _NO_TEXTURE)
        return None if found is None else wide_of_squares(found, picture)


def _changes_widely(squares: Sequence[Picture], noise: NoiseModel) -> bool:
    """Whether some of these sums change by more than their noise over the width of a wide light."""
    every = np.stack(squares)
    change = cv2.blur(np.asarray(np.ptp(every, axis=0), np.float32), _OVER)
    return bool((change > _CHANGES * np.sqrt(noise.variance(every[0]))).any())
