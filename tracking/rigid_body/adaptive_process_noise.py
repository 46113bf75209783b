"""How vehemently the vehicle moves, learnt as the run goes on: the jerk of its steady motion, and its manoeuvres."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array
from tracking.parameters import TrackerParameters
from tracking.rigid_body.hypotheses import Dynamics

RANGE = (1e-4, 1e5)  # m/s^3 or rad/s^3 per sqrt(Hz)
_LOG_RANGE = 2 * np.log(RANGE)
FIRST_GAIN, LEAST_GAIN = (
    0.5,
    0.1,
)  # how far one innovation moves the logarithm of the jerk's density, at first and later
SLOWER = 0.97  # per frame, from the one to the other
LEAST_JUMP = np.array([0.2, 0.5])  # m/s, rad/s: of a manoeuvre, while the vehicle stands
JUMP_OF_SPEED = 1.2  # a reversal changes a velocity by twice itself, along one axis of three
STEADIES_WITHIN_S = 0.1  # accelerations change in a manoeuvre by its jump over this time
FADES = 0.995  # per frame: the fastest motion lately
MANOEUVRE_MEMORY = 200.0  # frames
LEAST_P, MOST_P = 0.002, 0.2  # of a manoeuvre, per frame


def jump_variance(speed: Array) -> Array:
    """Variances (..., 2) by which a manoeuvre may change speeds (..., 2), m/s and rad/s."""
    return (LEAST_JUMP + JUMP_OF_SPEED * speed) ** 2


class AdaptiveProcessNoise:
    """What the tracker knows of the vehicle's way of moving."""

    def __init__(self, parameters: TrackerParameters) -> None:
        self._learn = parameters.learn_jerk
        self._log_jerk = 2 * np.log(np.repeat([parameters.jerk_m_s3, parameters.jerk_rad_s3], 3))
        self._gain = FIRST_GAIN
        self._p_manoeuvre = parameters.p_manoeuvre
        self._lately = np.zeros(2)
        self.fastest = np.zeros(2)  # m/s, rad/s: that the vehicle was seen to move
        self.dynamics = self._dynamics()

    def _dynamics(self) -> Dynamics:
        jump = jump_variance(self._lately)
        return Dynamics(np.exp(self._log_jerk), jump, jump / STEADIES_WITHIN_S**2, self._p_manoeuvre)

    def learn(self, moved: Array, manoeuvre: bool, slope: Array) -> None:
        """Take a measured frame: its velocities (6,), whether it began with a manoeuvre, and how the likelihood of its
        innovation grows with the logarithm of each axis' jerk (6,), a step up which is taken (surprise in digest.py).
        """
        speed = np.sqrt([moved[:3] @ moved[:3], moved[3:] @ moved[3:]])
        self._lately = np.maximum(FADES * self._lately, speed)
        self.fastest = np.maximum(self.fastest, speed)
        self._p_manoeuvre += (float(manoeuvre) - self._p_manoeuvre) / MANOEUVRE_MEMORY
        self._p_manoeuvre = min(max(self._p_manoeuvre, LEAST_P), MOST_P)
        if self._learn and not manoeuvre:
            self._log_jerk += self._gain * np.minimum(np.maximum(slope, -1.0), 3.0)
            self._log_jerk = np.minimum(np.maximum(self._log_jerk, _LOG_RANGE[0]), _LOG_RANGE[1])
            self._gain = max(LEAST_GAIN, SLOWER * self._gain)
        self.dynamics = self._dynamics()
