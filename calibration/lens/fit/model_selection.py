"""Which lens model: the smallest that predicts held-out photographs as well as the best one does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from calibration.least_squares.adjustment import AdjustmentError
from calibration.least_squares.parameter_blocks import Vectors
from calibration.lens.fit.corner_table import CornerTable
from calibration.lens.fit.hold_out import BRIEF, HeldOut, Scatter, hold_out, scatter
from calibration.lens.fit.lens_fit import AS_STATED, CORNER_GATE, BoardFreedom, LensFit, Values, fit, robust_fit
from calibration.lens.fit.lens_models import LADDER, LensModel, folds_in_picture, rational_of_fisheye
from calibration.lens.fit.residual_cells import SIGNIFICANT, beyond_noise, cell_means
from geometry.arrays import Bools

# With so many corners time counts: models that cannot be chosen any more are not solved another five times. 400 views
# took 25 s without this, 11 s with it; the choice is the same.
MANY_CORNERS = 4000
RATIONAL = LensModel(8)
KEPT = 0.99  # share of the corners that a lens which follows leaves in use
SYSTEMATIC = 1e-3  # of residuals' chance to exceed those of the best model so far by noise alone


@dataclass(frozen=True, slots=True)
class ModelCandidate:
    """One model tried."""

    model: LensModel
    fit: LensFit | None  # None where it could not be solved
    held: HeldOut | None  # None where it was not worth the time, or some fold could not be solved
    scatter: Scatter | None = None
    refused: str = ""  # why it cannot be chosen, however well it fits
    behind_px2: float = np.nan  # mean squared error that it has more than the best one, held out
    standard_error_px2: float = np.nan  # of that


@dataclass(frozen=True, slots=True)
class Ladder:
    """All rungs, and the one to stand on."""

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
) -> Ladder:
    """Solve every model (or only one) on the same corners (N,) and hold out.

    rich: fits of rich models, from which the others start; shape: the stacks of the board's shape to start from. Each
    rung also starts from the one below of its own kind. AdjustmentError where no model can be used.
    """
    fitted: list[ModelCandidate] = []
    below: LensFit | None = None
    for model in LADDER if only is None else (only,):
        starts = [f for f in rich if f.model.fisheye == model.fisheye and f.model.coefficients <= model.coefficients]
        starts = starts or [f for f in rich if f.model.fisheye == model.fisheye]
        if below is not None and not model.fisheye and model.coefficients >= RATIONAL.coefficients:
            starts = [*(f for f in starts if f.model == RATIONAL), below]
        elif len(starts) > 1:
            starts = starts[:1]  # the best of them
        rung = _best_rung(table, used, model, [{**f.values, **shape} for f in starts] or [None], board)
        if rung.fit is not None and not model.fisheye and model.coefficients:
            below = rung.fit
        fitted.append(rung)
    candidates = []
    for rung in fitted:
        hopeless = _hopeless(rung, fitted) if int(used.sum()) > MANY_CORNERS else ""
        candidates.append(replace(rung, refused=hopeless) if hopeless else _held_out(table, rung, folds))
    if only is not None and candidates[0].held is not None:
        return Ladder(candidates, candidates[0], "it was asked for")
    return choose(candidates)


def _best_rung(
    table: CornerTable, used: Bools, model: LensModel, starts: Sequence[Values | None], board: BoardFreedom
) -> ModelCandidate:
    """The model solved from each start, where it fits best."""
    candidates = [_fitted(table, used, model, start, board) for start in starts]
    return min(candidates, key=lambda r: np.inf if r.fit is None else r.fit.sigma_px)


def choose(candidates: Sequence[ModelCandidate]) -> Ladder:
    """Of rungs in ascending order: the first that predicts as well as the best and leaves nothing that it explains.

    As well: its held-out error is within one standard error of the smallest. What it leaves in the residuals beyond the
    best one's must be noise: the standard error is large where few views reach the parts of the picture in which two
    models differ, though all corners together leave no doubt.
    """
    able = [r for r in candidates if not r.refused and r.held is not None]
    if not able:
        reasons = "; ".join(f"{r.model.title}: {r.refused}" for r in candidates)
        raise AdjustmentError(f"no lens model can be used ({reasons})")
    best = min(able, key=lambda r: _rms(r))
    out = []
    for r in candidates:
        if r.held is None or best.held is None:
            out.append(r)
            continue
        gain, error = best.held.better_than(r.held)
        out.append(replace(r, behind_px2=gain, standard_error_px2=error))
    as_good = [r for r in out if not r.refused and r.held is not None and r.behind_px2 <= r.standard_error_px2]
    chosen = next(r for r in as_good if r.model == best.model or not leaves_something(r, best))
    if chosen.model == best.model:
        why = f"it predicts held-out views best ({_rms(best):.3f} px)"
        smaller = [r for r in out if r.held is not None and not r.refused][: [r.model for r in able].index(best.model)]
        if smaller:
            least = min(_rms(r) for r in smaller)
            why += f", and every smaller usable model errs more ({least:.3f} px at best) or leaves more in them"
    else:
        why = (
            f"its held-out error ({_rms(chosen):.3f} px) is within one standard error of the best model's"
            f" ({best.model.words}: {_rms(best):.3f} px), and it has fewer numbers to determine"
        )
    return Ladder(out, chosen, why)


def leaves_something(rung: ModelCandidate, best: ModelCandidate) -> bool:
    """Whether a model's residuals exceed those of the best one by more than noise and its fewer numbers explain."""
    if rung.fit is None or best.fit is None or best.scatter is None:
        return False
    more, least = (f.sigma_px**2 * f.adjusted.dof for f in (rung.fit, best.fit))
    noise = best.fit.sigma_px * max(1.0, best.scatter.factor)
    fewer = max(best.model.coefficients - rung.model.coefficients, 3)
    return bool(chi2.sf((more - least) / noise**2, fewer) < SYSTEMATIC)


def _rms(rung: ModelCandidate) -> float:
    return np.inf if rung.held is None else rung.held.rms_px


def _fitted(
    table: CornerTable, used: Bools, model: LensModel, start: Values | None, board: BoardFreedom
) -> ModelCandidate:
    """A model solved on all views."""
    if start is None:
        return ModelCandidate(
            model, None, None, refused="no focal length and no position of the board explain the corners"
        )
    try:
        found = fit(table, used, model, start, board, limits=BRIEF)
    except AdjustmentError as error:
        return ModelCandidate(model, None, None, refused=f"it cannot be solved: {error}")
    return ModelCandidate(model, found, None)


def _hopeless(rung: ModelCandidate, others: Sequence[ModelCandidate]) -> str:
    """Why a model cannot be chosen whatever its held-out error may be; empty where it can."""
    solved = [r for r in others if r.fit is not None]
    if rung.fit is None or not solved:
        return ""
    best = min(solved, key=lambda r: np.inf if r.fit is None else r.fit.sigma_px)
    assert best.fit is not None
    if rung.fit.sigma_px > 1.2 * best.fit.sigma_px:
        return f"it misses its own photographs {rung.fit.sigma_px / best.fit.sigma_px:.1f} times as far as the best"
    smaller = [r for r in solved if not r.model.fisheye and r.model.coefficients < rung.model.coefficients]
    if rung.model.fisheye or not smaller or smaller[-1].fit is None:
        return ""
    less = smaller[-1].fit
    before, after = (f.sigma_px**2 * f.adjusted.dof for f in (less, rung.fit))
    more = rung.model.coefficients - less.model.coefficients
    if chi2.sf((before - after) / rung.fit.sigma_px**2, more) > 0.01:
        return f"it fits its own photographs no better than {less.model.coefficients} coefficients do"
    return ""


def _held_out(table: CornerTable, rung: ModelCandidate, folds: int | None) -> ModelCandidate:
    """The rung with its held-out error, or with why it is refused."""
    found = rung.fit
    if found is None:
        return rung
    try:
        held = hold_out(table, found, folds)
        spread = scatter(found, held)
    except AdjustmentError as error:
        return replace(rung, refused=f"the views do not determine it: {error}")
    folded = folds_in_picture(found.lens, rung.model.fisheye, table.image_size_px)
    return replace(
        rung,
        held=held,
        scatter=spread,
        refused="it folds inside the picture: two directions would share a pixel" if folded else "",
    )


def union_of_used(
    table: CornerTable, starts: Sequence[tuple[LensModel, Values]], only: LensModel | None = None
) -> tuple[Bools, list[LensFit]]:
    """Corners (N,) that some rich model takes for the board's, and the robust fits that say so, best first.

    A model too small for the lens would throw out the corners of the picture's edge, which tell the models apart; so
    the rational model is asked as well, where the plain ones leave it something. AdjustmentError where none can be
    solved.
    """
    fits: list[LensFit] = []
    reasons: list[str] = []
    for model, values in starts:
        fits += _rich_fit(table, model, values, reasons)
    leaves = [beyond_noise(*cell_means(table, f), f.sigma_px)[0] < SIGNIFICANT or f.used.mean() < KEPT for f in fits]
    asked = only is not None and only.coefficients >= RATIONAL.coefficients
    if asked or (only is None and all(leaves)):
        for values in [_as_rational(table, f) for f in fits]:
            fits += _rich_fit(table, RATIONAL, values, reasons)
    if not fits:
        raise AdjustmentError(reasons[-1])
    gate = CORNER_GATE * min(f.sigma_px for f in fits)
    fits.sort(key=lambda f: _information(table, f, gate))
    # A view's corners count only where the best fit has a use for the view at all.
    views = table.counts(fits[0].used) > 0
    used = np.any([f.used for f in fits], axis=0) & views[table.view]
    return used, fits


def _rich_fit(table: CornerTable, model: LensModel, values: Values, reasons: list[str]) -> list[LensFit]:
    """The robust fit with as much of the board's shape as can be solved for; none where even the lens cannot."""
    for board in (BoardFreedom(warp=True, stretch=True), BoardFreedom(warp=True), AS_STATED):
        try:
            return [robust_fit(table, model, values, board)]
        except AdjustmentError as error:
            reasons.append(str(error))
    return []


def _as_rational(table: CornerTable, found: LensFit) -> Values:
    """The values of a fit with a rational lens that draws about the same."""
    if not found.model.fisheye:
        return found.values
    inside = np.linalg.norm((table.pixels[found.used] - found.lens[2:4]) / found.lens[:2], axis=1)
    lens = rational_of_fisheye(found.lens, float(inside.max()))
    return {**found.values, "intrinsics": Vectors(lens[None])}


def _information(table: CornerTable, found: LensFit, gate_px: float) -> float:
    """Schwarz's criterion over all corners: what it misses by (a gate at most), and a price for each number."""
    missed = np.minimum(np.nan_to_num(np.linalg.norm(found.residuals, axis=1), nan=np.inf), gate_px)
    n = 2 * len(table)
    return n * float(np.log(max(np.sum(missed**2) / n, 1e-18))) + found.model.coefficients * np.log(n)
