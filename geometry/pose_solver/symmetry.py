"""Symmetries of a vehicle: transforms that map its beams onto themselves. Spots cannot distinguish such poses.

Two beams always have one, half a turn about the line midway between them, which swaps them; so has a fan of equal
angles. Source: ours.
"""

from __future__ import annotations

from itertools import permutations

import numpy as np

from geometry import rotations
from geometry.arrays import Array, Bools, cross, normalised
from geometry.forward_model import SpotModel
from geometry.lines import common_perpendicular
from geometry.pose import Pose

# Rays that differ by less coincide: 4 mm at 2.5 m, about the accuracy to which a symmetric target is manufactured. A
# calibrated rig can distinguish the poses of a less symmetric target.
SAME_RAD, SAME_M = float(np.deg2rad(0.05)), 0.002
PARALLEL = 1e-3  # sine of the angle between two rays below which they define no frame


def is_symmetry(model: SpotModel, turn: Pose, within_rad: float = SAME_RAD, within_m: float = SAME_M) -> bool:
    """Whether a transform of the body maps each spot's ray onto the ray of a spot on the same screen."""
    points, rays, screens = _rays(model)
    moved, turned = turn.apply(points), turn.turn(rays)
    angle = np.arccos(np.clip(turned @ rays.T, -1, 1))
    gap = np.linalg.norm(cross(moved[:, None] - points, rays), axis=-1)
    on: Bools = (screens[:, None] == screens) & (angle < within_rad) & (gap < within_m)
    return bool(on.any(axis=1).all() and on.any(axis=0).all())


def symmetries(model: SpotModel) -> list[Pose]:
    """All transforms of the body, except the identity, that map its rays onto its rays."""
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
        differs = rotations.angle(turn.rotation) > 10 * SAME_RAD or np.linalg.norm(turn.translation) > 10 * SAME_M
        if differs and is_symmetry(model, turn) and not any(_same(turn, other) for other in found):
            found.append(turn)
    return found


def _rays(model: SpotModel) -> tuple[Array, Array, Array]:
    """Points (s, 3), directions (s, 3) and screens (s,) of the s spots; a screen is a number for its origin."""
    _, first = np.unique(model.spot_of, return_index=True)
    _, screens = np.unique(np.round(model.screen_origin[first], 9), axis=0, return_inverse=True)
    return model.point[first], model.ray[first], np.ravel(screens)


def _frame(point_a: Array, ray_a: Array, point_b: Array, ray_b: Array) -> Pose:
    """The frame of two rays: origin in the middle of their common perpendicular, x along the bisector, z normal."""
    on_a, on_b = common_perpendicular(point_a, ray_a, point_b, ray_b)
    z = normalised(cross(ray_a, ray_b))
    x = normalised(ray_a + ray_b)
    return Pose(np.stack([x, cross(z, x), z], axis=-1), 0.5 * (on_a + on_b))


def _same(one: Pose, other: Pose) -> bool:
    """Whether two transforms are equal within the tolerances."""
    difference = one.minus(other)
    return bool(np.linalg.norm(difference[3:]) < 2 * SAME_RAD and np.linalg.norm(difference[:3]) < 2 * SAME_M)
