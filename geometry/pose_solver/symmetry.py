"""The turns after which a vehicle's beams lie on each other: its spots alone cannot tell such poses apart.

Two beams always have one, half a turn about the line between them that swaps them; so has a fan of equal angles.
Source: ours.
"""

from __future__ import annotations

from itertools import permutations

import numpy as np

from geometry import rotations
from geometry.arrays import Array, Bools, cross, normalised
from geometry.forward_model import SpotModel
from geometry.lines import common_perpendicular
from geometry.pose import Pose

# Rays that differ by less lie on each other: 4 mm at 2.5 m, about as well as a target is made by design. What is less
# symmetric a calibrated rig can distinguish.
SAME_RAD, SAME_M = float(np.deg2rad(0.05)), 0.002
PARALLEL = 1e-3  # sine of the angle between two rays, below which they give no frame


def lie_on_each_other(model: SpotModel, turn: Pose, within_rad: float = SAME_RAD, within_m: float = SAME_M) -> bool:
    """Whether each spot's ray, moved by a transform of the body onto itself, lies on one of a spot of that screen."""
    points, rays, screens = _rays(model)
    moved, turned = turn.apply(points), turn.turn(rays)
    angle = np.arccos(np.clip(turned @ rays.T, -1, 1))
    gap = np.linalg.norm(cross(moved[:, None] - points, rays), axis=-1)
    on: Bools = (screens[:, None] == screens) & (angle < within_rad) & (gap < within_m)
    return bool(on.any(axis=1).all() and on.any(axis=0).all())


def symmetries(model: SpotModel) -> list[Pose]:
    """The transforms of the body onto itself, other than none, after which all its rays lie on each other."""
    points, rays, screens = _rays(model)
    sines = np.linalg.norm(cross(rays[:, None], rays), axis=-1)
    a, b = np.unravel_index(int(np.argmax(sines)), sines.shape)
    found: list[Pose] = []
    if sines[a, b] < PARALLEL:
        return found  # all parallel
    start = _frame(points[a], rays[a], points[b], rays[b])
    for c, d in permutations(range(len(points)), 2):
        if screens[c] != screens[a] or screens[d] != screens[b] or sines[c, d] < PARALLEL:
            continue
        turn = _frame(points[c], rays[c], points[d], rays[d]) @ start.inverse()
        moved = rotations.angle(turn.rotation) > 10 * SAME_RAD or np.linalg.norm(turn.translation) > 10 * SAME_M
        if moved and lie_on_each_other(model, turn) and not any(_same(turn, other) for other in found):
            found.append(turn)
    return found


def _rays(model: SpotModel) -> tuple[Array, Array, Array]:
    """Point, direction and screen (by its place in the list of places) of each spot, once."""
    _, first = np.unique(model.spot_of, return_index=True)
    _, screens = np.unique(np.round(model.screen_origin[first], 9), axis=0, return_inverse=True)
    return model.point[first], model.ray[first], np.ravel(screens)


def _frame(point_a: Array, ray_a: Array, point_b: Array, ray_b: Array) -> Pose:
    """A frame that two rays fix: its origin amid their common perpendicular, x between the rays."""
    on_a, on_b = common_perpendicular(point_a, ray_a, point_b, ray_b)
    z = normalised(cross(ray_a, ray_b))
    x = normalised(ray_a + ray_b)
    return Pose(np.stack([x, cross(z, x), z], axis=-1), 0.5 * (on_a + on_b))


def _same(one: Pose, other: Pose) -> bool:
    away = one.minus(other)
    return bool(np.linalg.norm(away[3:]) < 2 * SAME_RAD and np.linalg.norm(away[:3]) < 2 * SAME_M)
