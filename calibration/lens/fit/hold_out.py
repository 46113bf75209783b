"""Hold-out (cross-validation) error of a lens, and the scatter of its parameters between photographs.

Residuals of a fit always decrease with more coefficients; those in held-out views do not. Ours, after the usual k-fold
cross-validation; the pose of a held-out view is refitted, because it is not a parameter of the lens.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from calibration.least_squares.adjustment import Limits
from calibration.least_squares.parameter_blocks import Poses
from calibration.lens.fit.corner_table import CornerTable
from calibration.lens.fit.lens_adjustment import FitSettings, adjust
from calibration.lens.fit.lens_fit import LensFit, fit, used_views
from calibration.lens.fit.lens_parameters import Values
from geometry.arrays import Array, Bools, Ints

FOLDS = 5
# Models with parameters that the views hardly determine converge very slowly along a valley. They are stopped early: a
# twentieth of a sigma is negligible against the differences between folds.
BRIEF = Limits(steps=40, small_step_sigmas=0.05)
_ONE_BY_ONE = 10  # up to this number of views each is a fold of its own: a fifth of so few is too much to leave out


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Cross-validation result of one lens model."""

    view_error_px2: Array  # (V,): squared error per coordinate in each view when held out; nan where not used
    folds: Sequence[LensFit]  # each fitted without its views
    rms_px: float

    def better_than(self, other: HeldOut) -> tuple[float, float]:
        """Mean and standard error (px^2) of the decrease in error against `other`, paired by view."""
        gain = (other.view_error_px2 - self.view_error_px2)[np.isfinite(self.view_error_px2)]
        return float(gain.mean()), float(gain.std(ddof=1) / np.sqrt(len(gain)))


def folds_of(views: Ints, folds: int | None = None) -> list[Ints]:
    """The views (n,) assigned to folds in turn; if `folds` is None, one each for up to ten views, else five folds."""
    count = folds if folds is not None else len(views) if len(views) <= _ONE_BY_ONE else FOLDS
    count = max(2, min(count, len(views)))
    return [views[k::count] for k in range(count)]


def hold_out(table: CornerTable, found: LensFit, folds: int | None = None) -> HeldOut:
    """Fit again without each fold, from the values found; predict the views of the fold with their poses refitted.

    Raises:
        AdjustmentError: a fold cannot be solved.
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
    settings = FitSettings(without.sigma_px, limits=BRIEF)
    refitted = adjust(table, held, without.model, start, settings=settings, lens_free=nothing)
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
    """Whether the parameters of the lens, fitted without each fold in turn, vary as their covariances predict."""

    factor: float  # on their sigmas that explains the variation; about 1 for a good model
    p_value: float  # of at least as much variation, if model and noise are right


def scatter(found: LensFit, held: HeldOut) -> Scatter:
    """Compare the folds: leaving out data changes an estimate by a random amount of covariance C_without - C_all.

    This holds for nested least squares with independent errors (Hausman 1978, Econometrica 46, corollary 2.6). Errors
    that are correlated within a photograph (a board that bends differently each time, blur, a lens that the model
    cannot describe) increase the changes. They are weighted by the information of all data and compared as sums:
    compared one by one against C_without - C_all, which is nearly singular where a fold contributes little, rounding
    alone gave factors of hundreds on real sets.

    Raises:
        AdjustmentError: a covariance does not exist.
    """
    free = found.model.free
    everything = found.covariance
    information = np.linalg.pinv(everything, hermitian=True)
    measured = expected = spread = 0.0
    for without in held.folds:
        moved = (without.lens - found.lens)[free]
        # Both at the noise of all data: only then is the difference guaranteed to be a covariance.
        C = without.covariance * (found.sigma_px / without.sigma_px) ** 2 - everything
        measured += float(moved @ information @ moved)
        M = information @ C
        expected += float(np.trace(M))
        spread += float(np.trace(M @ M))
    # Weighted sum of squares approximated by the chi-square with the same mean and variance (Satterthwaite 1946). The
    # folds share most of their data and their changes sum to about zero: k - 1 of k count.
    k = len(held.folds)
    dof = expected**2 / spread * (k - 1) / k
    ratio = measured / expected
    return Scatter(float(np.sqrt(ratio)), float(chi2.sf(ratio * dof, dof)))
