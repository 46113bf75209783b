"""The model of Fu (2016), and which of its states a series of measurements determines."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from geometry.arrays import Array, numeric_jacobian, symmetric
from tracking.unscented.ukf import Function, Spread, Updated, predict, square_root, update

# Which states a series of measurements determines: information about the first state, and sigmas with a prior.

DETERMINED = 1.0  # information, in units of the prior's, from which a direction counts as observed


@dataclass(frozen=True, slots=True)
class Observability:
    """What measurements add to a prior of n states."""

    information: Array  # (n, n) of the first state, without the prior
    rank: int  # number of directions that the measurements determine better than the prior
    sigma_prior: Array  # (n,)
    sigma: Array  # (n,) with prior and measurements, without process noise
    unobserved: Array  # (n, n - rank) directions that are not observed, columns, in units of the prior's sigmas

    def observed(self, largest_ratio: float = 0.5) -> tuple[bool, ...]:
        """For each state: whether the measurements reduce its sigma to this share of the prior's, or less."""
        return tuple(bool(b) for b in self.sigma <= largest_ratio * self.sigma_prior)


def observability(states: Array, process: Function, measurement: Function, R: Array, prior: Array) -> Observability:
    """The observability of the first of T states along a trajectory (T, n), for one measurement per state.

    process, measurement: rows (k, n) to rows, as for the filter; both are linearised along the trajectory. R (m, m):
    noise of a measurement; prior (n, n): covariance of the first state. The information is the observability Gramian
    sum_k Phi_k^T H_k^T R^-1 H_k Phi_k with Phi_k = F_(k-1) ... F_0.

    Raises:
        ValueError: R or the prior is not positive definite.

    Source: Gelb (ed.), "Applied optimal estimation" (1974), section 3.3.
    """
    n = states.shape[1]
    whiten = np.linalg.inv(square_root(R))
    transition, information = np.eye(n), np.zeros((n, n))
    for x in states:
        H = whiten @ numeric_jacobian(lambda a: measurement(a[None])[0], x) @ transition
        information += H.T @ H
        transition = numeric_jacobian(lambda a: process(a[None])[0], x) @ transition
    root = square_root(prior)
    values, vectors = np.linalg.eigh(symmetric(root.T @ information @ root))
    low = values < DETERMINED
    left = root @ vectors / np.sqrt(1 + np.maximum(values, 0.0))
    sigma_prior = np.sqrt(np.diagonal(prior))
    return Observability(
        information,
        int(np.count_nonzero(~low)),
        sigma_prior,
        np.linalg.norm(left, axis=1),
        root @ vectors[:, low] / sigma_prior[:, None],
    )


# The filter of Fu (2016): relative state of a tanker and a receiver, and the printed modification of the update.
#
# State (8,): position x, y, z of the tanker relative to the receiver's camera, m (x ahead), its velocity, m/s, and the
# relative yaw and pitch, rad. Measurement (4,): y, z, yaw, pitch (eq. 4).
#
# Source: Fu, Kong, Dong, Zhi & Gao, Journal of Applied Optics 37(6), 860 (2016). Misprints and the forms used here are
# listed in docs/papers/fu2016.md.


STATES = ("x", "y", "z", "velocity x", "velocity y", "velocity z", "yaw", "pitch")
SPREAD = Spread(alpha=0.55, beta=2.0, kappa=-5.0)  # lambda = -7.0925, as printed
MEASURED = (1, 2, 6, 7)  # the numbers 2, 3, 7 and 8 of the state: eq. (4)
X0 = np.array([21.0, 9.0, 0.5, 0.4, 0.5, 0.5, 0.4, 0.0])
P0 = np.diag(np.array([50.0, 20.0, 5.0, 50.0, 20.0, 5.0, 5.0, 5.0]) / 3) ** 2  # eq. (10)
Q = 2e-5 * np.eye(8)
R = 1e-3 * np.eye(4)  # printed as 8 x 4
STATE_THRESHOLD, MEASUREMENT_THRESHOLD = 0.005, 0.125  # of eqs. (11) and (12)
MEMORY = 5  # measurements of eq. (13)


def process(dt_s: float) -> Callable[[Array], Array]:
    """The motion over a time step: constant velocity and angles; rows of states (k, 8) to rows.

    Eqs. (2) and (3) with the unknown accelerations and rates as noise. The printed matrix of eq. (8) couples the second
    half of the state back into the first and grows by 1.1 in every step; this is the form of eqs. (2) and (3).
    """
    F = np.eye(8)
    F[:3, 3:6] = dt_s * np.eye(3)
    return lambda states: states @ F.T


def selection(states: Array) -> Array:
    """Eq. (4): y, z, yaw and pitch (k, 4) of states (k, 8)."""
    return states[:, list(MEASURED)]


def bearings(states: Array) -> Array:
    """Eq. (5): y, z and the directions atan(y / x), atan(z / x), rad, in which the tanker is seen (k, 4)."""
    x, y, z = states[:, 0], states[:, 1], states[:, 2]
    return np.stack([y, z, np.arctan2(y, x), np.arctan2(z, x)], axis=-1)


@dataclass(slots=True)
class PrintedFilter:
    """The modification as printed: eqs. (11) to (13) on every number of measurement and state.

    A measurement is replaced by the mean of the last five, each weighted by its own value over their sum, and by 0
    where it differs from the one before by more than 12.5 % (eqs. 12 and 13). A number of the state that the update
    changes by more than 0.5 % keeps its previous value (text below eq. 14; the branches of eq. 11 are printed
    identical). The covariance is that of the standard filter: the paper gives no other.
    """

    x: Array = field(default_factory=X0.copy)
    P: Array = field(default_factory=P0.copy)
    _raw: list[Array] = field(default_factory=list)

    def step(self, z: Array, dt_s: float) -> Updated:
        """The state after the next measurement z (4,)."""
        self._raw = [*self._raw[-MEMORY:], z]
        x, P = predict(self.x, self.P, process(dt_s), Q, SPREAD)
        step = update(x, P, self._weighted(), selection, R, SPREAD)
        with np.errstate(divide="ignore", invalid="ignore"):
            steady = np.abs(step.x / self.x - 1) < STATE_THRESHOLD
        self.x, self.P = np.where(steady, step.x, self.x), step.P
        return Updated(self.x, self.P, step.innovation, step.innovation_covariance, step.nis)

    def _weighted(self) -> Array:
        """Eq. (13): the replaced measurement (4,); the measurement itself until there are five, and without weights."""
        if len(self._raw) <= MEMORY:
            return self._raw[-1]
        raw = np.array(self._raw)
        last, before = raw[1:], raw[:-1]
        with np.errstate(divide="ignore", invalid="ignore"):
            delta = np.where(np.abs(last / before - 1) <= MEASUREMENT_THRESHOLD, last / last.sum(axis=0), 0.0)
            delta = delta / delta.sum(axis=0)  # not printed: without it a single weight of 0 pulls the mean to 0
        mean = (delta * last).sum(axis=0)
        return np.where(np.isfinite(mean), mean, raw[-1])
