"""The least squares of a lens fit: the observation term of the corners, the priors, and the adjustment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular

from calibration.least_squares.adjustment import (
    Adjusted,
    Anchors,
    Limits,
    Loss,
    Term,
    Values,
    Vectors,
    independent,
    solve,
)
from calibration.lens.fit.corner_table import CornerTable
from calibration.lens.fit.lens_models import LensModel
from calibration.lens.fit.lens_parameters import AS_STATED, BoardFreedom, lens_of
from calibration.terms.corners import INTRINSICS_COUNT, CornerTerm, single_camera
from calibration.terms.surveyed import array_of, pose_of
from geometry.arrays import Array, Bools

CONVERGED = Limits()
# For fits that serve a decision or a start: a twentieth of a sigma is negligible against what they decide. Along the
# valley of parameters that the views hardly determine, the iteration needs very many steps to a thousandth of a sigma.
BRIEF = Limits(steps=40, small_step_sigmas=0.05)
# For outliers where nothing else converges: if photographs contradict each other, steps of reweighting become shorter
# by a few percent each. What is left out is decided by fits without them.
ROUGH = replace(BRIEF, must_converge=False)
# Relative sigma of a radius from the areas of blobs: blur and soft edges change it by .1 to .3 %, equally in all views.
_RADIUS_SIGMA = 0.005
_STATED_RADIUS_SIGMA = 0.02  # relative, of a stated radius: ink spreads and bright areas bloom
_MODERATE, _MODERATE_PRISM = 3.0, 0.1  # sigma of a coefficient times its power of the radius, at the picture's edge
_PRINT_SIGMA = 0.02  # of a point's displacement, in spacings: a wide prior on the common shift, rotation and scale


@dataclass(frozen=True, slots=True)
class FitSettings:
    """Weighting and termination of a fit."""

    sigma_px: float = 1.0  # of a corner's coordinate
    loss: Loss | None = None  # None: squares
    limits: Limits = CONVERGED


def term_of(
    table: CornerTable, used: Bools, fisheye: bool, sigma_px: float = 1.0, loss: Loss | None = None
) -> CornerTerm:
    """The observation term of the used corners (N,)."""
    return single_camera(
        table.pixels[used],
        table.points[used],
        table.middle,
        table.view[used],
        sigma_px * table.noise[used],
        fisheye,
        loss,
        table.point[used],
        None if table.circles is None or table.circles.areas_px2 is None else table.circles.areas_px2[used],
    )


def coefficient_prior(
    table: CornerTable, used: Bools, model: LensModel, values: Values, camera: int = 0
) -> Sequence[Term]:
    """A weak prior that limits the effect of each distortion coefficient on a point at the picture's edge.

    Only for models of more than five coefficients. camera: index of the lens among those of an adjustment.

    Numerator and denominator of the rational model nearly cancel: without the prior, photographs leave combinations of
    its coefficients undetermined, and the iteration diverges slowly along them. Its bias is far below the noise.
    Relative to the start's denominator: with an absolute limit, fx of a lens of 125 deg was 4 sigmas too small.
    """
    if model.coefficients <= 5:
        return ()
    xyz = pose_of(values, "boards")[table.view[used]].apply(table.points[used])
    with np.errstate(invalid="ignore", divide="ignore"):
        r2 = np.nanquantile(np.sum(xyz[:, :2] ** 2, axis=1) / xyz[:, 2] ** 2, 0.99)
    power = np.array([1, 2, 0, 0, 3, 1, 2, 3, 1, 2, 1, 2, 0, 0])
    sigmas = np.full(INTRINSICS_COUNT, np.inf)
    radial = np.array([0, 1, 4, 5, 6, 7])
    # Of a wide lens, numerator and denominator are both large at the edge: what counts is their ratio.
    size = max(1.0, abs(float(1.0 + np.array([r2, r2**2, r2**3]) @ lens_of(values)[9:12])))
    sigmas[4 + radial] = _MODERATE * size / float(r2) ** power[radial]
    prism = np.array([8, 9, 10, 11])
    sigmas[4 + prism] = _MODERATE_PRISM / float(r2) ** power[prism]
    sigmas[~model.free] = np.inf
    return independent("intrinsics", Vectors(np.zeros((1, INTRINSICS_COUNT))), sigmas[None], camera)


def with_circle_radius(table: CornerTable, used: Bools, model: LensModel, values: Values) -> tuple[Values, list[Term]]:
    """The values with an estimate of the circles' radius from the areas of their blobs, and the prior on it.

    Without areas the stated radius is used, or, as the start value of an unknown radius, a quarter of the spacing.
    """
    if table.circles is None:
        return values, []
    term, stated = term_of(table, used, model.fisheye), table.circles.diameter_m
    radius, sigma = table.spacing_m / 4, np.inf
    if term.areas_px2 is not None and used.any():
        radius, sigma = float(term.radii_by_areas(values)[0]), _RADIUS_SIGMA
    elif stated is not None:
        radius, sigma = stated / 2, _STATED_RADIUS_SIGMA
    elif array_of(values, "radius")[0, 0] > 0:
        return values, []
    known = Vectors(np.array([[radius]]))
    prior: list[Term] = list(independent("radius", known, np.array([[radius * sigma]]))) if np.isfinite(sigma) else []
    return {**values, "radius": known}, prior


def prior_terms(table: CornerTable, used: Bools, model: LensModel, values: Values) -> list[Term]:
    """The weak priors of a fit of the whole lens: on the coefficients of rich models, and on the radius of circles."""
    known = with_circle_radius(table, used, model, values)[1]
    return [*known, *coefficient_prior(table, used, model, values)]


def adjust(
    table: CornerTable,
    used: Bools,
    model: LensModel,
    values: Values,
    board: BoardFreedom = AS_STATED,
    settings: FitSettings = FitSettings(),
    lens_free: Bools | None = None,
) -> Adjusted:
    """The least-squares adjustment.

    lens_free (18,): which lens parameters are free; None: those of the model. Coefficients that the model does not have
    are set to 0; fixed shape parameters keep their values. The radius of circles is free together with the lens, with a
    prior from their areas. Raises AdjustmentError: the adjustment is singular or does not converge.
    """
    values = {**values, "intrinsics": Vectors(model.cut(lens_of(values))[None])}
    in_use = table.counts(used) > 0
    whole_lens = lens_free is None
    known: list[Term] = []
    if whole_lens:
        values, known = with_circle_radius(table, used, model, values)
        known += coefficient_prior(table, used, model, values)
    free: dict[str, bool | Bools] = {
        "intrinsics": (model.free if lens_free is None else lens_free)[None],
        "boards": np.repeat(in_use[:, None], 6, axis=1),
        "warp": board.warp and not board.points,
        "stretch": board.stretch and not board.points,
        "radius": whole_lens and table.circles is not None,
    }
    if board.points:
        seen = np.bincount(table.point[used], minlength=len(table.board_points)) > 0
        free["print"] = np.repeat(seen[:, None], 3, axis=1)
        known.append(Anchors("print", np.zeros((len(seen), 3)), _PRINT_SIGMA * table.spacing_m))
    fixed = frozenset(name for name in values if not np.any(free.get(name, False)))
    term = replace(term_of(table, used, model.fisheye, settings.sigma_px, settings.loss), fixed=fixed)
    basis = {"intrinsics": _lens_basis([term, *known], model, values)} if whole_lens and model.coefficients > 5 else {}
    return solve(values, [term, *known], free, settings.limits, basis)


def _lens_basis(terms: Sequence[Term], model: LensModel, values: Values) -> Array:
    """(18, 18): columns are combinations of the lens parameters with orthogonal effects on the corners, about 1 sigma.

    From the R factor of a QR decomposition of the derivatives at the start; the identity if R is singular.
    """
    own = [p.jacobian for t in terms for p in t.linearise(values).parts if p.stack == "intrinsics"]
    rows = np.concatenate([J.reshape(-1, INTRINSICS_COUNT) for J in own])[:, model.free]
    basis = np.eye(INTRINSICS_COUNT)
    scale = np.linalg.norm(rows, axis=0)
    if not (np.isfinite(scale).all() and np.all(scale > 0)):
        return basis
    R = np.linalg.qr(rows / scale, mode="r")
    if np.min(np.abs(np.diagonal(R))) > 1e-12:
        basis[np.ix_(model.free, model.free)] = solve_triangular(R, np.eye(len(R))) / scale[:, None]
    return basis
