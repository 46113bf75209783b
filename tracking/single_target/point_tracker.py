"""The tracker of one target: a constant-velocity Kalman filter with gate, prediction through misses, acquisition."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace

import numpy as np

from geometry.arrays import Array, Bools, symmetric
from geometry.uncertainty.chi_square import chi2_limit
from tracking import kalman
from tracking.detections import UNMATCHED, Detections
from tracking.statuses import PoseStatus


@dataclass(frozen=True, slots=True)
class PointParameters:
    """Tracking of one target. Units: px and frames, as in the paper (time step 1)."""

    sigma_a_px: float = 1.0  # px/frame^2: 1-sigma white acceleration; the initial value if estimated
    learn_sigma_a: bool = True  # estimate it from the innovations
    # px: added to every detection's own sigma. NEES/2 of discs that keep their shape (second_checks point 93 40): .39
    # with .1, .87 with .03, 1.03 with .02. A target that changes its shape needs more, .1 to 1.
    sigma_model_px: float = 0.02
    p_gate: float = 1e-4  # probability that the target's own detection lies outside the gate
    max_speed_px: float = 60.0  # px/frame: largest first vector of an acquisition
    confirm: int = 3  # consecutive detections that agree with one motion before a track starts; the paper: 2
    most_candidates: int = 12  # detections per picture from which tracks may start; the brightest
    max_size_ratio: float = 4.0  # a track that was lost is found again only with a brightness within this ratio
    max_predicted: int = 50  # frames without a detection after which the track is lost ...
    lost_sigma_px: float = 40.0  # px: ... or as soon as the position's sigma exceeds this
    start_px: tuple[float, float] | None = None  # u, v: the target that is nearest to this place at the start
    start_within_px: float = 50.0  # px: largest distance from it

    def __post_init__(self) -> None:
        for name in ("sigma_a_px", "max_speed_px", "lost_sigma_px", "start_within_px"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: expected a number above 0, got {getattr(self, name)}")
        if not (self.sigma_model_px >= 0 and self.max_size_ratio > 1):
            raise ValueError("sigma_model_px: expected 0 or more; max_size_ratio: expected more than 1")
        if not 0 < self.p_gate < 1:
            raise ValueError(f"p_gate: expected a number between 0 and 1, got {self.p_gate}")
        if not (self.confirm >= 2 and self.most_candidates >= 1 and self.max_predicted >= 0):
            raise ValueError("confirm: expected 2 or more; most_candidates: 1 or more; max_predicted: 0 or more")


USUAL = PointParameters()


# Acquisition: motions that start with two detections of consecutive pictures and agree with the following ones.
#
# Source: eq. (9) of Duan (2020) for the first vector; the confirmation is ours.

_MOST_TRACKS = 200  # candidate motions that are followed at once
_LONGEST = 30  # steps of a motion that are kept while none of several stands out
_OWN_STEPS = 8  # detections after which one of several motions can be the target's own; with 5, glitter has some
_OWN_SIGMAS = 4.0  # by which it moves farther than the others do, in each half of its steps
_SCENE = 3  # so many motions that move alike are a structured scene, any of which may be the target


@dataclass(frozen=True, slots=True)
class Step:
    """A detection of a candidate motion and the filter after it."""

    x: Array  # (4,) u, v, px, and their rates, px/frame; the first one has rates nan
    P: Array  # (4, 4)
    row: int  # of the detection in its picture
    flux: float  # nan where the detections have none


@dataclass(slots=True)
class CandidateTracks:
    """The candidate motions up to the last picture, and its detections that may start further ones."""

    parameters: PointParameters
    _tracks: list[tuple[Step, ...]] = field(default_factory=list)
    _last: list[Step] = field(default_factory=list)  # the detections of the last picture
    several: bool = False  # the last picture confirmed several motions, and it stays open which one is the target's

    def step(
        self, dt: float, found: Detections, cov: Array, may_start: Bools, near: Array | None = None
    ) -> tuple[Step, ...] | None:
        """Continue with a picture's detections; cov (n, 2, 2), px^2. Returns the steps of a confirmed motion, or None.

        dt: frames since the last picture. may_start (n,): detections where a motion may begin. Of several motions that
        are confirmed, the one that is nearest to the place `near` (2,) is chosen, without one that which stands out.
        """
        p, kept = self.parameters, min(len(found), self.parameters.most_candidates)
        continued = [c for track in self._tracks if (c := self._continued(track, dt, found, cov)) is not None]
        started = [
            (first, _second(first, found, cov, row, dt))
            for first in self._last
            for row in range(kept)
            if np.linalg.norm(found.uv_px[row] - first.x[:2]) <= p.max_speed_px * dt
        ]
        tracks = continued + started
        confirmed = _distinct([track for track in tracks if len(track) >= p.confirm])
        self._tracks = (confirmed + [track for track in tracks if len(track) < p.confirm])[:_MOST_TRACKS]
        self._last = [_first(found, cov, row) for row in np.flatnonzero(may_start[:kept]).tolist()]
        if near is not None:
            return min(confirmed, key=lambda t: float(np.linalg.norm(t[-1].x[:2] - near)), default=None)
        chosen = _standing_out(confirmed)
        self.several = chosen is None and bool(confirmed)
        return chosen

    def _continued(self, track: tuple[Step, ...], dt: float, found: Detections, cov: Array) -> tuple[Step, ...] | None:
        """A motion with the nearest detection in its gate; None: there is none."""
        p, last = self.parameters, track[-1]
        x, P = kalman.predict(last.x, last.P, dt, np.asarray(p.sigma_a_px))
        row, _ = nearest(x, P, found.uv_px, cov, p.p_gate)
        if row is None:
            return None
        x, P = kalman.update(x, P, found.uv_px[row], cov[row])
        return (*track[-_LONGEST:], Step(x, P, row, float(found.flux[row])))


def nearest(x: Array, P: Array, uv_px: Array, cov_px2: Array, p_gate: float) -> tuple[int | None, float]:
    """The detection (n, 2) with the smallest normalised innovation, and that number; None where the gate is empty."""
    if not len(uv_px):
        return None, float("nan")
    _, _, nis = kalman.innovation(x, P, uv_px, cov_px2)
    row = int(np.argmin(nis))
    return (row if nis[row] <= chi2_limit(p_gate, 2) else None), float(nis[row])


def _first(found: Detections, cov: Array, row: int) -> Step:
    P = np.pad(cov[row], (0, 2), constant_values=np.nan)
    return Step(np.array([*found.uv_px[row], np.nan, np.nan]), P, row, float(found.flux[row]))


def _second(first: Step, found: Detections, cov: Array, row: int, dt: float) -> Step:
    """Eq. (9): the first vector from two pictures; its covariance from both positions."""
    x, P = kalman.restart(found.uv_px[row], cov[row], first.x[:2], first.P[:2, :2], dt)
    return Step(x, P, row, float(found.flux[row]))


def _distinct(tracks: Sequence[tuple[Step, ...]]) -> list[tuple[Step, ...]]:
    """Of motions that end in the same detection the longest; of those the slowest: the others pass several objects."""
    ordered = sorted(tracks, key=lambda t: (len(t), -float(np.linalg.norm(t[-1].x[:2] - t[0].x[:2]))))
    return list({track[-1].row: track for track in ordered}.values())


def _standing_out(tracks: Sequence[tuple[Step, ...]]) -> tuple[Step, ...] | None:
    """The motion of the target; None: there is none, or the pictures leave open which one it is.

    It is the only one, or moves while the scene does not, or comes first in the order of its pictures (the brightest,
    or sharpest): of two motions alike, not of more, which are parts of a scene.
    """
    if len(tracks) < 2:
        return tracks[0] if tracks else None
    own = sorted(((_own_sigmas(t, tracks), k) for k, t in enumerate(tracks)), reverse=True)
    (most, best), (second, _) = own[:2]
    if most > _OWN_SIGMAS and (len(tracks) >= _SCENE or second <= _OWN_SIGMAS):
        return tracks[best]
    if len(tracks) >= _SCENE or max(map(len, tracks)) < _OWN_STEPS:
        return None
    return min(tracks, key=lambda t: (max(s.row for s in t), sum(s.row for s in t)))


def _own_sigmas(track: tuple[Step, ...], tracks: Sequence[tuple[Step, ...]]) -> float:
    """By how many sigmas a motion moves otherwise than the scene, in that half of its steps where it is less.

    The scene is that of the other motions, and at rest as far as these do not show it. A detection that is joined with
    another one from some picture on has moved in one half only.
    """
    steps, structured = len(track) - 1, len(tracks) >= _SCENE
    others = [t for t in tracks if t is not track and len(t) > steps]
    if len(track) < _OWN_STEPS or len(others) < (2 if structured else 1):
        return 0.0
    places = np.array([[t[-1 - back].x[:2] for back in (steps, steps // 2, 0)] for t in (track, *others)])
    moved = np.diff(places, axis=1)  # (n, 2, 2): of each motion in both halves
    scene = moved[1:] if structured else np.zeros((1, 2, 2))
    own = moved[0] - np.median(scene, axis=0)
    scatter_px = np.median(np.linalg.norm(scene - np.median(scene, axis=0), axis=-1), axis=0)
    sigmas = np.sqrt(np.trace(track[-1].P[:2, :2]) + scatter_px**2)
    return float(np.min(np.linalg.norm(own, axis=-1) / sigmas)) if own[0] @ own[1] > 0 else 0.0


# The tracker of one target: a constant-velocity Kalman filter with gate, prediction through misses, re-acquisition.
#
# Source: Duan, Yuan, Wang & Huangfu, "Target tracking system of UAV based on Kalman filter", Intelligent Computer and
# Applications 10(10), 92 (2020), eqs. (1) to (9). Gate, confirmation, estimated process noise and statuses are ours.
# The filter's equations are those of tracking/kalman.py with the time step 1 of the paper (one frame).

SIGMA_A_RANGE = (0.05, 1e3)  # limits of the estimated acceleration, in initial values: a target at rest may start
SIGMA_A_RATE = 0.05  # relative change of the estimated acceleration per excess of one normalised innovation
NEAR_MISS = 4.0  # times the gate: a detection nearer than this may be the target that turns
# Factors of the acceleration per frame without a detection, and their largest product: a target that moved steadily may
# turn while it is hidden, and does turn if a detection lies a little outside the gate.
MISS_GROWTH, NEAR_MISS_GROWTH, MOST_GROWTH = 1.1, 1.5, 10.0
SPEED_FACTOR = 3.0  # a lost target may move this much faster than ever observed
_FLUX_RATE = 0.1  # of the running means of the target's brightness and of its area
# An area that differs by more sigmas than this is that of a part of the target, or of the target and something beside
# it. What is hidden makes it smaller: a small area changes the mean twenty times as slowly. The first sigma is of the
# logarithm.
_UNUSUAL_AREA, _UNUSUAL_SHARE, _FIRST_AREA_SIGMA = 2.0, 0.05, 0.05
# Squares of areas that are weighted and limited like this have this share of their variance (normal distribution).
# Without it, the estimated sigma is three quarters of the true one, and twice as many areas are unusual.
_LIMITED_SHARE = 0.78
_SHAPE_RATE = 0.02  # least rate of the mean shape, which growth does not change: a slow occlusion is not usual with it
# Correlation of the shift of a target that is hidden in part with that of the frame before: the side changes as
# something narrow passes. With .8 to .95 the means over 20 recordings are alike; a strip that passes slowly needs .8.
_SAME_SIDE = 0.8
_STEADY = 3  # frames after which the area of a target that was lost is that of all of it
_POSITION = np.diag([1.0, 1.0, 0.0, 0.0])  # the part of the state


@dataclass(frozen=True, slots=True)
class _Usual:
    """A number of the target in most pictures: running mean and variance, and how much the next one changes them."""

    mean: float
    variance: float
    rate: float = 0.5

    def differs(self, away: float) -> bool:
        """Whether a number that is so far from the mean is unusual."""
        return abs(away) > _UNUSUAL_AREA * self.variance**0.5

    def after(self, away: float, least_rate: float) -> _Usual:
        """With one more number that is so far from the mean."""
        most = _UNUSUAL_AREA * self.variance**0.5
        rate = _UNUSUAL_SHARE * least_rate if self.differs(away) else self.rate
        return _Usual(
            self.mean + (_FLUX_RATE if away > most else rate) * max(away, -most),
            self.variance + rate * (min(abs(away), most) ** 2 / _LIMITED_SHARE - self.variance),
            self.rate if self.differs(away) else max(self.rate / (1 + self.rate), least_rate),
        )


@dataclass(frozen=True, slots=True)
class PointEstimate:
    """The target in one frame. Numbers that are not known are nan."""

    status: PoseStatus
    x: Array  # (4,) u, v, px, and their rates, px/frame
    P: Array  # (4, 4)
    predicted_px: Array  # (2,) predicted before this frame's picture
    nis: float  # normalised innovation squared of the detection, or of the nearest one outside the gate
    row: int  # the detection, or UNMATCHED
    sigma_a_px: float  # px/frame^2, estimated so far
    several: bool = False  # lost: there are several motions, of which none stands out


NOTHING = PointEstimate(
    PoseStatus.LOST, np.full(4, np.nan), np.full((4, 4), np.nan), np.full(2, np.nan), np.nan, UNMATCHED, np.nan
)


class PointTracker:
    """Follows one target, picture by picture."""

    def __init__(self, parameters: PointParameters = USUAL) -> None:
        self.parameters = parameters
        self.acquired: tuple[Step, ...] = ()  # after a step that started a track: its detections, this one last
        self._candidates = CandidateTracks(parameters)
        self._x: Array | None = None  # None: no track
        self._P = np.zeros((4, 4))
        self._sigma_a = parameters.sigma_a_px
        self._unseen = 0.0  # frames
        self._speed = 0.0  # px/frame, the largest so far
        self._growth = 1.0  # of the acceleration while the target is not seen
        self._flux = float("nan")  # running mean of the target's brightness
        # Covariance of the state with the direction in which the centroid of what is seen of the target is shifted.
        self._P_shift = np.zeros((4, 2))
        self._area: _Usual | None = None  # of the area's logarithm
        self._shape: _Usual | None = None  # of the logarithm of the shorter over the longer axis
        # The area's logarithm before the target was lost, and frames since then in which its area is steady.
        self._lost_log_area, self._steady = float("nan"), 0
        self.in_part = False  # the last picture shows the target in part, or not at all
        self._last_px: Array | None = None  # where the target was lost
        self._waited = 0.0  # frames since the last picture that CandidateTracks has seen

    def step(self, dt: float, found: Detections | None, before_hidden: bool = False) -> PointEstimate:
        """The target `dt` frames after the last step; found: the picture's detections, None without a picture.

        before_hidden: the next picture shows the target in part, or not at all.
        """
        self.acquired, beside = (), before_hidden or self.in_part
        self.in_part = False
        self._waited += dt
        if self._x is None:
            self._unseen += dt
            return NOTHING if found is None else self._acquire(found)
        self._x, self._P = kalman.predict(self._x, self._P, dt, np.asarray(self._sigma_a * self._growth))
        self._P_shift = _SAME_SIDE**dt * kalman.transition(dt) @ self._P_shift
        predicted, self._unseen = self._x[:2].copy(), self._unseen + dt
        row, nis, near = None, float("nan"), False
        if found is not None:
            cov = self._covariances(found)
            row, nis = nearest(self._x, self._P, found.uv_px, cov, self.parameters.p_gate)
            near = nis < NEAR_MISS * chi2_limit(self.parameters.p_gate, 2)
            # Without what an unusual area adds to the sigmas: a target that starts to move may change its area, too.
            self._learn(nis if near else float("nan"))
            if row is not None:
                nis = self._update(found, cov[row], self._hidden_px2(found, row, beside) ** 0.5, row)
                return self._estimate(PoseStatus.MEASURED, predicted, nis, row)
        self.in_part = found is not None
        self._growth = min(self._growth * (NEAR_MISS_GROWTH if near else MISS_GROWTH) ** dt, MOST_GROWTH)
        sigma = float(np.sqrt(np.linalg.eigvalsh(self._P[:2, :2])[1]))
        if self._unseen > self.parameters.max_predicted or sigma > self.parameters.lost_sigma_px:
            self._last_px, self._x = predicted, None
            self._candidates, self._waited = CandidateTracks(self.parameters), 0.0
            return replace(NOTHING, predicted_px=predicted, nis=nis, sigma_a_px=self._sigma_a)
        return self._estimate(PoseStatus.PREDICTED, predicted, nis, UNMATCHED)

    def _acquire(self, found: Detections) -> PointEstimate:
        cov = self._covariances(found)
        start = self.parameters.start_px
        near = np.array(start) if start is not None and self._last_px is None else self._last_px
        steps = self._candidates.step(self._waited, found, cov, self._may_start(found), near)
        self._waited = 0.0
        if steps is None:
            return replace(NOTHING, several=self._candidates.several)
        if self._area is not None:
            self._lost_log_area = self._area.mean
        self._P_shift = np.zeros((4, 2))
        if np.isfinite(self._lost_log_area) and np.isfinite(self._flux):  # found again: it may still be hidden in part
            more = [_shift_px2(self._lost_log_area, min(s.flux / self._flux, 2.0)) for s in steps]
            steps = tuple(replace(s, P=s.P + m * _POSITION) for s, m in zip(steps, more, strict=True))
            self._P_shift = more[-1] ** 0.5 * np.eye(4, 2)
        last = steps[-1]
        self._x, self._P, self.acquired = last.x, last.P, steps
        self._unseen, self._growth, self._area, self._steady = 0.0, 1.0, None, 0
        fluxes = [s.flux for s in steps if np.isfinite(s.flux)]
        self._flux = float(np.mean(fluxes)) if fluxes else self._flux
        return self._estimate(PoseStatus.MEASURED, np.full(2, np.nan), float("nan"), last.row)

    def _hidden_px2(self, found: Detections, row: int, beside: bool) -> float:
        """Variance of a coordinate, px^2, since a part of the target is hidden, or something else is taken for one.

        beside: the picture before or after this one shows it so: this one may, by less than the area's scatter.
        An edge that hides a share s of a disc with the radius r moves its centroid by .85 to 1 times s r. The area is
        flux over peak, which the light does not change. What is left of a disc is shorter by the share s along one
        axis, which a target that grows meanwhile does not change.
        """
        area = float(found.flux[row] / found.peak[row]) if found.peak[row] > 0 else float("nan")
        ratio = float(found.minor_px[row] / found.major_px[row]) if found.major_px[row] > 0 else float("nan")
        if not area > 0 or self._area is None:
            self._area = _Usual(float(np.log(area)), _FIRST_AREA_SIGMA**2) if area > 0 else None
            self._shape = _Usual(float(np.log(ratio)), _FIRST_AREA_SIGMA**2) if ratio > 0 else None
            known = self._area is not None and np.isfinite(self._lost_log_area)
            return _shift_px2(self._lost_log_area, area / np.exp(self._lost_log_area)) if known else 0.0
        usual, away = self._area, float(np.log(area)) - self._area.mean
        self.in_part, seen = usual.differs(away), float(np.exp(away))
        if self._shape is not None and ratio > 0:
            flatter = float(np.log(ratio)) - self._shape.mean
            if flatter < 0 and self._shape.differs(flatter):
                self.in_part, seen = True, min(seen, float(np.exp(flatter)))
            self._shape = self._shape.after(flatter, _SHAPE_RATE)
        self._area = usual.after(away, _FLUX_RATE)
        if np.isfinite(self._lost_log_area) and self._steady < _STEADY:
            self._steady = 0 if self.in_part else self._steady + 1
            return _shift_px2(self._lost_log_area, area / np.exp(self._lost_log_area))
        if not (self.in_part or beside):
            return 0.0
        return _shift_px2(usual.mean, seen, 0.0 if self.in_part else usual.variance)

    def _update(self, found: Detections, cov: Array, shift_px: float, row: int) -> float:
        """The state with a detection that has this covariance (2, 2). Returns its normalised innovation squared.

        shift_px: sigma of the shift of its centroid, which is much the same in successive pictures, so that the mean of
        many is hardly better: its direction is considered, not estimated. Source: Schmidt 1966.
        """
        assert self._x is not None
        P, common = self._P, self._P_shift + shift_px * np.eye(4, 2)
        S = P[:2, :2] + cov + shift_px * (self._P_shift[:2] + common[:2].T)
        y = found.uv_px[row] - self._x[:2]
        K = np.linalg.solve(S, (P[:, :2] + shift_px * self._P_shift).T).T
        nis = float(y @ np.linalg.solve(S, y))
        self._x, self._P = self._x + K @ y, symmetric(P - K @ S @ K.T)
        self._P_shift = self._P_shift - K @ common[:2]
        flux = float(found.flux[row])
        if np.isfinite(flux):
            self._flux = flux if np.isnan(self._flux) else (1 - _FLUX_RATE) * self._flux + _FLUX_RATE * flux
        self._unseen, self._growth = 0.0, 1.0
        self._speed = max(self._speed, float(np.linalg.norm(self._x[2:])))
        return nis

    def _learn(self, nis: float) -> None:
        """Adapt the acceleration to an innovation, of a detection in the gate or a little outside it.

        Without those outside, an acceleration that is much too small would never be corrected.
        """
        if self.parameters.learn_sigma_a and np.isfinite(nis) and self._unseen <= 1.5:
            change = np.exp(SIGMA_A_RATE * (np.clip(nis / 2, 0, 6) - 1))
            low, high = np.multiply(SIGMA_A_RANGE, self.parameters.sigma_a_px)
            self._sigma_a = float(np.clip(self._sigma_a * change, low, high))

    def _may_start(self, found: Detections) -> np.ndarray:
        """(n,): detections from which a track may start: near the given place, or what the lost target can be."""
        p, good = self.parameters, np.ones(len(found), dtype=bool)
        if self._last_px is None:
            if p.start_px is not None:
                good &= np.linalg.norm(found.uv_px - p.start_px, axis=-1) <= p.start_within_px
            return good
        reach = 3 * p.lost_sigma_px + min(p.max_speed_px, SPEED_FACTOR * max(self._speed, 1.0)) * self._unseen
        good &= np.linalg.norm(found.uv_px - self._last_px, axis=-1) <= reach
        if np.isfinite(self._flux):
            ratio = np.maximum(found.flux, 1e-12) / max(self._flux, 1e-12)
            good &= ~np.isfinite(found.flux) | (np.abs(np.log(ratio)) <= np.log(p.max_size_ratio))
        return good

    def _covariances(self, found: Detections) -> Array:
        return found.cov_px2 + self.parameters.sigma_model_px**2 * np.eye(2)

    def _estimate(self, status: PoseStatus, predicted: Array, nis: float, row: int) -> PointEstimate:
        assert self._x is not None
        return PointEstimate(status, self._x.copy(), self._P.copy(), predicted, nis, row, self._sigma_a)


def _shift_px2(log_area: float, seen: float, variance: float = 0.0) -> float:
    """Variance of a coordinate, px^2, of a disc with this area of which a share is seen, with the share's variance."""
    return float(np.exp(log_area) / np.pi * ((1 - seen) ** 2 + variance) / 2)


def track_point(
    dt: Array, found: Sequence[Detections | None], parameters: PointParameters = USUAL
) -> list[PointEstimate]:
    """The target in each of T frames. dt (T,): frames since the one before; found: as for `PointTracker.step`.

    The detections that confirmed a track are reported as measured, in the frames before the confirmation too.
    """
    tracker = PointTracker(parameters)
    out: list[PointEstimate] = []
    pictures: list[int] = []  # frames with a picture
    steps = dt.tolist()
    before, whole = copy(tracker), False  # the tracker before the last frame; whether that frame shows the whole target
    for k, (step, detections) in enumerate(zip(steps, found, strict=True)):
        if detections is not None:
            pictures.append(k)
        last = copy(tracker)
        now = tracker.step(step, detections)
        if tracker.in_part and whole:
            # The frame before may be hidden in part, too, by less than shows: once more, with sigmas that contain it.
            tracker = before
            out[k - 1] = tracker.step(steps[k - 1], found[k - 1], before_hidden=True)
            last = copy(tracker)
            now = tracker.step(step, detections)
        out.append(now)
        before = last
        whole = now.status is PoseStatus.MEASURED and not (tracker.in_part or tracker.acquired)
        for at, earlier in zip(pictures[-len(tracker.acquired) : -1], tracker.acquired[:-1], strict=False):
            start = replace(out[k], x=earlier.x, P=earlier.P, row=earlier.row)
            out[at] = start
    return out
