"""Strength of the motion's white jerk, by axis and by time, from the smoother's test quantities.

MacKay's fixed point: the strength q is right where the summed energy r^T Q r of the process noise equals its
expectation tr(Q N), the number of its components that the data determine. One pass of the smoother gives both for all
axes and frames, so that no search over q is needed. On uniform motion q stops falling where one component of the noise
is still determined: the floor follows from the data, and a later velocity jump can raise q again.

Source: MacKay (1992), "Bayesian interpolation", Neural Computation 4, eq. 4.9 (the fixed point); windows and
pseudo-counts: ours.
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Bools
from tracking.smoothing.motion.fixed_interval import Interval
from tracking.smoothing.motion.windows import window_mean

# Logarithms of (m/s^3)^2/Hz or (rad/s^3)^2/Hz. The lower end suits a vehicle at rest: over 10 s it allows 1 mm. Below
# it rounding errors matter.
LOG_RANGE = 2 * np.log([1e-5, 1e6])
PSEUDO_COUNT = 2.0  # determined components of the present strength that are added to each window
MIN_COUNT = 1.0  # determined components of a window, below which the strength does not fall
NO_DATA_SHARE = 0.01  # of that: a window without data, whose strength stays
WINDOW_COUNT = 12.0  # determined components per window: the sigma of the logarithm of its strength is then 0.4
AXES_SIGMA = 2.0  # of log q between axes: a factor of 2.7 in the motion
RELAXATION = 1.6  # of the fixed point's step in log q: gamma changes by q^(1/6), so plain steps are short
MAX_STEP = 4.0  # in log q


def next_log_density(log_density: Array, out: Interval, usable: Bools, local: bool) -> Array:
    """The logarithms (T, 6) of the spectral densities after one step of the fixed point.

    log_density (T, 6): those of the pass that made `out`; usable (T,): steps of steady motion, without a velocity jump.
    local: each window has its own strength, else the whole run has that of its median window.
    """
    energy = np.where(usable[:, None], out.energy, 0.0)
    gamma = np.where(usable[:, None], out.gamma, 0.0)
    frames = len(energy)
    energies, gammas = np.empty_like(log_density), np.empty_like(log_density)
    for axis in range(log_density.shape[1]):
        total = float(gamma[:, axis].sum())
        width = frames if total <= 0 else int(np.clip(np.ceil(frames * WINDOW_COUNT / total), 9, frames))
        energies[:, axis], gammas[:, axis] = (_window_sums(a[:, axis], width) for a in (energy, gamma))
    prior = _prior_components(log_density, gammas)
    change = np.empty_like(log_density)
    for axis in range(log_density.shape[1]):
        e, g, p = energies[:, axis], gammas[:, axis], prior[:, axis]
        step = np.log((e + PSEUDO_COUNT + np.maximum(p, 0.0)) / (g + PSEUDO_COUNT + np.maximum(-p, 0.0)))
        # The strength must not fall so far that no data could raise it again.
        has_data = g > NO_DATA_SHARE * MIN_COUNT
        step = np.where(
            has_data, np.maximum(step, 2 * np.log(MIN_COUNT / np.maximum(g, NO_DATA_SHARE * MIN_COUNT))), 0.0
        )
        if not local:
            # The median of the windows: velocity jumps that are not known yet raise few of them.
            step[:] = _weighted_median(step, g)
        change[:, axis] = np.clip(RELAXATION * step, -MAX_STEP, MAX_STEP)
    return np.clip(log_density + change, *LOG_RANGE)


def _prior_components(log_density: Array, gamma: Array) -> Array:
    """(T, 6): by how much a prior raises the energy of the process noise, in determined components.

    The prior: log q of an axis is normal about that of the axes of its kind, translation or rotation, weighted with
    what the data determine of each, gamma (T, 6). Without it the strength of an axis in which the motion is smaller
    than the noise collapses to zero, the usual fault of a variance estimated from weak data, and the covariance with
    it. Where the data determine it the prior weighs one or two components of dozens.
    """
    out = np.empty_like(log_density)
    for axes in (slice(0, 3), slice(3, 6)):
        weight = gamma[:, axes] + 1e-9
        centre = np.sum(weight * log_density[:, axes], axis=1) / weight.sum(axis=1)
        out[:, axes] = 2 * (centre[:, None] - log_density[:, axes]) / AXES_SIGMA**2
    return out


def _window_sums(values: Array, width: int) -> Array:
    """Sums of values (T,) weighted with a triangle about each, whose area is `width`.

    A box would suppress some wavelengths completely; there the fixed point would grow without limit.
    """
    once = window_mean(values, width)
    return np.maximum(window_mean(once, width) * width, 0.0)


def _weighted_median(values: Array, weights: Array) -> float:
    total = float(weights.sum())
    if total <= 0:
        return 0.0
    order = np.argsort(values)
    return float(values[order[np.searchsorted(np.cumsum(weights[order]), 0.5 * total)]])
