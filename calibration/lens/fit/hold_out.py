"""How well a lens predicts photographs that it was not made from, and how much its numbers scatter between photographs.

The residuals that a solve ends with always shrink with more coefficients; those in views held out do not. Ours, after
the usual k-fold cross-validation, with the pose of a held-out view refitted: nobody needs a lens to predict where a
board was held.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from calibration.least_squares.adjustment import Limits
from calibration.least_squares.parameter_blocks import Poses
from calibration.lens.fit.corner_table import CornerTable
from calibration.lens.fit.lens_fit import LensFit, Values, adjust, fit, used_views
from geometry.arrays import Array, Bools, Ints

FOLDS = 5
# Models with numbers that the views hardly determine creep along a valley for ever: they are given up early, and a
# twentieth of a sigma is nothing beside what a fold moves.
BRIEF = Limits(steps=40, small_step_sigmas=0.05)
_ONE_BY_ONE = 10  # up to so many views each is held out alone: with fewer, a fifth of the views is too much to spare


@dataclass(frozen=True, slots=True)
class HeldOut:
    """What the folds of one lens model gave."""

    view_error_px2: Array  # (V,): squared error per coordinate in each view when held out; nan where not used
    folds: Sequence[LensFit]  # each solved without its views
    rms_px: float

    def better_than(self, other: HeldOut) -> tuple[float, float]:
        """Mean and standard error (px^2) of how much less this one errs, view by view: pairs are far more telling."""
        gain = (other.view_error_px2 - self.view_error_px2)[np.isfinite(self.view_error_px2)]
        return float(gain.mean()), float(gain.std(ddof=1) / np.sqrt(len(gain)))


def folds_of(views: Ints, folds: int | None = None) -> list[Ints]:
    """The views (n,) dealt out in turn into folds; each alone for up to ten views, else into five, if None."""
    count = folds if folds is not None else len(views) if len(views) <= _ONE_BY_ONE else FOLDS
    count = max(2, min(count, len(views)))
    return [views[k::count] for k in range(count)]


def hold_out(table: CornerTable, found: LensFit, folds: int | None = None) -> HeldOut:
    """Solve again without each fold, from the found values; predict the fold's views with their poses refitted.

    AdjustmentError where some fold cannot be solved.
    """
    error = np.full(table.views, np.nan)
    kept = []
    for group in folds_of(used_views(found, table), folds):
        held = np.isin(table.view, group)
        without = fit(
            table, found.used & ~held, found.model, found.values, found.board, limits=BRIEF, sigma_px=found.sigma_px
        )
        kept.append(without)
        error[group] = _errors(table, found.used & held, without, found.values)[group]
    return HeldOut(error, kept, float(np.sqrt(np.nanmean(error))))


def _errors(table: CornerTable, held: Bools, without: LensFit, values: Values) -> Array:
    """(V,): squared error per coordinate and degree of freedom of the held corners (N,), their poses refitted."""
    start = {**without.values, "boards": _at(values)}
    nothing = np.zeros(18, dtype=bool)
    refitted = adjust(table, held, without.model, start, sigma_px=without.sigma_px, lens_free=nothing, limits=BRIEF)
    squared = np.zeros(len(table))
    squared[held] = np.sum(refitted.residuals[0] ** 2, axis=1) * without.sigma_px**2
    total = np.bincount(table.view, weights=squared, minlength=table.views)
    return total / np.maximum(2 * table.counts(held) - 6, 1)


def _at(values: Values) -> Poses:
    boards = values["boards"]
    assert isinstance(boards, Poses)
    return boards


@dataclass(frozen=True, slots=True)
class Scatter:
    """Whether the lens' numbers, solved without one fold after the other, differ as their covariances say."""

    factor: float  # by which their sigmas must be multiplied to explain the differences; about 1 for a good model
    p_value: float  # of differences as large or larger, if the model and its noise were right


def scatter(found: LensFit, held: HeldOut) -> Scatter:
    """From the folds: without a share of the data an estimate moves by a covariance C_without - C_all.

    That holds for nested least squares with independent errors (Hausman 1978, Econometrica 46, corollary 2.6). Errors
    that go together within a photograph (a board bent differently each time, blur, a lens model that cannot follow)
    move it further. Moves are weighed by the information of all data and compared as sums: one by one against C_without
    - C_all, which is nearly singular where a fold says little, rounding alone gave factors of hundreds on real sets.
    AdjustmentError where a covariance does not exist.
    """
    free = found.model.free
    everything = found.covariance
    information = np.linalg.pinv(everything, hermitian=True)
    measured = expected = spread = 0.0
    for without in held.folds:
        moved = (without.lens - found.lens)[free]
        # Both at the same noise, that of all data: only then is the difference sure to be a covariance.
        C = without.covariance * (found.sigma_px / without.sigma_px) ** 2 - everything
        measured += float(moved @ information @ moved)
        M = information @ C
        expected += float(np.trace(M))
        spread += float(np.trace(M @ M))
    # A sum of squares with unequal weights, taken for the chi-square with its mean and variance (Satterthwaite 1946).
    # Folds share most of their data and their moves sum to about nothing: k - 1 of k are worth counting.
    k = len(held.folds)
    dof = expected**2 / spread * (k - 1) / k
    ratio = measured / expected
    return Scatter(float(np.sqrt(ratio)), float(chi2.sf(ratio * dof, dof)))
