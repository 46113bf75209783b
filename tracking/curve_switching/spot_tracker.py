"""The paper's tracker: a filter per spot, three-step matching, and what one rigid body adds to it.

Source: Huo, Yang & Yang 2015, fig. 1: predict, recognise (in view: match; out of view: solve from the other beams),
modify. Ours: the pose from the matched spots is a witness. A match that contradicts the others is dropped, and spots
that the matching missed are looked for where the pose puts them (`rigid_check`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from geometry.pose_solver.gauss_newton import (
    PoseFit,
    SolveLimits,
    fit_pose,
    good_enough,
    point_covariance,
)
from geometry.pose_solver.robust_pose import EXPECTED_GATE, fit_pose_robust
from geometry.rig import Rig
from geometry.uncertainty.rig_parameters import RigCovariance
from geometry.uncertainty.rig_uncertainty import CalibrationSpread
from tracking.curve_switching.matching import match
from tracking.curve_switching.out_of_view import CoplanarViews, quadratic_positions
from tracking.curve_switching.tracks import Tracks
from tracking.curve_switching.vehicle import Vehicle
from tracking.detections import UNMATCHED, Detections
from tracking.labelling.first_labels import NO_POINT, find_labels
from tracking.parameters import TrackerParameters
from tracking.statuses import SpotStatus
from tracking.tracked_frame import Event, TrackedFrame

RIGID_GATE = 20.0  # squared sigmas: a detection this near to where the pose puts a spot is that spot (p = 5e-5)


class SpotTracker:
    """Feed it the detections of one frame after the other."""

    def __init__(
        self, rig: Rig, parameters: TrackerParameters, prior: PosePrior, covariance: RigCovariance | None = None
    ) -> None:
        """covariance: of the rig's calibration, where it is known; poses then carry its share."""
        self.rig = rig
        self.model = SpotModel.of(rig)
        self.calibration = None if covariance is None else CalibrationSpread(rig, self.model, covariance)
        self.parameters = parameters
        self.prior = prior
        self.coplanar = CoplanarViews.of(rig, self.model)
        self.tracks = Tracks.none(len(self.model), parameters.sigma_a_px_s2)
        self.vehicle = Vehicle(parameters)
        self.limits = SolveLimits(parameters.max_sigma_m, np.deg2rad(parameters.max_sigma_deg))
        self._labelled = False
        self._frames_since_try = 0
        self._told_tie = False

    @property
    def noise_scale(self) -> float:
        """How much larger than claimed the spots' errors are."""
        return self.vehicle.noise_scale

    def step(self, dt_s: float, found: Sequence[Detections | None]) -> TrackedFrame:
        """One frame. dt_s: time since the frame before (0 for the first); found: per camera, None without a picture."""
        self._predict(dt_s)
        events: list[Event] = []
        predicted = self.tracks.predicted_px
        n = len(self.model)
        point, gain = np.full(n, UNMATCHED), np.full(n, np.nan)
        turned = np.zeros(n, dtype=bool)
        fit: PoseFit | None = None
        found = [None if f is None else self._usable(f) for f in found]

        if not self._labelled:
            fit, point = self._acquire(found, self.prior, events, "labelled")
        else:
            point, turned, gain = self._match(found)
            fit, point, turned = self._pose(found, point, turned, events)
            if fit is None and self._should_search(found):
                kind = "relabelled" if self.vehicle.anchor_age_s <= 1.5 * dt_s else "reacquired"
                again, points = self._acquire(found, self.vehicle.search_prior(self.prior), events, kind)
                if again is not None:
                    fit, point = again, points
                    turned = self._far_from_prediction(found, point)
        return self._conclude(dt_s, found, predicted, point, turned, gain, fit, events)

    # -- prediction ---------------------------------------------------------------------------------------------------

    def _predict(self, dt_s: float) -> None:
        if dt_s <= 0:
            return
        self.tracks.predict(dt_s)
        self.vehicle.predict(dt_s)

    # -- matching -----------------------------------------------------------------------------------------------------

    def _usable(self, found: Detections) -> Detections:
        """Detections with the model's own error in their covariance."""
        floor = self.parameters.sigma_model_px**2 * np.eye(2)
        return replace(found, cov_px2=found.cov_px2 + floor)

    def _match(self, found: Sequence[Detections | None]) -> tuple[Ints, Bools, Array]:
        """The paper's matching in every camera: points, whether step 2 found them, gains, each (n,)."""
        t, p, model = self.tracks, self.parameters, self.model
        n = len(model)
        point, turned, gain = np.full(n, UNMATCHED), np.zeros(n, dtype=bool), np.full(n, np.nan)
        spread = np.sqrt(np.maximum(t.P[:, 0, 0], t.P[:, 1, 1]))
        r1 = np.clip(p.radius_sigmas * spread, p.r1_px, max(p.r1_px, p.max_radius_px))
        moved = np.linalg.norm(t.x[:, :2] - t.last, axis=-1)
        r2 = np.clip(1.5 * moved, p.r2_px, max(p.r2_px, p.max_radius_px))
        margin = p.image_margin_px + np.minimum(3 * spread, p.r1_px)
        in_view = t.alive & model.in_picture(t.x[:, :2], margin)
        for c, points in enumerate(found):
            rows = np.flatnonzero(in_view & (model.camera_of == c))
            if points is None or not len(rows):
                continue
            m = match(t.last[rows], t.x[rows, :2], r1[rows], r2[rows], points.uv_px, model.image_size_px[rows[0]], p)
            point[rows], turned[rows], gain[rows] = m.point, m.step == 2, m.gain
        return point, turned, gain

    def _far_from_prediction(self, found: Sequence[Detections | None], point: Ints) -> Bools:
        """Which matched views lie outside their first search region: the trajectory bent, or nobody looked."""
        uv, _ = self._pixels(found, point)
        gap = np.linalg.norm(uv - self.tracks.x[:, :2], axis=-1)
        return (point != UNMATCHED) & ~(self.tracks.alive & (gap <= self.parameters.r1_px))

    def _pixels(self, found: Sequence[Detections | None], point: Ints) -> tuple[Array, Array]:
        """Positions (n, 2) and covariances (n, 2, 2) of the matched points; nan without."""
        n = len(self.model)
        uv, cov = np.full((n, 2), np.nan), np.full((n, 2, 2), np.nan)
        for c, points in enumerate(found):
            rows = np.flatnonzero((self.model.camera_of == c) & (point != UNMATCHED))
            if points is not None and len(rows):
                uv[rows], cov[rows] = points.uv_px[point[rows]], points.cov_px2[point[rows]]
        return uv, cov

    # -- the pose as a witness ----------------------------------------------------------------------------------------

    def _start(self) -> Pose:
        return self.vehicle.motion.world_from_body if self.vehicle.motion is not None else self.prior.centre

    def _pose(
        self, found: Sequence[Detections | None], point: Ints, turned: Bools, events: list[Event]
    ) -> tuple[PoseFit | None, Ints, Bools]:
        """The pose from the matches, with the wrong ones dropped and the missed ones added. None: not observable."""
        rows = np.flatnonzero(point != UNMATCHED)
        if len(rows) < 3:
            return None, point, turned
        uv, cov = self._pixels(found, point)
        fit = fit_pose_robust(
            self.model,
            rows,
            uv[rows],
            cov[rows],
            self._start(),
            expected=self.vehicle.expected,
            limits=self.limits,
            noise_scale=self.vehicle.noise_scale,
            calibration=self.calibration,
        )
        if fit is None:
            fit = self._blended_fit(rows, uv, cov)
        if fit is None or not good_enough(fit, self.limits):
            return None, point, turned
        if len(rows) < 4 and not self._plausible(fit):
            return None, point, turned
        if not self.parameters.rigid_check:
            return fit, point, turned
        before, point = point, point.copy()
        left_out = np.setdiff1d(rows, fit.rows)
        point[left_out] = UNMATCHED
        point, new = self._add_missed(found, point, fit)
        if new:
            rows = np.union1d(fit.rows, new)
            now, now_cov = self._pixels(found, point)
            wider = fit_pose(
                self.model, rows, now[rows], now_cov[rows], fit.world_from_body, calibration=self.calibration
            )
            if wider is not None and wider.consistent(self.limits.p_false_alarm):
                fit = wider
                turned = np.where(np.isin(np.arange(len(point)), new), self._far_from_prediction(found, point), turned)
            else:
                point[new] = UNMATCHED
        for view in left_out[point[left_out] == UNMATCHED]:
            taken = np.any((point == before[view]) & (self.model.camera_of == self.model.camera_of[view]))
            if not taken and np.linalg.norm(uv[view] - fit.projected_px[view]) < self.parameters.blend_px:
                # A neighbour that melts into a spot pulls its centre by a pixel or two: still it, but no witness.
                point[view] = before[view]
            else:
                events.append(Event("dropped", "contradicts the other spots: not this spot", int(view)))
        return fit, point, turned & (point != UNMATCHED)

    def _blended_fit(self, rows: Ints, uv: Array, cov: Array) -> PoseFit | None:
        """All spots, where none can be singled out but all lie near their places; the frame's own misfit widens it."""
        fit = fit_pose(self.model, rows, uv[rows], cov[rows], self._start(), calibration=self.calibration)
        if fit is None or fit.dof <= 0 or np.linalg.norm(fit.residuals_px, axis=-1).max() > self.parameters.blend_px:
            return None
        if not self._plausible(fit):
            return None  # at a bend nothing vouches for such a set: all spots are searched anew
        return fit.widened(max(1.0, fit.chi2 / fit.dof / self.vehicle.noise_scale**2))

    def _plausible(self, fit: PoseFit) -> bool:
        """Whether three spots, which fit any labels, give a pose that the motion allows."""
        expected = self.vehicle.expected
        if expected is None:
            return False
        gap = fit.world_from_body.minus(expected[0])
        return float(gap @ np.linalg.solve(expected[1] + fit.covariance, gap)) < EXPECTED_GATE

    def _add_missed(self, found: Sequence[Detections | None], point: Ints, fit: PoseFit) -> tuple[Ints, list[int]]:
        """Detections where the pose puts spots that have none yet."""
        uv, reach = fit.projected_px, fit.spot_covariances()
        new: list[int] = []
        open_views = np.flatnonzero((point == UNMATCHED) & self.model.in_picture(uv, self.parameters.image_margin_px))
        for view in open_views:
            c = int(self.model.camera_of[view])
            points = found[c]
            if points is None or not len(points):
                continue
            taken = point[(self.model.camera_of == c) & (point != UNMATCHED)]
            gap = points.uv_px - uv[view]
            S = points.cov_px2 * self.vehicle.noise_scale**2 + reach[view]
            d2 = np.sum(gap * np.linalg.solve(S, gap[..., None])[..., 0], axis=-1)
            d2[taken] = np.inf
            best = int(np.argmin(d2))
            if d2[best] < RIGID_GATE:
                point[view] = best
                new.append(int(view))
        return point, new

    # -- labels without a track ---------------------------------------------------------------------------------------

    def _should_search(self, found: Sequence[Detections | None]) -> bool:
        """Whether to look for the whole vehicle anew: enough points are there, and the tracks give no pose."""
        if (
            self.vehicle.anchor is None
            or sum(len(f) for f in found if f is not None) < self.parameters.labels.min_spots
        ):
            return False
        self._frames_since_try += 1
        # At once when light returns, then ever more rarely: what fails for long will fail in the next frame too.
        tries = self._frames_since_try
        return tries <= 10 or tries % 5 == 0

    def _acquire(
        self, found: Sequence[Detections | None], prior: PosePrior, events: list[Event], kind: str
    ) -> tuple[PoseFit | None, Ints]:
        """Labels from a prior alone; the pose is refitted with the points' own covariances."""
        nothing = None, np.full(len(self.model), UNMATCHED)
        by_camera = {name: f for name, f in zip(self.model.camera_names, found, strict=True) if f is not None}
        result = find_labels(self.rig, self.model, by_camera, prior, self.parameters.labels, self.calibration)
        if result.chosen is None:
            if result.tie and not self._told_tie:
                events.append(Event("tie", result.in_words(self.model)))
                self._told_tie = True
            return nothing
        point = np.where(result.chosen.point_of == NO_POINT, UNMATCHED, result.chosen.point_of)
        rows = np.flatnonzero(point != UNMATCHED)
        uv, cov = self._pixels(found, point)
        start = result.chosen.fit.world_from_body
        fit = fit_pose_robust(
            self.model,
            rows,
            uv[rows],
            cov[rows],
            start,
            limits=self.limits,
            noise_scale=self.vehicle.noise_scale,
            calibration=self.calibration,
        )
        if fit is None:
            # The labels hold within the model's error, the claimed sigmas do not: this frame's own misfit widens it.
            fit = fit_pose(self.model, rows, uv[rows], cov[rows], start, calibration=self.calibration)
            if fit is not None and fit.dof > 0:
                fit = fit.widened(max(1.0, fit.chi2 / fit.dof / self.vehicle.noise_scale**2))
        if fit is None or not good_enough(fit, self.limits):
            return nothing
        names = ", ".join(self.model.views[v][1] for v in rows)
        events.append(Event(kind, f"spots {names} found from the prior alone"))
        self._told_tie = False
        return fit, point

    # -- modification -------------------------------------------------------------------------------------------------

    def _conclude(
        self,
        dt_s: float,
        found: Sequence[Detections | None],
        predicted: Array,
        point: Ints,
        turned: Bools,
        gain: Array,
        fit: PoseFit | None,
        events: list[Event],
    ) -> TrackedFrame:
        """Update filters and statuses from what was recognised."""
        if fit is not None:
            self._labelled, self._frames_since_try = True, 0
            self.vehicle.measured(fit, dt_s)
        elif self.vehicle.motion is not None:
            point = self._believed(found, point)
            turned = turned & (point != UNMATCHED)

        uv, cov = self._pixels(found, point)
        seen = point != UNMATCHED
        cov = self._with_blends(fit, uv, cov, seen)
        estimate, estimate_cov, exists = self._estimates(fit, uv)
        used_in_pose = seen if fit is None else np.isin(np.arange(len(self.model)), fit.rows)
        self._update_tracks(uv, cov, used_in_pose, turned, estimate, estimate_cov, exists, fit is not None)
        t = self.tracks
        rest = ~seen
        uv = np.where(rest[:, None], np.where(exists[:, None], estimate, t.x[:, :2]), uv)
        cov = np.where(rest[:, None, None], np.where(exists[:, None, None], estimate_cov, t.P[:, :2, :2]), cov)
        status = self._statuses(found, seen, turned, uv, exists, fit)
        unknown = np.array([s in (SpotStatus.LOST, SpotStatus.OFF_SCREEN) for s in status])
        uv = np.where(unknown[:, None], np.nan, uv)
        t.alive = t.alive & ~unknown
        t.remember(uv, cov)
        pose_status, pose, covariance = self.vehicle.result(fit)
        return TrackedFrame(
            uv_px=uv,
            cov_px2=np.where(unknown[:, None, None], np.nan, cov),
            status=tuple(status),
            predicted_px=predicted,
            gain=np.where(seen, gain, np.nan),
            point=point,
            pose_status=pose_status,
            pose=pose,
            pose_covariance=covariance,
            pose_systematic=None if pose is None else self.vehicle.systematic(fit),
            spots_used=len(fit.rows) if fit is not None else (int(np.count_nonzero(seen)) if pose is not None else 0),
            rms_px=fit.rms_px if fit is not None else float("nan"),
            events=tuple(events),
            used_in_pose=used_in_pose & seen,
        )

    def _believed(self, found: Sequence[Detections | None], point: Ints) -> Ints:
        """Where the matches do not give the pose they still narrow its prediction; those beyond belief are let go."""
        rows = np.flatnonzero(point != UNMATCHED)
        uv, cov = self._pixels(found, point)
        good = self.vehicle.measured_partly(self.model, rows, uv[rows], cov[rows])
        point = point.copy()
        point[rows[~good]] = UNMATCHED
        return point

    def _with_blends(self, fit: PoseFit | None, uv: Array, cov: Array, seen: Bools) -> Array:
        """Covariances, those of matched spots that the pose fit left out grown by how far they lie from it."""
        if fit is None:
            return cov
        blended = np.setdiff1d(np.flatnonzero(seen), fit.rows)
        if not len(blended):
            return cov
        gap2 = np.sum((uv[blended] - fit.projected_px[blended]) ** 2, axis=-1)
        cov = cov.copy()
        cov[blended] += gap2[:, None, None] * np.eye(2)
        return cov

    def _estimates(self, fit: PoseFit | None, uv: Array) -> tuple[Array, Array, Bools]:
        """Positions (n, 2) and covariances of all views from the others, and whether they exist."""
        n = len(self.model)
        motion = self.vehicle.motion
        if motion is None:
            return np.full((n, 2), np.nan), np.full((n, 2, 2), np.nan), np.zeros(n, dtype=bool)
        if fit is not None:
            position, spread = fit.projected_px, fit.spot_covariances() * self.vehicle.noise_scale**2
        else:
            position, J = self.model.project(motion.world_from_body)
            spread = point_covariance(J, motion.covariance) + self.vehicle.calibration_px(n)
        exists = ~np.isnan(position[:, 0])
        if self.parameters.out_of_view == "quadratic":
            solved = quadratic_positions(self.rig, self.model, self.coplanar, uv)
            outside = exists & ~self.model.in_picture(position) & ~np.isnan(solved[:, 0])
            position = np.where(outside[:, None], solved, position)
        if self.parameters.estimate == "prediction":
            # The paper: a hidden spot's estimate is its own filter's prediction; outside the picture it is solved.
            hidden = self.tracks.alive & self.model.in_picture(position)
            position = np.where(hidden[:, None], self.tracks.x[:, :2], position)
            spread = np.where(hidden[:, None, None], self.tracks.P[:, :2, :2], spread)
        return position, spread, exists

    def _update_tracks(
        self,
        uv: Array,
        cov: Array,
        seen: Bools,
        turned: Bools,
        estimate: Array,
        estimate_cov: Array,
        exists: Bools,
        measured_pose: bool,
    ) -> None:
        """Matched: Kalman's update, or eq. (6) at a bend. Not matched: the estimate stands for the measurement."""
        t, p, motion = self.tracks, self.parameters, self.vehicle.motion
        by_estimate = ~seen & exists & measured_pose
        if p.estimate == "prediction":
            by_estimate &= ~self.model.in_picture(estimate)
        use = seen | by_estimate
        z = np.where(seen[:, None], uv, estimate)
        R = np.where(seen[:, None, None], cov * self.vehicle.noise_scale**2, estimate_cov)
        new = use & ~t.alive
        t.update(z, R, use, seen, turned, p)
        # New tracks, and all that the pose filter alone carries, take position and rate from the vehicle's motion.
        seed = new | (~seen & exists & t.alive & (not measured_pose) & (p.estimate == "rigid"))
        if seed.any() and motion is not None:
            t.carry(seed, self.model, motion)
            at = np.where(use[:, None], z, estimate)
            here = seed & ~np.isnan(at[:, 0])
            t.x[here, :2], t.alive[here] = at[here], True

    def _statuses(
        self,
        found: Sequence[Detections | None],
        seen: Bools,
        turned: Bools,
        uv: Array,
        exists: Bools,
        fit: PoseFit | None,
    ) -> list[SpotStatus]:
        """One word per view."""
        model, t = self.model, self.tracks
        inside: Bools = model.in_picture(uv)
        nothing: Bools = np.asarray(np.isnan(uv).any(axis=-1))
        known_pose = fit is not None or self.vehicle.known
        out: list[SpotStatus] = []
        for i in range(len(model)):
            if seen[i]:
                out.append(SpotStatus.TURNED if turned[i] else SpotStatus.MATCHED)
            elif not self._labelled:
                out.append(SpotStatus.LOST)
            elif known_pose and not exists[i]:
                out.append(SpotStatus.OFF_SCREEN)
            elif nothing[i] or not (t.alive[i] and (known_pose or t.unseen_s[i] <= self.parameters.max_coast_s)):
                out.append(SpotStatus.LOST)
            elif found[int(model.camera_of[i])] is None:
                out.append(SpotStatus.NO_IMAGE)
            else:
                out.append(SpotStatus.OCCLUDED if inside[i] else SpotStatus.OUT_OF_VIEW)
        return out
