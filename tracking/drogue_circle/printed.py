"""The tracker of Zhou (2014) as printed, for comparison: whole pixels, last position, eq. (4).

The print does not define how the pixels N_t of the target are counted: here as for the corrected coefficient, those of
the disc that look as before. The first circle is found as in the corrected tracker (the paper refers to another one).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from geometry.arrays import Array
from tracking.drogue_circle.detectors import (
    CircleDetector,
    CircleParameters,
    Window,
    centre_votes,
    centres,
    crop_bounds,
    edge_pixels,
)
from tracking.drogue_circle.kalman import PRINTED_P0, printed_coefficient, printed_step
from tracking.drogue_circle.occlusion import Appearance, disc_cells, first_appearance
from tracking.drogue_circle.tracker import CircleFrame, Wanted, acquire, nothing_known
from tracking.kalman import transition
from tracking.noise import Picture
from tracking.statuses import Cause, PoseStatus

_MOST_CENTRES = 200  # with the most votes, among which the one within the gate is sought
_LOST_AFTER = 25  # frames without a measurement; the print has no such rule


def printed_measurement(picture: Picture, last: Array, p: CircleParameters) -> Array | None:
    """Section 2.3, steps 1 to 3: the best centre within 8 px of the last one, and the radius with the most edge pixels.

    last: (3,) u, v, r of the frame before. Returns (3,) whole pixels, or None without an edge.
    """
    u, v, r = (float(x) for x in last)
    window = Window(u, v, 0.5 * p.window_radii * r, p.gate_px, 0.0, 0.0)
    top, bottom, left, right = crop_bounds(picture.shape, window)
    if min(bottom - top, right - left) < 8:
        return None
    edges = edge_pixels(picture[top:bottom, left:right], p.blur_px)
    if not len(edges):
        return None
    reach = float(max(bottom - top, right - left))
    votes = centre_votes(edges, (1.0, reach), (0, bottom - top, 0, right - left), smooth=False)
    for row, column in zip(*centres(votes, _MOST_CENTRES), strict=True):
        if (column + left - u) ** 2 + (row + top - v) ** 2 < p.gate_px**2:
            distance = np.rint(np.hypot(edges.x - column, edges.y - row)).astype(int)
            return np.array([column + left, row + top, int(np.argmax(np.bincount(distance)))], dtype=float)
    return None


@dataclass(slots=True)
class PrintedTracker:
    """The state between frames; the same use as `CircleTracker`."""

    detector: CircleDetector  # for the first circle
    parameters: CircleParameters = field(default_factory=CircleParameters)
    near_px: tuple[float, float] | None = None
    _x: Array | None = None
    _P: Array = field(default_factory=lambda: PRINTED_P0.copy())
    _appearance: Appearance | None = None
    _area: float = 0.0
    _misses: int = 0

    def step(self, picture: Picture | None, dt: float = 1.0) -> CircleFrame:
        """The next frame. picture None: there is none. dt: frames since the last step."""
        if self._x is None:
            return self._first(picture)
        predicted = (transition(dt, 3) @ self._x)[:3]
        z = None if picture is None else printed_measurement(picture, self._x[:3], self.parameters)
        gamma = 1.0
        if picture is not None:
            place = predicted if z is None else z
            area = self._filled(picture, place)
            gamma, self._area = printed_coefficient(area, self._area), area
        self._x, self._P = printed_step(self._x, self._P, dt, z, gamma, self.parameters.occluded)
        measured = z is not None and gamma < self.parameters.occluded
        self._misses = 0 if measured else self._misses + 1
        if self._misses > _LOST_AFTER or not 2 < self._x[2] < 2000:
            self._x = None
            return nothing_known(Cause.NOT_FOUND, "lost")
        if measured:
            return CircleFrame(PoseStatus.MEASURED, Cause.NONE, self._x, self._P, predicted, None, gamma)
        cause = Cause.NO_IMAGE if picture is None else Cause.NOT_FOUND if z is None else Cause.OCCLUDED
        return CircleFrame(PoseStatus.PREDICTED, cause, self._x, self._P, predicted, None, gamma)

    def _first(self, picture: Picture | None) -> CircleFrame:
        if picture is None:
            return nothing_known(Cause.NO_IMAGE)
        found = acquire(picture, self.detector, self.parameters, Wanted(self.near_px, 20.0))
        if found.found is None:
            return nothing_known(Cause.AMBIGUOUS if len(found.circles) > 1 else Cause.NOT_FOUND)
        z = found.found.centre_and_radius
        self._x, self._P, self._misses = np.concatenate([z, np.zeros(3)]), PRINTED_P0.copy(), 0
        self._appearance = first_appearance(*disc_cells(picture, *found.found.centre_and_radius))
        self._area = self._filled(picture, z)
        return CircleFrame(
            PoseStatus.MEASURED, Cause.NONE, self._x, self._P, np.full(3, np.nan), None, 0.0, event="acquired"
        )

    def _filled(self, picture: Picture, circle: Array) -> float:
        """N_t, px, of a circle (3,)."""
        assert self._appearance is not None
        cells = disc_cells(picture, float(circle[0]), float(circle[1]), float(circle[2]))
        seen = 1 - self._appearance.coefficient(*cells)
        self._appearance = self._appearance.updated(*cells)
        return float(np.pi * circle[2] ** 2 * seen)
