"""The poses in which a rig sees enough of its spots, and the sets of three spots for candidate poses.

Three spots at random pixels of their pictures give poses in closed form. A pose is sampled with a density proportional
to |det J|, the Jacobian of the three spots' six pixels, and by every set of three views that sees it; its weight is the
inverse. Poses drawn uniformly from the lab's space would hardly ever show a spot to a long lens (one in 1e6 at
f = 6000 px). Any set of visible spots contains enough of the selected sets of three. Source: ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.forward_model import SpotModel
from geometry.planes import intersect_surface
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from geometry.pose_solver.three_spots import poses_from_three_spots
from geometry.rig import Rig

TIMES = 2  # triples in any set of visible spots, if it has that many that determine the pose: noise may affect one
MOST_SETS = 5000  # sets of one size that are considered: a random sample if there are more (above 12 spots)


def covering(
    triples: dict[tuple[int, int, int], float], spots: Sequence[int], least: int
) -> tuple[Ints, dict[int, int]]:
    """Triples (k, 3) such that any set of at least `least` spots contains TIMES of them, if possible; and stages.

    triples: the quality with which each determines the pose. The larger sets of spots are covered first: the first
    `stages[m]` triples cover all sets of m or more spots. Greedy set cover: the next triple is the one that covers most
    of the sets that still lack one; of equals the one with the best quality.
    """
    names = list(triples)
    quality = np.array([triples[t] for t in names])
    rng = np.random.default_rng(0)
    chosen: list[int] = []
    stages: dict[int, int] = {}
    for size in range(len(spots), least - 1, -1):
        sets = [frozenset(s) for s in combinations(spots, size)]
        if len(sets) > MOST_SETS:
            sets = [sets[i] for i in rng.choice(len(sets), MOST_SETS, replace=False)]
        covers: Array = np.array([[s.issuperset(t) for s in sets] for t in names], dtype=float).reshape(-1, len(sets))
        lacking = np.minimum(covers.sum(axis=0), TIMES)
        lacking = np.maximum(lacking - covers[chosen].sum(axis=0), 0.0)
        while lacking.any():
            covered = covers @ np.minimum(lacking, 1.0)
            covered[chosen] = 0.0
            best = int(np.argmax(covered + 0.5 * quality / quality.max()))
            if not covered[best] > 0:
                break
            chosen.append(best)
            lacking = np.maximum(lacking - covers[best], 0.0)
        stages[size] = len(chosen)
    return np.array([names[i] for i in chosen], dtype=np.int64).reshape(-1, 3), stages


DRAWN = 4000  # sets of three pixels; the relative error of the volume is then 0.1 to 0.2
FIXES = 1e-4  # least ratio of the singular values of three spots' Jacobian; collinear spots have 1e-12


@dataclass(frozen=True, slots=True)
class VisiblePoses:
    """The volume of visible poses, and the sets of three spots that determine a pose."""

    triples: dict[tuple[int, int, int], float]  # spots -> median ratio of the least to the largest singular value
    log_volume: float  # m^3 rad^3, of the poses that show at least `min_spots` spots
    typical: Pose | None  # a pose that shows the largest number of spots

    @staticmethod
    def of(rig: Rig, model: SpotModel, everywhere: PosePrior, min_spots: int) -> VisiblePoses:
        """The visible poses of the rig that `model` was made of; deterministic."""
        rng = np.random.default_rng(0)
        triples = _sets_of_three(model)
        if not triples:
            return VisiblePoses({}, everywhere.log_volume, None)
        views_of = [np.flatnonzero(model.spot_of == s) for s in range(len(model.spot_names))]
        which = rng.integers(len(triples), size=DRAWN)
        spots = np.array(triples)[which]
        views = _one_view_each(views_of, spots, rng)
        places = _at_random_pixels(rig, model, views, rng)
        poses = poses_from_three_spots(model.point[views], model.ray[views], places)
        usable = np.isfinite(poses.translation[..., 0]) & everywhere.contains(poses)
        source, _ = np.nonzero(usable)
        poses = poses[usable]
        pixels, J = model.project(poses)
        seen = model.in_picture(pixels)
        # (k, spots): the number of pictures that show each spot.
        shown = np.stack([seen[:, rows].sum(axis=1) for rows in views_of], axis=-1)
        enough = np.count_nonzero(shown, axis=1) >= min(min_spots, len({int(s) for s in model.spot_of}))
        at = np.arange(len(source))[:, None]
        s: Array = np.asarray(np.linalg.svd(J[at, views[source]].reshape(-1, 6, 6), compute_uv=False), dtype=float)
        quality = s[:, -1] / np.maximum(s[:, 0], 1e-300)
        good = _fixing(triples, which[source], quality, enough)
        if not good:
            return VisiblePoses({}, everywhere.log_volume, None)
        weight = _weights(model, triples, good, which[source], views[source], views_of, shown, s)
        volume = float(np.sum(weight[enough])) / DRAWN * len(triples)
        log_volume = min(float(np.log(max(volume, 1e-300))), everywhere.log_volume)
        typical = poses[int(np.argmax(np.count_nonzero(shown, axis=1) + quality / quality.max()))]
        return VisiblePoses({triples[i]: q for i, q in good.items()}, log_volume, typical)


def _one_view_each(views_of: Sequence[Ints], spots: Ints, rng: np.random.Generator) -> Ints:
    """A view of each of some spots, at random: as `rng.choice` of each spot's views in turn, far faster."""
    counts = np.array([len(views) for views in views_of])
    first = np.cumsum(counts) - counts
    chosen: Ints = np.concatenate(views_of)[first[spots] + rng.integers(counts[spots])]
    return chosen


def _sets_of_three(model: SpotModel) -> list[tuple[int, int, int]]:
    """All sets of three spots, except those with two of one beam end (a ray that may hit one of two screens)."""
    first = {int(s): int(np.flatnonzero(model.spot_of == s)[0]) for s in np.unique(model.spot_of)}
    ends = {s: (int(model.beam_of[v]), float(model.sign[v])) for s, v in first.items()}
    return [t for t in combinations(sorted(first), 3) if len({ends[s] for s in t}) == 3]


def _at_random_pixels(rig: Rig, model: SpotModel, views: Ints, rng: np.random.Generator) -> Array:
    """World points (k, 3, 3), m, at random pixels of the pictures of views (k, 3); nan outside the screen."""
    pixels = rng.uniform(-0.5, model.image_size_px[views] - 0.5)
    places = np.full((*views.shape, 3), np.nan)
    for c, name in enumerate(model.camera_names):
        of_camera = model.camera_of[views] == c
        screen = rig.screens[rig.cameras[name].screen]
        origin, rays = rig.cameras[name].rays(pixels[of_camera])
        hits = intersect_surface(origin, rays, screen.world_from_screen, screen.bow)
        if screen.size_m is not None:
            local = screen.world_from_screen.inverse().apply(hits)
            hits[(np.abs(local[:, :2]) > np.asarray(screen.size_m) / 2).any(axis=1)] = np.nan
        places[of_camera] = hits
    return places


def _fixing(triples: Sequence[tuple[int, int, int]], which: Ints, quality: Array, enough: Bools) -> dict[int, float]:
    """The sets of three that determine the pose where they are visible, by index, with their quality."""
    out = {}
    for i in range(len(triples)):
        mine = which == i
        if not (mine & enough).any():
            continue
        value = float(np.median(quality[mine & enough]))
        if value > FIXES:
            out[i] = value
    return out


def _weights(
    model: SpotModel,
    triples: Sequence[tuple[int, int, int]],
    good: dict[int, float],
    which: Ints,
    views: Ints,
    views_of: Sequence[Ints],
    shown: Array,
    singular: Array,
) -> Array:
    """The volume that each of k poses represents, times the number of sets; 0 for poses from other than good sets."""
    area = np.prod(model.image_size_px, axis=-1)[views].prod(axis=1)
    ways = np.array([np.prod([len(views_of[s]) for s in spots]) for spots in triples], dtype=float)[which]
    met = sum(np.prod(shown[:, list(triples[i])], axis=1) for i in good)
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = area * ways / (np.prod(singular, axis=1) * met)
    return np.where(np.isin(which, list(good)) & (met > 0), weight, 0.0)
