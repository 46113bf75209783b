"""Error of the lens model itself, from correlated residuals and from the other models.

The covariance of the parameters contains the noise of the corners, but not the error of a model that cannot describe
the lens. Two figures show such an error. First, the mean residuals in cells of the picture, which are noise if the
model is right. Second, the difference to the other models, weighted with their probabilities (see
`calibration/lens/fit/model_selection.py`). Both are added to the stated uncertainty. Ours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.lens.fit.corner_table import CornerTable
from calibration.lens.fit.coverage import seen_at
from calibration.lens.fit.lens_fit import LensFit
from calibration.lens.fit.model_selection import ModelSelection, beyond_noise, cell_means
from calibration.lens.fit.projection_map import ProjectionMap
from geometry.arrays import Array


@dataclass(frozen=True, slots=True)
class ModelUncertainty:
    """Model error beyond the covariance of the parameters."""

    p_value: float  # of mean residuals at least as large, if they are noise
    left_px: float  # RMS per coordinate of correlated residuals beyond noise; 0 where not significant
    between_px: float  # RMS difference to the other models where corners were seen, by their probabilities
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
    between = selection.chosen.model_error_px
    claimed = float(np.mean(np.trace(at.covariance_px2(covariance)[inside], axis1=-2, axis2=-1))) if inside.any() else 0
    factor = float(np.sqrt(1 + (between**2 + 2 * left**2) / claimed)) if claimed > 0 else 1.0
    return ModelUncertainty(p, left, between, factor)
