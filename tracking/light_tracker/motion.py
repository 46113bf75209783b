"""The motion of the pattern, and where the rim's centre lies in it: three small Kalman filters.

The centre moves with a nearly constant velocity (the filter of tracking/kalman.py), the logarithm of
the diameter is a random walk. A match is accurate to a few hundredths of a pixel, but its pattern drifts with tilt and
light; a detection has an error of some percent of the diameter, but does not drift. So the offset between the two is a
state of its own: detections correct the drift, and their errors average out. Source: ours.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geometry.arrays import Array
from tracking import kalman
from tracking.light_tracker.frames import LightParameters
from tracking.light_tracker.pattern import Match

_MATCH_SIGMA_PX = 0.03  # of a match, beside its own covariance
_MATCH_FACTOR = 2.0  # of the covariance of a match: neighbouring pixels have related errors
_MATCH_SIZE_SIGMA = 0.01
_START_SPEED = 0.3, 5.0  # 1 sigma of the speed at the start: diameters and px per frame
# Relative change of the acceleration per excess of a normalised innovation, its largest excess, and its limits relative
# to the initial value: as in tracking/single_target/point_tracker.py.
_LEARNING_RATE, _MOST_NIS = 0.1, 6.0
_SIGMA_A_RANGE = 0.1, 10.0
WHOLE = 0.9  # visible share of a pattern of which nothing is hidden
_HIDDEN_FACTOR = 10.0  # of the covariance of a match of which a part is hidden
_HUBER_SIGMAS = 2.5  # a detection farther away than this has a smaller weight


@dataclass(frozen=True, slots=True)
class Motion:
    """State after a frame."""

    x: Array  # (4,) u, v of the pattern's centre, px, and their rates, px/frame
    P: Array  # (4, 4)
    log_diameter: float  # of the pattern
    size_variance: float
    offset: Array  # (3,) of the rim from the pattern: u, v in diameters, logarithm of the diameter
    offset_variance: Array  # (3,)
    sigma_a_px: float  # px/frame^2: 1-sigma acceleration, estimated from the innovations

    @classmethod
    def started(cls, u_px: float, v_px: float, diameter_px: float, p: LightParameters) -> Motion:
        """At a detection."""
        speed = _START_SPEED[0] * diameter_px + _START_SPEED[1]
        # The pattern is cut out at the detection: its place is known, what the detection is wrong by is in the offset.
        P = np.diag([_MATCH_SIGMA_PX**2, _MATCH_SIGMA_PX**2, speed**2, speed**2])
        return cls(
            np.array([u_px, v_px, 0.0, 0.0]),
            P,
            float(np.log(diameter_px)),
            _MATCH_SIZE_SIGMA**2,
            np.zeros(3),
            _offset_noise(p),
            p.sigma_a_diameters * diameter_px + p.sigma_a_px,
        )

    def predicted(self, dt: float, misses: int, p: LightParameters) -> Motion:
        """`dt` frames later. misses: frames in a row without a measurement."""
        start = p.sigma_a_diameters * self.diameter_px + p.sigma_a_px
        # A drogue sways: what its acceleration was before it was hidden is not what it is now.
        sigma_a = self.sigma_a_px if not misses else max(self.sigma_a_px, start)
        x, P = kalman.predict(self.x, self.P, dt, np.asarray(sigma_a))
        drift = np.array([p.offset_drift, p.offset_drift, p.offset_drift]) ** 2 * dt
        return replace(
            self, x=x, P=P, size_variance=self.size_variance + p.sigma_growth**2 * dt,
            offset_variance=self.offset_variance + drift,
        )  # fmt: skip

    def matched(self, match: Match, p: LightParameters, learn: bool = True) -> Motion:
        """With a match. learn: adapt the acceleration to its innovation."""
        partly = _HIDDEN_FACTOR / match.visible**2 if match.visible < WHOLE else 1.0
        R = partly * (_MATCH_FACTOR * match.covariance[:2, :2] + _MATCH_SIGMA_PX**2 * np.eye(2))
        z = np.array([match.u_px, match.v_px])
        nis = float(kalman.innovation(self.x, self.P, z, R)[2])
        x, P = kalman.update(self.x, self.P, z, R)
        start = p.sigma_a_diameters * self.diameter_px + p.sigma_a_px
        change = float(np.exp(_LEARNING_RATE * (min(nis / 2, _MOST_NIS) - 1))) if learn and partly == 1.0 else 1.0
        sigma_a = float(np.clip(self.sigma_a_px * change, *np.multiply(_SIGMA_A_RANGE, start)))
        r = _MATCH_FACTOR * float(match.covariance[2, 2]) * partly + _MATCH_SIZE_SIGMA**2 * partly
        gain = self.size_variance / (self.size_variance + r)
        size = self.log_diameter + gain * (float(np.log(match.diameter_px)) - self.log_diameter)
        return replace(
            self, x=x, P=P, log_diameter=size, size_variance=(1 - gain) * self.size_variance, sigma_a_px=sigma_a
        )

    def detected(self, u_px: float, v_px: float, diameter_px: float, p: LightParameters) -> Motion:
        """With a detection beside a match: it corrects the offset."""
        away = (np.array([u_px, v_px]) - self.x[:2]) / self.diameter_px
        seen = np.array([*away, np.log(diameter_px) - self.log_diameter])
        innovation = seen - self.offset
        noise = _offset_noise(p)
        sigma = np.sqrt(self.offset_variance + noise)
        noise = noise * np.maximum(np.abs(innovation) / (_HUBER_SIGMAS * sigma), 1.0) ** 2
        gain = self.offset_variance / (self.offset_variance + noise)
        return replace(self, offset=self.offset + gain * innovation, offset_variance=(1 - gain) * self.offset_variance)

    def moved(self, match: Match, p: LightParameters) -> Motion:
        """Found at another place after a gap: at rest there, of the same size and offset."""
        start = Motion.started(match.u_px, match.v_px, match.diameter_px, p)
        return replace(start, offset=self.offset, offset_variance=self.offset_variance)

    def centred(self) -> Motion:
        """With the pattern cut out again at the rim."""
        x = np.concatenate([self.centre_px, self.x[2:]])
        size = float(np.log(self.rim_diameter_px))
        return replace(self, x=x, log_diameter=size, offset=np.zeros(3))

    @property
    def diameter_px(self) -> float:
        """Of the pattern."""
        return float(np.exp(self.log_diameter))

    @property
    def centre_px(self) -> Array:
        """(2,) of the rim."""
        return self.x[:2] + self.diameter_px * self.offset[:2]

    @property
    def rim_diameter_px(self) -> float:
        """Of the rim."""
        return float(np.exp(self.log_diameter + self.offset[2]))

    @property
    def covariance(self) -> Array:
        """(2, 2) of the rim's centre, px^2."""
        return self.P[:2, :2] + self.diameter_px**2 * np.diag(self.offset_variance[:2])

    @property
    def sigma_diameter_px(self) -> float:
        """Of the rim."""
        return self.rim_diameter_px * float(np.sqrt(self.size_variance + self.offset_variance[2]))

    @property
    def sigma_px(self) -> float:
        """Of the pattern's centre, along the axis with the larger one."""
        return float(np.sqrt(max(self.P[0, 0], self.P[1, 1])))


def _offset_noise(p: LightParameters) -> Array:
    return np.array([p.detection_sigma, p.detection_sigma, p.detection_size_sigma]) ** 2
