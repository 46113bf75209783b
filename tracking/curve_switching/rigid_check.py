"""The pose from the matched spots, and the check of every match against it: drop false matches, add missed ones.

Source: ours (`TrackerParameters.rigid_check`). The paper matches every spot by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import (
    EXPECTED_GATE,
    PoseFit,
    SolveLimits,
    fit_pose,
    fit_pose_robust,
    is_measurement,
)
from geometry.uncertainty.rig_uncertainty import RigUncertainty
from tracking.curve_switching.vehicle import Tracks, Vehicle
from tracking.detections import UNMATCHED, Detections
from tracking.parameters import TrackerParameters
from tracking.tracked_frame import Event

RIGID_GATE = 20.0  # squared sigmas: a detection this near to a spot's place in the pose is that spot (p = 5e-5)


def matched_pixels(model: SpotModel, found: Sequence[Detections | None], point: Ints) -> tuple[Array, Array]:
    """Positions (n, 2), px, and covariances (n, 2, 2), px^2, of the detections `point` (n,); nan where UNMATCHED."""
    n = len(model)
    uv, cov = np.full((n, 2), np.nan), np.full((n, 2, 2), np.nan)
    for c, points in enumerate(found):
        rows = np.flatnonzero((model.camera_of == c) & (point != UNMATCHED))
        if points is not None and len(rows):
            uv[rows], cov[rows] = points.uv_px[point[rows]], points.cov_px2[point[rows]]
    return uv, cov


def outside_first_search(model: SpotModel, tracks: Tracks, r1_px: float, uv_px: Array) -> Bools:
    """Which matched views (n,), uv_px (n, 2), lie outside their first search region or have no track: `turned`."""
    gap = np.linalg.norm(uv_px - tracks.x[:, :2], axis=-1)
    return ~np.isnan(uv_px[:, 0]) & ~(tracks.alive & (gap <= r1_px))


@dataclass(frozen=True, slots=True)
class RigidCheck:
    """The pose fit to matched spots, for one tracker."""

    model: SpotModel
    parameters: TrackerParameters
    limits: SolveLimits
    calibration: RigUncertainty | None

    def pose_of_matches(
        self,
        found: Sequence[Detections | None],
        point: Ints,
        turned: Bools,
        tracks: Tracks,
        vehicle: Vehicle,
        start: Pose,
        events: list[Event],
    ) -> tuple[PoseFit | None, Ints, Bools]:
        """The pose from the matches, and the corrected `point` (n,) and `turned` (n,). None: not observable.

        start: the pose at which the fit begins. With `rigid_check` false matches are dropped, with an event each, and
        missed spots are added.
        """
        rows = np.flatnonzero(point != UNMATCHED)
        if len(rows) < 3:
            return None, point, turned
        uv, cov = matched_pixels(self.model, found, point)
        fit = self.robust_fit(rows, uv, cov, start, vehicle, expected=vehicle.expected)
        if fit is None:
            fit = self._merged_fit(rows, uv, cov, start, vehicle)
        if fit is None or not is_measurement(fit, self.limits):
            return None, point, turned
        if len(rows) < 4 and not _agrees_with_motion(fit, vehicle):
            return None, point, turned
        if not self.parameters.rigid_check:
            return fit, point, turned
        matched, point = point, point.copy()
        left_out = np.setdiff1d(rows, fit.rows)
        point[left_out] = UNMATCHED
        fit, point, turned = self._with_missed_spots(found, point, turned, tracks, vehicle, fit)
        for view in left_out[point[left_out] == UNMATCHED]:
            taken = np.any((point == matched[view]) & (self.model.camera_of == self.model.camera_of[view]))
            if not taken and np.linalg.norm(uv[view] - fit.projected_px[view]) < self.parameters.blend_px:
                # A neighbour that merges with a spot shifts its centre by a pixel or two: the detection stays labelled
                # but is excluded from the pose.
                point[view] = matched[view]
            else:
                events.append(Event("dropped", "contradicts the other spots: not this spot", int(view)))
        return fit, point, turned & (point != UNMATCHED)

    def robust_fit(
        self,
        rows: Ints,
        uv: Array,
        cov: Array,
        start: Pose,
        vehicle: Vehicle,
        expected: tuple[Pose, Array] | None = None,
    ) -> PoseFit | None:
        """The robust fit to the views `rows` of uv (n, 2) and cov (n, 2, 2), near the pose `expected` if given."""
        return fit_pose_robust(
            self.model,
            rows,
            uv[rows],
            cov[rows],
            start,
            expected=expected,
            limits=self.limits,
            noise_scale=vehicle.noise_scale,
            calibration=self.calibration,
        )

    def widened_fit(self, rows: Ints, uv: Array, cov: Array, start: Pose, vehicle: Vehicle) -> PoseFit | None:
        """The fit to all views `rows`, its covariance scaled by the frame's own chi2 / dof where that is larger."""
        fit = fit_pose(self.model, rows, uv[rows], cov[rows], start, calibration=self.calibration)
        return None if fit is None else _widened(fit, vehicle)

    def _merged_fit(self, rows: Ints, uv: Array, cov: Array, start: Pose, vehicle: Vehicle) -> PoseFit | None:
        """The widened fit to all spots, if all lie near their places but no single spot can be excluded."""
        fit = fit_pose(self.model, rows, uv[rows], cov[rows], start, calibration=self.calibration)
        if fit is None or fit.dof <= 0 or np.linalg.norm(fit.residuals_px, axis=-1).max() > self.parameters.blend_px:
            return None
        # At a bend nothing confirms such a set of matches: the search for labels decides.
        return _widened(fit, vehicle) if _agrees_with_motion(fit, vehicle) else None

    def _with_missed_spots(
        self,
        found: Sequence[Detections | None],
        point: Ints,
        turned: Bools,
        tracks: Tracks,
        vehicle: Vehicle,
        fit: PoseFit,
    ) -> tuple[PoseFit, Ints, Bools]:
        """The fit, `point` and `turned` with the missed spots, as far as the fit with them is consistent."""
        point, new = self._add_missed(found, point, vehicle, fit)
        if not new:
            return fit, point, turned
        rows = np.union1d(fit.rows, new)
        uv, cov = matched_pixels(self.model, found, point)
        wider = fit_pose(self.model, rows, uv[rows], cov[rows], fit.world_from_body, calibration=self.calibration)
        if wider is None or not wider.consistent(self.limits.p_false_alarm):
            point[new] = UNMATCHED
            return fit, point, turned
        far = outside_first_search(self.model, tracks, self.parameters.r1_px, uv)
        return wider, point, np.where(np.isin(np.arange(len(point)), new), far, turned)

    def _add_missed(
        self, found: Sequence[Detections | None], point: Ints, vehicle: Vehicle, fit: PoseFit
    ) -> tuple[Ints, list[int]]:
        """Enter the nearest free detection within the gate for every view that has none; also the views added."""
        uv, fit_cov = fit.projected_px, fit.spot_covariances()
        new: list[int] = []
        open_views = np.flatnonzero((point == UNMATCHED) & self.model.in_picture(uv, self.parameters.image_margin_px))
        for view in open_views:
            c = int(self.model.camera_of[view])
            points = found[c]
            if points is None or not len(points):
                continue
            taken = point[(self.model.camera_of == c) & (point != UNMATCHED)]
            gap = points.uv_px - uv[view]
            S = points.cov_px2 * vehicle.noise_scale**2 + fit_cov[view]
            d2 = np.sum(gap * np.linalg.solve(S, gap[..., None])[..., 0], axis=-1)
            d2[taken] = np.inf
            best = int(np.argmin(d2))
            if d2[best] < RIGID_GATE:
                point[view] = best
                new.append(int(view))
        return point, new


def _agrees_with_motion(fit: PoseFit, vehicle: Vehicle) -> bool:
    """Whether the predicted motion allows the pose. Needed for three spots, which fit any labels."""
    expected = vehicle.expected
    if expected is None:
        return False
    gap = fit.world_from_body.minus(expected[0])
    return float(gap @ np.linalg.solve(expected[1] + fit.covariance, gap)) < EXPECTED_GATE


def _widened(fit: PoseFit, vehicle: Vehicle) -> PoseFit:
    return fit.widened(max(1.0, fit.chi2 / fit.dof / vehicle.noise_scale**2)) if fit.dof > 0 else fit
