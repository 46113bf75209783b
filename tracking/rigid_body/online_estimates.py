"""Online estimates of the process noise (jerk, size and frequency of manoeuvres) and of the variance factor."""

from __future__ import annotations

from collections import deque

import numpy as np

from geometry.arrays import Array
from tracking.parameters import TrackerParameters
from tracking.rigid_body.hypotheses.hypothesis_set import Dynamics

RANGE = (1e-4, 1e5)  # m/s^3 or rad/s^3 per sqrt(Hz)
_LOG_RANGE = 2 * np.log(RANGE)
# Change of the log density of the jerk per unit of the innovation score: at the start, and in the long run.
FIRST_GAIN, MIN_GAIN = 0.5, 0.1
GAIN_DECAY = 0.97  # per frame, from the first to the second
MIN_JUMP = np.array([0.2, 0.5])  # m/s, rad/s: sigma of a manoeuvre's velocity jump while the vehicle stands
JUMP_OF_SPEED = 1.2  # a reversal changes a velocity by twice itself, along one axis of three
MANOEUVRE_S = 0.1  # s: the accelerations jump by the velocities' jump over this time
SPEED_DECAY = 0.995  # per frame, of the recent largest speed
MANOEUVRE_MEMORY = 200.0  # frames: time constant of the manoeuvres' frequency
MIN_P, MAX_P = 0.002, 0.2  # of a manoeuvre, per frame


def jump_variance(speed: Array) -> Array:
    """Variances (..., 2) of a manoeuvre's velocity jump at speeds (..., 2), m/s and rad/s."""
    return (MIN_JUMP + JUMP_OF_SPEED * speed) ** 2


class AdaptiveProcessNoise:
    """Estimate of the vehicle's dynamics."""

    def __init__(self, parameters: TrackerParameters) -> None:
        self._adapt_jerk = parameters.learn_jerk
        self._log_jerk = 2 * np.log(np.repeat([parameters.jerk_m_s3, parameters.jerk_rad_s3], 3))
        self._gain = FIRST_GAIN
        self._p_manoeuvre = parameters.p_manoeuvre
        self._recent_speed = np.zeros(2)
        self.fastest = np.zeros(2)  # m/s, rad/s: largest speeds measured so far
        self.dynamics = self._dynamics()

    def _dynamics(self) -> Dynamics:
        jump = jump_variance(self._recent_speed)
        return Dynamics(np.exp(self._log_jerk), jump, jump / MANOEUVRE_S**2, self._p_manoeuvre)

    def update(self, velocities: Array, manoeuvre: bool, score: Array) -> None:
        """Take a measured frame.

        velocities (6,): of the vehicle, m/s and rad/s. manoeuvre: whether the frame began with one. score (6,):
        derivative of the innovation's log-likelihood by the log density of each axis' jerk (`innovation_score` in
        frame_summary.py); a step of stochastic gradient ascent follows it.
        """
        speed = np.sqrt([velocities[:3] @ velocities[:3], velocities[3:] @ velocities[3:]])
        self._recent_speed = np.maximum(SPEED_DECAY * self._recent_speed, speed)
        self.fastest = np.maximum(self.fastest, speed)
        self._p_manoeuvre += (float(manoeuvre) - self._p_manoeuvre) / MANOEUVRE_MEMORY
        self._p_manoeuvre = min(max(self._p_manoeuvre, MIN_P), MAX_P)
        if self._adapt_jerk and not manoeuvre:
            self._log_jerk += self._gain * np.minimum(np.maximum(score, -1.0), 3.0)
            self._log_jerk = np.minimum(np.maximum(self._log_jerk, _LOG_RANGE[0]), _LOG_RANGE[1])
            self._gain = max(MIN_GAIN, GAIN_DECAY * self._gain)
        self.dynamics = self._dynamics()


MEMORY = 100  # fits: time constant of the estimate, once it has seen so many
PRIOR_DOF = 30  # degrees of freedom that the stated sigmas count at the start: the first fits have more weight
DEADBAND = 1.3  # no effect below; if the stated sigmas are correct the estimate scatters by 0.06 about 1
MAX_RATIO = 3.0  # a single fit counts at most this many times the estimate
RECENT_FITS = 9  # if the median of so many exceeds the estimate by MAX_RATIO, the estimate jumps to it


class VarianceFactor:
    """Running mean of chi-square per degree of freedom, robust to outliers."""

    def __init__(self) -> None:
        self._mean = 1.0
        self._seen = float(PRIOR_DOF)  # degrees of freedom
        self._deadband = DEADBAND
        self._recent: deque[float] = deque(maxlen=RECENT_FITS)

    @property
    def noise_scale(self) -> float:
        """Ratio of the spots' errors to their stated sigmas; 1 while the estimate is within the deadband."""
        return float(np.sqrt(self._mean)) if self._mean > self._deadband else 1.0

    def update(self, chi2: float, dof: int, systematic_share: float = 0.0) -> None:
        """Take one fit.

        systematic_share: share of the expected misfit that comes from calibration errors. These are the same in every
        frame, so that no mean reduces their scatter; the deadband is widened by it.
        """
        if dof <= 0:
            return
        factor = chi2 / dof
        self._recent.append(factor)
        median = sorted(self._recent)[len(self._recent) // 2]
        if len(self._recent) == self._recent.maxlen and median > MAX_RATIO * max(self._mean, 1.0):
            self._mean = median
        self._seen += dof
        self._mean *= 1 + (min(factor / self._mean, MAX_RATIO) - 1) * max(dof / self._seen, 1 / MEMORY)
        self._mean = max(self._mean, 0.1)
        self._deadband = DEADBAND + 3 * systematic_share * np.sqrt(2 / dof)

    def raise_to(self, chi2: float, dof: int) -> None:
        """Raise the estimate at once to the misfit of a frame whose labels are certain for other reasons."""
        if dof > 0:
            self._mean = max(self._mean, chi2 / dof)
