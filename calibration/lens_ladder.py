"""Which lens model: the smallest that predicts held-out photographs as well as the best one does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from calibration.adjustment import AdjustmentError
from calibration.corner_table import CornerTable
from calibration.hold_out import BRIEF, HeldOut, hold_out, scatter
from calibration.lens_fit import LensFit, Values, fit, robust_fit
from calibration.lens_models import LADDER, LensModel, folds_in_picture
from calibration.stacks import Vectors
from geometry.arrays import Array, Bools

WARP_SIGNIFICANT = 1e-3  # of a flat board's chance to look this bent


@dataclass(frozen=True, slots=True)
class Rung:
    """One model tried."""

    model: LensModel
    fit: LensFit | None  # None where it could not be solved
    held: HeldOut | None
    refused: str = ""  # why it cannot be chosen, however well it fits
    behind_px2: float = np.nan  # mean squared error that it has more than the best one, held out
    standard_error_px2: float = np.nan  # of that


@dataclass(frozen=True, slots=True)
class Ladder:
    """All rungs, and the one to stand on."""

    rungs: Sequence[Rung]
    chosen: Rung
    why: str


def climb(
    table: CornerTable,
    used: Bools,
    starts: Sequence[Values | None],
    warp_free: bool,
    folds: int | None = None,
    only: LensModel | None = None,
) -> Ladder:
    """Solve every model (or only one) on the same corners (N,) and hold out.

    starts: of perspective lenses and of a fisheye, None where there is none. Each rung starts from the one below of
    its own kind. AdjustmentError where no model can be used.
    """
    perspective, fisheye = starts
    rungs = []
    below = perspective
    for model in LADDER if only is None else (only,):
        first = fisheye if model.fisheye else below
        if first is None:
            rungs.append(Rung(model, None, None, "no focal length and no position of the board explain the corners"))
            continue
        rung = _tried(table, used, model, first, warp_free, folds)
        if rung.fit is not None and not model.fisheye and model.coefficients:
            below = rung.fit.values
        rungs.append(rung)
    if only is not None and rungs[0].held is not None:
        return Ladder(rungs, rungs[0], "it was asked for")
    return choose(rungs)


def choose(rungs: Sequence[Rung]) -> Ladder:
    """Of rungs in ascending order: the first whose held-out error is within one standard error of the smallest."""
    able = [r for r in rungs if not r.refused and r.held is not None]
    if not able:
        reasons = "; ".join(f"{r.model.title}: {r.refused}" for r in rungs)
        raise AdjustmentError(f"no lens model can be used ({reasons})")
    best = min(able, key=lambda r: _rms(r))
    out = []
    for r in rungs:
        if r.held is None or best.held is None:
            out.append(r)
            continue
        gain, error = best.held.better_than(r.held)
        out.append(Rung(r.model, r.fit, r.held, r.refused, gain, error))
    chosen = next(r for r in out if not r.refused and r.held is not None and r.behind_px2 <= r.standard_error_px2)
    if chosen.model == best.model:
        why = f"it predicts held-out views best ({_rms(best):.3f} px)"
        smaller = [r for r in out if r.held is not None and not r.refused][: [r.model for r in able].index(best.model)]
        if smaller:
            why += (
                f", and every smaller model errs more by over one standard error ({_rms(smaller[-1]):.3f} px at best)"
            )
    else:
        why = (
            f"its held-out error ({_rms(chosen):.3f} px) is within one standard error of the best model's"
            f" ({best.model.words}: {_rms(best):.3f} px), and it has fewer numbers to determine"
        )
    return Ladder(out, chosen, why)


def _rms(rung: Rung) -> float:
    return np.inf if rung.held is None else rung.held.rms_px


def _tried(
    table: CornerTable, used: Bools, model: LensModel, start: Values, warp_free: bool, folds: int | None
) -> Rung:
    try:
        found = fit(table, used, model, start, warp_free, limits=BRIEF)
    except AdjustmentError as error:
        return Rung(model, None, None, f"it cannot be solved: {error}")
    try:
        found.covariance  # noqa: B018 - asked whether there is one
        held = hold_out(table, found, folds)
    except AdjustmentError as error:
        return Rung(model, found, None, f"the views do not determine it: {error}")
    if folds_in_picture(found.lens, model.fisheye, table.image_size_px):
        return Rung(model, found, held, "it folds inside the picture: two directions would share a pixel")
    return Rung(model, found, held)


@dataclass(frozen=True, slots=True)
class WarpTest:
    """Whether the board is bent, as the corners see it."""

    warp: tuple[float, float, float]  # 1/m, as found when free
    sigma: tuple[float, float, float]
    rise_m: float  # from its lowest to its highest point
    p_value: float  # of a flat board looking bent as much
    gain_px2: float  # mean squared error that held-out views lose with the bend
    corrected: bool
    why: str


def warp_test(table: CornerTable, found: LensFit, folds: int | None = None, force: bool | None = None) -> WarpTest:
    """Solve with the board free to bend and without; force: True or False decide whatever is found.

    AdjustmentError where the bend cannot be determined.
    """
    flat = fit(table, found.used, found.model, {**found.values, "warp": Vectors(np.zeros((1, 3)))}, False)
    bent = fit(table, found.used, found.model, flat.values, True)
    C = bent.warp_covariance
    size = np.sqrt(np.diagonal(C))
    if not np.all(size > 0):
        raise AdjustmentError("the views do not determine the board's bend")
    held = hold_out(table, bent, folds)
    # Corners of one photograph err together: against their noise alone nearly every board on real photographs is bent.
    size = size * max(1.0, scatter(bent, held).factor)
    statistic = float((bent.warp / size) @ np.linalg.solve(_correlation(C), bent.warp / size))
    p = float(chi2.sf(statistic, 3))
    gain, error = held.better_than(hold_out(table, flat, folds))
    if force is not None:
        corrected, why = force, "as asked for"
    elif p >= WARP_SIGNIFICANT:
        corrected, why = False, "not significantly different from a flat board"
    elif gain < -error:
        corrected, why = False, "significant, but held-out views are predicted worse"
    else:
        better = "better" if gain > error else "as well"
        corrected, why = True, f"significant, and held-out views are predicted {better}"
    return WarpTest(
        tuple(bent.warp),
        tuple(size),
        rise(table, bent),
        p,
        gain,
        corrected,
        why,
    )


def _correlation(C: Array) -> Array:
    size = np.sqrt(np.diagonal(C))
    return C / np.outer(size, size)


def rise(table: CornerTable, found: LensFit) -> float:
    """How far the board's points lie apart across it, m, by its warp, after the best-fitting flat board."""
    x, y = (table.board_points - table.middle)[:, :2].T
    a, b, c = found.warp
    z = a * x * x + b * x * y + c * y * y
    plane = np.stack([np.ones_like(x), x, y], axis=1)
    return float(np.ptp(z - plane @ np.linalg.lstsq(plane, z, rcond=None)[0]))


def union_of_used(table: CornerTable, starts: Sequence[tuple[LensModel, Values]]) -> tuple[Bools, list[LensFit]]:
    """Corners (N,) that some rich model takes for the board's, and the robust fits that say so, best first.

    A model too small for the lens would throw out the corners of the picture's edge, which tell the models apart.
    AdjustmentError where none can be solved.
    """
    fits: list[LensFit] = []
    reasons = []
    for model, values in starts:
        for warp_free in (True, False):
            try:
                fits.append(robust_fit(table, model, values, warp_free))
                break
            except AdjustmentError as error:
                reasons.append(str(error))
    if not fits:
        raise AdjustmentError(reasons[-1])
    fits.sort(key=lambda f: float(np.nanmedian(np.abs(f.residuals))))
    # A view's corners count only where the best fit has a use for the view at all.
    views = table.counts(fits[0].used) > 0
    used = np.any([f.used for f in fits], axis=0) & views[table.view]
    return used, fits
