"""Velocity jumps in close succession: two within a few steps, as of a turntable, and many, which are none.

The motion between the two jumps is only seen by the spots in between, so that these decide, each by the motion on its
side of both jumps: the spots' information is computed again for every pair of moments. The likelihood is that of the
run with two jumps at these moments, with the motion integrated out. It is not smooth, since spots change sides; it is
searched on a grid and then by steps that become shorter. Source: ours; the pattern search is that of Hooke & Jeeves
(1961), "Direct search solution of numerical and statistical problems", Journal of the ACM 8.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from geometry.arrays import Array, Bools, Ints
from tracking.rigid_body.online_estimates import MANOEUVRE_S
from tracking.smoothing.motion.fixed_interval import RunInformation, log_likelihood
from tracking.smoothing.motion.jump_moments import MOMENT_SIGMAS, JumpMoment, calm_jerk
from tracking.smoothing.motion.run_detections import Reference, Steps, WholeRun, delayed_information

_GRID = 0.5  # of a step: distance of the moments that are tried first ...
_GRID_SPREAD = 0.25  # ... and their sigma
_SHORTEST = 0.01  # of a step: length of the last steps of the search ...
_SPREAD = 0.02  # ... and sigma of the moments
# Of a step: spreads of the moments, of which the most likely is kept: a turn may be smooth.
_ROUNDED = (0.02, 0.1, 0.2, 0.4)
_ROUND_NATS = 10.0  # by which corners must be more likely than a turn with a stronger jerk, which they resemble
_LONGEST_DIFFERENCE = 0.25  # of a step: for the curvature
_CLOSE, _LEAST_JUMPS = 6, 5  # steps between two jumps, and jumps, of a close succession
_JERKS = np.exp(-2.0 * np.arange(8))  # of the strength with which the jerk makes such jumps in one step
_CURVATURES = 3  # times that it is computed, over about one sigma


@dataclass(frozen=True, slots=True)
class Stretch:
    """F frames about some steps that may have two jumps."""

    run: WholeRun
    assigned: Ints  # (T, n) labels of the run
    start: int  # the first of these frames in the run
    part: slice  # these frames in the run's estimated part
    ref: Reference  # F frames
    steps: Steps  # F frames, as known so far
    weight: Array  # (F,) of the spots of each frame
    first_variance: Array  # (18,) of RunInformation
    inside: slice  # the steps that may have the jumps
    size: Array  # (2,) variances of each jump

    @property
    def ends_s(self) -> Array:
        """(F,): when each step ends."""
        return np.cumsum(self.steps.dt)

    def nats(self, jerk: Array, jump: Array, moment: Array) -> float:
        """Log-likelihood for jerk densities (F, 6), variances (F, 2) of jumps and their moments (F, 2)."""
        run, nowhere = self.run, np.full_like(jump, np.nan)
        assert run.delays is not None
        steps = Steps(self.steps.dt, jerk, jump, nowhere, moment)
        L, g, chi2, log_det = delayed_information(
            run.views, run.detections, run.delays, self.assigned, run.calibration_cov, self.ref, steps, self.start
        )
        L, g = L * self.weight[:, None, None], g * self.weight[:, None]
        info = RunInformation(L, g, self.steps.dt, jump, jump / MANOEUVRE_S**2, moment, self.first_variance)
        return log_likelihood(self.ref, info, jerk) - 0.5 * float(self.weight @ (chi2 + log_det))

    def nats_of_pair(self, jerk: Array, at_s: Array, spread_s: Array) -> float:
        """Log-likelihood of two jumps at moments (2,) with these sigmas (2,); both in one step are not possible."""
        inside, ends = self.inside, self.ends_s
        if not (ends[inside.start - 1] <= at_s[0] and at_s[1] <= ends[inside.stop - 1]):
            return -np.inf
        rows = np.clip(np.searchsorted(ends, at_s), inside.start, inside.stop - 1)
        if rows[0] >= rows[1]:
            return -np.inf
        jump, moment = self.steps.velocity_jump.copy(), self.steps.moment.copy()
        jump[inside], moment[inside] = 0.0, (-1.0, 0.0)
        jump[rows] = self.size
        moment[rows] = np.column_stack([np.maximum(ends[rows] - at_s, 0.0), spread_s])
        return self.nats(jerk, jump, moment)

    def without_jumps(self, jump: Array, sizes: Array) -> tuple[float, Array]:
        """The most likely jerk densities (F, 6) without the jumps inside, and before them their log-likelihood.

        jump (F, 2): the variances of the other jumps; sizes (6,): of these.
        """
        best, nats = self.steps.jerk, -np.inf
        moment, inside = self.steps.moment.copy(), self.inside
        moment[inside] = -1.0, 0.0
        dt = float(np.median(self.steps.dt[inside]))
        for share in _JERKS:
            jerk = self.steps.jerk.copy()
            jerk[inside] = np.maximum(jerk[inside], share * 3 * sizes / dt**3)  # a velocity changes by q dt^3 / 3
            if (value := self.nats(jerk, jump, moment)) > nats:
                best, nats = jerk, value
        return nats, best


def successions(jumped: Bools) -> list[tuple[int, int]]:
    """The steps, first and end, about jumps (T,) in close succession."""
    out = list[list[int]]()
    for k in np.flatnonzero(jumped).tolist():
        if out and k - out[-1][-1] <= _CLOSE:
            out[-1].append(k)
        else:
            out.append([k])
    return [(max(one[0] - 1, 1), min(one[-1] + 2, len(jumped))) for one in out if len(one) >= _LEAST_JUMPS]


def find_pair(stretch: Stretch, before: tuple[JumpMoment, JumpMoment] | None = None) -> tuple[JumpMoment, ...]:
    """The moments of two jumps; empty where motion that is open within these steps explains the spots better.

    before: the moments that were found with other labels; the search begins there.
    """
    usual, dt = stretch.steps.jerk, float(np.median(stretch.steps.dt[stretch.inside]))
    best, at, jerk = -np.inf, np.zeros(2), usual
    for some in calm_jerk(usual):
        starts = _grid(stretch, dt) if before is None else [_moments_of(stretch, before)]
        for pair in starts:
            value = stretch.nats_of_pair(some, pair, np.full(2, _GRID_SPREAD * dt))
            if value > best:
                best, at, jerk = value, pair, some
    if not np.isfinite(best):
        return ()
    at = _climbed(stretch, jerk, at, dt)
    sigma = _sigmas(stretch, jerk, at, dt)
    if sigma is None:
        return ()
    others = stretch.steps.velocity_jump.copy()
    others[stretch.inside] = 0.0
    turn_nats, _ = stretch.without_jumps(others, np.repeat(stretch.size, 3))
    open_nats = stretch.nats(usual, stretch.steps.velocity_jump, stretch.steps.moment)
    wider = [np.maximum(sigma, share * dt / MOMENT_SIGMAS) for share in _ROUNDED]
    nats = [stretch.nats_of_pair(jerk, at, MOMENT_SIGMAS * one) for one in wider]
    if not max(nats) > max(open_nats, turn_nats + _ROUND_NATS):
        return ()
    sigma = wider[int(np.argmax(nats))]
    rows = np.searchsorted(stretch.ends_s, at)
    return tuple(
        JumpMoment(int(row), float(stretch.ends_s[row] - one), float(s), stretch.part, jerk, stretch.size)
        for row, one, s in zip(rows, at, sigma, strict=True)
    )


def _moments_of(stretch: Stretch, known: tuple[JumpMoment, JumpMoment]) -> Array:
    """The instants (2,) of moments that are steps of the stretch."""
    return np.array([stretch.ends_s[one.step] - one.later_s for one in known])


def _grid(stretch: Stretch, dt: float) -> list[Array]:
    """Pairs of moments, evenly spaced."""
    ends, inside = stretch.ends_s, stretch.inside
    every = np.arange(ends[inside.start - 1] + 0.5 * _GRID * dt, ends[inside.stop - 1], _GRID * dt)
    return [np.array([a, b]) for a, b in product(every, every) if b > a]


def _climbed(stretch: Stretch, jerk: Array, at: Array, dt: float) -> Array:
    """The moments of the largest likelihood near some."""
    spread = np.full(2, _SPREAD * dt)
    best, length = stretch.nats_of_pair(jerk, at, spread), 0.5 * _GRID
    while length > _SHORTEST:
        tried = [at + length * dt * np.array(move) for move in product((-1.0, 0.0, 1.0), repeat=2) if any(move)]
        values = [stretch.nats_of_pair(jerk, pair, spread) for pair in tried]
        i = int(np.argmax(values))
        if values[i] > best:
            best, at = values[i], tried[i]
        else:
            length *= 0.5
    return at


def _sigmas(stretch: Stretch, jerk: Array, at: Array, dt: float) -> Array | None:
    """Sigmas (2,), s, of the moments of the largest likelihood; None where it is no maximum."""
    spread = np.full(2, _SPREAD * dt)
    apart, sigma = np.full(2, 2 * _SPREAD * dt), None
    for _ in range(_CURVATURES):
        steps = np.diag(apart)

        def nats(i: int, j: int, steps: Array = steps) -> float:
            return stretch.nats_of_pair(jerk, at + i * steps[0] + j * steps[1], spread)

        middle = nats(0, 0)
        H = np.empty((2, 2))
        H[0, 0], H[1, 1] = nats(1, 0) + nats(-1, 0) - 2 * middle, nats(0, 1) + nats(0, -1) - 2 * middle
        H[0, 1] = H[1, 0] = 0.25 * (nats(1, 1) + nats(-1, -1) - nats(1, -1) - nats(-1, 1))
        if not (np.isfinite(H).all() and H[0, 0] < 0 and np.linalg.det(H) > 0):
            return None
        sigma = np.sqrt(np.diagonal(np.linalg.inv(-H))) * apart
        apart = np.clip(sigma, _SPREAD * dt, _LONGEST_DIFFERENCE * dt)
    return sigma
