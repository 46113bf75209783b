"""The pose of each frame of a run by itself, and its misfit to the smoothed one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compiled_projection import Views, project_all
from geometry.pose_solver.gauss_newton import SolveLimits, covariances_of
from tracking.rigid_body.association.frame_detections import BLENDED
from tracking.smoothing.motion.run_detections import Reference, RunDetections, fit_frames

_BLOCK = 4096  # frames whose fits are in memory at once


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

    beside (T, 6): a further error of the poses, one sigma, independent for each of the six components
    (motion.process_noise.corner_offsets).
    """
    out = SingleFramePoses.unknown(len(assigned))
    for start in range(0, len(assigned), _BLOCK):
        block = slice(start, start + _BLOCK)
        some = detections._replace(begin=detections.begin[start:])
        near = Reference(ref.R[block], ref.t[block], ref.m[block])
        fits = fit_frames(views, some, assigned[block], calibration_cov, near)
        rows = np.flatnonzero(fits.spots >= 3)
        covariance, full_rank = covariances_of(fits.information[rows])
        rows, covariance = rows[full_rank], covariance[full_rank]
        good = limits.hold(covariance)
        rows, covariance = rows[good], covariance[good]
        at, b = start + rows, beside[start + rows]
        out.measured[at] = True
        out.R[at], out.t[at] = fits.R[rows], fits.t[rows]
        out.covariance[at] = covariance + np.eye(6) * (b**2)[:, None]
        along = b * fits.along[rows]
        inside = np.eye(6) + b[:, :, None] * fits.at_ref[rows] * b[:, None]
        less = np.einsum("ki,ki->k", along, np.linalg.solve(inside, along[..., None])[..., 0])
        out.excess[at] = fits.chi2_ref[rows] - fits.chi2[rows] - less
    return out


def rms_residuals(views: Views, detections: RunDetections, assigned: Ints, ref: Reference) -> Array:
    """Root mean square residual (T,) per axis, px, of the spots labelled in each frame at the poses of a motion."""
    out = np.full(len(ref.t), np.nan)
    expected, _ = project_all(views, ref.R, ref.t)
    used = (assigned >= 0) & (assigned < BLENDED)
    square = np.full((*used.shape, 2), np.nan)
    square[used] = (detections.uv[(detections.begin[:-1, None] + assigned)[used]] - expected[used]) ** 2
    count = used.sum(axis=1)
    for spots in np.unique(count[count > 0]).tolist():
        frames = np.flatnonzero((count == spots) & np.isfinite(square).any(axis=(1, 2)))
        of_each = square[frames][used[frames]].reshape(len(frames), 2 * spots)
        out[frames] = np.sqrt(np.nanmean(of_each, axis=1))
    return out
