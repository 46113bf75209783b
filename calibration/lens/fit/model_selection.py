"""Selection of the lens model by the expected error of directions.

Residuals decrease with every coefficient, and held-out photographs share the board and its errors, so neither decides.
What a lens is used for are directions. Their expected squared error has two parts: the variance that the photographs
leave, which grows with the coefficients, and the difference to the other models, weighted with the probability that
these are right. The chosen model has the smallest sum where corners were seen, after the rotation of the camera that
fits the whole picture: what a model leaves open beyond the corners turns them. It leaves no part of the picture
unknown. The sum is the variance of Bayesian model averaging (Hoeting et al. 1999, Statistical Science 14) about one of
the models, with probabilities from the density that each photograph has as predicted by the others (Yao et al. 2018,
Bayesian Analysis 13, pseudo averaging), with their noise raised by the scatter between photographs. Its use as a
criterion is ours, after the focused information criterion (Claeskens and Hjort 2003, JASA 98).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from calibration.least_squares.adjustment import AdjustmentError, Limits, Values, Vectors
from calibration.lens.fit.corner_table import CornerTable
from calibration.lens.fit.coverage import seen_at
from calibration.lens.fit.lens_adjustment import BRIEF, ROUGH
from calibration.lens.fit.lens_fit import CORNER_GATE, LensFit, fit, robust_fit
from calibration.lens.fit.lens_models import LENS_MODELS, LensModel, folds_in_picture, rational_of_fisheye
from calibration.lens.fit.lens_parameters import AS_STATED, BoardFreedom
from calibration.lens.fit.projection_map import ProjectionMap, projection_map
from calibration.lens.fit.view_equations import ViewEquations, scattered
from geometry.arrays import Array, Bools
from geometry.camera import project_points_full

RATIONAL = LensModel(8)
FEWEST_INLIERS = 0.99  # share of used corners below which a lens model is considered too small
UNKNOWN_PX = 3.0  # sigma of the directions in 90 % of the picture from which on a model leaves them unknown
_COMMON = 0.9  # share of the covered picture over which errors are averaged: at its rim single places may diverge
OVERFIT = 3.0  # error in held-out photographs over the noise from which on a model depends on single photographs
PLAUSIBLE = 0.01  # probability of a model below which it is reported only where no other is more probable
PLAUSIBLE_NOISE = 0.05  # p-value of mean residuals above which models of 8 and 12 coefficients are not tried
SIGNIFICANT = 1e-3  # p-value of the mean residuals below which the lens model is wrong
_CORNERS_PER_CELL = 12
_MOST_COLUMNS = 16


@dataclass(frozen=True, slots=True)
class ModelCandidate:
    """One candidate model with its fit and the expected error of its directions where corners were seen."""

    model: LensModel
    fit: LensFit | None  # None where it could not be solved
    refused: str = ""  # reason why the model cannot be chosen
    sigma_px: float = np.nan  # of directions, from noise and scatter between photographs
    probability: float = np.nan  # that this model is right, if one of them is
    model_error_px: float = np.nan  # RMS difference to the other models, weighted with their probabilities

    @property
    def error_px(self) -> float:
        """Expected error of a direction, RMS per pixel."""
        return float(np.hypot(self.sigma_px, self.model_error_px))


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
    only: LensModel | None = None,
) -> ModelSelection:
    """Fit every model (or `only` one) to the same corners (N,), and choose.

    rich: fits of rich models, from which the others start; shape: start values of the board's shape. Each candidate
    also starts from the next smaller one of its kind. Raises AdjustmentError: no model can be used.
    """
    judged: list[_Judged] = []
    below: LensFit | None = None
    for model in LENS_MODELS if only is None else (only,):
        futile = _futile(table, model, judged)
        if futile:
            judged.append(_Judged(ModelCandidate(model, None, refused=futile)))
            continue
        same = [f for f in rich if f.model.fisheye == model.fisheye]
        starts = [f for f in same if f.model.coefficients <= model.coefficients] or same
        smaller = None if model.fisheye else below
        is_rich = model.coefficients >= RATIONAL.coefficients
        starts = [*(f for f in starts if f.model == model), smaller] if smaller and is_rich else starts[:1]
        candidate = _best_start(table, used, model, [{**f.values, **shape} for f in starts] or [None], board)
        if candidate.fit is None and smaller and not is_rich:
            # A rich lens that folds beyond the corners may fold before them without its last coefficients.
            candidate = _best_start(table, used, model, [{**smaller.values, **shape}], board)
        if candidate.fit is not None and not model.fisheye:
            below = candidate.fit
        judged.append(_judged(table, candidate))
    return _choose(judged)


def _futile(table: CornerTable, model: LensModel, smaller: Sequence[_Judged]) -> str:
    """Why a model of 8 or 12 coefficients need not be tried; empty if it must be.

    It would take most of the time: what the photographs do not determine converges slowly.
    """
    if model.coefficients < RATIONAL.coefficients:
        return ""
    fits = [j.candidate.fit for j in smaller if j.candidate.fit is not None and not j.scatters]
    if any(_leaves_noise(table, f) for f in fits):
        return "a smaller model leaves no correlated residuals and no scatter between photographs"
    unknown = (j.unknown_px * max(1.0, j.scatter) for j in smaller if j.map and j.candidate.model == RATIONAL)
    if any(px > UNKNOWN_PX for px in unknown):
        return f"{RATIONAL.coefficients} coefficients leave directions unknown already"
    return ""


def _leaves_noise(table: CornerTable, found: LensFit) -> bool:
    """Whether the residuals of a fit look like noise."""
    return beyond_noise(*cell_means(table, found), found.sigma_px)[0] >= PLAUSIBLE_NOISE


def _best_start(
    table: CornerTable, used: Bools, model: LensModel, starts: Sequence[Values | None], board: BoardFreedom
) -> ModelCandidate:
    """The best fit of the model over the start values, up to the first that leaves only noise."""
    candidates: list[ModelCandidate] = []
    for start in starts:
        candidates.append(_fitted(table, used, model, start, board))
        found = candidates[-1].fit
        if found is not None and len(starts) > 1 and _leaves_noise(table, found):
            break
    return min(candidates, key=lambda r: np.inf if r.fit is None else r.fit.sigma_px)


def _choose(judged: Sequence[_Judged]) -> ModelSelection:
    """The candidate with the smallest expected error of those that leave no directions unknown.

    If all do, the one with the smallest error where corners were seen is chosen: findings report it. Raises
    AdjustmentError: no candidate can be used.
    """
    solved = [j for j in judged if j.map is not None]
    if not solved:
        reasons = "; ".join(f"{j.candidate.model.title}: {j.candidate.refused}" for j in judged)
        raise AdjustmentError(f"no lens model can be used ({reasons})")
    best = min(solved, key=lambda j: j.deviance(j.noise_px))
    # One factor for all models: a rich model takes up a part of the scatter between few photographs.
    raised = max(1.0, best.scatter)
    score = np.array([j.deviance(best.noise_px * raised) for j in solved])
    weights = np.exp(-(score - score.min()) / 2)
    weights /= weights.sum()
    done = {}
    for j, weight in zip(solved, weights.tolist(), strict=True):
        excess = sum(w * _excess_px2(j, other, raised) for w, other in zip(weights, solved, strict=True))
        done[j.candidate.model] = replace(
            j.candidate,
            refused=j.refused(raised, float(np.sqrt(excess))),
            sigma_px=j.sigma_px * raised,
            probability=weight,
            model_error_px=float(np.sqrt(excess)),
        )
    out = [done.get(j.candidate.model, j.candidate) for j in judged]
    usable = [c for c in out if c.fit is not None and not c.refused]
    if usable:
        chosen = min(usable, key=lambda c: c.error_px)
        why = f"its directions have the smallest expected error where corners were seen ({chosen.error_px:.2g} px)"
    else:
        folding = {j.candidate.model for j in solved if j.folds}
        # Without coefficients, a lens is stated to be known where no corner was seen.
        distorting = [c for c in done.values() if c.model.coefficients > 0] or list(done.values())
        chosen = min(
            distorting,
            key=lambda c: (c.model in folding, c.probability < PLAUSIBLE, c.error_px > UNKNOWN_PX, c.error_px),
        )
        why = "every model folds or leaves directions unknown; this one has the smallest error where corners were seen"
    return ModelSelection(out, chosen, "as requested" if len(judged) == 1 else why)


@dataclass(frozen=True, slots=True)
class _Judged:
    """A candidate with the figures that the choice needs; sigmas are from the noise of corners alone."""

    candidate: ModelCandidate
    map: ProjectionMap | None = None  # None: no fit, or the views do not determine it
    inside: Bools | None = None  # (rows, columns): corners were seen there
    scatter: float = 1.0  # between photographs, factor on the sigmas
    scatters: bool = False  # whether it is significant
    noise_px: float = np.nan  # of a corner's coordinate
    coordinates: int = 0  # of all corners, less those that the poses of the boards take up
    predicted: tuple[float, float] = (np.inf, 0.0)  # see ViewEquations.predicted; chi-square in units of noise_px
    sigma_px: float = np.nan  # of directions where corners were seen
    unknown_px: float = np.inf  # of directions in 90 % of the picture
    stated_px: float = np.inf  # the same with the scatter between photographs, as it will be stated
    folds: bool = False
    overfit: float = 1.0  # RMS error in held-out photographs over the noise of the corners

    def deviance(self, noise_px: float) -> float:
        """Minus twice the log density of all photographs, each predicted by the others, with this noise of corners."""
        chi2, log_determinants = self.predicted
        ratio2 = (noise_px / self.noise_px) ** 2
        return chi2 / ratio2 + self.coordinates * np.log(noise_px**2) + log_determinants

    def refused(self, raised: float, model_error_px: float) -> str:
        """Reason why the model cannot be chosen; empty if it can. raised: factor on the sigmas."""
        if self.folds:
            return "it folds inside the picture: two directions would map to the same pixel"
        unknown = float(np.hypot(max(self.unknown_px * raised, self.stated_px), model_error_px))
        if unknown > UNKNOWN_PX:
            return f"the photographs leave its directions unknown: {unknown:.2g} px or more in a tenth of the picture"
        if self.overfit > OVERFIT:
            return (
                f"it depends on single photographs: held out, they err {self.overfit:.1f} times more than their noise"
            )
        return ""


def _judged(table: CornerTable, candidate: ModelCandidate) -> _Judged:
    found = candidate.fit
    if found is None:
        return _Judged(candidate)
    try:
        equations = ViewEquations.of(table, found)
        spread = equations.scatter()
        stated = scattered(found, equations, spread)
    except AdjustmentError as error:
        return _Judged(replace(candidate, refused=f"the views do not determine it: {error}"))
    C = equations.solution()[1][: equations.lens, : equations.lens]
    # With the rotation that fits where corners were seen, models would be chosen that leave the rest open.
    at = projection_map(found.model, found.lens, table.image_size_px, 1.0)
    inside = seen_at(table, found.used, at.pixels) & np.isfinite(at.by_parameter).all(axis=(2, 3))
    variance = np.trace(at.covariance_px2(C)[inside], axis1=-2, axis2=-1)
    return _Judged(
        candidate,
        map=at,
        inside=inside,
        scatter=max(spread.factor, spread.correlated),
        scatters=spread.is_significant,
        noise_px=found.sigma_px,
        coordinates=int(equations.count.sum()),
        predicted=equations.predicted(),
        sigma_px=float(np.sqrt(_common_mean(variance))) if inside.any() else np.inf,
        unknown_px=float(np.nanquantile(at.sigma_px(C), 0.9)),
        stated_px=float(np.nanquantile(at.sigma_px(stated), 0.9)),
        folds=folds_in_picture(found.lens, found.model.fisheye, table.image_size_px),
        overfit=float(np.sqrt(np.mean(equations.held_out_px2()))),
    )


def _excess_px2(one: _Judged, other: _Judged, raised: float) -> float:
    """Mean squared difference of the directions of two models where corners were seen, beyond that of their noise."""
    if other is one:
        return 0.0
    second = other.candidate.fit
    assert one.map is not None
    assert one.inside is not None
    assert second is not None
    noise2 = abs(other.sigma_px**2 - one.sigma_px**2) * raised**2
    return max(difference_px(one.map.pixels[one.inside], one.map.rays[one.inside], second) ** 2 - noise2, 0.0)


def difference_px(pixels: Array, rays: Array, second: LensFit) -> float:
    """RMS difference (px) at most of the pixels (n, 2) between the rays of two lenses, after the best rotation.

    rays (n, 3): those of the pixels through the first lens, nan where there is none.
    """
    there = np.isfinite(rays).all(axis=1)
    pixels, rays = pixels[there], rays[there]
    wide = np.asarray(second.model.fisheye)
    seen = project_points_full(rays, second.lens[:4], second.lens[4:], np.asarray(np.inf), wide)
    away = seen.pixels - pixels
    good = np.isfinite(away).all(axis=1)
    turn = np.cross(rays[:, None, :], seen.d_point)[good].reshape(-1, 3)
    moved = away[good].reshape(-1)
    left = moved - turn @ np.linalg.lstsq(turn, moved, rcond=None)[0]
    return float(np.sqrt(_common_mean(np.sum(left.reshape(-1, 2) ** 2, axis=1))))


def _common_mean(squares: Array) -> float:
    """Mean of squared errors (n,) without the largest ones."""
    return float(np.mean(np.sort(squares)[: max(int(_COMMON * len(squares)), 1)])) if len(squares) else 0.0


def _fitted(
    table: CornerTable, used: Bools, model: LensModel, start: Values | None, board: BoardFreedom
) -> ModelCandidate:
    """A model fitted to all views."""
    if start is None:
        return ModelCandidate(model, None, refused="no focal length and no pose of the board explain the corners")
    try:
        found = fit(table, used, model, start, board, limits=BRIEF)
    except AdjustmentError as error:
        return ModelCandidate(model, None, refused=f"it cannot be solved: {error}")
    return ModelCandidate(model, found)


def inliers_of_rich_models(
    table: CornerTable, starts: Sequence[tuple[LensModel, Values]], only: LensModel | None = None
) -> tuple[Bools, list[LensFit]]:
    """Corners (N,) that are inliers of any rich model, and the robust fits of these models, best first.

    A model too small for the lens would reject the corners at the edge of the picture, which distinguish the models.
    The rational model is therefore fitted as well, if the plain ones leave systematic residuals. Raises
    AdjustmentError: no model can be fitted.
    """
    fits: list[LensFit] = []
    reasons: list[str] = []
    for search in (BRIEF, ROUGH):
        for model, values in starts:
            fits += _rich_fit(table, model, values, reasons, search)
        if fits:
            break
    leaves = [
        beyond_noise(*cell_means(table, f), f.sigma_px)[0] < SIGNIFICANT or f.used.mean() < FEWEST_INLIERS for f in fits
    ]
    wanted = only is not None and only.coefficients >= RATIONAL.coefficients
    tried = any(model == RATIONAL for model, _ in starts)
    if not tried and (wanted or (only is None and all(leaves))):
        for found in sorted(fits, key=lambda f: f.sigma_px):
            fits += _rich_fit(table, RATIONAL, as_rational(table, found), reasons, BRIEF)
            if fits[-1].model == RATIONAL:
                break
    if not fits:
        raise AdjustmentError(reasons[-1])
    gate = CORNER_GATE * min(f.sigma_px for f in fits)
    fits.sort(key=lambda f: _schwarz_criterion(table, f, gate))
    # Inliers count only in views that the best fit uses.
    views = table.counts(fits[0].used) > 0
    used = np.any([f.used for f in fits], axis=0) & views[table.view]
    return used, fits


def _rich_fit(
    table: CornerTable, model: LensModel, values: Values, reasons: list[str], search: Limits
) -> list[LensFit]:
    """The robust fit with the bend of the board free if it can be solved for; empty if not even the lens can."""
    for board in (BoardFreedom(warp=True), AS_STATED):
        try:
            return [robust_fit(table, model, values, board, BRIEF, search)]
        except AdjustmentError as error:
            reasons.append(str(error))
    return []


def as_rational(table: CornerTable, found: LensFit) -> Values:
    """The values of a fit, with its lens approximated by a rational one as far out as corners were seen.

    Also those that it rejects: where the approximation folds before them, they could not be predicted.
    """
    if not found.model.fisheye:
        return found.values
    x, y, z = found.poses[table.view].apply(table.points).T
    lens = rational_of_fisheye(found.lens, float(np.nanmax(np.arctan2(np.hypot(x, y), z))))
    return {**found.values, "intrinsics": Vectors(lens[None])}


def _schwarz_criterion(table: CornerTable, found: LensFit, gate_px: float) -> float:
    """Schwarz's information criterion over all corners, with residuals limited to the gate."""
    missed = np.minimum(np.nan_to_num(np.linalg.norm(found.residuals, axis=1) / table.noise, nan=np.inf), gate_px)
    n = 2 * len(table)
    return n * float(np.log(max(np.sum(missed**2) / n, 1e-18))) + found.model.coefficients * np.log(n)


# Mean residuals in cells of the picture, which are noise if the lens model is right.


def cell_means(table: CornerTable, found: LensFit) -> tuple[Array, Array]:
    """Mean residuals (rows, columns, 2), px, and the number of residuals in each cell, by their weights."""
    width, height = table.image_size_px
    pixels, residuals = table.pixels[found.used], found.residuals[found.used]
    columns = int(np.clip(np.sqrt(len(pixels) / _CORNERS_PER_CELL * width / height), 3, _MOST_COLUMNS))
    rows = max(2, round(columns * height / width))
    j = np.clip(((pixels[:, 0] + 0.5) / width * columns).astype(int), 0, columns - 1)
    i = np.clip(((pixels[:, 1] + 0.5) / height * rows).astype(int), 0, rows - 1)
    total, count = np.zeros((rows, columns, 2)), np.zeros((rows, columns))
    weight = 1 / table.noise[found.used] ** 2
    np.add.at(total, (i, j), weight[:, None] * residuals)
    np.add.at(count, (i, j), weight)
    with np.errstate(invalid="ignore"):
        return total / count[..., None], count


def beyond_noise(cells: Array, count: Array, noise_px: float) -> tuple[float, float]:
    """P-value of such means if they are noise, and the RMS (per coordinate, px) of what exceeds it."""
    full = count > 0
    score = float(np.sum(count[full, None] * cells[full] ** 2)) / noise_px**2
    dof = 2 * int(full.sum())
    p = float(chdtrc(dof, score))
    left = noise_px * np.sqrt(max(score - dof, 0.0) / (2 * count.sum()))
    return p, float(left) if p < SIGNIFICANT else 0.0
