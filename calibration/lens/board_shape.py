"""Tests whether a board is as stated: flat, with rows and columns to scale and each point in its place.

One set of photographs of one board hardly separates an error of the board from one of the lens model: both are in all
photographs, so that held-out photographs do not separate them either. A deviation is therefore solved for together
with the lens only if each half of the photographs shows it. Scale and single points, which errors of lenses and of
corners imitate more easily than a bend, must in addition explain the residuals: what is left must be noise, and with
free points directions must be known as well as before. Where a significant deviation is not solved for, the result says
by how much it would change the lens. The absolute size of the board cannot be determined from photographs. Bend has
three parameters and scale two; the displacements of single points follow Strobl and Hirzinger (2011), "More accurate
pinhole camera calibration with imperfect planar target", ICCV workshops, with their common shift, rotation and scale
fixed by wide priors instead of by three chosen points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.special import chdtrc

from calibration.least_squares.adjustment import AdjustmentError
from calibration.lens.fit.corner_table import CornerTable
from calibration.lens.fit.coverage import seen_at
from calibration.lens.fit.lens_adjustment import BRIEF, ROUGH, term_of
from calibration.lens.fit.lens_fit import LensFit, fit
from calibration.lens.fit.lens_parameters import AS_STATED, BoardFreedom, board_as_stated
from calibration.lens.fit.model_selection import difference_px
from calibration.lens.fit.projection_map import projection_map
from calibration.lens.fit.view_equations import Scatter, ViewEquations, scattered
from geometry.arrays import Array, Bools

SIGNIFICANT = 1e-3  # p-value below which a deviation from the stated board is significant
_WORSE = 1.1  # ratio of the sigmas of directions above which displaced points are not solved for
HALF_SIGNIFICANT = 0.01  # the same in each half of the photographs
EXPLAINED = 0.01  # p-value of scatter between photographs below which noise does not explain it
# Views of each point required to solve for all points. Its three unknowns take up 3 of the 16 coordinates of 8 views,
# and with them errors that differ between photographs. With 5 views they take 3 of 10: the rest then looked like noise,
# and fx of a wavy sheet of paper was 9 of its sigmas off.
_SEEN_OFTEN = 8.0
MOST_POINTS = 2000  # above it the points are not solved for: three unknowns each
_WARP, _STRETCH = slice(0, 3), slice(3, 5)  # of the shape's five parameters


@dataclass(frozen=True, slots=True)
class WarpTest:
    """Test for a bent board."""

    warp: tuple[float, float, float]  # 1/m, estimated when free
    sigma: tuple[float, float, float]
    rise_m: float  # from its lowest to its highest point
    p_value: float  # of a bend at least as large, if the board is flat
    corrected: bool
    why: str
    change_px: float  # RMS of directions over the picture by solving for it; 0 where not significant


@dataclass(frozen=True, slots=True)
class StretchTest:
    """Test whether rows and columns are to scale and at right angles."""

    stretch: float  # relative excess length along x (the rows), if the length along y is right
    lean_rad: float  # deviation of the angle between rows and columns from 90 deg
    sigma: tuple[float, float]
    p_value: float  # of a deviation at least as large, if the board is as stated
    corrected: bool
    why: str
    change_px: float  # RMS of directions over the picture by solving for it; 0 where not significant


@dataclass(frozen=True, slots=True)
class PointsTest:
    """Test for displaced single points, beyond bend and scale."""

    off_m: Array  # (P, 3), estimated displacements, less the best-fitting common shift, rotation and scale
    p_value: float  # of residuals as strongly correlated per point, if the board is as stated
    corrected: bool
    why: str
    change_px: float = 0.0  # RMS of directions over the picture by solving for them; 0 where not significant

    @property
    def rms_m(self) -> float:
        """RMS displacement within the board's plane, per point."""
        return float(np.sqrt(np.mean(np.sum(self.off_m[:, :2] ** 2, axis=1))))


@dataclass(frozen=True, slots=True)
class BoardTest:
    """The shape of the board as estimated from the photographs."""

    warp: WarpTest
    stretch: StretchTest | None  # None where the photographs do not determine it
    points: PointsTest
    fit: LensFit  # with the corrections applied

    @property
    def free(self) -> BoardFreedom:
        """The shape parameters that are solved for with the lens."""
        stretch = self.stretch is not None and self.stretch.corrected
        return BoardFreedom(self.warp.corrected, stretch, self.points.corrected)


@dataclass(frozen=True, slots=True)
class BoardShapeOptions:
    """The user's decisions; None: decided by the tests."""

    warp: bool | None = None
    stretch: bool | None = None


def board_test(table: CornerTable, found: LensFit, options: BoardShapeOptions = BoardShapeOptions()) -> BoardTest:
    """Test each kind of deviation, and solve for those that are accepted.

    found: a fit of a lens model that is rich enough not to attribute its own error to the board. Raises
    AdjustmentError: not even the bend can be determined.
    """
    # The board as stated, its circles as measured.
    stated = {**board_as_stated(len(table.board_points)), "radius": found.values["radius"]}
    # Of a board far from its statement the steps remain short ones: the evidence is linear about where they end.
    flat = fit(table, found.used, found.model, {**found.values, **stated}, AS_STATED, limits=ROUGH)
    bent = fit(table, flat.used, flat.model, flat.values, BoardFreedom(warp=True), limits=ROUGH)
    test = _Evidence.of(table, bent)
    warp, why = test.bent()
    if options.warp is not None:
        warp, why = options.warp, "as requested"
    C = test.covariance
    sigmas = np.sqrt(np.maximum(np.diagonal(C), 0))
    change = _change_px(table, flat, bent) if test.p_warp < SIGNIFICANT else 0.0
    warp_test = WarpTest(
        tuple(test.shape[_WARP]), tuple(sigmas[_WARP]), rise(table, bent), test.p_warp, warp, why, change
    )  # fmt: skip
    kept, stretch_test = (bent if warp else flat), None
    if len(test.shape) > 3:
        (stretch, why), change = test.stretched(), 0.0
        if options.stretch is not None:
            stretch, why = options.stretch, "as requested"
        if stretch or test.p_stretch < SIGNIFICANT:
            freed = fit(table, kept.used, kept.model, kept.values, BoardFreedom(warp, stretch=True), limits=BRIEF)
            change = _change_px(table, kept, freed)
            kept = freed if stretch else kept
        stretch_test = StretchTest(
            float(test.shape[3]),
            float(test.shape[4]),
            (float(sigmas[3]), float(sigmas[4])),
            test.p_stretch,
            stretch,
            why,
            change,
        )
    points, kept = _points(table, kept, options, max(1.0, test.scatter.factor))
    return BoardTest(warp_test, stretch_test, points, kept)


@dataclass(frozen=True, slots=True)
class _Evidence:
    """Estimates of bend and scale by all photographs and by both halves, and the scatter once they are free."""

    shape: Array  # (5,) or, where the scale is not determined, (3,)
    covariance: Array
    halves: tuple[tuple[Array, Array], ...]  # the same two of each half; empty if a half does not determine them
    without: tuple[tuple[Array, Array], ...]  # the same two without each photograph; empty if one is indispensable
    scatter: Scatter

    @staticmethod
    def of(table: CornerTable, bent: LensFit) -> _Evidence:
        """From a fit with the bend free."""
        try:
            equations = ViewEquations.of(table, bent, BoardFreedom(warp=True, stretch=True))
            count = 5
        except AdjustmentError:
            equations, count = ViewEquations.of(table, bent), 3
        p = equations.lens
        at = slice(p, p + count)
        start = np.append(bent.warp, [0.0, 0.0])[:count]
        change, C = equations.solution()
        spread = equations.moved(change).scatter()
        raised = max(1.0, spread.factor) ** 2
        odd = np.arange(len(equations.views)) % 2 == 1

        def of_sets(sets: Sequence[Bools]) -> tuple[tuple[Array, Array], ...]:
            try:
                return tuple((start + d[at], c[at, at] * raised) for d, c in map(equations.solution, sets))
            except AdjustmentError:
                return ()

        without = of_sets(list(~np.eye(len(odd), dtype=bool)))
        return _Evidence(start + change[at], C[at, at] * raised, of_sets((odd, ~odd)), without, spread)

    @property
    def p_warp(self) -> float:
        return _p_value(self.shape[_WARP], self.covariance[_WARP, _WARP])

    @property
    def p_stretch(self) -> float:
        return _p_value(self.shape[_STRETCH], self.covariance[_STRETCH, _STRETCH])

    def _in_both_halves(self, part: slice) -> bool:
        """Whether both halves show it. A half of few photographs that cannot show what all do need only agree.

        No photograph may then be the one that shows it.
        """
        if len(self.halves) < 2:
            return False
        shown = [_p_value(x[part], C[part, part]) < HALF_SIGNIFICANT for x, C in self.halves]
        able = [_p_value(self.shape[part], C[part, part]) < HALF_SIGNIFICANT for _, C in self.halves]
        agree = [_p_value((x - self.shape)[part], C[part, part]) >= HALF_SIGNIFICANT for x, C in self.halves]
        others = [_p_value(x[part], C[part, part]) < SIGNIFICANT for x, C in self.without]
        few = bool(others) and all(others) and all(agree)
        return all(s or (few and not a) for s, a in zip(shown, able, strict=True))

    def bent(self) -> tuple[bool, str]:
        """Whether the board is bent, and why, or why not."""
        if self.p_warp >= SIGNIFICANT:
            return False, "not significantly different from a flat board"
        return (True, _IN_HALVES) if self._in_both_halves(_WARP) else (False, _NOT_IN_HALVES)

    def stretched(self) -> tuple[bool, str]:
        """Whether rows and columns are not to scale, and why, or why not."""
        if self.p_stretch >= SIGNIFICANT:
            return False, "not significantly different from rows and columns to scale"
        if not self._in_both_halves(_STRETCH):
            return False, _NOT_IN_HALVES
        if self.scatter.p_value < EXPLAINED:
            return False, f"{_IN_HALVES}, but it does not explain them: {_still(self.scatter)}"
        return True, f"{_IN_HALVES}, and it explains them"


_IN_HALVES = "significant, and both halves of the photographs agree on it"
_NOT_IN_HALVES = "significant, but not in both halves of the photographs"


def _still(left: Scatter) -> str:
    return f"they still scatter {left.factor:.1f} times more than noise"


def _change_px(table: CornerTable, first: LensFit, second: LensFit) -> float:
    """RMS difference of the directions of two lenses over the picture."""
    at = projection_map(first.model, first.lens, table.image_size_px, 1.0)
    return difference_px(at.pixels.reshape(-1, 2), at.rays.reshape(-1, 3), second)


def _p_value(found: Array, C: Array) -> float:
    """P-value of numbers whose true values are 0 and whose errors have this covariance."""
    return float(chdtrc(len(found), float(found @ np.linalg.solve(C, found))))


def _points(
    table: CornerTable, found: LensFit, options: BoardShapeOptions, factor: float
) -> tuple[PointsTest, LensFit]:
    """Test for residuals correlated per point; if they explain the residuals, the fit with all points free."""
    nothing = np.zeros((len(table.board_points), 3))
    p = _p_of_points(table, found, factor, found.used)
    if p >= SIGNIFICANT or options.stretch is False:
        return PointsTest(nothing, p, False, "the points lie as stated"), found
    odd = table.view % 2 == 1
    if any(_p_of_points(table, found, factor, found.used & half) >= HALF_SIGNIFICANT for half in (odd, ~odd)):
        return PointsTest(nothing, p, False, _NOT_IN_HALVES), found
    seen = np.bincount(table.point[found.used], minlength=len(nothing))
    if np.median(seen[seen > 0]) < _SEEN_OFTEN or np.sum(seen > 0) > MOST_POINTS:
        why = "significant, but there are too few photographs to solve for each point"
        return PointsTest(nothing, p, False, why), found
    board = BoardFreedom(found.board.warp, found.board.stretch, points=True)
    try:
        freed = fit(table, found.used, found.model, found.values, board, limits=BRIEF)
        left = ViewEquations.of(table, freed, AS_STATED).scatter()
        worse = _direction_sigma_px(table, freed) > _WORSE * _direction_sigma_px(table, found)
    except AdjustmentError as problem:
        return PointsTest(nothing, p, False, f"significant, but they cannot be solved for: {problem}"), found
    off = np.where((seen > 0)[:, None], _without_similarity(table.board_points, freed.printed), 0.0)
    change = _change_px(table, found, freed)
    if worse and options.stretch is None:
        return PointsTest(off, p, False, f"{_IN_HALVES}, but with them directions are less well known", change), found
    if left.p_value < EXPLAINED and options.stretch is None:
        why = f"{_IN_HALVES}, but they do not explain them: {_still(left)}"
        return PointsTest(off, p, False, why, change), found
    return PointsTest(off, p, True, f"{_IN_HALVES}, and they explain them", change), freed


def _direction_sigma_px(table: CornerTable, found: LensFit) -> float:
    """Median sigma of directions where corners were seen, from noise and the scatter between photographs."""
    equations = ViewEquations.of(table, found, AS_STATED)
    seen = partial(seen_at, table, found.used)
    at = projection_map(found.model, found.lens, table.image_size_px, 1.0, where=seen)
    sigmas = at.sigma_px(scattered(found, equations, equations.scatter()))
    return float(np.nanmedian(sigmas[seen(at.pixels)]))


def _p_of_points(table: CornerTable, found: LensFit, factor: float, used: Bools) -> float:
    """P-value of the score test of point displacements, from some corners (N,), with all other parameters fixed.

    Poses and lens have absorbed a part of the displacements, so that the chi-square is too small rather than too large.
    """
    term = term_of(table, used, found.model.fisheye, found.sigma_px * factor)
    line = term.linearise(found.values)
    J = next(p for p in line.parts if p.stack == "print").jacobian[..., :2]
    count = len(table.board_points)
    H, g = np.zeros((count, 2, 2)), np.zeros((count, 2))
    np.add.at(H, table.point[used], np.swapaxes(J, 1, 2) @ J)
    np.add.at(g, table.point[used], np.einsum("nij,ni->nj", J, line.residuals))
    seen = np.linalg.det(H) > 0
    score = float(np.sum(g[seen] * np.linalg.solve(H[seen], g[seen][..., None])[..., 0]))
    return float(chdtrc(2 * int(seen.sum()), score))


def _without_similarity(points: Array, off: Array) -> Array:
    """Offsets (P, 3) less the best-fitting common shift, rotation and scale within the board."""
    x, y = (points[:, :2] - points[:, :2].mean(axis=0)).T
    zero, one = np.zeros_like(x), np.ones_like(x)
    A = np.stack([np.stack([one, zero, x, -y], axis=1), np.stack([zero, one, y, x], axis=1)], axis=1).reshape(-1, 4)
    flat = off[:, :2].reshape(-1)
    left = (flat - A @ np.linalg.lstsq(A, flat, rcond=None)[0]).reshape(-1, 2)
    plane = np.stack([one, x, y], axis=1)
    z = off[:, 2] - plane @ np.linalg.lstsq(plane, off[:, 2], rcond=None)[0]
    return np.column_stack([left, z])


def rise(table: CornerTable, found: LensFit) -> float:
    """Peak-to-valley height of the warped board, m, relative to the best-fitting plane."""
    x, y = (table.board_points - table.middle)[:, :2].T
    a, b, c = found.warp
    z = a * x * x + b * x * y + c * y * y
    plane = np.stack([np.ones_like(x), x, y], axis=1)
    return float(np.ptp(z - plane @ np.linalg.lstsq(plane, z, rcond=None)[0]))
