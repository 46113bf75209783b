"""Numbers of the cameras' clocks, estimated jointly with the motion of a run.

The Gauss-Newton step of the whole run (whole_run.py) is solved once more for each number: how the most probable motion
changes with it. With the motion eliminated (Schur complement) a small system for the numbers is left. Source: ours.
"""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.pose import Pose
from tracking.rigid_body.models.motion import STATE
from tracking.smoothing.motion.fixed_interval import RunInformation, smoothed
from tracking.smoothing.motion.instants import usual_step
from tracking.smoothing.motion.process_noise import largest_near
from tracking.smoothing.motion.run_detections import ClockSolution, Reference, UnknownClocks, WholeRun, timed_rows

DETERMINED = 0.3  # of the prior's sigma: a number whose sigma is larger keeps its prior
MAX_CLOCK_STEPS = 4  # after each estimate of the motion
_LONGEST_STEP = 0.5  # of a prior's sigma: a longer step is not linear
# Of its sigma: a shorter step of a clock is not taken; the second number from the third step on, which a linear problem
# does not take: turns that change with each step would move the clocks without end.
_NEGLIGIBLE_STEPS = 0.05, 0.5
# The third of these steps or a later one, and the last, of a number whose sigma is below DETERMINED: longer than so
# many of its sigmas, or than this share of its prior's. Then nothing is known of any: a linear problem takes one step.
_FIRST_SMALL, _UNSETTLED_SIGMAS, _UNSETTLED_SHARE = 2, (3.0, 1.0), 0.3
# Sigmas of offsets, as a sigma of the moments of turns: the same spots show these and then the offsets.
TURN_SIGMAS = 2.0
NARROWER = 0.7  # of that sigma: a new one that is less needs a further solution
_ROUNDING = 30.0  # times the error of the smallest eigenvalue: less is rounding
_CHUNK = 512  # frames whose rows are in memory at once


def _with_priors(joint: Array, right: Array, kept: Bools, clocks: UnknownClocks) -> tuple[Array, Array]:
    """Corrections (p,) and covariance (p, p) where some numbers keep their priors.

    joint (p, p), right (p,): inverse and right side of the normal equations of all numbers. kept (p,): those that the
    run hardly determines; noise of the spots' speeds would pass for motion. The others are what they are with these
    free: spots that show one of them alone then count for it (a row time that the rows hardly show is no error of the
    offset). What is left of the others' errors is correlated with the kept ones' as in the solution for all.
    """
    covariance = joint.copy()
    covariance[np.ix_(kept, kept)] = np.diag(clocks.sigma_s[kept] ** 2)
    return np.where(kept, clocks.mean_s, joint @ right), 0.5 * (covariance + covariance.T)


def _beyond_rounding(S: Array, right: Array, clocks: UnknownClocks) -> tuple[Array, Array]:
    """The equations S (p, p), right (p,), where what the run adds to the prior is rounding only the prior's.

    S is a small difference of large numbers where the motion is free to follow the spots. Without rounding no
    eigenvalue is below that of the prior: how far the smallest one is shows how large it is.
    """
    size = clocks.sigma_s
    values, vectors = np.linalg.eigh(size[:, None] * 0.5 * (S + S.T) * size)
    known = values > 1.0 + _ROUNDING * max(1.0 - float(values[0]), 0.0)
    along = vectors.T @ np.column_stack([size * right, clocks.mean_s / size])
    S = (vectors * np.where(known, values, 1.0)) @ vectors.T / size[:, None] / size
    return 0.5 * (S + S.T), vectors @ np.where(known, along[:, 0], along[:, 1]) / size


def solve_clocks(
    run: WholeRun, assigned: Ints, weight: Array, at: tuple[Reference, int], info: RunInformation, density: Array
) -> ClockSolution:
    """Corrections of the unknown numbers of a run's clocks.

    at: F instants of a converged motion, and the first of them; info, density (F, 6): of the last step;
    weight (F,): of the frames' spots. assigned (T, n).
    """
    ref, start = at
    clocks, delays = run.clocks, run.delays
    assert clocks is not None
    assert delays is not None
    p, frames = len(clocks.camera), len(ref.t)
    B, C, b = np.zeros((frames, 6, p)), np.zeros((p, p)), np.zeros(p)
    parts = [slice(first, min(first + _CHUNK, frames)) for first in range(0, frames, _CHUNK)]

    def rows(part: slice) -> tuple[Array, Array, Array, Array]:
        some = Reference(*(np.ascontiguousarray(a[part]) for a in ref))
        e, W, H, speed, row = timed_rows(
            run.views, run.detections, delays, assigned, run.calibration_cov, some, start + part.start
        )
        return e, W * weight[part, None, None, None], H, clocks.columns(speed, row)

    for part in parts:
        e, W, H, d = rows(part)
        Wd = W @ d
        B[part] = np.einsum("knai,knaj->kij", H, Wd)
        C += np.einsum("knai,knaj->ij", d, Wd)
        b += np.einsum("knai,kna->i", Wd, e)
    x = smoothed(ref, info, density, tested=False).x
    G = np.empty((frames, STATE, p))  # change of the states by the numbers, with the sign of B
    for i, size in enumerate(clocks.sigma_s):
        moved = info._replace(vector=np.ascontiguousarray(info.vector + B[..., i] * size))
        G[..., i] = (smoothed(ref, moved, density, tested=False).x - x) / size
    precision = np.diag(1 / clocks.sigma_s**2)
    S = C - np.einsum("kis,kit->st", B, G[:, :6]) + precision
    right = b - np.einsum("kis,ki->s", B, x[:, :6]) + precision @ clocks.mean_s
    S, right = _beyond_rounding(S, right, clocks)
    joint = np.asarray(np.linalg.inv(S), dtype=float)
    kept = clocks.unsettled | (np.sqrt(np.diagonal(joint)) >= DETERMINED * clocks.sigma_s)
    correction, noise = _with_priors(joint, right, kept, clocks)
    systematic = np.zeros((p, p))
    if clocks.calibration is not None:
        total = np.zeros((p, 0))
        for part in parts:
            _, W, H, d = rows(part)
            Q = W @ (d - np.einsum("knai,kij->knaj", H, G[part, :6]))
            root = clocks.calibration.root_at(Pose(ref.R[part], ref.t[part])).reshape(*Q.shape[:3], -1)
            one = np.einsum("knas,knar->sr", Q, root)
            total = one if not total.size else total + one
        systematic = noise @ total @ total.T @ noise
        systematic[kept], systematic[:, kept] = 0.0, 0.0
    return ClockSolution(correction, noise, systematic, -G[:, :12])


def clock_step(found: ClockSolution, prior_sigma_s: Array, step: int) -> Array | None:
    """The change (p,) of the clocks after so many steps, with an estimate of the motion each; None: they do not end."""
    sigma, away = np.sqrt(np.diagonal(found.noise)), np.abs(found.correction_s)
    most = _UNSETTLED_SIGMAS[int(step == MAX_CLOCK_STEPS)] * sigma
    long = away > np.minimum(most, _UNSETTLED_SHARE * prior_sigma_s)
    if step >= _FIRST_SMALL and np.any(long & (sigma < DETERMINED * prior_sigma_s)):
        return None
    if step == MAX_CLOCK_STEPS or np.all(away < _NEGLIGIBLE_STEPS[int(step >= _FIRST_SMALL)] * sigma):
        return np.zeros(len(sigma))
    longest = _LONGEST_STEP * prior_sigma_s
    return np.asarray(np.clip(found.correction_s, -longest, longest))


def clock_sigmas(motion: Reference, sigma_s: float, dt: Array) -> Array:
    """Sigmas (T, 6), m and rad, of poses by cameras' unknown offsets (sigma_s) beyond the first order.

    Of a motion that accelerates, the offset d moves the pose of a camera's picture by v d + a d^2 / 2. The mean of the
    second part's square is 3/4 a^2 sigma^4. a sigma is the largest change of the velocities that far from the frame.
    Source: ours.
    """
    step, v = usual_step(dt), motion.m[:, :6]
    far = max(int(np.ceil(sigma_s / step)), 1)
    change = np.maximum(largest_near(v, far) - v, v + largest_near(-v, far)) * min(sigma_s / (far * step), 1.0)
    return np.asarray(np.sqrt(0.75) * sigma_s * change)
