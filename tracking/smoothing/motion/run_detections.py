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
    well_controlled,
)
from tracking.rigid_body.models.motion import state_after


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
# would have been at those instants; compiled. Source: ours; the transition as in tracking/rigid_body/models/motion.py.


class Delays(NamedTuple):
    """When the m detections of T frames were exposed."""

    after_s: Array  # (m,) s after the frame's instant
    row_time_s: Array  # (m,) s per row of its picture
    sigma_s: Array  # (m,) of `after_s`, as PictureClock.stamp_sigma_s
    clocks: Array  # (T, cameras, 3) of the pictures, as PictureClock.numbers


@compiled
def _covariance(cov: Array, speed: Array, row_time: float, sigma: float) -> tuple[float, float, float]:
    """Covariance (uu, uv, vv), px^2, of a detection less the pixel expected at its own instant.

    cov (2, 2): of the detection; speed (2,), px/s, of its spot: an error of the row changes that instant, and so the
    expectation. sigma: of that instant, s.
    """
    a, b, c = -speed[0] * row_time, 1.0 - speed[1] * row_time, sigma * sigma
    uu = cov[0, 0] + 2 * a * cov[0, 1] + a * a * cov[1, 1] + c * speed[0] * speed[0]
    both = b * (cov[0, 1] + a * cov[1, 1]) + c * speed[0] * speed[1]
    return uu, both, b * b * cov[1, 1] + c * speed[1] * speed[1]


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
    delays: Delays,
    d: int,
    ref: Reference,
    k: int,
    at: Array,
    J: Array,
) -> tuple[bool, Array, float, float, float]:
    """Whether view i is projected at the instant of point d, its speed (2,), px/s, and the weight of the point.

    noise, calibration_cov (2, 2), px^2: of the point, and of the view. That instant is near instant k of ref.
    at (2,), J (2, 6) receive the pixel, without the views' shift, and its Jacobian. The weight is the upper triangle of
    the inverse of the covariance, 1/px^2.
    """
    R, t, m = state_after(ref.R[k], ref.t[k], ref.m[k], delays.after_s[d])
    if not project_view(views, i, R, t, at, J):
        return False, np.zeros(2), 0.0, 0.0, 0.0
    for a in range(2):
        at[a] -= views[i]["shift"][a]
    speed = _speed(J, m)
    uu, both, vv = _covariance(noise, speed, delays.row_time_s[d], delays.sigma_s[d])
    uu, both, vv = uu + calibration_cov[0, 0], both + calibration_cov[0, 1], vv + calibration_cov[1, 1]
    w0, w1, w2, _ = inverse_2x2(uu, both, vv)
    return True, speed, w0, w1, w2


OUTLIER_SIGMAS = 6.0  # of a residual, above which a spot pulls no more (Huber 1964): one with a wrong label


@compiled
def _pull(w0: float, w1: float, w2: float, u: float, v: float) -> tuple[float, float]:
    """How many sigmas a residual u, v, px, of this weight is, and the share of the weight that it has."""
    far = np.sqrt(w0 * u * u + 2 * w1 * u * v + w2 * v * v)
    return far, min(1.0, OUTLIER_SIGMAS / max(far, 1e-300))


@compiled
def delayed_information(
    views: Views,
    detections: RunDetections,
    delays: Delays,
    assigned: Ints,
    calibration_cov: Array,
    ref: Reference,
    start: int,
) -> tuple[Array, Array, Array]:
    """`spot_information` of spots that were exposed so soon before or after F instants that the velocities are known.

    assigned (T, n); ref: F instants from instant `start` on.
    """
    frames, n = ref.t.shape[0], assigned.shape[1]
    L, g, chi2 = np.zeros((frames, 6, 6)), np.zeros((frames, 6)), np.zeros(frames)
    at, J, no_cov = np.empty(2), np.empty((2, 6)), np.empty((n, 2, 2))
    no_cov[:] = 0.0
    for k in range(frames):
        use, uv, noise = labelled_points(detections, start + k, assigned[start + k], no_cov)
        for i in range(n):
            if not use[i]:
                continue
            d = detections.begin[start + k] + assigned[start + k, i]
            projected, _, w0, w1, w2 = _weighted_spot(views, i, noise[i], calibration_cov[i], delays, d, ref, k, at, J)
            if projected:
                u, v = uv[i, 0] - at[0], uv[i, 1] - at[1]
                far, share = _pull(w0, w1, w2, u, v)
                add_spot(L[k], g[k], J, share * w0, share * w1, share * w2, u, v)
                chi2[k] += share * far**2 * (2.0 - share)
    return L, g, chi2


@compiled
def timed_rows(
    views: Views,
    detections: RunDetections,
    delays: Delays,
    assigned: Ints,
    calibration_cov: Array,
    ref: Reference,
    start: int,
) -> tuple[Array, Array, Array, Array, Array]:
    """What `delayed_information` sums up, spot by spot; 0 for views without a label.

    Returns residuals (F, n, 2), px; their weights (F, n, 2, 2); Jacobians (F, n, 2, 6) by the poses; the speeds
    (F, n, 2), px/s, of the spots; and their rows (F, n), px.
    """
    frames, n = ref.t.shape[0], assigned.shape[1]
    e, W, H = np.zeros((frames, n, 2)), np.zeros((frames, n, 2, 2)), np.zeros((frames, n, 2, 6))
    speed, row = np.zeros((frames, n, 2)), np.zeros((frames, n))
    at, J, no_cov = np.empty(2), np.empty((2, 6)), np.zeros((n, 2, 2))
    for k in range(frames):
        use, uv, noise = labelled_points(detections, start + k, assigned[start + k], no_cov)
        for i in range(n):
            if not use[i]:
                continue
            d = detections.begin[start + k] + assigned[start + k, i]
            projected, moving, w0, w1, w2 = _weighted_spot(
                views, i, noise[i], calibration_cov[i], delays, d, ref, k, at, J
            )
            if not projected:
                continue
            row[k, i] = uv[i, 1]
            for a in range(2):
                e[k, i, a], speed[k, i, a] = uv[i, a] - at[a], moving[a]
                for j in range(6):
                    H[k, i, a, j] = J[a, j]
            _, share = _pull(w0, w1, w2, e[k, i, 0], e[k, i, 1])
            W[k, i, 0, 0], W[k, i, 0, 1], W[k, i, 1, 0], W[k, i, 1, 1] = share * w0, share * w1, share * w1, share * w2
    return e, W, H, speed, row


class Between(NamedTuple):
    """The motion at F instants, those of T frames and between them."""

    t_s: Array  # (F,)
    of_frame: Ints  # (T,) which of them are those of the frames
    ref: Reference  # F instants
    motion_P: Array  # (F, 6, 6) of the velocities
    jerk: Array  # (F, 6) spectral densities of the white jerk
    jump: Array  # (F, 2) variances of the velocities' jump in the step before, and when it is ...
    moment: Array  # (F, 2) ... as in RunInformation


@compiled_in_caller
def _open_variance(between: Between, own: int, other: int, after: float, axis: int) -> float:
    """Variance of an axis of the pose `after` seconds from instant `own`, near instant `other`, relative to that pose.

    By what the steps between them leave open: the jerk, and when the velocities jump.
    """
    s = abs(after)
    out = between.jerk[own, axis] * s**5 / 20
    for step in range(min(own, other) + 1, max(own, other) + 1):
        later, spread = between.moment[step]
        if later < 0.0:
            spread = between.t_s[step] - between.t_s[step - 1]
        out += between.jump[step, axis // 3] * spread**2
    return out


@compiled
def moved_detections(
    views: Views, camera: Ints, detections: RunDetections, delays: Delays, assigned: Ints, between: Between
) -> tuple[Array, Array]:
    """The detections where they would have been at the instants of their frames: (m, 2), px, and covariances (m, 2, 2).

    Each moves as its spot does in a motion, one without a label (T, n) as the spot nearest to it. camera (n,): of each
    view.
    """
    uv, cov = detections.uv.copy(), detections.cov.copy()
    here, there, J = np.empty(2), np.empty(2), np.empty((2, 6))
    cameras, n = detections.has_image.shape[1], assigned.shape[1]
    t_s, ref = between.t_s, between.ref
    for k in range(len(between.of_frame)):
        own = between.of_frame[k]
        for c in range(cameras):
            at_frame = delays.clocks[k, c, 0] == 0.0 and delays.clocks[k, c, 1] == 0.0
            for row in range(detections.first[k, c], detections.first[k, c + 1]):
                d = detections.begin[k] + row
                if at_frame and delays.sigma_s[d] == 0.0:
                    break
                after, near = delays.after_s[d], own
                at_s = t_s[own] + after
                step = 1 if after > 0.0 else -1
                while 0 <= near + step < len(t_s) and abs(t_s[near + step] - at_s) < abs(t_s[near] - at_s):
                    near += step
                R, t, m = state_after(ref.R[near], ref.t[near], ref.m[near], at_s - t_s[near])
                view, nearest = -1, np.inf
                for i in range(n):
                    if camera[i] != c or not project_view(views, i, R, t, there, J):
                        continue
                    gap = (there[0] - uv[d, 0]) ** 2 + (there[1] - uv[d, 1]) ** 2
                    if assigned[k, i] >= 0 and assigned[k, i] % BLENDED == row:
                        gap = -1.0
                    if gap < nearest:
                        view, nearest = i, gap
                if view < 0 or not project_view(views, view, ref.R[own], ref.t[own], here, J):
                    continue
                project_view(views, view, R, t, there, J)
                uu, both, vv = _covariance(detections.cov[d], _speed(J, m), delays.row_time_s[d], delays.sigma_s[d])
                cov[d, 0, 0], cov[d, 0, 1], cov[d, 1, 0], cov[d, 1, 1] = uu, both, both, vv
                for a in range(2):
                    uv[d, a] += here[a] - there[a]
                    for b in range(2):
                        for i in range(6):
                            cov[d, a, b] += _open_variance(between, own, near, after, i) * J[a, i] * J[b, i]
                            for j in range(6):
                                P = 0.5 * (between.motion_P[own, i, j] + between.motion_P[near, i, j])
                                cov[d, a, b] += after**2 * J[a, i] * P * J[b, j]
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
    unsettled: bool  # no number is solved for
    far_s: float  # sigma of the present offsets, with which turns have been found
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

    def with_excess(self, factor: float, prior_sigma_s: Array) -> Array:
        """`noise` with so many times the spots' part of it, at least once: numbers that keep their priors have none."""
        own = np.sqrt(np.diagonal(self.noise)) < prior_sigma_s
        return np.asarray(self.noise * np.where(np.outer(own, own), max(factor, 1.0), 1.0))


class Turn(NamedTuple):
    """A change of the velocities (turns.py)."""

    middle_s: float
    likely_s: float  # the most likely length
    length_s: float  # that the spots allow
    size: Array  # (2,) its variances, (m/s)^2 and (rad/s)^2
    settled: bool = False  # a search has not changed it

    @property
    def begin_s(self) -> float:
        """When it begins."""
        return self.middle_s - 0.5 * self.length_s

    @property
    def end_s(self) -> float:
        """When it ends."""
        return self.middle_s + 0.5 * self.length_s


@dataclass(frozen=True, slots=True)
class SmoothedMotion:
    """The estimate, T frames."""

    ref: Reference
    log_density: Array | None  # (T, 6) logarithms of the jerk's spectral densities; None: not estimated yet
    interpolation_offset: float  # to be added to them for the interpolation between frames
    jumped: Bools  # (T,) the velocities jumped in the step before
    pose_P: Array  # (T, 6, 6)
    motion_P: Array  # (T, 6, 6) of the velocities
    known: Bools  # (T,) the pose is not lost
    weight: Array  # (T,) of the information of each frame's spots in the motion; 0: not used
    clocks: ClockSolution | None = None
    turns: tuple[Turn, ...] = ()  # of a run whose cameras have clocks of their own, ...
    between: Between | None = None  # ... and its motion at the instants of its spots

    @staticmethod
    def begin(ref: Reference, jumped: Bools, log_density: Array | None) -> SmoothedMotion:
        """The motion before the first estimate."""
        frames = len(ref.t)
        zero = np.zeros((frames, 6, 6))
        known = np.zeros(frames, dtype=bool)
        return SmoothedMotion(ref, log_density, 0.0, jumped, zero, zero, known, np.zeros(frames))

    def without_covariances(self) -> SmoothedMotion:
        """What the next estimate starts from: less memory."""
        zero = np.zeros_like(self.pose_P)
        return replace(self, pose_P=zero, motion_P=zero)
