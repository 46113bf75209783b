"""The curve-switching tracker: a Kalman filter per spot, three-step matching, and one pose of the rigid body.

Source: Huo, Yang & Yang 2015, fig. 1: predict, eqs. (1) and (2); recognise, spots in view by matching (section 4.1)
and spots out of view by solving from the other beams (section 4.2); modify, eqs. (3) to (6). Ours: the pose from the
matched spots checks every match and predicts the spots that are not matched (vehicle.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.forward_model import SpotModel
from geometry.pose_prior import PosePrior
from geometry.pose_solver.gauss_newton import PoseFit, SolveLimits, is_measurement, pixel_covariance
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigCovariance, RigUncertainty
from tracking.curve_switching.matching import match
from tracking.curve_switching.out_of_view import CoplanarViews, quadratic_positions
from tracking.curve_switching.vehicle import RigidCheck, Tracks, Vehicle, matched_pixels, outside_first_search
from tracking.detections import UNMATCHED, Detections
from tracking.input_validation import check_step
from tracking.labelling.first_labels import NO_POINT, find_labels
from tracking.parameters import TrackerParameters
from tracking.statuses import Event, SpotStatus, TrackedFrame, view_statuses

EAGER_SEARCHES = 10  # frames without a pose in which the labels are searched every time, and then only ...
SEARCH_EVERY = 5  # ... in every fifth: a search that has failed for long is likely to fail again


@dataclass(frozen=True, slots=True)
class _Matches:
    """The matches of one frame, n views."""

    point: Ints  # (n,) row of the detection in its camera's list, or UNMATCHED
    turned: Bools  # (n,) found by matching step 2, or far from the prediction
    gain: Array  # (n,) g3; nan without a match


@dataclass(frozen=True, slots=True)
class _Estimates:
    """Positions of all views from the other spots."""

    uv: Array  # (n, 2) px; nan where the spot does not exist
    cov: Array  # (n, 2, 2) px^2
    exists: Bools  # (n,) the beam meets its screen in front of the camera


class SpotTracker:
    """Tracks the spots of one rig, frame by frame."""

    def __init__(
        self, rig: Rig, parameters: TrackerParameters, prior: PosePrior, covariance: RigCovariance | None = None
    ) -> None:
        """covariance: of the rig's calibration, if known; it then contributes to the covariances of the poses."""
        self.rig = rig
        self.model = SpotModel.of(rig)
        self.calibration = None if covariance is None else RigUncertainty(rig, self.model, covariance)
        self.parameters = parameters
        self.prior = prior
        self.coplanar = CoplanarViews.of(self.model)
        self.tracks = Tracks.none(len(self.model), parameters.sigma_a_px_s2)
        self.vehicle = Vehicle(parameters)
        self.limits = SolveLimits(parameters.max_sigma_m, np.deg2rad(parameters.max_sigma_deg))
        self.rigid_check = RigidCheck(self.model, parameters, self.limits, self.calibration)
        self._started = False
        self._labelled = False
        self._searches = 0  # frames since the last pose in which the labels could be searched
        self._tie_reported = False

    @property
    def noise_scale(self) -> float:
        """Ratio of the spots' actual to their stated sigmas."""
        return self.vehicle.noise_scale

    def step(self, dt_s: float, found: Sequence[Detections | None]) -> TrackedFrame:
        """Process one frame.

        dt_s: time since the previous frame (0 for the first); found: detections per camera, None without a picture.
        Raises ValueError: if dt_s is not positive and finite (0 is allowed for the first frame), or if `found` does not
        have one entry per camera.
        """
        check_step(dt_s, found, self.model.camera_names, not self._started)
        self._started = True
        if dt_s > 0:
            self.tracks.predict(dt_s)
            self.vehicle.predict(dt_s)
        events: list[Event] = []
        predicted = self.tracks.predicted_px
        found = [None if f is None else self._with_model_error(f) for f in found]
        matches, fit = self._recognise(dt_s, found, events)
        return self._modify(dt_s, found, predicted, matches, fit, events)

    # -- recognise: match, check, search ------------------------------------------------------------------------------

    def _with_model_error(self, found: Detections) -> Detections:
        """Detections with the model's own error added to their covariances."""
        floor = self.parameters.sigma_model_px**2 * np.eye(2)
        return replace(found, cov_px2=found.cov_px2 + floor)

    def _recognise(
        self, dt_s: float, found: Sequence[Detections | None], events: list[Event]
    ) -> tuple[_Matches, PoseFit | None]:
        """The matches of one frame and the pose from them; None if the frame does not determine it."""
        n = len(self.model)
        if not self._labelled:
            fit, point = self._acquire(found, self.prior, events, "labelled")
            return _Matches(point, np.zeros(n, dtype=bool), np.full(n, np.nan)), fit
        matches = self._match(found)
        motion = self.vehicle.motion
        start = self.prior.centre if motion is None else motion.world_from_body
        fit, point, turned = self.rigid_check.pose_of_matches(
            found, matches.point, matches.turned, self.tracks, self.vehicle, start, events
        )
        if fit is None and self._should_search(found):
            kind = "relabelled" if self.vehicle.anchor_age_s <= 1.5 * dt_s else "reacquired"
            acquired, points = self._acquire(found, self.vehicle.search_prior(self.prior), events, kind)
            if acquired is not None:
                fit, point = acquired, points
                uv, _ = matched_pixels(self.model, found, point)
                turned = outside_first_search(self.tracks, self.parameters.r1_px, uv)
        return _Matches(point, turned, matches.gain), fit

    def _match(self, found: Sequence[Detections | None]) -> _Matches:
        """The three-step matching of section 4.1.2 in every camera."""
        t, p, model = self.tracks, self.parameters, self.model
        n = len(model)
        point, turned, gain = np.full(n, UNMATCHED), np.zeros(n, dtype=bool), np.full(n, np.nan)
        sigma = np.sqrt(np.maximum(t.P[:, 0, 0], t.P[:, 1, 1]))
        r1 = np.clip(p.radius_sigmas * sigma, p.r1_px, max(p.r1_px, p.max_radius_px))
        displacement = np.linalg.norm(t.x[:, :2] - t.last, axis=-1)
        r2 = np.clip(1.5 * displacement, p.r2_px, max(p.r2_px, p.max_radius_px))
        margin = p.image_margin_px + np.minimum(3 * sigma, p.r1_px)
        in_view = t.alive & model.in_picture(t.x[:, :2], margin)
        for c, points in enumerate(found):
            rows = np.flatnonzero(in_view & (model.camera_of == c))
            if points is None or not len(rows):
                continue
            m = match(t.last[rows], t.x[rows, :2], r1[rows], r2[rows], points.uv_px, model.image_size_px[rows[0]], p)
            point[rows], turned[rows], gain[rows] = m.point, m.step == 2, m.gain
        return _Matches(point, turned, gain)

    def _should_search(self, found: Sequence[Detections | None]) -> bool:
        """Whether to search the labels again: there are enough points, and the tracks give no pose."""
        if (
            self.vehicle.anchor is None
            or sum(len(f) for f in found if f is not None) < self.parameters.labels.min_spots
        ):
            return False
        self._searches += 1
        return self._searches <= EAGER_SEARCHES or self._searches % SEARCH_EVERY == 0

    def _acquire(
        self, found: Sequence[Detections | None], prior: PosePrior, events: list[Event], kind: str
    ) -> tuple[PoseFit | None, Ints]:
        """Labels from a prior alone; the pose is fitted again with the points' own covariances."""
        nothing = None, np.full(len(self.model), UNMATCHED)
        by_camera = {name: f for name, f in zip(self.model.camera_names, found, strict=True) if f is not None}
        result = find_labels(self.rig, self.model, by_camera, prior, self.parameters.labels, self.calibration)
        if result.chosen is None:
            if result.tie and not self._tie_reported:
                events.append(Event("tie", result.in_words(self.model)))
                self._tie_reported = True
            return nothing
        point = np.where(result.chosen.point_of == NO_POINT, UNMATCHED, result.chosen.point_of)
        rows = np.flatnonzero(point != UNMATCHED)
        uv, cov = matched_pixels(self.model, found, point)
        start = result.chosen.fit.world_from_body
        fit = self.rigid_check.robust_fit(rows, uv, cov, start, self.vehicle)
        if fit is None:
            # The labels agree within the model's error but not within the stated sigmas.
            fit = self.rigid_check.widened_fit(rows, uv, cov, start, self.vehicle)
        if fit is None or not is_measurement(fit, self.limits):
            return nothing
        names = ", ".join(self.model.views[v][1] for v in rows)
        events.append(Event(kind, f"spots {names} found from the prior alone"))
        self._tie_reported = False
        return fit, point

    # -- modify: update filters and statuses --------------------------------------------------------------------------

    def _modify(
        self,
        dt_s: float,
        found: Sequence[Detections | None],
        predicted: Array,
        matches: _Matches,
        fit: PoseFit | None,
        events: list[Event],
    ) -> TrackedFrame:
        """Update filters and statuses from the recognised spots."""
        point, turned = matches.point, matches.turned
        if fit is not None:
            self._labelled, self._searches = True, 0
            self.vehicle.update_with_pose(fit, dt_s)
        elif self.vehicle.motion is not None:
            point = self._update_vehicle_with_spots(found, point)
            turned = turned & (point != UNMATCHED)

        uv, cov = matched_pixels(self.model, found, point)
        seen = point != UNMATCHED
        cov = _with_merged_spots(fit, uv, cov, seen)
        estimates = self._estimates(fit, uv)
        used_in_pose = seen if fit is None else np.isin(np.arange(len(self.model)), fit.rows)
        self._update_tracks(uv, cov, used_in_pose, turned, estimates, fit is not None)
        t, exists = self.tracks, estimates.exists
        rest = ~seen
        uv = np.where(rest[:, None], np.where(exists[:, None], estimates.uv, t.x[:, :2]), uv)
        cov = np.where(rest[:, None, None], np.where(exists[:, None, None], estimates.cov, t.P[:, :2, :2]), cov)
        status = self._statuses(found, seen, turned, uv, exists, fit)
        unknown = np.array([s in (SpotStatus.LOST, SpotStatus.OFF_SCREEN) for s in status])
        uv = np.where(unknown[:, None], np.nan, uv)
        t.alive = t.alive & ~unknown
        t.store_last(uv, cov)
        pose_status, pose, covariance = self.vehicle.result(fit)
        return TrackedFrame(
            uv_px=uv,
            cov_px2=np.where(unknown[:, None, None], np.nan, cov),
            status=status,
            predicted_px=predicted,
            gain=np.where(seen, matches.gain, np.nan),
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

    def _update_vehicle_with_spots(self, found: Sequence[Detections | None], point: Ints) -> Ints:
        """Update the vehicle's motion with matches that do not determine the pose; the accepted matches (n,)."""
        rows = np.flatnonzero(point != UNMATCHED)
        uv, cov = matched_pixels(self.model, found, point)
        good = self.vehicle.update_with_spots(self.model, rows, uv[rows], cov[rows])
        point = point.copy()
        point[rows[~good]] = UNMATCHED
        return point

    def _estimates(self, fit: PoseFit | None, uv: Array) -> _Estimates:
        """Positions of all views from the other spots: by the pose (ours) or by section 4.2; uv (n, 2): matched."""
        n = len(self.model)
        motion = self.vehicle.motion
        if motion is None:
            return _Estimates(np.full((n, 2), np.nan), np.full((n, 2, 2), np.nan), np.zeros(n, dtype=bool))
        if fit is not None:
            position, spread = fit.projected_px, fit.spot_covariances() * self.vehicle.noise_scale**2
        else:
            position, J = self.model.project(motion.world_from_body)
            spread = pixel_covariance(J, motion.covariance) + self.vehicle.calibration_px(n)
        exists = ~np.isnan(position[:, 0])
        if self.parameters.out_of_view == "quadratic":
            solved = quadratic_positions(self.rig, self.model, self.coplanar, uv)
            outside = exists & ~self.model.in_picture(position) & ~np.isnan(solved[:, 0])
            position = np.where(outside[:, None], solved, position)
        if self.parameters.estimate == "prediction":
            # The paper: the estimate of a hidden spot is its own filter's prediction; outside the image it is solved.
            hidden = self.tracks.alive & self.model.in_picture(position)
            position = np.where(hidden[:, None], self.tracks.x[:, :2], position)
            spread = np.where(hidden[:, None, None], self.tracks.P[:, :2, :2], spread)
        return _Estimates(position, spread, exists)

    def _update_tracks(
        self, uv: Array, cov: Array, seen: Bools, turned: Bools, estimates: _Estimates, pose_measured: bool
    ) -> None:
        """Update with the matched positions; unmatched tracks take the estimate as their measurement."""
        t, p, motion = self.tracks, self.parameters, self.vehicle.motion
        exists = estimates.exists
        by_estimate = ~seen & exists & pose_measured
        if p.estimate == "prediction":
            by_estimate &= ~self.model.in_picture(estimates.uv)
        use = seen | by_estimate
        z = np.where(seen[:, None], uv, estimates.uv)
        R = np.where(seen[:, None, None], cov * self.vehicle.noise_scale**2, estimates.cov)
        new = use & ~t.alive
        t.update(z, R, use, seen, turned, p)
        # New tracks, and tracks that only the pose filter predicts, take position and rate from the vehicle's motion.
        seed = new | (~seen & exists & t.alive & (not pose_measured) & (p.estimate == "rigid"))
        if seed.any() and motion is not None:
            t.set_from_motion(seed, self.model, motion)
            at = np.where(use[:, None], z, estimates.uv)
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
    ) -> tuple[SpotStatus, ...]:
        """The status of every view."""
        model, t = self.model, self.tracks
        known_pose = fit is not None or self.vehicle.known
        exists = exists | (not known_pose)
        followed = t.alive & (known_pose | (t.unseen_s <= self.parameters.max_coast_s)) & ~np.isnan(uv).any(axis=-1)
        known = self._labelled & (followed | ~exists)
        has_image = np.array([f is not None for f in found])[model.camera_of]
        return view_statuses(seen, turned, exists, model.in_picture(uv), has_image, known)


def _with_merged_spots(fit: PoseFit | None, uv: Array, cov: Array, seen: Bools) -> Array:
    """Covariances (n, 2, 2), enlarged by the squared residual for matched spots that are excluded from the pose fit."""
    if fit is None:
        return cov
    merged = np.setdiff1d(np.flatnonzero(seen), fit.rows)
    if not len(merged):
        return cov
    gap2 = np.sum((uv[merged] - fit.projected_px[merged]) ** 2, axis=-1)
    cov = cov.copy()
    cov[merged] += gap2[:, None, None] * np.eye(2)
    return cov
