"""Correlation of the errors of neighbouring corners of one photograph, estimated from the residuals of the whole set.

Corners share errors with their neighbours: waves of the board that change from photograph to photograph, shadows and
reflections, pixels of overlapping search windows, blocks of JPEG, a lens that the model describes only nearly. In sets
of real photographs residuals of neighbours are correlated by up to .5, so that there are fewer independent corners than
the sigmas would count. The correlation is rho exp(-d^2 / (2 l^2)) at a distance d on the board, a Gaussian process for
each photograph; rho and l are those whose expected sums of products of residuals, at distances of up to ten spacings,
are nearest to the measured ones. Poses of boards take up what is common to a photograph: the expectation counts it.
Source: ours, from the method of moments for variograms (Cressie 1985, Math. Geology 17).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geometry.arrays import Array

_LAGS = (0.0, 1.5, 3.0, 5.5, 10.0)  # spacings: limits of the distances over which products are summed
_LENGTHS = (0.6, 0.7, 0.8, 0.9, 1.0, 1.2, 1.5, 2.0, 2.8, 4.0)  # spacings: of a correlation that poses do not take up
_SHARES = np.linspace(0.0, 1.0, 41)  # rho, in steps below what a set of photographs determines
_SIGNIFICANT = 4.0  # sigmas of the sum over nearest neighbours: of independent corners one set in 30,000 exceeds it


def correlations(residuals: Sequence[Array], poses: Sequence[Array], places: Sequence[Array]) -> list[Array] | None:
    """(n, n) of the corners of each photograph; None where the residuals do not show any.

    residuals (2 n,): u and v in turn, in sigmas, less what the pose of the board takes up; poses (2 n, 6): orthonormal
    derivatives by it; places (n, k): of the corners, in spacings.
    """
    apart2 = [np.sum((x[:, None] - x[None]) ** 2, axis=2) for x in places]
    bins = len(_LAGS)
    measured, independent, pairs = np.zeros(bins), np.zeros(bins), np.zeros(bins)
    expected = np.zeros((len(_LENGTHS), bins))
    for r, Q, d2 in zip(residuals, poses, apart2, strict=True):
        r, of_corner = r.reshape(-1, 2), Q.reshape(len(d2), -1)  # (n, 2), (n, 12)
        fields = np.array([np.exp(-d2 / (2 * length**2)).ravel() for length in _LENGTHS])
        for b in range(bins):
            near = (d2 <= _LAGS[b] ** 2) & (d2 > _LAGS[b - 1] ** 2) if b else d2 == 0
            W = near.astype(float)
            moved = (W @ of_corner).reshape(Q.shape)
            half = Q @ (0.5 * Q.T @ moved) - moved
            taken = half.reshape(of_corner.shape) @ of_corner.T
            left = 2 * W + taken + taken.T  # W less what the poses take up of it, u and v together
            measured[b] += np.sum(r * (W @ r))
            independent[b] += np.trace(left)
            pairs[b] += W.sum()
            expected[:, b] += fields @ left.ravel()
    if measured[1] - independent[1] * measured[0] / max(independent[0], 1e-300) < _SIGNIFICANT * 2 * np.sqrt(pairs[1]):
        return None
    model = (1 - _SHARES[:, None]) * independent + _SHARES[:, None] * expected[:, None]  # (lengths, shares, bins)
    misfit = measured / measured[0] - model / model[..., :1]
    at = np.unravel_index(np.argmin(np.sum(misfit[..., 1:] ** 2 / pairs.clip(1)[1:], axis=2)), misfit.shape[:2])
    rho, length = float(_SHARES[at[1]]), _LENGTHS[at[0]]
    return [(1 - rho) * np.eye(len(d2)) + rho * np.exp(-d2 / (2 * length**2)) for d2 in apart2]
