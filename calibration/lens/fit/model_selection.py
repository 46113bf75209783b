"""Selection of the lens model: the smallest one that predicts held-out photographs as well as the best one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from calibration.least_squares.adjustment import AdjustmentError
from calibration.least_squares.parameter_blocks import Vectors
from calibration.lens.fit.corner_table import CornerTable
from calibration.lens.fit.hold_out import BRIEF, HeldOut, Scatter, hold_out, scatter
from calibration.lens.fit.lens_fit import CORNER_GATE, LensFit, fit, robust_fit
from calibration.lens.fit.lens_models import LENS_MODELS, LensModel, folds_in_picture, rational_of_fisheye
from calibration.lens.fit.lens_parameters import AS_STATED, BoardFreedom, Values
from calibration.lens.fit.residual_cells import SIGNIFICANT, beyond_noise, cell_means
from geometry.arrays import Bools

# With more corners, models that can no longer be chosen are not cross-validated. 400 views took 25 s without this
# limit and 11 s with it; the choice is the same.
MANY_CORNERS = 4000
RATIONAL = LensModel(8)
FEWEST_INLIERS = 0.99  # share of used corners below which a lens model is considered too small
SYSTEMATIC = 1e-3  # p-value of residuals larger than the best model's, below which the difference is not noise


@dataclass(frozen=True, slots=True)
class ModelCandidate:
    """One candidate model with its fit and its hold-out error."""

    model: LensModel
    fit: LensFit | None  # None where it could not be solved
    held: HeldOut | None  # None where the model was skipped, or a fold could not be solved
    scatter: Scatter | None = None
    refused: str = ""  # reason why the model cannot be chosen, regardless of its fit
    excess_px2: float = np.nan  # mean squared hold-out error in excess of the best model's
    standard_error_px2: float = np.nan  # of excess_px2


@dataclass(frozen=True, slots=True)
class ModelSelection:
    """All candidates and the chosen one."""

    candidates: Sequence[ModelCandidate]
    chosen: ModelCandidate
    why: str


def select_model(
    table: CornerTable,
    used: Bools,
    rich: Sequence[LensFit],
    shape: Values,
    board: BoardFreedom,
    folds: int | None = None,
    only: LensModel | None = None,
) -> ModelSelection:
    """Fit and cross-validate every model (or `only` one) on the same corners (N,).

    rich: fits of rich models, from which the others start; shape: start values of the board's shape. Each candidate
    also starts from the next smaller one of its kind.

    Raises:
        AdjustmentError: no model can be used.
    """
    fitted: list[ModelCandidate] = []
    below: LensFit | None = None
    for model in LENS_MODELS if only is None else (only,):
        starts = [f for f in rich if f.model.fisheye == model.fisheye and f.model.coefficients <= model.coefficients]
        starts = starts or [f for f in rich if f.model.fisheye == model.fisheye]
        if below is not None and not model.fisheye and model.coefficients >= RATIONAL.coefficients:
            starts = [*(f for f in starts if f.model == RATIONAL), below]
        elif len(starts) > 1:
            starts = starts[:1]  # the best of them
        candidate = _best_start(table, used, model, [{**f.values, **shape} for f in starts] or [None], board)
        if candidate.fit is not None and not model.fisheye and model.coefficients:
            below = candidate.fit
        fitted.append(candidate)
    candidates = []
    for candidate in fitted:
        hopeless = _reason_to_skip(candidate, fitted) if int(used.sum()) > MANY_CORNERS else ""
        candidates.append(replace(candidate, refused=hopeless) if hopeless else _held_out(table, candidate, folds))
    if only is not None and candidates[0].held is not None:
        return ModelSelection(candidates, candidates[0], "as requested")
    return choose(candidates)


def _best_start(
    table: CornerTable, used: Bools, model: LensModel, starts: Sequence[Values | None], board: BoardFreedom
) -> ModelCandidate:
    """The best fit of the model over the start values."""
    candidates = [_fitted(table, used, model, start, board) for start in starts]
    return min(candidates, key=lambda r: np.inf if r.fit is None else r.fit.sigma_px)


def choose(candidates: Sequence[ModelCandidate]) -> ModelSelection:
    """Of candidates in ascending order, the first that predicts as well as the best one and leaves no systematic error.

    As well: its hold-out error is within one standard error of the smallest. Its residuals may exceed those of the best
    model only by noise: the standard error is large if few views reach the parts of the picture in which two models
    differ, although all corners together may distinguish them clearly.

    Raises:
        AdjustmentError: no candidate can be used.
    """
    usable = [r for r in candidates if not r.refused and r.held is not None]
    if not usable:
        reasons = "; ".join(f"{r.model.title}: {r.refused}" for r in candidates)
        raise AdjustmentError(f"no lens model can be used ({reasons})")
    best = min(usable, key=lambda r: _rms(r))
    out = []
    for r in candidates:
        if r.held is None or best.held is None:
            out.append(r)
            continue
        gain, error = best.held.better_than(r.held)
        out.append(replace(r, excess_px2=gain, standard_error_px2=error))
    as_good = [r for r in out if not r.refused and r.held is not None and r.excess_px2 <= r.standard_error_px2]
    chosen = next(r for r in as_good if r.model == best.model or not leaves_systematic_residuals(r, best))
    if chosen.model == best.model:
        why = f"it has the smallest hold-out error ({_rms(best):.3f} px)"
        smaller = [r for r in out if r.held is not None and not r.refused][
            : [r.model for r in usable].index(best.model)
        ]
        if smaller:
            least = min(_rms(r) for r in smaller)
            why += f", and every smaller usable model errs more ({least:.3f} px at best) or leaves a systematic error"
    else:
        why = (
            f"its hold-out error ({_rms(chosen):.3f} px) is within one standard error of the best model's"
            f" ({best.model.words}: {_rms(best):.3f} px), and it has fewer parameters"
        )
    return ModelSelection(out, chosen, why)


def leaves_systematic_residuals(candidate: ModelCandidate, best: ModelCandidate) -> bool:
    """Whether a model's residuals exceed the best model's by more than noise and the missing parameters explain."""
    if candidate.fit is None or best.fit is None or best.scatter is None:
        return False
    more, least = (f.sigma_px**2 * f.adjusted.dof for f in (candidate.fit, best.fit))
    noise = best.fit.sigma_px * max(1.0, best.scatter.factor)
    fewer = max(best.model.coefficients - candidate.model.coefficients, 3)
    return bool(chi2.sf((more - least) / noise**2, fewer) < SYSTEMATIC)


def _rms(candidate: ModelCandidate) -> float:
    return np.inf if candidate.held is None else candidate.held.rms_px


def _fitted(
    table: CornerTable, used: Bools, model: LensModel, start: Values | None, board: BoardFreedom
) -> ModelCandidate:
    """A model fitted to all views."""
    if start is None:
        return ModelCandidate(model, None, None, refused="no focal length and no pose of the board explain the corners")
    try:
        found = fit(table, used, model, start, board, limits=BRIEF)
    except AdjustmentError as error:
        return ModelCandidate(model, None, None, refused=f"it cannot be solved: {error}")
    return ModelCandidate(model, found, None)


def _reason_to_skip(candidate: ModelCandidate, others: Sequence[ModelCandidate]) -> str:
    """Reason why a model cannot be chosen whatever its hold-out error; empty if it can."""
    solved = [r for r in others if r.fit is not None]
    if candidate.fit is None or not solved:
        return ""
    best = min(solved, key=lambda r: np.inf if r.fit is None else r.fit.sigma_px)
    assert best.fit is not None
    if candidate.fit.sigma_px > 1.2 * best.fit.sigma_px:
        return f"its residuals are {candidate.fit.sigma_px / best.fit.sigma_px:.1f} times those of the best model"
    smaller = [r for r in solved if not r.model.fisheye and r.model.coefficients < candidate.model.coefficients]
    if candidate.model.fisheye or not smaller or smaller[-1].fit is None:
        return ""
    less = smaller[-1].fit
    before, after = (f.sigma_px**2 * f.adjusted.dof for f in (less, candidate.fit))
    more = candidate.model.coefficients - less.model.coefficients
    if chi2.sf((before - after) / candidate.fit.sigma_px**2, more) > 0.01:
        return f"it does not fit better than the model with {less.model.coefficients} coefficients"
    return ""


def _held_out(table: CornerTable, candidate: ModelCandidate, folds: int | None) -> ModelCandidate:
    """The candidate with its hold-out error, or with the reason why it is refused."""
    found = candidate.fit
    if found is None:
        return candidate
    try:
        held = hold_out(table, found, folds)
        spread = scatter(found, held)
    except AdjustmentError as error:
        return replace(candidate, refused=f"the views do not determine it: {error}")
    folded = folds_in_picture(found.lens, candidate.model.fisheye, table.image_size_px)
    return replace(
        candidate,
        held=held,
        scatter=spread,
        refused="it folds inside the picture: two directions would map to the same pixel" if folded else "",
    )


def inliers_of_rich_models(
    table: CornerTable, starts: Sequence[tuple[LensModel, Values]], only: LensModel | None = None
) -> tuple[Bools, list[LensFit]]:
    """Corners (N,) that are inliers of any rich model, and the robust fits of these models, best first.

    A model too small for the lens would reject the corners at the edge of the picture, which distinguish the models.
    The rational model is therefore fitted as well, if the plain ones leave systematic residuals.

    Raises:
        AdjustmentError: no model can be fitted.
    """
    fits: list[LensFit] = []
    reasons: list[str] = []
    for model, values in starts:
        fits += _rich_fit(table, model, values, reasons)
    leaves = [
        beyond_noise(*cell_means(table, f), f.sigma_px)[0] < SIGNIFICANT or f.used.mean() < FEWEST_INLIERS for f in fits
    ]
    wanted = only is not None and only.coefficients >= RATIONAL.coefficients
    if wanted or (only is None and all(leaves)):
        for values in [_as_rational(table, f) for f in fits]:
            fits += _rich_fit(table, RATIONAL, values, reasons)
    if not fits:
        raise AdjustmentError(reasons[-1])
    gate = CORNER_GATE * min(f.sigma_px for f in fits)
    fits.sort(key=lambda f: _schwarz_criterion(table, f, gate))
    # Inliers count only in views that the best fit uses.
    views = table.counts(fits[0].used) > 0
    used = np.any([f.used for f in fits], axis=0) & views[table.view]
    return used, fits


def _rich_fit(table: CornerTable, model: LensModel, values: Values, reasons: list[str]) -> list[LensFit]:
    """The robust fit with as much of the board's shape as can be solved for; empty if not even the lens can."""
    for board in (BoardFreedom(warp=True, stretch=True), BoardFreedom(warp=True), AS_STATED):
        try:
            return [robust_fit(table, model, values, board)]
        except AdjustmentError as error:
            reasons.append(str(error))
    return []


def _as_rational(table: CornerTable, found: LensFit) -> Values:
    """The values of a fit, with its lens approximated by a rational one."""
    if not found.model.fisheye:
        return found.values
    inside = np.linalg.norm((table.pixels[found.used] - found.lens[2:4]) / found.lens[:2], axis=1)
    lens = rational_of_fisheye(found.lens, float(inside.max()))
    return {**found.values, "intrinsics": Vectors(lens[None])}


def _schwarz_criterion(table: CornerTable, found: LensFit, gate_px: float) -> float:
    """Schwarz's information criterion over all corners, with residuals limited to the gate."""
    missed = np.minimum(np.nan_to_num(np.linalg.norm(found.residuals, axis=1), nan=np.inf), gate_px)
    n = 2 * len(table)
    return n * float(np.log(max(np.sum(missed**2) / n, 1e-18))) + found.model.coefficients * np.log(n)
