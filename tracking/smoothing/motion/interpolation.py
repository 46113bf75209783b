"""The motion between frames, and before the first and after the last one whose spots are used.

Between frames a motion without jerk at high frequencies, as of all heavy bodies, is smoother than white jerk. How much
is found by predicting each frame from all others; beyond the frames the motion is predicted from them. Source: ours;
the leave-one-out predictive likelihood: Geisser & Eddy (1979), "A predictive approach to model selection", JASA 74.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools
from tracking.rigid_body.models.motion import ANY_MOMENT, STATE, predicted
from tracking.rigid_body.online_estimates import MANOEUVRE_S
from tracking.smoothing.motion.fixed_interval import (
    Interval,
    RunInformation,
    leave_one_out_log_likelihood,
    smoothed,
)
from tracking.smoothing.motion.run_detections import Reference

MOST_OWN = 0.9  # share of what is known of a pose that its own spots may have for these to be left out
OFFSETS = (-2.0, -4.0, -6.0)  # of log q: tried for the interpolation between frames
BLOCK = 20  # frames that share an offset, or have none


@dataclass(frozen=True, slots=True)
class Interpolation:
    """T frames whose motion between them may be smoother than white jerk."""

    ref: Reference
    info: RunInformation
    log_density: Array  # (T, 6) of the white jerk
    interior: Bools  # (T,) frames that may have a lower one
    pose_P: Array  # (T, 6, 6) with the white jerk

    def best_offset(self, delayed: bool) -> float:
        """Offset of log q with the largest leave-one-out likelihood: each frame predicted by all others.

        delayed: some spots were not exposed at the instants of their frames.
        """
        if not self.interior.any():
            return 0.0
        by_others = None
        if delayed:
            # Where the spots of a frame are also what the velocities are known by, they would count twice.
            by_others = (self.interior & self._known_by_others())[:, None, None]
            if 2 * by_others.sum() < self.interior.sum():
                return 0.0
        best, value = 0.0, self._leave_one_out(0.0, by_others)
        for offset in OFFSETS:
            likelihood = self._leave_one_out(offset, by_others)
            if likelihood < value:
                break
            best, value = offset, likelihood
        for offset in (best - 1.0, best + 1.0):
            if offset < 0:
                likelihood = self._leave_one_out(offset, by_others)
                if likelihood > value:
                    best, value = offset, likelihood
        return best

    def frames_better_with(self, offset: float) -> Bools:
        """(T,): frames that the others predict better with this offset, which is that of the whole run.

        A vehicle that rests and then swings rests most of the time.
        """
        better = np.zeros(len(self.interior), dtype=bool)
        L, g = of_poses(self.info.information) * self._known_by_others()[:, None, None], of_poses(self.info.vector)
        both = [smoothed(self.ref, self.info, self._density(o), tested=False) for o in (0.0, offset)]
        for first in range(0, len(better), BLOCK):
            block = slice(first, first + BLOCK)
            some = self.info._replace(information=L[block], vector=g[block], dt=self.info.dt[block])
            white, less = (leave_one_out_log_likelihood(out.x[block], out.pose_P[block], some) for out in both)
            better[block] = less > white
        return better

    def _known_by_others(self) -> Bools:
        """(T,): frames of whose pose the other frames know a part."""
        own = np.linalg.eigvals(self.pose_P @ of_poses(self.info.information)).real.max(axis=1)
        return np.asarray(own < MOST_OWN)

    def _density(self, offset: float) -> Array:
        return np.exp(self.log_density + offset * self.interior[:, None])

    def _leave_one_out(self, offset: float, by_others: Bools | None) -> float:
        out = smoothed(self.ref, self.info, self._density(offset), tested=False)
        # Of spots that were not exposed at the instant of their frame, what they say about the pose.
        left_out = of_poses(self.info.information)
        if by_others is not None:
            left_out = left_out * by_others
        about_poses = self.info._replace(information=left_out, vector=of_poses(self.info.vector))
        value = float(leave_one_out_log_likelihood(out.x, out.pose_P, about_poses))
        return value if np.isfinite(value) else -np.inf


def of_poses(a: Array) -> Array:
    """The part (..., 6) or (..., 6, 6) about the poses of vectors (T, s) or matrices (T, s, s)."""
    if a.shape[1] == 6:
        return a
    return np.ascontiguousarray(a[:, :6] if a.ndim == 2 else a[:, :6, :6])


def extrapolated(
    whole: Reference, core: slice, ref: Reference, out: Interval, dt: Array, log_density: Array, jump: Array
) -> tuple[Reference, Array, Array]:
    """The motion of T frames, and covariances (T, 6, 6) of poses and velocities.

    whole: any motion of all frames; ref, out: the estimate for those of `core`; dt (T,), s; log_density (T, 6): of the
    jerk; jump (2, 2): variances of the velocities' jump in each step before the core, and after it.
    """
    frames = len(dt)
    R, t, m = (np.array(a) for a in whole)
    R[core], t[core], m[core] = ref
    pose_P, motion_P = np.empty((frames, 6, 6)), np.empty((frames, 6, 6))
    pose_P[core], motion_P[core] = out.pose_P, out.motion_P
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
            R_k, t_k, m_k, P_k, _ = predicted(*at, step, density, size, size / MANOEUVRE_S**2, *ANY_MOMENT)
            at = (R_k, t_k, m_k, P_k)
            R[k], t[k], m[k] = at[0], at[1], at[2] * flip[6:]
            pose_P[k], motion_P[k] = at[3][:6, :6], at[3][6:12, 6:12]
    return Reference(R, t, m), pose_P, motion_P
