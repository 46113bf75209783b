"""Most probable motion given all labelled spots of a run, with its covariance and its process noise.

Gauss-Newton on the whole run (fixed_interval.py) with Levenberg's damping; the true cost decides which steps are taken.
Between the steps the strength of the jerk and the velocity jumps (process_noise.py) are estimated.
Source: ours.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geometry.arrays import Array, Bools, Ints
from tracking.rigid_body.online_estimates import MANOEUVRE_S, jump_variance
from tracking.smoothing.motion.clocks import solve_clocks
from tracking.smoothing.motion.corner_pairs import Stretch, find_pair, successions
from tracking.smoothing.motion.fixed_interval import (
    Interval,
    RunInformation,
    log_likelihood,
    motion_cost,
    smoothed,
)
from tracking.smoothing.motion.interpolation import Interpolation, extrapolated, of_poses
from tracking.smoothing.motion.jump_moments import (
    AROUND,
    MOMENT_SIGMAS,
    VAGUE_STEPS,
    JumpGroup,
    JumpMoment,
    find_moment,
    jump_groups,
    uncertain_groups,
)
from tracking.smoothing.motion.process_noise import (
    PSEUDO_COUNT,
    corner_offsets,
    corner_times,
    jump_variances,
    largest_jumps,
    largest_near,
    new_jumps,
    next_log_density,
    open_steps,
    unobserved_steps,
    weak_frames,
    with_errors_along_axes,
)
from tracking.smoothing.motion.run_detections import (
    CORNER_SIGMAS,
    ClockSolution,
    Reference,
    SmoothedMotion,
    Steps,
    WholeRun,
    delayed_information,
    first_variance,
    shifted,
    speeds,
    spot_information,
)
from tracking.statuses import LOST_SIGMA_M, LOST_SIGMA_RAD

MAX_PASSES = 25  # a limit: the passes end where nothing changes any more
ROUNDING_NATS = 10.0  # by which rounding may raise the cost
GLOBAL_PASSES = 5  # with one strength of the jerk for the whole run; then each window has its own
FIRST_ADAPTING_PASSES, LATER_ADAPTING_PASSES = 14, 2  # after which the strength is kept: in the first and later rounds
NO_JUMPS_BEFORE = 2  # passes: before that the strength of the jerk is too uncertain to detect jumps
CONVERGED_SIGMAS = 0.02  # a Gauss-Newton step below this is negligible
CONVERGED_LOG_DENSITY = 0.3  # change of log q, weighted by its determined components, below which the strength is kept
DAMPING = (np.inf, 0.1, 0.01, 1e-3)  # m and rad: tried in turn until the cost falls; inf: none
MAX_CORRECTIONS = 3  # steps that may follow a step before the cost has fallen
PARTIAL_WEIGHT = 0.25  # of the spots of a frame that does not determine the pose
P_JUMP_OUTSIDE = 0.15  # probability of a velocity jump in each frame that is extrapolated
MAX_DISTANCE = 12  # frames: spots farther from any measured frame are not used
GAP_FRAMES = 15  # on both sides of a gap that show whether the velocities have jumped in it
NO_JUMP_NATS = 5.0  # by which a motion without a jump is more likely, from which there was none (p < 1 % of 5 %)
MOMENT_ROUNDS = 4  # in which the moment of a jump is found, each with the spots that were too near to it before
EITHER_SIDE_SIGMAS = 3.0  # of such a moment: as near to it, a spot may be on either side
FIRST_SLACK_NATS = 3.0  # by which a jump at one moment may at first be less likely than at an open one
JUMP_NATS = 3.0  # by which each jump in close succession must make a run more likely than a stronger jerk does
NEGLIGIBLE_JUMP = 1e-3  # of the variance of the fastest motion
LEAST_SPREAD = 0.1  # of a step: no real corner is in one instant
NO_LIMIT = 1e4  # of a jump's variance: spots that are open by it have no weight


def estimate(
    run: WholeRun, assigned: Ints, measured: Bools, motion: SmoothedMotion, max_distance: int, trusted: Bools
) -> SmoothedMotion:
    """The motion given labels (T, n). measured (T,): frames whose own spots determine the pose.

    Spots of frames that are not trusted (T,), or farther than max_distance (frames) from any measured frame, are not
    used; 0: only measured frames are. Frames before the first used one and after the last are extrapolated. Raises
    FloatingPointError: The first Gauss-Newton step is not finite.
    """
    measured = measured & trusted
    far = ~largest_near(measured, max_distance)
    used = ~far & trusted & (assigned >= 0).any(axis=1)
    if not measured.any():
        return replace(motion, known=np.zeros(len(run.dt), dtype=bool), weight=np.zeros(len(run.dt)))
    at = np.flatnonzero(used)
    core = slice(int(at[0]), int(at[-1]) + 1)
    return _Estimator(run, assigned, measured, used, core, motion).run_passes()


class _Estimator:
    """Passes over the core of one run: the frames from the first used one to the last."""

    def __init__(
        self, run: WholeRun, assigned: Ints, measured: Bools, used: Bools, core: slice, motion: SmoothedMotion
    ) -> None:
        self.run, self.assigned, self.used, self.core, self.motion = run, assigned, used, core, motion
        self.weight = np.where(used, np.where(measured, 1.0, PARTIAL_WEIGHT), 0.0)
        self.measured = measured[core]
        self.ref = Reference(*(np.ascontiguousarray(a[core]) for a in motion.ref))
        self.jumped = motion.jumped[core].copy()
        self.jumped[0] = False
        self.dt = np.ascontiguousarray(run.dt[core])
        self.beside = np.zeros((len(self.dt), 6))  # of corner_offsets, at the reference of the last step
        self.steps: Steps | None = None  # at that reference; None: before the first step
        self.weak = np.zeros(len(self.dt), dtype=bool)  # (T,) see `jump_variances` ...
        self.excluded = np.zeros(len(self.dt), dtype=bool)  # (T,) ... this ...
        self.jump_scale = motion.jump_scale[core].copy()  # (T, 2) ... this ...
        self.moment = motion.moment[core].copy()  # (T, 2) ... and this
        self.settled = np.zeros(len(self.dt), dtype=bool)  # (T,) jumps whose moments these passes have found
        self.turning = np.zeros(len(self.dt), dtype=bool)  # (T,) steps whose jumps a stronger jerk has replaced
        self.no_pair = set[tuple[int, int]]()  # steps, first and end, in which two jumps were searched
        self.kept: tuple[Reference, tuple[Array, Array, Array]] | None = None  # of the last `_without_corners`
        self.fresh = motion.log_density is None
        self.log_density = self._first_density() if motion.log_density is None else motion.log_density[core].copy()
        self.interpolation_offset = motion.interpolation_offset
        self.clocks: ClockSolution | None = None
        self.smoother = motion.smoother[core].copy()
        self.interior = self.smoother.copy()  # (T,) frames that all passes so far found to be interior

    def run_passes(self) -> SmoothedMotion:
        """Passes until nothing changes."""
        adapting = self.run.adapt_jerk
        first = 0 if self.fresh else GLOBAL_PASSES
        out: Interval | None = None
        for number in range(first, first + MAX_PASSES):
            density = self._density(out, interpolating=not adapting)
            if self.run.delays is not None:
                self._open_steps(density)
            # Without a jump, only the passes that estimate the strength of the jerk use the tests of the noise.
            result, moved = self._step(density, adapting or not self.run.adapt_jerk or bool(self.jumped.any()))
            if not (np.isfinite(result.x).all() and np.isfinite(result.pose_P).all()):
                if out is None:
                    raise FloatingPointError("the smoothing pass has no finite first step")
                break
            out = result
            if self.run.delays is not None and number >= NO_JUMPS_BEFORE:
                self._size_jumps(out)
            sd = np.sqrt(np.maximum(np.diagonal(out.pose_P, axis1=1, axis2=2), 1e-30))
            converged = bool(np.all(np.abs(moved[:, :6]) < CONVERGED_SIGMAS * sd))
            new = np.zeros_like(self.jumped)
            if (adapting or not self.run.adapt_jerk) and number >= NO_JUMPS_BEFORE:
                new = new_jumps(out.shock, self.jumped) & ~self.turning
                self.jumped |= new
            if adapting:
                adapting = not self._adapt(out, number, number - first + 1, bool(new.any()))
                if not adapting and (
                    self._turns_found() or (self._hidden_jumps_excluded() | self._find_moments(density))
                ):
                    adapting, first = True, number + 1  # the jerk has to explain what the jumps did
            elif converged and not new.any():
                break
        assert out is not None
        if self.run.clocks is not None and self.steps is not None:
            info, _ = self._information(self.ref)
            at = self.ref, self.steps, self.core.start
            self.clocks = solve_clocks(self.run, self.assigned, self.weight[self.core], at, info, density)
        return self._extrapolated(out)

    def _size_jumps(self, out: Interval) -> None:
        """One step of the fixed point of `next_log_density` for the variance of each known jump.

        A jump of the size of the fastest motion leaves the poses between pictures of different instants open by many
        times their noise. In runs whose pictures are of one instant each frame has its own pose.
        """
        step = (out.jump_energy + PSEUDO_COUNT) / (np.maximum(out.jump_gamma, 0.0) + PSEUDO_COUNT)
        scale = np.where(self.jumped[:, None], np.minimum(self.jump_scale * step, 1.0), 0.0)
        # Of jumps side by side the data choose one; which of the steps had it stays open.
        scale = largest_near(scale, 1)
        vague, largest = ~self.measured | self.weak, largest_jumps(self.ref, self.measured, self.dt)
        for k in np.flatnonzero(self.jumped & (self.moment[:, 0] < 0)).tolist():
            # Where several steps may have the jump it explains less than it is.
            first, last = open_steps(k, vague, self.jump_scale)
            scale[k] = np.maximum(scale[k], self._change(first, last) / np.maximum(largest[k], 1e-300))
        self.jump_scale[self.jumped] = np.minimum(scale, 1.0)[self.jumped]

    def _change(self, first: int, last: int) -> Array:
        """Mean squares (2,) of how much the velocities change over some steps, of translation and of rotation."""
        change = (self.ref.m[last, :6] - self.ref.m[first - 1, :6]).reshape(2, 3)
        return np.asarray(np.mean(change**2, axis=1))

    def _adapt(self, out: Interval, number: int, passes: int, new_jump: bool) -> bool:
        """Update the strength of the jerk after a pass; whether it is the last time."""
        before = self.log_density
        steady = ~self.jumped
        steady[0] = False
        self.log_density = next_log_density(before, out, steady, local=number >= GLOBAL_PASSES)
        weight = np.minimum(out.gamma, 1.0)
        change = float(np.max(np.abs(self.log_density - before) * np.sqrt(weight), initial=0.0))
        settled = number >= GLOBAL_PASSES + 1 and change < CONVERGED_LOG_DENSITY and not new_jump
        last = settled or passes >= (FIRST_ADAPTING_PASSES if self.fresh else LATER_ADAPTING_PASSES)
        if last and self.fresh:
            self.interpolation_offset = self._interpolation(out).best_offset(self.run.delays is not None)
            if self.run.delays is not None and self.interpolation_offset < 0.0:
                self.smoother = self._interpolation(out).frames_better_with(self.interpolation_offset)
                self.interior = self.smoother.copy()
        return last

    def _turns_found(self) -> bool:
        """Replace jumps in close succession by a stronger jerk where that explains the spots; whether any are.

        A vehicle that rests and then swings has the strength of the rest at first, and a jump in every second step.
        """
        if self.run.delays is None or self.steps is None:
            return False
        found, largest = False, largest_jumps(self.ref, self.measured, self.dt)
        for first, end in successions(self.jumped):
            stretch, jumps = self._stretch(first, end), self.jumped[first:end].copy()
            nats = stretch.nats(stretch.steps.jerk, stretch.steps.velocity_jump, stretch.steps.moment)
            kept, self.jumped[first:end] = self.moment[first:end].copy(), False
            self.moment[first:end] = -1.0, 0.0
            others = np.ascontiguousarray(self._jump_variances(self.ref)[stretch.part])
            sizes = np.repeat((largest * self.jump_scale)[first:end][jumps].max(axis=0), 3)
            turn_nats, jerk = stretch.without_jumps(others, sizes)
            if not turn_nats > nats - JUMP_NATS * np.count_nonzero(jumps):
                self.jumped[first:end], self.moment[first:end] = jumps, kept
                continue
            self.log_density[stretch.part], self.jump_scale[first:end] = np.log(jerk), 1.0
            self.turning[first:end], found = True, True
        return found

    def _stretch(self, first: int, end: int, size: Array | None = None) -> Stretch:
        """The frames about some steps. size (2,): variances of the jumps that are searched for there."""
        assert self.steps is not None
        part = slice(max(first - AROUND, 0), min(end + AROUND, len(self.dt)))
        weight = np.where(self.used[self.core], np.where(self.measured, 1.0, PARTIAL_WEIGHT), 0.0)
        ref = Reference(*(np.ascontiguousarray(a[part]) for a in self.ref))
        steps = Steps(*(np.ascontiguousarray(a[part]) for a in self.steps))
        steps = steps._replace(
            jerk=np.exp(self.log_density[part]), moment=self.moment[part].copy(),
            velocity_jump=np.ascontiguousarray(self._jump_variances(self.ref)[part]),
        )  # fmt: skip
        return Stretch(
            self.run, self.assigned, self.core.start + part.start, part, ref, steps, weight[part],
            first_variance(self.ref, self.dt, bool(self.measured[0])), slice(first - part.start, end - part.start),
            np.zeros(2) if size is None else size,
        )  # fmt: skip

    def _hidden_jumps_excluded(self) -> bool:
        """Find steps in which the frames around them exclude a hidden jump; whether there are more than before.

        A jump that may be hidden in a gap leaves open where the spots beside it were at their frames' instants: by
        .2 px at 5 px per frame, where a spot is known to .01 px. Runs whose pictures are of one instant do without.
        """
        if self.run.delays is None:
            return False
        info, _ = self._information(self.ref)
        density, hidden = np.exp(self.log_density), unobserved_steps(self.measured) & ~self.excluded
        edges = np.flatnonzero(np.diff(np.r_[False, hidden, False].astype(np.int8)))
        ranges = [(int(first), int(end)) for first, end in edges.reshape(-1, 2)]
        while ranges:
            first, end = ranges.pop()
            if self._nats_without_hidden_jumps(info, density, first, end) > NO_JUMP_NATS:
                self.excluded[first:end] = True
                continue
            # A slow camera leaves all steps of a recording unobserved: a jump in one says nothing of the others. Within
            # a gap it does: nothing shows in which of its steps a jump is.
            apart = np.flatnonzero(self.measured[first : end - 1]) + first + 1
            if len(apart):
                middle = int(apart[np.argmin(np.abs(2 * apart - first - end))])
                ranges += [(middle, end), (first, middle)]
        return bool((hidden & self.excluded).any())

    def _nats_without_hidden_jumps(self, info: RunInformation, density: Array, first: int, end: int) -> float:
        """By how much the run is more likely if no jump is hidden in the steps from `first` to before `end`."""
        part = slice(max(first - GAP_FRAMES, 0), min(end + GAP_FRAMES, len(self.dt)))
        ref = Reference(*(np.ascontiguousarray(a[part]) for a in self.ref))
        some = info._replace(**{name: getattr(info, name)[part] for name in info._fields[:-1]})
        excluded, before = self.excluded.copy(), self.excluded
        excluded[first:end] = True
        nats = []
        for self.excluded in (before, excluded):
            jump = np.ascontiguousarray(self._jump_variances(self.ref)[part])
            open_to_jumps = some._replace(velocity_jump=jump, acceleration_jump=jump / MANOEUVRE_S**2)
            nats.append(log_likelihood(ref, open_to_jumps, density[part]))
        self.excluded = before
        return nats[1] - nats[0]

    def _find_moments(self, density: Array) -> bool:
        """Find when the velocities jump, where several steps may; whether any changed. density (T, 6): of the jerk.

        Where it stays open, the poses beside it are vague in runs whose pictures are of different instants. Jumps whose
        steps overlap may be one, or two.
        """
        if self.run.delays is None or self.steps is None:
            return False
        groups = jump_groups(self.jumped & ~self.settled, self.moment, ~self.measured | self.weak, self.jump_scale)
        if not groups:
            return False
        pairs = {i: known for i, group in enumerate(groups) if len(known := group.known(self.moment, self.dt)) == 2}
        found = {
            i: known[0] for i, group in enumerate(groups) if len(known := group.known(self.moment, self.dt)) == 1
        }  # fmt: skip
        largest, before = largest_jumps(self.ref, self.measured, self.dt), self.moment.copy()
        none = set(pairs)  # groups that have not one moment, as the spots near it have shown
        for number in range(MOMENT_ROUNDS):
            info = self._information_without(groups, largest, found)
            for i, group in enumerate(groups):
                if i in none or (i in found and not found[i].improved):
                    continue
                size, steps = self._size(group, largest), (group.inside.start, group.inside.stop - 1)
                slack = FIRST_SLACK_NATS if number < MOMENT_ROUNDS - 1 else 0.0
                moment = find_moment(self.ref, info, density, steps, size, slack, found.get(i))
                if moment is not None:
                    found[i] = moment.after(found.get(i))
                elif i in found and found.pop(i).rounds > 0:
                    none.add(i)
        real = [self.jump_scale[group.jumps].max() > NEGLIGIBLE_JUMP for group in groups]
        for i in uncertain_groups(groups, found, self.dt, real):
            found.pop(i, None)
        for i, group in enumerate(groups):
            self.moment[group.inside] = -1.0, 0.0
            if i in found:
                self._settle(group.jumps, group.inside, (found[i],), largest)
        for i in range(len(groups)):
            if i not in found and real[i]:
                self._find_pair(groups, i, largest, pairs.get(i))
        return not np.array_equal(before, self.moment)

    def _size(self, group: JumpGroup, largest: Array) -> Array:
        """Variances (2,) of the jump of a group."""
        change = self._change(group.inside.start, group.inside.stop - 1)
        return np.maximum(largest[group.jumps[0]] * self.jump_scale[group.jumps].max(axis=0), change)

    def _settle(self, jumps: Ints, inside: slice, moments: tuple[JumpMoment, ...], largest: Array) -> None:
        """Replace some jumps by those at these moments, which are the only ones in some steps."""
        self.jumped[jumps], self.excluded[inside] = False, True
        for moment in moments:
            k = moment.step
            self.jumped[k] = self.settled[k] = True
            self.moment[k] = moment.later_s, max(MOMENT_SIGMAS * moment.sigma_s, LEAST_SPREAD * self.dt[k])
            self.jump_scale[k] = np.minimum(moment.size / np.maximum(largest[k], 1e-300), 1.0)
            self.log_density[moment.part] = np.log(moment.density)

    def _find_pair(self, groups: list[JumpGroup], i: int, largest: Array, known: tuple[JumpMoment, ...] | None) -> None:
        """Find the moments of two jumps in place of those of a group that has not one moment.

        known: the moments found with other labels.
        """
        group = groups[i]
        first = max(group.inside.start - 1, groups[i - 1].inside.stop if i > 0 else 1)
        end = min(group.inside.stop + 1, groups[i + 1].inside.start if i + 1 < len(groups) else len(self.dt))
        # The spots in between decide: without the pictures of some camera too few do. A search that has failed fails
        # again while the same steps are open.
        every = self.run.detections.has_image[self.core][first - 1 : end + 1].all()
        if end - first < 2 or not every or (first, end) in self.no_pair:
            return
        self.no_pair.add((first, end))
        stretch = self._stretch(first, end, self._size(group, largest))
        part = stretch.part
        start = None if known is None else [replace(m, step=m.step - part.start) for m in known]
        found = find_pair(stretch, None if start is None else (start[0], start[1]))
        if found and all(m.sigma_s < 2 * VAGUE_STEPS * self.dt[part][m.step] for m in found):
            moments = tuple(replace(m, step=m.step + part.start, part=part) for m in found)
            self._settle(group.jumps, slice(first, end), moments, largest)

    def _information_without(
        self, groups: list[JumpGroup], largest: Array, found: dict[int, JumpMoment]
    ) -> RunInformation:
        """`_information`, where the spots that may be on either side of these jumps have no weight.

        found: moments, so far, of some groups; of the others all spots in their steps may be on either side.
        """
        steps, kept = self.steps, self.moment
        assert steps is not None
        jump, moment, unknown = steps.velocity_jump.copy(), self.moment.copy(), self.moment.copy()
        for i, group in enumerate(groups):
            inside = group.inside
            unknown[inside], moment[inside] = (-1.0, 0.0), (-1.0, 0.0)
            if i not in found:
                jump[inside] = NO_LIMIT * largest[inside]
                continue
            k = found[i].step
            jump[inside], jump[k] = 0.0, NO_LIMIT * largest[k]
            moment[k] = found[i].later_s, EITHER_SIDE_SIGMAS / CORNER_SIGMAS * found[i].sigma_s
        nowhere = np.full_like(steps.corner_s, np.nan)
        self.steps = steps._replace(corner_s=nowhere, velocity_jump=jump, moment=moment)
        self.moment, self.kept = unknown, None
        info, _ = self._information(self.ref)
        self.steps, self.moment, self.kept = steps, kept, None
        return info

    # -- strength of the jerk -----------------------------------------------------------------------------------------

    def _first_density(self) -> Array:
        """The most likely strength on a coarse grid, the same for all axes of translation, and of rotation."""
        info, _ = self._information(self.ref)
        steps = np.log(10.0) * np.arange(-4.0, 7.0, 2.0)
        grid = [np.repeat([a, a + 2 * np.log(3.0)], 3) for a in steps]

        def likelihood(log_density: Array) -> float:
            value = log_likelihood(self.ref, info, np.broadcast_to(np.exp(log_density), (len(self.dt), 6)).copy())
            return value if np.isfinite(value) else -np.inf

        return np.tile(max(grid, key=likelihood), (len(self.dt), 1))

    def _density(self, out: Interval | None, interpolating: bool) -> Array:
        """Spectral densities (T, 6): the estimated ones, or those for interpolation well inside measured stretches.

        The estimated strength is the best predictor. Between frames a motion without jerk at high frequencies, as of
        all heavy bodies, is smoother than white jerk of that strength; near the ends of a run, a gap or a velocity jump
        the lower strength would smooth too far.
        """
        if not interpolating or out is None or self.interpolation_offset == 0.0:
            return np.exp(self.log_density)
        # Frames only leave: the memory follows from the density, and passes that add and drop frames would never end.
        self.interior &= self._interior(out)
        return np.exp(self.log_density + self.interpolation_offset * self.interior[:, None])

    def _interpolation(self, out: Interval) -> Interpolation:
        info, _ = self._information(self.ref)
        return Interpolation(self.ref, info, self.log_density, self._interior(out), out.pose_P)

    def _interior(self, out: Interval) -> Bools:
        """(T,): frames farther than twice the smoother's memory from any gap, jump or end."""
        info, _ = self._information(self.ref)
        share = np.einsum("kij,kji->k", out.pose_P, of_poses(info.information))[self.measured]
        usual = float(np.median(share)) / 6 if len(share) else 1.0
        memory = int(np.clip(np.ceil(2 / max(usual, 1e-3)), 3, 200))
        edge: Bools = np.concatenate([[True], ~self.measured | self.jumped, [True]])
        near: Bools = largest_near(edge, memory)[1:-1]
        return ~near

    # -- Gauss-Newton -------------------------------------------------------------------------------------------------

    def _step(self, density: Array, tested: bool) -> tuple[Interval, Array]:
        """One damped Gauss-Newton step, which moves the reference. tested: as for `smoothed`.

        Returns the undamped smoother's result at the reference before the step, and how far each frame moved (T, 18).
        """
        info, chi2 = self._information(self.ref)
        cost = 0.5 * chi2 + motion_cost(self.ref, info, density)
        # Damping is against steps that leave the linear region; rounding alone makes some nats.
        limit = cost + ROUNDING_NATS * (1 + 1e-3 * abs(cost))
        out = smoothed(self.ref, info, density, tested)
        for damping in DAMPING:
            x = out.x if np.isinf(damping) else smoothed(self.ref, _damped(info, damping), density, tested=False).x
            moved = self._corrected(x, info, damping, density, limit)
            if moved is not None:
                self.ref = moved
                return out, x
        return out, np.zeros_like(out.x)

    def _corrected(
        self, x: Array, info: RunInformation, damping: float, density: Array, limit: float
    ) -> Reference | None:
        """The reference moved by x (T, 18), corrected until its cost is below the limit; None where it stays above.

        Where the jerk is weak, as of a vehicle at rest between steps, the motion is nearly a constraint. The curvature
        of that constraint, which a linear step misses, then costs more than the step gains, however short it is, and a
        further step removes it (Maratos effect; the remedy is the second-order correction, e.g. Nocedal & Wright,
        "Numerical Optimization", sections 15.4 and 18.3). The jump variances stay those of the step.
        """
        moved = self.ref
        for correction in range(MAX_CORRECTIONS + 1):
            if correction > 0:
                L, g, _ = self._spot_information(moved)
                x = smoothed(moved, _damped(info._replace(information=L, vector=g), damping), density, tested=False).x
            if not np.isfinite(x).all():
                return None
            moved = shifted(moved, x)
            cost = 0.5 * float(self._spot_information(moved)[2].sum()) + motion_cost(moved, info, density)
            if cost <= limit:
                return moved
        return None

    def _information(self, ref: Reference) -> tuple[RunInformation, float]:
        """The frames' information at a reference, with the allowed velocity jumps; and the spots' chi-square."""
        measured, jumped = self.measured, self.jumped
        self.beside = corner_offsets(ref, jumped, self.run.exposure_s, self.dt)
        L, g, chi2 = self._spot_information(ref)
        if jumped.any():
            # For all later passes: a frame near the limit would be weak in every second one, and they would never end.
            self.weak |= weak_frames(L if self.run.delays is None else self._undelayed(ref), measured)
        jump = self._jump_variances(ref)
        first = first_variance(ref, self.dt, bool(measured[0]))
        return RunInformation(L, g, self.dt, jump, jump / MANOEUVRE_S**2, self.moment, first), float(chi2.sum())

    def _spot_information(self, ref: Reference) -> tuple[Array, Array, Array]:
        """Information of the used spots at a reference: normal matrices (T, s, s), vectors (T, s), chi-squares (T,).

        s is 6, or 18 with delays, as in RunInformation.

        An exposure with a corner has a further error: the components of `beside`, one sigma, independent of each other.
        """
        L, g, chi2 = self._without_corners(ref)
        corners = np.flatnonzero(self.beside.any(axis=1))
        if len(corners):
            L, g, chi2 = L.copy(), g.copy(), chi2.copy()
        for k in corners:
            L[k], g[k], less = with_errors_along_axes(_padded(self.beside[k], g[k]), L[k], g[k])
            chi2[k] -= less
        return L, g, chi2

    def _without_corners(self, ref: Reference) -> tuple[Array, Array, Array]:
        """As `_spot_information`, without the errors of corners. The last reference's is kept."""
        if self.kept is not None and self.kept[0] is ref:
            return self.kept[1]
        run, start = self.run, self.core.start
        if run.delays is None:
            L, g, chi2 = spot_information(run.views, run.detections, self.assigned, run.calibration_cov, ref, start)
        else:
            L, g, chi2, _ = delayed_information(
                run.views, run.detections, run.delays, self.assigned, run.calibration_cov, ref, self._steps(), start
            )
        unused = ~self.used[self.core]
        L[unused], g[unused], chi2[unused] = 0.0, 0.0, 0.0
        # Along a direction that the spots leave open their paths are not straight, with the same sign in every frame.
        for a in (L, g, chi2):
            a[~self.measured] *= PARTIAL_WEIGHT
        self.kept = ref, (L, g, chi2)
        return L, g, chi2

    def _jump_variances(self, ref: Reference) -> Array:
        """`jump_variances` (T, 2) at a reference."""
        return jump_variances(
            ref, self.weak, self.measured, self.jumped, self.dt, self.excluded, self.jump_scale, self.moment
        )

    def _undelayed(self, ref: Reference) -> Array:
        """Normal matrices (T, 6, 6) as if all spots were of the instants of their frames.

        A jump makes the spots beside it vague; a frame that counted as weak for that would spread the jump further.
        """
        run = self.run
        L = spot_information(run.views, run.detections, self.assigned, run.calibration_cov, ref, self.core.start)[0]
        L[~self.used[self.core]] = 0.0
        return L

    def _steps(self) -> Steps:
        """What the motion leaves open within each step; nothing before the first pass."""
        if self.steps is not None:
            return self.steps
        none = np.zeros((len(self.dt), 6))
        return Steps(self.dt, none, none[:, :2].copy(), none[:, :2].copy(), self.moment)

    def _open_steps(self, density: Array) -> None:
        """Update the steps to jerk densities (T, 6) and to the jumps known so far."""
        jump = np.ascontiguousarray(self._jump_variances(self.ref))
        corners = corner_times(self.ref, self.jumped, self.dt)
        self.steps = Steps(self.dt, np.ascontiguousarray(density), jump, corners, self.moment.copy())
        self.kept = None

    # -- result -------------------------------------------------------------------------------------------------------

    def _extrapolated(self, out: Interval) -> SmoothedMotion:
        """The motion of all frames: the core's, and the prediction from its ends, forward and backward in time."""
        core, frames = self.core, len(self.run.dt)
        log_density = np.empty((frames, 6))
        log_density[core] = self.log_density
        log_density[: core.start], log_density[core.stop :] = self.log_density[0], self.log_density[-1]
        jump = P_JUMP_OUTSIDE * jump_variance(speeds(self.ref.m[[0, -1]]))  # at the core's first frame, and at its last
        ref, pose_P, motion_P = extrapolated(self.motion.ref, core, self.ref, out, self.run.dt, log_density, jump)
        sd = np.sqrt(np.diagonal(pose_P, axis1=1, axis2=2))
        known = (sd[:, :3].max(axis=1) < LOST_SIGMA_M) & (sd[:, 3:].max(axis=1) < LOST_SIGMA_RAD)
        jumped, scale = self.motion.jumped.copy(), self.motion.jump_scale.copy()
        moment, excluded = self.motion.moment.copy(), np.zeros(frames, dtype=bool)
        smoother = self.motion.smoother.copy()
        jumped[core], scale[core], moment[core] = self.jumped, self.jump_scale, self.moment
        excluded[core], smoother[core] = self.excluded, self.smoother
        clocks = self.clocks
        if clocks is not None:
            nearest = np.clip(np.arange(frames) - core.start, 0, core.stop - core.start - 1)
            clocks = replace(clocks, motion=clocks.motion[nearest])
        return SmoothedMotion(
            ref, log_density, self.interpolation_offset, smoother, jumped, scale, moment, excluded, pose_P, motion_P,
            known, self.weight, clocks,
        )  # fmt: skip


def _damped(info: RunInformation, damping: float) -> RunInformation:
    """Levenberg's damping: as if each frame's pose had been measured at the reference, with this sigma (m and rad)."""
    pose = np.diag(_padded(np.ones(6), info.vector[0]))
    return info._replace(information=info.information + pose / damping**2)


def _padded(b: Array, like: Array) -> Array:
    """A vector of the pose (6,) as one of the numbers that another (s,) is about: the others are 0."""
    return np.concatenate([b, np.zeros(len(like) - len(b))])
