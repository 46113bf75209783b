"""How vehemently the vehicle moves, learnt as the run goes on: the jerk of its steady motion, and its manoeuvres."""

from __future__ import annotations

import numpy as np

from geometry import small
from geometry.arrays import Array, Bools
from geometry.projection import Views
from tracking.hypotheses import Children, Dynamics, Hypotheses
from tracking.information import frame_information
from tracking.motion import predicted
from tracking.parameters import TrackerParameters

RANGE = (1e-4, 1e5)  # m/s^3 or rad/s^3 per sqrt(Hz)
FIRST_GAIN, LEAST_GAIN = 0.5, 0.1  # how far one innovation moves the logarithm of the jerk's density, at first and later
SLOWER = 0.97  # per frame, from the one to the other
LEAST_JUMP = np.array([0.2, 0.5])  # m/s, rad/s: of a manoeuvre, while the vehicle stands
JUMP_OF_SPEED = 1.2  # a reversal changes a velocity by twice itself, along one axis of three
STEADIES_WITHIN_S = 0.1  # accelerations change in a manoeuvre by its jump over this time
FADES = 0.995  # per frame: the fastest motion lately
MANOEUVRE_MEMORY = 200.0  # frames


class Temper:
    """What the tracker knows of the vehicle's way of moving."""

    def __init__(self, parameters: TrackerParameters) -> None:
        self._learn = parameters.learn_jerk
        self._log_jerk = 2 * np.log([parameters.jerk_m_s3, parameters.jerk_rad_s3])
        self._gain = FIRST_GAIN
        self._p_manoeuvre = parameters.p_manoeuvre
        self._lately = np.zeros(2)
        self.fastest = np.zeros(2)  # m/s, rad/s: that the vehicle was seen to move
        self.dynamics = self._dynamics()

    def _dynamics(self) -> Dynamics:
        jump = (LEAST_JUMP + JUMP_OF_SPEED * self._lately) ** 2
        return Dynamics(np.exp(self._log_jerk), jump, jump / STEADIES_WITHIN_S**2, self._p_manoeuvre)

    def learn(
        self,
        before: Hypotheses | None,
        children: Children,
        best: int,
        dt_s: float,
        measured: bool,
        use: Bools,
        uv: Array,
        cov: Array,
        views: Views,
    ) -> None:
        """Take the frame's best child: a step of gradient ascent on the likelihood of its innovation."""
        if not measured or dt_s <= 0 or before is None:
            return
        after, manoeuvre = children.after, bool(children.manoeuvre[best])
        speed = np.array([np.linalg.norm(after.m[best, :3]), np.linalg.norm(after.m[best, 3:6])])
        self._lately = np.maximum(FADES * self._lately, speed)
        self.fastest = np.maximum(self.fastest, speed)
        self._p_manoeuvre += (float(manoeuvre) - self._p_manoeuvre) / MANOEUVRE_MEMORY
        self._p_manoeuvre = float(np.clip(self._p_manoeuvre, 0.002, 0.2))
        if self._learn and not manoeuvre:
            h = int(children.parent[best])
            none = np.zeros(2)
            R, t, _, P, _ = predicted(
                before.R[h], before.t[h], before.m[h], before.P[h], dt_s, self.dynamics.jerk, none, none
            )
            L, g, _, _, _ = frame_information(views, R, t, use, uv, cov)
            self._log_jerk += self._gain * np.clip(_slope(np.ascontiguousarray(P[:6, :6]), L, g), -1.0, 3.0)
            self._log_jerk = np.clip(self._log_jerk, 2 * np.log(RANGE[0]), 2 * np.log(RANGE[1]))
            self._gain = max(LEAST_GAIN, SLOWER * self._gain)
        self.dynamics = self._dynamics()


def _slope(P: Array, L: Array, g: Array) -> Array:
    """(2,): how the log-likelihood grows with the share of P that translation and rotation make, per unit of its size.

    With w = S^-1 y: (w^T P w - tr(S^-1 P)) / (1 + tr(S^-1 P)) / 2, taken for the two diagonal blocks of P.
    """
    right = np.concatenate([L, g[:, None]], axis=1)
    x, _ = small.solve(np.eye(6) + L @ P, right)
    M, w = x[:, :6], x[:, 6]
    out = np.zeros(2)
    for k, block in enumerate((slice(0, 3), slice(3, 6))):
        expected = float(np.sum(M[block, block] * P[block, block]))
        out[k] = 0.5 * (w[block] @ P[block, block] @ w[block] - expected) / (1.0 + expected)
    return out
