"""A circle found in the whole picture, without a prediction; several circles make the choice ambiguous."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import erf

import cv2
import numpy as np

from tracking.drogue_circle.candidates import CircleCandidate, CircleDetector, Picture, Window
from tracking.drogue_circle.parameters import CircleParameters, Edge
from tracking.drogue_circle.rim_fit import RimFit, SmoothCrop, fit_rim, smooth_crop

_MOST_FITTED = 24  # of the whole picture
_SAME_CENTRE = 0.6  # distance of two centres, as a share of the larger radius, below which they are one target
_RIM_SHARE = 0.92  # score of the outermost circle of a target, as a share of the best one's, that makes it the rim
_LEAST_POINTS = 12  # independent edge points: texture often gives a short arc of a small circle
_CORRELATED_PX = 3.5  # length of rim that counts as one point, see `rim_fit`
# Residuals of the rim points, RMS: share of the radius, and px. Of plain and ribbed discs they are .10 to .16 px, of
# textured ones of 27 px .3 px, of the round outlines of clouds, fields and waves .5 to .8 px at 9 to 19 px.
_LARGEST_RMS = 0.012, 0.15
_START_RMS = 0.05, 0.35  # the same before `_best_near`: a mixture of rims has larger ones
_EDGE_SHARE = 0.6  # score of another edge of a target, as a share of the best one's
_THIN, _OPENING = 0.85, 0.9  # radii of the inner edge of a thin rim and of an opening, as shares of the outer edge's
_REACH, _MOST_EDGES = 3.2, 10  # of the search for other edges: radii, and number
_APART = 0.99  # radius of another edge, the same
# Starts of `_best_near`: shift of the centre and change of the radius, as shares of the radius.
_SHIFT, _SHIFTS, _GROWTH = 0.12, 6, (0.9, 1.0, 1.1)
_MOST_SHIFT_PX = 3.0
_ON_RIM = 0.03, 0.3  # of `_clean_share`: share of the radius, and least distance, px


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
    u, v, radius = fit.circle
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
    tried: list[CircleCandidate] = []
    for c in candidates:
        if len(tried) >= _MOST_FITTED:
            break
        if not _may_be(c, wanted) or any(_is_near(c, t) for t in tried):
            continue
        tried.append(c)
        half = 1.3 * c.radius_px + 10
        window = Window(c.u_px, c.v_px, half, p.gate_px, p.min_radius_px, 2 * c.radius_px)
        crop = smooth_crop(picture, window, p.blur_px)
        fit = fit_rim(crop, c, p.acquire_coverage)
        if fit is not None and is_certain(fit, _START_RMS):
            fit = _best_near(crop, fit, p)
        largest = p.max_radius_px or 0.5 * max(picture.shape[:2])
        if (
            fit is not None
            and p.min_radius_px <= fit.rim.radius_px <= largest
            and is_certain(fit)
            and _fits(fit, wanted)
        ):
            fits.append(fit)
    return fits


def _best_near(crop: SmoothCrop, fit: RimFit, p: CircleParameters) -> RimFit:
    """The best fit from starts around a fit.

    Several rims next to each other, of which each is seen in part, have a local optimum of points of two of them: a
    mixture. A start next to one of the rims leads to it alone, with smaller residuals.
    """
    u, v, radius = fit.circle
    step = min(_SHIFT * radius, _MOST_SHIFT_PX)
    angles = 2 * np.pi * np.arange(_SHIFTS) / _SHIFTS
    shifts = [(0.0, 0.0), *zip((step * np.cos(angles)).tolist(), (step * np.sin(angles)).tolist(), strict=True)]
    best, share = fit, _clean_share(fit)
    for du, dv in shifts:
        for growth in _GROWTH:
            start = CircleCandidate(u + du, v + dv, growth * radius, 0.0, fit.polarity)
            other = fit_rim(crop, start, p.acquire_coverage, sure=True)
            if other is not None and _clean_share(other) > share:
                best, share = other, _clean_share(other)
    return best


def _clean_share(fit: RimFit) -> float:
    """Share of the rim with edge points next to the circle, if their residuals are normal."""
    near = max(_ON_RIM[0] * fit.rim.radius_px, _ON_RIM[1])
    return fit.coverage * erf(near / (np.sqrt(2) * max(fit.rms_px, 1e-3)))


def is_certain(fit: RimFit, largest_rms: tuple[float, float] = _LARGEST_RMS) -> bool:
    """Whether a rim has enough precise edge points that texture does not imitate it."""
    points = fit.coverage * 2 * np.pi * fit.rim.radius_px / _CORRELATED_PX
    return bool(points >= _LEAST_POINTS and fit.rms_px <= largest_rms[0] * fit.rim.radius_px + largest_rms[1])


def _may_be(c: CircleCandidate, wanted: Wanted) -> bool:
    """Whether a coarse circle may be the wanted one, with a margin for its errors."""
    if wanted.near_px is not None:
        away = np.hypot(c.u_px - wanted.near_px[0], c.v_px - wanted.near_px[1])
        if away > wanted.within_px + 0.3 * c.radius_px + 4:
            return False
    if wanted.radius_px is not None and not _within(c.radius_px / wanted.radius_px, 1.3 * wanted.radius_factor):
        return False
    return not (wanted.polarity and c.polarity and c.polarity != wanted.polarity)


def _fits(fit: RimFit, wanted: Wanted) -> bool:
    if wanted.near_px is not None:
        away = np.hypot(fit.rim.u_px - wanted.near_px[0], fit.rim.v_px - wanted.near_px[1])
        if away > wanted.within_px:
            return False
    if wanted.radius_px is not None and not _within(fit.rim.radius_px / wanted.radius_px, wanted.radius_factor):
        return False
    return not wanted.polarity or fit.polarity == wanted.polarity


def _within(ratio: float, factor: float) -> bool:
    return 1 / factor <= ratio <= factor


def _is_near(c: CircleCandidate, other: CircleCandidate) -> bool:
    """Whether two coarse circles are the same."""
    close = np.hypot(c.u_px - other.u_px, c.v_px - other.v_px) < max(2.0, 0.15 * c.radius_px)
    return bool(close and abs(c.radius_px - other.radius_px) < 2.5 and c.polarity == other.polarity)


def _is_same(fit: RimFit, other: RimFit) -> bool:
    away = np.hypot(fit.rim.u_px - other.rim.u_px, fit.rim.v_px - other.rim.v_px)
    return bool(away < _SAME_CENTRE * max(fit.rim.radius_px, other.rim.radius_px))
