"""Coarse circles from a detector, and the window it searches: where another detector is added."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Picture: TypeAlias = NDArray[np.uint8] | NDArray[np.uint16]  # (h, w), DN


@dataclass(frozen=True, slots=True)
class Window:
    """A square of the picture around a predicted circle. The square may reach beyond the picture."""

    u_px: float  # centre of the square: the predicted centre
    v_px: float
    half_px: float  # half of its side
    gate_px: float  # largest distance of a centre from the predicted one
    min_radius_px: float
    max_radius_px: float


@dataclass(frozen=True, slots=True)
class CircleCandidate:
    """A coarse circle, accurate to a few pixels. Candidates are fitted to the rim afterwards."""

    u_px: float
    v_px: float
    radius_px: float
    score: float  # the larger the better, comparable within one call of a detector
    polarity: int = 0  # +1: brighter outside the rim, -1: brighter inside, 0: unknown


# A detector gets the picture and a window around the prediction, or None to search the whole picture. It returns its
# candidates, the best first; an empty sequence where it finds none.
CircleDetector: TypeAlias = Callable[[Picture, Window | None], Sequence[CircleCandidate]]


def crop_bounds(shape: tuple[int, ...], window: Window) -> tuple[int, int, int, int]:
    """Rows and columns (top, bottom, left, right) of a window inside a picture; empty where they do not meet."""
    height, width = shape[:2]
    top, left = int(np.floor(window.v_px - window.half_px)), int(np.floor(window.u_px - window.half_px))
    bottom, right = int(np.ceil(window.v_px + window.half_px)) + 1, int(np.ceil(window.u_px + window.half_px)) + 1
    top, left = min(max(top, 0), height), min(max(left, 0), width)
    return top, max(min(bottom, height), top), left, max(min(right, width), left)
