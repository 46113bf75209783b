"""The rigid tracker: one filter for the vehicle's pose and motion, which predicts all spots together.

Huo, Yang & Yang (2015) track each spot by itself. Here the state is the vehicle's pose with its velocities and
accelerations, and all spots of a frame are assigned jointly. Corners of the motion, occlusion, spots outside the
picture, missing pictures and re-acquisition therefore need no cases of their own. A frame takes these steps:

1. Predict every hypothesis and branch it over assignments and manoeuvres (hypotheses/branching.py).
2. Search the frame for the whole vehicle where the hypotheses do not explain it (acquisition.py);
   the answers, and mirror solutions of three spots, become children as well.
3. Prune and merge the children (hypotheses/hypothesis_set.py).
4. Decide which labels are confirmed (label_confirmation.py) and whether the frame's spots determine the pose.
5. Update the online estimates: process noise, variance factor, clutter, static points and spot sizes
   (online_estimates.py).

Source: ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from geometry.arrays import Array, Ints
from geometry.compiled_projection import Views
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from geometry.pose_solver.gauss_newton import SolveLimits, fit_pose
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigCovariance, RigUncertainty
from tracking.detections import Detections, PictureClock
from tracking.input_validation import UsablePoints, check_step
from tracking.labelling.first_labels import MIN_EVIDENCE_NATS, NO_POINT, Labelling
from tracking.parameters import TrackerParameters
from tracking.rigid_body.acquisition import (
    MISSING_TO_DOUBT,
    P_VISIBLE_AT_START,
    SEARCH_CLOCK_PX,
    SEARCH_SHARES,
    Acquisition,
    SearchSchedule,
    Start,
    add_mirror_solutions,
    add_pose,
    continued_hypotheses,
    continues,
    is_vague,
    predicted_hypothesis,
    unknown_vehicle,
    without_history,
)
from tracking.rigid_body.association.frame_detections import (
    DetectionModel,
    FrameDetections,
    Observation,
    ViewTable,
    chosen_points,
    distinct_spots,
)
from tracking.rigid_body.frame_summary import (
    FrameDecision,
    FrameSummary,
    innovation_score,
    is_lost,
    lost_frame,
    predicted_pixels,
    summarise,
    tracked_frame,
    undecided_events,
)
from tracking.rigid_body.hypotheses.branching import branch
from tracking.rigid_body.hypotheses.hypothesis_set import (
    MIN_CONFIRMING_SPOTS,
    MIN_REDUNDANT_SPOTS,
    Children,
    Hypotheses,
    State,
    empty_children,
    prune_and_merge,
    state_of,
)
from tracking.rigid_body.label_confirmation import FirstEvidence, FrameHypotheses, LabelConfirmation
from tracking.rigid_body.models.information import (
    add_clock_errors,
    clocks_of,
    has_clocks,
    picture_shifts,
    single_frame_pose,
)
from tracking.rigid_body.models.occlusion import MISSED
from tracking.rigid_body.online_estimates import AdaptiveProcessNoise, PointStatistics, VarianceFactor
from tracking.statuses import Event, TrackedFrame

P_NEW = 1e-3  # probability per frame that the vehicle is not where any hypothesis predicts it
# Other hypotheses make a pose of few spots a prediction if they add more than this share of the frame's own variance.
AMBIGUOUS_SHARE = 9.0
STATIC_SEARCH_INTERVAL = 5  # every so many searches use static points as well
MISFIT_LIMIT = 9.0  # chi-square per degree of freedom of a first labelling that shows that the sigmas are too small


class RigidTracker:
    """Tracks the vehicle through the detections of one frame after the other."""

    def __init__(
        self, rig: Rig, parameters: TrackerParameters, prior: PosePrior, covariance: RigCovariance | None = None
    ) -> None:
        """covariance: of the rig's calibration, if known; the poses' covariances then include its errors."""
        self.rig = rig
        self.model = SpotModel.of(rig)
        self.parameters = parameters
        self.calibration = None if covariance is None else RigUncertainty(rig, self.model, covariance)
        self.limits = SolveLimits(parameters.max_sigma_m, np.deg2rad(parameters.max_sigma_deg))
        self.variance_factor = VarianceFactor()
        self.process_noise = AdaptiveProcessNoise(parameters)
        n = len(self.model)
        self._view_table = ViewTable.of(rig, self.model)
        self._groups = int(self._view_table.group.max(initial=-1)) + 1
        self._detection_model = DetectionModel(parameters.p_detect, parameters.p_blend)
        self._points = PointStatistics(self.model, parameters)
        self._schedule = SearchSchedule(self.model, parameters.labels.min_spots)
        self._acquisition = Acquisition(rig, self.model, parameters, prior, self.calibration)
        self._confirmation = LabelConfirmation(self.model, parameters)
        self._hypotheses: Hypotheses | None = None
        self._calibration_cov = np.zeros((n, 2, 2))  # calibration errors' covariance of the expected pixels ...
        self._systematic = np.zeros((6, 6))  # ... and of the pose
        self._last_pose: Pose | None = None  # the last measured one ...
        self._last_pose_age_s = 0.0  # ... and its age; before there is one, the time since the first frame
        self._saw_any = False  # the frame before had labelled spots
        self._evidence = FirstEvidence(n)
        self._begun = False
        self._stated_cov = np.zeros((0, 2, 2))  # of the present frame's detections
        self._clocks: list[PictureClock | None] = []  # by camera, of its pictures

    def begin_at(self, pose: Pose, m: Array, P: Array) -> None:
        """Start from a known state instead of the prior: m (12,) and P (18, 18) as in models/motion.py."""
        n = len(self.model)
        self._hypotheses = Hypotheses(
            np.array(pose.rotation, order="C")[None], np.array(pose.translation)[None], m[None].copy(), P[None].copy(),
            np.zeros(1), np.full((1, n + self._groups), P_VISIBLE_AT_START),
        )  # fmt: skip
        self._last_pose, self._begun, self._saw_any = pose, True, True
        self.process_noise.fastest = np.array([np.linalg.norm(m[:3]), np.linalg.norm(m[3:6])])

    @property
    def noise_scale(self) -> float:
        """Ratio of the spots' errors to their stated sigmas."""
        return self.variance_factor.noise_scale

    def step(self, dt_s: float, found: Sequence[Detections | None]) -> TrackedFrame:
        """Track one frame. dt_s: time since the frame before (0 for the first); found: per camera, None: no picture.

        Invalid detections (tracking/input_validation.py) are dropped. Raises ValueError: The step is not forward in
        time, or cameras or array shapes do not fit.
        """
        check_step(dt_s, found, self.model.camera_names, not self._begun)
        usable = UsablePoints.of(found)
        self._begun = True
        return usable.with_given_rows(self._step(dt_s, usable.found), self.model.camera_of)

    def _step(self, dt_s: float, found: Sequence[Detections | None]) -> TrackedFrame:
        """Track one frame with valid detections."""
        model, n, old = self.model, len(self.model), self._hypotheses
        self._last_pose_age_s += dt_s
        self._schedule.next_frame()
        events: list[Event] = []
        obs, after_jump = self._observations(found, dt_s)
        if old is None:
            children, count = empty_children(n, self._groups), 0
            predicted_px = np.full((n, 2), np.nan)
        else:
            children, count = branch(obs, after_jump, self.process_noise.dynamics, dt_s, old)
            predicted_px = np.full((n, 2), np.nan) if is_lost(old.P[0]) else predicted_pixels(obs.views, old, dt_s)
        best = children.assigned[int(np.argmax(children.hypotheses.log_weight[:count]))] if count else None
        searched: dict[int, str] = {}
        if self._schedule.due(best, found, lambda: is_vague(model, old, dt_s, self.process_noise.dynamics)):
            count = self._search(children, count, obs, found, dt_s, events, searched)
        if count == 0:
            return lost_frame(n, predicted_px, events)
        if old is not None and dt_s > 0:
            count = add_mirror_solutions(children, count, obs, model, old, self.process_noise.dynamics, dt_s)
        if self._last_pose is None:
            k = int(np.argmax(children.hypotheses.log_weight[:count]))
            nats = float(children.hypotheses.log_weight[k])
            if not self._evidence.add(obs.frame, children.assigned[k], nats, old is not None):
                self._hypotheses = None
                return lost_frame(n, predicted_px, events)
        self._hypotheses, kept, probability, spread = prune_and_merge(children, count)
        h = FrameHypotheses(
            dt_s, old, self._hypotheses, children, kept, probability, spread, searched, self._last_pose is None,
            self._evidence.is_enough,
        )  # fmt: skip
        if obs.timed:  # what this frame says about the velocities counts for where its spots have moved
            state = state_of(self._hypotheses, 0)
            obs = self._moved(obs, state, np.ascontiguousarray(state.P[6:12, 6:12]))
        return self._answer(obs, h, predicted_px, events)

    def _observations(self, found: Sequence[Detections | None], dt_s: float) -> tuple[Observation, Observation]:
        """The frame's detections together with what their likelihood depends on: after steady motion, and after a jump.

        The two differ where pictures have clocks of their own: the spots have moved since the frame's instant, with the
        predicted velocities.
        """
        frame = self._points.frame(found, self.noise_scale, self._last_pose is None)
        self._stated_cov, self._clocks = frame.cov, [None if f is None else f.clock for f in found]
        no_shift = np.zeros_like(self._calibration_cov)
        obs = Observation(
            self.model.numbers, self._view_table, self._detection_model, self._calibration_cov, frame, no_shift,
            clocks_of(found), has_clocks(found),
        )  # fmt: skip
        if self._hypotheses is None or not obs.timed:
            return obs, obs
        dynamics = self.process_noise.dynamics
        state = predicted_hypothesis(self._hypotheses, 0, dt_s, dynamics, manoeuvre=False)
        velocity_P = np.ascontiguousarray(state.P[6:12, 6:12])
        jump = np.diag(np.repeat(dynamics.velocity_jump, 3))
        return self._moved(obs, state, velocity_P), self._moved(obs, state, velocity_P + jump)

    def _moved(self, obs: Observation, state: State, velocity_P: Array) -> Observation:
        """The observation with spots that have moved until their pictures were taken.

        velocity_P (6, 6): covariance of the state's velocities.
        """
        camera = self._view_table.camera
        shift, cov = picture_shifts(self.model.numbers, camera, obs.clocks, state.R, state.t, state.m, velocity_P)
        views = self.model.numbers.copy()
        views["shift"] = shift
        frame = obs.frame
        if any(clock is not None and (clock.delay_sigma_s or clock.row_sigma_s) for clock in self._clocks):
            frame = frame._replace(cov=self._with_clock_errors(frame, views, state, velocity_P))
        return obs._replace(views=views, calibration_cov=self._calibration_cov + cov, shift_cov=cov, frame=frame)

    def _with_clock_errors(self, frame: FrameDetections, views: Views, state: State, velocity_P: Array) -> Array:
        """Covariances (m, 2, 2) of the detections with the motion of their spots in the error of their clocks.

        Each moves as the spot nearest to it. As noise of its own in each picture this error hardly biases the pose:
        along the motion the other cameras decide.
        """
        none = (0.0, 0.0, 0.0)
        errors = [none if k is None else (k.delay_sigma_s, k.row_sigma_s, k.middle_row) for k in self._clocks]
        cov = self._stated_cov.copy()
        add_clock_errors(
            views, self._view_table.camera, np.array(errors), state.R, state.t, state.m, velocity_P, frame.first,
            frame.uv, SEARCH_CLOCK_PX, cov,
        )  # fmt: skip
        return cov

    def _at_candidate(self, obs: Observation, pose: Pose, unknown: Start) -> Observation:
        """The observation for an unknown vehicle that is at a pose."""
        if not obs.timed:
            return obs
        state = unknown.state._replace(R=np.array(pose.rotation, order="C"), t=np.array(pose.translation))
        return self._moved(obs, state, np.ascontiguousarray(state.P[6:12, 6:12]))

    # -- search for the whole vehicle ---------------------------------------------------------------------------------

    def _search(
        self,
        children: Children,
        count: int,
        obs: Observation,
        found: Sequence[Detections | None],
        dt_s: float,
        events: list[Event],
        searched: dict[int, str],
    ) -> int:
        """Add the answers of a search of this frame to the children; returns the number of children.

        Each answer is added as the continuation of the likeliest hypotheses, so that two frames' poses give the
        velocities, and as a vehicle of which nothing was known. Answers that no child had before go into `searched`.
        """
        first = self._last_pose is None
        prior = self._acquisition.search_prior(
            self._last_pose, self._last_pose_age_s, self.process_noise.fastest, self._schedule.just_found,
            self._schedule.doubted or self._schedule.astray,
        )  # fmt: skip
        static_too = self._schedule.searches % STATIC_SEARCH_INTERVAL == 0
        candidates = self._acquisition.labellings(obs.frame, found, prior, first, static_too, events)
        # A vehicle that was never measured may as well appear now; else it is rarely off all predictions.
        log_weight = 0.0 if self._hypotheses is None else -self._evidence.nats if first else float(np.log(P_NEW))
        log_weight += self._acquisition.log_visible(prior) if first else 0.0
        visibilities = len(self.model) + self._groups
        shares = SEARCH_SHARES if obs.timed else SEARCH_SHARES[:1]
        starts = [unknown_vehicle(prior, log_weight, visibilities, share) for share in shares]
        if first and len(candidates) == 1 and candidates[0].fit.dof > 0 and candidates[0].score >= MIN_EVIDENCE_NATS:
            # Later the scale is known, and a misfit shows a wrong answer (a scale of 3 after a screen was occluded).
            unmoved = self._at_candidate(obs, candidates[0].fit.world_from_body, starts[0])
            self._raise_variance_factor(unmoved, candidates[0])
            obs, _ = self._observations(found, dt_s)
        if self._hypotheses is not None and dt_s > 0:
            dynamics = self.process_noise.dynamics
            starts += continued_hypotheses(self._hypotheses, dt_s, dynamics, len(self.model), manoeuvre=True)
            if first:
                # The assignment of spots whose velocities are unknown may miss an answer for one hypothesis and find
                # its twin for another, which would then win by that alone.
                starts += continued_hypotheses(self._hypotheses, dt_s, dynamics, len(self.model), manoeuvre=False)
        known = {tuple(np.maximum(children.assigned[k], MISSED)) for k in range(count)}
        branched = count
        if self._schedule.doubted:
            best = children.assigned[int(np.argmax(children.hypotheses.log_weight[:count]))]
            least = distinct_spots(best >= 0, self.model.spot_of) + MISSING_TO_DOUBT
            candidates = [c for c in candidates if distinct_spots(c.point_of != NO_POINT, self.model.spot_of) >= least]
            if candidates:
                count, best_start = without_history(children, count, obs, self.model, starts[0])
                of_unknown = [s._replace(log_weight=best_start.log_weight) for s in starts if s.parent < 0]
                starts[: len(of_unknown)] = of_unknown
        for one in candidates:
            pose = one.fit.world_from_body
            assigned = self._assigned(obs.frame, one)
            for start in starts:
                if not start.manoeuvre and continues(children, branched, start.parent, assigned):
                    continue
                here = self._at_candidate(obs, pose, start) if start.parent < 0 else obs
                count, place = add_pose(children, count, here, self.model, start, assigned, pose)
                if place >= 0:
                    searched.pop(place, None)
                    if tuple(np.maximum(children.assigned[place], MISSED)) not in known:
                        searched[place] = ", ".join(self.model.views[v][1] for v in np.flatnonzero(assigned >= 0))
        return count

    def _assigned(self, frame: FrameDetections, one: Labelling) -> Ints:
        """A labelling as an assignment (n,)."""
        return np.where(one.point_of == NO_POINT, MISSED, one.point_of + frame.first[self.model.camera_of])

    def _raise_variance_factor(self, obs: Observation, one: Labelling) -> None:
        """Raise the variance factor to the misfit of a first labelling, which holds within the model's error."""
        assigned = self._assigned(obs.frame, one)
        use, uv, cov = chosen_points(obs.frame.uv, obs.frame.cov, 0, assigned, obs.calibration_cov)
        pose = one.fit.world_from_body
        start = np.ascontiguousarray(pose.rotation), np.ascontiguousarray(pose.translation)
        _, _, _, chi2, count = single_frame_pose(obs.views, *start, use, uv, cov)
        dof = 2 * count - 6
        if dof > 0 and chi2 / dof > MISFIT_LIMIT:
            self.variance_factor.raise_to(chi2 * self.noise_scale**2, dof)

    # -- the frame's answer -------------------------------------------------------------------------------------------

    def _answer(self, obs: Observation, h: FrameHypotheses, predicted_px: Array, events: list[Event]) -> TrackedFrame:
        """Check the best hypothesis, update the online estimates, and give the frame's answer."""
        model, assigned, now = self.model, h.assigned, h.now
        from_search = h.best in h.searched
        if from_search:
            self._schedule.found()
        checks = self._confirmation.check(obs, h, self.process_noise.dynamics)
        s = summarise(obs, now.R[0], now.t[0], assigned, h.probability, checks.min_probability)
        spots = int(distinct_spots(s.use, model.spot_of))
        # Another pose that is not excluded makes this one a prediction, with a covariance that covers both.
        ambiguous = spots <= MIN_REDUNDANT_SPOTS and bool(
            np.any(checks.spread.diagonal() > AMBIGUOUS_SHARE * s.single_frame_cov.diagonal())
        )
        count = int(np.count_nonzero(s.use))
        measured = count >= 3 and checks.confirmed and not ambiguous and self._observable(s.single_frame_cov)
        if measured and h.first:
            measured = not self._acquisition.is_ambiguous(Pose(now.R[0], now.t[0]), self._last_pose_age_s)
        if measured:
            self._update_errors(obs, s, now, count)
        covariance = now.P[0, :6, :6] + checks.spread + self._systematic
        known = measured or (self._last_pose is not None and not is_lost(covariance))
        # After a frame that showed nothing, one or two points may be false: a second such frame must follow.
        isolated = distinct_spots(s.labelled, model.spot_of) < MIN_CONFIRMING_SPOTS and not self._saw_any
        self._saw_any = bool((assigned >= 0).any())
        labelled = s.labelled if known and checks.confirmed and not isolated else np.zeros_like(s.labelled)
        predicted_cov: Array | None = None
        if measured:
            if from_search:
                text = f"spots {h.searched[h.best]} found from the prior alone"
                events.append(Event(self._kind_of_search(h.dt_s), text))
            elif h.before is not None and h.dt_s > 0 and h.parent >= 0:
                predicted_cov = self._update_process_noise(obs, s, h)
            self._last_pose, self._last_pose_age_s = Pose(now.R[0], now.t[0]), 0.0
            self._acquisition.vehicle_found()
        self._schedule.measured(measured, spots)
        if known:
            self._points.update(obs.frame, assigned, s, measured)
            events.extend(undecided_events(assigned, h.probability, labelled, s.labelled))
        decision = FrameDecision(
            assigned, h.probability, labelled, known, measured, h.manoeuvre, covariance, self._systematic,
            self._calibration_cov, self.parameters.blend_px,
        )  # fmt: skip
        out = tracked_frame(model, obs.frame, s, now, decision, (predicted_px, predicted_cov), events)
        shift = np.asarray(obs.views["shift"])
        return replace(out, shift_px=shift.copy()) if shift.any() else out

    def _kind_of_search(self, dt_s: float) -> str:
        if self._last_pose is None:
            return "labelled"
        return "relabelled" if self._last_pose_age_s <= 1.5 * dt_s else "reacquired"

    def _observable(self, covariance: Array) -> bool:
        """Whether the covariance (6, 6) of a frame by itself makes it a measurement. The trace decides most cases."""
        d = covariance.diagonal()
        if sum(d[:3]) <= self.limits.max_sigma_m**2 and sum(d[3:]) <= self.limits.max_sigma_rad**2:
            return True
        if not np.isfinite(d).all():
            return False
        return bool(self.limits.hold(covariance))

    # -- online estimates ---------------------------------------------------------------------------------------------

    def _update_errors(self, obs: Observation, s: FrameSummary, h: Hypotheses, count: int) -> None:
        """Update the variance factor and, if the calibration's covariance is known, the effects of its errors.

        The factor refers to the stated covariances, not to those that it has already widened: with these it settled at
        the root of the errors' scale (1.7 where the errors were 3 times the stated sigmas).
        """
        if self.calibration is None:
            self.variance_factor.update(s.chi2 * self.noise_scale**2, 2 * count - 6)
            return
        rows = np.flatnonzero(s.use)
        start = Pose(h.R[0], h.t[0])
        uv = s.uv[rows] - obs.views["shift"][rows]
        fit = fit_pose(self.model, rows, uv, s.cov[rows], start, calibration=self.calibration)
        if fit is not None and fit.observable:
            self._calibration_cov = np.zeros_like(self._calibration_cov) + fit.calibration_px()
            self._systematic = fit.systematic
            self.variance_factor.update(fit.chi2 * self.noise_scale**2, fit.dof, fit.systematic_share)

    def _update_process_noise(self, obs: Observation, s: FrameSummary, h: FrameHypotheses) -> Array | None:
        """Update the process noise; returns the covariances (n, 2, 2) of the predicted pixels.

        None if the best hypothesis continues another one than that which the predicted pixels are of.
        """
        assert h.before is not None
        jerk = self.process_noise.dynamics.jerk
        score, predicted_cov = innovation_score(obs.views, h.before, h.parent, h.dt_s, jerk, s.use, s.uv, s.cov)
        self.process_noise.update(h.now.m[0, :6], h.manoeuvre, score)
        return predicted_cov + self._calibration_cov if h.parent == 0 else None
