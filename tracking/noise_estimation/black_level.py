"""How much of the background's grey level is light: texture is a share of the light, not of the level with its offset.

A camera adds a black level to each pixel. The amplitude of the texture, plotted against the level over an unevenly lit
picture, is a straight line that meets zero at the black level. Source: ours.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array

_TILE = 32  # px: side of the squares in which the texture is measured
_SPARSE = 7  # every such pixel of a tile shows its level, which is smooth
_LARGEST_SHARE = 0.05  # of full scale: usual black levels are between 0 and this
_LEAST_LIGHT = 0.35  # of the level
_UNEVEN = 0.25  # relative scatter of a tile's variance: texture is not the same everywhere
_INDEPENDENT = 40  # tiles: neighbours share what is uneven
_OUTLIER = 9.0  # squared sigmas
_MEDIAN_SQUARE = 0.4549  # median of the square of a standard normal deviate
_LEVELS = 25  # black levels that are tried


def level_over_light(
    texture_dn: NDArray[Any], level_dn: NDArray[Any], white_dn2: float, full_dn: float, black_dn: float | None = None
) -> float:
    """The expected ratio of the background's level to its light: 1 for a black level of zero.

    texture_dn (h, w): a mean picture less its smooth background; level_dn (h, w): that background; white_dn2: variance
    of the noise in texture_dn; full_dn: full scale. A black level between 0 and 5 % of full scale is assumed, as far as
    the texture does not show it, unless it is known: black_dn.
    """
    if black_dn is not None:
        usual = float(np.median(level_dn))
        return usual / max(usual - black_dn, _LEAST_LIGHT * usual) if usual > 0 else 1.0
    rows, columns = (n // _TILE for n in texture_dn.shape)
    if rows * columns < 4:
        return 1.0
    square = _tiles(texture_dn, rows, columns) ** 2
    middle = np.median(square, axis=1) / np.float32(_MEDIAN_SQUARE)
    variance = np.minimum(square, np.float32(_OUTLIER) * middle[:, None]).mean(axis=1, dtype=np.float64) - white_dn2
    level = np.median(_tiles(level_dn, rows, columns)[:, ::_SPARSE], axis=1).astype(float)
    usual = float(np.median(level))
    used = (level > 0) & (level < 2 * usual)
    if not used.any() or usual <= 0:
        return 1.0
    level, variance = level[used], variance[used]
    black = np.linspace(0.0, min(_LARGEST_SHARE * full_dn, (1 - _LEAST_LIGHT) * float(level.min())), _LEVELS)
    fit = np.array([_log_likelihood(level - b, variance, white_dn2) for b in black])
    weight = np.exp((fit - fit.max()) * min(1.0, _INDEPENDENT / len(level)))
    return float(np.sum(weight * usual / (usual - black)) / np.sum(weight))


def _tiles(values: NDArray[Any], rows: int, columns: int) -> NDArray[Any]:
    """(rows * columns, _TILE^2)."""
    cut = values[: rows * _TILE, : columns * _TILE].reshape(rows, _TILE, columns, _TILE)
    return cut.transpose(0, 2, 1, 3).reshape(rows * columns, _TILE * _TILE)


def _log_likelihood(light: Array, variance: Array, white: float) -> float:
    """Of variances (m,) that grow with the square of the light (m,)."""
    contrast2 = max(float(np.median(variance / light**2)), 1e-12)
    expected = contrast2 * light**2
    sigma = _UNEVEN * (expected + white) + 1e-12
    misfit = np.minimum(((variance - expected) / sigma) ** 2, _OUTLIER)
    return float(-0.5 * np.sum(misfit) - np.sum(np.log(sigma)))
