"""Sigma points and the unscented transform: mean and covariance of a function of a random vector.

Source: Julier & Uhlmann, "Unscented filtering and nonlinear estimation", Proc. IEEE 92(3), 2004; scaling by Wan & van
der Merwe (2000). The covariance is computed in a form that rounding and negative weights cannot make indefinite (ours,
see `deviations`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array

Function = Callable[[Array], Array]  # (k, n) -> (k, m): rows are independent points


@dataclass(frozen=True, slots=True)
class Spread:
    """How far the sigma points lie from the mean, and the weight of the central point in the covariance.

    The points of a vector of n numbers lie at sqrt(alpha^2 (n + kappa)) sigmas. Defaults (ours): no negative weight for
    any n. Fu (2016) uses alpha 0.55, beta 2, kappa -5.

    Raises:
        ValueError: alpha is not above 0, or beta is below alpha^2: the covariance would not always be positive
            semidefinite.
    """

    alpha: float = 1.0
    beta: float = 2.0  # 2 is best for a Gaussian
    kappa: float = 0.0

    def __post_init__(self) -> None:
        if not self.alpha > 0:
            raise ValueError(f"alpha: expected a number above 0, got {self.alpha}")
        if not self.beta >= self.alpha**2:
            raise ValueError(f"beta: expected alpha^2 = {self.alpha**2:g} or more, got {self.beta}")

    def scale(self, n: int) -> float:
        """n + lambda of eq. (9) of Fu (2016), for a vector of n numbers.

        Raises:
            ValueError: kappa is -n or less.
        """
        if not n + self.kappa > 0:
            raise ValueError(f"kappa: expected more than -{n} for {n} numbers, got {self.kappa}")
        return self.alpha**2 * (n + self.kappa)

    def weights(self, n: int) -> tuple[Array, Array]:
        """Weights (2n + 1,) of the mean and of the covariance, the central point first.

        Source: eq. (9) of Fu (2016); printed "1/2(n + lambda)" means 1 / (2 (n + lambda)). For his values, n = 8:
        -7.815, -5.118 and 0.55096.
        """
        scale = self.scale(n)
        mean = np.full(2 * n + 1, 1 / (2 * scale))
        mean[0] = 1 - n / scale
        covariance = mean.copy()
        covariance[0] += 1 - self.alpha**2 + self.beta
        return mean, covariance


USUAL = Spread()


@dataclass(frozen=True, slots=True)
class Space:
    """How vectors are changed and compared, for vectors that are not plain numbers (angles, rotations).

    plus(x, d): x (p,) changed by each row of d (k, n), as (k, p). minus(a, b): the d (k, n) that changes b (p,) into
    each row of a (k, p). Covariances are those of d.
    """

    plus: Callable[[Array, Array], Array]
    minus: Callable[[Array, Array], Array]


NUMBERS = Space(np.add, np.subtract)


def with_angles(columns: Sequence[int]) -> Space:
    """Numbers of which some columns are angles, rad: their differences are taken in [-pi, pi)."""
    index = list(columns)

    def minus(a: Array, b: Array) -> Array:
        d = np.subtract(a, b)
        d[..., index] = (d[..., index] + np.pi) % (2 * np.pi) - np.pi
        return d

    return Space(np.add, minus)


def square_root(P: Array) -> Array:
    """A matrix L (n, n) with L L^T = P, for a positive semidefinite P (n, n).

    Eigenvalues that rounding has made negative count as zero.

    Raises:
        ValueError: P is clearly indefinite, or not finite.
    """
    try:
        return np.asarray(np.linalg.cholesky(P), dtype=float)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(P) if np.isfinite(P).all() else (np.array([np.nan]), P)
        if not values[0] >= -1e-9 * max(values[-1], 1e-300):
            raise ValueError(f"covariance: expected no negative eigenvalue, got {values[0]:.3g}") from None
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)), dtype=float)


def sigma_points(x: Array, P: Array, spread: Spread = USUAL, space: Space = NUMBERS) -> Array:
    """The points (2n + 1, p) of a mean x (p,) and covariance P (n, n); the mean first."""
    n = len(P)
    columns = np.sqrt(spread.scale(n)) * square_root(P).T
    return space.plus(x, np.concatenate([np.zeros((1, n)), columns, -columns]))


def deviations(values: Array, n: int, spread: Spread, space: Space = NUMBERS) -> tuple[Array, Array]:
    """Mean (p,) and weighted deviations D (2n + 1, m) of the function values (2n + 1, p) at the sigma points.

    The covariance is D^T D. With d_i the difference of value i to the central value and w = 1 / (2 (n + lambda)), the
    weighted mean is d = w sum d_i, and the usual sum of the weighted squares about the mean equals
    w sum d_i d_i^T + (beta - alpha^2) d d^T: no term is negative, although the central weight is. Source: ours.
    """
    w = 1 / (2 * spread.scale(n))
    d = space.minus(values[1:], values[0])
    mean = w * d.sum(axis=0)
    D = np.concatenate([np.sqrt(w) * d, np.sqrt(spread.beta - spread.alpha**2) * mean[None]])
    return space.plus(values[0], mean[None])[0], D


def transform(
    x: Array, P: Array, function: Function, spread: Spread = USUAL, space: Space = NUMBERS, of: Space = NUMBERS
) -> tuple[Array, Array]:
    """Mean (p,) and covariance (m, m) of a function of a random vector with mean x and covariance P (n, n).

    function: (2n + 1, ...) rows to (2n + 1, p) rows. space, of: those of x and of the values.
    """
    mean, D = deviations(function(sigma_points(x, P, spread, space)), len(P), spread, of)
    return mean, D.T @ D
