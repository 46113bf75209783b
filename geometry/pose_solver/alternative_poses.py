"""The other poses that put the same spots on the same pixels: the ambiguity of few spots.

Three spots have up to eight solutions in closed form (geometry/pose_solver/three_spots.py), including mirror solutions.
A fourth spot usually excludes all but one; with coplanar beams, or with two beams only, several may remain. Source:
ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from geometry.arrays import Array, Ints
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import RANK_TOLERANCE, fit_pose
from geometry.pose_solver.three_spots import poses_from_three_spots

# Solutions that differ by less than this are the same: rounding leaves 1e-6 at worst.
SAME = 1e-4  # m and rad
# A fit to all spots reduces the misfit that a solution for three of them leaves in the others by less than this factor.
MAX_FIT_GAIN = 50.0


def alternative_poses(
    model: SpotModel, world_from_body: Pose, rows: Ints | Sequence[int], tolerance_px: float = 1.0
) -> Pose:
    """All other poses (k,) that put the spots of views `rows` (m,) where the given pose puts them.

    With three spots the poses are exact; with more, they are fitted to all spots and agree in every view to within the
    tolerance. Views of two cameras may show one spot. The stack is empty if there is no other pose. It is also empty
    for fewer than three spots, or three collinear ones, which allow a continuum of poses: the caller must check whether
    the spots determine the pose at all (`observable` of a fit).
    """
    views = np.asarray(rows, dtype=np.int64)
    target, J = model.project(world_from_body)
    places = model.hits(world_from_body)[0]
    views = views[np.isfinite(target[views, 0])]
    none = Pose(np.zeros((0, 3, 3)), np.zeros((0, 3)))
    triple = _best_triple(model, J, views)
    if triple is None:
        return none
    solutions = poses_from_three_spots(model.point[triple], model.ray[triple], places[triple])
    solutions = solutions[np.isfinite(solutions.translation[:, 0])]
    found: list[Pose] = []
    exact = len(np.unique(model.spot_of[views])) == 3
    for start in (solutions[i] for i in range(len(solutions.translation))):
        misfit = _misfit(model, start, views, target)
        if not misfit <= MAX_FIT_GAIN * tolerance_px:
            continue
        pose = start
        if not exact and misfit > 1e-3 * tolerance_px:
            fit = fit_pose(model, views, target[views], np.tile(np.eye(2), (len(views), 1, 1)), start)
            if fit is None or not _misfit(model, fit.world_from_body, views, target) <= tolerance_px:
                continue
            pose = fit.world_from_body
        if all(np.abs(pose.minus(other)).max() > SAME for other in (world_from_body, *found)):
            found.append(pose)
    if not found:
        return none
    return Pose(np.stack([p.rotation for p in found]), np.stack([p.translation for p in found]))


def _best_triple(model: SpotModel, J: Array, rows: Ints) -> Ints | None:
    """The views (3,) of the three spots that determine the pose best; None if no three do."""
    _, first = np.unique(model.spot_of[rows], return_index=True)
    triples = np.array(list(combinations(rows[np.sort(first)], 3)), dtype=np.int64).reshape(-1, 3)
    if not len(triples):
        return None
    s = np.linalg.svd(J[triples].reshape(-1, 6, 6), compute_uv=False)
    quality = s[:, -1] / np.maximum(s[:, 0], 1e-300)
    best = int(np.argmax(quality))
    return triples[best] if quality[best] > RANK_TOLERANCE else None


def _misfit(model: SpotModel, pose: Pose, rows: Ints, target: Array) -> float:
    """The largest distance, px, of a spot from its target; nan if one has no projection."""

    return float(np.max(np.linalg.norm(model.project(pose)[0][rows] - target[rows], axis=-1)))
