"""What the lens model itself may be wrong by: residuals that go together over the picture, and models that fit as well.

A covariance knows the corners' noise and nothing of a lens that the model cannot follow. Two things tell of that. The
mean residuals in cells of the picture: of a lens that follows they are noise. And the other models that predict
held-out photographs as well as the chosen one does: where these draw the same ray elsewhere, the photographs do not
decide between them. What both make is added to the claim. Ours; the second is the spread between models of Bayesian
model averaging (Hoeting et al. 1999, Statistical Science 14), with the largest difference in place of its mean.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.lens.fit.corner_table import CornerTable
from calibration.lens.fit.coverage import seen_at
from calibration.lens.fit.lens_fit import LensFit
from calibration.lens.fit.lens_models import LensModel, undistorted
from calibration.lens.fit.model_selection import Ladder, leaves_something
from calibration.lens.fit.projection_map import ProjectionMap
from calibration.lens.fit.residual_cells import beyond_noise, cell_means
from geometry.arrays import Array, Ints
from geometry.camera import project_points_full

AS_GOOD_SE = 2.0  # standard errors of held-out error within which the photographs do not decide between two models


@dataclass(frozen=True, slots=True)
class ModelDoubt:
    """How far the model may be off, beyond its numbers' covariance."""

    cell_px: Array  # (rows, columns, 2): mean residual in each cell of the picture, projected less measured; nan: none
    cell_count: Ints  # (rows, columns)
    p_value: float  # of residuals whose means are as large, if they were noise
    left_px: float  # RMS per coordinate of what goes together in them beyond noise; 0 where not significant
    other: LensModel | None  # of the models that predict as well, the one that draws most differently
    between_px: float  # how far it differs where corners were seen, RMS, less where it predicts worse; 0: no other
    factor: float  # on the sigmas of the lens, so that the claim holds both


def model_doubt(
    table: CornerTable, found: LensFit, ladder: Ladder, at: ProjectionMap, covariance: Array, scatter: float = 1.0
) -> ModelDoubt:
    """Of a lens with the covariance (p, p) of its numbers, over the part of the picture where corners were seen.

    scatter: factor by which photographs scatter more than noise explains: errors that go together within a photograph
    make means of cells larger as well, and are in the covariance already.
    """
    noise = min([found.sigma_px, *(r.fit.sigma_px for r in ladder.candidates if r.fit is not None)])
    cells, count = cell_means(table, found)
    p, left = beyond_noise(cells, count, noise * scatter)
    inside = seen_at(table, found.used, at.pixels) & np.isfinite(at.by_parameter).all(axis=(2, 3))
    other, between = None, 0.0
    chosen = ladder.chosen
    for rung in ladder.candidates:
        as_good = not rung.refused and rung.behind_px2 <= AS_GOOD_SE * rung.standard_error_px2
        if rung.fit is None or rung.model == found.model or not as_good or leaves_something(rung, chosen):
            continue
        behind = rung.behind_px2 / rung.standard_error_px2 if rung.behind_px2 > 0 else 0.0
        # Weighed by the chance that held-out error leaves it: two standard errors behind, a third counts.
        apart = _apart(at.pixels[inside], found, rung.fit) * float(np.exp(-(behind**2) / 4))
        if apart > between:
            other, between = rung.model, apart
    claimed = float(np.mean(np.trace(at.covariance_px2(covariance)[inside], axis1=-2, axis2=-1))) if inside.any() else 0
    factor = float(np.sqrt(1 + (between**2 + 2 * left**2) / claimed)) if claimed > 0 else 1.0
    return ModelDoubt(cells, count, p, left, other, between, factor)


def _apart(pixels: Array, first: LensFit, second: LensFit) -> float:
    """How far off (RMS, px) another lens draws the rays of the first at pixels (n, 2), the best turn taken out."""
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
