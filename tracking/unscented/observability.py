"""Which states a series of measurements determines: information about the first state, and sigmas with a prior."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, numeric_jacobian, symmetric
from tracking.unscented.sigma_points import Function, square_root

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
