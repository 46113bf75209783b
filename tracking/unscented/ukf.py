"""The unscented Kalman filter: prediction and update as functions of state, covariance and two given functions.

    x, P = predict(x, P, process, Q)
    x, P = (step := update(x, P, z, measurement, R)).x, step.P

`process` and `measurement` take rows of points, (k, n), and return rows, so that one call serves all sigma points.
Process and measurement noise are additive. The covariances come from matrix square roots: they are symmetric and
positive semidefinite in every step, whatever the functions do.

Source: Julier & Uhlmann (2004); the array form of the update follows van der Merwe & Wan, "The square-root unscented
Kalman filter", ICASSP 2001.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array
from tracking.unscented.sigma_points import (
    NUMBERS,
    USUAL,
    Function,
    Space,
    Spread,
    deviations,
    sigma_points,
    square_root,
)


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
