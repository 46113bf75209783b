"""Mean residuals in cells of the picture, which are noise if the lens model is right."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtrc

from calibration.lens.fit.corner_table import CornerTable
from calibration.lens.fit.lens_fit import LensFit
from geometry.arrays import Array

SIGNIFICANT = 1e-3  # p-value of the mean residuals below which the lens model is wrong
_CORNERS_PER_CELL = 12
_MOST_COLUMNS = 16


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
