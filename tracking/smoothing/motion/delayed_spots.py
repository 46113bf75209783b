"""Spots that were not exposed at the instants of their frames: their information about the motion, and where they
would have been at those instants; compiled.

A spot exposed s seconds after its frame's instant measures the pose at that time, which follows from the frame's state
by the motion model: its Jacobian by the state (18 numbers) is that of the pose times the transition over s. What the
motion model does not know of that time (the jerk, and a velocity jump in the step) is added to the spot's covariance.
Source: ours; the transition as in tracking/rigid_body/models/motion.py.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Ints
from geometry.compilation.jit import compiled
from geometry.compiled_projection import Views, project_view
from tracking.rigid_body.association.frame_detections import BLENDED
from tracking.rigid_body.models.information import inverse_2x2
from tracking.rigid_body.models.motion import STATE, state_after
from tracking.rigid_body.models.picture_shifts import add_spot, timed_spot
from tracking.smoothing.motion.reference import Reference
from tracking.smoothing.motion.run_detections import RunDetections, labelled_points


class Delays(NamedTuple):
    """When the m detections of T frames were exposed."""

    after_s: Array  # (m,) s after the frame's instant
    row_time_s: Array  # (m,) s per row of its picture
    clocks: Array  # (T, cameras, 3) of the pictures, as PictureClock.numbers


class Steps(NamedTuple):
    """What the motion model leaves open in the step before each of F frames."""

    dt: Array  # (F,) s
    jerk: Array  # (F, 6) spectral densities of the white jerk
    velocity_jump: Array  # (F, 2) variances of the velocities' jump


@compiled
def _open_variance(steps: Steps, k: int, axis: int, after: float) -> float:
    """Variance of an axis of the pose `after` seconds from frame k beyond the extrapolated state; m^2 or rad^2."""
    s = abs(after)
    out = steps.jerk[k, axis] * s**5 / 20
    step = k + 1 if after > 0.0 else k
    if 0 < step < steps.dt.shape[0] and steps.dt[step] > 0.0:
        out += steps.velocity_jump[step, axis // 3] / steps.dt[step] * s**3 / 3
    return out


@compiled
def _covariance(
    cov: Array, J: Array, m: Array, row_time: float, steps: Steps, k: int, after: float
) -> tuple[float, float, float]:
    """Covariance (uu, uv, vv), px^2, of a detection less the pixel expected from frame k's state at its own instant.

    cov (2, 2): of the detection; J (2, 6), m (12,): of its spot; after: s from the frame to that instant. An error of
    the row changes that instant, and so the expectation; and the motion between the two is not known exactly.
    """
    speed = _speed(J, m)
    a, b = -speed[0] * row_time, 1.0 - speed[1] * row_time
    uu = cov[0, 0] + 2 * a * cov[0, 1] + a * a * cov[1, 1]
    both, vv = b * (cov[0, 1] + a * cov[1, 1]), b * b * cov[1, 1]
    for i in range(6):
        more = _open_variance(steps, k, i, after)
        uu, both, vv = uu + more * J[0, i] ** 2, both + more * J[0, i] * J[1, i], vv + more * J[1, i] ** 2
    return uu, both, vv


@compiled
def _speed(J: Array, m: Array) -> Array:
    """Speed (2,), px/s, of a spot with the Jacobian J (2, 6) for a motion m (12,)."""
    out = np.zeros(2)
    for a in range(2):
        for j in range(6):
            out[a] += J[a, j] * m[j]
    return out


@compiled
def delayed_information(
    views: Views,
    detections: RunDetections,
    delays: Delays,
    assigned: Ints,
    calibration_cov: Array,
    ref: Reference,
    steps: Steps,
    start: int,
) -> tuple[Array, Array, Array]:
    """Normal matrices (F, 18, 18), vectors (F, 18) and chi-squares (F,) of the labelled spots at a reference motion.

    assigned (T, n); ref, steps: F frames from frame `start` on.
    """
    frames, n = ref.t.shape[0], assigned.shape[1]
    L, g, chi2 = np.zeros((frames, STATE, STATE)), np.zeros((frames, STATE)), np.zeros(frames)
    at, J, H, no_cov = np.empty(2), np.empty((2, 6)), np.empty((2, STATE)), np.zeros((n, 2, 2))
    for k in range(frames):
        use, uv, noise = labelled_points(detections, start + k, assigned[start + k], no_cov)
        for i in range(n):
            if not use[i]:
                continue
            d = detections.begin[start + k] + assigned[start + k, i]
            after = delays.after_s[d]
            projected, m = timed_spot(views, i, ref.R[k], ref.t[k], ref.m[k], after, at, J, H)
            if not projected:
                continue
            uu, both, vv = _covariance(noise[i], J, m, delays.row_time_s[d], steps, k, after)
            uu, both, vv = uu + calibration_cov[i, 0, 0], both + calibration_cov[i, 0, 1], vv + calibration_cov[i, 1, 1]
            w0, w1, w2, _ = inverse_2x2(uu, both, vv)
            chi2[k] += add_spot(L[k], g[k], H, w0, w1, w2, uv[i, 0] - at[0], uv[i, 1] - at[1])
    return L, g, chi2


@compiled
def moved_detections(
    views: Views,
    camera: Ints,
    detections: RunDetections,
    delays: Delays,
    assigned: Ints,
    ref: Reference,
    velocity_P: Array,
    steps: Steps,
) -> tuple[Array, Array]:
    """The detections where they would have been at the instants of their frames: (m, 2), px, and covariances (m, 2, 2).

    Each moves as its spot does in a reference motion of T frames, one without a label (T, n) as the spot nearest to it.
    camera (n,): of each view; velocity_P (T, 6, 6): covariances of the velocities; steps: T frames.
    """
    uv, cov = detections.uv.copy(), detections.cov.copy()
    here, there, J = np.empty(2), np.empty(2), np.empty((2, 6))
    cameras, n = detections.has_image.shape[1], assigned.shape[1]
    for k in range(ref.t.shape[0]):
        for c in range(cameras):
            if delays.clocks[k, c, 0] == 0.0 and delays.clocks[k, c, 1] == 0.0:
                continue
            for row in range(detections.first[k, c], detections.first[k, c + 1]):
                d = detections.begin[k] + row
                R, t, m = state_after(ref.R[k], ref.t[k], ref.m[k], delays.after_s[d])
                view, nearest = -1, np.inf
                for i in range(n):
                    if camera[i] != c or not project_view(views, i, R, t, there, J):
                        continue
                    gap = (there[0] - uv[d, 0]) ** 2 + (there[1] - uv[d, 1]) ** 2
                    if assigned[k, i] >= 0 and assigned[k, i] % BLENDED == row:
                        gap = -1.0
                    if gap < nearest:
                        view, nearest = i, gap
                if view < 0 or not project_view(views, view, ref.R[k], ref.t[k], here, J):
                    continue
                project_view(views, view, R, t, there, J)
                uu, both, vv = _covariance(detections.cov[d], J, m, delays.row_time_s[d], steps, k, delays.after_s[d])
                cov[d, 0, 0], cov[d, 0, 1], cov[d, 1, 0], cov[d, 1, 1] = uu, both, both, vv
                for a in range(2):
                    uv[d, a] += here[a] - there[a]
                    for b in range(2):
                        for i in range(6):
                            for j in range(6):
                                cov[d, a, b] += delays.after_s[d] ** 2 * J[a, i] * velocity_P[k, i, j] * J[b, j]
    return uv, cov
