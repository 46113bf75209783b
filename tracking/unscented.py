"""The unscented Kalman filter of Fu (2016): sigma points, robust updates, his model, observability of its states."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from geometry.arrays import Array, numeric_jacobian, symmetric
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
    any n. Fu (2016) uses alpha 0.55, beta 2, kappa -5. Raises ValueError: alpha is not above 0, or beta is below
    alpha^2: the covariance would not always be positive semidefinite.
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
        """n + lambda of eq. (9) of Fu (2016), for a vector of n numbers. Raises ValueError: kappa is -n or less."""
        if not n + self.kappa > 0:
            raise ValueError(f"kappa: expected more than -{n} for {n} numbers, got {self.kappa}")
        return self.alpha**2 * (n + self.kappa)


USUAL = Spread()


def square_root(P: Array) -> Array:
    """A matrix L (n, n) with L L^T = P, for a positive semidefinite P (n, n).

    Eigenvalues that rounding has made negative count as zero. Raises ValueError: P is clearly indefinite, or not
    finite.
    """
    try:
        return np.asarray(np.linalg.cholesky(P), dtype=float)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(P) if np.isfinite(P).all() else (np.array([np.nan]), P)
        if not values[0] >= -1e-9 * max(values[-1], 1e-300):
            raise ValueError(f"covariance: expected no negative eigenvalue, got {values[0]:.3g}") from None
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)), dtype=float)


def sigma_points(x: Array, P: Array, spread: Spread = USUAL) -> Array:
    """The points (2n + 1, n) of a mean x (n,) and covariance P (n, n); the mean first."""
    columns = np.sqrt(spread.scale(len(P))) * square_root(P).T
    return x + np.concatenate([np.zeros((1, len(P))), columns, -columns])


def deviations(values: Array, n: int, spread: Spread) -> tuple[Array, Array]:
    """Mean (m,) and weighted deviations D (2n + 1, m) of the function values (2n + 1, m) at the sigma points.

    The covariance is D^T D. With d_i the difference of value i to the central value and w = 1 / (2 (n + lambda)), the
    weighted mean is d = w sum d_i, and the usual sum of the weighted squares about the mean equals
    w sum d_i d_i^T + (beta - alpha^2) d d^T: no term is negative, although the central weight is. Source: ours.
    """
    w = 1 / (2 * spread.scale(n))
    d = values[1:] - values[0]
    mean = w * d.sum(axis=0)
    D = np.concatenate([np.sqrt(w) * d, np.sqrt(spread.beta - spread.alpha**2) * mean[None]])
    return values[0] + mean, D


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

Rule = Callable[[float, int], float]  # normalised innovation squared of m numbers, and m -> the measurement's weight


def full_weight(nis: float, m: int) -> float:
    """The rule of the standard filter."""
    return 1.0


def gate(nis: float, m: int, p_false_alarm: float = 1e-3) -> float:
    """A measurement whose normalised innovation is too large is not used.

    p_false_alarm: probability that a correct measurement is left out. The gate is closed for as long as the prediction
    is wrong by more than its sigmas say: after a long disturbance it can stay closed. Use it where the process noise
    covers the motion; otherwise use `student_t`.
    """
    return 1.0 if nis <= chi2_limit(p_false_alarm, m) else 0.0


def student_t(nis: float, m: int, dof: float = 4.0, p_full_weight: float = 1e-2, power: float = 2.0) -> float:
    """Heavy tails of the measurement noise where the innovation is unlikely.

    The weight is ((dof + limit) / (dof + nis))^power, at most 1, with the chi-square limit of `p_full_weight`:
    measurements that fit a Gaussian keep their full weight, so the filter equals the standard one while nothing is
    wrong. A measurement is never left out entirely, so the filter recovers after any disturbance. power 1 is the weight
    of the multivariate t distribution; with it the effect of an outlier decreases as 1 / size. A slow disturbance of
    many frames needs a faster decrease. Measured (`beampose study fu2016`): with power 2 the peaks during a smooth
    error of 2 m are about half of those with power 1; power 3 is no better.

    Source: Roth, Ozkan & Gustafsson, "A Student's t filter for heavy tailed process and measurement noise", ICASSP
    2013, for the weight; limit and power are ours.
    """
    return min(1.0, (dof + chi2_limit(p_full_weight, m)) / (dof + nis)) ** power


@dataclass(slots=True)
class Lasting:
    """A rule for disturbances of several steps: each measurement gets the least weight of its own and the last ones.

    Amid a disturbance a measurement is near the prediction now and then by chance; it then pulls the state with full
    weight. Start a new one with each filter. Source: ours; measured in docs/papers/fu2016.md.
    """

    rule: Rule = student_t
    steps: int = 2  # that share the least weight, the present one included
    _weights: list[float] = field(default_factory=list)

    def __call__(self, nis: float, m: int) -> float:
        """The weight of the next measurement."""
        self._weights = [*self._weights, self.rule(nis, m)][-self.steps :]
        return min(self._weights)


@dataclass(frozen=True, slots=True)
class Updated:
    """The result of an update with m numbers."""

    x: Array  # (n,)
    P: Array  # (n, n)
    innovation: Array  # (m,) measured minus predicted
    innovation_covariance: Array  # (m, m)
    nis: float  # normalised innovation squared: chi-square with m degrees of freedom for a correct model
    weight: float = 1.0  # that the rule gave the measurement; 0: not used


def predict(x: Array, P: Array, process: Function, Q: Array, spread: Spread = USUAL) -> tuple[Array, Array]:
    """State x (n,) and covariance P (n, n) one step later; Q (n, n) is added.

    Raises ValueError: P has a negative eigenvalue.
    """
    mean, D = deviations(process(sigma_points(x, P, spread)), len(P), spread)
    return mean, D.T @ D + 0.5 * (Q + Q.T)


def update(
    x: Array, P: Array, z: Array, measurement: Function, R: Array, spread: Spread = USUAL, rule: Rule = full_weight
) -> Updated:
    """The state after the measurement z (m,) with noise R (m, m), divided by the weight that the rule gives it.

    With the weighted deviations dx (2n + 1, n) of the state and dz (2n + 1, m) of the predicted measurement, the QR
    decomposition of [[dz, dx], [R^(1/2)^T, 0]] has the triangular factor [[S^(1/2)^T, G^T], [0, P^(1/2)^T]], with the
    gain K = G S^(-1/2) and the new covariance P^(1/2) P^(1/2)^T, for which nothing is subtracted. Weight 0 leaves the
    state as it was. Raises ValueError: P or R has a negative eigenvalue, or the innovation covariance is singular.
    """
    n, m = len(P), len(z)
    points = sigma_points(x, P, spread)
    predicted, dz = deviations(measurement(points), n, spread)
    dx = np.concatenate([(points[1:] - x) / np.sqrt(2 * spread.scale(n)), np.zeros((1, n))])
    innovation, S = z - predicted, dz.T @ dz + R
    try:
        nis = float(innovation @ np.linalg.solve(S, innovation))
    except np.linalg.LinAlgError:
        raise ValueError("innovation covariance: expected an invertible matrix, got a singular one") from None
    weight = rule(nis, m)
    if weight <= 0:
        return Updated(x, dx.T @ dx, innovation, S, nis, 0.0)
    noise = np.concatenate([square_root(R / weight).T, np.zeros((m, n))], axis=1)
    stacked = np.concatenate([np.concatenate([dz, dx], axis=1), noise])
    triangle: Array = np.asarray(np.linalg.qr(stacked, mode="r"), dtype=float)
    root_S, gain, root_P = triangle[:m, :m], triangle[:m, m:], triangle[m:, m:]
    step = np.linalg.solve(root_S.T, innovation) @ gain
    return Updated(x + step, root_P.T @ root_P, innovation, S, nis, weight)


# Which states a series of measurements determines: information about the first state, and sigmas with a prior.

DETERMINED = 1.0  # information, in units of the prior's, from which a direction counts as observed


@dataclass(frozen=True, slots=True)
class Observability:
    """What measurements add to a prior of n states."""

    information: Array  # (n, n) of the first state, without the prior
    rank: int  # number of directions that the measurements determine better than the prior
    sigma_prior: Array  # (n,)
    sigma: Array  # (n,) with prior and measurements, without process noise

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
    left = root @ vectors / np.sqrt(1 + np.maximum(values, 0.0))
    rank = int(np.count_nonzero(values >= DETERMINED))
    return Observability(information, rank, np.sqrt(np.diagonal(prior)), np.linalg.norm(left, axis=1))


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
