"""When the velocities jump: where the motions before and after the jump meet.

In runs whose pictures are of different instants the poses beside a jump follow from the motion on its side. As long as
several steps may have the jump, the poses between them are on neither side, and known much worse than by the spots'
noise. The likelihood of the moment is that of the run with a jump at that moment, with the motion integrated out; it is
a parabola where the moment is known to a part of a step, and its curvature is the variance. Source: ours; the profile
likelihood of a change point, e.g. Basseville & Nikiforov (1993), "Detection of Abrupt Changes", chapter 2.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from geometry.arrays import Array, Bools, Ints
from tracking.rigid_body.online_estimates import MANOEUVRE_S
from tracking.smoothing.motion.fixed_interval import RunInformation, log_likelihood
from tracking.smoothing.motion.process_noise import open_steps
from tracking.smoothing.motion.run_detections import Reference

VAGUE_STEPS = 0.15  # a moment whose sigma is larger than this part of a step is not used
EARLIER_STEPS = 0.1  # least sigma of a moment that was found with other labels, in steps
APART_FRAMES = 1  # between the steps of two jumps, from which one does not disturb the moment of the other
MOMENT_SIGMAS = 2.0  # of a moment, as a sigma: the same spots show the moment and then the motion
AROUND = 12  # frames on both sides of the steps that show when the jump is
_SPREADS = (0.5, 0.1, 0.02)  # of a step: sigmas of the moment with which it is found, one after the other
_PARABOLAS = 4  # with each of these, at most
_NARROWER = 0.5  # of the distances, for the next sigma
_IMPROVED = 0.8  # of the sigma before
_CALM = 0.25  # quantile of the jerk about a jump
_STRONG = 4.0  # times that: a jerk that a jump may have caused
_LEAST = 0.25  # of the last of these sigmas: the least one of a moment


@dataclass(frozen=True, slots=True)
class JumpMoment:
    """When the velocities jump."""

    step: int
    later_s: float  # how long before the end of the step
    sigma_s: float
    part: slice  # of the run's frames: those about the jump, with ...
    density: Array  # (F, 6) ... the jerk with which a jump at one moment explains them best
    size: Array  # (2,) variances of the jump
    improved: bool = True  # more spots may say more
    rounds: int = 1  # in which it was found one after the other, each with the spots that were too near to it before

    def after(self, before: JumpMoment | None) -> JumpMoment:
        """This moment, found with more spots than `before`."""
        if before is None:
            return self
        return replace(self, improved=self.sigma_s < _IMPROVED * before.sigma_s, rounds=before.rounds + 1)


def find_moment(
    ref: Reference,
    info: RunInformation,
    density: Array,
    steps: tuple[int, int],
    size: Array,
    slack_nats: float = 0.0,
    before: JumpMoment | None = None,
) -> JumpMoment | None:
    """The moment of a jump; None: not known.

    ref, info, density (T, 6): of a run in which some steps (first, last) may have the jump, of variances size (2,). The
    spots of these steps count as if the motion within them was open. None also where the run with a jump at one moment
    is less likely, by more than a slack, than that in which all of these steps are open: the motion turns for longer.

    before: the moment found with fewer spots. Spots near a jump that count for one side contradict a moment that is
    farther off than its sigma, and the likelihood is no parabola there: the search begins at that moment.

    Where a jump was not known before, a strong jerk may have explained it: the jerk of the calmer frames is tried, too.
    """
    first, last = steps
    part = slice(max(first - AROUND, 0), min(last + AROUND, len(info.dt)))
    some = info._replace(**{name: getattr(info, name)[part] for name in info._fields[:-1]})
    near = Reference(*(np.ascontiguousarray(a[part]) for a in ref))
    usual = np.ascontiguousarray(density[part])
    inside = slice(first - part.start, last + 1 - part.start)
    best, most = None, log_likelihood(near, some, usual) - slack_nats
    for jerk in calm_jerk(usual):
        around = _Around(near, some, jerk, inside, size)
        found = None if before is None else _search(around, (before.step - part.start, before.later_s, before.sigma_s))
        found = found or _search(around)
        if found is not None and found[0] > most:
            most, step, later, sigma = found
            best = JumpMoment(part.start + step, later, sigma, part, jerk, size)
    return best


def calm_jerk(usual: Array) -> tuple[Array, ...]:
    """Densities of the jerk (F, 6) about a jump: as estimated and, where some is strong, that of the calmer frames."""
    calm = np.minimum(usual, np.quantile(usual, _CALM, axis=0))
    return (usual, calm) if np.any(usual > _STRONG * calm) else (usual,)


@dataclass(frozen=True, slots=True)
class JumpGroup:
    """Jumps that may be one, or two."""

    jumps: Ints  # (j,) steps in which they were found
    inside: slice  # the steps that may have them

    def known(self, moment: Array, dt: Array) -> tuple[JumpMoment, ...]:
        """The moments (T, 2) that earlier labels gave for them, less certain; dt (T,), s."""
        return tuple(
            JumpMoment(
                k, moment[k, 0], max(moment[k, 1], EARLIER_STEPS * dt[k]), slice(0, 0), np.zeros((0, 6)), np.zeros(2),
                rounds=0,
            )
            for k in self.jumps.tolist() if moment[k, 0] >= 0
        )  # fmt: skip


def jump_groups(jumped: Bools, moment: Array, vague: Bools, scale: Array) -> list[JumpGroup]:
    """Jumps (T,), one by one, with the steps that may have each; moment (T, 2): where known.

    vague, scale: of `open_steps`.
    """
    out = list[JumpGroup]()
    for k in np.flatnonzero(jumped).tolist():
        beside = max(k - 1, 1), min(k + 1, len(vague) - 1)
        first, last = beside if moment[k, 0] >= 0 else open_steps(k, vague, scale)
        if out and first < out[-1].inside.stop:
            before = out[-1]
            out[-1] = JumpGroup(
                np.append(before.jumps, k), slice(before.inside.start, max(last + 1, before.inside.stop))
            )
        else:
            out.append(JumpGroup(np.array([k]), slice(first, last + 1)))
    return out


def uncertain_groups(groups: list[JumpGroup], found: dict[int, JumpMoment], dt: Array, real: list[np.bool]) -> set[int]:
    """Which of the groups have no certain moment.

    One that the spots near it have not confirmed is none, nor is one beside a jump whose moment is not known: the
    motion between the two is known too little. real: the group's jump is not negligible.
    """
    out = {
        i for i in range(len(groups))
        if i not in found or found[i].rounds < 2 or found[i].sigma_s > VAGUE_STEPS * dt[found[i].step]
    }  # fmt: skip
    beside = set[int]()
    for i, j in pairwise(range(len(groups))):
        if groups[j].inside.start - groups[i].inside.stop < APART_FRAMES:
            beside |= {a for a, b, there in ((i, j, real[j]), (j, i, real[i])) if b in out and there}
    return out | beside


@dataclass(frozen=True, slots=True)
class _Around:
    """The frames about some steps that may have a jump."""

    ref: Reference
    info: RunInformation
    jerk: Array
    inside: slice
    size: Array  # (2,)

    def nats(self, ends_s: Array, at_s: float, spread_s: float) -> float:
        """Log-likelihood of a jump at a moment with a sigma, s; ends_s: of the steps."""
        info, inside = self.info, self.inside
        jump, moment = info.velocity_jump.copy(), info.moment.copy()
        jump[inside], moment[inside] = 0.0, (-1.0, 0.0)
        step = self.step(ends_s, at_s)
        jump[step], moment[step] = self.size, (max(ends_s[step] - at_s, 0.0), spread_s)
        with_jump = info._replace(velocity_jump=jump, acceleration_jump=jump / MANOEUVRE_S**2, moment=moment)
        return log_likelihood(self.ref, with_jump, self.jerk)

    def step(self, ends_s: Array, at_s: float) -> int:
        """The step that contains a moment."""
        return int(np.clip(np.searchsorted(ends_s, at_s), self.inside.start, self.inside.stop - 1))


def _search(around: _Around, before: tuple[int, float, float] | None = None) -> tuple[float, int, float, float] | None:
    """Log-likelihood, nats, step, time before its end and sigma, s, of the most likely moment.

    before: the last three of a moment at which the search begins.
    """
    inside, ends = around.inside, np.cumsum(around.info.dt)
    start, end, dt = ends[inside.start - 1], ends[inside.stop - 1], float(np.median(around.info.dt[inside]))
    at, apart, spreads = 0.5 * (start + end), dt, list(_SPREADS)
    if before is not None:
        spreads = spreads[-1:]
        at, apart = float(ends[before[0]]) - before[1], max(before[2], spreads[0] * dt)
    for share in spreads:
        spread = share * dt
        for _ in range(_PARABOLAS):
            low, middle, high = (around.nats(ends, at + d, spread) for d in (-apart, 0.0, apart))
            curvature = (low + high - 2 * middle) / apart**2
            if not curvature < 0:
                return None
            move = 0.5 * (low - high) / (apart * curvature)
            at += move
            if not start - 0.5 * dt < at < end + 0.5 * dt:
                return None
            sigma = float(np.sqrt(-1 / curvature))
            apart = min(apart, max(sigma, spread))
            if abs(move) < apart:
                break
        else:
            return None
        apart *= _NARROWER
    sigma = float(np.sqrt(max(sigma**2 - spread**2, (_LEAST * spread) ** 2)))
    if not (start <= at <= end and sigma < 0.5 * (end - start)):
        return None
    step = around.step(ends, at)
    return around.nats(ends, at, MOMENT_SIGMAS * sigma), step, float(max(ends[step] - at, 0.0)), sigma
