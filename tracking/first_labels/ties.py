"""What would decide between two poses that explain the same points."""

from __future__ import annotations

import numpy as np

from geometry import rotations
from geometry.arrays import Bools
from geometry.spots import SpotModel
from geometry.symmetry import lie_on_each_other
from tracking.first_labels.candidates import NO_POINT
from tracking.first_labels.search import Labelling

FITTED_RAD, FITTED_M = float(np.deg2rad(0.3)), 0.01  # two fitted poses of a symmetric rig differ from it by this
APART_PX = 5.0  # a spot expected at places farther apart than this tells two poses from each other


def spot_names(model: SpotModel, views: Bools) -> str:
    """The spots of some views (n,), each once, in words."""
    return " ".join(dict.fromkeys(model.views[v][1] for v in np.flatnonzero(views)))


def what_decides(model: SpotModel, one: Labelling, other: Labelling) -> str:
    """In words: which spots in view, or which prior, would exclude one of two labellings of the same points."""
    here, there = one.fit.world_from_body, other.fit.world_from_body
    uv_here, uv_there = model.project(here)[0], model.project(there)[0]
    inside_here, inside_there = model.in_picture(uv_here), model.in_picture(uv_there)
    free = (one.point_of == NO_POINT) & (other.point_of == NO_POINT)
    only_one = free & (inside_here != inside_there)
    at_two_places = free & inside_here & inside_there & (np.linalg.norm(uv_here - uv_there, axis=-1) > APART_PX)
    parts = []
    if only_one.any():
        parts.append(
            f"spot {spot_names(model, only_one)}, which only one of the first two expects in the picture"
            " (is it hidden, or was it not found?)"
        )
    if at_two_places.any():
        parts.append(f"spot {spot_names(model, at_two_places)}, expected at two places and found at neither")
    if lie_on_each_other(model, here.inverse() @ there, FITTED_RAD, FITTED_M):
        parts.append("no spot of this rig: turned from one pose to the other it coincides with itself")
    elif not parts:
        parts.append("another spot in view")
    shift = float(np.abs(here.translation - there.translation).max())
    turn = float(np.rad2deg(rotations.angle(here.rotation.T @ there.rotation)))
    bounds = [f"within_deg below {turn / 2:.1f}"] if turn > 1 else []
    bounds += [f"within_m below {shift / 2:.3f}"] if shift > FITTED_M else []
    parts.append(
        f"a prior that excludes one: the first two are {shift:.3f} m and {turn:.1f} deg apart, so"
        f" {' or '.join(bounds)} about the true pose"
    )
    return "; or ".join(parts)
