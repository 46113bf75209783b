"""Tracks one circle through pictures: Zhou (2014), figure 2, with a rim fit, a sound noise model and acquisition."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from geometry.arrays import Array, Bools
from tracking.drogue_circle.acquisition import Acquisition, Wanted, acquire
from tracking.drogue_circle.candidates import CircleCandidate, CircleDetector, Picture, Window
from tracking.drogue_circle.kalman import FilterBank, distance2
from tracking.drogue_circle.occlusion import Appearance, RimHabit, disc_cells, first_appearance, is_clear
from tracking.drogue_circle.parameters import CircleParameters
from tracking.drogue_circle.rim import SmoothCrop, smooth_crop
from tracking.drogue_circle.rim_fit import RimFit, fit_rim
from tracking.statuses import PoseStatus

_START_RATE_RADII = 0.25  # 1 sigma of the rate of a new circle, in radii per frame
_WHOLE, _WHOLE_GATE = 0.85, 10.0  # coverage of a rim that is seen whole, and the factor of its gate
_CHANGED = 4  # searches of the whole picture after which a circle of another appearance is accepted
_FORGOTTEN = 50  # searches for a circle like the lost one, after which any circle is accepted
_REFITS = 2  # without the sectors of an occluder
_LEAST_RADIUS = 0.7  # of the smallest radius of an acquisition, below which a circle is not tracked
_CONFIRMED = 3  # measurements after which an acquisition is confirmed
_COVERAGE_COST, _POLARITY_COST = 40.0, 15.0  # against distance^2, of a whole rim and of the other polarity
_AS_PREDICTED, _WELL_SEEN = 16.0, 0.75  # distance^2 and coverage of a fit that needs no comparison with others


class Cause(StrEnum):
    """Why a frame has no measured circle; empty where it has one."""

    NONE = ""
    NO_IMAGE = "no_image"
    OCCLUDED = "occluded"
    NOT_FOUND = "not_found"
    AMBIGUOUS = "ambiguous"
    OUT_OF_VIEW = "out_of_view"

    @property
    def meaning(self) -> str:
        """One sentence for the user."""
        return _MEANINGS[self]


_MEANINGS = {
    Cause.NONE: "the circle is measured",
    Cause.NO_IMAGE: "there is no usable picture",
    Cause.OCCLUDED: "half of the target or more is hidden",
    Cause.NOT_FOUND: "no circle in the picture fits",
    Cause.AMBIGUOUS: "several circles fit equally well",
    Cause.OUT_OF_VIEW: "the predicted centre is outside the picture",
}


@dataclass(frozen=True, slots=True)
class CircleFrame:
    """The circle in one frame. Arrays are nan while nothing is known."""

    status: PoseStatus
    cause: Cause
    state: Array  # (6,) u, v, r in px and their rates in px/frame
    covariance: Array  # (6, 6)
    predicted: Array  # (3,) u, v, r before the picture was used
    measured: RimFit | None  # the fit that was used
    occlusion: float  # gamma; nan where it is unknown
    circles: int = 0  # separate circles, where the whole picture was searched
    event: str = ""  # acquired, reacquired, lost, ambiguous


@dataclass(slots=True)
class CircleTracker:
    """The state between frames. `detector` returns coarse circles; the rim fit is the same for all detectors."""

    detector: CircleDetector
    parameters: CircleParameters = field(default_factory=CircleParameters)
    near_px: tuple[float, float] | None = None  # of the first circle, if the user knows it
    _bank: FilterBank | None = None
    _appearance: Appearance | None = None
    _cells: tuple[Array, Bools] = field(default_factory=lambda: (np.zeros((0, 0)), np.zeros((0, 0), dtype=bool)))
    _fit: RimFit | None = None  # the last one
    _habit: RimHabit | None = None
    _trusted: RimFit | None = None  # the last clear one of a confirmed circle
    _searches: int = 0  # of the whole picture since the circle was lost
    _misses: int = 0
    _measured: int = 0  # since the acquisition
    _ambiguous: bool = False

    def step(self, picture: Picture | None, dt: float = 1.0) -> CircleFrame:
        """The next frame. picture None: there is none. dt: frames since the last step."""
        predicted = np.full(3, np.nan)
        if self._bank is not None:
            self._bank = self._bank.predicted(dt)
            predicted = self._bank.state()[0][:3]
        if picture is None:
            self._misses += 1
            return self._without(Cause.NO_IMAGE, predicted, np.nan)
        if self._bank is None:
            return self._acquired(picture, predicted)
        fit, gamma = self._measure(picture)
        if fit is not None and gamma < self.parameters.occluded:
            return self._updated(picture, fit, gamma, predicted)
        self._misses += 1
        if self._measured < _CONFIRMED and self._misses >= _CONFIRMED:
            self._bank = None  # a false acquisition: no later frame confirms it
            return self._without(Cause.NOT_FOUND, predicted, gamma, event="lost")
        if self._misses >= self.parameters.search_after and self._misses % self.parameters.search_after == 0:
            again = self._found_elsewhere(picture, predicted)
            if again is not None:
                return again
        height, width = picture.shape[:2]
        outside = not (-0.5 <= predicted[0] < width - 0.5 and -0.5 <= predicted[1] < height - 0.5)
        hidden = gamma >= self.parameters.occluded
        cause = Cause.OUT_OF_VIEW if outside else Cause.OCCLUDED if hidden else Cause.NOT_FOUND
        return self._without(cause, predicted, gamma)

    def _window(self) -> Window:
        """The search window around the prediction: four radii wide, larger where the prediction is uncertain."""
        assert self._bank is not None
        p = self.parameters
        x, P = self._bank.state()
        sigma = float(np.sqrt(max(P[0, 0], P[1, 1])))
        radius = max(float(x[2]), 3.0)
        gate = max(p.gate_px, min(3 * sigma, 2 * radius))
        change = max(p.radius_gate * radius, min(3 * float(np.sqrt(P[2, 2])), 0.5 * radius), 2.0)
        half = max(0.5 * p.window_radii * radius, 1.15 * radius + gate)
        return Window(float(x[0]), float(x[1]), half, gate, max(radius - change, 3.0), radius + change)

    def _measure(self, picture: Picture) -> tuple[RimFit | None, float]:
        """The best rim in the window, and the occlusion coefficient there or, without a rim, at the prediction."""
        assert self._bank is not None
        p, window = self.parameters, self._window()
        crop = smooth_crop(picture, window, p.blur_px)
        x, P = self._bank.state()
        best, best_cost = None, np.inf
        fitted: list[RimFit] = []
        for c in self._candidates(picture, window, x):
            fit = fit_rim(crop, c, p.min_coverage)
            if fit is None or any(_is_equal(fit, f) for f in fitted):
                continue
            fitted.append(fit)
            d2 = float(distance2(x, P, fit.centre_and_radius, fit.covariance_px2)[0])
            near = np.hypot(fit.rim.u_px - window.u_px, fit.rim.v_px - window.v_px) < window.gate_px
            if not near or d2 > self._gate(fit) or fit.rim.radius_px < _LEAST_RADIUS * p.min_radius_px:
                continue
            cost = d2 - _COVERAGE_COST * fit.coverage + (_POLARITY_COST if fit.polarity != self._polarity else 0)
            if cost < best_cost:
                best, best_cost = fit, cost
            if d2 < _AS_PREDICTED and fit.coverage > _WELL_SEEN:
                break  # before the detector is called, where the prediction itself fits
        if best is None:
            return None, self._coefficient(picture, window.u_px, window.v_px, float(x[2]))
        gamma = self._coefficient(picture, *map(float, best.centre_and_radius))
        return self._without_occluder(picture, crop, best, gamma)

    def _without_occluder(
        self, picture: Picture, crop: SmoothCrop, fit: RimFit, gamma: float
    ) -> tuple[RimFit | None, float]:
        """The fit without the edges in sectors that an occluder hides: they pull the circle to one side."""
        assert self._appearance is not None and self._habit is not None
        for _ in range(_REFITS):
            hidden = self._appearance.hidden_sectors(*self._cells)
            if not hidden.any():
                break
            hidden |= self._habit.without_edge
            coarse = CircleCandidate(*map(float, fit.centre_and_radius), 0.0, fit.polarity)
            again = fit_rim(crop, coarse, self.parameters.min_coverage, hidden)
            if again is None:
                return None, gamma
            still = _is_equal(again, fit)
            fit = again
            if still:
                break
            gamma = self._coefficient(picture, *map(float, fit.centre_and_radius))
        usual = is_clear(gamma) or self._habit.is_usual(fit)
        return (fit if usual else None), gamma

    def _candidates(self, picture: Picture, window: Window, x: Array) -> Iterator[CircleCandidate]:
        """The predicted circle, then those of the detector: which is called only if it is needed."""
        yield CircleCandidate(window.u_px, window.v_px, max(float(x[2]), 3.0), np.inf, self._polarity)
        found = sorted(self.detector(picture, window), key=self._preference, reverse=True)
        yield from found[: self.parameters.candidates]

    def _preference(self, c: CircleCandidate) -> float:
        """The score of a candidate, halved if its polarity is not that of the tracked rim."""
        return c.score * (1.0 if c.polarity in (0, self._polarity) else 0.5)

    @property
    def _polarity(self) -> int:
        return 0 if self._fit is None else self._fit.polarity

    def _gate(self, fit: RimFit) -> float:
        """The innovation gate: wide for a rim that is seen whole, since the target may turn faster than modelled."""
        return self.parameters.gate_chi2 * (_WHOLE_GATE if fit.coverage > _WHOLE else 1.0)

    def _coefficient(self, picture: Picture, u_px: float, v_px: float, radius_px: float) -> float:
        if self._appearance is None or radius_px < 2:
            return np.nan
        self._cells = disc_cells(picture, u_px, v_px, radius_px)
        return self._appearance.coefficient(*self._cells)

    def _noise(self, fit: RimFit, gamma: float) -> Array:
        """R = R0 / (1 - gamma)^2 with the covariance of the fit as R0."""
        return fit.covariance_px2 / (1 - gamma) ** 2

    def _updated(self, picture: Picture, fit: RimFit, gamma: float, predicted: Array) -> CircleFrame:
        assert self._bank is not None and self._appearance is not None and self._habit is not None
        z, R = fit.centre_and_radius, self._noise(fit, gamma)
        self._bank = self._bank.updated(z, R, self.parameters.forgetting)
        if is_clear(gamma):
            self._appearance = self._appearance.updated(*self._cells)
            self._habit = self._habit.updated(fit)
            if self._measured >= _CONFIRMED:
                self._trusted = fit
        self._fit, self._misses, self._measured = fit, 0, self._measured + 1
        x, P = self._bank.state()
        return CircleFrame(PoseStatus.MEASURED, Cause.NONE, x, P, predicted, fit, gamma)

    def _acquired(self, picture: Picture, predicted: Array) -> CircleFrame:
        """Search the whole picture: for any circle, or for one like that which was lost."""
        self._searches += 1
        before = self._trusted if self._searches <= _FORGOTTEN else None
        wanted = Wanted(
            near_px=self.near_px if self._trusted is None else None,
            within_px=20.0,
            radius_px=None if before is None else before.rim.radius_px,
            polarity=0 if before is None else before.polarity,
        )
        found = acquire(picture, self.detector, self.parameters, wanted)
        if found.found is None:
            ambiguous = len(found.circles) > 1
            event = "ambiguous" if ambiguous and not self._ambiguous else ""
            self._ambiguous = ambiguous
            cause = Cause.AMBIGUOUS if ambiguous else Cause.NOT_FOUND
            return replace(self._without(cause, predicted, np.nan, event=event), circles=len(found.circles))
        return self._started(picture, found, predicted, "acquired" if self._trusted is None else "reacquired")

    def _started(
        self, picture: Picture, found: Acquisition, predicted: Array, event: str, keep: bool = False
    ) -> CircleFrame:
        """Begin to track a circle. keep: it looks as before, so that its appearance stays known."""
        assert found.found is not None
        fit, p = found.found, self.parameters
        z, R = fit.centre_and_radius, fit.covariance_px2
        rate = _START_RATE_RADII * fit.rim.radius_px
        self._bank = FilterBank.started(z, R, rate, p.accelerations_px, p.radius_share)
        if not keep:
            self._appearance = first_appearance(*disc_cells(picture, *map(float, z)))
            self._habit = RimHabit(fit.sectors, fit.rms_px, 1)
        self._fit, self._misses, self._measured, self._ambiguous, self._searches = fit, 0, 1, False, 0
        x, P = self._bank.state()
        gamma = float(np.clip(1 - fit.coverage, 0.0, 1.0))  # no appearance is known yet: the share of the rim
        return CircleFrame(PoseStatus.MEASURED, Cause.NONE, x, P, predicted, fit, gamma, len(found.circles), event)

    def _found_elsewhere(self, picture: Picture, predicted: Array) -> CircleFrame | None:
        """The circle outside the window, or with a changed appearance: one that is well seen and has its radius."""
        assert self._fit is not None and self._bank is not None
        like = self._fit if self._trusted is None else self._trusted
        radius = float(np.clip(self._bank.state()[0][2], 0.7 * like.rim.radius_px, 1.4 * like.rim.radius_px))
        wanted = Wanted(radius_px=radius, radius_factor=1.3, polarity=like.polarity)
        found = acquire(picture, self.detector, self.parameters, wanted)
        if found.found is None:
            return None
        cells = disc_cells(picture, *map(float, found.found.centre_and_radius))
        if self._appearance is not None and is_clear(self._appearance.coefficient(*cells)):
            return self._started(picture, found, predicted, "reacquired", keep=True)
        # After a longer gap the appearance of the own circle may have changed; a partly hidden one is not believed.
        late = self._misses >= _CHANGED * self.parameters.search_after
        return self._started(picture, found, predicted, "reacquired") if late and found.found.coverage > _WHOLE else None

    def _without(self, cause: Cause, predicted: Array, gamma: float, event: str = "") -> CircleFrame:
        """A frame without a measurement: predicted, or lost."""
        if self._bank is not None:
            x, P = self._bank.state()
            sigma = float(np.sqrt(max(P[0, 0], P[1, 1])))
            if sigma <= self.parameters.lost_sigma_radii * max(float(x[2]), 1.0) and x[2] > 2:
                return CircleFrame(PoseStatus.PREDICTED, cause, x, P, predicted, None, gamma, event=event)
            self._bank, event = None, "lost"
        nan = np.full(6, np.nan)
        return CircleFrame(PoseStatus.LOST, cause, nan, np.full((6, 6), np.nan), predicted, None, gamma, event=event)


def _is_equal(one: RimFit, other: RimFit) -> bool:
    away = np.abs(one.centre_and_radius - other.centre_and_radius)
    return bool(one.polarity == other.polarity and away.max() < 0.05)
