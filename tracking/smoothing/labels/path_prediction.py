"""Prediction of a path from its own last points: polynomials in time, with their errors measured on the known part.

Source: ours; the prediction from a spot's own last places is that of Huo, Yang & Yang (2015) in its simplest form.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple, TypeVar

import numpy as np

from geometry.arrays import Array, Ints

POLYNOMIALS = ((1, 2), (1, 4), (2, 3), (2, 5))  # in time: degree, number of points that they are fitted to
MAX_AHEAD = 4  # frames that a path is extrapolated over
REACH = 8  # frames, within which a polynomial's points must lie
MIN_HISTORY = 12  # errors that a polynomial's scale is estimated from
# The errors' distribution is modelled as a mixture: the weight of each component, and the quantile of the measured
# errors that gives its sigma. Smooth motion makes the first component, velocity jumps the last.
COMPONENTS = ((0.6, 0.5), (0.35, 0.95), (0.05, 0.995))

ErrorSigmas = list[list[Array | None]]
"""By polynomial and number of frames ahead: sigmas (components,) px per axis; None if there are too few errors."""


Row = TypeVar("Row")  # of a point of a frame, or those of several points


class Prediction(NamedTuple):
    """Prediction of a path by one polynomial."""

    at: Array  # (2,) px
    sigma: Array  # (components,) px per axis, of the errors

    def density(self, place: Array, cov: Array) -> Array:
        """Density (...), 1/px^2, of the path at places (..., 2) with covariances (..., 2, 2)."""
        S = cov[..., None, :, :] + self.sigma[:, None, None] ** 2 * np.eye(2)  # (..., components, 2, 2)
        e = place - self.at
        d2 = np.einsum("...i,...pij,...j->...p", e, np.linalg.inv(S), e)
        densities = np.exp(-0.5 * d2) / (2 * np.pi * np.sqrt(np.linalg.det(S)))
        return np.asarray(densities @ np.array([w for w, _ in COMPONENTS]))


def error_sigmas(uv: Array) -> ErrorSigmas:
    """The errors of all predictions along the known part of a path uv (T, 2), px; nan where unknown."""
    return [[_error_sigmas(uv, *form, ahead) for ahead in range(1, MAX_AHEAD + 1)] for form in POLYNOMIALS]


def known_before(uv: Array, k: int, direction: int, reach: int) -> Ints:
    """Frames, the nearest first, in which a path uv (T, 2) is known, fewer than `reach` frames before frame k."""
    near = k - direction * np.arange(1, reach)
    near = near[(near >= 0) & (near < len(uv))]
    return np.asarray(near[np.isfinite(uv[near, 0])])


def predictions(uv: Array, sigmas: ErrorSigmas, k: int, direction: int) -> list[Prediction]:
    """Predictions for frame k: short polynomials suit the time after a velocity jump, long ones a smooth path.

    uv (T, 2), px: the path, nan where unknown. direction: of time, 1 or -1.
    """
    near = known_before(uv, k, direction, REACH + MAX_AHEAD)
    if not len(near) or abs(k - near[0]) > MAX_AHEAD:
        return []
    ahead = int(abs(k - near[0]))
    out = []
    for (degree, points), by_distance in zip(POLYNOMIALS, sigmas, strict=True):
        sigma = by_distance[ahead - 1]
        if sigma is None or len(near) < points or abs(near[points - 1] - near[0]) >= REACH:
            continue
        weights = _weights(tuple(np.abs(k - near[:points]).tolist()), degree)
        consecutive = _weights(tuple(range(ahead, ahead + points)), degree)
        # The sigmas hold for consecutive points; points farther apart have larger weights, and so larger errors.
        wider = max(float(np.linalg.norm(weights) / np.linalg.norm(consecutive)), 1.0)
        out.append(Prediction(weights @ uv[near[:points]], sigma * wider))
    return out


def mean_density(of: list[Prediction], place: Array, cov: Array) -> Array:
    """Density (...), 1/px^2, of a path by all its predictions; arguments as of `Prediction.density`."""
    return np.asarray(np.mean([p.density(place, cov) for p in of], axis=0))


def agreed(sides: list[tuple[Row, float] | None], least: float) -> tuple[Row, float] | None:
    """The answer of a path from both of its ends, with the larger of the two probabilities; None: there is none.

    sides: points and their probability from each end that reaches a frame; None: searched without success. Where both
    ends reach, they must agree, or the probability of the one that found points must be at least `least`.
    """
    found = [s for s in sides if s is not None]
    if len({row for row, _ in found}) != 1:
        return None
    p = max(p for _, p in found)
    return (found[0][0], p) if len(found) == len(sides) or p >= least else None


@cache
def _weights(ago: tuple[int, ...], degree: int) -> Array:
    """Weights (m,) of points so many frames ago for the present value of a polynomial fitted to them."""
    at = -np.array(ago, dtype=float)
    return np.asarray(np.linalg.pinv(np.vander(at, degree + 1, increasing=True))[0])


def _error_sigmas(uv: Array, degree: int, points: int, ahead: int) -> Array | None:
    """Sigmas (components,) per axis, px, of predictions so many frames ahead along a labelled path uv (T, 2).

    None if there are too few labels.
    """
    weights = _weights(tuple(range(ahead, ahead + points)), degree)
    n = len(uv) - ahead - points + 1
    if n < MIN_HISTORY:
        return None
    predicted = sum(w * uv[points - 1 - j : points - 1 - j + n] for j, w in enumerate(weights))
    squared = np.sum((uv[points - 1 + ahead :][:n] - predicted) ** 2, axis=1)
    squared = squared[np.isfinite(squared)]
    if len(squared) < MIN_HISTORY:
        return None
    # The squared distance of a two-dimensional Gaussian is exponentially distributed; the tail's sigma is its quantile.
    core = [np.quantile(squared, q) / (-2 * np.log(1 - q)) for _, q in COMPONENTS[:-1]]
    return np.asarray(np.sqrt([*core, np.quantile(squared, COMPONENTS[-1][1]) / 2]))
