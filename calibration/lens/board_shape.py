"""Tests whether a board is as stated: flat, with rows and columns to scale and each point in its place.

Deviations that the photographs show are solved for together with the lens, if this predicts held-out photographs as
well or better. The absolute size of the board cannot be determined from photographs. Bend has three parameters and
scale two; the displacements of single points follow Strobl and Hirzinger (2011), "More accurate pinhole camera
calibration with imperfect planar target", ICCV workshops, with their common shift, rotation and scale fixed by wide
priors instead of by three chosen points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from calibration.least_squares.adjustment import AdjustmentError
from calibration.lens.fit.corner_table import CornerTable
from calibration.lens.fit.hold_out import HeldOut, hold_out, scatter
from calibration.lens.fit.lens_adjustment import term_of
from calibration.lens.fit.lens_fit import LensFit, fit
from calibration.lens.fit.lens_parameters import AS_STATED, BoardFreedom, Values, board_as_stated
from geometry.arrays import Array

SIGNIFICANT = 1e-3  # p-value below which a deviation from the stated board is significant
_SEEN_OFTEN = 3.0  # views of each point required to solve for all points
_MOST_POINTS = 2000  # above it the points are not solved for: three unknowns each


@dataclass(frozen=True, slots=True)
class WarpTest:
    """Test for a bent board."""

    warp: tuple[float, float, float]  # 1/m, estimated when free
    sigma: tuple[float, float, float]
    rise_m: float  # from its lowest to its highest point
    p_value: float  # of a bend at least as large, if the board is flat
    gain_px2: float  # decrease of the mean squared hold-out error with the bend; nan where p is too large to test it
    corrected: bool
    why: str


@dataclass(frozen=True, slots=True)
class StretchTest:
    """Test whether rows and columns are to scale and at right angles."""

    stretch: float  # relative excess length along x (the rows), if the length along y is right
    lean_rad: float  # deviation of the angle between rows and columns from 90 deg
    sigma: tuple[float, float]
    p_value: float  # of a deviation at least as large, if the board is as stated
    corrected: bool
    why: str


@dataclass(frozen=True, slots=True)
class PointsTest:
    """Test for displaced single points, beyond bend and scale."""

    off_m: Array  # (P, 3), estimated displacements, less the best-fitting common shift, rotation and scale
    p_value: float  # of residuals as strongly correlated per point, if the board is as stated
    corrected: bool
    why: str

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
    folds: int | None = None


def board_test(table: CornerTable, found: LensFit, options: BoardShapeOptions = BoardShapeOptions()) -> BoardTest:
    """Solve with the board as stated and with its shape free.

    found: a fit of a lens model that is rich enough not to attribute its own error to the board.

    Raises:
        AdjustmentError: not even the bend can be determined.
    """
    flat = fit(table, found.used, found.model, {**found.values, **_stated_board(table, found)}, AS_STATED)
    other, widths = _freed(table, flat)
    warp_sure, stretch_sure = _p_value(other.warp, other.shape_covariance[:3, :3]), 1.0
    if widths:
        stretch_sure = _p_value(other.stretch, other.shape_covariance[3:, 3:])
    factor, flat_held = 1.0, None
    if min(warp_sure, stretch_sure) < SIGNIFICANT:
        # Errors within one photograph are correlated: against noise alone nearly every real board would appear bent.
        factor = max(1.0, scatter(other, hold_out(table, other, options.folds)).factor)
        flat_held = hold_out(table, flat, options.folds)
        warp_sure = _p_value(other.warp, other.shape_covariance[:3, :3] * factor**2)
        if widths:
            stretch_sure = _p_value(other.stretch, other.shape_covariance[3:, 3:] * factor**2)
    wanted = BoardFreedom(warp_sure < SIGNIFICANT, stretch_sure < SIGNIFICANT)
    wanted = BoardFreedom(
        wanted.warp if options.warp is None else options.warp,
        wanted.stretch if options.stretch is None or not widths else options.stretch,
    )
    kept, gain, error = _accepted(table, flat, flat_held, wanted, options)
    sigmas = np.sqrt(np.maximum(np.diagonal(other.shape_covariance), 0)) * factor
    return BoardTest(
        WarpTest(
            tuple(other.warp),
            tuple(sigmas[:3]),
            rise(table, other),
            warp_sure,
            gain,
            kept.board.warp,
            _why(kept.board.warp, options.warp, warp_sure, "a flat board", gain, error),
        ),
        StretchTest(
            float(other.stretch[0]),
            float(other.stretch[1]),
            (float(sigmas[3]), float(sigmas[4])),
            stretch_sure,
            kept.board.stretch,
            _why(kept.board.stretch, options.stretch, stretch_sure, "rows and columns to scale", gain, error),
        )
        if widths
        else None,
        *_points(table, kept, options, factor),
    )


def _stated_board(table: CornerTable, found: LensFit) -> Values:
    """The board as stated, its circles as measured."""
    return {**board_as_stated(len(table.board_points)), "radius": found.values["radius"]}


def _freed(table: CornerTable, flat: LensFit) -> tuple[LensFit, bool]:
    """The fit with bend and stretch free, or with the bend alone if the stretch is undetermined; and which it is."""
    try:
        other = fit(table, flat.used, flat.model, flat.values, BoardFreedom(warp=True, stretch=True))
        if np.all(np.diagonal(other.shape_covariance) > 0):
            return other, True
    except AdjustmentError:
        pass
    other = fit(table, flat.used, flat.model, flat.values, BoardFreedom(warp=True))
    if not np.all(np.diagonal(other.shape_covariance)[:3] > 0):
        raise AdjustmentError("the views do not determine the board's bend")
    return other, False


def _p_value(found: Array, C: Array) -> float:
    """P-value of numbers whose true values are 0 and whose errors have this covariance."""
    return float(chi2.sf(float(found @ np.linalg.solve(C, found)), len(found)))


def _accepted(
    table: CornerTable, flat: LensFit, flat_held: HeldOut | None, wanted: BoardFreedom, options: BoardShapeOptions
) -> tuple[LensFit, float, float]:
    """The fit with the wanted freedom, unless the hold-out error grows; its hold-out gain and standard error (px^2)."""
    if wanted == AS_STATED:
        return flat, np.nan, np.nan
    freed = fit(table, flat.used, flat.model, flat.values, wanted)
    if flat_held is None:  # requested by the user
        return freed, np.nan, np.nan
    gain, error = hold_out(table, freed, options.folds).better_than(flat_held)
    if gain >= -error:
        return freed, gain, error
    requested = BoardFreedom(bool(options.warp), bool(options.stretch))
    return (fit(table, flat.used, flat.model, flat.values, requested) if requested != AS_STATED else flat), gain, error


def _why(corrected: bool, requested: bool | None, p: float, true: str, gain: float, error: float) -> str:
    if requested is not None and corrected == requested:
        return "as requested"
    if p >= SIGNIFICANT:
        return f"not significantly different from {true}"
    if not corrected:
        return "significant, but held-out views are predicted worse"
    return f"significant, and held-out views are predicted {'better' if gain > error else 'as well'}"


def _points(
    table: CornerTable, found: LensFit, options: BoardShapeOptions, factor: float
) -> tuple[PointsTest, LensFit]:
    """Test for residuals correlated per point; if significant, the fit with all points free if it predicts better."""
    p = _p_of_points(table, found, factor)
    nothing = np.zeros((len(table.board_points), 3))
    seen = np.bincount(table.point[found.used], minlength=len(nothing))
    if p >= SIGNIFICANT or options.stretch is False:
        return PointsTest(nothing, p, False, "the points lie as stated"), found
    if np.median(seen[seen > 0]) < _SEEN_OFTEN or np.sum(seen > 0) > _MOST_POINTS:
        why = "significant, but there are too few photographs to solve for each point"
        return PointsTest(nothing, p, False, why), found
    board = BoardFreedom(found.board.warp, found.board.stretch, points=True)
    try:
        freed = fit(table, found.used, found.model, found.values, board)
        gain, error = hold_out(table, freed, options.folds).better_than(hold_out(table, found, options.folds))
    except AdjustmentError as problem:
        return PointsTest(nothing, p, False, f"significant, but they cannot be solved for: {problem}"), found
    off = np.where((seen > 0)[:, None], _without_similarity(table.board_points, freed.printed), 0.0)
    if gain <= error:
        return PointsTest(off, p, False, "significant, but held-out views are not predicted better with them"), found
    return PointsTest(off, p, True, "significant, and held-out views are predicted better"), freed


def _p_of_points(table: CornerTable, found: LensFit, factor: float) -> float:
    """P-value of the score test of point displacements within the board, with all other parameters fixed.

    Poses and lens have absorbed a part of the displacements, so that the chi-square is too small rather than too large.
    """
    used = found.used
    term = term_of(table, used, found.model.fisheye, found.sigma_px * factor)
    line = term.linearise(found.values)
    J = next(p for p in line.parts if p.stack == "print").jacobian[..., :2]
    count = len(table.board_points)
    H, g = np.zeros((count, 2, 2)), np.zeros((count, 2))
    np.add.at(H, table.point[used], np.swapaxes(J, 1, 2) @ J)
    np.add.at(g, table.point[used], np.einsum("nij,ni->nj", J, line.residuals))
    seen = np.linalg.det(H) > 0
    score = float(np.sum(g[seen] * np.linalg.solve(H[seen], g[seen][..., None])[..., 0]))
    return float(chi2.sf(score, 2 * int(seen.sum())))


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
