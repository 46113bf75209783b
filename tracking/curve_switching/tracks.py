"""The Kalman filters of all views and their history."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools
from geometry.forward_model import SpotModel
from tracking.curve_switching import kalman
from tracking.curve_switching.pose_filter import RigidMotion
from tracking.parameters import TrackerParameters

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
