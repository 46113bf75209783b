"""One frame's detections and what predicts them, in the form that the compiled functions take.

An assignment is an array (n,) of int: for each view the row of its detection in `FrameDetections`, that row plus
BLENDED, or one of the negative values MISSED and NOT_SEARCHED.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled
from geometry.compiled_projection import Views
from geometry.forward_model import SpotModel
from geometry.rig import Rig

NOT_SEARCHED = -2  # the camera has no picture, or the spot is not expected in it; see also occlusion.MISSED
# Added to the row of a detection that has merged with a neighbour: it is labelled but excluded from the pose.
BLENDED = 1 << 20
# px: radius of the disc around an expected spot in which false points are counted (clutter.py).
CLUTTER_RADIUS_PX = 15.0


class FrameDetections(NamedTuple):
    """One frame's m detections, sorted by camera."""

    uv: Array  # (m, 2) px
    cov: Array  # (m, 2, 2) px^2
    blend_px: Array  # (m,) how far a neighbour that has merged with the spot may shift the detection; 0: not at all
    first: Ints  # (cameras + 1,) where the rows of each camera begin
    has_image: Bools  # (cameras,)
    log_clutter: Array  # (n,) log density of false points near each view's spot, 1/px^2
    log_static: Array  # (m,) log density of static points at each detection; -inf: none known there
    size_px: Array  # (m,) larger half axis of the detection; nan: not known
    usual_size_px: Array  # (n,) the usual larger half axis of each view's spot; nan: not known
    log_clutter_excess: Array  # (n,) log ratio of the density of false points near a spot to that of the whole picture


class ViewTable(NamedTuple):
    """What the search needs of the n views besides their projection."""

    camera: Ints  # (n,)
    size: Array  # (n, 2) px: width, height of the picture
    group: Ints  # (n,) the spot's screen: spots of one screen may be occluded together

    @staticmethod
    def of(rig: Rig, model: SpotModel) -> ViewTable:
        """The table of a rig's views."""
        screens = list(dict.fromkeys(rig.spots[s].screen for _, s in model.views))
        group = np.array([screens.index(rig.spots[s].screen) for _, s in model.views], dtype=np.int64)
        return ViewTable(np.ascontiguousarray(model.camera_of), np.ascontiguousarray(model.image_size_px), group)


class DetectionModel(NamedTuple):
    """Probabilities of detection."""

    p_detect: float  # that a visible spot in the picture is detected
    p_blend: float  # that a detected spot has merged with a neighbour


class Observation(NamedTuple):
    """One frame's detections together with everything that their likelihood depends on besides the state."""

    views: Views  # (n,) for the projection
    view_table: ViewTable
    detection_model: DetectionModel
    # (n, 2, 2) px^2: covariance of the expected pixels due to calibration errors, and to the shift of `views`
    calibration_cov: Array
    frame: FrameDetections
    shift_cov: Array  # (n, 2, 2) px^2: the second part alone (models/picture_shifts.py); 0 without pictures' clocks
    clocks: Array  # (cameras, 3) of the pictures, as PictureClock.numbers
    timed: bool  # some picture has a clock of its own


@compiled
def chosen_points(
    uv: Array, cov: Array, begin: int, assigned: Ints, calibration_cov: Array
) -> tuple[Bools, Array, Array]:
    """Detections of one assignment (n,): views used in the pose (n,), pixels (n, 2) and covariances (n, 2, 2).

    uv (m, 2), px, cov (m, 2, 2), px^2: detections, of which those of the assignment's frame begin at row `begin`;
    calibration_cov (n, 2, 2), px^2: is added.
    """
    n = assigned.shape[0]
    use, of_view, noise = np.zeros(n, np.bool_), np.zeros((n, 2)), np.zeros((n, 2, 2))
    for i in range(n):
        if 0 <= assigned[i] < BLENDED:
            d = begin + assigned[i]
            use[i] = True
            for a in range(2):
                of_view[i, a] = uv[d, a]
                for b in range(2):
                    noise[i, a, b] = cov[d, a, b] + calibration_cov[i, a, b]
    return use, of_view, noise


def distinct_spots(chosen: Bools, spot: Ints) -> Ints:
    """Number (...) of different spots among the chosen views (..., n); spot (n,): the spot of each view."""
    if chosen.ndim == 1:  # a frame's: ten times as fast
        return np.asarray(len(set(spot[chosen].tolist())))
    return np.count_nonzero(np.stack([chosen[..., spot == s].any(axis=-1) for s in np.unique(spot)], axis=-1), axis=-1)
