"""The motion before the first frame whose spots are used and after the last one, predicted from there."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array
from tracking.rigid_body.models.motion import ANY_MOMENT, STATE, predicted
from tracking.rigid_body.online_estimates import MANOEUVRE_S
from tracking.smoothing.motion.fixed_interval import Interval
from tracking.smoothing.motion.run_detections import Reference


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
