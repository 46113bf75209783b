"""The pose of each frame of a run by itself, and its misfit to the smoothed one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compiled_projection import Views, project_all
from geometry.pose_solver.gauss_newton import SolveLimits, covariance_of
from tracking.rigid_body.models.information import frame_information, single_frame_pose
from tracking.smoothing.motion.reference import Reference
from tracking.smoothing.motion.run_detections import RunDetections, labelled_points


@dataclass(frozen=True, slots=True)
class SingleFramePoses:
    """T frames; nan where not measured."""

    R: Array  # (T, 3, 3)
    t: Array  # (T, 3), m
    covariance: Array  # (T, 6, 6)
    measured: Bools  # (T,) the frame's spots determine its pose
    excess: Array  # (T,) chi-square of the frame's spots at the smoothed pose less that at their own pose

    @staticmethod
    def unknown(frames: int) -> SingleFramePoses:
        """No frame measured."""
        nan = np.nan
        return SingleFramePoses(
            np.full((frames, 3, 3), nan), np.full((frames, 3), nan), np.full((frames, 6, 6), nan),
            np.zeros(frames, dtype=bool), np.zeros(frames),
        )  # fmt: skip


def single_frame_poses(
    views: Views,
    detections: RunDetections,
    assigned: Ints,
    calibration_cov: Array,
    ref: Reference,
    limits: SolveLimits,
    beside: Array,
) -> SingleFramePoses:
    """Each frame's own pose from its labels (T, n), starting at the reference motion.

    beside (T, 6): a further error, one sigma, of the poses (motion.velocity_jumps.corner_offsets).
    """
    frames = len(assigned)
    out = SingleFramePoses.unknown(frames)
    for k in range(frames):
        use, uv, cov = labelled_points(detections, k, assigned[k], calibration_cov)
        if np.count_nonzero(use) < 3:
            continue
        R, t, L, chi2, count = single_frame_pose(views, ref.R[k], ref.t[k], use, uv, cov)
        covariance, full_rank = covariance_of(L)
        if not full_rank or count < 3:
            continue
        worst = [np.sqrt(np.linalg.eigvalsh(covariance[i, i])[-1]) for i in (slice(0, 3), slice(3, 6))]
        out.measured[k] = worst[0] <= limits.max_sigma_m and worst[1] <= limits.max_sigma_rad
        if out.measured[k]:
            out.R[k], out.t[k], out.covariance[k] = R, t, covariance
            at_ref, along, chi2_ref = frame_information(views, ref.R[k], ref.t[k], use, uv, cov)[:3]
            b = beside[k]
            out.covariance[k] += np.outer(b, b)
            out.excess[k] = chi2_ref - chi2 - float(b @ along) ** 2 / (1 + b @ at_ref @ b)
    return out


def rms_residuals(views: Views, detections: RunDetections, assigned: Ints, ref: Reference) -> Array:
    """Root mean square residual (T,) per axis, px, of the spots labelled in each frame at the poses of a motion."""
    out = np.full(len(ref.t), np.nan)
    none = np.zeros((assigned.shape[1], 2, 2))
    expected, _ = project_all(views, ref.R, ref.t)
    for k in range(len(out)):
        use, uv, _ = labelled_points(detections, k, assigned[k], none)
        if use.any() and np.isfinite(expected[k][use]).any():
            out[k] = np.sqrt(np.nanmean((uv - expected[k])[use] ** 2))
    return out
