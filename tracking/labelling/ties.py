"""Explanation of a tie: which observations would decide between two poses that explain the same points."""

from __future__ import annotations

import numpy as np

from geometry import rotations
from geometry.arrays import Array, Bools
from geometry.forward_model import SpotModel
from geometry.pose_solver.visibility import is_symmetry
from tracking.labelling.points import NO_POINT
from tracking.labelling.search import Labelling

FITTED_RAD, FITTED_M = float(np.deg2rad(0.3)), 0.01  # tolerance of the symmetry of two fitted poses
APART_PX = 5.0  # a spot expected farther than this from every spot of the other pose distinguishes the two


def spot_names(model: SpotModel, views: Bools) -> str:
    """The names of the spots of some views (n,), each once."""
    return " ".join(dict.fromkeys(model.views[v][1] for v in np.flatnonzero(views)))


def what_decides(model: SpotModel, one: Labelling, other: Labelling) -> str:
    """A sentence: which spots in view, or which prior, would exclude one of two labellings of the same points."""
    here, there = one.fit.world_from_body, other.fit.world_from_body
    uv_here, uv_there = model.project(here)[0], model.project(there)[0]
    parts = []
    for which, mine, uv, uv_other in (("first", one, uv_here, uv_there), ("second", other, uv_there, uv_here)):
        places = [
            f"{spot} at ({uv[v, 0]:.0f}, {uv[v, 1]:.0f}) px of camera {camera!r}"
            for v, (camera, spot) in enumerate(model.views)
            if mine.point_of[v] == NO_POINT and _only_here(model, v, uv, uv_other)
        ]
        if places:
            parts.append(f"spot {', '.join(places)}, where only the {which} expects one and none was found (hidden?)")
    if is_symmetry(model, here.inverse() @ there, FITTED_RAD, FITTED_M):
        parts.append("no spot of this rig: it is symmetric under the rotation from one pose to the other")
    elif not parts:
        parts.append("another spot in view")
    shift = float(np.abs(here.translation - there.translation).max())
    turn = float(np.rad2deg(rotations.angle(here.rotation.T @ there.rotation)))
    bounds = [f"within_deg below {turn / 2:.1f}"] if turn > 1 else []
    bounds += [f"within_m below {shift / 2:.3f}"] if shift > FITTED_M else []
    if bounds:
        parts.append(
            f"a prior that excludes one: the first two are {shift:.3f} m and {turn:.1f} deg apart, so"
            f" {' or '.join(bounds)} about the true pose"
        )
    return "; or ".join(parts)


def _only_here(model: SpotModel, view: int, uv: Array, uv_other: Array) -> bool:
    """Whether a view is in its picture in one pose, uv (n, 2), and no spot is near it in the other, uv_other (n, 2)."""
    if not model.in_picture(uv)[view]:
        return False
    gap = np.linalg.norm(uv_other[model.camera_of == model.camera_of[view]] - uv[view], axis=-1)
    return not bool(np.any(gap < APART_PX))
