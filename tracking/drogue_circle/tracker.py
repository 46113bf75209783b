"""Finds the circle of a drogue in the whole picture and follows it; several circles make the choice ambiguous."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from math import erf

import cv2
import numpy as np

from geometry.arrays import Array, Bools
from tracking.drogue_circle.detectors import CircleCandidate, CircleDetector, CircleParameters, Edge, Window
from tracking.drogue_circle.kalman import FilterBank, motion_models
from tracking.drogue_circle.occlusion import Appearance, RimHabit, disc_cells, first_appearance, is_clear
from tracking.drogue_circle.rim_fit import CORRELATED_PX, RimFit, SmoothCrop, fit_rim, smooth_crop
from tracking.noise import Picture
from tracking.statuses import Cause, PoseStatus

_MOST_FITTED = 24  # of the whole picture
# Distance from a circle that led to no fit, from which another one is tried: the first rays are 4 px long.
_AGAIN_PX = 2.0
_SAME_CENTRE = 0.6  # distance of two centres, as a share of the larger radius, below which they are one target
_RIM_SHARE = 0.92  # score of the outermost circle of a target, as a share of the best one's, that makes it the rim
_LEAST_POINTS = 12  # independent edge points: texture often gives a short arc of a small circle
# Residuals of the rim points, RMS: share of the radius, and px. Of plain and ribbed discs they are .10 to .16 px, of
# textured ones of 27 px .3 px, of the round outlines of clouds, fields and waves .5 to .8 px at 9 to 19 px. Crowns of
# trees and shreds of cloud of 8 to 10 px have .03 to .037 of the seen radius (times the coverage), targets of 8 to
# 22 px .01 to .023.
_LARGEST_RMS = 0.012, 0.15, 0.026  # the last one a share of the seen radius
_START_RMS = 0.05, 0.35, np.inf  # the same before `_best_near`: a mixture of rims has larger ones
_CORNER_PX = 0.3  # error of an edge next to a gap of the rim, from the blurred corner of rim and occluder
_EDGE_SHARE = 0.6  # score of another edge of a target, as a share of the best one's
_THIN, _OPENING = 0.85, 0.9  # radii of the inner edge of a thin rim and of an opening, as shares of the outer edge's
_REACH, _MOST_EDGES = 3.2, 10  # of the search for other edges: radii, and number
_APART = 0.99  # radius of another edge, the same
# Starts of `_best_near`: shift of the centre and change of the radius, as shares of the radius.
_SHIFT, _SHIFTS, _GROWTH = 0.12, 6, (0.9, 1.0, 1.1)
_MOST_SHIFT_PX = 3.0  # of a start: large drogues move by pixels, not by shares of their radius
_ON_RIM = 0.03, 0.3  # of `_clean_share`: share of the radius, and least distance, px
_CLEAN = 0.95  # a rim of which this share is clean is none of two: of a mixture each is seen in part


@dataclass(frozen=True, slots=True)
class Wanted:
    """What is known about the circle before it is found; None: unknown."""

    near_px: tuple[float, float] | None = None  # its centre, within `within_px`
    within_px: float = 0.0
    radius_px: float | None = None  # within a factor of `radius_factor`
    radius_factor: float = 1.5
    polarity: int = 0


@dataclass(frozen=True, slots=True)
class Acquisition:
    """The outcome of a search of the whole picture."""

    found: RimFit | None  # None: no circle, or the choice is ambiguous
    circles: tuple[RimFit, ...]  # all separate circles, the best first
    edges: tuple[RimFit, ...] = ()  # of the best one, the outermost first


def acquire(picture: Picture, detector: CircleDetector, p: CircleParameters, wanted: Wanted) -> Acquisition:
    """Search the whole picture for the circle. Circles about one centre are the edges of one target.

    Where nothing is known about the radius, the edge that `p` asks for is returned.
    """
    fits = sorted(_fitted(picture, detector(picture, None), p, wanted), key=lambda f: -f.score)
    targets: list[RimFit] = []
    edges: tuple[RimFit, ...] = ()
    while fits:
        own = [f for f in fits if _is_same(f, fits[0])]
        # The inner circles of a target may be off its centre: those of a drogue lie deeper.
        targets.append(_supported(own))
        edges = edges or _edges([*own, *_about(picture, targets[0], p)])
        fits = [f for f in fits if not any(f is o for o in own) and not _is_same(f, targets[-1])]
    clear = len(targets) == 1 or (len(targets) > 1 and targets[1].score < p.ambiguous_share * targets[0].score)
    found = None
    if clear:
        found = targets[0] if wanted.radius_px is not None else _chosen(edges, targets[0], p.edge)
    return Acquisition(found, tuple(targets), edges)


def _supported(fits: Sequence[RimFit]) -> RimFit:
    """The outermost of the fits that are supported about as well as the best one."""
    best = max(f.score for f in fits)
    return max((f for f in fits if f.score >= _RIM_SHARE * best), key=lambda f: f.rim.radius_px)


def _about(picture: Picture, fit: RimFit, p: CircleParameters) -> list[RimFit]:
    """More edges about the centre of a fit: the steepest places of the mean grey value along its radius.

    The reduced pictures of the search do not show both edges of a thin rim.
    """
    u, v, radius = fit.centre_and_radius
    reach = min(_REACH * radius, p.max_radius_px or 0.5 * max(picture.shape[:2]))
    crop = smooth_crop(picture, Window(u, v, reach + 10, 0.0, 0.0, 0.0), p.blur_px)
    size = (int(2 * (reach + 4)), 256)  # rows are directions, columns half pixels of the radius
    flags = cv2.WARP_POLAR_LINEAR | cv2.WARP_FILL_OUTLIERS
    polar = cv2.warpPolar(crop.values, size, (u - crop.left, v - crop.top), size[0] / 2, flags)
    slope = np.gradient(polar.astype(float), axis=1).mean(axis=0)
    steep = np.abs(slope)
    peaks = 1 + np.flatnonzero((steep[1:-1] >= steep[:-2]) & (steep[1:-1] > steep[2:]))
    peaks = peaks[peaks >= 2 * p.min_radius_px]
    fits = []
    for i in peaks[np.argsort(-steep[peaks])][:_MOST_EDGES].tolist():
        start = CircleCandidate(u, v, i / 2, 0.0, int(np.sign(slope[i])))
        edge = fit_rim(crop, start, p.acquire_coverage, sure=True)
        if edge is not None and is_certain(edge) and _is_same(edge, fit):
            fits.append(edge)
    return fits


def _edges(own: Sequence[RimFit]) -> tuple[RimFit, ...]:
    """The separate edges of a target, the outermost first. own: its fits."""
    edges: list[RimFit] = []
    own = sorted(own, key=lambda f: -f.score)
    for f in own:
        again = any(f.polarity == e.polarity and _APART < f.rim.radius_px / e.rim.radius_px < 1 / _APART for e in edges)
        if f.score >= _EDGE_SHARE * own[0].score and not again:
            edges.append(f)
    return tuple(sorted(edges, key=lambda f: -f.rim.radius_px))


def _chosen(edges: Sequence[RimFit], supported: RimFit, edge: Edge) -> RimFit | None:
    """The wanted edge of a target; None where it does not show."""
    if edge is Edge.SUPPORTED:
        return supported
    outer = edges[0]
    if edge is Edge.OUTER:
        return outer
    share = [(f, f.rim.radius_px / outer.rim.radius_px) for f in edges[1:]]
    if edge is Edge.INNER:
        return next((f for f, r in share if r > _THIN and f.polarity != outer.polarity), None)
    inside = [f for f, r in share if r < _OPENING]
    return _supported(inside) if inside else None


def _fitted(
    picture: Picture, candidates: Sequence[CircleCandidate], p: CircleParameters, wanted: Wanted
) -> list[RimFit]:
    """The candidates that fit a rim and what is wanted."""
    fits: list[RimFit] = []
    tried: list[tuple[CircleCandidate, float]] = []  # and how near another one leads to the same fit, px
    for c in candidates:
        if len(tried) >= _MOST_FITTED:
            break
        coarse = c.u_px, c.v_px, c.radius_px, c.polarity
        if not _may_be(*coarse, wanted, 0.3 * c.radius_px + 4, 1.3) or any(_is_near(c, *t) for t in tried):
            continue
        half = 1.3 * c.radius_px + 10
        window = Window(c.u_px, c.v_px, half, p.gate_px, p.min_radius_px, 2 * c.radius_px)
        crop = smooth_crop(picture, window, p.blur_px)
        fit = fit_rim(crop, c, p.acquire_coverage)
        tried.append((c, _AGAIN_PX if fit is None else np.inf))
        if fit is not None and is_certain(fit, _START_RMS):
            fit = _best_near(crop, fit, p)
        largest = p.max_radius_px or 0.5 * max(picture.shape[:2])
        if (
            fit is not None
            and p.min_radius_px <= fit.rim.radius_px <= largest
            and is_certain(fit)
            and _may_be(fit.rim.u_px, fit.rim.v_px, fit.rim.radius_px, fit.polarity, wanted)
        ):
            fits.append(fit)
    return fits


def _best_near(crop: SmoothCrop, fit: RimFit, p: CircleParameters) -> RimFit:
    """The best fit from starts around a fit.

    Several rims next to each other, of which each is seen in part, have a local optimum of points of two of them: a
    mixture. A start next to one of the rims leads to it alone, with smaller residuals.
    """
    u, v, radius = fit.centre_and_radius
    step = min(_SHIFT * radius, _MOST_SHIFT_PX)
    angles = 2 * np.pi * np.arange(_SHIFTS) / _SHIFTS
    shifts = [(0.0, 0.0), *zip((step * np.cos(angles)).tolist(), (step * np.sin(angles)).tolist(), strict=True)]
    best, share = fit, _clean_share(fit)
    for du, dv in shifts:
        for growth in _GROWTH:
            if share > _CLEAN:
                return best
            start = CircleCandidate(u + du, v + dv, growth * radius, 0.0, fit.polarity)
            other = fit_rim(crop, start, p.acquire_coverage, sure=True)
            if other is not None and _clean_share(other) > share:
                best, share = other, _clean_share(other)
    return best


def _clean_share(fit: RimFit) -> float:
    """Share of the rim with edge points next to the circle, if their residuals are normal."""
    near = max(_ON_RIM[0] * fit.rim.radius_px, _ON_RIM[1])
    return fit.coverage * erf(near / (np.sqrt(2) * max(fit.rms_px, 1e-3)))


def is_certain(fit: RimFit, largest_rms: tuple[float, float, float] = _LARGEST_RMS) -> bool:
    """Whether a rim has enough precise edge points that texture does not imitate it."""
    (share, px, seen_share), radius = largest_rms, fit.rim.radius_px
    seen_px = fit.coverage * radius
    largest = np.hypot(min(share * radius + px, seen_share * seen_px), _CORNER_PX * np.sqrt(fit.beside_gaps))
    return bool(2 * np.pi * seen_px / CORRELATED_PX >= _LEAST_POINTS and fit.rms_px <= largest)


def _may_be(
    u_px: float, v_px: float, radius_px: float, polarity: int, wanted: Wanted, off_px: float = 0.0, ratio: float = 1.0
) -> bool:
    """Whether a circle may be the wanted one. off_px, ratio: errors of a coarse centre and radius."""
    near, factor = wanted.near_px, ratio * wanted.radius_factor
    if near is not None and np.hypot(u_px - near[0], v_px - near[1]) > wanted.within_px + off_px:
        return False
    if wanted.radius_px is not None and not 1 / factor <= radius_px / wanted.radius_px <= factor:
        return False
    return not wanted.polarity or polarity in (0, wanted.polarity)


def _is_near(c: CircleCandidate, other: CircleCandidate, within_px: float) -> bool:
    """Whether two coarse circles are the same, if circles within some px are."""
    close = np.hypot(c.u_px - other.u_px, c.v_px - other.v_px) < min(max(2.0, 0.15 * c.radius_px), within_px)
    return bool(close and abs(c.radius_px - other.radius_px) < 2.5 and c.polarity == other.polarity)


def _is_same(fit: RimFit, other: RimFit) -> bool:
    away = np.hypot(fit.rim.u_px - other.rim.u_px, fit.rim.v_px - other.rim.v_px)
    return bool(away < _SAME_CENTRE * max(fit.rim.radius_px, other.rim.radius_px))


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
# Share of the sectors that look different, above which a rim that shows as much as usual is that of a target that has
# turned: its inside, which lies deeper, moves against the rim, and an occluder of so many sectors would hide the rim.
_TURNED = 0.25
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
        cells = disc_cells(picture, *fit.centre_and_radius)
        habit = RimHabit(fit.sectors, 1)
        return cls(_bank_at(fit, p), first_appearance(*cells), habit, fit, cells)

    def state(self) -> tuple[Array, Array]:
        """State (6,) and covariance (6, 6), with what averaging over pictures does not reduce of the last fit's."""
        x, P = self.bank.state()
        R = self.fit.covariance_px2
        averaged = max(1 - np.trace(P[:2, :2]) / np.trace(R[:2, :2]), 0.0)
        P[:3, :3] += averaged * self.fit.lasting * R
        return x, P

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
        gamma = self._coefficient(picture, *fit.centre_and_radius)
        least = p.min_coverage * self.habit.coverage  # of the rim that shows in clear frames
        for _ in range(_REFITS):
            hidden = self.appearance.hidden_sectors(*self.cells)
            turned = hidden.mean() > _TURNED and fit.coverage >= _USUAL * self.habit.coverage
            if turned or not hidden.any():
                break
            u, v, radius = fit.centre_and_radius
            coarse = CircleCandidate(u, v, radius, 0.0, fit.polarity)
            again = fit_rim(crop, coarse, least, hidden | self.habit.without_edge)
            if again is None:
                return None, gamma
            still, fit = again.is_equal(fit), again
            if still:
                break
            gamma = self._coefficient(picture, *fit.centre_and_radius)
        return fit, gamma

    def _candidates(
        self, picture: Picture, window: Window, detector: CircleDetector, p: CircleParameters
    ) -> Iterator[CircleCandidate]:
        """The predicted circle, then those of the detector: which is called only if it is needed."""
        radius = 0.5 * (window.min_radius_px + window.max_radius_px)
        yield CircleCandidate(window.u_px, window.v_px, radius, np.inf, self.fit.polarity)
        yield from detector(picture, window)[: p.candidates]

    def _coefficient(self, picture: Picture, u_px: float, v_px: float, radius_px: float) -> float:
        self.cells = disc_cells(picture, u_px, v_px, radius_px)
        return self.appearance.coefficient(*self.cells)


def _bank_at(fit: RimFit, p: CircleParameters) -> FilterBank:
    rate = _START_RATE_RADII * fit.rim.radius_px
    models = motion_models(p.accelerations_px, p.jerks_px, p.radius_share)
    return FilterBank.started(fit.centre_and_radius, fit.covariance_px2, rate, models)


# The circle in one frame: status, cause, state, and the fit behind it.


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
    found: int = 0  # separate circles, where the whole picture was searched
    event: str = ""  # acquired, reacquired, lost, ambiguous
    edges_px: tuple[float, ...] = ()  # radii of the edges of the target that was acquired, the outermost first

    @property
    def place(self) -> Array:
        """u, v, radius (3,), px."""
        return self.state[:3]

    @property
    def sigmas(self) -> Array:
        """Standard deviations (3,) of `place`."""
        return np.sqrt(np.diag(self.covariance))[:3]


def nothing_known(cause: Cause, event: str = "") -> CircleFrame:
    """A lost frame."""
    nan = np.full(6, np.nan)
    return CircleFrame(PoseStatus.LOST, cause, nan, np.full((6, 6), np.nan), nan[:3], None, np.nan, event=event)


# Tracks one circle through pictures: Zhou (2014), figure 2, with a rim fit, a sound noise model and acquisition.


_CONFIRMED = 3  # measurements after which an acquisition is confirmed: till then each is as certain as the first one
_CHANGED = 4  # searches of the whole picture after which a circle of another appearance is accepted
_FORGOTTEN = 50  # searches for a circle like the lost one, after which any circle is accepted
_COMPARED_RADII = 0.25  # largest sigma of a predicted place, in radii, of which the occlusion coefficient is reported
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
        if fit is not None and gamma < self.parameters.occluded and (track.measured >= _CONFIRMED or is_certain(fit)):
            track.update(fit, gamma, self.parameters)
            if is_clear(gamma) and track.measured > _CONFIRMED:
                self._trusted = fit
            x, P = track.state()
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
        if is_clear(track.appearance.coefficient(*disc_cells(picture, *search.found.centre_and_radius))):
            track.restart(search.found, self.parameters)
        # After a longer gap the appearance of the own circle may have changed; a partly hidden one is not believed.
        elif track.misses >= _CHANGED * self.parameters.search_after and search.found.coverage > WHOLE:
            self._track = track = Track.started(picture, search.found, self.parameters)
        else:
            return None
        return self._at_start(track, predicted, len(search.circles), "reacquired")

    def _at_start(self, track: Track, predicted: Array, found: int, event: str) -> CircleFrame:
        """The frame of an acquisition. No appearance is known yet: the coefficient is that of the rim."""
        x, P = track.state()
        gamma = float(np.clip(1 - track.fit.coverage, 0.0, 1.0))
        return CircleFrame(PoseStatus.MEASURED, Cause.NONE, x, P, predicted, track.fit, gamma, found, event)

    def _unmeasured(self, track: Track, cause: Cause, predicted: Array, gamma: float) -> CircleFrame:
        """A frame without a measurement: predicted, or lost."""
        x, P = track.state()
        sigma = float(np.sqrt(max(P[0, 0], P[1, 1])))
        certain = sigma <= self.parameters.lost_sigma_radii * max(float(x[2]), 1.0)
        gamma = gamma if sigma <= _COMPARED_RADII * x[2] else np.nan  # of a place where the target may not be
        if certain and x[2] > 2 and track.misses <= self.parameters.most_predicted:
            return CircleFrame(PoseStatus.PREDICTED, cause, x, P, predicted, None, gamma)
        self._track = None
        return replace(nothing_known(cause, "lost"), predicted=predicted, occlusion=gamma)
