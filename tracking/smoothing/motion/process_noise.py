"""Strength of the motion's white jerk, by axis and by time, and velocity jumps (corners) in the steps of a run."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from geometry.arrays import Array, Bools, true_ranges, weighted_median
from geometry.pose import Pose
from tracking.rigid_body.models.motion import ANY_MOMENT, process_noise
from tracking.rigid_body.online_estimates import jump_variance
from tracking.smoothing.motion.fixed_interval import Interval
from tracking.smoothing.motion.run_detections import Reference, speeds

# Moving maximum and mean of a series.
#
# scipy.ndimage has both, but its import takes 0.1 s of a run that must start in half a second. The tests compare with
# it.

Values = TypeVar("Values", Array, Bools)


def largest_near(values: Values, half: int) -> Values:
    """Moving maximum (T, ...) of values (T, ...) over at most `half` places on either side along the first axis.

    From maxima over 1, 2, 4 ... places; the last two, which overlap, make the window.
    """
    frames = len(values)
    half = min(half, frames)
    if frames == 0 or half == 0:
        return values.copy()
    window = 2 * half + 1
    at_ends = [(half, half)] + [(0, 0)] * (values.ndim - 1)
    largest, span = np.pad(values, at_ends, mode="edge"), 1
    while 2 * span <= window:
        largest = np.maximum(largest[:-span], largest[span:])
        span *= 2
    rest = window - span
    return np.asarray(np.maximum(largest[:frames], largest[rest : rest + frames]), dtype=values.dtype)


def window_mean(values: Array, width: int) -> Array:
    """Moving mean (T,) of values (T,) over `width` places, width // 2 of them before each; zeros beyond the ends.

    A running sum, bit-identical to scipy.ndimage.uniform_filter1d.
    """
    padded = np.concatenate([np.zeros(width // 2), values, np.zeros(width - width // 2 - 1)])
    first = np.cumsum(padded[:width])[-1:]
    return np.asarray(np.cumsum(np.concatenate([first, padded[width:] - padded[:-width]])) / width)


# Strength of the motion's white jerk, by axis and by time, from the smoother's test quantities.
#
# MacKay's fixed point: the strength q is right where the summed energy r^T Q r of the process noise equals its
# expectation tr(Q N), the number of its components that the data determine. One pass of the smoother gives both for all
# axes and frames, so that no search over q is needed. On uniform motion q stops falling where one component of the
# noise is still determined: the floor follows from the data, and a later velocity jump can raise q again.
#
# Source: MacKay (1992), "Bayesian interpolation", Neural Computation 4, eq. 4.9 (the fixed point); windows and
# pseudo-counts: ours.

# Logarithms of (m/s^3)^2/Hz or (rad/s^3)^2/Hz. The lower end suits a vehicle at rest: over 10 s it allows 1 mm. Below
# it rounding errors matter.
LOG_RANGE = 2 * np.log([1e-5, 1e6])
PSEUDO_COUNT = 2.0  # determined components of the present strength that are added to each window
MIN_COUNT = 1.0  # determined components of a window, below which the strength does not fall
NO_DATA_SHARE = 0.01  # of that: a window without data, whose strength stays
WINDOW_COUNT = 12.0  # determined components per window: the sigma of the logarithm of its strength is then 0.4
AXES_SIGMA = 2.0  # of log q between axes: a factor of 2.7 in the motion
RELAXATION = 1.6  # of the fixed point's step in log q: gamma changes by q^(1/6), so plain steps are short
MAX_STEP = 4.0  # in log q


def next_log_density(log_density: Array, out: Interval, usable: Bools, local: bool) -> Array:
    """The logarithms (T, 6) of the spectral densities after one step of the fixed point.

    log_density (T, 6): those of the pass that made `out`; usable (T,): steps of steady motion, without a velocity jump.
    local: each window has its own strength, else the whole run has that of its median window.
    """
    energy = np.where(usable[:, None], out.energy, 0.0)
    gamma = np.where(usable[:, None], out.gamma, 0.0)
    frames = len(energy)
    energies, gammas = np.empty_like(log_density), np.empty_like(log_density)
    for axis in range(log_density.shape[1]):
        total = float(gamma[:, axis].sum())
        width = frames if total <= 0 else int(np.clip(np.ceil(frames * WINDOW_COUNT / total), 9, frames))
        energies[:, axis], gammas[:, axis] = (_window_sums(a[:, axis], width) for a in (energy, gamma))
    prior = _prior_components(log_density, gammas)
    change = np.empty_like(log_density)
    for axis in range(log_density.shape[1]):
        e, g, p = energies[:, axis], gammas[:, axis], prior[:, axis]
        step = np.log((e + PSEUDO_COUNT + np.maximum(p, 0.0)) / (g + PSEUDO_COUNT + np.maximum(-p, 0.0)))
        # The strength must not fall so far that no data could raise it again.
        has_data = g > NO_DATA_SHARE * MIN_COUNT
        step = np.where(
            has_data, np.maximum(step, 2 * np.log(MIN_COUNT / np.maximum(g, NO_DATA_SHARE * MIN_COUNT))), 0.0
        )
        if not local:
            # The median of the windows: velocity jumps that are not known yet raise few of them.
            step[:] = weighted_median(step, g)
        change[:, axis] = np.clip(RELAXATION * step, -MAX_STEP, MAX_STEP)
    return np.clip(log_density + change, *LOG_RANGE)


def _prior_components(log_density: Array, gamma: Array) -> Array:
    """(T, 6): by how much a prior raises the energy of the process noise, in determined components.

    The prior: log q of an axis is normal about that of the axes of its kind, translation or rotation, weighted with
    what the data determine of each, gamma (T, 6). Without it the strength of an axis in which the motion is smaller
    than the noise collapses to zero, the usual fault of a variance estimated from weak data, and the covariance with
    it. Where the data determine it the prior weighs one or two components of dozens.
    """
    out = np.empty_like(log_density)
    for axes in (slice(0, 3), slice(3, 6)):
        weight = gamma[:, axes] + 1e-9
        centre = np.sum(weight * log_density[:, axes], axis=1) / weight.sum(axis=1)
        out[:, axes] = 2 * (centre[:, None] - log_density[:, axes]) / AXES_SIGMA**2
    return out


def _window_sums(values: Array, width: int) -> Array:
    """Sums of values (T,) weighted with a triangle about each, whose area is `width`.

    A box would suppress some wavelengths completely; there the fixed point would grow without limit.
    """
    once = window_mean(values, width)
    return np.maximum(window_mean(once, width) * width, 0.0)


SHOCK_CHI2 = 20.0  # chi-square of 6 degrees (p = 3e-3) above which a step gets a velocity jump
SHOCK_SEPARATION = 2  # frames: of shocks this close to each other only the largest becomes a jump
P_JUMP_OCCLUDED = 0.05  # probability of a jump in each step at a frame that does not determine the pose
P_JUMP_SHARED = 0.3  # least probability of a known jump in each of several steps between which little is observed
# Log determinant of a frame's information below the run's usual one: sigmas of the pose half as large again.
WEAK_LOG_DET = 2 * 6 * np.log(1.5)
SPEED_WINDOW_S = 0.5  # s: the size of a jump follows from the fastest motion within this time of it


def unobserved_steps(measured: Bools) -> Bools:
    """(T,): steps in which a jump would not show. measured (T,): frames whose spots determine the pose.

    The first measured frame after a gap does not show when a jump happened, and the second one does not show whether it
    happened between the two.
    """
    out = ~measured
    out[1:] |= ~measured[:-1]
    out[2:] |= ~measured[:-2]
    return out


def largest_jumps(ref: Reference, measured: Bools, dt: Array) -> Array:
    """Variances (T, 2) of jumps as large as the fastest motion near each step, (m/s)^2 and (rad/s)^2.

    In a gap: near the whole of it. What a vehicle did at one end of it it may have done at the other, and in between.
    """
    usual = float(np.median(dt[dt > 0])) if np.any(dt > 0) else SPEED_WINDOW_S
    window = max(1, min(round(SPEED_WINDOW_S / usual), len(dt)))
    fastest = largest_near(np.where(measured[:, None], speeds(ref.m), 0.0), window)
    for first, end in true_ranges(unobserved_steps(measured)):
        fastest[first:end] = fastest[first:end].max(axis=0)
    return jump_variance(fastest)


def jump_variances(ref: Reference, weak: Bools, measured: Bools, jumped: Bools, dt: Array) -> Array:
    """Variances (T, 2) of the velocities' jump in each step, (m/s)^2 and (rad/s)^2, weighted with its probability.

    measured (T,): frames whose spots determine the pose; weak (T,): those that do so much worse than usual; jumped
    (T,): steps with a known jump; dt (T,), s.
    """
    probability = np.where(unobserved_steps(measured), P_JUMP_OCCLUDED, 0.0)
    vague = ~measured | weak
    for k in np.flatnonzero(jumped):
        probability[k] = 1.0
        # The jump is in one of the steps between the frames that determine the pose well.
        first, last = k, k
        while first > 1 and vague[first - 1]:
            first -= 1
        while last < len(vague) - 1 and vague[last]:
            last += 1
        share = 1.0 if first == last else max(1.0 / (last + 1 - first), P_JUMP_SHARED)
        probability[first : last + 1] = np.maximum(probability[first : last + 1], share)
    return np.asarray(probability[:, None] * largest_jumps(ref, measured, dt))


def new_jumps(shock: Array, jumped: Bools) -> Bools:
    """(T,): steps with a velocity jump that is not known yet (jumped (T,)): local maxima of the shock (T,)."""
    peak = shock >= largest_near(np.where(jumped, 0.0, shock), SHOCK_SEPARATION)
    return np.asarray(peak & (shock > SHOCK_CHI2) & ~jumped)


def corner_offsets(ref: Reference, jumped: Bools, exposure_s: float, dt: Array) -> Array:
    """Largest mean pose over the exposure less that at its middle, (T, 6), where the velocities jump; 0 elsewhere.

    Where they jump at the middle of the exposure, the mean is an eighth of the exposure times the jump beside the
    corner: for all spots as if the vehicle were there. A jump before frame k (jumped[k]) may be in the exposure of that
    frame or of the one before it, or beside a step that is also taken for a jump because of that offset. Each component
    turns where its straight lines before and after meet; if that is farther than an exposure from the middle of a
    frame, it has no error there. What shifts the instant by half an exposure, an error of the poses of half the
    exposure times the jump, exceeds the offset. In the first and the last frame nothing shows a jump: where the motion
    has jumps, these may have the largest. Source: ours.
    """
    out = np.zeros((len(ref.t), 6))
    pose, t_s, steps = Pose(ref.R, ref.t), np.cumsum(dt), np.r_[jumped, False]
    jumps = np.flatnonzero(jumped[1:] & (exposure_s > 0)) + 1
    if len(jumps):
        out[[0, -1]] = np.abs(ref.m[jumps, :6] - ref.m[jumps - 1, :6]).max(axis=0) * exposure_s / 8
    for k in jumps.tolist():
        for first, last in {(k - 1, k), (k - 1 - int(steps[k - 1]), k + int(steps[k + 1]))}:
            jump = ref.m[last, :6] - ref.m[first, :6]
            # The jump times the interval from the first frame to the corner.
            late = ref.m[last, :6] * (t_s[last] - t_s[first]) - pose[last].minus(pose[first])
            for frame in range(first, last + 1):
                inside = np.abs(late - jump * (t_s[frame] - t_s[first])) < np.abs(jump) * exposure_s
                out[frame] = np.maximum(np.where(inside, np.abs(jump) * exposure_s / 8, 0.0), out[frame])
    return out


def with_errors_along_axes(b: Array, information: Array, vector: Array) -> tuple[Array, Array, float]:
    """Information (s, s) and vector (s,) of spots with a further common error of one sigma b_i in each pose component.

    The errors are independent: two components that turn within one frame do so at different moments. Also by how much
    chi-square falls. Source: the Sherman-Morrison formula.
    """
    total = 0.0
    for i in np.flatnonzero(b):
        Lb = information[:, i] * b[i]
        along, share = float(b[i] * vector[i]), float(1 / (1 + b[i] * Lb[i]))
        information, vector = information - np.outer(Lb, Lb) * share, vector - Lb * along * share
        total += along**2 * share
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
            variance = process_noise(float(max(step[k], 1e-9)), 0.0, float(size[k, i]), 0.0, *ANY_MOMENT)[0]
            out[k, 3 * i : 3 * i + 3] = np.sqrt(variance)
    return out
