"""A run as the estimation of its motion sees it: reference motion, detections and their information, the estimate.

What is used frame by frame is compiled.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled, compiled_in_caller
from geometry.compiled_linalg import copy_into, copy_matrix_into, pose_plus
from geometry.compiled_projection import Views, project_view
from geometry.pose import Pose
from geometry.uncertainty.rig_uncertainty import RigUncertainty
from tracking.rigid_body.association.frame_detections import BLENDED, chosen_points
from tracking.rigid_body.models.information import (
    add_spot,
    frame_information,
    inverse_2x2,
    single_frame_pose,
    timed_spot,
    well_controlled,
)
from tracking.rigid_body.models.motion import STATE, state_after


class Reference(NamedTuple):
    """Motion of T frames, as in tracking/rigid_body/models/motion.py."""

    R: Array  # (T, 3, 3)
    t: Array  # (T, 3), m
    m: Array  # (T, 12)


def unknown_moments(frames: int) -> Array:
    """(T, 2): moments of jumps, as in RunInformation, of which none is known."""
    return np.tile([-1.0, 0.0], (frames, 1))


def speeds(m: Array) -> Array:
    """Speeds (..., 2), m/s and rad/s, of motions (..., 12)."""
    return np.stack([np.linalg.norm(m[..., :3], axis=-1), np.linalg.norm(m[..., 3:6], axis=-1)], axis=-1)


def first_variance(ref: Reference, dt: Array, measured: bool) -> Array:
    """Variances (18,) of the first frame's deviation: wide compared with the run's motion."""
    speed = np.abs(ref.m[:, :6]).reshape(-1, 2, 3).max(axis=(0, 2), initial=0.0)
    change = np.abs(np.diff(ref.m[:, :6], axis=0)) / np.maximum(dt[1:, None], 1e-9)
    acceleration = change.reshape(-1, 2, 3).max(axis=(0, 2), initial=0.0)
    pose = [0.1, 0.1] if measured else [1.0, 1.0]
    return np.asarray(np.repeat([*pose, *(2 * speed + 0.1), *(2 * acceleration + 1.0)], 3) ** 2)


@compiled
def shifted(ref: Reference, x: Array) -> Reference:
    """The reference moved by deviations (T, 18)."""
    R, t, m = ref.R.copy(), ref.t.copy(), ref.m.copy()
    for k in range(ref.t.shape[0]):
        R_k, t_k = pose_plus(ref.R[k], ref.t[k], x[k])
        copy_matrix_into(R[k], R_k)
        copy_into(t[k], t_k)
        for i in range(12):
            m[k, i] += x[k, 6 + i]
    return Reference(R, t, m)


def straight_between(poses: Array, measured: Bools, t_s: Array) -> Reference:
    """First reference: the measured poses, straight interpolation between them, and velocities by differences.

    poses (T, 4, 3): rotation and, below it, translation; measured (T,); t_s (T,): times.
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


class RunDetections(NamedTuple):
    """m detections of T frames and n views; those of frame k are the rows begin[k] to begin[k + 1], sorted by camera.

    `blend_px`, `size_px` and `usual_size_px` are as in FrameDetections.
    """

    uv: Array  # (m, 2) px
    cov: Array  # (m, 2, 2) px^2
    blend_px: Array  # (m,)
    begin: Ints  # (T + 1,)
    first: Ints  # (T, cameras + 1) where the rows of each camera begin within the frame
    has_image: Bools  # (T, cameras)
    size_px: Array  # (m,)
    usual_size_px: Array  # (n,)


@compiled
def labelled_points(
    detections: RunDetections, k: int, assigned: Ints, calibration_cov: Array
) -> tuple[Bools, Array, Array]:
    """Frame k's labelled detections: views used in the pose (n,), pixels (n, 2) and covariances (n, 2, 2)."""
    return chosen_points(detections.uv, detections.cov, detections.begin[k], assigned, calibration_cov)


@compiled
def spot_information(
    views: Views, detections: RunDetections, assigned: Ints, calibration_cov: Array, ref: Reference, start: int
) -> tuple[Array, Array, Array]:
    """Normal matrices (F, 6, 6), vectors (F, 6) and chi-squares (F,) of the labelled spots at a reference motion.

    assigned (T, n); ref: F frames from frame `start` on.
    """
    frames = ref.t.shape[0]
    L, g, chi2 = np.empty((frames, 6, 6)), np.empty((frames, 6)), np.empty(frames)
    for k in range(frames):
        use, uv, cov = labelled_points(detections, start + k, assigned[start + k], calibration_cov)
        L_k, g_k, chi2[k], _, _ = frame_information(views, ref.R[k], ref.t[k], use, uv, cov)
        copy_matrix_into(L[k], L_k)
        copy_into(g[k], g_k)
    return L, g, chi2


class FrameFits(NamedTuple):
    """The pose of each of T frames by itself, from a reference motion on."""

    R: Array  # (T, 3, 3)
    t: Array  # (T, 3), m
    information: Array  # (T, 6, 6) normal matrices there
    chi2: Array  # (T,)
    spots: Ints  # (T,) used; 0 where fewer than three are labelled, and the other fields are not filled
    at_ref: Array  # (T, 6, 6) normal matrices at the reference,
    along: Array  # (T, 6) J^T C^-1 (measured - expected) there,
    chi2_ref: Array  # (T,) and chi-squares


@compiled
def fit_frames(
    views: Views, detections: RunDetections, assigned: Ints, calibration_cov: Array, ref: Reference
) -> FrameFits:
    """Fit the pose of each frame to its labelled spots (T, n), starting at the reference motion."""
    frames = assigned.shape[0]
    R, t, L, chi2 = np.empty((frames, 3, 3)), np.empty((frames, 3)), np.empty((frames, 6, 6)), np.empty(frames)
    spots = np.zeros(frames, np.int64)
    at_ref, along, chi2_ref = np.empty((frames, 6, 6)), np.empty((frames, 6)), np.empty(frames)
    for k in range(frames):
        use, uv, cov = labelled_points(detections, k, assigned[k], calibration_cov)
        labelled = 0
        for i in range(use.shape[0]):
            labelled += 1 if use[i] else 0
        if labelled < 3:
            continue
        R_k, t_k, L_k, chi2[k], spots[k] = single_frame_pose(views, ref.R[k], ref.t[k], use, uv, cov)
        at_ref_k, along_k, chi2_ref[k], _, _ = frame_information(views, ref.R[k], ref.t[k], use, uv, cov)
        copy_matrix_into(R[k], R_k)
        copy_into(t[k], t_k)
        copy_matrix_into(L[k], L_k)
        copy_matrix_into(at_ref[k], at_ref_k)
        copy_into(along[k], along_k)
    return FrameFits(R, t, L, chi2, spots, at_ref, along, chi2_ref)


@compiled
def controlled_labels(
    views: Views, detections: RunDetections, assigned: Ints, calibration_cov: Array, ref: Reference
) -> tuple[Bools, Bools]:
    """Labels (T, n) that are used in the poses, and those of them that the other labels of their frame control."""
    labelled, controlled = np.zeros(assigned.shape, np.bool_), np.zeros(assigned.shape, np.bool_)
    for k in range(assigned.shape[0]):
        use, _, cov = labelled_points(detections, k, assigned[k], calibration_cov)
        by_others = well_controlled(views, ref.R[k], ref.t[k], use, cov)
        for i in range(use.shape[0]):
            labelled[k, i], controlled[k, i] = use[i], by_others[i]
    return labelled, controlled


# Spots that were not exposed at the instants of their frames: their information about the motion, and where they
# would have been at those instants; compiled.
#
# A spot exposed s seconds after its frame's instant measures the pose at that time, which follows from the frame's
# state by the motion model: its Jacobian by the state (18 numbers) is that of the pose times the transition over s.
# What the motion model does not know of that time (the jerk, and a velocity jump in the step) is added to the spot's
# covariance. Source: ours; the transition as in tracking/rigid_body/models/motion.py.


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
    corner_s: Array  # (F, 2) when they jump, s after the step's begin; nan: not known
    moment: Array  # (F, 2) of RunInformation


CORNER_SIGMAS = 2.0  # of a known moment of a jump: as near to it, a spot may be on either side
CORNER_SHARE = 0.05  # of a step: how much nearer to a frame than the corner a spot must be to belong to the same line


@compiled_in_caller
def _open_variance(steps: Steps, k: int, axis: int, after: float) -> float:
    """Variance of an axis of the pose `after` seconds from frame k beyond the extrapolated state; m^2 or rad^2."""
    s = abs(after)
    out = steps.jerk[k, axis] * s**5 / 20
    step = k + 1 if after > 0.0 else k
    if 0 < step < steps.dt.shape[0] and steps.dt[step] > 0.0:
        corner, dt = steps.corner_s[step, axis // 3], steps.dt[step]
        later, spread = steps.moment[step]
        if later >= 0.0:
            beyond = s - (dt - later if after > 0.0 else later)
            if beyond > -CORNER_SIGMAS * spread:
                beyond = max(beyond, 0.0)
                out += steps.velocity_jump[step, axis // 3] * (beyond * beyond + spread * spread)
            return out
        beyond = s - (corner if after > 0.0 else dt - corner)
        if not beyond < -CORNER_SHARE * dt:
            out += steps.velocity_jump[step, axis // 3] / dt * s**3 / 3
    return out


@compiled_in_caller
def _on_its_side(steps: Steps, k: int, after: float) -> tuple[int, float]:
    """The frame whose state a spot `after` seconds from frame k follows from, and its time after that one, s.

    Frame k, or the next one on the other side of a jump whose moment is known.
    """
    if after > 0.0 and k + 1 < steps.dt.shape[0]:
        later = steps.moment[k + 1, 0]
        if later >= 0.0 and after > steps.dt[k + 1] - later:
            return k + 1, after - steps.dt[k + 1]
    elif after < 0.0 and k > 0:
        later = steps.moment[k, 0]
        if later >= 0.0 and -after > later:
            return k - 1, after + steps.dt[k]
    return k, after


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
def _weighted_spot(
    views: Views,
    i: int,
    noise: Array,
    calibration_cov: Array,
    after: float,
    row_time: float,
    ref: Reference,
    steps: Steps,
    k: int,
    at: Array,
    J: Array,
    H: Array,
) -> tuple[bool, Array, float, float, float]:
    """Whether view i is projected `after` seconds from frame k, its motion as of `timed_spot`, and a point's weight.

    noise, calibration_cov (2, 2), px^2: of the point, and of the view; row_time: of its picture. k: frame of ref and
    steps. at, J, H receive what `timed_spot` writes. The weight is the upper triangle of the inverse of the covariance,
    1/px^2.
    """
    projected, m = timed_spot(views, i, ref.R[k], ref.t[k], ref.m[k], after, at, J, H)
    if not projected:
        return False, m, 0.0, 0.0, 0.0
    uu, both, vv = _covariance(noise, J, m, row_time, steps, k, after)
    uu, both, vv = uu + calibration_cov[0, 0], both + calibration_cov[0, 1], vv + calibration_cov[1, 1]
    w0, w1, w2, _ = inverse_2x2(uu, both, vv)
    return True, m, w0, w1, w2


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
) -> tuple[Array, Array, Array, Array]:
    """Normal matrices (F, 18, 18), vectors (F, 18) and chi-squares (F,) of the labelled spots at a reference motion.

    Also the sums (F,) of the log determinants of their covariances.

    assigned (T, n); ref, steps: F frames from frame `start` on.
    """
    frames, n = ref.t.shape[0], assigned.shape[1]
    L, g, chi2 = np.zeros((frames, STATE, STATE)), np.zeros((frames, STATE)), np.zeros(frames)
    log_det = np.zeros(frames)
    at, J, H, no_cov = np.empty(2), np.empty((2, 6)), np.empty((2, STATE)), np.zeros((n, 2, 2))
    for k in range(frames):
        use, uv, noise = labelled_points(detections, start + k, assigned[start + k], no_cov)
        for i in range(n):
            if not use[i]:
                continue
            d = detections.begin[start + k] + assigned[start + k, i]
            j, after = _on_its_side(steps, k, delays.after_s[d])
            projected, _, w0, w1, w2 = _weighted_spot(
                views, i, noise[i], calibration_cov[i], after, delays.row_time_s[d], ref, steps, j, at, J, H
            )
            if not projected:
                continue
            chi2[j] += add_spot(L[j], g[j], H, w0, w1, w2, uv[i, 0] - at[0], uv[i, 1] - at[1])
            log_det[j] -= np.log(w0 * w2 - w1 * w1)
    return L, g, chi2, log_det


@compiled
def timed_rows(
    views: Views,
    detections: RunDetections,
    delays: Delays,
    assigned: Ints,
    calibration_cov: Array,
    ref: Reference,
    steps: Steps,
    start: int,
) -> tuple[Array, Array, Array, Array, Array]:
    """What `delayed_information` sums up, spot by spot; 0 for views without a label.

    Returns residuals (F, n, 2), px; their weights (F, n, 2, 2); Jacobians (F, n, 2, 18) by the states; the speeds
    (F, n, 2), px/s, of the spots; and their rows (F, n), px.
    """
    frames, n = ref.t.shape[0], assigned.shape[1]
    e, W, H = np.zeros((frames, n, 2)), np.zeros((frames, n, 2, 2)), np.zeros((frames, n, 2, STATE))
    speed, row = np.zeros((frames, n, 2)), np.zeros((frames, n))
    at, J, one, no_cov = np.empty(2), np.empty((2, 6)), np.empty((2, STATE)), np.zeros((n, 2, 2))
    for k in range(frames):
        use, uv, noise = labelled_points(detections, start + k, assigned[start + k], no_cov)
        for i in range(n):
            if not use[i]:
                continue
            d = detections.begin[start + k] + assigned[start + k, i]
            projected, m, w0, w1, w2 = _weighted_spot(
                views,
                i,
                noise[i],
                calibration_cov[i],
                delays.after_s[d],
                delays.row_time_s[d],
                ref,
                steps,
                k,
                at,
                J,
                one,
            )
            if not projected:
                continue
            W[k, i, 0, 0], W[k, i, 0, 1], W[k, i, 1, 0], W[k, i, 1, 1] = w0, w1, w1, w2
            moving = _speed(J, m)
            row[k, i] = uv[i, 1]
            for a in range(2):
                e[k, i, a], speed[k, i, a] = uv[i, a] - at[a], moving[a]
                for j in range(STATE):
                    H[k, i, a, j] = one[a, j]
    return e, W, H, speed, row


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
                own, after = _on_its_side(steps, k, delays.after_s[d])
                R, t, m = state_after(ref.R[own], ref.t[own], ref.m[own], after)
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
                uu, both, vv = _covariance(detections.cov[d], J, m, delays.row_time_s[d], steps, own, after)
                cov[d, 0, 0], cov[d, 0, 1], cov[d, 1, 0], cov[d, 1, 1] = uu, both, both, vv
                for a in range(2):
                    uv[d, a] += here[a] - there[a]
                    for b in range(2):
                        for i in range(6):
                            for j in range(6):
                                cov[d, a, b] += delays.after_s[d] ** 2 * J[a, i] * velocity_P[own, i, j] * J[b, j]
    return uv, cov


@dataclass(frozen=True, slots=True)
class WholeRun:
    """What stays the same while the motion is estimated: T frames, n views."""

    views: Views
    detections: RunDetections
    calibration_cov: Array  # (n, 2, 2) px^2: covariance of the expected pixels due to calibration errors
    dt: Array  # (T,) s
    exposure_s: float
    adapt_jerk: bool  # estimate the strength of the jerk; else it is kept
    delays: Delays | None = None  # of the detections; None: all are of the instants of their frames
    clocks: UnknownClocks | None = None  # numbers of the cameras' clocks that are estimated with the motion


@dataclass(frozen=True, slots=True)
class UnknownClocks:
    """p numbers of the cameras' clocks, and what is known of their corrections before."""

    camera: Ints  # (p,)
    is_row_time: Bools  # (p,) else the offset
    mean_s: Array  # (p,)
    sigma_s: Array  # (p,)
    camera_of: Ints  # (n,) of the views
    middle_row: Array  # (n,) of the pictures
    calibration: RigUncertainty | None = None

    def columns(self, speed: Array, row: Array) -> Array:
        """Derivatives (F, n, 2, p) of the expected pixels by the numbers, from `timed_rows`."""
        later = row - self.middle_row
        own = self.camera_of[:, None] == self.camera
        factor = np.where(own, np.where(self.is_row_time, later[..., None], 1.0), 0.0)
        return np.asarray(speed[..., None] * factor[:, :, None, :])


@dataclass(frozen=True, slots=True)
class ClockSolution:
    """Corrections of p numbers of the clocks, jointly with the motion of T frames."""

    correction_s: Array  # (p,)
    noise: Array  # (p, p) covariance by the spots' noise and the prior ...
    systematic: Array  # (p, p) ... and by the calibration's errors
    motion: Array  # (T, 12, p) change of pose and velocities by the numbers


@dataclass(frozen=True, slots=True)
class SmoothedMotion:
    """The estimate, T frames."""

    ref: Reference
    log_density: Array | None  # (T, 6) logarithms of the jerk's spectral densities; None: not estimated yet
    interpolation_offset: float  # to be added to them for the interpolation between frames ...
    smoother: Bools  # (T,) ... about these
    jumped: Bools  # (T,) the velocities jumped in the step before
    jump_scale: Array  # (T, 2) of the variances of these jumps, as in `jump_variances` ...
    moment: Array  # (T, 2) ... and when they are, as in RunInformation
    excluded: Bools  # (T,) the velocities did not jump in the step before, although it was not observed
    pose_P: Array  # (T, 6, 6)
    motion_P: Array  # (T, 6, 6) of the velocities
    known: Bools  # (T,) the pose is not lost
    weight: Array  # (T,) of the information of each frame's spots in the motion; 0: not used
    clocks: ClockSolution | None = None

    @staticmethod
    def begin(ref: Reference, jumped: Bools, log_density: Array | None) -> SmoothedMotion:
        """The motion before the first estimate."""
        frames = len(ref.t)
        zero = np.zeros((frames, 6, 6))
        known = np.zeros(frames, dtype=bool)
        scale, moment = np.ones((frames, 2)), unknown_moments(frames)
        return SmoothedMotion(
            ref, log_density, 0.0, ~known, jumped, scale, moment, known.copy(), zero, zero, known, np.zeros(frames)
        )

    def without_covariances(self) -> SmoothedMotion:
        """What the next estimate starts from: less memory."""
        zero = np.zeros_like(self.pose_P)
        return replace(self, pose_P=zero, motion_P=zero)
