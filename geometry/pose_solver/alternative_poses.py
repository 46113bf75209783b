"""The other poses that put the same spots on the same pixels: what few spots leave open.

Three spots have up to eight solutions in closed form (geometry/pose_solver/three_spots.py), mirror solutions among
them. A fourth spot mostly excludes all but one; beams in one plane, or two of them only, may keep several. Source:
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

# A solution nearer to the given pose than this, or to another one, is the same: rounding leaves 1e-6 at worst.
SAME = 1e-4  # m and rad
# A fit to all spots lessens the misfit that three of them leave in the others, but hardly by more than this factor.
WORTH_A_FIT = 50.0


def alternatives(
    model: SpotModel, world_from_body: Pose, rows: Ints | Sequence[int], tolerance_px: float = 1.0
) -> Pose:
    """All other poses (k,) that put the spots of views `rows` (m,) where the given pose puts them.

    Exactly with three spots; with more, to within the tolerance in every view, after a least-squares fit to all. Views
    of two cameras may show one spot. An empty stack where there is no other pose. With fewer than three spots, or three
    that do not fix a pose (on one line), there is a continuum of poses, and the stack is empty too: whether the spots
    fix the pose at all is for the caller to know (`observable` of a fit).
    """
    views = np.asarray(rows, dtype=np.int64)
    target, J = model.project(world_from_body)
    places = model.hits(world_from_body)[0]
    views = views[np.isfinite(target[views, 0])]
    nothing = Pose(np.zeros((0, 3, 3)), np.zeros((0, 3)))
    triple = _best_triple(model, J, views)
    if triple is None:
        return nothing
    solutions = poses_from_three_spots(model.point[triple], model.ray[triple], places[triple])
    solutions = solutions[np.isfinite(solutions.translation[:, 0])]
    found: list[Pose] = []
    exact = len(np.unique(model.spot_of[views])) == 3
    for start in (solutions[i] for i in range(len(solutions.translation))):
        misfit = _misfit(model, start, views, target)
        if not misfit <= WORTH_A_FIT * tolerance_px:
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
        return nothing
    return Pose(np.stack([p.rotation for p in found]), np.stack([p.translation for p in found]))


def _best_triple(model: SpotModel, J: Array, rows: Ints) -> Ints | None:
    """The three views (3,), of three spots, that fix the pose best; None if none do."""
    _, first = np.unique(model.spot_of[rows], return_index=True)
    triples = np.array(list(combinations(rows[np.sort(first)], 3)), dtype=np.int64).reshape(-1, 3)
    if not len(triples):
        return None
    s = np.linalg.svd(J[triples].reshape(-1, 6, 6), compute_uv=False)
    quality = s[:, -1] / np.maximum(s[:, 0], 1e-300)
    best = int(np.argmax(quality))
    return triples[best] if quality[best] > RANK_TOLERANCE else None


def _misfit(model: SpotModel, pose: Pose, rows: Ints, target: Array) -> float:
    """The largest distance of a spot from its target, px; nan where one is not projected."""
    return float(np.max(np.linalg.norm(model.project(pose)[0][rows] - target[rows], axis=-1)))
