"""A recorded motion: attitudes and positions over time, interpolated and differentiated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry import rotations
from geometry.arrays import Array, Bools, Ints

GAP = 2.5  # times the median step: no interpolation across longer gaps
_BEYOND_ENDS = 0.01  # steps by which a time may lie before the first or after the last sample
_SLOPE_SAMPLES = 3  # on either side


@dataclass(frozen=True, slots=True)
class Motion:
    """Attitudes, positions or both at n rising times. Either may be absent, not both."""

    t_s: Array  # (n,), rising
    rotation: Array | None  # (n, 3, 3), reference frame from body
    position_m: Array | None  # (n, 3)
    covariance: Array  # (n, 6, 6) of [dt (m), dtheta (rad, body)]; zero where the motion counts as exact

    def __post_init__(self) -> None:
        if self.rotation is None and self.position_m is None:
            raise ValueError("expected attitudes, positions or both")
        if len(self.t_s) < 2 or not np.all(np.diff(self.t_s) > 0):
            raise ValueError("expected two or more rising times")

    def __len__(self) -> int:
        return len(self.t_s)

    def select(self, rows: Bools | Ints) -> Motion:
        """The motion at some of its times."""
        return Motion(
            self.t_s[rows],
            None if self.rotation is None else self.rotation[rows],
            None if self.position_m is None else self.position_m[rows],
            self.covariance[rows],
        )

    @property
    def step_s(self) -> float:
        """The median step in time."""
        return float(np.median(np.diff(self.t_s)))


@dataclass(frozen=True, slots=True)
class Interpolated:
    """A motion at m other times; nan where it has a gap or is not recorded."""

    rotation: Array | None  # (m, 3, 3)
    position_m: Array | None  # (m, 3)
    covariance: Array  # (m, 6, 6): that of the nearest sample
    known: Bools  # (m,)


def interpolate(motion: Motion, t_s: Array, gap: float = GAP) -> Interpolated:
    """The motion at times (m,): the cubic through four samples, a line at the ends and beside gaps.

    Rotations are interpolated as rotation vectors about the sample before. gap: in median steps; across longer ones
    nothing is interpolated. A time within 1e-9 steps of a sample returns that sample.
    """
    t_s = np.asarray(t_s, dtype=float)
    step = motion.step_s
    n = len(motion)
    before = np.clip(np.searchsorted(motion.t_s, t_s, side="right") - 1, 0, n - 2)
    u = (t_s - motion.t_s[before]) / (motion.t_s[before + 1] - motion.t_s[before])
    tolerance = 1e-6
    long = np.diff(motion.t_s) > gap * step
    on_first, on_second = np.abs(u) < tolerance, np.abs(u - 1) < tolerance
    inside = (u > -_BEYOND_ENDS) & (u < 1 + _BEYOND_ENDS)
    known = inside & (~long[before] | on_first | on_second)
    places = before[:, None] + np.array([-1, 0, 1, 2])
    long_around = np.concatenate([[True], long, [True]])  # before the first sample, between samples, after the last one
    cubic = ~(long_around[before] | long_around[before + 1] | long_around[before + 2])
    places = np.clip(places, 0, n - 1)
    weights = _lagrange_weights(motion.t_s[places], t_s, cubic)
    rotation = position = None
    if motion.position_m is not None:
        position = np.where(known[:, None], np.einsum("mk,mkj->mj", weights, motion.position_m[places]), np.nan)
    if motion.rotation is not None:
        base = motion.rotation[before]
        about = rotations.log(np.swapaxes(base, -1, -2)[:, None] @ motion.rotation[places])
        rotation = base @ rotations.exp(np.einsum("mk,mkj->mj", weights, about))
        rotation = np.where(known[:, None, None], rotation, np.nan)
    nearest = np.where(u > 0.5, before + 1, before)
    return Interpolated(rotation, position, motion.covariance[nearest], known)


def _lagrange_weights(nodes: Array, t: Array, cubic: Bools) -> Array:
    """Weights (m, 4) of four samples at times nodes (m, 4): cubic, or linear between the two in the middle."""
    weights = np.zeros(nodes.shape)
    scale = nodes[:, 2] - nodes[:, 1]
    x, z = (t - nodes[:, 1]) / scale, (nodes - nodes[:, 1:2]) / scale[:, None]
    weights[:, 1], weights[:, 2] = 1 - x, x
    for k in range(4):
        others = [j for j in range(4) if j != k]
        with np.errstate(divide="ignore", invalid="ignore"):
            w = np.prod([(x - z[:, j]) / (z[:, k] - z[:, j]) for j in others], axis=0)
        weights[:, k] = np.where(cubic, w, weights[:, k])
    return weights


def rates(motion: Motion, gap: float = GAP) -> Array:
    """Velocity (m/s) and rotation rate (rad/s, body) of a motion, (n, 6); zero for what is absent or unknown.

    The slope of the samples up to three steps away, symmetric in time: the error of a sample and that of its rate are
    uncorrelated if the errors are stationary.
    """
    n = len(motion)
    longest = gap * motion.step_s
    top, bottom = np.zeros((n, 6)), np.zeros(n)
    index = np.arange(n)
    for k in range(1, _SLOPE_SAMPLES + 1):
        i = index[k : n - k]
        if not len(i):
            break
        dt = motion.t_s[i + k] - motion.t_s[i - k]
        good = np.where(dt < 2 * k * longest, dt, 0.0)
        change = np.zeros((len(i), 6))
        if motion.position_m is not None:
            change[:, :3] = motion.position_m[i + k] - motion.position_m[i - k]
        if motion.rotation is not None:
            here = np.swapaxes(motion.rotation[i], -1, -2)
            change[:, 3:] = rotations.log(here @ motion.rotation[i + k]) - rotations.log(here @ motion.rotation[i - k])
        top[i] += good[:, None] * change
        bottom[i] += good * dt
    return top / np.where(bottom > 0, bottom, 1.0)[:, None]
