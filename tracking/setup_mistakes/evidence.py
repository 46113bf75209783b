"""How well a rig explains a recording, which mistake explains it better, and which mistakes no recording shows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from geometry.pose_solver.gauss_newton import PoseFit, whiten
from geometry.pose_solver.visibility import assumed_range, poses_within
from geometry.rig import Rig
from geometry.uncertainty.chi_square import chi2_limit
from geometry.uncertainty.rig_uncertainty import RigCovariance, RigUncertainty
from tracking.detections import Detections
from tracking.labelling.points import NO_POINT
from tracking.labelling.search import Labelling, candidate_labellings
from tracking.parameters import LabelParameters
from tracking.resting_points import NOWHERE, Three, at_places, resting_places
from tracking.setup_mistakes.possible import FEW_POSES, HERE, Block, Mistake, effect_on, possible_mistakes

# How well a rig explains sampled frames of a recording, and which mistake explains them better.
#
# Each frame is labelled without a track (tracking/labelling): the evidence of its best pose against "all points are
# false", summed over the frames, compares a mistake with the set-up as given (Bayes factor of two models). Source:
# ours.

LEAD_NATS = 30.0  # by which a mistake must explain the frames better than the set-up as given ...
# ... or this, where it gives labels to several points more: at rest all frames are one, and four spots have 17 nats. In
# 300 correct recordings no mistake but wrong numbers leads by 8. One false point at the place of a spot leads by 18.
LEAST_NATS, SEVERAL = 15.0, 2
LEAST_SEEN = 0.75  # share of the spots that the poses without the mistake put into the pictures, which has a label
MORE_LABELS = 0.5  # per frame, that fit a pose: a mistake must explain more points
SAME_NATS = 10.0  # mistakes nearer to the best are named with it
LONGEST_SEARCH = 2  # frames with which all mistakes are compared; fewer where one of them leads
BEST = 5  # mistakes that are compared with all frames
ENOUGH = 6  # frames; further ones are used only where these show no mistake and one leads
LEAST_FITTING = 0.75  # share of the frames that a set-up must explain to their sigmas
SURE_SPOTS = 5  # labels of a frame: false points often agree with the pose of four
P_FIT = 1e-6  # probability that correct labels do not fit their sigmas
LEAST_POINTS = 2  # points per picture, median, from which a camera without any label is reported
LEAST_LABELLED = 0.5  # share of the spots that the poses put into a camera's pictures which have a label
RESTING = 0.75  # share of the frames in which a lamp is found; some of them are neighbours
MOST_CHANGED = 1  # false points that come or go between frames that are alike
MODEL_PX = 0.03  # px: model error that is allowed beside the sigmas of the points (calibrations are no better)
# A frame is searched with at most this effort: 60 mistakes are compared.
MOST_POINTS, MOST_TRIPLES = 12, 3000


@dataclass(frozen=True, slots=True)
class Frames:
    """Sampled frames. `at_start`: the first block is at the start of the recording, where the prior holds."""

    blocks: Sequence[Block]
    prior: PosePrior | None
    at_start: bool


@dataclass(frozen=True, slots=True)
class Explained:
    """How well a set-up explains K frames."""

    nats: Array  # (K,) evidence of the best pose; 0: no pose is better than "all points are false"
    fits: Bools  # (K,) the pose fits its points to their sigmas
    labelled: Ints  # (K, c) points with a label, by camera
    expected: Ints  # (K, c) spots that the pose puts into the picture
    points: Ints  # (K, c)
    changed: Ints  # (K,) points with the label of a spot that the mistake changes

    @property
    def good(self) -> bool:
        """Whether the frames are explained."""
        return bool(self.fits.mean() >= LEAST_FITTING) and not self.with_few_labels(LEAST_LABELLED)

    @property
    def is_certain(self) -> bool:
        """Whether the frames are explained, with more spots than agree by chance."""
        many = self.labelled.sum(axis=1) >= SURE_SPOTS
        return self.good and bool((self.fits & many).mean() >= LEAST_FITTING)

    @property
    def first(self) -> Explained:
        """Of the first frame only."""
        return Explained(*(getattr(self, name)[:1] for name in Explained.__slots__))

    def lead(self, given: Explained) -> float:
        """The nats by which these frames are explained better than by the set-up as given."""
        return float(self.nats.sum() - given.nats.sum())

    def with_few_labels(self, share: float = 0.0) -> tuple[int, ...]:
        """Cameras with points whose labels are at most this share of the spots that they should see."""
        enough = np.median(self.points, axis=0) >= LEAST_POINTS
        few = self.labelled.sum(axis=0) <= share * self.expected.sum(axis=0)
        return tuple(int(c) for c in np.flatnonzero(enough & few))


@dataclass(frozen=True, slots=True)
class Comparison:
    """The set-up as given, and the mistakes that explain the recording better, best first."""

    given: Explained
    found: tuple[tuple[Mistake, Explained], ...]


def compare(
    rig: Rig, frames: Frames, parameters: LabelParameters, covariance: RigCovariance | None = None
) -> Comparison:
    """Test all possible mistakes, unless the set-up as given explains the frames.

    covariance: of the rig's calibration, if known.
    """
    blocks = _without_resting(_distinct(frames.blocks), parameters.min_spots)
    unlimited, frames = parameters, replace(frames, blocks=blocks)
    parameters = replace(
        parameters,
        max_points=min(parameters.max_points, MOST_POINTS),
        max_triples=min(parameters.max_triples, MOST_TRIPLES),
    )
    as_given = Mistake("", "", "", rig)
    given = explained(as_given, replace(frames, blocks=frames.blocks[:ENOUGH]), parameters, covariance)
    certain = given.is_certain
    if certain and _first_is_in_prior(given, frames):
        return Comparison(given, ())
    # Of a rig that few poses of the prior let see enough spots, the same says nothing about a mistake.
    few = parameters.min_spots
    often = _may_see(rig, frames.prior, few)
    has_effect = effect_on(rig, outside=not often)
    left: list[tuple[Mistake, Explained | None]] = [
        (m, None)
        for m in possible_mistakes(rig, frames.prior)
        if (m.rig is rig or (has_effect(m) and (not often or _may_see(m.rig, frames.prior, few))))
        and (m.prior is not None or not certain)
    ]
    whole: list[tuple[Mistake, Explained]] = []
    for k, block in enumerate(frames.blocks):
        one = Frames([block], frames.prior, frames.at_start and k == 0)
        if k >= ENOUGH:
            if any(_better(m, e, rig, given) for m, e in whole):
                frames = replace(frames, blocks=frames.blocks[:k])
                break
            # Where many frames are needed the vehicle hardly moves, and hidden spots look like another number.
            left = [(m, s) for m, s in left if m.kind != "numbers"]
            if not left:
                return Comparison(given, ())
            given = _joined(given, explained(as_given, one, parameters, covariance))
        whole = [(m, _joined(s, explained(m, one, parameters, covariance))) for m, s in left]
        gains = [float(s.nats.sum() - given.nats[: k + 1].sum()) for _, s in whole]
        order = sorted(range(len(whole)), key=lambda i: -gains[i])
        if k + 1 >= LONGEST_SEARCH and gains[order[0]] <= 0:
            return Comparison(given, ())
        if gains[order[0]] >= LEAD_NATS or k + 1 >= LONGEST_SEARCH:
            order = order[:BEST]
        left = [*(whole[i] for i in order)]
    whole.sort(key=lambda one: -float(one[1].nats.sum()))
    found = [one for one in whole if _better(*one, rig, given)]
    if found:
        # In a crowd the limited search misses poses by chance, which is no evidence for a mistake.
        given = explained(as_given, frames, unlimited, covariance)
        if given.is_certain and _first_is_in_prior(given, frames):
            return Comparison(given, ())
        found = [one for one in found if _better(*one, rig, given)]
        # A spot that was hidden in one of two pictures of a camera is found with the other one, whichever way they are
        # numbered: only the same pictures of the camera are evidence.
        found = [
            (m, e)
            for m, e in found
            if m.kind != "numbers" or e.lead(given) + _lead_beside(m, rig, frames, parameters, covariance) >= LEAD_NATS
        ]
    # Beams whose ends are exchanged hardly ever meet a screen: such a rig explains what one without these beams does.
    found = [(m.elsewhere if m.beams and not e.changed.any() else m, e) for m, e in found]
    limit = float(found[0][1].nats.sum()) - SAME_NATS if found else 0.0
    # Where the rig explains all frames but the first, a prior that excludes it is named only if it is in other units:
    # the search for the first pose reports any other.
    return Comparison(
        given, tuple((m, e) for m, e in found if e.nats.sum() >= limit and not (certain and m.kind == "prior"))
    )


def _lead_beside(
    mistake: Mistake, rig: Rig, frames: Frames, parameters: LabelParameters, known: RigCovariance | None
) -> float:
    """The nats by which wrong numbers of a camera explain the counterparts of the frames better."""
    given, without = (explained(m, frames, parameters, known) for m in mistake.counterparts(rig))
    return without.lead(given)


def _first_is_in_prior(given: Explained, frames: Frames) -> bool:
    """Whether a pose within the prior explains the first frame, the only one that a prior refers to."""
    return not frames.at_start or frames.prior is None or bool(given.nats[0] > 0)


def _distinct(blocks: Sequence[Block]) -> list[Block]:
    """The blocks without those that show what an earlier one shows.

    Of a vehicle at rest false points fit the pose of a mistake by chance in all frames alike, and hidden spots are
    missing in all: such frames are one piece of evidence.
    """
    out: list[Block] = []
    for block in blocks:
        if not any(_moved(block[HERE], other[HERE]) <= MOST_CHANGED for other in out):
            out.append(block)
    return out


def _without_resting(blocks: Sequence[Block], min_spots: int) -> Sequence[Block]:
    """The blocks without the points that stay in their places, if the others are enough for a pose.

    A room's lamps and edges are brighter than spots, and more of them: a limited search then finds no pose of the
    spots, or one of theirs.
    """
    names = {name for block in blocks for name in block[HERE]}
    seen = {name: [_with_neighbours(block, name) for block in blocks if name in block[HERE]] for name in names}
    places = resting_places(seen, min_spots, RESTING)
    return [
        [{name: of[~at_places(of.uv_px, places.get(name, NOWHERE))] for name, of in frame.items()} for frame in block]
        for block in blocks
    ]


def _with_neighbours(block: Block, name: str) -> Three:
    """A camera's points in a frame, and in those before and after it."""
    before, here, after = (block[k].get(name, Detections.none()).uv_px for k in (0, HERE, -1))
    return before, here, after


def _moved(one: Mapping[str, Detections], other: Mapping[str, Detections]) -> int:
    """The number of points of a frame that another frame does not have at the same place."""
    count = 0
    for name, found in one.items():
        there = other.get(name, Detections.none()).uv_px
        count += int(np.count_nonzero(~at_places(found.uv_px, there)))
    return count


def _may_see(rig: Rig, prior: PosePrior | None, min_spots: int) -> bool:
    """Whether a rig sees enough spots in a quarter of the poses of a prior; it saves searches. True without a prior."""
    if prior is None:
        return True
    model = SpotModel.of(rig)
    seen = model.in_picture(model.project(poses_within(prior, FEW_POSES))[0]).sum(axis=1)
    return bool(np.quantile(seen, 0.75) >= min_spots)


def _joined(one: Explained | None, more: Explained) -> Explained:
    """Of some frames and further ones."""
    if one is None:
        return more
    pairs = ((getattr(one, name), getattr(more, name)) for name in Explained.__slots__)
    return Explained(*(np.concatenate(pair) for pair in pairs))


def _better(mistake: Mistake, one: Explained, rig: Rig, given: Explained) -> bool:
    """Whether a mistake explains the frames that show a pose, and better than the set-up as given.

    Of a prior only the first frame, to which it refers.
    """
    if mistake.prior is not None:
        one, given = one.first, given.first
    shows = one.nats > 0
    fitting = bool(shows.any()) and float(one.fits[shows].mean()) >= LEAST_FITTING
    # A rig with a camera that looks elsewhere is likelier than one whose camera should see spots and does not. Without
    # the mistake no camera loses its labels, and one that the mistake concerns has some.
    before = given.labelled[given.fits].sum(axis=0)
    few = set(one.with_few_labels(LEAST_LABELLED))
    lost = {c for c in few if one.labelled[:, c].sum() < before[c]} - set(given.with_few_labels(LEAST_LABELLED))
    unused = bool(few) and few >= mistake.cameras(rig) != set()
    more = one.labelled[one.fits].sum() - before.sum() >= MORE_LABELS * len(one.fits)
    seen = one.labelled.sum() >= LEAST_SEEN * one.expected.sum()
    several = one.labelled.sum() - given.labelled.sum() >= SEVERAL
    leads = one.lead(given) >= (LEAST_NATS if several else LEAD_NATS)
    return fitting and bool(more) and bool(seen) and not lost and not unused and leads


def explained(
    mistake: Mistake, frames: Frames, parameters: LabelParameters, covariance: RigCovariance | None
) -> Explained:
    """How well the set-up without a mistake explains frames."""
    rig = mistake.rig
    model = SpotModel.of(rig)
    calibration = None if covariance is None else RigUncertainty(rig, model, covariance)
    K, c = len(frames.blocks), len(rig.cameras)
    counts = [np.zeros((K, c), dtype=np.int64) for _ in range(3)]
    out = Explained(np.zeros(K), np.zeros(K, dtype=bool), counts[0], counts[1], counts[2], np.zeros(K, dtype=np.int64))
    changed = np.array([rig.spots[spot].beam in mistake.beams for _, spot in model.views], dtype=bool)
    for k, block in enumerate(frames.blocks):
        prior = (mistake.prior or frames.prior) if k == 0 and frames.at_start else None
        points = mistake.points(block)
        out.points[k] = [len(block[HERE].get(name, ())) for name in rig.cameras]
        if sum(map(len, points.values())) < parameters.min_spots:
            continue
        found = candidate_labellings(rig, model, points, prior, parameters, calibration, most=1)
        if not found or found[0].score <= 0:
            continue
        best = found[0]
        out.nats[k] = best.score
        given = best.point_of != NO_POINT
        out.labelled[k] = np.bincount(model.camera_of[given], minlength=c)
        out.changed[k] = np.count_nonzero(given & changed)
        in_view = model.in_picture(best.fit.projected_px)
        out.expected[k] = np.bincount(model.camera_of[in_view], minlength=c)
        out.fits[k] = _fits(best, model, points) if calibration is None else best.fit.consistent(P_FIT)
    return out


def _fits(one: Labelling, model: SpotModel, points: dict[str, Detections]) -> bool:
    """Whether labelled points agree to their sigmas; `one.fit` allows for a larger model error."""
    rows = one.fit.rows
    cov = np.array([points[model.views[v][0]].cov_px2[one.point_of[v]] for v in rows])
    W = whiten(cov + MODEL_PX**2 * np.eye(2))
    misfit = float(np.sum((W @ one.fit.residuals_px[..., None]) ** 2))
    return one.fit.dof <= 0 or misfit <= chi2_limit(P_FIT, one.fit.dof)


# Mistakes that no recording shows: the rig as given explains what is recorded with them, by other poses.
#
# Each mistake is made in a simulation without noise: the points of poses within the prior, as they would be recorded,
# are labelled with the rig as given. A symmetric rig fits them all. Source: ours.

NAMES = "target"  # the kind of mistakes that may exchange names only
POSES = 200  # of which the TRIED with the most visible spots are tried
TRIED = 2  # poses that must both hide a mistake: one alone may hide it by chance
BESIDE = (0.05, 0.03, -0.04, 0.05, -0.03, 0.04)  # m and rad, from the first pose of a recording to one beside it ...
STEPS = (1.0, -1.0, 0.3, -0.3, 0.1, -0.1)  # ... times the first of these with which most cameras see a spot, ...
NEAR_M, NEAR_RAD = 0.3, 0.3  # ... whose counterpart is searched for this near that of the first
LARGEST_RMS_PX = 0.02  # to which a symmetric rig fits the simulated points, which are exact
P_SAME = 1e-3  # poses of the same points that differ by less than errors of this probability are the same


@dataclass(frozen=True, slots=True)
class Invisible:
    """A mistake that no recording shows, and by how much the poses would be wrong."""

    mistake: Mistake
    off_m: float
    off_deg: float
    chi2: float  # of the poses' difference, with the covariances of both
    rms_px: float  # to which these other poses fit simulated points, which are exact

    @property
    def is_harmless(self) -> bool:
        """Whether the poses are the same to their sigmas, as where only names are exchanged."""
        return self.chi2 < chi2_limit(P_SAME, 6)

    @property
    def is_exact(self) -> bool:
        """Whether the rig as stated hides it, and not only one within its stated sigmas."""
        return self.rms_px < LARGEST_RMS_PX


def invisible_mistakes(
    rig: Rig,
    prior: PosePrior | None,
    parameters: LabelParameters,
    first: Pose | None = None,
    covariance: RigCovariance | None = None,
) -> Iterator[Invisible]:
    """The mistakes that a rig hides over the poses of a prior (without one: of a usual range).

    first: of a recording, to which the prior refers; then only this pose and one beside it are tried. Points have the
    usual error of a calibrated rig as their sigma: a mistake that changes less is none. covariance: of a rig that will
    be refined: the points then fit to the errors that it allows, of each pose by themselves.
    """
    model, sigma_px = SpotModel.of(rig), parameters.model_sigma_px
    calibration = None if covariance is None else RigUncertainty(rig, model, covariance)
    prior = assumed_range(rig) if prior is None else prior
    # A pose on the axis of symmetry is the same with the mistake; the one beside it shows whether others differ.
    beside = np.outer((0.0, *STEPS), BESIDE)
    poses = poses_within(prior, POSES) if first is None else first.plus(beside)
    views = np.count_nonzero(model.in_picture(model.project(poses)[0]).any(axis=0))
    has_effect = effect_on(rig)
    for mistake in possible_mistakes(rig):
        late = any(change.later for change in mistake.pictures.values())
        if mistake.by_itself or late or not (mistake.kind == NAMES or has_effect(mistake)):
            continue
        true = SpotModel.of(mistake.rig)
        pixels, jacobian = true.project(poses)
        seen = true.in_picture(pixels)
        if np.count_nonzero(seen.any(axis=0)) < views:
            continue  # such a rig would have spots that it never sees
        recorded = _recorded(mistake, true, pixels)
        off: list[Array] = []
        # Where the camera with the mistake sees no spot, everything fits.
        seeing = np.count_nonzero([seen[:, true.camera_of == c].any(axis=1) for c in set(true.camera_of)], axis=0)
        if first is None:
            rows = np.argsort(-seen.sum(axis=1), kind="stable")[:TRIED]
        else:
            rows = np.array([0, 1 + np.argmax(seeing[1:])])
        near = prior
        for k in rows:
            points = _detections(mistake, true, recorded[k], seen[k], sigma_px)
            if sum(map(len, points.values())) < max(parameters.min_spots, 1):
                break
            found = candidate_labellings(rig, model, points, near, parameters, calibration, most=1)
            if not found or not _explains_all(found[0], points, calibration is not None):
                break
            pose, fit = poses[int(k)], found[0].fit
            J = jacobian[k][seen[k]].reshape(-1, 6) / sigma_px
            off.append(_off(fit, pose, np.linalg.pinv(J.T @ J, hermitian=True)))
            if first is not None:
                near = PosePrior(fit.world_from_body, NEAR_M, NEAR_RAD)
        if len(off) == TRIED:
            worst = np.max(off, axis=0)
            yield Invisible(mistake, float(worst[0]), float(np.rad2deg(worst[1])), *worst[2:].tolist())


def _recorded(mistake: Mistake, model: SpotModel, pixels: Array) -> Array:
    """Pixels (..., n, 2) as they are recorded with the mistake."""
    out = pixels.copy()
    for name, change in mistake.pictures.items():
        mine = model.camera_of == model.camera_names.index(name)
        out[..., mine, :] = change.recorded(pixels[..., mine, :])
    return out


def _detections(
    mistake: Mistake, model: SpotModel, recorded: Array, seen: Array, sigma_px: float
) -> dict[str, Detections]:
    """The recorded points of one pose, by the camera under whose name they are recorded."""
    out = {}
    for c, name in enumerate(model.camera_names):
        uv = recorded[(model.camera_of == c) & seen]
        change = mistake.pictures.get(name)
        out[name if change is None else change.source] = Detections.at(
            uv, np.tile(sigma_px**2 * np.eye(2), (len(uv), 1, 1))
        )
    return out


def _explains_all(one: Labelling, points: dict[str, Detections], to_sigmas: bool) -> bool:
    """Whether every point has a label, and lies where the pose, which they determine, puts its spot, or near it."""
    fit, labelled = one.fit, int(np.count_nonzero(one.point_of != NO_POINT))
    every = labelled == sum(map(len, points.values()))
    fits = fit.consistent(P_FIT) if to_sigmas else fit.rms_px < LARGEST_RMS_PX
    return every and fit.dof > 0 and fit.observable and fits


def _off(fit: PoseFit, pose: Pose, covariance: Array) -> Array:
    """Distance, m, and angle, rad, of a fitted pose from another one, their chi-square, and the RMS of the fit (4,)."""
    off = fit.world_from_body.minus(pose)
    chi2 = off @ np.linalg.solve(fit.covariance + covariance, off)
    return np.array([np.linalg.norm(off[:3]), np.linalg.norm(off[3:]), chi2, fit.rms_px])
