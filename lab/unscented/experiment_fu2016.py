"""The experiment of Fu (2016), section 4: 20 s at 0.1 s with a disturbance from 6 to 8 s.

The paper gives the filter's numbers, but neither the motion nor the disturbance ("complex additive noise" of high
order). Both are stated here. Motion: the mean of the paper's first state, with a sway of 0.3 to 0.4 m and 2 degrees.
Disturbances: noise whose size depends on the state, around an offset; and a smooth error that starts and ends slowly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools
from tracking.unscented.fu2016 import P0, SPREAD, X0, PrintedFilter, Q, R, process, selection
from tracking.unscented.robust import gated_update, student_t_update
from tracking.unscented.ukf import Updated, predict, update

DT_S, STEPS = 0.1, 201
FROM_S, TO_S = 6.0, 8.0  # the disturbance
RECOVERED_S = 9.0  # peaks are searched from FROM_S to here
SETTLED_S = 3.0  # from here on the filters have found the first state
SIZE = np.array([2.0, 2.0, np.deg2rad(5.0), np.deg2rad(5.0)])  # of the disturbance, m and rad
SWAY = np.array([0.4, 0.35, 0.3, np.deg2rad(2.0), np.deg2rad(2.0)])  # amplitudes: x, y, z, m; yaw, pitch, rad
PERIOD_S = np.array([25.0, 20.0, 16.0, 12.0, 14.0])
DISTURBANCES = ("none", "burst", "smooth bias")
FILTERS = ("standard", "as printed", "gate", "Student-t")
POSITION, VELOCITY, ANGLE = [1, 2], [4, 5], [6, 7]  # the observed states: lateral and vertical, and the angles


@dataclass(frozen=True, slots=True)
class Recording:
    """A simulated recording of T steps."""

    t_s: Array  # (T,)
    states: Array  # (T, 8) true states
    measured: Array  # (T, 4)
    disturbed: Bools  # (T,)


def simulate(seed: int, number: int, disturbance: str) -> Recording:
    """Recording `number` of a seed; the disturbances of one number have the same motion and the same noise.

    Raises:
        ValueError: no such disturbance.
    """
    if disturbance not in DISTURBANCES:
        raise ValueError(f"disturbance: expected one of {', '.join(DISTURBANCES)}, got {disturbance!r}")
    rng = np.random.default_rng([seed, number])
    t: Array = DT_S * np.arange(STEPS, dtype=float)
    rate = 2 * np.pi / PERIOD_S
    phase = rate * t[:, None] + rng.uniform(0, 2 * np.pi, 5)
    sway, speed = SWAY * np.sin(phase), SWAY * rate * np.cos(phase)
    states = np.concatenate([X0[:3] + sway[:, :3], speed[:, :3], X0[6:] + sway[:, 3:]], axis=1)
    noise, burst = rng.standard_normal((2, STEPS, 4))
    measured = selection(states) + noise @ np.sqrt(R)
    disturbed = (t > FROM_S - 0.5 * DT_S) & (t < TO_S + 0.5 * DT_S)
    if disturbance == "burst":  # eq. (14): F = j(X) + m(X) V, with m of second order
        second_order = 0.5 * (1 + (sway[:, [1, 2, 3, 4]] / SWAY[1:]) ** 2)
        measured[disturbed] += (SIZE * (0.5 + second_order * burst))[disturbed]
    if disturbance == "smooth bias":
        bump = np.sin(np.pi * (t - FROM_S) / (TO_S - FROM_S)) ** 2
        measured[disturbed] += (SIZE * bump[:, None])[disturbed]
    return Recording(t, states, measured, disturbed)


def estimate(recording: Recording, name: str) -> Array:
    """The states (T, 8) that one of FILTERS estimates. Raises KeyError for any other name."""
    if name == "as printed":
        printed = PrintedFilter()
        return np.array([printed.step(z, DT_S).x for z in recording.measured])
    rule = _UPDATES[name]
    x, P, out = X0, P0, []
    for z in recording.measured:
        x, P = predict(x, P, process(DT_S), Q, SPREAD)
        step = rule(x, P, z, selection, R, SPREAD)
        x, P = step.x, step.P
        out.append(x)
    return np.array(out)


_UPDATES: dict[str, Callable[..., Updated]] = {
    "standard": update,
    "gate": gated_update,
    "Student-t": student_t_update,
}


def peaks(recording: Recording, states: Array) -> tuple[float, float, float]:
    """Largest errors from 6 to 9 s: position, m, velocity, m/s, and angle, degrees, of the observed states."""
    window = (recording.t_s >= FROM_S - 0.5 * DT_S) & (recording.t_s <= RECOVERED_S + 0.5 * DT_S)
    error = np.abs(states - recording.states)[window]
    largest = (error[:, of].max() for of in (POSITION, VELOCITY, ANGLE))
    position, velocity, angle = largest
    return float(position), float(velocity), float(np.rad2deg(angle))


def quiet_rms(recording: Recording, states: Array) -> tuple[float, float, float, float]:
    """RMS errors from 3 s on: position, m, velocity, m/s, angle, degrees, of the observed states; and of x, m."""
    error = (states - recording.states)[recording.t_s > SETTLED_S]
    rms = [float(np.sqrt(np.mean(error[:, of] ** 2))) for of in (POSITION, VELOCITY, ANGLE, [0])]
    return rms[0], rms[1], float(np.rad2deg(rms[2])), rms[3]
