"""Most probable motion of a run whose cameras have clocks of their own: at the instants of its frames and its spots.

As whole_run.py, with instants in place of frames, and turns in place of velocity jumps: no frame has a pose of its own
that would show where a jump is. After the passes each turn is improved (turns.py), and the passes are repeated.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geometry.arrays import Array, Bools, Ints, true_ranges
from tracking.rigid_body.online_estimates import MANOEUVRE_S
from tracking.smoothing.motion.clocks import solve_clocks
from tracking.smoothing.motion.fixed_interval import Interval, RunInformation, smoothed
from tracking.smoothing.motion.instants import Instants, motion_at, usual_step
from tracking.smoothing.motion.process_noise import (
    P_JUMP_OCCLUDED,
    P_JUMP_SHARED,
    PSEUDO_COUNT,
    SHOCK_CHI2,
    largest_jumps,
    largest_near,
    next_log_density,
)
from tracking.smoothing.motion.run_detections import (
    Between,
    ClockSolution,
    Reference,
    RunDetections,
    SmoothedMotion,
    Turn,
    WholeRun,
    first_variance,
)
from tracking.smoothing.motion.turns import (
    LEAST_LENGTH,
    LEAST_SHARE,
    TurnSearch,
    resolved_nats,
    successions,
    unresolved,
    velocity_jumps,
)
from tracking.smoothing.motion.whole_run import (
    CONVERGED_LOG_DENSITY,
    GLOBAL_PASSES,
    NO_JUMPS_BEFORE,
    PARTIAL_WEIGHT,
    _Estimator,
    at_rest,
)

FIRST_PASSES, LATER_PASSES = 14, 5  # with one strength of the jerk first, and after turns have changed
LAST_PASSES = 3  # of these, in which the strength of the jerk stays
ROUNDS = 4  # of passes and improved turns
FEWEST = 2  # turns in succession that a jerk may replace ...
BESIDE_GAP = 1.0  # frames: ... unless a gap is as near, whose jumps a jerk that is stronger there would exclude
UNSETTLED_FEWEST = 3  # and where clocks stay at their priors: their errors resemble two turns, which a jerk would hide
# m and rad: a sigma of each pose in a gap about the reference. A strong jerk would let the vehicle be kilometres away
# after some frames, and covariances with both this and the error of a spot exceed the digits of a number.
NEAR = 10.0
# Frames with poses of their own: three show position, velocity and acceleration, as many more that the jerk is as
# strong as assumed. Without these any offset follows from that assumption.
FEWEST_POSES = 6
APART = 1.5  # frames: of shocks as close as this only the largest is a turn ...
POSSIBLE_CHI2 = 12.6  # of 6 degrees (p = .05), above which a step may have a turn
FIRST_LENGTH = 1.0  # frames: ... of this length at first


def estimate_timed(
    run: WholeRun, assigned: Ints, measured: Bools, motion: SmoothedMotion, max_distance: int, trusted: Bools
) -> SmoothedMotion:
    """`estimate` of a run whose pictures have instants of their own.

    Raises:
        FloatingPointError: The first Gauss-Newton step is not finite.
    """
    measured = measured & trusted
    frames = len(run.dt)
    if not measured.any():
        return replace(motion, known=np.zeros(frames, dtype=bool), weight=np.zeros(frames))
    if run.clocks is not None and np.count_nonzero(measured) < FEWEST_POSES:
        run = replace(run, clocks=replace(run.clocks, unsettled=True))
    longest = _longest_step(run.detections)
    observed = _observed(measured, longest)
    used = largest_near(measured, max_distance) & trusted & (assigned >= 0).any(axis=1)
    instants = Instants.of(run, assigned, used)
    frames_s = np.cumsum(run.dt)
    ref = motion_at(motion.ref, frames_s, instants.t_s)
    if motion.between is not None:
        ref = motion_at(motion.between.ref, motion.between.t_s, instants.t_s)
    some = np.zeros(len(instants.t_s), dtype=bool)
    log_density = None if motion.log_density is None else motion.log_density[instants.frame]
    begin = replace(SmoothedMotion.begin(ref, some, log_density), turns=motion.turns)
    has_spots: Bools = np.any(instants.assigned >= 0, axis=1)
    at = np.flatnonzero(has_spots)
    core = slice(int(at[0]), int(at[-1]) + 1)
    known = tuple(some[instants.frame] for some in (measured, observed, _bounded(measured, longest)))
    estimator = _TimedEstimator(instants, usual_step(run.dt), known, has_spots, core, begin)
    found = estimator.run_passes()
    rows = instants.of_frame
    jump, moment = velocity_jumps(found.turns, instants.t_s)
    assert found.log_density is not None
    between = Between(
        instants.t_s, rows, found.ref, found.motion_P, np.exp(found.log_density), jump, moment
    )  # fmt: skip
    turning = np.cumsum(jump.max(axis=1) > 0)[rows]
    clocks = found.clocks
    if clocks is not None:
        clocks = replace(clocks, motion=clocks.motion[np.clip(rows - core.start, 0, core.stop - core.start - 1)])
    return replace(
        found,
        ref=Reference(*(np.ascontiguousarray(a[rows]) for a in found.ref)),
        log_density=found.log_density[rows],
        jumped=np.diff(turning, prepend=turning[:1]) > 0,
        pose_P=found.pose_P[rows],
        motion_P=found.motion_P[rows],
        known=found.known[rows],
        weight=np.where(used, np.where(observed, 1.0, PARTIAL_WEIGHT), 0.0),
        clocks=clocks,
        between=between,
    )


def _longest_step(detections: RunDetections) -> int:
    """The usual number of frames from one picture of a camera to the next, of the slowest one."""
    steps = (np.diff(np.flatnonzero(there)) for there in detections.has_image.T)
    return max((int(np.ceil(np.median(one))) for one in steps if len(one)), default=1)


def _observed(measured: Bools, longest: int) -> Bools:
    """(T,): frames that would show a jump: near measured ones (T,), by the longest step of a camera, and between them.

    Before the first measured frame, and after the last, nothing shows the velocity on the other side.
    """
    between = np.logical_or.accumulate(measured) & np.logical_or.accumulate(measured[::-1])[::-1]
    return np.asarray(largest_near(measured, longest) & between)


def _bounded(measured: Bools, longest: int) -> Bools:
    """(T,): measured frames (T,), and those between them that are near both: a gap's ends have one on one side only."""
    near_both = ~largest_near(~largest_near(measured, longest), longest)
    return np.asarray(_observed(measured, longest) & (measured | near_both))


def _near_unobserved(measured: Bools, t_s: Array, frame_s: float) -> Bools:
    """(F,): steps before instants t_s (F,) in which a jump would not show, as `unobserved_steps`.

    measured (F,): instants of frames whose spots determine the pose. The instants on either side of a gap, up to a
    frame from it, show a jump but not when it happened.
    """
    gap = t_s[~measured]
    if not len(gap):
        return np.zeros(len(t_s), dtype=bool)
    begin = np.append(t_s[:1], t_s[:-1])
    after = np.clip(np.searchsorted(gap, begin - 1.5 * frame_s), 0, len(gap) - 1)
    return np.asarray((gap[after] >= begin - 1.5 * frame_s) & (gap[after] <= t_s + 0.5 * frame_s))


class _TimedEstimator(_Estimator):
    """Passes over the instants of a run, from the first with a spot to the last."""

    def __init__(
        self, instants: Instants, frame_s: float, known: tuple[Bools, ...], used: Bools, core: slice,
        motion: SmoothedMotion,
    ) -> None:  # fmt: skip
        """known: instants (F,) of frames that are measured, of those near such frames, and of those between these."""
        self.frame_s, self.turns = frame_s, list(motion.turns)
        self.t_s = np.ascontiguousarray(instants.t_s[core])
        self.continuous = np.zeros(len(self.t_s), dtype=bool)  # (F,) steps in which a jerk has replaced turns
        self.unobserved = _near_unobserved(known[1][core], self.t_s, frame_s)  # (F,) steps, of which ...
        self.vague = self.unobserved | _near_unobserved(known[2][core], self.t_s, frame_s)  # (F,) with the gaps' ends
        self.open = np.zeros(len(self.t_s))  # (F,) ... these have a jump, with this probability in a frame
        self.steady = np.zeros(len(self.t_s), dtype=bool)  # (F,) these exclude a jump, but for one of a variance of ...
        # (F,) ... this share of the fastest motion's: the largest that the spots have allowed, since a jerk that has
        # become stronger beside a gap makes all jumps in it less likely.
        self.allowed = np.zeros(len(self.t_s))
        self.clocks: ClockSolution | None = None
        self.last: tuple[Interval, Array] | None = None  # the last finite pass, and its strength of the jerk
        dt = np.ascontiguousarray(instants.run.dt[core])
        # (F, 2) of the first reference: what a jump leaves open would raise the speeds, and these the jumps.
        self.largest = largest_jumps(Reference(*(a[core] for a in motion.ref)), known[0][core], dt)
        # (6,) A jerk that turns the fastest motion round within a frame, by q dt^3 / 3. Spots that contradict
        # each other would make it as strong as rounding allows.
        fastest = np.maximum(self.largest.max(axis=0), np.finfo(float).tiny)
        self.strongest = np.log(np.repeat(3 * fastest / frame_s**3, 3))
        super().__init__(instants.run, instants.assigned, known[1], used, core, motion)
        self.per_frame = len(dt) / max(float(dt.sum()) / frame_s, 1.0)
        self._gaps_opened()

    def run_passes(self) -> SmoothedMotion:
        """Passes and searches for turns until nothing changes."""
        out = self._passes(FIRST_PASSES if self.fresh else LATER_PASSES, GLOBAL_PASSES if self.fresh else 0)
        for number in range(ROUNDS):
            improved = self._turns_improved(every=number == 0)
            adapting = self._hidden_excluded() | self._turns_withdrawn()
            if not (improved or adapting):
                break
            out = self._passes(LATER_PASSES, adapting=adapting)
        else:  # no turn is left that has not been improved
            self._turns_improved(every=False)
            out = self._passes(LATER_PASSES, adapting=False, searching=False)
        if self.run.clocks is not None:
            found = self.turns
            self.turns = [self._with_other_clocks(turn) for turn in found]
            info, _ = self._information(self.ref)
            at = self.ref, self.core.start
            self.clocks = solve_clocks(
                self.run, self.assigned, self.weight[self.core], at, info, np.exp(self.log_density)
            )
            self.turns = found
        out = self._with_unresolved(self._interpolated(out))
        return replace(self._extrapolated(out), clocks=self.clocks, turns=tuple(self.turns))

    def _interpolated(self, out: Interval) -> Interval:
        """The result of the last passes again, with the density for interpolation. The shocks stay those of `out`."""
        if self.run.adapt_jerk and not self.fresh:  # the first motion is that of the tracker's labels
            self.interpolation_offset = self._interpolation(out).best_offset()
        for _ in range(LAST_PASSES if self.interpolation_offset else 0):
            before = self.ref
            new, moved = self._step(self._density(out, interpolating=True), False)
            if not (np.isfinite(new.x).all() and np.isfinite(new.pose_P).all()):
                self.ref, self.interpolation_offset = before, 0.0
                break
            out = new._replace(shock=out.shock)
            if at_rest(out, moved):
                break
        return out

    def _edges(self) -> Bools:
        return np.asarray(~self.measured | (self._jumps()[0].max(axis=1) > 0))

    def _around(self, information: Array) -> Array:
        """That of all pictures that are as near as the slowest camera's: one camera's spots may leave the pose open."""
        apart_s = _longest_step(self.run.detections) * self.frame_s
        first, after = (np.searchsorted(self.t_s, self.t_s + some_s) for some_s in (-apart_s, apart_s))
        padded = np.append(information, np.zeros((1, 6, 6)), axis=0)
        return np.asarray(np.add.reduceat(padded, np.column_stack([first, after]).ravel())[::2])

    def _with_other_clocks(self, turn: Turn) -> Turn:
        """A turn at the moments that it may have with other clocks: those found with the present ones confirm these."""
        assert self.run.clocks is not None
        return turn._replace(length_s=float(np.hypot(turn.length_s, np.sqrt(12) * self.run.clocks.far_s)))

    def _with_unresolved(self, out: Interval) -> Interval:
        """The covariances, where turns or hidden jumps resemble others, of both motions about that with the former.

        And with the differences to the motion by a jerk that turns in succession do not exclude, and to that by turns
        of their most likely lengths and by short ones that the spots do not exclude: a jerk rounds corners as well.
        """
        hidden, turns = self._hidden(self._allowed_at_ends(), self.vague), list(self.turns)
        search = replace(self._search(), density=self._density(out, interpolating=True))
        short = [turn._replace(length_s=turn.likely_s) for turn in turns]
        short += self._possible(out.shock)
        short = [search.largest(turn, short) for turn in short]
        if not short and not hidden.any():
            return out
        smooth, density = turns, search.density
        for some in successions(self.turns, self.frame_s):
            jerk: Array | None = None
            if len(some) >= FEWEST and self._shown(some):
                jerk = search.without(some, self.turns, -resolved_nats(some, self.frame_s))
            if jerk is not None:
                smooth = [t for t in smooth if not any(t is each for each in some)]
                density = np.maximum(density, jerk)
        for some in unresolved(self.turns, self.frame_s):
            one = search.one_for(some, turns)
            if one is not None:
                turns = [*(t for t in turns if not any(t is each for each in some)), one]
        turns = [search.to_next_spots(search.largest(turn, turns)) for turn in turns]
        other = smoothed(*replace(search, hidden=hidden).of_part(turns, slice(None)), search.density, tested=False)
        others = [other.x, smoothed(*search.of_part(short, slice(None)), search.density, tested=False).x]
        if len(smooth) < len(self.turns):
            others.append(smoothed(*search.of_part(smooth, slice(None)), density, tested=False).x)
        x = np.stack(others)
        pose, motion = (np.einsum("mki,mkj->kij", d, d) for d in (x[..., :6], x[..., 6:12]))
        return out._replace(
            pose_P=0.5 * (out.pose_P + other.pose_P + pose), motion_P=0.5 * (out.motion_P + other.motion_P + motion)
        )

    def _possible(self, shock: Array) -> list[Turn]:
        """Short and small turns at the lesser maxima of the shock (F,), outside the turns and gaps."""
        length = LEAST_LENGTH * self.frame_s
        shock = np.where((self.open > 0) | (self._jumps()[0].max(axis=1) > 0), 0.0, shock)
        return [
            Turn(float(self.t_s[k] - 0.5 * self.dt[k]), length, length, LEAST_SHARE * self.largest[k])
            for k in self._peaks(shock, POSSIBLE_CHI2)
        ]

    def _passes(self, count: int, common: int = 0, adapting: bool = True, searching: bool = True) -> Interval:
        """Passes, of which the first `common` have one strength of the jerk.

        adapting: they estimate it; searching: they add turns.
        """
        for number in range(count):
            before = self.ref
            out, moved = self._step(np.exp(self.log_density), True)
            if not (np.isfinite(out.x).all() and np.isfinite(out.pose_P).all()):
                if self.last is None:
                    raise FloatingPointError("the smoothing pass has no finite first step")
                (_, self.log_density), self.ref = self.last, before
                break
            self.last = out, self.log_density
            jumping = (self._jumps()[0].max(axis=1) > 0) | ((self.open > 0) & ~self.steady)
            if number > 0:
                self.turns = [self._sized(turn, out) for turn in self.turns]
            searching &= number < count - LAST_PASSES
            if searching:
                adapting &= number == 0 or common > 0
                settled = not adapting or self._adapted(out, jumping, local=number >= common)
                if number >= (NO_JUMPS_BEFORE if common > 0 else 1):
                    new = self._add_turns(np.where(jumping | self.continuous, 0.0, out.shock))
                    searching = new or not settled or number < common
            elif at_rest(out, moved):
                break
        assert self.last is not None
        return self.last[0]

    def _adapted(self, out: Interval, jumping: Bools, local: bool) -> bool:
        """Update the strength of the jerk after a pass; whether it has hardly changed. jumping (F,): steps in turns."""
        if not self.run.adapt_jerk:
            return True
        before, steady = self.log_density, ~jumping
        steady[0] = False
        self.log_density = np.minimum(next_log_density(before, out, steady, local), self.strongest)
        change = np.abs(self.log_density - before) * np.sqrt(np.minimum(out.gamma, 1.0))
        return bool(change.max(initial=0.0) < CONVERGED_LOG_DENSITY)

    def _sized(self, turn: Turn, out: Interval) -> Turn:
        """One step of the fixed point of `next_log_density` for the variances of a turn."""
        steps = (self.t_s > turn.begin_s) & np.append(True, self.t_s[:-1] < turn.end_s)
        energy, gamma = out.jump_energy[steps].sum(), out.jump_gamma[steps].sum()
        size = turn.size * (energy + PSEUDO_COUNT) / (max(gamma, 0.0) + PSEUDO_COUNT)
        return turn._replace(size=np.minimum(size, self.largest[steps].max(axis=0, initial=0.0)))

    def _add_turns(self, shock: Array) -> bool:
        """Add turns at the local maxima of the shock (F,); whether there are any."""
        length, before = FIRST_LENGTH * self.frame_s, len(self.turns)
        for k in self._peaks(shock, SHOCK_CHI2):
            self.turns.append(Turn(float(self.t_s[k] - 0.5 * self.dt[k]), length, length, self.largest[k]))
        self.turns.sort(key=lambda turn: turn.middle_s)
        found = len(self.turns) > before
        self._gaps_opened()
        return found

    def _peaks(self, shock: Array, least: float) -> list[int]:
        """Steps with a local maximum of the shock (F,) above this."""
        middle_s, above = self.t_s - 0.5 * self.dt, np.flatnonzero(shock > least).tolist()
        return [k for k in above if shock[k] >= shock[np.abs(middle_s - middle_s[k]) < APART * self.frame_s].max()]

    def _gaps_opened(self) -> None:
        """Replace turns in and beside gaps: nothing shows in which of the unobserved steps the velocities jump."""
        gaps = true_ranges(self.unobserved)
        for turn in list(self.turns):
            inside = (self.t_s > turn.begin_s) & (self.t_s - self.dt < turn.end_s)
            if not (inside & self.unobserved).any():
                continue
            self.turns.remove(turn)
            for first, end in gaps:
                if inside[first:end].any():
                    inside[first:end] = True
            frames = self.dt[inside].sum() / self.frame_s
            self.open[inside] = np.maximum(self.open[inside], max(P_JUMP_SHARED, 1.0 / max(frames, 1.0)))
            self.steady &= ~inside
            self.allowed[inside] = 1.0

    def _search(self) -> TurnSearch:
        info, _ = self._information(self.ref)
        density = np.exp(self.log_density)
        return TurnSearch(self.ref, info, density, self._hidden(~self.steady), self.t_s, self.frame_s)

    def _turns_withdrawn(self) -> bool:
        """Replace turns by a stronger jerk where that explains the spots; whether any are.

        A vehicle that rests and then swings has the strength of the rest at first, and many turns.
        """
        found, search, clocks = False, self._search(), self.run.clocks
        fewest = UNSETTLED_FEWEST if clocks is not None and clocks.unsettled else FEWEST
        for some in successions(self.turns, self.frame_s):
            if len(some) < fewest:
                continue
            density = search.without(some, self.turns) if self._shown(some) else None
            if density is None:
                continue
            self.turns = [t for t in self.turns if not any(t is one for one in some)]
            if self.run.adapt_jerk:
                most = np.maximum(self.log_density, self.strongest)
                self.log_density = np.clip(np.log(density), self.log_density, most)
            begin, end = some[0].begin_s - self.frame_s, max(t.end_s for t in some) + self.frame_s
            self.continuous |= (self.t_s > begin) & (self.t_s - self.dt < end)
            found = True
        return found

    def _shown(self, some: list[Turn]) -> bool:
        """Whether a jerk may replace these turns: where few spots are left it explains whatever contradicts itself."""
        beside, last_s = BESIDE_GAP * self.frame_s, max(t.end_s for t in some)
        first, after = np.searchsorted(self.t_s, [some[0].begin_s - beside, last_s + beside])
        return bool(self.measured[first : after + 1].all())

    def _turns_improved(self, every: bool) -> bool:
        """Find when the turns are, one after the other; whether any has changed. every: also those that are settled."""
        search, any_changed = self._search(), False
        for some in successions(self.turns, self.frame_s):
            # Of turns side by side one that moves moves the others.
            settled = all(turn.settled for turn in some)
            for turn in some if every or not settled else ():
                others = [one for one in self.turns if one is not turn]
                new = search.improved(turn._replace(settled=settled), others)
                any_changed |= new is None or not new.settled
                self.turns = sorted([*others, *([] if new is None else [new])], key=lambda one: one.middle_s)
        self._gaps_opened()
        return any_changed

    def _allowed_at_ends(self) -> Array:
        """(F,): `allowed`, also of the ends of each gap."""
        out = self.allowed.copy()
        for first, end in true_ranges(self.vague):
            out[first:end] = out[first:end].max()
        return out

    def _hidden(self, shares: Array | Bools, unobserved: Bools | None = None) -> Array:
        """(F, 2): variances of the jumps in unobserved steps (F,), with these shares (F,)."""
        unobserved = self.unobserved if unobserved is None else unobserved
        probability = np.where(unobserved, np.maximum(self.open, P_JUMP_OCCLUDED), self.open)
        return (shares * probability * np.minimum(self.dt / self.frame_s, 1.0))[:, None] * self.largest

    def _hidden_excluded(self) -> bool:
        """Exclude jumps from gaps where the motion around is more likely without; whether from any more."""
        search, before, every = self._search(), self.steady.copy(), self._hidden(np.ones(len(self.t_s)))
        for first, end in true_ranges(np.asarray(every.any(axis=1))):
            steady, allowed = search.gap_share(slice(first, end), every, self.turns)
            self.steady[first:end] |= steady
            self.allowed[first:end] = np.maximum(self.allowed[first:end], allowed)
        return bool(np.any(self.steady & ~before))

    def _jumps(self) -> tuple[Array, Array]:
        """Variances (F, 2) of the velocities' jumps by turns, and their moments (F, 2)."""
        return velocity_jumps(self.turns, self.t_s)

    def _information(self, ref: Reference) -> tuple[RunInformation, float]:
        jump, moment = self._jumps()
        self.beside = self._beside(ref)
        L, g, chi2 = self._spot_information(ref)
        jump = np.where(jump > 0, jump, self._hidden(~self.steady))
        first = first_variance(ref, self.dt, True)
        return RunInformation(L, g, self.dt, jump, jump / MANOEUVRE_S**2, moment, first), float(chi2.sum())

    def _spot_information(self, ref: Reference) -> tuple[Array, Array, Array]:
        """As in one clock's runs, and in gaps that each pose is near the reference: see NEAR."""
        L, g, chi2 = super()._spot_information(ref)
        return np.where(self.measured[:, None, None], L, L + np.eye(6) / NEAR**2), g, chi2

    def _beside(self, ref: Reference) -> Array:
        """As `corner_offsets`: of the instants whose exposures may contain a part of a turn."""
        out = np.zeros((len(self.t_s), 6))
        exposure_s = self.run.exposure_s
        if exposure_s > 0:
            for turn in self.turns:
                ends = np.clip(np.searchsorted(self.t_s, [turn.begin_s, turn.end_s]) - [1, 0], 0, len(self.t_s) - 1)
                inside = (self.t_s > turn.begin_s - 0.5 * exposure_s) & (self.t_s < turn.end_s + 0.5 * exposure_s)
                out[inside] = np.maximum(out[inside], np.abs(np.diff(ref.m[ends, :6], axis=0)) * exposure_s / 8)
        return out
