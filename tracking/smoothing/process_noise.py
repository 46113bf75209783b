"""Strength of the motion's white jerk, by axis and by time, from the smoother's own test quantities.

MacKay's fixed point: the strength q is right where the energy r^T Q r of the process noise, summed, equals its
expectation tr(Q N), the number of its components that the evidence determines. Both come with one pass of the smoother
for all axes and frames, so no search over q is needed. On uniform motion q stops falling where one component of the
noise is still determined: the floor follows from the evidence, and a later corner can raise q again.

Source: MacKay (1992), "Bayesian interpolation", Neural Computation 4, eq. 4.9 (the fixed point); windows and
pseudo-counts: ours.
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Bools
from tracking.smoothing.fixed_interval import Interval
from tracking.smoothing.windows import window_mean

# (m/s^3)^2/Hz or (rad/s^3)^2/Hz, as logarithms. The lower end is for a vehicle that stands: over 10 s it allows 1 mm.
# Below it rounding is felt.
LOG_RANGE = 2 * np.log([1e-5, 1e6])
PSEUDO_COUNT = 2.0  # determined components that any window is taken to have, with the strength that it has now
LEAST_COUNT = 1.0  # determined components of a window, below which the strength does not fall
NOTHING = 0.01  # of that: a window without evidence, whose strength stays
WINDOW_COUNT = 12.0  # determined components per window: the logarithm of its strength is then good to 0.4
RELAXATION = 1.6  # of the fixed point's step in log q: gamma changes by q^(1/6), so plain steps are short
LONGEST_STEP = 4.0  # in log q


def next_log_density(log_density: Array, out: Interval, usable: Bools, local: bool) -> Array:
    """The logarithms (T, 6) of the spectral densities after one step of the fixed point.

    log_density (T, 6): those of the pass that made `out`; usable (T,): steps that say something of the steady motion
    (none with a bend). local: let each window have its own strength, else the whole run has that of its median window.
    """
    energy = np.where(usable[:, None], out.energy, 0.0)
    gamma = np.where(usable[:, None], out.gamma, 0.0)
    frames = len(energy)
    change = np.empty_like(log_density)
    for axis in range(log_density.shape[1]):
        total = float(gamma[:, axis].sum())
        width = frames if total <= 0 else int(np.clip(np.ceil(frames * WINDOW_COUNT / total), 9, frames))
        e, g = (_window_sums(a[:, axis], width) for a in (energy, gamma))
        step = np.log((e + PSEUDO_COUNT) / (g + PSEUDO_COUNT))
        # Where next to nothing of the noise is determined any more, no evidence could raise its strength again.
        some = g > NOTHING * LEAST_COUNT
        step = np.where(some, np.maximum(step, 2 * np.log(LEAST_COUNT / np.maximum(g, NOTHING * LEAST_COUNT))), 0.0)
        if not local:
            # The median of the windows: corners that are not known of yet raise few of them.
            step[:] = _weighted_median(step, g)
        change[:, axis] = np.clip(RELAXATION * step, -LONGEST_STEP, LONGEST_STEP)
    return np.clip(log_density + change, *LOG_RANGE)


def _window_sums(values: Array, width: int) -> Array:
    """Sums over a triangle about each value (T,) with the area of `width` of them.

    A triangle, not a box: what a box averages away at some wavelengths the fixed point would let grow without end.
    """
    once = window_mean(values, width)
    return np.maximum(window_mean(once, width) * width, 0.0)


def _weighted_median(values: Array, weights: Array) -> float:
    total = float(weights.sum())
    if total <= 0:
        return 0.0
    order = np.argsort(values)
    return float(values[order[np.searchsorted(np.cumsum(weights[order]), 0.5 * total)]])
