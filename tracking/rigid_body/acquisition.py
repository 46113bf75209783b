"""Search of a frame for the whole vehicle: when, where it may be, which labellings explain the frame's points.

The answers, and mirror solutions of three spots, become children of the hypotheses and are scored like all others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Ints
from geometry.compiled_projection import project_all
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from geometry.pose_solver.visibility import alternative_poses, symmetries
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigUncertainty
from tracking.detections import Detections
from tracking.labelling.first_labels import NO_POINT, Labelling, candidate_labellings, find_labels
from tracking.labelling.search import plan_of
from tracking.parameters import TrackerParameters
from tracking.rigid_body.association.frame_detections import (
    BLENDED,
    NOT_SEARCHED,
    FrameDetections,
    Observation,
    detection_log_likelihood,
    distinct_spots,
    in_picture,
    log_clutter_ratio,
)
from tracking.rigid_body.frame_summary import is_lost
from tracking.rigid_body.hypotheses.hypothesis_set import (
    MAX_TRACKING_SIGMA_PX,
    MIN_CONFIRMING_SPOTS,
    MIN_REDUNDANT_SPOTS,
    Children,
    Dynamics,
    Hypotheses,
    State,
    add_child,
    iterated_update,
)
from tracking.rigid_body.models.information import has_clocks
from tracking.rigid_body.models.motion import ANY_MOMENT, predicted
from tracking.rigid_body.models.occlusion import MISSED, predict, update
from tracking.statuses import Event

# Sigmas of the motion of a vehicle that has just been found.
FIRST_SPEED, FIRST_RATE = 4.0, 6.0  # m/s, rad/s
FIRST_ACCELERATION, FIRST_ANGULAR_ACCELERATION = 30.0, 100.0  # m/s^2, rad/s^2
# Sigmas of the motion between the pictures of one frame in a search by geometry alone: each search tries some shares of
# them, since with the fastest motion no pose of few spots can be distinguished from another. px/s where the prior's
# centre shows no spot.
SEARCH_SPEED, SEARCH_RATE, SEARCH_PX_S = 1.0, 1.0, 1500.0  # m/s, rad/s
SEARCH_SHARES = (1.0, 0.2, 0.04)  # of these speeds, tried in turn where clocks differ
# Largest motion of a spot in the error of a clock that is not known yet: a vehicle that moves faster is found later.
SEARCH_CLOCK_PX = 8.0
# Limits of the search around the last pose; beyond the second one a fan of beams looks like itself, turned.
MAX_DISTANCE_M, MAX_TURN_RAD = 1.5, np.deg2rad(60.0)
# Spots of two poses nearer than this are the same. A vehicle that is symmetric up to more than this can be measured.
SAME_SPOT_PX = 0.1
MAX_CANDIDATES = 4  # labellings of one search
STATIC_LOG_DENSITY = -4.0  # 1/px^2: points where static ones are denser are left out of most searches


class Acquisition:
    """Searches frames by geometry alone (tracking/labelling)."""

    def __init__(
        self,
        rig: Rig,
        model: SpotModel,
        parameters: TrackerParameters,
        prior: PosePrior,
        calibration: RigUncertainty | None,
    ) -> None:
        """prior: where the vehicle is in the first frame."""
        self._rig, self._model, self._parameters = rig, model, parameters
        self._prior, self._calibration = prior, calibration
        self._tie_reported = False

    def vehicle_found(self) -> None:
        """The vehicle has been measured; the next tie is reported again."""
        self._tie_reported = False

    def search_prior(
        self, last: Pose | None, age_s: float, fastest: Array, just_found: bool, doubted: bool = False
    ) -> PosePrior:
        """Region to search: around the last measured pose, as far as the vehicle may have moved since.

        Before there is one: the run's prior, widened likewise. age_s: time since the last measured pose, or since the
        first frame. fastest (2,): largest measured speeds, m/s and rad/s. just_found: these are hardly known yet.
        doubted: the last measured pose may be wrong.
        """
        p = self._parameters
        if last is not None and doubted:
            return PosePrior(last, max(MAX_DISTANCE_M, self._prior.within_m), max(MAX_TURN_RAD, self._prior.within_rad))
        if last is None:
            if age_s == 0.0 or self._prior.within_rad >= np.pi:
                return self._prior
            within_m = self._prior.within_m + min((FIRST_SPEED + p.reacquire_m_s) * age_s, MAX_DISTANCE_M)
            turned = self._prior.within_rad + (FIRST_RATE + np.deg2rad(p.reacquire_deg_s)) * age_s
            within_rad = min(turned, max(MAX_TURN_RAD, self._prior.within_rad))
            return PosePrior(self._prior.centre, within_m, within_rad)
        speed, rate = fastest + np.array([p.reacquire_m_s, np.deg2rad(p.reacquire_deg_s)])
        if just_found:
            speed, rate = max(speed, 3 * FIRST_SPEED), max(rate, 3 * FIRST_RATE)
        return PosePrior(
            last,
            min(0.05 + speed * age_s, max(MAX_DISTANCE_M, self._prior.within_m)),
            min(np.deg2rad(3.0) + rate * age_s, max(MAX_TURN_RAD, self._prior.within_rad)),
        )

    def log_visible(self, prior: PosePrior) -> float:
        """Log of how many times larger a region of poses is than that of the poses which show enough spots.

        A vehicle that is yet to be found is one whose spots the pictures show: long lenses see them from a small part
        of the region only, as the evidence of a search (tracking/labelling) takes into account as well.
        """
        shown = plan_of(self._rig, self._model, self._parameters.labels.min_spots).log_volume
        return max(prior.log_volume - shown, 0.0)

    def is_ambiguous(self, pose: Pose, age_s: float) -> bool:
        """Whether the prior allows another pose of a symmetric vehicle, which shows the same spots.

        No observation decides between the two. The tracker's weights of the two may drift apart nevertheless, since it
        enumerates assignments and motions of each only in part. age_s: time since the first frame.
        """
        prior = self.search_prior(None, age_s, np.zeros(2), False)
        here = self._model.project(pose)[0]
        twins = [twin for turn in self._symmetries if prior.contains(twin := pose @ turn)]
        return any(self._same_spots(here, self._model.project(twin)[0]) for twin in twins)

    @cached_property
    def _symmetries(self) -> list[Pose]:
        return symmetries(self._model)

    def _same_spots(self, here: Array, there: Array) -> bool:
        """Whether each spot of one pose, (n, 2) px, has a spot of the other one at its place in the same picture."""
        camera = self._model.camera_of
        gap = np.linalg.norm(here[:, None] - there, axis=-1)
        nearest = np.where(camera[:, None] == camera, gap, np.inf)[np.isfinite(here).all(axis=1)].min(axis=1)
        return bool(nearest.max() < SAME_SPOT_PX)

    def labellings(
        self,
        frame: FrameDetections,
        found: Sequence[Detections | None],
        prior: PosePrior,
        first: bool,
        static_too: bool,
        events: list[Event],
    ) -> list[Labelling]:
        """Labellings of the frame that agree with a prior, best first; a tie is added to the events.

        first: the vehicle has not been measured before. static_too: use static points as well.
        """
        p, usable, rows = self._parameters, {}, []
        for c, (name, points) in enumerate(zip(self._model.camera_names, found, strict=True)):
            rows.append(np.zeros(0, dtype=np.int64))
            if points is None:
                continue
            static = frame.log_static[frame.first[c] : frame.first[c + 1]] > STATIC_LOG_DENSITY
            rows[c] = np.arange(len(points)) if static_too else np.flatnonzero(~static)
            usable[name] = points if len(rows[c]) == len(points) else points[rows[c]]
        if sum(len(points) for points in usable.values()) < p.labels.min_spots:
            return []
        tries = [
            {name: self._widened(points, prior, name, share) for name, points in usable.items()}
            for share in (SEARCH_SHARES if has_clocks(found) else SEARCH_SHARES[:1])
        ]
        some: list[Labelling] = []
        if first and not self._tie_reported:
            results = [find_labels(self._rig, self._model, t, prior, p.labels, self._calibration) for t in tries]
            result = max(results, key=lambda r: max((one.score for one in r.candidates), default=-np.inf))
            if result.tie:
                events.append(Event("tie", result.in_words(self._model)))
                self._tie_reported = True
            some = [result.chosen] if result.chosen is not None else list(result.candidates)
        if not some:
            for t in tries:
                some += candidate_labellings(
                    self._rig, self._model, t, prior, p.labels, self._calibration, most=MAX_CANDIDATES
                )
            some = sorted(some, key=lambda one: -one.score)[:MAX_CANDIDATES]
        out: list[Labelling] = []
        for one in some:
            point = one.point_of.copy()
            for v in np.flatnonzero(point != NO_POINT):
                point[v] = rows[self._model.camera_of[v]][point[v]]
            out.append(replace(one, point_of=point))
        return out

    def _widened(self, points: Detections, prior: PosePrior, camera: str, share: float) -> Detections:
        """The points of a picture with covariances for the unknown motion of the vehicle until it was taken.

        share: of the usual motion.
        """
        if points.clock is None or not len(points):
            return points
        mine = self._model.camera_of == self._model.camera_names.index(camera)
        J = self._model.project(prior.centre)[1][mine]  # 0 without a projection
        sigmas = share * np.repeat([SEARCH_SPEED, SEARCH_RATE], 3)
        speed2 = 0.5 * np.sum((J * sigmas) ** 2, axis=(1, 2))
        px_s2 = float(np.median(speed2[speed2 > 0])) if np.any(speed2 > 0) else (share * SEARCH_PX_S) ** 2
        v = points.uv_px[:, 1]
        unknown = np.minimum(points.clock.variance_s2(v) * px_s2, SEARCH_CLOCK_PX**2)
        variance = points.clock.after_s(v) ** 2 * px_s2 + unknown
        return replace(points, cov_px2=points.cov_px2 + variance[:, None, None] * np.eye(2))


P_VISIBLE_AT_START = 0.95  # of each spot and each screen
MAX_LINKED = 3  # hypotheses that a search's answers continue, and children whose mirror solutions are added
DOUBT_NATS = 7.0  # by so much an answer must explain a frame better than a doubted track, both without their history
ALTERNATIVE_NATS = 8.0  # mirror solutions are added to children that are at most this much less likely than the best


class Start(NamedTuple):
    """A predicted state that a pose is to update."""

    state: State
    p_visible: Array  # (n + groups,)
    log_weight: float
    parent: int  # index of the hypothesis of the frame before; -1: none
    manoeuvre: bool  # the state may have jumped, or is unknown


def unknown_vehicle(prior: PosePrior, log_weight: float, visibilities: int, share: float = 1.0) -> Start:
    """A vehicle that is somewhere in the search region and of whose motion nothing is known.

    share: of the usual speeds, as in SEARCH_SHARES.
    """
    where = (min(prior.within_m, 10.0) / np.sqrt(3), prior.within_rad / np.sqrt(3))
    speeds = (share * FIRST_SPEED, share * FIRST_RATE)
    sigmas = [*where, *speeds, FIRST_ACCELERATION, FIRST_ANGULAR_ACCELERATION]
    R, t = np.ascontiguousarray(prior.centre.rotation), np.array(prior.centre.translation)
    state = State(R, t, np.zeros(12), np.diag(np.repeat(sigmas, 3) ** 2))
    return Start(state, np.full(visibilities, P_VISIBLE_AT_START), log_weight, -1, True)


def predicted_hypothesis(h: Hypotheses, k: int, dt_s: float, dynamics: Dynamics, manoeuvre: bool) -> State:
    """Hypothesis k of the frame before, predicted over dt_s."""
    none = np.zeros(2)
    jumps = (dynamics.velocity_jump, dynamics.acceleration_jump) if manoeuvre else (none, none)
    R, t, m, P, _ = predicted(h.R[k], h.t[k], h.m[k], h.P[k], dt_s, dynamics.jerk, *jumps, *ANY_MOMENT)
    return State(R, t, m, P)


def continued_hypotheses(h: Hypotheses, dt_s: float, dynamics: Dynamics, n: int, manoeuvre: bool) -> list[Start]:
    """The likeliest hypotheses of the frame before, predicted with or without a manoeuvre; n: number of views."""
    out = []
    for k in np.argsort(-h.log_weight)[:MAX_LINKED].tolist():
        p = dynamics.p_manoeuvre if manoeuvre else 1 - dynamics.p_manoeuvre
        state = predicted_hypothesis(h, k, dt_s, dynamics, manoeuvre)
        out.append(Start(state, predict(h.p_visible[k], n), float(h.log_weight[k] + np.log(p)), k, manoeuvre))
    return out


def without_history(
    children: Children, count: int, obs: Observation, model: SpotModel, start: Start
) -> tuple[int, Start]:
    """An unknown vehicle's start whose answers compete with the best child as if that had no history either.

    Where the track itself is doubted, its narrow prediction must not count for it: a wrong pose that has been followed
    for some frames predicts its few points better than an unknown vehicle predicts all of its spots. Also returns the
    number of children, to which the best child's labels of this start are added.
    """
    if count == 0:
        return count, start
    best = int(np.argmax(children.hypotheses.log_weight[:count]))
    pose = Pose(children.hypotheses.R[best].copy(), children.hypotheses.t[best].copy())
    weight = float(children.hypotheses.log_weight[best])
    count, place = add_pose(children, count, obs, model, start, children.assigned[best].copy(), pose)
    if place < 0:
        return count, start
    history = weight - float(children.hypotheses.log_weight[place]) - DOUBT_NATS
    return count, start._replace(log_weight=start.log_weight + max(history, 0.0))


def continues(children: Children, count: int, parent: int, assigned: Ints) -> bool:
    """Whether one of the first `count` children continues a hypothesis steadily with the same labels (n,)."""
    labels = np.maximum(children.assigned[:count], MISSED) == np.maximum(assigned, MISSED)
    steady = (children.parent[:count] == parent) & ~children.manoeuvre[:count]
    return bool((labels.all(axis=1) & steady).any())


def add_pose(
    children: Children, count: int, obs: Observation, model: SpotModel, start: Start, assigned: Ints, pose: Pose
) -> tuple[int, int]:
    """Add the update of a state by an assignment (n,) near a pose; see `add_child` for the result."""
    state, log_likelihood, _, _ = iterated_update(
        obs, start.state, assigned, np.array(pose.rotation, order="C"), np.array(pose.translation)
    )
    uv, _ = project_all(obs.views, state.R[None], state.t[None])
    inside = model.in_picture(uv[0]) & obs.frame.has_image[model.camera_of]
    assigned = np.where((assigned < 0) & ~inside, NOT_SEARCHED, assigned)
    log_weight = start.log_weight
    log_weight += log_likelihood + log_clutter_ratio(obs, state.R, state.t, state.P)
    p_in = in_picture(obs, assigned, state.R, state.t)
    log_weight += detection_log_likelihood(obs, start.p_visible, assigned, p_in)
    if not np.isfinite(log_weight):
        return count, -1
    after = update(start.p_visible, obs.view_table.group, assigned, obs.detection_model.p_detect * p_in)
    return add_child(children, count, state, log_weight, after, assigned, False, start.parent)


def add_mirror_solutions(
    children: Children,
    count: int,
    obs: Observation,
    model: SpotModel,
    old: Hypotheses,
    dynamics: Dynamics,
    dt_s: float,
) -> int:
    """Add the other poses that three labelled spots allow to the children; returns the number of children.

    Three spots determine a pose up to a few solutions, and only the motion can distinguish them. Each solution gets
    children of its own, so that one to which the vehicle may have changed remains among the hypotheses.
    """
    w = children.hypotheses.log_weight[:count]
    for c in np.argsort(-w)[:MAX_LINKED].tolist():
        assigned = children.assigned[c].copy()
        exact = (assigned >= 0) & (assigned < BLENDED)
        parent = int(children.parent[c])
        if (
            w[c] < w.max() - ALTERNATIVE_NATS
            or parent < 0
            or distinct_spots(exact, model.spot_of) != MIN_CONFIRMING_SPOTS
        ):
            continue
        pose = Pose(children.hypotheses.R[c].copy(), children.hypotheses.t[c].copy())
        others = alternative_poses(model, pose, np.flatnonzero(exact))
        manoeuvre = bool(children.manoeuvre[c])
        p = dynamics.p_manoeuvre
        log_weight = float(old.log_weight[parent]) + float(np.log(p if manoeuvre else 1 - p))
        state = predicted_hypothesis(old, parent, dt_s, dynamics, manoeuvre)
        for i in range(len(others.translation)):
            start = Start(state, predict(old.p_visible[parent], len(model)), log_weight, parent, manoeuvre)
            count, _ = add_pose(children, count, obs, model, start, assigned, others[i])
    return count


LONG_UNMEASURED = 10  # frames without a measured pose, after which two missing spots are enough to contradict
SEARCH_AT = (2, 4, 8, 14)  # frames in a row that contradict the best hypothesis, at which a search is made
ASTRAY = 15  # frames without a measured pose, after which a contradicted vehicle is searched anywhere
MISSING_TO_DOUBT = 2  # spots of one camera; an answer must explain so many more than the doubted track
CONTRADICTED_INTERVAL = 20  # frames: and after that at each multiple of it
FEW_SPOTS_INTERVAL = 50  # frames in a row with few, uncontradicted labels between two searches
JUST_FOUND = 5  # frames after a successful search: until then the velocities may be almost unknown
# Searches in a row without success, from which on only every so many frames are searched. A failing search of twelve
# spots costs 0.4 s, and an occluded screen may stay so for minutes. More points than before are searched at once.
INTERVALS = ((0, 1), (20, 2), (100, 5), (300, 10), (1000, 20))


def is_vague(model: SpotModel, h: Hypotheses | None, dt_s: float, dynamics: Dynamics) -> bool:
    """Whether the best hypothesis predicts some spot worse than MAX_TRACKING_SIGMA_PX, or no spot at all."""
    if h is None:
        return True
    R, t, _, P = predicted_hypothesis(h, 0, dt_s, dynamics, manoeuvre=False)
    _, J = project_all(model.numbers, R[None], t[None])
    cov = J[0] @ P[:6, :6] @ np.swapaxes(J[0], -1, -2)
    projected = J[0].any(axis=(1, 2))  # project_all gives 0 where there is no projection
    if is_lost(P) or not projected.any():
        return True
    return bool(np.sqrt(np.max(cov[projected][:, [0, 1], [0, 1]])) > MAX_TRACKING_SIGMA_PX)


def _due(frames: int) -> bool:
    """Whether to search after so many frames in a row that give a reason for it."""
    return frames in SEARCH_AT or frames % CONTRADICTED_INTERVAL == 0


class SearchSchedule:
    """Counters over the frames that decide about searches."""

    def __init__(self, model: SpotModel, min_spots: int) -> None:
        """min_spots: points that a frame needs for a search."""
        self._model, self._min_spots = model, min_spots
        self.searches = 0  # in a row without success
        self._since_found = 0  # frames since a search found the vehicle
        self._unmeasured = 0  # frames in a row without a measured pose
        self._contradicted = 0  # frames in a row that contradict the best hypothesis
        self._doubted = 0  # frames in a row whose labels explain the pose, but few of a camera's points
        self._few_spots = 0  # frames in a row that label fewer than MIN_REDUNDANT_SPOTS
        self._points_before = 0  # of all cameras, in the frame before

    @property
    def just_found(self) -> bool:
        """Whether a search has found the vehicle a few frames ago."""
        return self._since_found <= JUST_FOUND

    @property
    def doubted(self) -> bool:
        """Whether the last measured pose may be wrong."""
        return self._doubted > 0

    @property
    def astray(self) -> bool:
        """Whether the vehicle is probably not near the place where it is followed: it moved faster than ever before."""
        return self._contradicted > 0 and self._unmeasured >= ASTRAY

    def next_frame(self) -> None:
        """Count a frame."""
        self._since_found += 1

    def found(self) -> None:
        """A search has given this frame's best hypothesis; the next frame is searched too, to confirm or refute it."""
        self.searches = self._since_found = 0

    def measured(self, whether: bool, spots: int) -> None:
        """Whether this frame's pose is measured, and from how many spots."""
        self._unmeasured = 0 if whether else self._unmeasured + 1
        if whether and spots >= MIN_REDUNDANT_SPOTS:
            self.searches = 0

    def due(
        self, best: Ints | None, found: Sequence[Detections | None], prediction_is_vague: Callable[[], bool]
    ) -> bool:
        """Whether to search this frame: there are enough points, and no hypothesis explains them with certainty.

        best (n,): assignment of the likeliest child; None without one. prediction_is_vague: whether the best hypothesis
        predicts some spot too badly to track it.
        """
        points, before = sum(len(f) for f in found if f is not None), self._points_before
        self._points_before = points
        doubted, self._doubted = self._doubted, 0
        if points < self._min_spots:
            return False
        if best is not None:
            explained = distinct_spots(best >= 0, self._model.spot_of) >= MIN_REDUNDANT_SPOTS
            vague = (self.just_found or not explained) and prediction_is_vague()
            if explained and not vague:
                self._few_spots = 0
                self._doubted = doubted + 1 if self._doubtful(best, found) else 0
                return self._doubted > 0 and _due(self._doubted)
            if not vague:
                self._few_spots += 1
                if self._contradicts(best, found):
                    return _due(self._contradicted)
                # Few spots of a well predicted vehicle mean that the others are occluded; rarely that they are false.
                return self._few_spots % FEW_SPOTS_INTERVAL == 0
        # At once when spots reappear, then less and less often: a search that keeps failing will fail again.
        self.searches += 1
        more = points > before + 1
        interval = next(frames for least, frames in reversed(INTERVALS) if self.searches > least)
        return more or self.searches % interval == 0

    def _doubtful(self, best: Ints, found: Sequence[Detections | None]) -> bool:
        """Whether most spots of a camera are missing although it has as many other points.

        A reflection may pass for the only spot of a screen: with the spots of another one, it determines a wrong pose.
        """
        for c, f in enumerate(found):
            mine = best[self._model.camera_of == c]
            missing, labelled = int(np.count_nonzero(mine == MISSED)), int(np.count_nonzero(mine >= 0))
            if f is not None and missing >= max(MISSING_TO_DOUBT, labelled + 1) and len(f) >= missing + labelled:
                return True
        return False

    def _contradicts(self, best: Ints, found: Sequence[Detections | None]) -> bool:
        """Whether a camera has enough points, but none where several spots are expected; counts such frames.

        Those of all cameras count together, since with two beams none expects several. After some frames without a
        measured pose fewer contradict: one or two labels agree with almost any pose.
        """
        missed, labelled = best == MISSED, best >= 0
        long = self._unmeasured >= LONG_UNMEASURED
        least, elsewhere = 2 if long else MIN_CONFIRMING_SPOTS, 0
        contradicts = False
        for c, f in enumerate(found):
            if f is None:
                continue
            mine = self._model.camera_of == c
            missing = int(np.count_nonzero(missed & mine))
            spare = len(f) - int(np.count_nonzero(labelled & mine))
            contradicts |= missing >= least and len(f) >= missing
            elsewhere += min(missing, max(spare, 0))
        contradicts |= elsewhere >= least
        self._contradicted = self._contradicted + 1 if contradicts else 0
        return contradicts
