"""Turns: when the velocities of a run with cameras on clocks of their own jump, and how long that takes.

The velocities of a turn change as by white acceleration between its beginning and its end: a corner is a short turn.
With the motion integrated out, the likelihood of its middle and length is that of the run; the spots are at their own
instants (instants.py), so that it needs no other information for another turn. Source: ours; the profile likelihood of
a change point, e.g. Basseville & Nikiforov (1993), "Detection of Abrupt Changes", chapter 2.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from geometry.arrays import Array
from geometry.compilation.jit import compiled
from tracking.rigid_body.online_estimates import MANOEUVRE_S
from tracking.smoothing.motion.fixed_interval import (
    Filtered,
    RunInformation,
    filtered,
    log_likelihood,
    log_likelihood_with,
    smoothed,
)
from tracking.smoothing.motion.process_noise import next_log_density
from tracking.smoothing.motion.run_detections import Reference, Turn

AROUND = 24  # frames on both sides of a turn that show it: 8 showed none of corners of slow motion
LEAST_LENGTH = 0.02  # of a frame, twice _LAST_STEP: a longer one would round corners by more than the spots show
_LONGEST = 6.0  # frames: a longer change of the velocities is jerk
_LENGTHS = (LEAST_LENGTH, 1.0, 2.0, 4.0)  # frames: from which the search begins ...
_FARTHEST, _SHORT = 1.5, 0.5  # frames: ... at middles as far as this; of shorter turns the likelihood is narrow ...
_GRID = (0.25, 0.5)  # frames: ... and of shorter, and of longer turns the distance of these
_FIRST_STEP, _LAST_STEP = 0.125, 0.01  # frames, of the search for the middle
_LONGER = 1.5  # times, of that for the length
_GAINED = 1e-3  # nats: less is rounding
_AMBIGUOUS_NATS = 2.0  # by which a longer turn may be less likely: a turn is as long as the spots allow
_WIDER = 1.25  # times, in the search for that
_SIGMAS = 2.0  # of the middle, as a sigma: the same spots show it and then the motion
_WITH_IT = (-1.0, -0.5, 0.0, 0.5, 1.0)  # of the way of the middle: how far the turn beside it moves, too
_SHARES = (1.0, 0.3, 0.1, 0.03, 0.01, 0.003, 0.001)  # of a turn's variance, of which the most likely one is taken
LEAST_SHARE = _SHARES[-1]
_GAP_SHARES = (*10.0 ** np.arange(0.0, -6.5, -0.5), 0.0)  # of that of a gap's jumps: a thousandth of the fastest speed
_EXCLUDED_NATS = 5.0  # by which these must be less likely than none, or than smaller ones, to exclude them
# By which the largest jumps that a gap may have must be: they are of all six axes, those of a motion often of one.
_IMPOSSIBLE_NATS = 6 * _EXCLUDED_NATS / 2
_CURVATURE_NATS = 0.5  # drop of the likelihood from which the sigma of the middle is computed
_CHANGED = 0.02, 0.1  # of a frame, and relative: less does not change a turn
TURN_NATS = 3.0  # by which each turn must make a run more likely
GAINED_NATS = 2 * TURN_NATS  # by which a jerk must be more likely than turns: two have as many numbers as it has axes
# For each turn, by which several must be more likely than one smooth turn, or a jerk, in their place: the more there
# are, the better they approximate any smooth motion. So many frames between two turns show how it goes on in between.
_RESOLVED_NATS, _SHOWN_BETWEEN = 20.0, 2.0
_UNRESOLVED = 4.0  # frames: turns farther apart do not resemble one
_WIDTHS = np.array([1.0, 1.3, 1.7])  # of the distance of some turns: the lengths of one in their place ...
_SIZES = (0.3, 1.0, 3.0, 10.0)  # ... and of their variances: its sizes
_CLOSE = 3.0  # frames between two turns in close succession
_JERKS = 10.0 ** np.arange(-4, 2)  # of the jerk that changes the velocities as much within a frame
_JERK_STEPS, _GAINED_BY_STEP = 20, 1.0  # from there, and nats that each must gain


def velocity_jumps(turns: Sequence[Turn], t_s: Array) -> tuple[Array, Array]:
    """Variances (F, 2) of the velocities' jumps in the steps before instants t_s (F,), and their moments (F, 2).

    As in RunInformation: white acceleration in a part of a step adds what a jump in the middle of that part does, whose
    moment has a sigma of the part's length over the square root of 12.
    """
    spans = np.array([(turn.begin_s, turn.end_s, turn.length_s) for turn in turns]).reshape(-1, 3)
    return _velocity_jumps(spans, np.array([turn.size for turn in turns]).reshape(-1, 2), t_s)


@compiled
def _velocity_jumps(spans: Array, sizes: Array, t_s: Array) -> tuple[Array, Array]:
    """`velocity_jumps` of turns with begins, ends and lengths (n, 3), s, and sizes (n, 2)."""
    jump, moment = np.zeros((len(t_s), 2)), np.empty((len(t_s), 2))
    moment[:, 0], moment[:, 1] = -1.0, 0.0  # unknown
    for k in range(1, len(t_s)):
        weight = first = second = 0.0
        for i in range(len(spans)):
            begin, end, length = spans[i]
            if t_s[k] < begin or t_s[k - 1] >= end:
                continue
            low, high = max(begin, t_s[k - 1]), min(end, t_s[k])
            share, later = (high - low) / length, t_s[k] - 0.5 * (low + high)
            jump[k] += share * sizes[i]
            own = share * sizes[i].max()
            weight += own
            first += own * later
            second += own * (later**2 + (high - low) ** 2 / 12)
        if weight > 0:
            moment[k, 0] = first / weight
            moment[k, 1] = np.sqrt(max(second / weight - moment[k, 0] ** 2, 0.0))
    return jump, moment


@dataclass(frozen=True, slots=True)
class TurnSearch:
    """The likelihood of turns, with the motion at F instants integrated out."""

    ref: Reference
    info: RunInformation
    density: Array  # (F, 6) of the jerk
    hidden: Array  # (F, 2) variances of jumps in steps that nothing observes
    t_s: Array  # (F,)
    frame_s: float

    def part(self, first_s: float, last_s: float) -> slice:
        """The instants that show turns between two times."""
        around = AROUND * self.frame_s
        first, end = np.searchsorted(self.t_s, [first_s - around, last_s + around])
        return slice(max(int(first) - 1, 0), int(end) + 1)

    def near(self, turns: Sequence[Turn], part: slice) -> list[Turn]:
        """Those of some turns that are in a part."""
        t_s = self.t_s[part]
        return [t for t in turns if t.end_s > t_s[0] and t.begin_s < t_s[-1]]

    def of_part(self, turns: Sequence[Turn], part: slice) -> tuple[Reference, RunInformation]:
        """A part of the run with some turns."""
        jump, moment = velocity_jumps(turns, self.t_s[part])
        jump = np.where(jump > 0, jump, self.hidden[part])
        some = self.info._replace(
            **{name: getattr(self.info, name)[part] for name in ("information", "vector", "dt")},
            velocity_jump=jump, acceleration_jump=jump / MANOEUVRE_S**2, moment=moment,
        )  # fmt: skip
        return Reference(*(np.ascontiguousarray(a[part]) for a in self.ref)), some

    def nats(self, turns: Sequence[Turn], part: slice, density: Array) -> float:
        """Log-likelihood of a part of the run with this jerk (F, 6), up to a constant."""
        return float(log_likelihood(*self.of_part(turns, part), np.ascontiguousarray(density[part])))

    def with_turns(self, turns: Sequence[Turn], part: slice) -> _WithTurns:
        """A part of the run with turns to which others are added."""
        (ref, some), density = self.of_part(turns, part), np.ascontiguousarray(self.density[part])
        both = filtered(ref, some, density)
        return _WithTurns(tuple(turns), ref, some, density, self.hidden[part], self.t_s[part], both)

    def without(self, some: Sequence[Turn], all_turns: Sequence[Turn], gained: float = GAINED_NATS) -> Array | None:
        """Densities (F, 6) of a jerk that explains the spots without some of all turns; None: these are needed.

        gained: by how much the jerk must be more likely, nats, where each turn costs TURN_NATS.
        """
        begin, end = min(t.begin_s for t in some), max(t.end_s for t in some)
        part = self.part(begin, end)
        every = self.near(all_turns, part)
        others = [t for t in every if not any(t is one for one in some)]
        inside = (self.t_s > begin - self.frame_s) & (self.t_s - self.info.dt < end + self.frame_s)
        # A velocity changes by q dt^3 / 3.
        size = np.repeat(np.max([t.size for t in some], axis=0), 3) * 3 / self.frame_s**3
        tried = [
            np.where(inside[:, None], np.maximum(self.density, share * size), self.density) for share in (0.0, *_JERKS)
        ]
        nats = [self.nats(others, part, density) for density in tried]
        best, most = tried[int(np.argmax(nats))], max(nats)
        # Each axis has a strength of its own, as a turntable's about which it turns; then each part of the time.
        (ref, info), density, own = self.of_part(others, part), best, inside[part]
        for local in (False, True):
            for _ in range(_JERK_STEPS):
                out = smoothed(ref, info, np.ascontiguousarray(density[part]), True)
                out = out._replace(energy=out.energy[own], gamma=out.gamma[own])
                density = density.copy()
                density[inside] = np.exp(next_log_density(np.log(density[inside]), out, own[own], local))
                if (value := self.nats(others, part, density)) < most + _GAINED_BY_STEP:
                    break
                best, most = density, value
            density = best
        run, likely = self.with_turns(others, part), list(some)
        for i, turn in enumerate(likely):
            likely[i] = run.sized(turn, [*likely[:i], *likely[i + 1 :]])
        least = run.nats(likely) - TURN_NATS * len(some)
        if nats[0] > least:
            return self.density
        return best if most > least + gained else None

    def one_for(self, some: Sequence[Turn], all_turns: Sequence[Turn]) -> Turn | None:
        """One turn in place of some of all turns; None: the spots exclude it."""
        short = [t._replace(length_s=t.likely_s) for t in some]
        begin, end = min(t.begin_s for t in short), max(t.end_s for t in short)
        part, size = self.part(begin, end), np.sum([t.size for t in some], axis=0)
        run = self.with_turns([t for t in self.near(all_turns, part) if not any(t is one for one in some)], part)
        lengths = _WIDTHS * (end - begin)
        tried = [Turn(0.5 * (begin + end), length, length, k * size) for length in lengths for k in _SIZES]
        nats = [run.nats([one]) for one in tried]
        return tried[int(np.argmax(nats))] if max(nats) > run.nats(short) - resolved_nats(some, self.frame_s) else None

    def largest(self, turn: Turn, all_turns: Sequence[Turn]) -> Turn:
        """A turn as large as the spots allow: slow motion hardly shows its size."""
        part = self.part(turn.begin_s, turn.end_s)
        run = self.with_turns([t for t in self.near(all_turns, part) if t is not turn], part)
        least = run.nats([turn]) - _AMBIGUOUS_NATS
        for share in _SHARES:  # the largest first
            larger = turn._replace(size=turn.size * share / LEAST_SHARE)
            if run.nats([larger]) > least:
                return larger
        return turn

    def gap_share(self, gap: slice, most: Array, turns: Sequence[Turn]) -> tuple[bool, float]:
        """Whether the steps of a gap have no jumps, and the share of the variances `most` (F, 2) that these may have.

        `most` belongs to the fastest motion nearby. Around the gap the vehicle may be much slower, where jumps of that
        size are less likely than none although smaller ones are needed: then they are not excluded.
        """
        part, hidden = self.part(self.t_s[gap.start], self.t_s[gap.stop - 1]), self.hidden.copy()
        near, nats = self.near(turns, part), []
        for share in _GAP_SHARES:
            hidden[gap] = share * most[gap]
            nats.append(replace(self, hidden=hidden).nats(near, part, self.density))
        if max(nats) > nats[-1] + TURN_NATS or nats[-1] < nats[0] + _EXCLUDED_NATS:
            return False, 1.0
        allowed = np.flatnonzero(np.array(nats) > max(nats) - _IMPOSSIBLE_NATS)
        return True, float(_GAP_SHARES[allowed[0]])

    def to_next_spots(self, turn: Turn) -> Turn:
        """A turn that takes some frames, from the last spots before it to the first after it: its ends are smooth."""
        if turn.likely_s < _SHORT * self.frame_s:
            return turn
        seen_s = self.t_s[np.any(self.info.vector, axis=1)]
        first, end = np.searchsorted(seen_s, [turn.begin_s, turn.end_s]).tolist()
        begin_s = min(float(seen_s[max(first - 1, 0)]), turn.begin_s)
        end_s = max(float(seen_s[min(end, len(seen_s) - 1)]), turn.end_s)
        return turn._replace(middle_s=0.5 * (begin_s + end_s), length_s=end_s - begin_s)

    def improved(self, turn: Turn, others: Sequence[Turn]) -> Turn | None:
        """The most likely turn in place of one; None: the run is as likely without it."""
        part, frame = self.part(turn.middle_s, turn.middle_s), self.frame_s
        others = [one._replace(length_s=one.likely_s) for one in self.near(others, part)]
        run = self.with_turns(others, part)

        def nats(middle: float, length: float) -> float:
            return run.nats([Turn(middle, length, length, turn.size)])

        middle, length = turn.middle_s, turn.likely_s
        most = nats(middle, length)
        for begin in (length / frame,) if turn.settled else (length / frame, *_LENGTHS):
            found = self._climbed(nats, turn.middle_s, begin * frame, 0.0 if turn.settled else _FARTHEST)
            if found[0] > most:
                most, middle, length = found
        sized = run.sized(Turn(middle, length, length, turn.size))
        turn, most = turn._replace(size=sized.size), max(most, run.nats([sized]))
        if run.nats([]) > most - TURN_NATS:
            return None
        beside = [
            one for one in others if len(successions(sorted([turn, one], key=lambda one: one.middle_s), frame)) == 1
        ]
        nearest = min(beside, key=lambda one: abs(one.middle_s - middle), default=None)
        rest = run if nearest is None else self.with_turns([one for one in others if one is not nearest], part)

        def profile(at: float, length: float) -> float:
            # What moves one of two turns moves the other.
            if nearest is None:
                return nats(at, length)
            here = Turn(at, length, length, turn.size)
            ways = (nearest._replace(middle_s=nearest.middle_s + share * (at - middle)) for share in _WITH_IT)
            return max(rest.nats([one, here]) for one in ways)

        allowed = length
        while allowed < _LONGEST * frame and nats(middle, _WIDER * allowed) > most - _AMBIGUOUS_NATS:
            allowed *= _WIDER
        sigma = _SIGMAS * self._sigma(profile, middle, allowed)
        spread = min(float(np.hypot(allowed, np.sqrt(12) * sigma)), _LONGEST * frame)
        moved = abs(middle - turn.middle_s) > _CHANGED[0] * frame
        settled = not moved and abs(spread - turn.length_s) < _CHANGED[1] * turn.length_s
        return Turn(middle, length, spread, turn.size, settled)

    def _climbed(
        self, nats: Callable[[float, float], float], middle: float, length: float, farthest: float
    ) -> tuple[float, float, float]:
        """The log-likelihood, middle and length of the most likely turn near these. farthest: frames, on a grid."""
        frame = self.frame_s
        apart = _GRID[0] if length < _SHORT * frame else _GRID[1]
        tried = middle + frame * np.arange(-farthest, farthest + 0.5 * apart, apart)
        values = [nats(float(at), length) for at in tried]
        best, middle, step = max(values), float(tried[int(np.argmax(values))]), _FIRST_STEP * frame
        while step > _LAST_STEP * frame:
            longer, shorter = min(length * _LONGER, _LONGEST * frame), max(length / _LONGER, LEAST_LENGTH * frame)
            for at, long in ((middle + step, length), (middle - step, length), (middle, longer), (middle, shorter)):
                if (value := nats(at, long)) > best + _GAINED:
                    best, middle, length = value, at, long
                    break
            else:
                step /= 2
        return best, middle, length

    def _sigma(self, nats: Callable[[float, float], float], middle: float, length: float) -> float:
        """Of the middle, s, from the curvature of the likelihood."""
        apart = max(_CHANGED[0] * self.frame_s, 0.1 * length)
        most, drop = nats(middle, length), 0.0
        while apart < _LONGEST * self.frame_s:
            drop = most - 0.5 * (nats(middle - apart, length) + nats(middle + apart, length))
            if drop > _CURVATURE_NATS:
                break
            apart *= 2
        return float(apart / np.sqrt(2 * drop)) if drop > 0 else _LONGEST * self.frame_s


@dataclass(frozen=True, slots=True)
class _WithTurns:
    """F instants with some turns, filtered from both ends: what other turns add is a matter of their steps alone."""

    turns: tuple[Turn, ...]
    ref: Reference
    info: RunInformation
    density: Array  # (F, 6)
    hidden: Array  # (F, 2)
    t_s: Array  # (F,)
    filtered: Filtered

    def nats(self, more: Sequence[Turn]) -> float:
        """Log-likelihood with more turns, up to a constant."""
        if not more:
            return float(self.filtered.nats[-1])
        ends = [min(t.begin_s for t in more), max(t.end_s for t in more)]
        before, after = np.searchsorted(self.t_s, ends).tolist()
        first, end = max(before, 1), min(after + 1, len(self.t_s))
        t_s = self.t_s[first - 1 : end]
        others = [t for t in self.turns if t.end_s > t_s[0] and t.begin_s < t_s[-1]]
        jumps, moments = velocity_jumps([*others, *more], t_s)
        jump, moment = self.info.velocity_jump.copy(), self.info.moment.copy()
        jump[first:end] = np.where(jumps > 0, jumps, self.hidden[first - 1 : end])[1:]
        moment[first:end] = moments[1:]
        info = self.info._replace(velocity_jump=jump, acceleration_jump=jump / MANOEUVRE_S**2, moment=moment)
        return float(log_likelihood_with(self.ref, info, self.density, self.filtered, first, end))

    def sized(self, turn: Turn, more: Sequence[Turn] = ()) -> Turn:
        """A turn with its most likely size: that of a new one, of the fastest motion, makes a slow one unlikely.

        It is as long as it may be, or as is most likely.
        """
        lengths = turn.length_s, turn.likely_s
        tried = [turn._replace(length_s=length, size=share * turn.size) for length in lengths for share in _SHARES]
        return max(tried, key=lambda one: self.nats([one, *more]))


def unresolved(turns: Sequence[Turn], frame_s: float) -> list[list[Turn]]:
    """Groups of turns, by time, that may be one smooth turn."""
    out = list[list[Turn]]()
    for turn in turns:
        if out and turn.middle_s - out[-1][0].middle_s < _UNRESOLVED * frame_s:
            out[-1].append(turn)
        else:
            out.append([turn])
    return [some for some in out if len(some) > 1]


def resolved_nats(some: Sequence[Turn], frame_s: float) -> float:
    """By which turns must be more likely than a smooth motion in their place; at least as for two."""
    return _RESOLVED_NATS * max(2, *map(len, successions(some, frame_s, _SHOWN_BETWEEN)))


def successions(turns: Sequence[Turn], frame_s: float, apart: float = _CLOSE) -> list[list[Turn]]:
    """Turns, by time, in groups of those in close succession: apart (frames) between neighbours at most."""
    out = list[list[Turn]]()
    for turn in turns:
        if out and turn.begin_s - out[-1][-1].end_s < apart * frame_s:
            out[-1].append(turn)
        else:
            out.append([turn])
    return out
