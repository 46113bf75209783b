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
from tracking.smoothing.motion.fixed_interval import Interval, RunInformation, leave_one_out_log_likelihood, smoothed
from tracking.smoothing.motion.run_detections import Reference

OFFSETS = (-2.0, -4.0, -6.0)  # of log q: tried for the interpolation between frames


@dataclass(frozen=True, slots=True)
class Interpolation:
    """T frames whose motion between them may be smoother than white jerk."""

    ref: Reference
    info: RunInformation
    log_density: Array  # (T, 6) of the white jerk
    interior: Bools  # (T,) frames that may have a lower one

    def best_offset(self) -> float:
        """Offset of log q with the largest leave-one-out likelihood: each frame predicted by all others."""
        if not self.interior.any():
            return 0.0
        best, value = 0.0, self._leave_one_out(0.0)
        for offset in OFFSETS:
            likelihood = self._leave_one_out(offset)
            if likelihood < value:
                break
            best, value = offset, likelihood
        for offset in (best - 1.0, best + 1.0):
            if offset < 0:
                likelihood = self._leave_one_out(offset)
                if likelihood > value:
                    best, value = offset, likelihood
        return best

    def _leave_one_out(self, offset: float) -> float:
        density = np.exp(self.log_density + offset * self.interior[:, None])
        out = smoothed(self.ref, self.info, density, tested=False)
        value = float(leave_one_out_log_likelihood(out.x, out.pose_P, self.info))
        return value if np.isfinite(value) else -np.inf


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
