"""The pattern of a drogue, its motion, and the appearance that detections confirmed.

The pattern is found again by correlation in a window, then refined to a fraction of a pixel with its size. It has a
fixed number of pixels; the window is reduced so that the drogue has the pattern's size, so a large drogue costs no more
than a small one. Source of the refinement: Lucas & Kanade (1981) in the inverse form of Baker & Matthews (2004), with
gain and offset of the brightness; the correlation is that of cv2.matchTemplate.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array
from tracking import kalman
from tracking.light_tracker.frames import LightParameters, fisher
from tracking.noise import Picture

Floats: TypeAlias = NDArray[np.float32]

SMALLEST_PX, LARGEST_PX = 9.0, 24.0  # diameter of the drogue in the pattern
_REACH = 0.62  # of the pattern, in diameters: the rim and a little of what is around it
_LARGEST_REACH = 4.0  # diameters of the largest pattern: half of the side of the largest window
_ITERATIONS = 6  # a limit: the steps end where they are small
_CONVERGED_PX = 0.01  # step below which the next one is no longer made: a third of the sigma of a match
_MOST_SHIFT = 0.35  # of the diameter, away from the peak of the correlation
_MOST_GROWTH = 0.25  # relative change of the diameter in one frame
_HIDDEN_FACTOR = 2.0  # times the usual unexplained variance: from here on a part of the pattern is left out
_ROBUST_ROUNDS = 2  # fits without the parts that differ, each with the parts that the one before left
_LEAST_VISIBLE = 0.3  # share of the pattern; with less there is no match
_TUKEY, _LEAST_SCALE = 4.7, 0.05  # residuals in usual sigmas of which the weight is zero; least sigma
_LEAST_CONTRAST = 0.5  # DN: a window without any contrast matches nothing


@dataclass(frozen=True, slots=True)
class Match:
    """The pattern in a picture."""

    u_px: float  # of the pattern's centre
    v_px: float
    diameter_px: float
    covariance: Array  # (3, 3) of u, v (px) and of the logarithm of the diameter
    correlation: float  # weighted correlation coefficient, at most 1
    visible: float  # share of the pattern that agrees with the picture
    agreement: float  # correlation of this share
    second: float  # of the next best place of the window; -1 where there is none
    patch: Floats  # (n, n) the picture there, of mean 0 and sigma 1 under the weights


@dataclass(frozen=True, slots=True)
class Pattern:
    """A drogue's appearance. `values` have the mean 0 and the sigma 1 under the weights."""

    values: Floats  # (n, n)
    weights: Floats  # (n, n), sum 1
    diameter: float  # of the drogue, in pixels of the pattern
    solver: Floats  # (5, n n): shift (2), growth, gain and offset from a patch, times the gain
    normal: Array  # (5, 5) inverse of the normal matrix

    @classmethod
    def started(cls, picture: Picture, u_px: float, v_px: float, diameter_px: float) -> Pattern | None:
        """The pattern at a place; None where the picture has no contrast there."""
        diameter = float(np.clip(diameter_px, SMALLEST_PX, LARGEST_PX))
        half = int(np.ceil(_REACH * diameter))
        y, x = np.mgrid[-half : half + 1, -half : half + 1].astype(np.float32)
        # Full weight up to the rim, falling to zero over a twentieth of the diameter at least and one pixel.
        away = (np.hypot(x, y) / diameter - 0.5 - 0.5 / diameter) / max(_REACH - 0.5, 0.05)
        weights = np.clip(1 - away, 0, 1).astype(np.float32)
        weights /= weights.sum()
        window = _Window.around(picture, u_px, v_px, half * diameter_px / diameter, diameter / diameter_px)
        if window is None:
            return None
        growth = window.scale * diameter_px / diameter
        patch = _normalised(window.patch(*window.inside(u_px, v_px), growth, half), weights, _LEAST_CONTRAST)
        return None if patch is None else cls.of(patch, weights, diameter)

    @classmethod
    def of(cls, values: Floats, weights: Floats, diameter: float) -> Pattern:
        """The pattern with its solver."""
        half = values.shape[0] // 2
        y, x = np.mgrid[-half : half + 1, -half : half + 1].astype(np.float32)
        dy, dx = np.gradient(values)
        J = np.stack([dx, dy, dx * x + dy * y, values, np.ones_like(values)]).reshape(5, -1)
        normal = np.linalg.inv((J * weights.ravel()) @ J.T.astype(float) + 1e-9 * np.eye(5))
        return cls(values, weights, diameter, (normal @ (J * weights.ravel())).astype(np.float32), normal)

    def updated(self, match: Match, rate: float) -> Pattern:
        """The pattern after a match: a running mean."""
        mixed = _normalised((1 - rate) * self.values + rate * match.patch, self.weights, 1e-6)
        return self if mixed is None else Pattern.of(mixed, self.weights, self.diameter)

    def find(
        self, picture: Picture, u_px: float, v_px: float, diameter_px: float, reach_px: float, usual: float = np.inf
    ) -> Match | None:
        """The best match with a centre within `reach_px` of a place, of about the given diameter; None without one.

        usual: `unexplained` of good matches. With clearly more, a part is hidden: what disagrees is left out.
        """
        scale = self.diameter / diameter_px
        half = self.values.shape[0] // 2
        reach = float(np.clip(np.ceil(reach_px * scale), 2, _LARGEST_REACH * LARGEST_PX))
        window = _Window.around(picture, u_px, v_px, (reach + half + 2) / scale, scale)
        if window is None:
            return None
        x0, y0 = window.inside(u_px, v_px)
        left, top = round(x0 - reach), round(y0 - reach)
        side = 2 * int(reach) + 1
        field = window.field[top - half : top + half + side, left - half : left + half + side]
        if min(field.shape) < 2 * half + 1 or top < half or left < half:
            return None
        raw = cv2.matchTemplate(field, self.values, cv2.TM_CCOEFF_NORMED, mask=self.weights)
        scores: Floats = np.nan_to_num(raw, nan=-1.0, posinf=-1.0, neginf=-1.0).astype(np.float32)
        _, _, _, (x, y) = cv2.minMaxLoc(scores)
        second = _second(scores, x, y, 0.5 * self.diameter)
        return self._refined(window, float(left + x), float(top + y), window.scale / scale, second, usual)

    def _refined(self, window: _Window, x: float, y: float, growth: float, second: float, usual: float) -> Match | None:
        """Gauss-Newton for shift and growth; x, y: the peak of the correlation in the window."""
        half = self.values.shape[0] // 2
        place = self._aligned(window, (x, y, growth))
        if place is None:
            return None
        patch = _normalised(window.patch(*place, half), self.weights, _LEAST_CONTRAST)
        if patch is None:
            return None
        correlation = float((self.weights * self.values * patch).sum())
        visible, agreement, left = 1.0, correlation, unexplained(correlation)
        part = self
        if left > _HIDDEN_FACTOR * usual:
            for _ in range(_ROBUST_ROUNDS):
                weights = self._agreeing(window.patch(*place, half), usual)
                visible = float((weights * self.weights).sum())
                if visible < _LEAST_VISIBLE:
                    return None
                part = Pattern.of(self.values, (weights * self.weights / visible).astype(np.float32), self.diameter)
                better = part._aligned(window, place, (x, y, growth))
                if better is None:
                    return None
                place = better
            patch = _normalised(window.patch(*place, half), self.weights, _LEAST_CONTRAST)
            if patch is None:
                return None
            correlation = float((self.weights * self.values * patch).sum())
            agreement = part._correlation(patch)
        # Of unit variance, the part that the pattern does not explain, over its degrees of freedom; `normal` belongs to
        # weights of sum 1, so it is divided by the effective number of pixels.
        pixels = visible / float((self.weights**2).sum())
        covariance = unexplained(agreement) / max(pixels - 5, 1) * part.normal[:3, :3]
        to_px = np.array([place[2] / window.scale] * 2 + [1.0])
        covariance = covariance * to_px[:, None] * to_px
        u, v = window.outside(*place[:2])
        diameter = place[2] * self.diameter / window.scale
        return Match(u, v, diameter, covariance, correlation, visible, agreement, second, patch)

    def _correlation(self, patch: Floats) -> float:
        """The weighted correlation coefficient with a patch; 0 without contrast."""
        values, seen = _normalised(self.values, self.weights, 1e-6), _normalised(patch, self.weights, 1e-6)
        return 0.0 if values is None or seen is None else float((self.weights * values * seen).sum())

    def _aligned(
        self, window: _Window, place: tuple[float, float, float], start: tuple[float, float, float] | None = None
    ) -> tuple[float, float, float] | None:
        """Gauss-Newton for shift and growth from a place; None where it leaves the surroundings of `start`."""
        half = self.values.shape[0] // 2
        x, y, growth = place
        x0, y0, growth0 = place if start is None else start
        limit = _MOST_SHIFT * self.diameter
        for _ in range(_ITERATIONS):
            du, dv, dg, gain, _ = (self.solver @ window.patch(x, y, growth, half).ravel()).tolist()
            if not gain > 0:
                return None
            du, dv, dg = du / gain, dv / gain, float(np.clip(dg / gain, -0.1, 0.1))
            x, y = x - growth * du / (1 + dg), y - growth * dv / (1 + dg)
            growth /= 1 + dg
            if abs(x - x0) > limit or abs(y - y0) > limit or abs(np.log(growth / growth0)) > _MOST_GROWTH:
                return None
            if abs(du) + abs(dv) + self.diameter / 2 * abs(dg) < _CONVERGED_PX:
                break
        return x, y, growth

    def _agreeing(self, patch: Floats, usual: float) -> Floats:
        """Weights (n, n), 0 to 1, of the pixels that agree with the pattern up to gain and offset (Tukey's biweight).

        Gain and offset come from the half of the pixels that agrees best, starting with all.
        """
        own = self.weights > 0
        values, seen = self.values[own].astype(float), patch[own].astype(float)
        keep = np.ones(len(values), bool)
        away = np.zeros(len(values))
        for _ in range(4):
            A = np.stack([values[keep], np.ones(int(keep.sum()))], axis=1)
            gain, offset = np.linalg.lstsq(A, seen[keep], rcond=None)[0]
            if not gain > 0:
                return np.zeros_like(patch)
            away = np.abs((seen - offset) / gain - values)
            keep = away <= np.median(away)
        scale = np.sqrt(usual) + _LEAST_SCALE
        out = np.zeros_like(patch)
        out[own] = np.clip(1 - (away / (_TUKEY * scale)) ** 2, 0, 1) ** 2
        return out


def unexplained(correlation: float) -> float:
    """Variance that the pattern does not explain, over the one that it explains."""
    square = float(np.clip(correlation, 1e-3, 1 - 1e-6)) ** 2
    return (1 - square) / square


@dataclass(frozen=True, slots=True)
class _Window:
    """A part of the picture, reduced. Its border repeats the outermost pixels where it reaches beyond the picture."""

    field: Floats
    left: int  # of its first column, px of the picture
    top: int
    scale: float  # pixels of the window per pixel of the picture

    @classmethod
    def around(cls, picture: Picture, u_px: float, v_px: float, half_px: float, scale: float) -> _Window | None:
        """The part within `half_px` of a place; None where the place is outside the picture."""
        height, width = picture.shape
        if not (-0.5 <= u_px < width - 0.5 and -0.5 <= v_px < height - 0.5):
            return None
        reach = int(np.ceil(half_px)) + 3
        left, top = round(u_px) - reach, round(v_px) - reach
        right, bottom = round(u_px) + reach + 1, round(v_px) + reach + 1
        inner = picture[max(top, 0) : min(bottom, height), max(left, 0) : min(right, width)]
        field = inner.astype(np.float32)
        borders = max(-top, 0), max(bottom - height, 0), max(-left, 0), max(right - width, 0)
        if any(borders):
            field = np.asarray(cv2.copyMakeBorder(field, *borders, cv2.BORDER_REPLICATE), np.float32)
        side = max(round(scale * field.shape[0]), 3)
        exact = side / field.shape[0]
        if side != field.shape[0]:
            how = cv2.INTER_AREA if side < field.shape[0] else cv2.INTER_CUBIC
            field = np.asarray(cv2.resize(field, (side, side), interpolation=how), np.float32)
        return cls(field, left, top, exact)

    def inside(self, u_px: float, v_px: float) -> tuple[float, float]:
        """Place in the window."""
        return (u_px - self.left + 0.5) * self.scale - 0.5, (v_px - self.top + 0.5) * self.scale - 0.5

    def outside(self, x: float, y: float) -> tuple[float, float]:
        """Place in the picture."""
        return (x + 0.5) / self.scale - 0.5 + self.left, (y + 0.5) / self.scale - 0.5 + self.top

    def patch(self, x: float, y: float, growth: float, half: int) -> Floats:
        """(n, n) values around a place, `growth` pixels of the window apart."""
        n = 2 * half + 1
        matrix = np.array([[growth, 0, x - growth * half], [0, growth, y - growth * half]])
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        out = cv2.warpAffine(self.field, matrix, (n, n), flags=flags, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(out, np.float32)


def _normalised(patch: Floats, weights: Floats, least_sigma: float) -> Floats | None:
    """With the mean 0 and the sigma 1 under the weights; None with a sigma of `least_sigma` or less."""
    away = patch - np.float32((weights * patch).sum())
    sigma = float(np.sqrt((weights * away**2).sum()))
    return (away / np.float32(sigma)).astype(np.float32) if sigma > least_sigma else None


def _second(scores: Floats, x: int, y: int, apart: float) -> float:
    """The largest score at least `apart` from the peak; -1 where the window has no such place."""
    v, u = np.mgrid[: scores.shape[0], : scores.shape[1]]
    others = scores[(u - x) ** 2 + (v - y) ** 2 > apart**2]
    return float(others.max()) if others.size else -1.0


# The motion of the pattern, and where the rim's centre lies in it: three small Kalman filters.
#
# The centre moves with a nearly constant velocity (the filter of tracking/kalman.py), the logarithm of the diameter is
# a random walk. A match is accurate to a few hundredths of a pixel, but its pattern drifts with tilt and light; a
# detection has an error of some percent of the diameter, but does not drift. So the offset between the two is a state
# of its own: detections correct the drift, and their errors average out in part. Their size depends on the drogue, its
# tilt and its background (.6 to 3 % of the diameter, in 48 sequences of two renderers): the variance is estimated from
# the innovations. An error that all detections of one drogue have in common shows in no innovation. A part of it grows
# with the others, a part is the same for all drogues: its variance is _COMMON times (the usual one + theirs). Where the
# rim has little contrast both are larger, so that the contrast itself says nothing more (.001 of the log likelihood per
# coordinate in 60 approaches of three renderers, this sum .037). Source: ours.

_MATCH_SIGMA_PX = 0.03  # of a match, beside its own covariance
_MATCH_SIZE_SIGMA = 0.01  # of the log diameter of a match, beside its own covariance
_START_SPEED = 0.3, 5.0  # 1 sigma of the speed at the start: diameters and px per frame
# Relative change of the acceleration per excess of a normalised innovation, its largest excess, and its limits relative
# to the initial value: as in tracking/single_target/point_tracker.py.
_LEARNING_RATE, _MOST_NIS = 0.1, 6.0
_SIGMA_A_RANGE = 0.1, 10.0
_COMMON = 0.5  # variance of the error that all detections have in common, over the sum of the usual one and of each
_NOISE_RATE, _NOISE_RANGE = 0.3, (0.2, 10.0)  # the same of the noise of detections, which are few
WHOLE = 0.9  # visible share of a pattern of which nothing is hidden
_HUBER_SIGMAS = 2.5  # a detection farther away than this has a smaller weight


@dataclass(frozen=True, slots=True)
class PatternState:
    """State after a frame."""

    x: Array  # (4,) u, v of the pattern's centre, px, and their rates, px/frame
    P: Array  # (4, 4)
    log_diameter: float  # of the pattern
    size_variance: float
    offset: Array  # (3,) of the rim from the pattern: u, v in diameters, logarithm of the diameter
    offset_variance: Array  # (3,)
    sigma_a_px: float  # px/frame^2: 1-sigma acceleration, estimated from the innovations
    noise_scale: Array  # (3,) of the variance of detections, estimated from the innovations
    common_variance: Array  # (3,) of the error of `offset` that all detections have in common

    @classmethod
    def started(cls, u_px: float, v_px: float, diameter_px: float, p: LightParameters) -> PatternState:
        """At a detection."""
        speed = _START_SPEED[0] * diameter_px + _START_SPEED[1]
        # The pattern is cut out at the detection: its place is known, what the detection is wrong by is in the offset.
        P = np.diag([_MATCH_SIGMA_PX**2, _MATCH_SIGMA_PX**2, speed**2, speed**2])
        noise = _detection_noise(diameter_px, p)
        return cls(
            np.array([u_px, v_px, 0.0, 0.0]),
            P,
            float(np.log(diameter_px)),
            _MATCH_SIZE_SIGMA**2,
            np.zeros(3),
            noise,
            p.sigma_a_diameters * diameter_px + p.sigma_a_px,
            np.ones(3),
            2 * _COMMON * noise,
        )

    def predicted(self, dt: float, misses: int, p: LightParameters) -> PatternState:
        """`dt` frames later. misses: frames in a row without a measurement."""
        start = p.sigma_a_diameters * self.diameter_px + p.sigma_a_px
        # A drogue sways: what its acceleration was before it was hidden is not what it is now.
        sigma_a = self.sigma_a_px if not misses else max(self.sigma_a_px, start)
        x, P = kalman.predict(self.x, self.P, dt, np.asarray(sigma_a))
        drift = p.offset_drift**2 * dt
        return replace(
            self, x=x, P=P, size_variance=self.size_variance + p.sigma_growth**2 * dt,
            offset_variance=self.offset_variance + drift,
        )  # fmt: skip

    def matched(self, match: Match, p: LightParameters, learn: bool = True) -> PatternState:
        """With a match. learn: adapt the acceleration to its innovation."""
        whole = match.visible >= WHOLE
        partly = 1.0 if whole else 1 / match.visible**2
        R = partly * (match.covariance[:2, :2] + _MATCH_SIGMA_PX**2 * np.eye(2))
        z = np.array([match.u_px, match.v_px])
        nis = float(kalman.innovation(self.x, self.P, z, R)[2])
        x, P = kalman.update(self.x, self.P, z, R)
        start = p.sigma_a_diameters * self.diameter_px + p.sigma_a_px
        change = float(np.exp(_LEARNING_RATE * (min(nis / 2, _MOST_NIS) - 1))) if learn and whole else 1.0
        sigma_a = float(np.clip(self.sigma_a_px * change, *np.multiply(_SIGMA_A_RANGE, start)))
        r = partly * (float(match.covariance[2, 2]) + _MATCH_SIZE_SIGMA**2)
        gain = self.size_variance / (self.size_variance + r)
        size = self.log_diameter + gain * (float(np.log(match.diameter_px)) - self.log_diameter)
        return replace(
            self, x=x, P=P, log_diameter=size, size_variance=(1 - gain) * self.size_variance, sigma_a_px=sigma_a
        )

    def detected(self, u_px: float, v_px: float, diameter_px: float, p: LightParameters) -> PatternState:
        """With a detection beside a match: it corrects the offset."""
        away = (np.array([u_px, v_px]) - self.x[:2]) / self.diameter_px
        seen = np.array([*away, np.log(diameter_px) - self.log_diameter])
        innovation = seen - self.offset
        usual = _detection_noise(self.diameter_px, p)
        nis = innovation**2 / (self.offset_variance + self.noise_scale * usual)
        nis[:2] = nis[:2].mean()
        change = np.exp(_NOISE_RATE * (np.minimum(nis, _MOST_NIS) - 1))
        scale = np.clip(self.noise_scale * change, *_NOISE_RANGE)
        change = scale / self.noise_scale
        # The detections before had the same scatter, and so has what they gave.
        variance = self.offset_variance * change
        noise = scale * usual * np.maximum(nis / change / _HUBER_SIGMAS**2, 1.0)
        gain = variance / (variance + noise)
        return replace(
            self, offset=self.offset + gain * innovation, offset_variance=(1 - gain) * variance, noise_scale=scale,
            common_variance=_COMMON * (1 + scale) * usual,
        )  # fmt: skip

    def moved(self, match: Match, p: LightParameters) -> PatternState:
        """Found at another place after a gap: at rest there, of the same size and offset."""
        start = PatternState.started(match.u_px, match.v_px, match.diameter_px, p)
        return start.with_offset_of(self)

    def with_offset_of(self, other: PatternState) -> PatternState:
        """This motion, with the offset of another state and all that is known of it."""
        return replace(
            self, offset=other.offset, offset_variance=other.offset_variance, noise_scale=other.noise_scale,
            common_variance=other.common_variance,
        )  # fmt: skip

    def centred(self) -> PatternState:
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
        return self.P[:2, :2] + self.diameter_px**2 * np.diag((self.offset_variance + self.common_variance)[:2])

    @property
    def sigma_diameter_px(self) -> float:
        """Of the rim."""
        variance = self.size_variance + self.offset_variance[2] + self.common_variance[2]
        return self.rim_diameter_px * float(np.sqrt(variance))

    @property
    def sigma_px(self) -> float:
        """Of the pattern's centre, along the axis with the larger one."""
        return float(np.sqrt(max(self.P[0, 0], self.P[1, 1])))


def _detection_noise(diameter_px: float, p: LightParameters) -> Array:
    """Variance (3,) of u, v (diameters) and log diameter of a detection."""
    centre = p.detection_sigma**2 + (p.detection_sigma_px / diameter_px) ** 2
    return np.array([centre, centre, p.detection_size_sigma**2])


# The appearance of a drogue that detections confirmed, kept while a newer one is not confirmed.
#
# A drogue that is found again while a part of it is still hidden gives a pattern with the edge of what hides it. Such a
# pattern does not match the whole drogue some frames later; the one from before does.

_SIMILAR = 0.7  # fall of Fisher's z of the correlation below its usual value
_GOOD = 1.5  # Fisher's z that is similar in any case: a correlation of 0.905
_LEAD = 0.3  # of Fisher's z over the next best place of the window


def is_similar(usual: float, z: float) -> bool:
    """Whether a match with Fisher's z is about as good as those of a pattern usually are."""
    return usual - z < _SIMILAR or z > _GOOD


def is_clear(match: Match) -> bool:
    """Whether no other place of the window is nearly as good."""
    return fisher(match.correlation) > fisher(match.second) + _LEAD


@dataclass(frozen=True, slots=True)
class Known:
    """A pattern with what belongs to it."""

    pattern: Pattern
    usual: float  # running mean of Fisher's z of its matches
    confirmed: int  # detections
    support: float  # running mean of the log odds of the checks
    motion: PatternState  # of its last frame: size, offset of the rim

    def found(self, picture: Picture, u_px: float, v_px: float, reach_px: float) -> Match | None:
        """Where it is within `reach_px` of a place; None where nothing looks like it, or several places do."""
        usual = unexplained(float(np.tanh(self.usual)))
        match = self.pattern.find(picture, u_px, v_px, self.motion.diameter_px, reach_px, usual)
        if match is None or not is_similar(self.usual, fisher(match.correlation)) or not is_clear(match):
            return None
        return match
