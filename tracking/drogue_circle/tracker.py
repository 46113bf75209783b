"""Follows the circle of a drogue: what is known of it, and the steps from picture to picture."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from geometry.arrays import Array, Bools
from tracking.drogue_circle.acquisition import Wanted, acquire
from tracking.drogue_circle.candidates import CircleCandidate, CircleDetector, Picture, Window
from tracking.drogue_circle.kalman import FilterBank, motion_models
from tracking.drogue_circle.occlusion import Appearance, RimHabit, disc_cells, first_appearance, is_clear
from tracking.drogue_circle.parameters import CircleParameters
from tracking.drogue_circle.rim_fit import CircleFrame, RimFit, SmoothCrop, fit_rim, nothing_known, smooth_crop
from tracking.statuses import Cause, PoseStatus

# The circle that is followed: its filters, its appearance, and its measurement in a window of the picture.

_START_RATE_RADII = 0.25  # 1 sigma of the rate of a new circle, in radii per frame
_COVERAGE_COST, _POLARITY_COST = 40.0, 15.0  # against distance^2, of a whole rim and of the other polarity
_AS_PREDICTED, _WELL_SEEN = 16.0, 0.75  # distance^2 and coverage of a fit that needs no comparison with others
_SURE_PX, _SETTLED = 0.7, 5  # sigma of a prediction, and measurements before it, from which the fit may start
_USUAL = 0.9  # of the usual coverage, the same
WHOLE = 0.85  # coverage of a rim that is seen whole
_GATE_PX2 = 0.1**2 * np.eye(3)  # of the gate: a rim is not a perfect circle
_WHOLE_GATE = 10.0  # factor of the innovation gate of such a rim
_REFITS = 2  # without the sectors of an occluder
_LEAST_RADIUS = 0.7  # of the smallest radius of an acquisition, below which a circle is not tracked


@dataclass(slots=True)
class Track:
    """The circle that is followed."""

    bank: FilterBank
    appearance: Appearance
    habit: RimHabit
    fit: RimFit  # the last one
    cells: tuple[Array, Bools]  # of the disc that was last compared with the appearance
    misses: int = 0  # frames since the last measurement
    measured: int = 1  # frames with a measurement since the acquisition

    @classmethod
    def started(cls, picture: Picture, fit: RimFit, p: CircleParameters) -> Track:
        """A track that begins with a circle of the whole picture, at rest within a quarter of its radius per frame."""
        cells = disc_cells(picture, *fit.circle)
        habit = RimHabit(fit.sectors, fit.rms_px, 1)
        return cls(_bank_at(fit, p), first_appearance(*cells), habit, fit, cells)

    def restart(self, fit: RimFit, p: CircleParameters) -> None:
        """Continue at another place; the target looks as before."""
        self.bank, self.fit, self.misses, self.measured = _bank_at(fit, p), fit, 0, 1

    def window(self, p: CircleParameters) -> Window:
        """The search window around the prediction: four radii wide, larger where the prediction is uncertain."""
        x, P = self.bank.state()
        sigma = float(np.sqrt(max(P[0, 0], P[1, 1])))
        radius = max(float(x[2]), 3.0)
        gate = max(p.gate_px, min(3 * sigma, 2 * radius))
        change = max(p.radius_gate * radius, min(3 * float(np.sqrt(P[2, 2])), 0.5 * radius), 2.0)
        half = max(0.5 * p.window_radii * radius, 1.15 * radius + gate)
        return Window(float(x[0]), float(x[1]), half, gate, max(radius - change, 3.0), radius + change)

    def measure(self, picture: Picture, detector: CircleDetector, p: CircleParameters) -> tuple[RimFit | None, float]:
        """The best rim in the window, and the occlusion coefficient there or, without a rim, at the prediction."""
        window = self.window(p)
        crop = smooth_crop(picture, window, p.blur_px)
        x, P = self.bank.state()
        sure = bool(max(P[0, 0], P[1, 1], P[2, 2]) < _SURE_PX**2) and self.measured > _SETTLED
        best, best_cost = None, np.inf
        fitted: list[RimFit] = []
        for c in self._candidates(picture, window, detector, p):
            fit = fit_rim(crop, c, p.min_coverage, sure=True) if sure else None
            if fit is None or fit.coverage < _USUAL * self.habit.coverage:
                fit = fit_rim(crop, c, p.min_coverage)
            sure = False  # of the first candidate only, the prediction
            if fit is None or any(fit.is_equal(f) for f in fitted):
                continue
            fitted.append(fit)
            # A rim that is seen whole may be where any of the filters expects it, since the target may turn.
            d2 = self.bank.distance2(fit.centre_and_radius, fit.covariance_px2 + _GATE_PX2, fit.coverage > WHOLE)
            near = np.hypot(fit.rim.u_px - window.u_px, fit.rim.v_px - window.v_px) < window.gate_px
            gate = p.gate_chi2 * (_WHOLE_GATE if fit.coverage > WHOLE else 1.0)
            if not near or d2 > gate or fit.rim.radius_px < _LEAST_RADIUS * p.min_radius_px:
                continue
            cost = d2 - _COVERAGE_COST * fit.coverage + (_POLARITY_COST if fit.polarity != self.fit.polarity else 0)
            if cost < best_cost:
                best, best_cost = fit, cost
            if d2 < _AS_PREDICTED and fit.coverage > min(_WELL_SEEN, _USUAL * self.habit.coverage):
                break  # before the detector is called, where the prediction itself fits
        if best is None:
            return None, self._coefficient(picture, window.u_px, window.v_px, max(float(x[2]), 1.0))
        return self._without_occluder(picture, crop, best, p)

    def update(self, fit: RimFit, gamma: float, p: CircleParameters) -> None:
        """Use a measurement: R = R0 / (1 - gamma)^2 with the covariance of the fit as R0."""
        self.bank = self.bank.updated(fit.centre_and_radius, fit.covariance_px2 / (1 - gamma) ** 2, p.forgetting)
        self.appearance = self.appearance.updated(*self.cells)
        if is_clear(gamma):
            self.habit = self.habit.updated(fit)
        self.fit, self.misses, self.measured = fit, 0, self.measured + 1

    def _without_occluder(
        self, picture: Picture, crop: SmoothCrop, fit: RimFit, p: CircleParameters
    ) -> tuple[RimFit | None, float]:
        """The fit without the edges in sectors that an occluder hides: they pull the circle to one side."""
        gamma = self._coefficient(picture, *fit.circle)
        for _ in range(_REFITS):
            hidden = self.appearance.hidden_sectors(*self.cells)
            if not hidden.any():
                break
            u, v, radius = fit.circle
            coarse = CircleCandidate(u, v, radius, 0.0, fit.polarity)
            again = fit_rim(crop, coarse, p.min_coverage, hidden | self.habit.without_edge)
            if again is None:
                return None, gamma
            still, fit = again.is_equal(fit), again
            if still:
                break
            gamma = self._coefficient(picture, *fit.circle)
        usual = is_clear(gamma) or self.habit.is_usual(fit)
        return (fit if usual else None), gamma

    def _candidates(
        self, picture: Picture, window: Window, detector: CircleDetector, p: CircleParameters
    ) -> Iterator[CircleCandidate]:
        """The predicted circle, then those of the detector: which is called only if it is needed."""
        radius = 0.5 * (window.min_radius_px + window.max_radius_px)
        yield CircleCandidate(window.u_px, window.v_px, radius, np.inf, self.fit.polarity)
        yield from sorted(detector(picture, window), key=self._preference, reverse=True)[: p.candidates]

    def _preference(self, c: CircleCandidate) -> float:
        """The score of a candidate, halved if its polarity is not that of the tracked rim."""
        return c.score * (1.0 if c.polarity in (0, self.fit.polarity) else 0.5)

    def _coefficient(self, picture: Picture, u_px: float, v_px: float, radius_px: float) -> float:
        self.cells = disc_cells(picture, u_px, v_px, radius_px)
        return self.appearance.coefficient(*self.cells)


def _bank_at(fit: RimFit, p: CircleParameters) -> FilterBank:
    rate = _START_RATE_RADII * fit.rim.radius_px
    models = motion_models(p.accelerations_px, p.jerks_px, p.radius_share)
    return FilterBank.started(fit.centre_and_radius, fit.covariance_px2, rate, models)


# Tracks one circle through pictures: Zhou (2014), figure 2, with a rim fit, a sound noise model and acquisition.


_CONFIRMED = 3  # measurements after which an acquisition is confirmed
_CHANGED = 4  # searches of the whole picture after which a circle of another appearance is accepted
_FORGOTTEN = 50  # searches for a circle like the lost one, after which any circle is accepted
_NEAR_PX = 20.0  # distance of the first circle from the place that the user states


@dataclass(slots=True)
class CircleTracker:
    """The state between frames. `detector` returns coarse circles; the rim fit is the same for all detectors."""

    detector: CircleDetector
    parameters: CircleParameters = field(default_factory=CircleParameters)
    near_px: tuple[float, float] | None = None  # of the first circle, if the user knows it
    _track: Track | None = None
    _trusted: RimFit | None = None  # the last clear fit of a confirmed circle
    _searches: int = 0  # of the whole picture since the circle was lost
    _ambiguous: bool = False

    def step(self, picture: Picture | None, dt: float = 1.0) -> CircleFrame:
        """The next frame. picture None: there is none. dt: frames since the last step."""
        track = self._track
        if track is None:
            return nothing_known(Cause.NO_IMAGE) if picture is None else self._acquired(picture)
        track.bank = track.bank.predicted(dt)
        predicted = track.bank.state()[0][:3]
        if picture is None:
            track.misses += 1
            return self._unmeasured(track, Cause.NO_IMAGE, predicted, np.nan)
        fit, gamma = track.measure(picture, self.detector, self.parameters)
        if fit is not None and gamma < self.parameters.occluded:
            track.update(fit, gamma, self.parameters)
            if is_clear(gamma) and track.measured > _CONFIRMED:
                self._trusted = fit
            x, P = track.bank.state()
            return CircleFrame(PoseStatus.MEASURED, Cause.NONE, x, P, predicted, fit, gamma)
        track.misses += 1
        if track.measured < _CONFIRMED <= track.misses:
            self._track = None  # a false acquisition: no later frame confirms it
            return replace(nothing_known(Cause.NOT_FOUND, "lost"), predicted=predicted)
        if track.misses % self.parameters.search_after == 0:
            again = self._found_elsewhere(track, picture, predicted)
            if again is not None:
                return again
        height, width = picture.shape[:2]
        outside = not (-0.5 <= predicted[0] < width - 0.5 and -0.5 <= predicted[1] < height - 0.5)
        hidden = gamma >= self.parameters.occluded
        cause = Cause.OUT_OF_VIEW if outside else Cause.OCCLUDED if hidden else Cause.NOT_FOUND
        return self._unmeasured(track, cause, predicted, gamma)

    def _acquired(self, picture: Picture) -> CircleFrame:
        """Search the whole picture: for any circle, or for one like that which was lost."""
        self._searches += 1
        before = self._trusted if self._searches <= _FORGOTTEN else None
        wanted = Wanted(
            near_px=self.near_px if self._trusted is None else None,
            within_px=_NEAR_PX,
            radius_px=None if before is None else before.rim.radius_px,
            polarity=0 if before is None else before.polarity,
        )
        search = acquire(picture, self.detector, self.parameters, wanted)
        ambiguous = search.found is None and len(search.circles) > 1
        event = "ambiguous" if ambiguous and not self._ambiguous else ""
        self._ambiguous = ambiguous
        if search.found is None:
            cause = Cause.AMBIGUOUS if ambiguous else Cause.NOT_FOUND
            return replace(nothing_known(cause, event), found=len(search.circles))
        self._track, self._searches = Track.started(picture, search.found, self.parameters), 0
        event = "acquired" if self._trusted is None else "reacquired"
        out = self._at_start(self._track, np.full(3, np.nan), len(search.circles), event)
        return replace(out, edges_px=tuple(f.rim.radius_px for f in search.edges))

    def _found_elsewhere(self, track: Track, picture: Picture, predicted: Array) -> CircleFrame | None:
        """The circle outside the window, or with a changed appearance: one that is well seen and has its radius."""
        like = track.fit if self._trusted is None else self._trusted
        radius = float(np.clip(predicted[2], 0.7 * like.rim.radius_px, 1.4 * like.rim.radius_px))
        wanted = Wanted(radius_px=radius, radius_factor=1.3, polarity=like.polarity)
        search = acquire(picture, self.detector, self.parameters, wanted)
        if search.found is None:
            return None
        if is_clear(track.appearance.coefficient(*disc_cells(picture, *search.found.circle))):
            track.restart(search.found, self.parameters)
        # After a longer gap the appearance of the own circle may have changed; a partly hidden one is not believed.
        elif track.misses >= _CHANGED * self.parameters.search_after and search.found.coverage > WHOLE:
            self._track = track = Track.started(picture, search.found, self.parameters)
        else:
            return None
        return self._at_start(track, predicted, len(search.circles), "reacquired")

    def _at_start(self, track: Track, predicted: Array, found: int, event: str) -> CircleFrame:
        """The frame of an acquisition. No appearance is known yet: the coefficient is that of the rim."""
        x, P = track.bank.state()
        gamma = float(np.clip(1 - track.fit.coverage, 0.0, 1.0))
        return CircleFrame(PoseStatus.MEASURED, Cause.NONE, x, P, predicted, track.fit, gamma, found, event)

    def _unmeasured(self, track: Track, cause: Cause, predicted: Array, gamma: float) -> CircleFrame:
        """A frame without a measurement: predicted, or lost."""
        x, P = track.bank.state()
        sigma = float(np.sqrt(max(P[0, 0], P[1, 1])))
        certain = sigma <= self.parameters.lost_sigma_radii * max(float(x[2]), 1.0)
        if certain and x[2] > 2 and track.misses <= self.parameters.most_predicted:
            return CircleFrame(PoseStatus.PREDICTED, cause, x, P, predicted, None, gamma)
        self._track = None
        return replace(nothing_known(cause, "lost"), predicted=predicted, occlusion=gamma)
