"""Most probable motion given all labelled spots of a run, with its covariance and its process noise.

Gauss-Newton on the whole run (fixed_interval.py) with Levenberg's damping; the true cost decides which steps are taken.
Between the steps the strength of the jerk and the velocity jumps (process_noise.py) are estimated.
Source: ours.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geometry.arrays import Array, Bools, Ints
from tracking.rigid_body.online_estimates import MANOEUVRE_S
from tracking.smoothing.motion.fixed_interval import Interval, RunInformation, log_likelihood, motion_cost, smoothed
from tracking.smoothing.motion.interpolation import Interpolation, extrapolated
from tracking.smoothing.motion.process_noise import (
    corner_offsets,
    jump_variances,
    largest_jumps,
    largest_near,
    new_jumps,
    next_log_density,
    weak_frames,
    with_errors_along_axes,
)
from tracking.smoothing.motion.run_detections import (
    Reference,
    SmoothedMotion,
    WholeRun,
    delayed_information,
    first_variance,
    shifted,
    spot_information,
    unknown_moments,
)
from tracking.statuses import LOST_SIGMA_M, LOST_SIGMA_RAD

MAX_PASSES = 25  # a limit: the passes end where nothing changes any more
ROUNDING_NATS = 10.0  # by which rounding may raise the cost
GLOBAL_PASSES = 5  # with one strength of the jerk for the whole run; then each window has its own
FIRST_ADAPTING_PASSES, LATER_ADAPTING_PASSES = 14, 2  # after which the strength is kept: in the first and later rounds
NO_JUMPS_BEFORE = 2  # passes: before that the strength of the jerk is too uncertain to detect jumps
NATS_PER_JUMP = 3.0  # by which a motion without jumps must be likelier: in doubt jumps, whose covariances are wider
CONVERGED_SIGMAS = 0.02  # a Gauss-Newton step below this is negligible
CONVERGED_LOG_DENSITY = 0.3  # change of log q, weighted by its determined components, below which the strength is kept
DAMPING = (np.inf, 0.1, 0.01, 1e-3)  # m and rad: tried in turn until the cost falls; inf: none
MAX_CORRECTIONS = 3  # steps that may follow a step before the cost has fallen
PARTIAL_WEIGHT = 0.25  # of the spots of a frame that does not determine the pose
P_JUMP_OUTSIDE = 0.15  # probability of a velocity jump in each frame that is extrapolated
MAX_DISTANCE = 12  # frames: spots farther from any measured frame are not used


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
    estimator = _Estimator(run, assigned, measured, used, core, motion)
    estimated = estimator.run_passes()
    if not (estimator.fresh and estimator.jumped.any()):
        return estimated
    # Fast swings look like corners as long as the strength of their jerk is not known.
    steady = replace(motion.without_covariances(), jumped=np.zeros_like(motion.jumped))
    swinging = _Estimator(run, assigned, measured, used, core, steady, jumps=False)
    try:
        other = swinging.run_passes()
    except FloatingPointError:
        return estimated
    if swinging.log_evidence() < estimator.log_evidence() + NATS_PER_JUMP * estimator.jumped.sum():
        return estimated
    return _Estimator(run, assigned, measured, used, core, other.without_covariances()).run_passes()


class _Estimator:
    """Passes over the core of one run: the frames from the first used one to the last."""

    def __init__(
        self, run: WholeRun, assigned: Ints, measured: Bools, used: Bools, core: slice, motion: SmoothedMotion,
        jumps: bool = True,
    ) -> None:  # fmt: skip
        """jumps: whether steps may get a velocity jump beside those of `motion`."""
        self.jumps = jumps
        self.run, self.assigned, self.used, self.core, self.motion = run, assigned, used, core, motion
        self.weight = np.where(used, np.where(measured, 1.0, PARTIAL_WEIGHT), 0.0)
        self.measured = measured[core]
        self.ref = Reference(*(np.ascontiguousarray(a[core]) for a in motion.ref))
        self.jumped = motion.jumped[core].copy()
        self.jumped[0] = False
        self.dt = np.ascontiguousarray(run.dt[core])
        self.beside = np.zeros((len(self.dt), 6))  # of corner_offsets, at the reference of the last step
        self.weak = np.zeros(len(self.dt), dtype=bool)  # (T,) see `jump_variances`
        self.kept: tuple[Reference, tuple[Array, Array, Array]] | None = None  # of the last `_without_corners`
        self.fresh = motion.log_density is None
        self.log_density = self._first_density() if motion.log_density is None else motion.log_density[core].copy()
        self.interpolation_offset = motion.interpolation_offset
        self.per_frame = 1.0  # instants at which the motion is estimated
        self.interior = np.ones(len(self.dt), dtype=bool)  # (T,) frames that all passes so far found to be interior

    def run_passes(self) -> SmoothedMotion:
        """Passes until nothing changes."""
        adapting = self.run.adapt_jerk
        first = 0 if self.fresh else GLOBAL_PASSES
        out: Interval | None = None
        for number in range(first, first + MAX_PASSES):
            density = self._density(out, interpolating=not adapting)
            # Without a jump, only the passes that estimate the strength of the jerk use the tests of the noise.
            result, moved = self._step(density, adapting or not self.run.adapt_jerk or bool(self.jumped.any()))
            if not (np.isfinite(result.x).all() and np.isfinite(result.pose_P).all()):
                if out is None:
                    raise FloatingPointError("the smoothing pass has no finite first step")
                break
            out = result
            converged = at_rest(out, moved)
            new = np.zeros_like(self.jumped)
            if self.jumps and (adapting or not self.run.adapt_jerk) and number >= NO_JUMPS_BEFORE:
                new = new_jumps(out.shock, self.jumped)
                self.jumped |= new
            if adapting:
                adapting = not self._adapt(out, number, number - first + 1, bool(new.any()))
            elif converged and not new.any():
                break
        assert out is not None
        return self._extrapolated(out)

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
            self.interpolation_offset = self._interpolation(out).best_offset()
        return last

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
        return Interpolation(self.ref, info, self.log_density, self._interior(out))

    def _interior(self, out: Interval) -> Bools:
        """(T,): frames farther than twice the smoother's memory from any gap, jump, end or frame with few spots."""
        info, _ = self._information(self.ref)
        share = np.einsum("kij,kji->k", out.pose_P, info.information)[self.measured]
        shown = share[share > 0]  # instants of frames with no spots of their own have none
        usual = float(np.median(shown)) * len(shown) / (6 * len(share)) if len(shown) else 1.0
        memory = int(np.clip(np.ceil(2 / max(usual, 1e-3 / self.per_frame)), 3, 200 * self.per_frame))
        # In a direction that few spots hardly determine the motion is that of a gap.
        weak = weak_frames(self._around(info.information), self.measured)
        edge: Bools = np.concatenate([[True], self._edges() | weak, [True]])
        near: Bools = largest_near(edge, memory)[1:-1]
        return ~near

    def _edges(self) -> Bools:
        """(T,): frames of gaps and velocity jumps."""
        return ~self.measured | self.jumped

    def _around(self, information: Array) -> Array:
        """Of the spots' information about the pose at each instant, (T, 6, 6), what counts for that instant."""
        return information

    def log_evidence(self) -> float:
        """Log-likelihood of the spots, nats up to a constant, with the motion integrated out.

        Each known velocity jump is at most as large as it is in the reference: with the variance of the fastest motion
        nearby, a slow corner is less likely than none.
        """
        info, chi2 = self._information(self.ref)
        at = np.flatnonzero(self.jumped)
        change = (self.ref.m[at] - self.ref.m[at - 1]).reshape(-1, 4, 3)
        size = np.mean(change**2, axis=2)
        velocity, acceleration = info.velocity_jump.copy(), info.acceleration_jump.copy()
        velocity[at] = np.minimum(velocity[at], size[:, :2])
        acceleration[at] = np.minimum(acceleration[at], size[:, 2:])
        info = info._replace(velocity_jump=velocity, acceleration_jump=acceleration)
        return log_likelihood(self.ref, info, np.exp(self.log_density)) - 0.5 * chi2

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
            self.weak |= weak_frames(L, measured)
        jump, moment = jump_variances(ref, self.weak, measured, jumped, self.dt), unknown_moments(len(self.dt))
        first = first_variance(ref, self.dt, bool(measured[0]))
        return RunInformation(L, g, self.dt, jump, jump / MANOEUVRE_S**2, moment, first), float(chi2.sum())

    def _spot_information(self, ref: Reference) -> tuple[Array, Array, Array]:
        """Information of the used spots at a reference: normal matrices (T, 6, 6), vectors (T, 6), chi-squares (T,).

        An exposure with a corner has a further error: the components of `beside`, one sigma, independent of each other.
        """
        L, g, chi2 = self._without_corners(ref)
        corners = np.flatnonzero(self.beside.any(axis=1))
        if len(corners):
            L, g, chi2 = L.copy(), g.copy(), chi2.copy()
        for k in corners:
            L[k], g[k], less = with_errors_along_axes(self.beside[k], L[k], g[k])
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
            L, g, chi2 = delayed_information(
                run.views, run.detections, run.delays, self.assigned, run.calibration_cov, ref, start
            )
        unused = ~self.used[self.core]
        L[unused], g[unused], chi2[unused] = 0.0, 0.0, 0.0
        # Along a direction that the spots leave open their paths are not straight, with the same sign in every frame.
        for a in (L, g, chi2):
            a[~self.measured] *= PARTIAL_WEIGHT
        self.kept = ref, (L, g, chi2)
        return L, g, chi2

    # -- result -------------------------------------------------------------------------------------------------------

    def _extrapolated(self, out: Interval) -> SmoothedMotion:
        """The motion of all frames: the core's, and the prediction from its ends, forward and backward in time."""
        core, frames = self.core, len(self.run.dt)
        log_density = np.empty((frames, 6))
        log_density[core] = self.log_density
        log_density[: core.start], log_density[core.stop :] = self.log_density[0], self.log_density[-1]
        # At the core's first frame, and at its last. A vehicle at rest may go on as it moved before, in gaps too.
        jump = P_JUMP_OUTSIDE * largest_jumps(self.ref, np.ones_like(self.measured), self.dt)[[0, -1]]
        ref, pose_P, motion_P = extrapolated(self.motion.ref, core, self.ref, out, self.run.dt, log_density, jump)
        sd = np.sqrt(np.diagonal(pose_P, axis1=1, axis2=2))
        known = (sd[:, :3].max(axis=1) < LOST_SIGMA_M) & (sd[:, 3:].max(axis=1) < LOST_SIGMA_RAD)
        jumped = self.motion.jumped.copy()
        jumped[core] = self.jumped
        return SmoothedMotion(
            ref, log_density, self.interpolation_offset, jumped, pose_P, motion_P, known, self.weight,
        )  # fmt: skip


def at_rest(out: Interval, moved: Array) -> bool:
    """Whether a pass has moved no frame, by (T, 18), by more than a share of its sigma."""
    sd = np.sqrt(np.maximum(np.diagonal(out.pose_P, axis1=1, axis2=2), 1e-30))
    return bool(np.all(np.abs(moved[:, :6]) < CONVERGED_SIGMAS * sd))


def _damped(info: RunInformation, damping: float) -> RunInformation:
    """Levenberg's damping: as if each frame's pose had been measured at the reference, with this sigma (m and rad)."""
    return info._replace(information=info.information + np.eye(6) / damping**2)
