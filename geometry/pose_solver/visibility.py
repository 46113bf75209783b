"""Which spots are seen in which poses, and which poses the spots of a symmetric vehicle cannot distinguish."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from geometry import rotations
from geometry.arrays import Array, Bools, cross, normalised
from geometry.forward_model import SpotModel
from geometry.planes import common_perpendicular
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from geometry.pose_solver.gauss_newton import SolveLimits, covariance_of
from geometry.rig import Rig

# Visibility over a range of poses: which spots are in which pictures, and how well they determine the pose.

POSES = 2000  # number of poses drawn: a share of 50 % then has a standard deviation of 1 %
SEED = 0
NOISE_PX = 0.1  # error of a spot, 1 sigma, to which the pose sigmas refer: that of a clean laser spot
DEFAULT_RANGE = PosePrior(Pose.identity(), within_m=0.5, within_rad=float(np.deg2rad(30.0)))


@dataclass(frozen=True, slots=True)
class Visibility:
    """Visibility of the spots over n poses of a range. All shares are 0 to 1."""

    views: tuple[tuple[str, str], ...]  # camera, spot
    in_picture: Array  # (views,) share of the poses with this spot in this picture
    outside: Array  # (views,) share with the spot on its screen, but outside the picture
    off_screen: Array  # (views,) share with the spot beside its screen, or beyond the fold of the lens
    on_screen: Mapping[str, float]  # by spot: share of the poses in which its ray meets its screen
    blind: Mapping[str, float]  # by camera: share of the poses in which it sees no spot at all
    observable: float  # share of the poses that the visible spots of one frame determine, by the solver's limits
    spots_in_view: Array  # (n,) number of views in their pictures
    sigma_m: Array  # (n,) standard deviation of the worst direction of position, m, for NOISE_PX; inf: not observable
    sigma_rad: Array  # (n,) standard deviation of the worst axis of attitude, rad


def poses_within(prior: PosePrior, count: int, seed: int = SEED) -> Pose:
    """Random poses (count,), uniform over a prior: over its cube, and over all rotations up to its angle.

    Uniform in the Haar measure of the rotations, whose density over the angle is proportional to 1 - cos(angle).
    """
    rng = np.random.default_rng(seed)
    axis = normalised(rng.normal(size=(count, 3)))
    grid = np.linspace(0, prior.within_rad, 2001)
    below = grid - np.sin(grid)
    angle = np.interp(rng.uniform(0, below[-1], count), below, grid)
    shift = rng.uniform(-prior.within_m, prior.within_m, (count, 3))
    return Pose(
        prior.centre.rotation @ rotations.exp(axis * angle[:, None]),
        prior.centre.translation + shift,
    )


def visibility_of(rig: Rig, prior: PosePrior, limits: SolveLimits, count: int = POSES) -> Visibility:
    """Visibility of the rig's spots over poses drawn from a prior; deterministic."""
    poses = poses_within(prior, count)
    model = SpotModel.of(rig)
    pixels, J = model.project(poses)
    seen = np.asarray(model.in_picture(pixels))
    projected = np.isfinite(pixels[..., 0])
    hits = np.isfinite(model.hits(poses)[0][..., 0])
    sigma_m, sigma_rad, good = _sigmas(np.where(seen[..., None, None], J, 0.0), limits)
    cameras, spots = np.array([c for c, _ in model.views]), np.array([s for _, s in model.views])
    return Visibility(
        views=model.views,
        in_picture=seen.mean(axis=0),
        outside=(projected & ~seen).mean(axis=0),
        off_screen=(~projected).mean(axis=0),
        on_screen={s: float(hits[:, spots == s].any(axis=1).mean()) for s in rig.spots if s in spots},
        blind={c: float(1 - seen[:, cameras == c].any(axis=1).mean()) for c in rig.cameras},
        observable=float(good.mean()),
        spots_in_view=seen.sum(axis=1),
        sigma_m=sigma_m,
        sigma_rad=sigma_rad,
    )


def _sigmas(J: Array, limits: SolveLimits) -> tuple[Array, Array, Bools]:
    """Worst sigmas of position (n,), m, and attitude (n,), rad, and whether they are within the limits (n,).

    J: Jacobians (n, views, 2, 6), 0 for spots that are not seen.
    """
    flat = J.reshape(len(J), -1, 6) / NOISE_PX
    normal = np.swapaxes(flat, -1, -2) @ flat
    sigma_m, sigma_rad = np.full(len(J), np.inf), np.full(len(J), np.inf)
    for i, H in enumerate(normal):
        covariance, observable = covariance_of(H)
        if observable:
            sigma_m[i] = np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])
            sigma_rad[i] = np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1])
    return sigma_m, sigma_rad, (sigma_m <= limits.max_sigma_m) & (sigma_rad <= limits.max_sigma_rad)


# Symmetries of a vehicle: transforms that map its beams onto themselves. Spots cannot distinguish such poses.
#
# Two beams always have one, half a turn about the line midway between them, which swaps them; so has a fan of equal
# angles. Source: ours.


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
