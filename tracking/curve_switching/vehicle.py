"""The trackers of all spots of a vehicle, the pose that they share, and the check of every match against it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from geometry.pose_solver.gauss_newton import (
    EXPECTED_GATE,
    PoseFit,
    SolveLimits,
    fit_pose,
    fit_pose_robust,
    is_measurement,
    pixel_covariance,
)
from geometry.uncertainty.rig_uncertainty import RigUncertainty
from tracking import kalman
from tracking.detections import UNMATCHED, Detections
from tracking.kalman import RigidMotion
from tracking.parameters import TrackerParameters
from tracking.rigid_body.online_estimates import VarianceFactor
from tracking.statuses import LOST_SIGMA_M, LOST_SIGMA_RAD, Event, PoseStatus

# The Kalman filters of all views and their history.

BENT_NIS = 25.0  # squared sigmas: an innovation beyond this is a bend of the trajectory (p = 4e-6)
SIGMA_A_RANGE = (50.0, 2e6)  # px/s^2: limits of the estimated acceleration
SIGMA_A_RATE = 0.03  # relative change of the estimated acceleration per excess of one normalised innovation
MAX_RATE_SIGMA = 1.0  # m/s, rad/s: with larger sigmas the vehicle's velocities do not predict the spots


@dataclass(slots=True)
class Tracks:
    """State and history of n views. Rows that are not `alive` are undefined."""

    x: Array  # (n, 4), px and px/s
    P: Array  # (n, 4, 4)
    alive: Bools  # (n,)
    rate_known: Bools  # (n,) the prediction uses a known velocity; without one no prediction is reported
    last: Array  # (n, 2) position in the previous frame, px
    last_cov: Array  # (n, 2, 2) its covariance, px^2
    last_age_s: float  # time since the previous frame
    unseen_s: Array  # (n,) time since the last update by a detection or a measured pose
    sigma_a: Array  # (n,) 1-sigma acceleration, px/s^2

    @staticmethod
    def none(views: int, sigma_a_px_s2: float) -> Tracks:
        """The state before the first labels."""
        return Tracks(
            x=np.zeros((views, 4)),
            P=np.tile(np.eye(4), (views, 1, 1)),
            alive=np.zeros(views, dtype=bool),
            rate_known=np.zeros(views, dtype=bool),
            last=np.full((views, 2), np.nan),
            last_cov=np.tile(np.eye(2), (views, 1, 1)),
            last_age_s=0.0,
            unseen_s=np.full(views, np.inf),
            sigma_a=np.full(views, sigma_a_px_s2),
        )

    @property
    def predicted_px(self) -> Array:
        """(n, 2): predicted positions, px; nan where the velocity is unknown."""
        return np.where((self.alive & self.rate_known)[:, None], self.x[:, :2], np.nan)

    def predict(self, dt_s: float) -> None:
        """Predict all filters over one time step, eqs. (1) and (2)."""
        self.x, self.P = kalman.predict(self.x, self.P, dt_s, self.sigma_a)
        self.last_age_s += dt_s
        self.unseen_s = self.unseen_s + dt_s

    def set_from_motion(self, views: Bools, model: SpotModel, motion: RigidMotion) -> None:
        """Set position, rate and covariance of the tracks `views` (n,) from the vehicle's motion."""
        uv, J = model.project(motion.world_from_body)
        exists = ~np.isnan(uv[:, 0])
        rows = np.flatnonzero(views & exists)
        G = np.zeros((len(rows), 4, 12))
        G[:, :2, :6] = G[:, 2:, 6:] = J[rows]
        self.x[rows, :2], self.x[rows, 2:] = uv[rows], J[rows] @ motion.twist
        self.P[rows] = G @ motion.P @ np.swapaxes(G, -1, -2) + 1e-6 * np.eye(4)
        self.rate_known[rows] = bool(np.sqrt(np.max(np.diagonal(motion.P)[6:])) < MAX_RATE_SIGMA)
        self.alive = np.where(views, exists, self.alive)

    def update(
        self, z: Array, R: Array, use: Bools, measured: Bools, turned: Bools, parameters: TrackerParameters
    ) -> None:
        """Update the tracks `use` (n,): Kalman's eqs. (3) to (5), or the restart of eq. (6) at a bend.

        z (n, 2), px, with covariances R (n, 2, 2). measured (n,): the position is a detection; only those update the
        estimated acceleration. turned (n,): found by matching step 2.
        """
        old = np.flatnonzero(use & self.alive)
        self.unseen_s[use] = 0.0
        if not len(old):
            return
        self.rate_known[old] = True
        _, _, nis = kalman.innovation(self.x[old], self.P[old], z[old], R[old])
        # A bend too slight for step 2, and one outside the image, shows in the innovation (ours).
        bent = (turned[old] | (nis > BENT_NIS)) & parameters.curve_switch
        bent &= ~np.isnan(self.last[old, 0]) & (self.last_age_s > 0)
        straight, restarted = old[~bent], old[bent]
        if len(straight):
            self.x[straight], self.P[straight] = kalman.update(
                self.x[straight], self.P[straight], z[straight], R[straight]
            )
        if len(restarted):
            self.x[restarted], self.P[restarted] = kalman.restart(
                z[restarted], R[restarted], self.last[restarted], self.last_cov[restarted], self.last_age_s
            )
        if parameters.learn_sigma_a:
            estimable = measured[old] & ~turned[old]
            change = np.exp(SIGMA_A_RATE * (np.clip(nis / 2, 0, 6) - 1))
            estimated = np.clip(self.sigma_a[old] * change, *SIGMA_A_RANGE)
            self.sigma_a[old] = np.where(estimable, estimated, self.sigma_a[old])

    def store_last(self, uv_px: Array, cov_px2: Array) -> None:
        """Store this frame's positions (n, 2) and covariances (n, 2, 2) as the last ones."""
        self.last = np.where(self.alive[:, None], uv_px, np.nan)
        self.last_cov = np.where(self.alive[:, None, None], cov_px2, np.eye(2))
        self.last_age_s = 0.0


# The state of the vehicle as a whole: motion, accelerations, and the variance factor of the spots. Source: ours.


CLUTTER_NEAR_SPOTS = 2e-4  # 1/px^2: the paper's 20 % of false points within 15 px of a spot
ACCELERATION_RATE = 0.03  # relative change of the estimated accelerations per excess of one normalised innovation
ACCELERATION_RANGE = (0.02, 2000.0)  # m/s^2 and rad/s^2: limits of the estimated accelerations
BENT = 100.0  # squared sigmas per axis: beyond it the pose filter restarts, because the velocities are no longer valid
OCCLUDED_FACTOR = 3.0  # factor on the accelerations while spots are occluded: a reversal then cannot be observed


class Vehicle:
    """The pose filter with online estimates of its accelerations and of the spots' variance factor."""

    def __init__(self, parameters: TrackerParameters) -> None:
        self.parameters = parameters
        self.motion: RigidMotion | None = None
        self.anchor: Pose | None = None  # the last measured pose
        self.anchor_age_s = 0.0  # time since that pose
        self._accelerations = np.array([parameters.pose_sigma_a_m_s2, parameters.pose_sigma_a_rad_s2])
        self._fastest = np.zeros(2)  # m/s and rad/s: the largest speeds observed so far
        self._variance_factor = VarianceFactor()
        # Contributions of the calibration's errors at the last measured pose.
        self._systematic = np.zeros((6, 6))  # to the pose's covariance
        self._systematic_px: Array | float = 0.0  # (n, 2, 2) to the expected pixels' covariances, px^2
        self._rows: Ints = np.zeros(0, dtype=np.int64)  # views that the last measured pose was fitted to

    @property
    def noise_scale(self) -> float:
        """Ratio of the spots' errors to their stated sigmas."""
        return self._variance_factor.noise_scale

    @property
    def known(self) -> bool:
        """Whether the predicted pose is accurate enough to be reported."""
        if self.motion is None:
            return False
        s = np.sqrt(np.maximum(np.diagonal(self.motion.covariance), 0))
        return bool(s[:3].max() < LOST_SIGMA_M and s[3:].max() < LOST_SIGMA_RAD)

    @property
    def expected(self) -> tuple[Pose, Array] | None:
        """The predicted pose and its covariance (6, 6)."""
        return None if self.motion is None else (self.motion.world_from_body, self.motion.covariance)

    def predict(self, dt_s: float) -> None:
        """Predict the motion over one time step."""
        self.anchor_age_s += dt_s
        if self.motion is not None:
            a = self._accelerations
            self.motion = self.motion.predicted(dt_s, float(a[0]), float(a[1]))

    def search_prior(self, first: PosePrior) -> PosePrior:
        """The prior for a new search: around the last measured pose, as far as the vehicle may have moved since.

        first: the run's own prior, which bounds the size of the region from below.
        """
        assert self.anchor is not None, "no pose was measured yet: the run's own prior applies"
        p = self.parameters
        speed = p.reacquire_m_s + self._fastest[0]
        rate = np.deg2rad(p.reacquire_deg_s) + self._fastest[1]
        return PosePrior(
            self.anchor,
            min(0.05 + speed * self.anchor_age_s, max(1.0, first.within_m)),
            min(np.deg2rad(3.0) + rate * self.anchor_age_s, max(np.deg2rad(45.0), first.within_rad)),
        )

    def update_with_pose(self, fit: PoseFit, dt_s: float) -> None:
        """Update the filter, the accelerations and the variance factor with a measured pose.

        The filter tracks the pose as measured through the calibration: the calibration's errors are the same in every
        frame, so they count as noise only if the pose comes from other spots than in the previous measured frame.
        """
        same_spots = np.array_equal(fit.rows, self._rows)
        covariance = (fit.noise if same_spots else fit.covariance) * self.noise_scale**2
        self._rows, self._systematic = fit.rows, fit.systematic * self.noise_scale**2
        self._systematic_px = fit.calibration_px()
        self._variance_factor.update(fit.chi2, fit.dof, fit.systematic_share)
        if self.motion is None:
            self.motion = RigidMotion.at_rest(fit.world_from_body, covariance)
        else:
            after, y, S = self.motion.updated_with_pose(fit.world_from_body, covariance)
            nis = np.array([y[i] @ np.linalg.solve(S[i, i], y[i]) / 3 for i in (slice(0, 3), slice(3, 6))])
            if self.anchor_age_s <= 1.5 * dt_s:
                change = np.exp(ACCELERATION_RATE * (np.clip(nis, 0, 6) - 1))
                self._accelerations = np.clip(self._accelerations * change, *ACCELERATION_RANGE)
            self.motion = RigidMotion.at_rest(fit.world_from_body, covariance) if nis.max() > BENT else after
        if self.anchor is not None and self.anchor_age_s > 0:
            displacement = fit.world_from_body.minus(self.anchor)
            speeds = np.array([np.linalg.norm(displacement[:3]), np.linalg.norm(displacement[3:])]) / self.anchor_age_s
            self._fastest = np.maximum(self._fastest, speeds)
        self.anchor, self.anchor_age_s = fit.world_from_body, 0.0

    def update_with_spots(self, model: SpotModel, rows: Ints, uv_px: Array, cov_px2: Array) -> Bools:
        """Update the filter with spots that do not determine the pose but narrow its prediction.

        rows (m,): their views; uv_px (m, 2) and cov_px2 (m, 2, 2). Returns (m,): the accepted spots. With few spots a
        false point is as likely as a true one, so a spot must be much more likely than clutter under the prediction.
        """
        assert self.motion is not None
        motion = self._with_occlusion_noise(self.motion)
        good = np.zeros(len(rows), dtype=bool)
        if len(rows):
            projected, J = model.project(motion.world_from_body)
            y = uv_px - projected[rows]
            C = (cov_px2 + self.calibration_px(len(model))[rows]) * self.noise_scale**2
            S = pixel_covariance(J[rows], motion.covariance) + C
            nis = np.sum(y * np.linalg.solve(S, y[..., None])[..., 0], axis=-1)
            log_clutter = np.log(max(self.parameters.labels.clutter_per_px2, CLUTTER_NEAR_SPOTS))
            log_spot = -0.5 * nis - 0.5 * np.log(np.linalg.det(2 * np.pi * S))
            good = np.asarray(log_spot - log_clutter > self.parameters.labels.lead_nats)
            if good.any():
                R = np.zeros((2 * good.sum(), 2 * good.sum()))
                for k, block in enumerate(C[good]):
                    R[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = block
                motion, _ = motion.updated(y[good].ravel(), J[rows[good]].reshape(-1, 6), R)
        self.motion = motion
        return good

    def result(self, fit: PoseFit | None) -> tuple[PoseStatus, Pose | None, Array | None]:
        """The reported pose of this frame: status, pose, covariance (6, 6)."""
        if fit is not None:
            return PoseStatus.MEASURED, fit.world_from_body, fit.covariance * self.noise_scale**2
        if self.motion is not None and self.known:
            return PoseStatus.PREDICTED, self.motion.world_from_body, self.motion.covariance + self._systematic
        return PoseStatus.LOST, None, None

    def systematic(self, fit: PoseFit | None) -> Array:
        """The calibration's contribution to the pose's covariance (6, 6)."""
        return self._systematic if fit is None else fit.systematic * self.noise_scale**2

    def calibration_px(self, count: int) -> Array:
        """The calibration's contribution to the covariance of each view's expected pixel, (count, 2, 2), px^2."""
        return np.zeros((count, 2, 2)) + self._systematic_px

    def _with_occlusion_noise(self, motion: RigidMotion) -> RigidMotion:
        """The motion with additional process noise, beyond that of the ordinary prediction."""
        P = motion.P.copy()
        i = np.arange(6, 12)
        extra = np.repeat(self._accelerations**2, 3) * (OCCLUDED_FACTOR**2 - 1)
        P[i, i] += extra * min(self.anchor_age_s, 0.1) ** 2 / 4
        return replace(motion, P=P)


# The pose from the matched spots, and the check of every match against it: drop false matches, add missed ones.
#
# Source: ours (`TrackerParameters.rigid_check`). The paper matches every spot by itself.

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


def outside_first_search(tracks: Tracks, r1_px: float, uv_px: Array) -> Bools:
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
        far = outside_first_search(tracks, self.parameters.r1_px, uv)
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
