"""The rigid tracker: one filter for the vehicle, which carries all spots.

Where Huo, Yang & Yang (2015) track spots that know nothing of each other, here the state is the vehicle's pose with its
velocities and accelerations, all spots of a frame are assigned together, and bends, hiding, the picture's edge, missing
pictures and re-entry are all the same thing: what the detections say about where the vehicle may be. Source: ours; the
parts are in motion.py, association.py, hypotheses.py.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.calibration_spread import CalibrationSpread
from geometry.pose import Pose
from geometry.projection import project_all
from geometry.rig import Rig
from geometry.rig_parameters import RigCovariance
from geometry.solve import SolveLimits, covariance_of, fit_pose
from geometry.spots import SpotModel
from tracking.association import BLENDED, Chances, Frame, Sights
from tracking.detections import Detections
from tracking.hiding import MISSED, learnt, together
from tracking.hypotheses import Children, Hypotheses, add_child, chosen_points, concluded, grow, no_children, sift
from tracking.information import fit_alone
from tracking.labels import NO_POINT, LabelResult, PosePrior, find_labels
from tracking.match import UNMATCHED
from tracking.misfit import Misfit
from tracking.motion import STATE
from tracking.parameters import TrackerParameters
from tracking.statuses import PoseStatus, SpotStatus, view_statuses
from tracking.surroundings import ClutterNearSpots
from tracking.temper import Temper
from tracking.tracked_frame import Event, MotionEstimate, TrackedFrame
from tracking.usable_points import UsablePoints, check_step

# What is known of the motion of a vehicle that has just been found: sigmas.
FIRST_SPEED, FIRST_RATE = 4.0, 6.0  # m/s, rad/s
FIRST_ACCELERATION, FIRST_ANGULAR = 30.0, 100.0  # m/s^2, rad/s^2
P_FRESH = 1e-3  # probability per frame that the vehicle is not where any hypothesis has it
LOST_SIGMA_M, LOST_SIGMA_RAD = 1.0, np.deg2rad(60.0)  # a predicted pose vaguer than this is `lost`
FEW = 4  # spots: fewer do not tell a lost vehicle from one that is mostly hidden
VAGUE_PX = 15.0  # 1 sigma of a predicted spot: beyond it the whole picture is searched at once


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
        self.misfit = Misfit()
        self.temper = Temper(parameters)
        n = len(self.model)
        self._sights = Sights.of(rig, self.model)
        self._groups = int(self._sights.group.max(initial=-1)) + 1
        self._chances = Chances(parameters.p_detect, parameters.p_blend)
        self._clutter = ClutterNearSpots(self.model, parameters.labels.clutter_per_px2)
        self._hypotheses: Hypotheses | None = None
        self._extra = np.zeros((n, 2, 2))  # of the calibration's errors, on the expected pixels ...
        self._systematic = np.zeros((6, 6))  # ... and on the pose
        self._anchor: Pose | None = None  # the last measured pose ...
        self._anchor_age_s = 0.0  # ... and its age
        self._few = 0  # frames in a row with fewer than FEW spots
        self._searches = 0  # in a row without success
        self._told_tie = False
        self._begun = False

    @property
    def noise_scale(self) -> float:
        """How much larger than claimed the spots' errors are."""
        return self.misfit.noise_scale

    def step(self, dt_s: float, found: Sequence[Detections | None]) -> TrackedFrame:
        """One frame. dt_s: time since the frame before (0 for the first); found: per camera, None without a picture.

        Points that are none (tracking/usable_points.py) are passed over. Raises ValueError for a step that is not
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
            children, count = grow(
                views, self._sights, frame, self._chances, self.temper.dynamics, self._extra, dt_s, self._hypotheses
            )
        predicted = self._predicted_px(dt_s)
        fresh: dict[int, str] = {}
        if self._should_search(children, count, found):
            count = self._search(children, count, frame, found, events, fresh)
        if count == 0:
            return self._nothing(found, predicted, events)
        staying, places, certain, spread = sift(children, count)
        before = self._hypotheses
        self._hypotheses = staying
        return self._conclude(dt_s, found, frame, children, places, certain, spread, predicted, before, events, fresh)

    # -- the frame's detections ---------------------------------------------------------------------------------------

    def _frame(self, found: Sequence[Detections | None]) -> Frame:
        """All cameras' detections in one list, with the errors that the run has shown them to have."""
        counts = [0 if f is None else len(f) for f in found]
        first = np.zeros(len(found) + 1, dtype=np.int64)
        np.cumsum(counts, out=first[1:])
        some = [f for f in found if f is not None]
        if some:
            uv = np.concatenate([f.uv_px for f in some])
            major = np.concatenate([f.major_px for f in some])
            cov = np.concatenate([f.cov_px2 for f in some]) * self.noise_scale**2
            cov[:, [0, 1], [0, 1]] += self.parameters.sigma_model_px**2
            blend = np.where(np.isnan(major), 0.0, self.parameters.blend_px)
        else:
            uv, cov, blend = np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0)
        has_image = np.array([f is not None for f in found])
        return Frame(uv, cov, blend, first, has_image, self._clutter.log_density(first))

    # -- labels from a prior alone ------------------------------------------------------------------------------------

    def _should_search(self, children: Children, count: int, found: Sequence[Detections | None]) -> bool:
        """Whether to look for the whole vehicle: enough points are there, and no hypothesis explains them."""
        if sum(len(f) for f in found if f is not None) < self.parameters.labels.min_spots:
            return False
        if self._hypotheses is not None and count:
            best = int(np.argmax(children.after.weight[:count]))
            if np.count_nonzero(children.assigned[best] >= 0) >= FEW:
                self._few = 0
                return False
            self._few += 1
            if self._few < 3 and not self._vague(self._hypotheses):
                return False
        # At once when light returns, then ever more rarely: what fails for long will fail in the next frame too.
        self._searches += 1
        return self._searches <= 10 or self._searches % 5 == 0

    def _vague(self, hypotheses: Hypotheses) -> bool:
        _, J = project_all(self.model.numbers, hypotheses.R[:1], hypotheses.t[:1])
        spread = J[0] @ hypotheses.P[0, :6, :6] @ np.swapaxes(J[0], -1, -2)
        return bool(np.sqrt(np.max(spread[:, [0, 1], [0, 1]])) > VAGUE_PX)

    def _search_prior(self) -> PosePrior:
        """Around the last measured pose, as far as the vehicle may have got since; the run's own before there is one."""
        if self._anchor is None:
            return self.prior
        p, age = self.parameters, self._anchor_age_s
        speed, rate = self.temper.fastest + np.array([p.reacquire_m_s, np.deg2rad(p.reacquire_deg_s)])
        return PosePrior(
            self._anchor,
            min(0.05 + speed * age, max(1.0, self.prior.within_m)),
            min(np.deg2rad(3.0) + rate * age, max(np.deg2rad(45.0), self.prior.within_rad)),
        )

    def _search(
        self,
        children: Children,
        count: int,
        frame: Frame,
        found: Sequence[Detections | None],
        events: list[Event],
        fresh: dict[int, str],
    ) -> int:
        """Add what the search from a prior alone finds to the children; how many there are then."""
        by_camera = {name: f for name, f in zip(self.model.camera_names, found, strict=True) if f is not None}
        prior = self._search_prior()
        result = find_labels(self.rig, self.model, by_camera, prior, self.parameters.labels, self.calibration)
        if result.tie and not self._told_tie:
            events.append(Event("tie", self._tie_text(result)))
            self._told_tie = True
        candidates = [result.chosen] if result.chosen is not None else list(result.candidates[:4])
        if result.chosen is not None and result.chosen.fit.dof > 0:
            self._believe_misfit(frame, result)
            frame = self._frame(found)
        P = np.diag(
            np.repeat(
                [
                    prior.within_m / np.sqrt(3), prior.within_rad / np.sqrt(3), FIRST_SPEED, FIRST_RATE,
                    FIRST_ACCELERATION, FIRST_ANGULAR,
                ],
                3,
            ) ** 2
        )  # fmt: skip
        n = len(self.model)
        shown = np.full(n + self._groups, 0.95)
        start = (np.ascontiguousarray(prior.centre.rotation), prior.centre.translation.copy(), np.zeros(12), P)
        for one in candidates:
            pose = one.fit.world_from_body
            assigned = np.where(one.point_of == NO_POINT, MISSED, one.point_of + frame.first[self.model.camera_of])
            R, t = np.ascontiguousarray(pose.rotation), np.ascontiguousarray(pose.translation)
            R, t, m, P_after, gaussian, _, spots = concluded(
                self.model.numbers, frame, self._extra, start, assigned, R, t
            )
            uv, _ = project_all(self.model.numbers, R[None], t[None])
            has_image = frame.has_image[self.model.camera_of]
            inside = self.model.in_picture(uv[0]) & has_image
            weight = np.log(P_FRESH) if self._hypotheses is not None else 0.0
            p = self.parameters.p_detect * 0.9  # marginal(shown)
            weight += gaussian + spots * np.log(p) - float(np.sum(frame.log_clutter[assigned >= 0]))
            weight += np.count_nonzero(inside & (assigned < 0)) * np.log(1 - p)
            assigned = np.where((assigned < 0) & ~inside, -2, assigned)
            if not np.isfinite(weight):
                continue
            before = count
            weight += together(shown, self._sights.group, assigned, self.parameters.p_detect)
            after = learnt(shown, self._sights.group, assigned, self.parameters.p_detect)
            count = add_child(children, count, R, t, m, P_after, weight, after, assigned, False, -1)
            if count > before:
                names = ", ".join(self.model.views[v][1] for v in np.flatnonzero(assigned >= 0))
                fresh[count - 1] = names
        return count

    def _believe_misfit(self, frame: Frame, result: LabelResult) -> None:
        """The labels hold within the model's error; where the claimed sigmas do not, this frame says by how much."""
        assert result.chosen is not None
        labels = result.chosen.point_of
        assigned = np.where(labels == NO_POINT, MISSED, labels + frame.first[self.model.camera_of])
        use, uv, cov = chosen_points(frame, assigned, self._extra)
        pose = result.chosen.fit.world_from_body
        start = np.ascontiguousarray(pose.rotation), np.ascontiguousarray(pose.translation)
        _, _, _, chi2, count = fit_alone(self.model.numbers, *start, use, uv, cov)
        dof = 2 * count - 6
        if dof > 0 and chi2 / dof > 9.0:
            self.misfit.at_least(chi2 * self.noise_scale**2, dof)

    def _tie_text(self, result: LabelResult) -> str:
        """Both candidates in words: which spots they name and where they put the vehicle."""
        parts = []
        for one in result.candidates[:2]:
            ypr = np.rad2deg(one.fit.world_from_body.ypr)
            x, y, z = one.fit.world_from_body.translation
            names = " ".join(self.model.views[v][1] for v in np.flatnonzero(one.point_of != NO_POINT))
            parts.append(
                f"spots {names} at x {x:.3f} y {y:.3f} z {z:.3f} m,"
                f" yaw {ypr[0]:.2f} pitch {ypr[1]:.2f} roll {ypr[2]:.2f} deg"
            )
        return f"{result.reason}: " + " | ".join(parts)

    # -- what the frame's result is -----------------------------------------------------------------------------------

    def _predicted_px(self, dt_s: float) -> Array:
        """Where the best hypothesis expected each spot, (n, 2), before this frame's picture was looked at."""
        h = self._hypotheses
        if h is None or self._lost(h.P[0, :6, :6]):
            return np.full((len(self.model), 2), np.nan)
        turn = dt_s * h.m[0, 3:6] + 0.5 * dt_s**2 * h.m[0, 9:12]
        move = dt_s * h.m[0, :3] + 0.5 * dt_s**2 * h.m[0, 6:9]
        pose = Pose(h.R[0], h.t[0]).plus(np.concatenate([move, turn]))
        return project_all(self.model.numbers, pose.rotation[None], pose.translation[None])[0][0]

    @staticmethod
    def _lost(covariance: Array) -> bool:
        """Whether a pose of this covariance (6, 6) says nothing any more."""
        s = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
        return bool(s[:3].max() >= LOST_SIGMA_M or s[3:].max() >= LOST_SIGMA_RAD)

    def _conclude(
        self,
        dt_s: float,
        found: Sequence[Detections | None],
        frame: Frame,
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
        # What was found from a prior alone must lead as it must in labels.py: a tie of 5 to 1 is still a tie.
        unproven = self._anchor is None or best in fresh
        least = max(p.min_label_probability, 1 / (1 + np.exp(-p.labels.lead_nats)) if unproven else 0.0)
        labelled = (assigned >= 0) & (certain >= least)
        use, uv, cov = chosen_points(frame, np.where(labelled, assigned, MISSED), np.zeros_like(self._extra))
        R1, t1, L1, chi2, count = fit_alone(model.numbers, h.R[0], h.t[0], use, uv, cov)
        alone, observable = covariance_of(L1) if count >= 3 else (np.full((6, 6), np.inf), False)
        measured = observable and self._good(alone)
        if measured:
            self.misfit.take(chi2, 2 * count - 6)
        systematic = self._calibrated(use, uv, cov, h) if measured else self._systematic
        pose = Pose(h.R[0], h.t[0])
        covariance = h.P[0, :6, :6] + spread + systematic
        if measured:
            status = PoseStatus.MEASURED
        else:
            status = PoseStatus.LOST if self._lost(covariance) else PoseStatus.PREDICTED
        known = status is not PoseStatus.LOST
        # Fewer than three certain spots of a vehicle that was never found are no start.
        if self._anchor is None and not measured:
            known, status = False, PoseStatus.LOST
        labelled = labelled & known
        if measured:
            if best in fresh:
                events.append(Event(self._kind_of_search(dt_s), f"spots {fresh[best]} found from the prior alone"))
            self._anchor, self._anchor_age_s, self._told_tie = pose, 0.0, False
            if count >= FEW:
                self._searches = 0
        undecided = np.flatnonzero((assigned >= 0) & ~labelled)
        events.extend(
            Event("undecided", f"label left open: its probability is {certain[v]:.2f}", int(v)) for v in undecided if known
        )
        self.temper.learn(before, children, best, dt_s, measured and best not in fresh, use, uv, cov, model.numbers)
        expected_px, expected_cov, exists = self._estimates(pose, covariance)
        self._clutter.learn(frame, assigned % BLENDED, expected_px, known)
        seen_uv, seen_cov = self._points(found, frame, assigned, labelled)
        out_uv = np.where(labelled[:, None], seen_uv, expected_px)
        out_cov = np.where(labelled[:, None, None], seen_cov, expected_cov)
        turned = labelled & bool(children.manoeuvre[best])
        inside = model.in_picture(out_uv)
        spot_status = view_statuses(labelled, turned, exists, inside, frame.has_image[model.camera_of], known)
        hide = np.array([s in (SpotStatus.LOST, SpotStatus.OFF_SCREEN) for s in spot_status])
        out_uv[hide] = np.nan
        used = use & known
        residual = (uv - project_all(model.numbers, R1[None], t1[None])[0][0])[used]
        point = np.where(labelled, assigned % BLENDED - frame.first[model.camera_of], UNMATCHED)
        return TrackedFrame(
            uv_px=out_uv,
            cov_px2=out_cov,
            status=spot_status,
            predicted_px=predicted,
            gain=np.full(len(model), np.nan),
            point=point,
            pose_status=status,
            pose=pose if known else None,
            pose_covariance=covariance if known else None,
            spots_used=int(np.count_nonzero(used)) if measured else 0,
            rms_px=float(np.sqrt(np.mean(residual**2))) if len(residual) and measured else float("nan"),
            events=tuple(events),
            label_probability=np.where(labelled | (assigned >= 0), certain, np.nan),
            motion=MotionEstimate(h.m[0, :3], h.m[0, 3:6], h.P[0, 6:12, 6:12]) if known else None,
            pose_systematic=systematic if known else None,
        )

    def _kind_of_search(self, dt_s: float) -> str:
        if self._anchor is None:
            return "labelled"
        return "relabelled" if self._anchor_age_s <= 1.5 * dt_s else "reacquired"

    def _good(self, alone: Array) -> bool:
        """Whether a single frame's covariance (6, 6) makes it a measurement. The trace decides all but hard cases."""
        d = np.diagonal(alone)
        if np.sqrt(d[:3].sum()) <= self.limits.max_sigma_m and np.sqrt(d[3:].sum()) <= self.limits.max_sigma_rad:
            return True
        worst = [np.sqrt(np.linalg.eigvalsh(alone[i, i])[-1]) for i in (slice(0, 3), slice(3, 6))]
        return bool(worst[0] <= self.limits.max_sigma_m and worst[1] <= self.limits.max_sigma_rad)

    def _calibrated(self, use: Bools, uv: Array, cov: Array, h: Hypotheses) -> Array:
        """The calibration's share of this frame's pose covariance; what it does to the expected pixels is remembered."""
        if self.calibration is None:
            return self._systematic
        rows = np.flatnonzero(use)
        fit = fit_pose(self.model, rows, uv[rows], cov[rows], Pose(h.R[0], h.t[0]), calibration=self.calibration)
        if fit is not None and fit.observable:
            self._extra = np.zeros_like(self._extra) + fit.calibration_px()
            self._systematic = fit.systematic
        return self._systematic

    def _estimates(self, pose: Pose, covariance: Array) -> tuple[Array, Array, Bools]:
        """Where the pose puts all spots, (n, 2), with covariances (n, 2, 2), and which have a projection."""
        uv, J = project_all(self.model.numbers, pose.rotation[None], pose.translation[None])
        cov = J[0] @ covariance @ np.swapaxes(J[0], -1, -2) + self._extra
        exists: Bools = ~np.isnan(uv[0, :, 0])
        return uv[0], cov, exists

    def _points(
        self, found: Sequence[Detections | None], frame: Frame, assigned: Ints, labelled: Bools
    ) -> tuple[Array, Array]:
        """Positions (n, 2) and covariances (n, 2, 2) of the labelled detections; a blended one is as vague as it may be."""
        n = len(self.model)
        uv, cov = np.full((n, 2), np.nan), np.full((n, 2, 2), np.nan)
        rows = np.flatnonzero(labelled)
        d = assigned[rows] % BLENDED
        uv[rows], cov[rows] = frame.uv[d], frame.cov[d]
        blended = rows[assigned[rows] >= BLENDED]
        cov[blended] += (self.parameters.blend_px / 2) ** 2 * np.eye(2)
        return uv, cov

    def _nothing(
        self, found: Sequence[Detections | None], predicted: Array, events: list[Event]
    ) -> TrackedFrame:
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
