"""The motion that is most probable given all labelled spots of a run, with its covariance and its process noise.

Gauss-Newton on the whole run (tracking/smoothing/fixed_interval.py), damped after Levenberg, with the true cost
deciding which steps are taken; between steps the strength of the jerk (tracking/smoothing/process_noise.py) and the
steps in which the velocities jumped are found. Source: ours.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compiled_projection import Views
from geometry.pose import Pose
from tracking.rigid_body.adaptive_process_noise import STEADIES_WITHIN_S, jump_variance
from tracking.rigid_body.motion import STATE, predicted
from tracking.smoothing.fixed_interval import (
    FrameInformation,
    Interval,
    Reference,
    leave_one_out_log_likelihood,
    log_likelihood,
    motion_cost,
    shifted,
    smoothed,
    speeds,
)
from tracking.smoothing.process_noise import next_log_density
from tracking.smoothing.reassociation import AllDetections, evidence_of
from tracking.smoothing.windows import largest_near
from tracking.statuses import LOST_SIGMA_M, LOST_SIGMA_RAD

MOST_PASSES = 25
ROUNDING = 10.0  # nats of the cost
GLOBAL_PASSES = 5  # one strength for the whole run, before windows have their own
LEARNING_PASSES, MORE_PASSES = 14, 2  # after which the strength stays: at first, and in later rounds
NO_BENDS_BEFORE = 2  # passes: until then the strength is anybody's guess
SHOCK = 20.0  # chi-square of 6 degrees (p = 3e-3): a jump of the velocities beyond what the motion allows
APART = 2  # frames: of shocks so near each other the largest is looked at first
SMALL_STEP = 0.02  # sigmas: a step of Gauss-Newton that is nothing any more
SMALL_CHANGE = 0.3  # of log q, weighted by what determines it: the strength has settled
TRUST = (np.inf, 0.1, 0.01, 1e-3)  # m and rad: damping of a step, tried in turn until the cost falls
P_OCCLUDED = 0.05  # probability of a bend in each frame that does not show the pose
P_EITHER = 0.3  # of a bend being in each of several steps, where a frame between them says little
# Of log det of a frame's information below the usual: its pose's sigmas are half as large again.
WEAK = 2 * 6 * np.log(1.5)
OPEN_WEIGHT = 0.25  # of the spots of a frame that does not show the pose
P_BEYOND = 0.15  # of a bend in each frame before the first evidence or after the last: nothing beyond bounds it
DEEP = 12  # frames: so far from any measured one a few spots are not taken for evidence
SPEED_WINDOW_S = 0.5  # a bend's size is judged by the fastest motion within this time of it
FINER = (-2.0, -4.0, -6.0)  # of log q: tried for filling in between frames


@dataclass(frozen=True, slots=True)
class WholeRun:
    """What stays the same while the motion is estimated: T frames, n views."""

    views: Views
    every: AllDetections
    extra: Array  # (n, 2, 2) px^2, of the calibration's errors on the expected pixels
    dt: Array  # (T,) s
    exposure_s: float
    learn: bool  # the strength of the jerk; else it stays as it is


@dataclass(frozen=True, slots=True)
class SmoothedMotion:
    """The estimate, T frames."""

    ref: Reference
    log_density: Array | None  # (T, 6) log of the jerk's spectral densities; None: not known yet
    finer: float  # to be added to it for filling in between frames
    bent: Bools  # (T,) the velocities jumped in the step before
    pose_P: Array  # (T, 6, 6)
    motion_P: Array  # (T, 6, 6) of the velocities
    known: Bools  # (T,) the pose says something

    @staticmethod
    def begin(ref: Reference, bent: Bools, log_density: Array | None) -> SmoothedMotion:
        """A first guess."""
        frames = len(ref.t)
        nothing = np.zeros((frames, 6, 6))
        none = np.zeros(frames, dtype=bool)
        return SmoothedMotion(ref, log_density, 0.0, bent, nothing, nothing, none)


def estimate(
    run: WholeRun, assigned: Ints, measured: Bools, motion: SmoothedMotion, deep: int, trusted: Bools
) -> SmoothedMotion:
    """The motion given labels (T, n). measured (T,): frames whose own spots give the pose.

    deep: frames; so far from any measured frame spots are not taken for evidence (0: only measured frames are), nor are
    those of frames that are not trusted (T,). Frames before the first evidence and after the last are extrapolated.
    """
    frames = len(run.dt)
    measured = measured & trusted
    far = ~largest_near(measured, deep)
    used = ~far & trusted & (assigned >= 0).any(axis=1)
    if not measured.any():
        return replace(motion, known=np.zeros(frames, dtype=bool))
    at = np.flatnonzero(used)
    core = slice(int(at[0]), int(at[-1]) + 1)
    estimator = _Estimator(run, assigned, measured, used, core, motion)
    return estimator.run_passes()


class _Estimator:
    """The passes over the core of one run: the frames from the first evidence to the last."""

    def __init__(
        self, run: WholeRun, assigned: Ints, measured: Bools, used: Bools, core: slice, motion: SmoothedMotion
    ) -> None:
        self.run, self.assigned, self.used, self.core, self.motion = run, assigned, used, core, motion
        self.measured = measured[core]
        self.ref = Reference(*(np.ascontiguousarray(a[core]) for a in motion.ref))
        self.bent = motion.bent[core].copy()
        self.bent[0] = False
        self.dt = np.ascontiguousarray(run.dt[core])
        self.log_density = None if motion.log_density is None else motion.log_density[core].copy()
        self.finer = motion.finer

    def run_passes(self) -> SmoothedMotion:
        """Passes until nothing changes."""
        fresh = self.log_density is None
        learning = self.run.learn
        if self.log_density is None:
            self.log_density = self._first_density()
        first = 0 if fresh else GLOBAL_PASSES
        out: Interval | None = None
        for number in range(first, first + MOST_PASSES):
            density = self._density(out, filling_in=not learning)
            there, moved = self._step(density)
            if not (np.isfinite(there.x).all() and np.isfinite(there.pose_P).all()):
                if out is None:
                    raise FloatingPointError("the smoothing pass has no finite first step")
                break
            out = there
            sd = np.sqrt(np.maximum(np.diagonal(out.pose_P, axis1=1, axis2=2), 1e-30))
            settled = bool(np.all(np.abs(moved[:, :6]) < SMALL_STEP * sd))
            more = np.zeros_like(self.bent)
            if (learning or not self.run.learn) and number >= NO_BENDS_BEFORE:
                more = self._new_bends(out.shock)
                self.bent |= more
            if learning:
                before = self.log_density
                steady = ~self.bent
                steady[0] = False
                self.log_density = next_log_density(before, out, steady, local=number >= GLOBAL_PASSES)
                weight = np.minimum(out.gamma, 1.0)
                change = float(np.max(np.abs(self.log_density - before) * np.sqrt(weight), initial=0.0))
                still = number >= GLOBAL_PASSES + 1 and change < SMALL_CHANGE and not more.any()
                if still or number - first + 1 >= (LEARNING_PASSES if fresh else MORE_PASSES):
                    learning = False
                    if fresh:
                        self.finer = self._best_finer(out)
                continue
            if settled and not more.any():
                break
        assert out is not None
        return self._whole(out)

    def _first_density(self) -> Array:
        """The likeliest strength on a coarse grid, the same for all axes of translation, and of rotation."""
        ev, _ = self._evidence(self.ref)
        steps = np.log(10.0) * np.arange(-4.0, 7.0, 2.0)
        grid = [np.repeat([a, a + 2 * np.log(3.0)], 3) for a in steps]

        def cost(log_density: Array) -> float:
            value = log_likelihood(self.ref, ev, np.broadcast_to(np.exp(log_density), (len(self.dt), 6)).copy())
            return value if np.isfinite(value) else -np.inf

        return np.tile(max(grid, key=cost), (len(self.dt), 1))

    def _density(self, out: Interval | None, filling_in: bool) -> Array:
        """Spectral densities (T, 6): the learnt ones, or, well inside a run of measured frames, the finer ones.

        The learnt strength is the one that looks ahead best. Between frames a motion without jerk at high frequencies,
        as of all heavy things, is smoother than white jerk of that strength; near the ends of a run, a gap or a bend
        the finer one reaches too far.
        """
        assert self.log_density is not None
        if not filling_in or out is None or self.finer == 0.0:
            return np.exp(self.log_density)
        return np.exp(self.log_density + self.finer * self._inside(out)[:, None])

    def _inside(self, out: Interval) -> Bools:
        """(T,): frames farther than twice the smoother's memory from any edge."""
        ev, _ = self._evidence(self.ref)
        share = np.einsum("kij,kji->k", out.pose_P, ev.information)[self.measured]
        usual = float(np.median(share)) / 6 if len(share) else 1.0
        memory = int(np.clip(np.ceil(2 / max(usual, 1e-3)), 3, 200))
        edge: Bools = np.concatenate([[True], ~self.measured | self.bent, [True]])
        near: Bools = largest_near(edge, memory)[1:-1]
        return ~near

    def _best_finer(self, out: Interval) -> float:
        """By how much smaller the strength is (in log q) under which each frame is best predicted by all others."""
        assert self.log_density is not None
        ev, _ = self._evidence(self.ref)
        inside = self._inside(out)
        if not inside.any():
            return 0.0
        best, value = 0.0, self._left_out(ev, 0.0, inside)
        for finer in FINER:
            there = self._left_out(ev, finer, inside)
            if there < value:
                break
            best, value = finer, there
        for finer in (best - 1.0, best + 1.0):
            there = self._left_out(ev, finer, inside) if finer < 0 else -np.inf
            if there > value:
                best, value = finer, there
        return best

    def _left_out(self, ev: FrameInformation, finer: float, inside: Bools) -> float:
        assert self.log_density is not None
        out = smoothed(self.ref, ev, np.exp(self.log_density + finer * inside[:, None]))
        value = float(leave_one_out_log_likelihood(out.x, out.pose_P, ev))
        return value if np.isfinite(value) else -np.inf

    def _step(self, density: Array) -> tuple[Interval, Array]:
        """One damped step of Gauss-Newton; the undamped smoother's result at the new reference's linearisation, and
        how far each frame moved (T, 18).
        """
        ev, misfit = self._evidence(self.ref)
        cost = 0.5 * misfit + motion_cost(self.ref, ev, density)
        out = smoothed(self.ref, ev, density)
        for trust in TRUST:
            x = out.x if np.isinf(trust) else smoothed(self.ref, _damped(ev, trust), density).x
            if not np.isfinite(x).all():
                continue
            there = shifted(self.ref, x)
            cost_there = 0.5 * float(self._of_the_spots(there)[2].sum()) + motion_cost(there, ev, density)
            # Damping is against steps that leave the region where all is straight; rounding alone makes some nats.
            if cost_there <= cost + ROUNDING * (1 + 1e-3 * abs(cost)):
                self.ref = there
                return out, x
        return out, np.zeros_like(out.x)

    def _evidence(self, ref: Reference) -> tuple[FrameInformation, float]:
        """The frames' information at a reference, where the motion may have bent; the spots' misfit (chi-square)."""
        run, measured, bent = self.run, self.measured, self.bent
        L, g, chi2 = self._of_the_spots(ref)
        if run.exposure_s > 0:
            for k in np.flatnonzero(bent[1:] & measured[1:] & measured[:-1]):
                # The light of an exposure in which the velocities jump lies beside the corner, by up to an eighth of
                # the exposure's share of the jump: the same for all spots, as if the vehicle were there.
                b = (ref.m[k + 1, :6] - ref.m[k, :6]) * run.exposure_s / 8
                Lb = L[k] @ b
                share = 1 / (1 + b @ Lb)
                g[k] -= Lb * (b @ g[k]) * share
                L[k] -= np.outer(Lb, Lb) * share
        jump = self._jumps(ref, L)
        first = _before_the_first(ref, self.dt, bool(measured[0]))
        return FrameInformation(L, g, self.dt, jump, jump / STEADIES_WITHIN_S**2, first), float(chi2.sum())

    def _of_the_spots(self, ref: Reference) -> tuple[Array, Array, Array]:
        """What the labelled spots say at a reference: information (T, 6, 6), vector (T, 6), chi-square (T,)."""
        run = self.run
        L, g, chi2, _ = evidence_of(run.views, run.every, self.assigned, run.extra, ref, self.core.start)
        dropped = ~self.used[self.core]
        L[dropped], g[dropped], chi2[dropped] = 0.0, 0.0, 0.0
        # Spots that leave a direction of the pose open are not straight along it, frame after frame in the same sense.
        for a in (L, g, chi2):
            a[~self.measured] *= OPEN_WEIGHT
        return L, g, chi2

    def _jumps(self, ref: Reference, information: Array) -> Array:
        """(T, 2) variances of the velocities' jumps in each step."""
        measured, dt = self.measured, self.dt
        usual = float(np.median(dt[dt > 0])) if np.any(dt > 0) else SPEED_WINDOW_S
        window = max(1, min(round(SPEED_WINDOW_S / usual), len(dt)))
        size = jump_variance(largest_near(np.where(measured[:, None], speeds(ref.m), 0.0), window))
        # After a dark stretch the first light does not tell when it bent, and the second not whether it did so between.
        dark = ~measured
        dark[1:] |= ~measured[:-1]
        dark[2:] |= ~measured[:-2]
        chance = np.where(dark, P_OCCLUDED, 0.0)
        bends = np.flatnonzero(self.bent)
        weak = ~measured | _weak(information, measured) if len(bends) else measured
        for k in bends:
            first, last = k, k
            while first > 1 and weak[first - 1]:
                first -= 1
            while last < len(dt) - 1 and weak[last]:
                last += 1
            # In one of the steps between the frames that show the pose well; which one is not known.
            share = 1.0 if first == last else max(1.0 / (last + 1 - first), P_EITHER)
            chance[first : last + 1] = np.maximum(chance[first : last + 1], share)
            chance[k] = 1.0
        return np.asarray(chance[:, None] * size)

    def _new_bends(self, shock: Array) -> Bools:
        """(T,): steps in which the velocities jumped and that are not known of: the largest shock of each place."""
        peak = shock >= largest_near(np.where(self.bent, 0.0, shock), APART)
        return np.asarray(peak & (shock > SHOCK) & ~self.bent)

    def _whole(self, out: Interval) -> SmoothedMotion:
        """The result of all frames: the core's, and what follows from its ends."""
        core, frames = self.core, len(self.run.dt)
        assert self.log_density is not None
        R, t, m = (np.array(a) for a in self.motion.ref)
        R[core], t[core], m[core] = self.ref
        pose_P, motion_P = np.empty((frames, 6, 6)), np.empty((frames, 6, 6))
        pose_P[core], motion_P[core] = out.pose_P, out.motion_P
        log_density = np.empty((frames, 6))
        log_density[core] = self.log_density
        log_density[: core.start], log_density[core.stop :] = self.log_density[0], self.log_density[-1]
        jump = P_BEYOND * jump_variance(speeds(self.ref.m[[0, -1]]))  # at the core's first frame, and at its last
        dt = self.run.dt
        last = core.stop - 1
        forward = [(k, dt[k]) for k in range(core.stop, frames)]
        backward = [(k, dt[k + 1]) for k in range(core.start - 1, -1, -1)]
        for start, P, steps, sign, size in (
            (last, out.ends_P[1], forward, 1.0, jump[1]),
            (core.start, out.ends_P[0], backward, -1.0, jump[0]),
        ):
            flip = np.ones(STATE)
            flip[6:12] = sign  # time reversed: velocities change sign, accelerations do not
            at = (R[start].copy(), t[start].copy(), m[start] * flip[6:], P * np.outer(flip, flip))
            density = np.exp(log_density[start])
            for k, step in steps:
                R_k, t_k, m_k, P_k, _ = predicted(*at, step, density, size, size / STEADIES_WITHIN_S**2)
                at = (R_k, t_k, m_k, P_k)
                R[k], t[k], m[k] = at[0], at[1], at[2] * flip[6:]
                pose_P[k], motion_P[k] = at[3][:6, :6], at[3][6:12, 6:12]
        sd = np.sqrt(np.diagonal(pose_P, axis1=1, axis2=2))
        known = (sd[:, :3].max(axis=1) < LOST_SIGMA_M) & (sd[:, 3:].max(axis=1) < LOST_SIGMA_RAD)
        bent = self.motion.bent.copy()
        bent[core] = self.bent
        return SmoothedMotion(Reference(R, t, m), log_density, self.finer, bent, pose_P, motion_P, known)


def _weak(information: Array, measured: Bools) -> Bools:
    """(T,): frames that say much less of the pose than the run's frames usually do."""
    sign, log_det = np.linalg.slogdet(information)
    log_det = np.where(sign > 0, log_det, -np.inf)
    usual = float(np.median(log_det[measured])) if measured.any() else 0.0
    return np.asarray(log_det < usual - WEAK)


def _damped(ev: FrameInformation, trust: float) -> FrameInformation:
    """Levenberg's damping: as if each frame's pose had been measured where it is, to within `trust` (m and rad)."""
    return ev._replace(information=ev.information + np.eye(6) / trust**2)


def _before_the_first(ref: Reference, dt: Array, measured: bool) -> Array:
    """(18,) variances of the first frame's deviation: wide against what the run shows."""
    speed = np.abs(ref.m[:, :6]).reshape(-1, 2, 3).max(axis=(0, 2), initial=0.0)
    change = np.abs(np.diff(ref.m[:, :6], axis=0)) / np.maximum(dt[1:, None], 1e-9)
    acceleration = change.reshape(-1, 2, 3).max(axis=(0, 2), initial=0.0)
    pose = [0.1, 0.1] if measured else [1.0, 1.0]
    return np.asarray(np.repeat([*pose, *(2 * speed + 0.1), *(2 * acceleration + 1.0)], 3) ** 2)


def straight_between(poses: Array, measured: Bools, t_s: Array) -> Reference:
    """A first reference: the measured ones of poses (T, 4, 3), what lies between two of them on the straight way, with
    the velocities of differences.
    """
    at = np.flatnonzero(measured & np.isfinite(poses[:, 3, 0]))
    frames = len(t_s)
    if not len(at):
        return Reference(np.tile(np.eye(3), (frames, 1, 1)), np.zeros((frames, 3)), np.zeros((frames, 12)))
    right = np.clip(np.searchsorted(at, np.arange(frames)), 0, len(at) - 1)
    left = np.where(at[right] > np.arange(frames), np.maximum(right - 1, 0), right)
    a, b = at[left], at[right]
    length = t_s[b] - t_s[a]
    share = np.where(length > 0, (t_s - t_s[a]) / np.where(length > 0, length, 1.0), 0.0)
    share = np.clip(share, 0.0, 1.0)  # before the first and after the last: that pose
    before, after = Pose(poses[a, :3], poses[a, 3]), Pose(poses[b, :3], poses[b, 3])
    between = before.plus(after.minus(before) * share[:, None])
    R, t = np.ascontiguousarray(between.rotation), np.ascontiguousarray(between.translation)
    m = np.zeros((frames, 12))
    if frames > 2:
        step = Pose(R[2:], t[2:]).minus(Pose(R[:-2], t[:-2]))
        time = (t_s[2:] - t_s[:-2])[:, None]
        m[1:-1, :6] = step / np.where(time > 0, time, 1.0)
        m[0], m[-1] = m[1], m[-2]
    return Reference(R, t, m)
