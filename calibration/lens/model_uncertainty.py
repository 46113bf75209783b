"""Error of the lens model itself, from correlated residuals and from rival models that predict equally well.

The covariance of the parameters contains the noise of the corners, but not the error of a model that cannot describe
the lens. Two figures show such an error. First, the mean residuals in cells of the picture, which are noise if the
model is right. Second, other models that predict held-out photographs as well as the chosen one: where their rays
differ, the photographs do not decide between the models. Both are added to the stated uncertainty. Ours; the second is
the between-model variance of Bayesian model averaging (Hoeting et al. 1999, Statistical Science 14), with the largest
difference in place of the mean.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.lens.fit.corner_table import CornerTable
from calibration.lens.fit.coverage import seen_at
from calibration.lens.fit.lens_fit import LensFit
from calibration.lens.fit.lens_models import LensModel, undistorted
from calibration.lens.fit.model_selection import ModelSelection, leaves_systematic_residuals
from calibration.lens.fit.projection_map import ProjectionMap
from calibration.lens.fit.residual_cells import beyond_noise, cell_means
from geometry.arrays import Array, Ints
from geometry.camera import project_points_full

AS_GOOD_SE = 2.0  # standard errors of the hold-out error within which two models count as equally good


@dataclass(frozen=True, slots=True)
class ModelUncertainty:
    """Model error beyond the covariance of the parameters."""

    cell_px: Array  # (rows, columns, 2): mean residual per cell of the picture, projected minus measured; nan: empty
    cell_count: Ints  # (rows, columns)
    p_value: float  # of mean residuals at least as large, if they are noise
    left_px: float  # RMS per coordinate of correlated residuals beyond noise; 0 where not significant
    other: LensModel | None  # the most different of the models that predict equally well
    between_px: float  # RMS difference to it where corners were seen, reduced if it predicts worse; 0: no other
    factor: float  # on the sigmas of the lens, so that they include both


def estimate_model_uncertainty(
    table: CornerTable,
    found: LensFit,
    selection: ModelSelection,
    at: ProjectionMap,
    covariance: Array,
    scatter: float = 1.0,
) -> ModelUncertainty:
    """Model error of a lens with parameter covariance (p, p), over the part of the picture where corners were seen.

    scatter: factor by which photographs scatter more than noise explains. Errors that are correlated within a
    photograph also enlarge the means of cells, and are already in the covariance.
    """
    noise = min([found.sigma_px, *(r.fit.sigma_px for r in selection.candidates if r.fit is not None)])
    cells, count = cell_means(table, found)
    p, left = beyond_noise(cells, count, noise * scatter)
    inside = seen_at(table, found.used, at.pixels) & np.isfinite(at.by_parameter).all(axis=(2, 3))
    other, between = None, 0.0
    chosen = selection.chosen
    for candidate in selection.candidates:
        as_good = not candidate.refused and candidate.excess_px2 <= AS_GOOD_SE * candidate.standard_error_px2
        if (
            candidate.fit is None
            or candidate.model == found.model
            or not as_good
            or leaves_systematic_residuals(candidate, chosen)
        ):
            continue
        excess_se = candidate.excess_px2 / candidate.standard_error_px2 if candidate.excess_px2 > 0 else 0.0
        # Weight by the probability of the hold-out error: 1/e at two standard errors.
        difference_px = _difference_px(at.pixels[inside], found, candidate.fit) * float(np.exp(-(excess_se**2) / 4))
        if difference_px > between:
            other, between = candidate.model, difference_px
    claimed = float(np.mean(np.trace(at.covariance_px2(covariance)[inside], axis1=-2, axis2=-1))) if inside.any() else 0
    factor = float(np.sqrt(1 + (between**2 + 2 * left**2) / claimed)) if claimed > 0 else 1.0
    return ModelUncertainty(cells, count, p, left, other, between, factor)


def _difference_px(pixels: Array, first: LensFit, second: LensFit) -> float:
    """RMS difference (px) at pixels (n, 2) between the rays of two lenses, after the best-fitting rotation."""
    flat = undistorted(pixels, first.lens, first.model.fisheye)
    rays = np.concatenate([flat, np.ones((len(flat), 1))], axis=1)
    wide = np.asarray(second.model.fisheye)
    seen = project_points_full(rays, second.lens[:4], second.lens[4:], np.asarray(np.inf), wide)
    away = seen.pixels - pixels
    good = np.isfinite(away).all(axis=1)
    turn = np.cross(rays[:, None, :], seen.d_point)[good].reshape(-1, 3)
    moved = away[good].reshape(-1)
    left = moved - turn @ np.linalg.lstsq(turn, moved, rcond=None)[0]
    return float(np.sqrt(np.sum(left**2) / max(int(good.sum()), 1)))
