"""The filters of all views side by side, and what each frame does to them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools
from geometry.forward_model import SpotModel
from tracking.curve_switching import kalman
from tracking.curve_switching.pose_filter import RigidMotion
from tracking.parameters import TrackerParameters

BENT_NIS = 25.0  # squared sigmas: a spot this far from its prediction has turned (p = 4e-6)
SIGMA_A_RANGE = (50.0, 2e6)  # px/s^2
SIGMA_A_RATE = 0.03  # share by which one innovation may move the learnt acceleration
RATE_KNOWN = 1.0  # m/s, rad/s: the sigma of the vehicle's rates under which they predict anything


@dataclass(slots=True)
class Tracks:
    """State and history of n views. Rows that are not `alive` mean nothing."""

    x: Array  # (n, 4), px and px/s
    P: Array  # (n, 4, 4)
    alive: Bools  # (n,)
    rate_known: Bools  # (n,) a velocity stands behind the prediction: without one there is none to publish
    last: Array  # (n, 2) position at the frame before, px
    last_cov: Array  # (n, 2, 2) its covariance
    last_age_s: float  # how long ago that was
    unseen_s: Array  # (n,) time since a detection or a measured pose stood behind it
    sigma_a: Array  # (n,) px/s^2

    @staticmethod
    def none(views: int, sigma_a_px_s2: float) -> Tracks:
        """No track yet."""
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
        """(n, 2): where the spots should be; nan where nothing is known of their motion."""
        return np.where((self.alive & self.rate_known)[:, None], self.x[:, :2], np.nan)

    def predict(self, dt_s: float) -> None:
        """One step on."""
        self.x, self.P = kalman.predict(self.x, self.P, dt_s, self.sigma_a)
        self.last_age_s += dt_s
        self.unseen_s = self.unseen_s + dt_s

    def carry(self, views: Bools, model: SpotModel, motion: RigidMotion) -> None:
        """Give the tracks `views` (n,) the position, rate and covariance that the vehicle's motion means for them."""
        uv, J = model.project(motion.world_from_body)
        exists = ~np.isnan(uv[:, 0])
        rows = np.flatnonzero(views & exists)
        G = np.zeros((len(rows), 4, 12))
        G[:, :2, :6] = G[:, 2:, 6:] = J[rows]
        self.x[rows, :2], self.x[rows, 2:] = uv[rows], J[rows] @ motion.twist
        self.P[rows] = G @ motion.P @ np.swapaxes(G, -1, -2) + 1e-6 * np.eye(4)
        self.rate_known[rows] = bool(np.sqrt(np.max(np.diagonal(motion.P)[6:])) < RATE_KNOWN)
        self.alive = np.where(views, exists, self.alive)

    def update(
        self, z: Array, R: Array, use: Bools, measured: Bools, turned: Bools, parameters: TrackerParameters
    ) -> None:
        """Take positions z (n, 2), px, covariances R (n, 2, 2) where `use` (n,): Kalman's update or eq. (6) at a bend.

        measured (n,): they are detections, from which the acceleration is learnt; turned (n,): found by the second
        search.
        """
        old = np.flatnonzero(use & self.alive)
        self.unseen_s[use] = 0.0
        if not len(old):
            return
        self.rate_known[old] = True
        _, _, nis = kalman.innovation(self.x[old], self.P[old], z[old], R[old])
        # A bend too slight for the second search shows in the innovation, as it does outside the picture.
        bent = (turned[old] | (nis > BENT_NIS)) & parameters.curve_switch
        bent &= ~np.isnan(self.last[old, 0]) & (self.last_age_s > 0)
        go, anew = old[~bent], old[bent]
        if len(go):
            self.x[go], self.P[go] = kalman.update(self.x[go], self.P[go], z[go], R[go])
        if len(anew):
            self.x[anew], self.P[anew] = kalman.restart(
                z[anew], R[anew], self.last[anew], self.last_cov[anew], self.last_age_s
            )
        if parameters.learn_sigma_a:
            learn = measured[old] & ~turned[old]
            change = np.exp(SIGMA_A_RATE * (np.clip(nis / 2, 0, 6) - 1))
            learnt = np.clip(self.sigma_a[old] * change, *SIGMA_A_RANGE)
            self.sigma_a[old] = np.where(learn, learnt, self.sigma_a[old])

    def remember(self, uv_px: Array, cov_px2: Array) -> None:
        """Keep this frame's positions (n, 2) and covariances (n, 2, 2) as the last ones."""
        self.last = np.where(self.alive[:, None], uv_px, np.nan)
        self.last_cov = np.where(self.alive[:, None, None], cov_px2, np.eye(2))
        self.last_age_s = 0.0
