"""Velocity jumps (corners of the motion) in the steps of a run: which steps may have one, how large, and new ones."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Bools
from tracking.rigid_body.adaptive_process_noise import jump_variance
from tracking.rigid_body.models.motion import process_noise
from tracking.smoothing.motion.reference import Reference, speeds
from tracking.smoothing.motion.windows import largest_near

SHOCK_CHI2 = 20.0  # chi-square of 6 degrees (p = 3e-3) above which a step gets a velocity jump
SHOCK_SEPARATION = 2  # frames: of shocks this close to each other only the largest becomes a jump
P_JUMP_OCCLUDED = 0.05  # probability of a jump in each step at a frame that does not determine the pose
P_JUMP_SHARED = 0.3  # least probability of a known jump in each of several steps between which little is observed
# Log determinant of a frame's information below the run's usual one: sigmas of the pose half as large again.
WEAK_LOG_DET = 2 * 6 * np.log(1.5)
SHORT_EXPOSURE = 0.1  # of the step between two frames: with a shorter exposure a corner is hardly ever within one
SPEED_WINDOW_S = 0.5  # s: the size of a jump follows from the fastest motion within this time of it


def jump_variances(ref: Reference, weak: Bools, measured: Bools, jumped: Bools, dt: Array) -> Array:
    """Variances (T, 2) of the velocities' jump in each step, (m/s)^2 and (rad/s)^2, weighted with its probability.

    measured (T,): frames whose spots determine the pose; weak (T,): those that do so much worse than usual; jumped
    (T,): steps with a known jump; dt (T,), s.
    """
    usual = float(np.median(dt[dt > 0])) if np.any(dt > 0) else SPEED_WINDOW_S
    window = max(1, min(round(SPEED_WINDOW_S / usual), len(dt)))
    size = jump_variance(largest_near(np.where(measured[:, None], speeds(ref.m), 0.0), window))
    # The first measured frame after a gap does not show when a jump happened, and the second one does not show whether
    # it happened between the two.
    unobserved = ~measured
    unobserved[1:] |= ~measured[:-1]
    unobserved[2:] |= ~measured[:-2]
    probability = np.where(unobserved, P_JUMP_OCCLUDED, 0.0)
    jumps = np.flatnonzero(jumped)
    weak = ~measured | weak
    for k in jumps:
        first, last = k, k
        while first > 1 and weak[first - 1]:
            first -= 1
        while last < len(dt) - 1 and weak[last]:
            last += 1
        # The jump is in one of the steps between the frames that determine the pose well.
        share = 1.0 if first == last else max(1.0 / (last + 1 - first), P_JUMP_SHARED)
        probability[first : last + 1] = np.maximum(probability[first : last + 1], share)
        probability[k] = 1.0
    return np.asarray(probability[:, None] * size)


def new_jumps(shock: Array, jumped: Bools) -> Bools:
    """(T,): steps with a velocity jump that is not known yet (jumped (T,)): local maxima of the shock (T,)."""
    peak = shock >= largest_near(np.where(jumped, 0.0, shock), SHOCK_SEPARATION)
    return np.asarray(peak & (shock > SHOCK_CHI2) & ~jumped)


def corner_offsets(ref: Reference, jumped: Bools, exposure_s: float, dt: Array) -> Array:
    """Largest mean pose over the exposure less that at its middle, (T, 6), where the velocities jump; 0 elsewhere.

    Where they jump at the middle of the exposure, the mean is an eighth of the exposure times the jump beside the
    corner: for all spots as if the vehicle were there. A jump before frame k (jumped[k]) is in the exposure of that
    frame or of the one before it. Short exposures hardly ever contain one and get 0. Source: ours.
    """
    out = np.zeros((len(ref.t), 6))
    for k in np.flatnonzero(jumped[1:] & (exposure_s > SHORT_EXPOSURE * dt[1:])) + 1:
        b = (ref.m[k, :6] - ref.m[k - 1, :6]) * exposure_s / 8
        for frame in (k - 1, k):
            if np.linalg.norm(b) > np.linalg.norm(out[frame]):
                out[frame] = b
    return out


def with_error_along(b: Array, information: Array, vector: Array) -> tuple[Array, Array, float]:
    """Information (s, s) and vector (s,) of spots with a further common error, of one sigma b (s,); and by how much
    their chi-square falls. Source: the Sherman-Morrison formula.
    """
    Lb = information @ b
    along, share = float(b @ vector), float(1 / (1 + b @ Lb))
    return information - np.outer(Lb, Lb) * share, vector - Lb * along * share, along**2 * share


def with_errors_along_axes(b: Array, information: Array, vector: Array) -> tuple[Array, Array, float]:
    """As `with_error_along`, with an independent error of one sigma b_i of each pose component.

    Two components that turn within one frame do so at different moments, and the error is not a multiple of b.
    """
    total = 0.0
    for i in np.flatnonzero(b):
        one = np.zeros(len(b))
        one[i] = b[i]
        information, vector, less = with_error_along(one, information, vector)
        total += less
    return information, vector, total


def weak_frames(information: Array, measured: Bools) -> Bools:
    """(T,): frames with much less information (T, 6, 6) about the pose than is usual in the run."""
    sign, log_det = np.linalg.slogdet(information)
    log_det = np.where(sign > 0, log_det, -np.inf)
    usual = float(np.median(log_det[measured])) if measured.any() else 0.0
    return np.asarray(log_det < usual - WEAK_LOG_DET)


def jump_sigmas(ref: Reference, dt: Array) -> Array:
    """Sigmas (T, 6) of the pose, m and rad, that a velocity jump in the step before a frame adds."""
    size = jump_variance(speeds(ref.m))
    step = np.maximum(dt, np.concatenate([dt[1:], dt[-1:]]))
    out = np.empty((len(dt), 6))
    for k in range(len(dt)):
        for i in range(2):
            variance = process_noise(float(max(step[k], 1e-9)), 0.0, float(size[k, i]), 0.0)[0]
            out[k, 3 * i : 3 * i + 3] = np.sqrt(variance)
    return out
