"""Whether a board is as it was said to be: flat, its rows and columns to scale, each point in its place.

What the photographs show to be otherwise is solved for together with the lens, where that predicts held-out photographs
as well or better. Its size as a whole no photograph shows. Bend and scale are two and three numbers; the points one by
one are those of Strobl and Hirzinger (2011), "More accurate pinhole camera calibration with imperfect planar target",
ICCV workshops, with their common place, turn and scale fixed by wide priors instead of by three chosen points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from calibration.least_squares.adjustment import AdjustmentError
from calibration.lens.fit.corner_table import CornerTable
from calibration.lens.fit.hold_out import HeldOut, hold_out, scatter
from calibration.lens.fit.lens_fit import AS_STATED, BoardFreedom, LensFit, Values, board_as_stated, fit, term_of
from geometry.arrays import Array

SIGNIFICANT = 1e-3  # of a true board's chance to look this wrong
_SEEN_OFTEN = 3.0  # views of each point that solving for all points takes
_MOST_POINTS = 2000  # beyond it the points are not solved for: three unknowns each


@dataclass(frozen=True, slots=True)
class WarpTest:
    """Whether the board is bent, as the corners see it."""

    warp: tuple[float, float, float]  # 1/m, as found when free
    sigma: tuple[float, float, float]
    rise_m: float  # from its lowest to its highest point
    p_value: float  # of a flat board looking bent as much
    gain_px2: float  # mean squared error that held-out views lose with the bend; nan where p is too large to ask
    corrected: bool
    why: str


@dataclass(frozen=True, slots=True)
class StretchTest:
    """Whether rows and columns are as far apart as was said, and at right angles."""

    stretch: float  # share by which the board is longer along x (its rows) than said, if right along y
    lean_rad: float  # by which its columns lean against the right angle
    sigma: tuple[float, float]
    p_value: float  # of a true board looking so
    corrected: bool
    why: str


@dataclass(frozen=True, slots=True)
class PointsTest:
    """Whether single points lie off, beyond bend and scale."""

    off_m: Array  # (P, 3), as found; after the best common shift, turn and scale
    p_value: float  # of a true board whose residuals go together so, point by point
    corrected: bool
    why: str

    @property
    def rms_m(self) -> float:
        """How far the points lie off within the board, per point."""
        return float(np.sqrt(np.mean(np.sum(self.off_m[:, :2] ** 2, axis=1))))


@dataclass(frozen=True, slots=True)
class BoardTest:
    """The board as the photographs show it."""

    warp: WarpTest
    stretch: StretchTest | None  # None where the photographs do not determine it
    points: PointsTest
    fit: LensFit  # with what is corrected

    @property
    def free(self) -> BoardFreedom:
        """What is solved for with the lens."""
        stretch = self.stretch is not None and self.stretch.corrected
        return BoardFreedom(self.warp.corrected, stretch, self.points.corrected)


@dataclass(frozen=True, slots=True)
class Asked:
    """What the user decided; None: as the photographs say."""

    warp: bool | None = None
    stretch: bool | None = None
    folds: int | None = None


def board_test(table: CornerTable, found: LensFit, asked: Asked = Asked()) -> BoardTest:
    """Solve with the board as stated, and free to differ. found: a lens that is rich enough not to blame the board.

    AdjustmentError where not even the bend can be determined.
    """
    flat = fit(table, found.used, found.model, {**found.values, **_true_board(table, found)}, AS_STATED)
    other, widths = _freed(table, flat)
    warp_sure, stretch_sure = _p(other.warp, other.shape_covariance[:3, :3]), 1.0
    if widths:
        stretch_sure = _p(other.stretch, other.shape_covariance[3:, 3:])
    factor, flat_held = 1.0, None
    if min(warp_sure, stretch_sure) < SIGNIFICANT:
        # Corners of one photograph err together: against noise alone nearly every board on real photographs is bent.
        factor = max(1.0, scatter(other, hold_out(table, other, asked.folds)).factor)
        flat_held = hold_out(table, flat, asked.folds)
        warp_sure = _p(other.warp, other.shape_covariance[:3, :3] * factor**2)
        if widths:
            stretch_sure = _p(other.stretch, other.shape_covariance[3:, 3:] * factor**2)
    wanted = BoardFreedom(warp_sure < SIGNIFICANT, stretch_sure < SIGNIFICANT)
    wanted = BoardFreedom(
        wanted.warp if asked.warp is None else asked.warp,
        wanted.stretch if asked.stretch is None or not widths else asked.stretch,
    )
    kept, gain, error = _kept(table, flat, flat_held, wanted, asked)
    sigmas = np.sqrt(np.maximum(np.diagonal(other.shape_covariance), 0)) * factor
    return BoardTest(
        WarpTest(
            tuple(other.warp),
            tuple(sigmas[:3]),
            rise(table, other),
            warp_sure,
            gain,
            kept.board.warp,
            _why(kept.board.warp, asked.warp, warp_sure, "a flat board", gain, error),
        ),
        StretchTest(
            float(other.stretch[0]),
            float(other.stretch[1]),
            (float(sigmas[3]), float(sigmas[4])),
            stretch_sure,
            kept.board.stretch,
            _why(kept.board.stretch, asked.stretch, stretch_sure, "rows and columns to scale", gain, error),
        )
        if widths
        else None,
        *_points(table, kept, asked, factor),
    )


def _true_board(table: CornerTable, found: LensFit) -> Values:
    """The board as stated, its circles as measured."""
    return {**board_as_stated(len(table.board_points)), "radius": found.values["radius"]}


def _freed(table: CornerTable, flat: LensFit) -> tuple[LensFit, bool]:
    """The fit with the board free to bend and stretch, or where that is undetermined, to bend; and which it is."""
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


def _p(found: Array, C: Array) -> float:
    """Of numbers that are 0 but for errors of this covariance."""
    return float(chi2.sf(float(found @ np.linalg.solve(C, found)), len(found)))


def _kept(
    table: CornerTable, flat: LensFit, flat_held: HeldOut | None, wanted: BoardFreedom, asked: Asked
) -> tuple[LensFit, float, float]:
    """The fit with what is wanted, if held-out views do not object, with their gain and its error (px^2)."""
    if wanted == AS_STATED:
        return flat, np.nan, np.nan
    freed = fit(table, flat.used, flat.model, flat.values, wanted)
    if flat_held is None:  # asked for
        return freed, np.nan, np.nan
    gain, error = hold_out(table, freed, asked.folds).better_than(flat_held)
    if gain >= -error:
        return freed, gain, error
    insisted = BoardFreedom(bool(asked.warp), bool(asked.stretch))
    return (fit(table, flat.used, flat.model, flat.values, insisted) if insisted != AS_STATED else flat), gain, error


def _why(corrected: bool, asked: bool | None, p: float, true: str, gain: float, error: float) -> str:
    if asked is not None and corrected == asked:
        return "as asked for"
    if p >= SIGNIFICANT:
        return f"not significantly different from {true}"
    if not corrected:
        return "significant, but held-out views are predicted worse"
    return f"significant, and held-out views are predicted {'better' if gain > error else 'as well'}"


def _points(table: CornerTable, found: LensFit, asked: Asked, factor: float) -> tuple[PointsTest, LensFit]:
    """Whether residuals go together point by point, and if so the fit with all points free, if it predicts better."""
    p = _p_of_points(table, found, factor)
    nothing = np.zeros((len(table.board_points), 3))
    seen = np.bincount(table.point[found.used], minlength=len(nothing))
    if p >= SIGNIFICANT or asked.stretch is False:
        return PointsTest(nothing, p, False, "the points lie where they were said to"), found
    if np.median(seen[seen > 0]) < _SEEN_OFTEN or np.sum(seen > 0) > _MOST_POINTS:
        return PointsTest(nothing, p, False, "significant, but the photographs are too few to find each point"), found
    board = BoardFreedom(found.board.warp, found.board.stretch, points=True)
    try:
        freed = fit(table, found.used, found.model, found.values, board)
        gain, error = hold_out(table, freed, asked.folds).better_than(hold_out(table, found, asked.folds))
    except AdjustmentError as problem:
        return PointsTest(nothing, p, False, f"significant, but they cannot be solved for: {problem}"), found
    off = np.where((seen > 0)[:, None], _without_similarity(table.board_points, freed.printed), 0.0)
    if gain <= error:
        return PointsTest(off, p, False, "significant, but held-out views are predicted no better with them"), found
    return PointsTest(off, p, True, "significant, and held-out views are predicted better"), freed


def _p_of_points(table: CornerTable, found: LensFit, factor: float) -> float:
    """The score test of places within the board: what each point's residuals say of it, all else as it is.

    Poses and lens have taken up a part, so that the chi-square is rather too small than too large.
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
    """Offsets (P, 3) less the common shift, turn and scale within the board that explains most of them."""
    x, y = (points[:, :2] - points[:, :2].mean(axis=0)).T
    zero, one = np.zeros_like(x), np.ones_like(x)
    A = np.stack([np.stack([one, zero, x, -y], axis=1), np.stack([zero, one, y, x], axis=1)], axis=1).reshape(-1, 4)
    flat = off[:, :2].reshape(-1)
    left = (flat - A @ np.linalg.lstsq(A, flat, rcond=None)[0]).reshape(-1, 2)
    plane = np.stack([one, x, y], axis=1)
    z = off[:, 2] - plane @ np.linalg.lstsq(plane, off[:, 2], rcond=None)[0]
    return np.column_stack([left, z])


def rise(table: CornerTable, found: LensFit) -> float:
    """How far the board's points lie apart across it, m, by its warp, after the best-fitting flat board."""
    x, y = (table.board_points - table.middle)[:, :2].T
    a, b, c = found.warp
    z = a * x * x + b * x * y + c * y * y
    plane = np.stack([np.ones_like(x), x, y], axis=1)
    return float(np.ptp(z - plane @ np.linalg.lstsq(plane, z, rcond=None)[0]))
