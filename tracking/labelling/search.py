"""Candidate labellings of one frame, with or without a prior: what a rig sees, and the steps of the search."""

from __future__ import annotations

import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.forward_model import SpotModel
from geometry.planes import intersect_surface
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from geometry.pose_solver.gauss_newton import PoseFit, fit_pose
from geometry.pose_solver.three_spots import poses_from_three_spots
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigUncertainty
from tracking.detections import Detections
from tracking.labelling.candidates import BestCandidates, generate
from tracking.labelling.completion import SHARES, complete_all
from tracking.labelling.points import (
    NO_POINT,
    LabelLimits,
    LabelProblem,
    Points,
    PointsOnScreens,
    SpotGeometry,
    on_screens,
    points_of,
)
from tracking.parameters import LabelParameters

# The poses in which a rig sees enough of its spots, and the sets of three spots for candidate poses.
#
# Three spots at random pixels of their pictures give poses in closed form. A pose is sampled with a density
# proportional to |det J|, the Jacobian of the three spots' six pixels, and by every set of three views that sees it;
# its weight is the inverse. Poses drawn uniformly from the lab's space would hardly ever show a spot to a long lens
# (one in 1e6 at f = 6000 px). Any set of visible spots contains enough of the selected sets of three. Source: ours.

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
    columns = np.array([[spots.index(s) for s in t] for t in names], dtype=np.int64).reshape(-1, 3)
    quality = np.array([triples[t] for t in names])
    rng = np.random.default_rng(0)
    chosen: list[int] = []
    stages: dict[int, int] = {}
    for size in range(len(spots), least - 1, -1):
        sets = np.array(list(combinations(spots, size)))
        if len(sets) > MOST_SETS:
            sets = sets[rng.choice(len(sets), MOST_SETS, replace=False)]
        members = (sets[:, :, None] == spots).any(axis=1)  # (sets, spots)
        covers = members[:, columns].all(axis=-1).T.astype(float)
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


# The largest model error considered, as a multiple of `model_sigma_px`: the evidence is the mean over several sizes up
# to this one.
LARGEST_MODEL_ERROR = 2.0
P_MISFIT = 1e-6  # probability that the correct labels are rejected because of their misfit
FEWEST_POINTS = 6  # least number of points per camera that are used in a crowd; the clearest
LEAST_LIKELY = 25.0  # nats: labellings with a larger distance to the best are not reported


@dataclass(frozen=True, slots=True)
class Labelling:
    """A pose and the points that it explains."""

    fit: PoseFit
    point_of: Ints  # (n views,) row in its camera's detections, or NO_POINT
    score: float  # log evidence against "all points are false", nats: the likelihood averaged over the prior's poses
    expected: int  # number of views that the pose predicts in the picture


@dataclass(frozen=True, slots=True)
class RigPlan:
    """The data of a rig that the search uses, computed once."""

    model: SpotModel
    everywhere: PosePrior
    triples: Ints  # (k, 3) spots: the first `stages[m]` of them cover any set of m or more visible spots
    stages: Mapping[int, int]
    screen_of_camera: Ints  # (cameras,)
    spot_screen: Ints  # (spots,)
    view_at: Ints  # (spots, cameras)
    spot_point: Array  # (spots, 3)
    spot_ray: Array  # (spots, 3)
    front: Array  # (n, 4) the plane of each view's screen, with the normal towards its camera
    log_volume: float  # m^3 rad^3, of the poses that show at least `min_spots` spots
    typical: Pose | None  # a pose that shows the largest number of spots

    @staticmethod
    def of(rig: Rig, model: SpotModel, min_spots: int) -> RigPlan:
        """Prepare the search for a rig. The rig is the one that `model` was made of."""
        screens = list(rig.screens)
        everywhere = PosePrior.everywhere(rig)
        view_at = np.full((len(model.spot_names), len(model.camera_names)), -1)
        view_at[model.spot_of, model.camera_of] = np.arange(len(model))
        point, ray = np.zeros((len(model.spot_names), 3)), np.zeros((len(model.spot_names), 3))
        point[model.spot_of], ray[model.spot_of] = model.point, model.ray
        spots = sorted({int(s) for s in model.spot_of})
        visible = VisiblePoses.of(rig, model, everywhere, min_spots)
        triples, stages = covering(visible.triples, spots, min(min_spots, len(spots)))
        normal = model.screen_rotation[..., 2]
        camera = -np.einsum("nij,ni->nj", model.camera_rotation, model.camera_translation)
        side = np.sign(np.sum(normal * (camera - model.screen_origin), axis=-1))
        normal = normal * np.where(side < 0, -1.0, 1.0)[:, None]
        return RigPlan(
            model=model,
            everywhere=everywhere,
            triples=triples,
            stages=stages,
            screen_of_camera=np.array([screens.index(rig.cameras[c].screen) for c in model.camera_names]),
            spot_screen=np.array([screens.index(rig.spots[s].screen) for s in model.spot_names]),
            view_at=view_at,
            spot_point=point,
            spot_ray=ray,
            front=np.concatenate([normal, np.sum(normal * model.screen_origin, axis=-1)[:, None]], axis=-1),
            log_volume=visible.log_volume,
            typical=visible.typical,
        )


MOST_PLANS = 128  # kept; the mistakes of a set-up (tracking/setup_mistakes) are 60 rigs that are searched in turn
_plans: list[tuple[Rig, int, bytes, RigPlan]] = []


def plan_of(rig: Rig, model: SpotModel, min_spots: int) -> RigPlan:
    """The plan of a rig, cached for the last rigs; `model` is made of the rig.

    Runs that are processed one after the other mostly have the same rig, each read from its file.
    """
    for known, least, _, plan in _plans:
        if known is rig and least == min_spots:
            return plan
    content = pickle.dumps((rig, min_spots))
    equal = (plan for _, _, known, plan in _plans if known == content)
    plan = next(equal, None) or RigPlan.of(rig, model, min_spots)
    _plans.insert(0, (rig, min_spots, content, plan))
    del _plans[MOST_PLANS:]
    return plan


def candidate_labellings(
    rig: Rig,
    model: SpotModel,
    detections: Mapping[str, Detections],
    prior: PosePrior | None = None,
    parameters: LabelParameters | None = None,
    calibration: RigUncertainty | None = None,
    most: int = 8,
) -> list[Labelling]:
    """The at most `most` labellings of one frame that best explain its points, best first.

    detections: by camera name; a camera without a picture is absent. The rig is the one that `model` was made of.
    prior: None for all poses in which the rig can see its spots. calibration: the effect of the calibration's errors on
    the spots, if known. A labelling has at least `parameters.min_spots` spots.
    """
    parameters = LabelParameters() if parameters is None else parameters
    plan = plan_of(rig, model, parameters.min_spots)
    prior = plan.everywhere if prior is None else prior
    log_volume = min(prior.log_volume, plan.log_volume)
    points = points_of(rig, model, detections, parameters, partial(_reached_by_any, plan, prior))
    has_image = np.array([model.camera_names[c] in detections for c in model.camera_of])
    spots = _spot_geometry(plan, points, has_image, parameters, _calibration_cov_px2(plan, calibration))
    limits = LabelLimits(
        np.ascontiguousarray(prior.centre.rotation, dtype=np.float64),
        np.array(prior.centre.translation, dtype=np.float64),
        prior.half_width_m,
        float(1 + 2 * np.cos(prior.largest_turn_rad)) - 1e-9,
        parameters.p_detect,
        parameters.min_spots,
    )
    problem = LabelProblem(model.numbers, spots, points, limits, plan.front)
    reached = _reached(plan, prior, points.world)
    sigma_px = LARGEST_MODEL_ERROR * parameters.model_sigma_px
    best = BestCandidates.none(parameters.max_refined, len(model))
    brightness_known = all(np.isfinite(found.flux).any() for found in detections.values() if len(found))
    for screens, most_triples in _within_budget(plan, problem, reached, parameters, brightness_known, sigma_px):
        done = 0
        for size, end in plan.stages.items():
            stage = plan.triples[done : min(end, most_triples)]
            stage = np.ascontiguousarray(stage[(spots.spot_screen[stage] >= 0).all(axis=1)])
            done = end
            generate(problem, screens, reached, stage, best)
            # Labellings that are not covered yet explain at least two spots fewer, so they cannot compete.
            if done >= most_triples or _spots_of_best(plan, problem, best) > size:
                break
    return _completed(plan, problem, prior, log_volume, best, calibration, most, sigma_px)


def crowd_of_unknown_brightness(
    rig: Rig,
    model: SpotModel,
    detections: Mapping[str, Detections],
    prior: PosePrior | None,
    parameters: LabelParameters,
    limit: int,
) -> tuple[str, int] | None:
    """A camera with more than `limit` points that may be spots under the prior but have no flux, and their number."""
    crowds = [n for n, found in detections.items() if len(found) > limit and not np.isfinite(found.flux).any()]
    if not crowds:
        return None
    plan = plan_of(rig, model, parameters.min_spots)
    prior = plan.everywhere if prior is None else prior
    for name in crowds:
        camera = rig.cameras[name]
        screen = rig.screens[camera.screen]
        places = intersect_surface(*camera.rays(detections[name].uv_px), screen.world_from_screen, screen.bow)
        count = int(np.count_nonzero(_reached_by_any(plan, prior, model.camera_names.index(name), places)))
        if count > limit:
            return name, count
    return None


def _reached(plan: RigPlan, prior: PosePrior, places: Array) -> Bools:
    """Which places (m, 3), m, each spot may light under a prior: (spots, m)."""
    rays = list(zip(plan.spot_point, plan.spot_ray, strict=True))
    return np.array([prior.reaches(p, r, places) for p, r in rays], dtype=bool).reshape(len(rays), len(places))


def _reached_by_any(plan: RigPlan, prior: PosePrior, camera: int, places: Array) -> Bools:
    """Which places (m, 3), m, on the screen of a camera any of its spots may light."""
    mine = plan.view_at[:, camera] >= 0
    return np.asarray(_reached(plan, prior, places)[mine].any(axis=0) & np.isfinite(places).all(axis=-1))


def _spots_of_best(plan: RigPlan, problem: LabelProblem, best: BestCandidates) -> int:
    """The number of spots that the likeliest candidate so far explains."""
    if not best.taken[0]:
        return 0
    _, _, labels, evidence, _, _ = complete_all(problem, best, 1)
    return len(set(plan.model.spot_of[labels[0] != NO_POINT])) if evidence[0] > -np.inf else 0


def _within_budget(
    plan: RigPlan,
    problem: LabelProblem,
    reached: Bools,
    parameters: LabelParameters,
    brightness_known: bool,
    sigma_px: float,
) -> list[tuple[PointsOnScreens, int]]:
    """The points and the number of the plan's triples to be used, in one or two passes: `max_triples` sets of points.

    In a crowd the sets are divided among all points with few triples of spots, which are enough if most spots are
    visible, and the clearest points with all triples. Spots are clearer than most false points, but reflections
    may be clearer than they are. If the brightness is unknown, the first pass has all sets.
    """
    points, spot_geometry = problem.points, problem.spots
    most, budget = parameters.max_points, parameters.max_triples
    screen_count = int(plan.screen_of_camera.max()) + 1
    passes: list[tuple[PointsOnScreens, int]] = []
    while True:
        screens = on_screens(points, plan.screen_of_camera, screen_count, sigma_px, most)
        options = np.zeros(len(plan.spot_screen))
        for spot, k in enumerate(spot_geometry.spot_screen):
            if k >= 0:
                options[spot] = np.count_nonzero(reached[spot, screens.point[screens.first[k] : screens.first[k + 1]]])
        sets = np.cumsum(np.prod(options[plan.triples], axis=1))
        if not len(sets) or sets[-1] <= budget:
            return [*passes, (screens, len(sets))]
        if not brightness_known or most <= FEWEST_POINTS:
            return [*passes, (screens, max(1, int(np.count_nonzero(sets <= budget))))]
        if not passes:
            budget = budget // 2
            passes.append((screens, max(1, int(np.count_nonzero(sets <= budget)))))
        most = max(int(0.8 * most), FEWEST_POINTS)


_calibration_covs: list[tuple[RigUncertainty, RigPlan, Array]] = []


def _calibration_cov_px2(plan: RigPlan, calibration: RigUncertainty | None) -> Array:
    """The calibration's covariance of each view's pixel (n, 2, 2), px^2, in a typical pose; cached."""
    n = len(plan.model)
    if calibration is None or plan.typical is None:
        return np.zeros((n, 2, 2))
    for spread, of, px2 in _calibration_covs:
        if spread is calibration and of is plan:
            return px2
    px2 = calibration.at(plan.typical).reshape(n, 2, n, 2)[np.arange(n), :, np.arange(n)].copy()
    _calibration_covs.insert(0, (calibration, plan, px2))
    del _calibration_covs[8:]
    return px2


def _spot_geometry(
    plan: RigPlan, points: Points, has_image: Bools, parameters: LabelParameters, known_cov: Array
) -> SpotGeometry:
    """The views for compiled code; known_cov (n, 2, 2), px^2: of the calibration."""
    model = plan.model
    sigma2 = (LARGEST_MODEL_ERROR * parameters.model_sigma_px) ** 2
    with_points = {
        int(plan.screen_of_camera[c]) for c in range(len(model.camera_names)) if points.first[c + 1] > points.first[c]
    }
    seen = np.isin(plan.spot_screen, list(with_points)) & (plan.view_at >= 0).any(axis=1)
    return SpotGeometry(
        model.camera_of,
        model.spot_of,
        model.image_size_px,
        has_image,
        known_cov + sigma2 * np.eye(2),
        known_cov,
        sigma2,
        plan.view_at,
        plan.spot_point,
        plan.spot_ray,
        np.where(seen, plan.spot_screen, -1),
    )


def _completed(
    plan: RigPlan,
    problem: LabelProblem,
    prior: PosePrior,
    log_volume: float,
    best: BestCandidates,
    calibration: RigUncertainty | None,
    most: int,
    sigma_px: float,
) -> list[Labelling]:
    """The best candidates completed, without duplicates, best first."""
    model, points = plan.model, problem.points
    R, t, labels_of, evidences, shares, expected_of = complete_all(problem, best, int(best.taken[0]))
    evidences = evidences - log_volume
    out: list[Labelling] = []
    kept: list[tuple[Pose, Ints]] = []
    for k in np.argsort(-evidences, kind="stable"):
        evidence, pose, labels = evidences[k], Pose(R[k], t[k]), labels_of[k]
        if len(out) == most or not evidence > evidences.max() - LEAST_LIKELY:
            break
        if any(np.array_equal(labels, other) and _near(pose, there) for there, other in kept):
            continue
        kept.append((pose, labels))
        fit = _consistent_fit(model, points, labels, pose, SHARES[: shares[k] + 1] * sigma_px, calibration)
        if fit is None or not bool(prior.contains(fit.world_from_body)):
            continue
        point_of = np.where(labels == NO_POINT, NO_POINT, points.row[np.maximum(labels, 0)])
        out.append(Labelling(fit, point_of, float(evidence), int(expected_of[k])))
    return out


def _consistent_fit(
    model: SpotModel,
    points: Points,
    labels: Ints,
    start: Pose,
    model_errors_px: Array,
    calibration: RigUncertainty | None,
) -> PoseFit | None:
    """The fit to labelled points with the smallest model error under which all points agree.

    model_errors_px: in descending order. None if the points do not agree even with the largest one. A spot that is
    merged with a neighbour may have a residual of many of its own sigmas while all others agree.
    """
    rows = np.flatnonzero(labels != NO_POINT)
    chosen = labels[rows]
    for sigma_px in model_errors_px[::-1]:
        covariances = points.cov[chosen] + sigma_px**2 * np.eye(2)
        fit = fit_pose(model, rows, points.uv[chosen], covariances, start, calibration=calibration)
        if fit is None or not fit.observable:
            return None
        if fit.consistent(P_MISFIT):
            return fit
    return None


def _near(one: Pose, other: Pose) -> bool:
    """Whether two poses with the same labels are the same solution."""
    difference = one.minus(other)
    return bool(np.abs(difference[:3]).max() < 0.02 and np.abs(difference[3:]).max() < 0.02)
