"""Which spots are seen in which poses, and which poses the spots cannot distinguish: few spots, a symmetric vehicle."""

from __future__ import annotations

import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations, permutations

import numpy as np

from geometry import rotations
from geometry.arrays import Array, Bools, Ints, cross, normalised
from geometry.forward_model import SpotModel
from geometry.planes import common_perpendicular, intersect_surface
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from geometry.pose_solver.gauss_newton import RANK_TOLERANCE, SolveLimits, covariances_of, fit_pose
from geometry.pose_solver.three_spots import poses_from_three_spots
from geometry.rig import Rig

# The other poses that put the same spots on the same pixels: the ambiguity of few spots.
#
# Three spots have up to eight solutions in closed form (geometry/pose_solver/three_spots.py), including mirror
# solutions. A fourth spot usually excludes all but one; with coplanar beams, or with two beams only, several may
# remain. Source: ours.

# Solutions that differ by less than this are the same: rounding leaves 1e-6 at worst.
SAME = 1e-4  # m and rad
# A fit to all spots reduces the misfit that a solution for three of them leaves in the others by less than this factor.
MAX_FIT_GAIN = 50.0
TOLERANCE_PX = 1.0  # of a fit to all spots: the other pose agrees with every view to within this


def alternative_poses(model: SpotModel, world_from_body: Pose, rows: Ints | Sequence[int]) -> Pose:
    """All other poses (k,) that put the spots of views `rows` (m,) where the given pose puts them.

    With three spots the poses are exact; with more, they are fitted to all spots and agree in every view to within
    TOLERANCE_PX. Views of two cameras may show one spot. The stack is empty if there is no other pose. It is also empty
    for fewer than three spots, or three collinear ones, which allow a continuum of poses: the caller must check whether
    the spots determine the pose at all (`observable` of a fit).
    """
    views = np.asarray(rows, dtype=np.int64)
    target, J = model.project(world_from_body)
    places = model.hits(world_from_body)
    views = views[np.isfinite(target[views, 0])]
    triple = _best_triple(model, J, views)
    if triple is None:
        return Pose.stack([])
    solutions = poses_from_three_spots(model.point[triple], model.ray[triple], places[triple])
    solutions = solutions[np.isfinite(solutions.translation[:, 0])]
    found: list[Pose] = []
    exact = len(np.unique(model.spot_of[views])) == 3
    for start in (solutions[i] for i in range(len(solutions.translation))):
        misfit = _misfit(model, start, views, target)
        if not misfit <= MAX_FIT_GAIN * TOLERANCE_PX:
            continue
        pose = start
        if not exact and misfit > 1e-3 * TOLERANCE_PX:
            fit = fit_pose(model, views, target[views], np.tile(np.eye(2), (len(views), 1, 1)), start)
            if fit is None or not _misfit(model, fit.world_from_body, views, target) <= TOLERANCE_PX:
                continue
            pose = fit.world_from_body
        if all(np.abs(pose.minus(other)).max() > SAME for other in (world_from_body, *found)):
            found.append(pose)
    return Pose.stack(found)


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


# Visibility over a range of poses: which spots are in which pictures, and how well they determine the pose.

POSES = 2000  # number of poses drawn: a share of 50 % then has a standard deviation of 1 %
SEED = 0
NOISE_PX = 0.1  # error of a spot, 1 sigma, to which the pose sigmas refer: that of a clean laser spot
MIN_SPOTS = 3  # that a pose needs
ASSUMED_M, ASSUMED_RAD = 0.5, float(np.deg2rad(30.0))  # about the middle of the view, where no range is stated


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


def assumed_range(rig: Rig) -> PosePrior:
    """The range of poses of a rig for which none is stated: about the world's origin, or the middle of its view.

    The origin, unless fewer than MIN_SPOTS are in view there: what a rig with a mistake sees elsewhere means nothing.
    """
    return _assumed_range(pickle.dumps(rig))


@lru_cache(maxsize=8)
def _assumed_range(content: bytes) -> PosePrior:
    """As `assumed_range`, of a pickled rig: it is asked for once for each mistake that a rig may have."""
    rig: Rig = pickle.loads(content)
    model = SpotModel.of(rig)
    seen = model.spot_of[model.in_picture(model.project(Pose.identity())[0])]
    centre = Pose.identity() if len(np.unique(seen)) >= MIN_SPOTS else middle_of_view(rig)
    return PosePrior(centre, ASSUMED_M, ASSUMED_RAD)


# Where a rig sees the vehicle: the pose about which it may move most.

_DISTANCES = (0.25, 0.5, 1.0, 2.0)  # of the vehicle from a screen, in distances of its camera
_ROLLS = 12  # about the mean direction to the screens, which may be all that they determine
# Motions after which spots are to be in view: half widths of the shifts, in distances of the cameras, and of the turns.
_MOVED, _TURNED, _MOTIONS = 0.15, float(np.deg2rad(20.0)), 60
# Views in the pictures that a rotation of 1 rad is worth: the world's axes are usually chosen so that it is small.
_UPRIGHT = 0.1


def middle_of_view(rig: Rig) -> Pose:
    """The pose (world_from_body) from which a vehicle may move most with its spots in their pictures; ours.

    The identity where that brings all spots into their pictures: then the world's origin is where the vehicle is.
    Candidates: places between the screens and before each, on either side, with the rotation that aims the beams at
    what the cameras see in the middle (Kabsch), rolled about the mean direction, and what a fit makes of them.
    """
    model = SpotModel.of(rig)
    if np.all(model.in_picture(model.project(Pose.identity())[0])):
        return Pose.identity()
    aims = _aims(rig, model)
    eyes = np.array([rig.cameras[c].camera_from_world.inverse().translation for c, _ in model.views])
    distance = np.linalg.norm(eyes - aims, axis=1)
    middle = (model.image_size_px - 1) / 2
    wide = model.image_size_px[:, :, None].astype(float) ** 2 * np.eye(2)
    candidates = []
    for place in _places(rig, model, aims, distance):
        aimed = _aimed(model, aims, place)
        start = aimed[int(np.argmax(np.sum(model.in_picture(model.project(aimed)[0]), axis=-1)))]
        candidates.append(start)
        rows = np.flatnonzero(np.isfinite(model.project(start)[0][:, 0]))
        fit = fit_pose(model, rows, middle[rows], wide[rows], start)
        candidates += [] if fit is None else [fit.world_from_body]
    shifts = poses_within(PosePrior(Pose.identity(), _MOVED * float(np.mean(distance)), _TURNED), _MOTIONS)

    def value(pose: Pose) -> float:
        moved = Pose(pose.rotation @ shifts.rotation, pose.translation + shifts.translation)
        seen = np.sum(model.in_picture(model.project(moved)[0]), axis=-1)
        here = np.sum(model.in_picture(model.project(pose)[0]))
        return float(here + np.mean(seen) - _UPRIGHT * rotations.angle(pose.rotation))

    return max(candidates, key=value)


def _aims(rig: Rig, model: SpotModel) -> Array:
    """Points (n, 3), m, in world, that the cameras of the views see in the middle of their pictures, on the screens."""
    out = []
    for camera, _ in model.views:
        seen_by = rig.cameras[camera]
        screen = rig.screens[seen_by.screen]
        origin, ray = seen_by.rays((np.array(seen_by.image_size_px) - 1) / 2)
        hit = intersect_surface(origin, ray, screen.world_from_screen, screen.bow)
        out.append(hit if np.all(np.isfinite(hit)) else screen.world_from_screen.translation)
    return np.array(out)


def _places(rig: Rig, model: SpotModel, aims: Array, distance: Array) -> Array:
    """Places (k, 3), m, in world, between the aims (n, 3) and before each; distance (n,), m, of its camera."""
    places = [aims.mean(axis=0), np.unique(aims, axis=0).mean(axis=0)]
    for (camera, _), aim, away in zip(model.views, aims, distance, strict=True):
        normal = rig.screens[rig.cameras[camera].screen].world_from_screen.rotation[:, 2]
        places += [aim + side * share * away * normal for side in (-1, 1) for share in _DISTANCES]
    return np.unique(np.round(places, 6), axis=0)


def _aimed(model: SpotModel, aims: Array, place: Array) -> Pose:
    """Poses (_ROLLS,) of the vehicle at a place (3,) whose beams roughly point to the aims (n, 3)."""
    u, _, vt = np.linalg.svd(normalised(aims - place + 1e-9).T @ model.ray)
    aimed = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    rolls = 2 * np.pi * np.arange(_ROLLS) / _ROLLS
    return Pose(rotations.exp(rolls[:, None] * u[:, 0]) @ aimed, np.tile(place, (_ROLLS, 1)))


def poses_within(prior: PosePrior, count: int) -> Pose:
    """Random poses (count,), uniform over a prior: over its cube, and over all rotations up to its angle.

    Uniform in the Haar measure of the rotations, whose density over the angle is proportional to 1 - cos(angle).
    """
    rng = np.random.default_rng(SEED)
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
    hits = np.isfinite(model.hits(poses)[..., 0])
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
    covariances, observable = covariances_of(normal)
    for sigma, part in ((sigma_m, slice(0, 3)), (sigma_rad, slice(3, 6))):
        sigma[observable] = np.sqrt(np.linalg.eigvalsh(covariances[observable, part, part])[..., -1])
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
