"""What is known of the vehicle as a whole: its motion, how it manoeuvres, and how well the rig describes its spots."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from geometry.pose_solver.gauss_newton import PoseFit, point_covariance
from tracking.curve_switching import pose_filter
from tracking.curve_switching.pose_filter import RigidMotion
from tracking.parameters import TrackerParameters
from tracking.statuses import LOST_SIGMA_M, LOST_SIGMA_RAD, PoseStatus

CLUTTER_NEAR_SPOTS = 2e-4  # 1/px^2: the paper's 20 % of false points within 15 px of a spot
MISFIT_MEMORY = 100  # frames: memory of the misfit that scales claimed covariances ...
MISFIT_DEADBAND = 1.3  # ... once it exceeds this: with honest sigmas it scatters by 0.06 about 1
LEARN_RATE = 0.03  # share by which one innovation may move the learnt accelerations
ACCELERATION_RANGE = (0.02, 2000.0)  # m/s^2 and rad/s^2
BENT = 100.0  # squared sigmas per axis: the old velocities say nothing any more
DARK_FACTOR = 3.0  # accelerations while nothing is seen: a reversal in the dark leaves no trace


class Vehicle:
    """The pose filter with what it learns on the way."""

    def __init__(self, parameters: TrackerParameters) -> None:
        self.parameters = parameters
        self.motion: RigidMotion | None = None
        self.anchor: Pose | None = None  # the last measured pose ...
        self.anchor_age_s = 0.0  # ... and its age
        self._accelerations = np.array([parameters.pose_sigma_a_m_s2, parameters.pose_sigma_a_rad_s2])
        self._fastest = np.zeros(2)  # m/s and rad/s: the fastest that the vehicle was seen to move
        self._misfit = 1.0  # running mean of chi2 / dof
        self._recent: deque[float] = deque(maxlen=9)  # the last ones
        self._deadband = MISFIT_DEADBAND
        # Of the calibration's errors, from the last measured pose: what they do to the pose and the expected pixels.
        self._systematic = np.zeros((6, 6))
        self._systematic_px: Array | float = 0.0  # (n, 2, 2)
        self._rows: Ints = np.zeros(0, dtype=np.int64)  # the views that it was measured from

    @property
    def noise_scale(self) -> float:
        """How much larger than claimed the spots' errors are; 1 while the misfit does not say otherwise."""
        return float(np.sqrt(self._misfit)) if self._misfit > self._deadband else 1.0

    @property
    def known(self) -> bool:
        """Whether the predicted pose says anything."""
        if self.motion is None:
            return False
        s = np.sqrt(np.maximum(np.diagonal(self.motion.covariance), 0))
        return bool(s[:3].max() < LOST_SIGMA_M and s[3:].max() < LOST_SIGMA_RAD)

    @property
    def expected(self) -> tuple[Pose, Array] | None:
        """The predicted pose and its covariance (6, 6)."""
        return None if self.motion is None else (self.motion.world_from_body, self.motion.covariance)

    def predict(self, dt_s: float) -> None:
        """One step on."""
        self.anchor_age_s += dt_s
        if self.motion is not None:
            a = self._accelerations
            self.motion = pose_filter.predict(self.motion, dt_s, float(a[0]), float(a[1]))

    def search_prior(self, first: PosePrior) -> PosePrior:
        """Around the last measured pose, as far as the vehicle may have got since. `first`: the run's own prior."""
        assert self.anchor is not None, "nothing was measured yet: the run's own prior holds"
        p = self.parameters
        speed = p.reacquire_m_s + self._fastest[0]
        rate = np.deg2rad(p.reacquire_deg_s) + self._fastest[1]
        return PosePrior(
            self.anchor,
            min(0.05 + speed * self.anchor_age_s, max(1.0, first.within_m)),
            min(np.deg2rad(3.0) + rate * self.anchor_age_s, max(np.deg2rad(45.0), first.within_rad)),
        )

    def measured(self, fit: PoseFit, dt_s: float) -> None:
        """Take a measured pose: the filter's update, and what there is to learn from it.

        The filter follows the vehicle as the calibration shows it: errors of the calibration are the same from frame
        to frame, and count as noise only where other spots carry the pose than before.
        """
        same_spots = np.array_equal(fit.rows, self._rows)
        covariance = (fit.noise if same_spots else fit.covariance) * self.noise_scale**2
        self._rows, self._systematic = fit.rows, fit.systematic * self.noise_scale**2
        self._systematic_px = fit.calibration_px()
        if fit.dof > 0:
            self._learn_misfit(fit.chi2 / fit.dof)
            # One calibration has one set of errors: its share of the misfit is drawn once, and no mean evens it out.
            self._deadband = MISFIT_DEADBAND + 3 * fit.systematic_share * np.sqrt(2 / fit.dof)
        if self.motion is None:
            self.motion = pose_filter.begin(fit.world_from_body, covariance)
        else:
            after, y, S = pose_filter.corrected_by_pose(self.motion, fit.world_from_body, covariance)
            nis = np.array([y[i] @ np.linalg.solve(S[i, i], y[i]) / 3 for i in (slice(0, 3), slice(3, 6))])
            if self.anchor_age_s <= 1.5 * dt_s:
                change = np.exp(LEARN_RATE * (np.clip(nis, 0, 6) - 1))
                self._accelerations = np.clip(self._accelerations * change, *ACCELERATION_RANGE)
            self.motion = pose_filter.begin(fit.world_from_body, covariance) if nis.max() > BENT else after
        if self.anchor is not None and self.anchor_age_s > 0:
            move = fit.world_from_body.minus(self.anchor)
            moved = np.array([np.linalg.norm(move[:3]), np.linalg.norm(move[3:])]) / self.anchor_age_s
            self._fastest = np.maximum(self._fastest, moved)
        self.anchor, self.anchor_age_s = fit.world_from_body, 0.0

    def measured_partly(self, model: SpotModel, rows: Ints, uv_px: Array, cov_px2: Array) -> Bools:
        """Take spots that do not give the pose but narrow its prediction.

        rows (m,): their views; uv_px (m, 2) and cov_px2 (m, 2, 2). Returns (m,): which were believed. With few spots a
        false point is as likely as a true one: it must be much more likely under the prediction.
        """
        assert self.motion is not None
        motion = self._darkened(self.motion)
        good = np.zeros(len(rows), dtype=bool)
        if len(rows):
            projected, J = model.project(motion.world_from_body)
            y = uv_px - projected[rows]
            C = (cov_px2 + self.calibration_px(len(model))[rows]) * self.noise_scale**2
            S = point_covariance(J[rows], motion.covariance) + C
            nis = np.sum(y * np.linalg.solve(S, y[..., None])[..., 0], axis=-1)
            log_clutter = np.log(max(self.parameters.labels.clutter_per_px2, CLUTTER_NEAR_SPOTS))
            log_spot = -0.5 * nis - 0.5 * np.log(np.linalg.det(2 * np.pi * S))
            good = np.asarray(log_spot - log_clutter > self.parameters.labels.lead_nats)
            if good.any():
                R = np.zeros((2 * good.sum(), 2 * good.sum()))
                for k, block in enumerate(C[good]):
                    R[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = block
                motion, _ = pose_filter.corrected(motion, y[good].ravel(), J[rows[good]].reshape(-1, 6), R)
        self.motion = motion
        return good

    def result(self, fit: PoseFit | None) -> tuple[PoseStatus, Pose | None, Array | None]:
        """This frame's pose for the user: status, pose, covariance (6, 6)."""
        if fit is not None:
            return PoseStatus.MEASURED, fit.world_from_body, fit.covariance * self.noise_scale**2
        if self.motion is not None and self.known:
            return PoseStatus.PREDICTED, self.motion.world_from_body, self.motion.covariance + self._systematic
        return PoseStatus.LOST, None, None

    def systematic(self, fit: PoseFit | None) -> Array:
        """The part of the pose's covariance (6, 6) that the calibration's errors make."""
        return self._systematic if fit is None else fit.systematic * self.noise_scale**2

    def calibration_px(self, count: int) -> Array:
        """What the calibration's errors leave open of each view's expected pixel, (count, 2, 2), px^2."""
        return np.zeros((count, 2, 2)) + self._systematic_px

    def _darkened(self, motion: RigidMotion) -> RigidMotion:
        """More process noise than the ordinary prediction has already added."""
        P = motion.P.copy()
        i = np.arange(6, 12)
        extra = np.repeat(self._accelerations**2, 3) * (DARK_FACTOR**2 - 1)
        P[i, i] += extra * min(self.anchor_age_s, 0.1) ** 2 / 4
        return replace(motion, P=P)

    def _learn_misfit(self, misfit: float) -> None:
        """The slow mean; a blended spot now and then counts at most threefold, but when most fits misfit it jumps."""
        self._recent.append(misfit)
        usual = float(np.median(self._recent))
        if len(self._recent) == self._recent.maxlen and usual > 3 * max(self._misfit, 1.0):
            self._misfit = usual
        self._misfit *= 1 + (min(misfit / self._misfit, 3.0) - 1) / MISFIT_MEMORY
        self._misfit = max(self._misfit, 0.1)
