"""The unscented Kalman filter of Fu (2016): sigma points, robust updates, the filter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array
from geometry.uncertainty.chi_square import chi2_limit

# Sigma points and the unscented transform: mean and covariance of a function of a random vector.
#
# Source: Julier & Uhlmann, "Unscented filtering and nonlinear estimation", Proc. IEEE 92(3), 2004; scaling by Wan &
# van der Merwe (2000). The covariance is computed in a form that rounding and negative weights cannot make indefinite
# (ours, see `deviations`).

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


# Robust updates of the unscented Kalman filter: a Mahalanobis gate and Student's t noise.
#
# Both take the place of `ukf.update` and have no memory of their own.


def gated_update(
    x: Array,
    P: Array,
    z: Array,
    measurement: Function,
    R: Array,
    spread: Spread = USUAL,
    space: Space = NUMBERS,
    of: Space = NUMBERS,
    *,
    p_false_alarm: float = 1e-3,
) -> Updated:
    """As `ukf.update`, but a measurement whose normalised innovation is too large is not used.

    p_false_alarm: probability that a correct measurement is left out. The gate is closed for as long as the prediction
    is wrong by more than its sigmas say: after a long disturbance it can stay closed. Use it where the process noise
    covers the motion; otherwise use `student_t_update`.

    Raises:
        ValueError: as `ukf.update`.
    """
    compared = Measured.of(x, P, z, measurement, R, spread, space, of)
    return compared.update(1.0 if compared.nis() <= chi2_limit(p_false_alarm, len(z)) else 0.0)


def student_t_update(
    x: Array,
    P: Array,
    z: Array,
    measurement: Function,
    R: Array,
    spread: Spread = USUAL,
    space: Space = NUMBERS,
    of: Space = NUMBERS,
    *,
    dof: float = 4.0,
    p_full_weight: float = 1e-2,
    power: float = 2.0,
) -> Updated:
    """As `ukf.update`, with heavy tails of the measurement noise where the innovation is unlikely.

    R is divided by the weight w = ((dof + limit) / (dof + nis))^power, at most 1, with the chi-square limit of
    `p_full_weight`: measurements that fit a Gaussian keep their full weight, so the filter equals the standard one
    while nothing is wrong. A measurement is never left out entirely, so the filter recovers after any disturbance.
    power 1 is the weight of the multivariate t distribution; with it the effect of an outlier decreases as 1 / size. A
    slow disturbance of many frames needs a faster decrease. Measured (`beampose study fu2016`): with power 2 the peaks
    during a smooth error of 2 m are about half of those with power 1; power 3 is no better.

    Raises:
        ValueError: as `ukf.update`.

    Source: Roth, Ozkan & Gustafsson, "A Student's t filter for heavy tailed process and measurement noise", ICASSP
    2013, for the weight; limit and power are ours.
    """
    compared = Measured.of(x, P, z, measurement, R, spread, space, of)
    limit = chi2_limit(p_full_weight, len(z))
    return compared.update(min(1.0, (dof + limit) / (dof + compared.nis())) ** power)


# The unscented Kalman filter: prediction and update as functions of state, covariance and two given functions.
#
#     x, P = predict(x, P, process, Q)
#     x, P = (step := update(x, P, z, measurement, R)).x, step.P
#
# `process` and `measurement` take rows of points, (k, n), and return rows, so that one call serves all sigma points.
# Process and measurement noise are additive. The covariances come from matrix square roots: they are symmetric and
# positive semidefinite in every step, whatever the functions do.
#
# Source: Julier & Uhlmann (2004); the array form of the update follows van der Merwe & Wan, "The square-root unscented
# Kalman filter", ICASSP 2001.


@dataclass(frozen=True, slots=True)
class Updated:
    """The result of an update with m numbers."""

    x: Array  # (p,)
    P: Array  # (n, n)
    innovation: Array  # (m,) measured minus predicted
    innovation_covariance: Array  # (m, m)
    nis: float  # normalised innovation squared: chi-square with m degrees of freedom for a correct model
    weight: float = 1.0  # that a robust update gave the measurement; 0: not used


def predict(
    x: Array, P: Array, process: Function, Q: Array, spread: Spread = USUAL, space: Space = NUMBERS
) -> tuple[Array, Array]:
    """State x (p,) and covariance P (n, n) one step later; Q (n, n) is added.

    Raises:
        ValueError: P has a negative eigenvalue.
    """
    values = process(sigma_points(x, P, spread, space))
    mean, D = deviations(values, len(P), spread, space)
    return mean, D.T @ D + 0.5 * (Q + Q.T)


def update(
    x: Array,
    P: Array,
    z: Array,
    measurement: Function,
    R: Array,
    spread: Spread = USUAL,
    space: Space = NUMBERS,
    of: Space = NUMBERS,
) -> Updated:
    """The state after the measurement z (m,) with noise R (m, m). space, of: those of the state and of z.

    Raises:
        ValueError: P or R has a negative eigenvalue, or the innovation covariance is singular.
    """
    return Measured.of(x, P, z, measurement, R, spread, space, of).update()


@dataclass(frozen=True, slots=True)
class Measured:
    """A predicted state compared with a measurement, before the update: robust updates choose R from it."""

    x: Array  # (p,)
    innovation: Array  # (m,)
    dx: Array  # (2n + 1, n) weighted deviations of the state: P = dx^T dx
    dz: Array  # (2n + 1, m) weighted deviations of the predicted measurement
    R: Array  # (m, m)
    space: Space

    @staticmethod
    def of(
        x: Array, P: Array, z: Array, measurement: Function, R: Array, spread: Spread, space: Space, of: Space
    ) -> Measured:
        """As `update`. Raises ValueError."""
        points = sigma_points(x, P, spread, space)
        predicted, dz = deviations(measurement(points), len(P), spread, of)
        dx = np.concatenate([space.minus(points[1:], x) / np.sqrt(2 * spread.scale(len(P))), np.zeros((1, len(P)))])
        return Measured(x, of.minus(z[None], predicted)[0], dx, dz, R, space)

    def covariance(self) -> Array:
        """The innovation covariance S (m, m), px^2 or what the measurement has."""
        return self.dz.T @ self.dz + self.R

    def nis(self) -> float:
        """Normalised innovation squared. Raises ValueError where S is singular."""
        try:
            return float(self.innovation @ np.linalg.solve(self.covariance(), self.innovation))
        except np.linalg.LinAlgError:
            raise ValueError("innovation covariance: expected an invertible matrix, got a singular one") from None

    def update(self, weight: float = 1.0) -> Updated:
        """The update with R divided by `weight`; weight 0 leaves the state as it was.

        The QR decomposition of [[dz, dx], [R^(1/2)^T, 0]] has the triangular factor [[S^(1/2)^T, G^T], [0, P^(1/2)^T]],
        with the gain K = G S^(-1/2) and the new covariance P^(1/2) P^(1/2)^T, for which nothing is subtracted.

        Raises:
            ValueError: the innovation covariance is singular, or R has a negative eigenvalue.
        """
        nis = self.nis()
        if weight <= 0:
            return Updated(self.x, self.dx.T @ self.dx, self.innovation, self.covariance(), nis, 0.0)
        m, n = len(self.innovation), self.dx.shape[1]
        noise = np.concatenate([square_root(self.R / weight).T, np.zeros((m, n))], axis=1)
        stacked = np.concatenate([np.concatenate([self.dz, self.dx], axis=1), noise])
        triangle: Array = np.asarray(np.linalg.qr(stacked, mode="r"), dtype=float)
        root_S, gain, root_P = triangle[:m, :m], triangle[:m, m:], triangle[m:, m:]
        step = np.linalg.solve(root_S.T, self.innovation) @ gain
        return Updated(
            self.space.plus(self.x, step[None])[0],
            root_P.T @ root_P,
            self.innovation,
            self.covariance(),
            nis,
            weight,
        )
