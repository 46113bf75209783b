"""The rigid tracker: one filter for the vehicle, which carries all spots.

Where Huo, Yang & Yang (2015) track spots that know nothing of each other, here the state is the vehicle's pose with its
velocities and accelerations, all spots of a frame are assigned together, and bends, hiding, the picture's edge, missing
pictures and re-entry are all the same thing: what the detections say about where the vehicle may be. Source: ours; the
parts are in motion.py, association.py, hypotheses.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from geometry.arrays import Array, Ints
from geometry.compiled_projection import project_all
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from geometry.pose_solver.alternative_poses import alternatives
from geometry.pose_solver.gauss_newton import SolveLimits, fit_pose
from geometry.rig import Rig
from geometry.uncertainty.rig_parameters import RigCovariance
from geometry.uncertainty.rig_uncertainty import CalibrationSpread
from tracking.detections import UNMATCHED, Detections
from tracking.input_validation import UsablePoints, check_step
from tracking.labelling.first_labels import NO_POINT, Labelling, candidate_labellings, find_labels
from tracking.parameters import TrackerParameters
from tracking.rigid_body.adaptive_process_noise import AdaptiveProcessNoise
from tracking.rigid_body.association import (
    BLENDED,
    DetectionModel,
    FrameDetections,
    ViewTable,
    distinct_spots,
    log_chance,
    log_clutter_ratio,
)
from tracking.rigid_body.clutter import RADIUS_PX, ClutterNearSpots
from tracking.rigid_body.frame_summary import FrameSummary, ahead, innovation_score, summarise
from tracking.rigid_body.hypotheses import (
    FAR_TOO_VAGUE_PX,
    FEW,
    MIN_CONFIRMING_SPOTS,
    SURE,
    VAGUE_PX,
    Children,
    Hypotheses,
    add_child,
    branch,
    chosen_points,
    iterated_update,
    no_children,
    prune_and_merge,
    spread_of_all,
    wide_views,
    widest,
)
from tracking.rigid_body.information import controlled, fit_alone
from tracking.rigid_body.motion import predicted
from tracking.rigid_body.occlusion import MISSED, joint_log_likelihood, marginal, predict, update
from tracking.rigid_body.static_points import FADES, no_places
from tracking.rigid_body.static_points import learn as learn_static
from tracking.rigid_body.static_points import log_density as log_static_density
from tracking.rigid_body.variance_factor import VarianceFactor
from tracking.statuses import LOST_SIGMA_M, LOST_SIGMA_RAD, PoseStatus, SpotStatus, view_statuses
from tracking.tracked_frame import Event, MotionEstimate, TrackedFrame

# What is known of the motion of a vehicle that has just been found: sigmas.
FIRST_SPEED, FIRST_RATE = 4.0, 6.0  # m/s, rad/s
FIRST_ACCELERATION, FIRST_ANGULAR = 30.0, 100.0  # m/s^2, rad/s^2
P_FRESH = 1e-3  # probability per frame that the vehicle is not where any hypothesis has it
LONG_UNMEASURED = 10  # frames without a measured pose, after which two missing spots are enough to doubt it
SEARCH_AT = (2, 4, 8, 14)  # frames in a row that contradict the hypothesis
DOUBT_FRAMES = 50  # in a row with fewer: then they are doubted
NOWHERE = (SpotStatus.LOST, SpotStatus.OFF_SCREEN)
ENOUGH_EVIDENCE = 7.0  # nats: chance alone reaches it with a probability of exp(-7) = 1e-3 per frame
MOST_EVIDENCE, LEAST_EVIDENCE = 50.0, -5.0  # nats; a vehicle that was never found and is less likely than this goes
ALTERNATIVE_NATS = 8.0  # a child so far behind the best is not asked for its mirror solutions
AMBIGUOUS = 9.0  # share of the frame's own variance that other answers may add to a measured pose of few spots
LARGE = 6  # spots: so many leave only a spot itself unchecked
YOUNG = 5  # frames after a search found the vehicle: until then its velocities may be known to next to nothing
MOST_LINKED, MOST_CANDIDATES = 3, 4  # hypotheses that a search's answers continue, and answers
FARTHEST_M, FARTHEST_RAD = 1.5, np.deg2rad(60.0)  # of a search from the last pose: beyond it a fan looks like itself
STATIC_LOG_DENSITY = -4.0  # 1/px^2: a point where static ones are denser is left out of a search
SIZE_GAIN = 0.1  # of one frame, for how wide a spot usually is


class RigidTracker:
    """Feed it the detections of one frame after the other."""

    def __init__(
        self, rig: Rig, parameters: TrackerParameters, prior: PosePrior, covariance: RigCovariance | None = None
    ) -> None:
        """covariance: of the rig's calibration, where it is known; poses then carry its share."""
        self.rig = rig
        self.model = SpotModel.of(rig)
        self.parameters = parameters
        self.prior = prior
        self.calibration = None if covariance is None else CalibrationSpread(rig, self.model, covariance)
        self.limits = SolveLimits(parameters.max_sigma_m, np.deg2rad(parameters.max_sigma_deg))
        self.misfit = VarianceFactor()
        self.temper = AdaptiveProcessNoise(parameters)
        n = len(self.model)
        self._sights = ViewTable.of(rig, self.model)
        self._groups = int(self._sights.group.max(initial=-1)) + 1
        self._chances = DetectionModel(parameters.p_detect, parameters.p_blend)
        self._clutter = ClutterNearSpots(self.model, parameters.labels.clutter_per_px2)
        self._static = no_places(len(self.model.camera_names))
        self._usual_px = np.full(n, np.nan)  # larger half axis of each view's spot
        self._hypotheses: Hypotheses | None = None
        self._extra = np.zeros((n, 2, 2))  # of the calibration's errors, on the expected pixels ...
        self._systematic = np.zeros((6, 6))  # ... and on the pose
        self._anchor: Pose | None = None  # the last measured pose ...
        self._anchor_age_s = 0.0  # ... and its age
        self._found_before = np.zeros(n, dtype=bool)  # (n,): spots of the best hypothesis in the frame before
        self._saw_any = False  # the frame before showed spots
        self._unmeasured = 0  # frames in a row without a measured pose
        self._doubts = 0  # frames in a row that contradict the best hypothesis
        self._few = 0  # frames in a row with fewer than FEW spots
        self._searches = 0  # in a row without success
        self._points_before = 0  # of all cameras, in the frame before
        self._evidence = 0.0  # nats, of the best hypothesis against "all points are false", until a pose is measured
        self._since_found = 0  # frames since a search found the vehicle
        self._vague_since = False  # no frame has had enough spots since the labels of one were left open
        self._told_tie = False
        self._begun = False

    def begin_at(self, pose: Pose, m: Array, P: Array) -> None:
        """Start from a known state instead of the prior: m (12,) and P (18, 18) as in tracking/rigid_body/motion.py."""
        n = len(self.model)
        self._hypotheses = Hypotheses(
            np.array(pose.rotation, order="C")[None], np.array(pose.translation)[None], m[None].copy(), P[None].copy(),
            np.zeros(1), np.full((1, n + self._groups), 0.95),
        )  # fmt: skip
        self._anchor, self._begun, self._saw_any = pose, True, True
        self.temper.fastest = np.array([np.linalg.norm(m[:3]), np.linalg.norm(m[3:6])])

    @property
    def noise_scale(self) -> float:
        """How much larger than claimed the spots' errors are."""
        return self.misfit.noise_scale

    def step(self, dt_s: float, found: Sequence[Detections | None]) -> TrackedFrame:
        """One frame. dt_s: time since the frame before (0 for the first); found: per camera, None without a picture.

        Points that are none (tracking/input_validation.py) are passed over. Raises ValueError for a step that is not
        forward in time, and for cameras or shapes that do not fit.
        """
        check_step(dt_s, found, self.model.camera_names, not self._begun)
        usable = UsablePoints.of(found)
        self._begun = True
        return usable.as_given(self._step(dt_s, usable.found), self.model.camera_of)

    def _step(self, dt_s: float, found: Sequence[Detections | None]) -> TrackedFrame:
        """The same, with points that can be used."""
        n = len(self.model)
        self._anchor_age_s += dt_s
        events: list[Event] = []
        frame = self._frame(found)
        views = self.model.numbers
        if self._hypotheses is None:
            children, count = no_children(n, self._groups), 0
        else:
            children, count = branch(
                views, self._sights, frame, self._chances, self.temper.dynamics, self._extra, dt_s, self._hypotheses
            )
        predicted = self._predicted_px(dt_s)
        fresh: dict[int, str] = {}
        self._since_found += 1
        if self._should_search(children, count, found, dt_s):
            count = self._search(children, count, frame, found, dt_s, events, fresh)
        if count == 0:
            return self._nothing(found, predicted, events)
        count = self._add_alternatives(children, count, frame, dt_s)
        if self._anchor is None:
            best = float(np.max(children.after.weight[:count]))
            self._evidence = min(best + (0.0 if self._hypotheses is None else self._evidence), MOST_EVIDENCE)
            if self._evidence < LEAST_EVIDENCE:
                self._hypotheses, self._evidence = None, 0.0
                return self._nothing(found, predicted, events)
        staying, places, certain, spread = prune_and_merge(children, count)
        before = self._hypotheses
        self._hypotheses = staying
        return self._conclude(dt_s, found, frame, children, places, certain, spread, predicted, before, events, fresh)

    # -- the frame's detections ---------------------------------------------------------------------------------------

    def _frame(self, found: Sequence[Detections | None]) -> FrameDetections:
        """All cameras' detections in one list, with the errors that the run has shown them to have."""
        counts = [0 if f is None else len(f) for f in found]
        first = np.zeros(len(found) + 1, dtype=np.int64)
        np.cumsum(counts, out=first[1:])
        some = [f for f in found if f is not None]
        major = np.zeros(0)
        if some:
            uv = np.concatenate([f.uv_px for f in some])
            major = np.concatenate([f.major_px for f in some])
            cov = np.concatenate([f.cov_px2 for f in some]) * self.noise_scale**2
            cov[:, [0, 1], [0, 1]] += self.parameters.sigma_model_px**2
            blend = np.where(np.isnan(major), 0.0, self.parameters.blend_px)
        else:
            uv, cov, blend = np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0)
        has_image = np.array([f is not None for f in found])
        static = log_static_density(self._static, uv, cov, first)
        log_clutter, crowded = self._clutter.log_density(first)
        if self._anchor is None:
            # That false points crowd near spots must not make points without any spot evidence of a vehicle.
            log_clutter, crowded = log_clutter - crowded, np.zeros_like(crowded)
        return FrameDetections(uv, cov, blend, first, has_image, log_clutter, static, major, self._usual_px, crowded)

    # -- labels from a prior alone ------------------------------------------------------------------------------------

    def _should_search(self, children: Children, count: int, found: Sequence[Detections | None], dt_s: float) -> bool:
        """Whether to look for the whole vehicle: enough points are there, and no hypothesis explains them for sure."""
        points, before = sum(len(f) for f in found if f is not None), self._points_before
        self._points_before = points
        if points < self.parameters.labels.min_spots:
            return False
        if self._hypotheses is not None and count:
            best = int(np.argmax(children.after.weight[:count]))
            explained = distinct_spots(children.assigned[best] >= 0, self.model.spot_of) >= FEW
            young = self._since_found <= YOUNG
            vague = (young or not explained) and self._vague(self._hypotheses, dt_s)
            if explained and not vague:
                self._few = 0
                return False
            if not vague:
                self._few += 1
                if self._contradicted(children, best, found):
                    return self._doubts in SEARCH_AT or self._doubts % 20 == 0
                # Few spots where the motion is known are mostly hidden ones; seldom they are false points.
                return self._few % DOUBT_FRAMES == 0
        # At once when light returns, then ever more rarely: what fails for long will fail in the next frame too.
        self._searches += 1
        more = points > before + 1
        return more or self._searches <= 20 or self._searches % (2 if self._searches < 100 else 5) == 0

    def _contradicted(self, children: Children, best: int, found: Sequence[Detections | None]) -> bool:
        """Whether a camera shows enough points, but none where the hypothesis expects several spots."""
        missed = children.assigned[best] == MISSED
        here = [
            int(np.count_nonzero(missed & (self.model.camera_of == c))) if f is not None else 0
            for c, f in enumerate(found)
        ]
        least = MIN_CONFIRMING_SPOTS if self._unmeasured < LONG_UNMEASURED else 2
        against = any(m >= least and f is not None and len(f) >= m for m, f in zip(here, found, strict=True))
        self._doubts = self._doubts + 1 if against else 0
        return against

    def _vague(self, hypotheses: Hypotheses, dt_s: float) -> bool:
        """Whether the best hypothesis predicts some spot of this frame worse than VAGUE_PX, or no spot at all."""
        R, t, _, P, _ = self._predicted(hypotheses, 0, dt_s, manoeuvre=False)
        _, J = project_all(self.model.numbers, R[None], t[None])
        spread = J[0] @ P[:6, :6] @ np.swapaxes(J[0], -1, -2)
        there = J[0].any(axis=(1, 2))  # project_all gives 0 where there is no projection
        return self._lost(P) or not there.any() or bool(np.sqrt(np.max(spread[there][:, [0, 1], [0, 1]])) > VAGUE_PX)

    def _predicted(
        self, h: Hypotheses, k: int, dt_s: float, manoeuvre: bool
    ) -> tuple[Array, Array, Array, Array, Array]:
        """Hypothesis k of the frame before, in this frame."""
        dynamics = self.temper.dynamics
        none = np.zeros(2)
        jump, unsteady = (dynamics.jump, dynamics.unsteady) if manoeuvre else (none, none)
        return predicted(h.R[k], h.t[k], h.m[k], h.P[k], dt_s, dynamics.jerk, jump, unsteady)

    def _search_prior(self) -> PosePrior:
        """Around the last measured pose, as far as the vehicle may have moved since; before there is one, the run's
        prior, which is about the first frame, likewise.
        """
        p, age = self.parameters, self._anchor_age_s
        if self._anchor is None:
            if age == 0.0 or self.prior.within_rad >= np.pi:
                return self.prior
            within_m = self.prior.within_m + min((FIRST_SPEED + p.reacquire_m_s) * age, FARTHEST_M)
            turned = self.prior.within_rad + (FIRST_RATE + np.deg2rad(p.reacquire_deg_s)) * age
            within_rad = min(turned, max(FARTHEST_RAD, self.prior.within_rad))
            return PosePrior(self.prior.centre, within_m, within_rad)
        speed, rate = self.temper.fastest + np.array([p.reacquire_m_s, np.deg2rad(p.reacquire_deg_s)])
        if self._since_found <= YOUNG:  # how fast it moves is not known yet
            speed, rate = max(speed, 3 * FIRST_SPEED), max(rate, 3 * FIRST_RATE)
        return PosePrior(
            self._anchor,
            min(0.05 + speed * age, max(FARTHEST_M, self.prior.within_m)),
            min(np.deg2rad(3.0) + rate * age, max(FARTHEST_RAD, self.prior.within_rad)),
        )

    def _search(
        self,
        children: Children,
        count: int,
        frame: FrameDetections,
        found: Sequence[Detections | None],
        dt_s: float,
        events: list[Event],
        fresh: dict[int, str],
    ) -> int:
        """Add what a search of the frame alone finds to the children; how many there are then.

        Each candidate competes as the continuation of every hypothesis, so that two frames' poses make the velocities,
        and as a vehicle of which nothing was known before.
        """
        prior = self._search_prior()
        candidates = self._proposed(frame, found, prior, events)
        if candidates and self._anchor is None and len(candidates) == 1 and candidates[0].fit.dof > 0:
            # Later the scale is known: an answer that then misfits is a wrong one (a scale of 3 after a dark screen).
            self._believe_misfit(frame, candidates[0])
            frame = self._frame(found)
        n = len(self.model)
        starts: list[tuple[tuple[Array, Array, Array, Array], Array, float, int]] = []
        shown = np.full(n + self._groups, 0.95)
        appears = 0.0
        if self._hypotheses is not None:
            # A vehicle that was never found may as well appear now; one that was is rarely not where it was thought.
            appears = -self._evidence if self._anchor is None else float(np.log(P_FRESH))
        where = (min(prior.within_m, 10.0) / np.sqrt(3), prior.within_rad / np.sqrt(3))
        P = np.diag(np.repeat([*where, FIRST_SPEED, FIRST_RATE, FIRST_ACCELERATION, FIRST_ANGULAR], 3) ** 2)
        centre = (np.ascontiguousarray(prior.centre.rotation), np.array(prior.centre.translation), np.zeros(12), P)
        starts.append((centre, shown, appears, -1))
        h = self._hypotheses
        if h is not None and dt_s > 0:
            for k in np.argsort(-h.weight)[:MOST_LINKED].tolist():
                *state, _ = self._predicted(h, k, dt_s, manoeuvre=True)
                weight = float(h.weight[k]) + np.log(self.temper.dynamics.p_manoeuvre)
                starts.append(((state[0], state[1], state[2], state[3]), predict(h.shown[k], n), weight, k))
        known = {tuple(np.maximum(children.assigned[k], MISSED)) for k in range(count)}
        for one in candidates:
            pose = one.fit.world_from_body
            assigned = np.where(one.point_of == NO_POINT, MISSED, one.point_of + frame.first[self.model.camera_of])
            for before, chances, weight, parent in starts:
                count, place = self._add(children, count, frame, assigned, pose, before, chances, weight, parent)
                if place >= 0:
                    fresh.pop(place, None)
                    if tuple(np.maximum(children.assigned[place], MISSED)) not in known:
                        names = ", ".join(self.model.views[v][1] for v in np.flatnonzero(assigned >= 0))
                        fresh[place] = names
        return count

    def _add(
        self,
        children: Children,
        count: int,
        frame: FrameDetections,
        assigned: Ints,
        pose: Pose,
        before: tuple[Array, Array, Array, Array],
        shown: Array,
        weight: float,
        parent: int,
    ) -> tuple[int, int]:
        """Add an assignment (n,) near a pose, as the continuation of one state: children, and its place (-1: none)."""
        views, sights = self.model.numbers, self._sights
        R, t = np.array(pose.rotation, order="C"), np.array(pose.translation)
        R, t, m, P_after, gaussian, _, _ = iterated_update(views, frame, self._extra, before, assigned, R, t)
        uv, _ = project_all(views, R[None], t[None])
        inside = self.model.in_picture(uv[0]) & frame.has_image[self.model.camera_of]
        assigned = np.where((assigned < 0) & ~inside, -2, assigned)
        weight += gaussian + log_clutter_ratio(views, sights, frame, R, t, P_after)
        weight += log_chance(views, sights, frame, self._chances, marginal(shown, sights.group), assigned, R, t)
        weight += joint_log_likelihood(shown, sights.group, assigned, self.parameters.p_detect)
        if not np.isfinite(weight):
            return count, -1
        after = update(shown, sights.group, assigned, self.parameters.p_detect)
        return add_child(children, count, R, t, m, P_after, weight, after, assigned, False, parent)

    def _add_alternatives(self, children: Children, count: int, frame: FrameDetections, dt_s: float) -> int:
        """Add the other poses that so few spots allow, mirror solutions, to the children; how many there are then.

        Three spots fix a pose up to a few solutions; which one it is only the motion can tell. Each solution competes
        with its own, so that one that the vehicle may have changed to is not forgotten.
        """
        h = self._hypotheses
        if h is None or count == 0 or dt_s <= 0:
            return count
        w = children.after.weight[:count]
        for c in np.argsort(-w)[:MOST_LINKED].tolist():
            assigned = children.assigned[c].copy()
            exact = (assigned >= 0) & (assigned < BLENDED)
            parent = int(children.parent[c])
            if (
                w[c] < w.max() - ALTERNATIVE_NATS
                or parent < 0
                or distinct_spots(exact, self.model.spot_of) != MIN_CONFIRMING_SPOTS
            ):
                continue
            pose = Pose(children.after.R[c].copy(), children.after.t[c].copy())
            others = alternatives(self.model, pose, np.flatnonzero(exact))
            manoeuvre = bool(children.manoeuvre[c])
            p = self.temper.dynamics.p_manoeuvre
            weight = float(h.weight[parent]) + float(np.log(p if manoeuvre else 1 - p))
            *state, _ = self._predicted(h, parent, dt_s, manoeuvre)
            before = (state[0], state[1], state[2], state[3])
            for i in range(len(others.translation)):
                shown = predict(h.shown[parent], len(self.model))
                count, _ = self._add(children, count, frame, assigned, others[i], before, shown, weight, parent)
        return count

    def _proposed(
        self, frame: FrameDetections, found: Sequence[Detections | None], prior: PosePrior, events: list[Event]
    ) -> list[Labelling]:
        """Labellings of the frame that a search from the prior alone proposes, best first.

        Points that stay in their place are no spots; every few searches they are looked at all the same.
        """
        p, by_camera, rows = self.parameters, {}, []
        all_points = self._searches % 5 == 0
        for c, (name, points) in enumerate(zip(self.model.camera_names, found, strict=True)):
            rows.append(np.zeros(0, dtype=np.int64))
            if points is None:
                continue
            static = frame.log_static[frame.first[c] : frame.first[c + 1]] > STATIC_LOG_DENSITY
            rows[c] = np.arange(len(points)) if all_points else np.flatnonzero(~static)
            by_camera[name] = points if len(rows[c]) == len(points) else points[rows[c]]
        if sum(len(points) for points in by_camera.values()) < p.labels.min_spots:
            return []
        if self._anchor is None and not self._told_tie:
            result = find_labels(self.rig, self.model, by_camera, prior, p.labels, self.calibration)
            if result.tie:
                events.append(Event("tie", result.in_words(self.model)))
                self._told_tie = True
            some = [result.chosen] if result.chosen is not None else list(result.candidates)
        else:
            some = []
        if not some:
            some = candidate_labellings(
                self.rig, self.model, by_camera, prior, p.labels, self.calibration, most=MOST_CANDIDATES
            )
        out = []
        for one in some:
            point = one.point_of.copy()
            for v in np.flatnonzero(point != NO_POINT):
                point[v] = rows[self.model.camera_of[v]][point[v]]
            out.append(replace(one, point_of=point))
        return out

    def _believe_misfit(self, frame: FrameDetections, one: Labelling) -> None:
        """The labels hold within the model's error; where the claimed sigmas do not, this frame says by how much."""
        labels = one.point_of
        assigned = np.where(labels == NO_POINT, MISSED, labels + frame.first[self.model.camera_of])
        use, uv, cov = chosen_points(frame, assigned, self._extra)
        pose = one.fit.world_from_body
        start = np.ascontiguousarray(pose.rotation), np.ascontiguousarray(pose.translation)
        _, _, _, chi2, count = fit_alone(self.model.numbers, *start, use, uv, cov)
        dof = 2 * count - 6
        if dof > 0 and chi2 / dof > 9.0:
            self.misfit.at_least(chi2 * self.noise_scale**2, dof)

    # -- what the frame's result is -----------------------------------------------------------------------------------

    def _predicted_px(self, dt_s: float) -> Array:
        """Where the best hypothesis expected each spot, (n, 2), before this frame's picture was looked at."""
        h = self._hypotheses
        if h is None or self._lost(h.P[0]):
            return np.full((len(self.model), 2), np.nan)
        return ahead(self.model.numbers, h, dt_s)

    @staticmethod
    def _lost(covariance: Array) -> bool:
        """Whether a pose of this covariance (6 or more, square) says nothing any more."""
        d = covariance.diagonal()
        return bool(max(d[:3]) >= LOST_SIGMA_M**2 or max(d[3:6]) >= LOST_SIGMA_RAD**2)

    def _conclude(
        self,
        dt_s: float,
        found: Sequence[Detections | None],
        frame: FrameDetections,
        children: Children,
        places: Ints,
        certain: Array,
        spread: Array,
        predicted: Array,
        before: Hypotheses | None,
        events: list[Event],
        fresh: dict[int, str],
    ) -> TrackedFrame:
        """The best hypothesis in the words of a TrackedFrame, and what there is to learn from it."""
        p, model = self.parameters, self.model
        best = int(places[0])
        h = self._hypotheses
        assert h is not None
        assigned = children.assigned[best]
        if best in fresh:
            self._searches = self._since_found = 0  # the next frame is searched too: it confirms this one, or does not
        # What was found from a prior alone must lead as it must in labels.py: a tie of 5 to 1 is still a tie.
        unproven = self._anchor is None or best in fresh
        least = max(p.min_label_probability, 1 / (1 + np.exp(-p.labels.lead_nats)) if unproven else 0.0)
        proven = self._anchor is not None or self._evidence >= ENOUGH_EVIDENCE
        parent, spots = int(children.parent[best]), int(distinct_spots(assigned >= 0, model.spot_of))
        doubted = (assigned >= 0) & (certain < SURE)
        sure = distinct_spots((assigned >= 0) & ~doubted, model.spot_of)
        if sure < FEW:
            least = max(least, SURE)  # the others do not check a label
        if spots and before is not None and dt_s > 0 and parent >= 0:
            R, t, _, P, _ = self._predicted(before, parent, dt_s, bool(children.manoeuvre[best]))
            used = np.where(assigned < BLENDED, assigned, -1)
            wide = wide_views(model.numbers, R, t, P, used)
            again = (assigned >= 0) & self._found_before & ~wide
            if self._vague_since and (parent > 0 or distinct_spots(again, model.spot_of) < MIN_CONFIRMING_SPOTS):
                # Labels that nothing checked must not check what comes after them, until a whole pose is found again.
                wide |= used >= 0
            self._vague_since = False
            if wide.any():
                # The motion does not check some label: the other spots must, or it must be beyond doubt.
                least = max(least, SURE)
                use, _, cov = chosen_points(frame, assigned, self._extra)
                unchecked = use & ~controlled(model.numbers, h.R[0], h.t[0], use, cov)
                # A spot that was found in the frame before too confirms itself. A single one that returns where it may
                # be anywhere waits for the next frame, which finds it again or does not.
                new = wide & ~self._found_before
                lone = np.count_nonzero(new) == 1 and (unchecked if spots >= LARGE else unchecked.any()) & new
                far = widest(model.numbers, R, t, P, used) > FAR_TOO_VAGUE_PX
                few = sure < FEW and (unchecked.any() or far or doubted.any())
                if few or np.any(lone):
                    proven, spread = False, spread_of_all(children, places)
                    self._vague_since = True
        elif best in fresh and self._anchor is not None:
            use, _, cov = chosen_points(frame, assigned, self._extra)
            if distinct_spots(controlled(model.numbers, h.R[0], h.t[0], use, cov), model.spot_of) < FEW:
                # Where the others leave a direction of the pose open some false point fits: the next frame must agree.
                proven, spread = False, spread_of_all(children, places)
                self._vague_since = True
        self._found_before = assigned >= 0
        d = summarise(model.numbers, self._sights, frame, h.R[0], h.t[0], assigned, certain, least, RADIUS_PX)
        count = int(np.count_nonzero(d.use))
        # Another pose that is not excluded makes it a prediction, with a covariance that covers both.
        distinct = int(distinct_spots(d.use, model.spot_of))
        ambiguous = distinct <= FEW and bool(np.any(spread.diagonal() > AMBIGUOUS * d.alone.diagonal()))
        measured = count >= 3 and proven and not ambiguous and self._good(d.alone)
        self._unmeasured = 0 if measured else self._unmeasured + 1
        if measured and self.calibration is not None:
            self._look_at_calibration(d, h)
        elif measured:
            # Against the claimed covariances, not those that the scale has already widened: with these the scale
            # settled at the root of the errors' (1.7 where they were 3 times what was claimed).
            self.misfit.take(d.chi2 * self.noise_scale**2, 2 * count - 6)
        systematic = self._systematic
        pose = Pose(h.R[0], h.t[0])
        covariance = h.P[0, :6, :6] + spread + systematic
        known = measured or (self._anchor is not None and not self._lost(covariance))
        # After a frame that showed nothing, one or two points may be false ones: a second such frame must follow.
        alone = distinct_spots(d.labelled, model.spot_of) < MIN_CONFIRMING_SPOTS and not self._saw_any
        self._saw_any = bool((assigned >= 0).any())
        labelled = d.labelled if known and proven and not alone else np.zeros_like(d.labelled)
        predicted_cov: Array | None = None
        if measured:
            if best in fresh:
                events.append(Event(self._kind_of_search(dt_s), f"spots {fresh[best]} found from the prior alone"))
            elif before is not None and dt_s > 0 and children.parent[best] >= 0:
                slope, spread_px = innovation_score(
                    model.numbers,
                    before,
                    int(children.parent[best]),
                    dt_s,
                    self.temper.dynamics.jerk,
                    d.use,
                    d.uv,
                    d.cov,
                )
                if children.parent[best] == 0:  # the one that predicted_px is of
                    predicted_cov = spread_px + self._extra
                self.temper.learn(h.m[0, :6], bool(children.manoeuvre[best]), slope)
            self._anchor, self._anchor_age_s, self._told_tie = pose, 0.0, False
            if distinct >= FEW:
                self._searches = 0
        if known:
            self._clutter.learn(d.near, d.discs)
            self._learn_points(frame, assigned, d, measured)
            events.extend(
                Event("undecided", _why_open(bool(d.labelled[v]), float(certain[v])), int(v))
                for v in np.flatnonzero((assigned >= 0) & ~labelled)
            )
        seen = labelled[:, None]
        uv_px = np.where(seen, d.uv, d.expected_px)
        expected_cov = d.jacobian @ covariance @ d.jacobian.transpose(0, 2, 1) + self._extra
        cov_px2 = np.where(seen[..., None], d.cov, expected_cov)
        blended = labelled & (assigned >= BLENDED)
        if blended.any():
            cov_px2[blended] += (p.blend_px / 2) ** 2 * np.eye(2)  # a neighbour has pulled it, nobody knows how far
        turned = labelled & children.manoeuvre[best]
        exists = ~np.isnan(d.expected_px[:, 0])
        status = view_statuses(labelled, turned, exists, d.inside, frame.has_image[model.camera_of], known)
        nowhere = [s in NOWHERE for s in status]
        uv_px[nowhere], cov_px2[nowhere] = np.nan, np.nan
        pose_status = PoseStatus.MEASURED if measured else PoseStatus.PREDICTED if known else PoseStatus.LOST
        return TrackedFrame(
            uv_px=uv_px,
            cov_px2=cov_px2,
            status=status,
            predicted_px=predicted,
            gain=np.full(len(model), np.nan),
            point=np.where(labelled, assigned % BLENDED - frame.first[model.camera_of], UNMATCHED),
            pose_status=pose_status,
            pose=pose if known else None,
            pose_covariance=covariance if known else None,
            spots_used=count if measured else 0,
            rms_px=float(d.rms_px) if measured else float("nan"),
            events=tuple(events),
            label_probability=np.where(assigned >= 0, certain, np.nan),
            used_in_pose=d.use & labelled,
            predicted_cov_px2=predicted_cov,
            motion=MotionEstimate(h.m[0, :3], h.m[0, 3:6], h.P[0, 6:12, 6:12]) if known else None,
            pose_systematic=systematic if known else None,
        )

    def _learn_points(self, frame: FrameDetections, assigned: Ints, d: FrameSummary, measured: bool) -> None:
        """What stays in its place, and how wide each spot is, from a frame with a pose."""
        if measured:
            labels = np.where(assigned >= 0, assigned % BLENDED, -1)
            camera = self._sights.camera
            learn_static(
                self._static, frame.uv, frame.cov, frame.first, frame.has_image, labels, d.expected_px, camera, FADES
            )
        for v in np.flatnonzero(d.use):
            size = frame.size_px[assigned[v]]
            if np.isfinite(size):
                old = self._usual_px[v]
                self._usual_px[v] = size if np.isnan(old) else old + SIZE_GAIN * (size - old)

    def _kind_of_search(self, dt_s: float) -> str:
        if self._anchor is None:
            return "labelled"
        return "relabelled" if self._anchor_age_s <= 1.5 * dt_s else "reacquired"

    def _good(self, alone: Array) -> bool:
        """Whether a single frame's covariance (6, 6) makes it a measurement. The trace decides all but hard cases."""
        d = alone.diagonal()
        if sum(d[:3]) <= self.limits.max_sigma_m**2 and sum(d[3:]) <= self.limits.max_sigma_rad**2:
            return True
        if not np.isfinite(d).all():
            return False
        worst = [np.sqrt(np.linalg.eigvalsh(alone[i, i])[-1]) for i in (slice(0, 3), slice(3, 6))]
        return bool(worst[0] <= self.limits.max_sigma_m and worst[1] <= self.limits.max_sigma_rad)

    def _look_at_calibration(self, d: FrameSummary, h: Hypotheses) -> None:
        """What the calibration's errors do to this frame's pose and, through it, to the expected pixels."""
        rows = np.flatnonzero(d.use)
        start = Pose(h.R[0], h.t[0])
        fit = fit_pose(self.model, rows, d.uv[rows], d.cov[rows], start, calibration=self.calibration)
        if fit is not None and fit.observable:
            self._extra = np.zeros_like(self._extra) + fit.calibration_px()
            self._systematic = fit.systematic
            self.misfit.take(fit.chi2 * self.noise_scale**2, fit.dof, fit.systematic_share)

    def _nothing(self, found: Sequence[Detections | None], predicted: Array, events: list[Event]) -> TrackedFrame:
        """A frame before the vehicle was ever found."""
        n = len(self.model)
        return TrackedFrame(
            uv_px=np.full((n, 2), np.nan),
            cov_px2=np.full((n, 2, 2), np.nan),
            status=(SpotStatus.LOST,) * n,
            predicted_px=predicted,
            gain=np.full(n, np.nan),
            point=np.full(n, UNMATCHED),
            pose_status=PoseStatus.LOST,
            pose=None,
            pose_covariance=None,
            spots_used=0,
            rms_px=float("nan"),
            events=tuple(events),
            label_probability=np.full(n, np.nan),
        )


def _why_open(certain_enough: bool, probability: float) -> str:
    """Why a label was not given, in words."""
    if certain_enough:
        return "label left open: one or two points of light after a dark frame may be false ones"
    return f"label left open: its probability is {probability:.2f}"
