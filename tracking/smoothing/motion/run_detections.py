"""All detections of a run, and the information of its labelled spots about the motion; compiled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compilation.jit import compiled
from geometry.compiled_linalg import copy_into, copy_matrix_into
from geometry.compiled_projection import Views
from tracking.rigid_body.association.frame_detections import chosen_points
from tracking.rigid_body.models.information import frame_information, single_frame_pose, well_controlled
from tracking.smoothing.motion.reference import Reference


class RunDetections(NamedTuple):
    """m detections of T frames and n views; those of frame k are the rows begin[k] to begin[k + 1], sorted by camera.

    `blend_px`, `log_static`, `size_px` and `usual_size_px` are as in FrameDetections.
    """

    uv: Array  # (m, 2) px
    cov: Array  # (m, 2, 2) px^2
    blend_px: Array  # (m,)
    begin: Ints  # (T + 1,)
    first: Ints  # (T, cameras + 1) where the rows of each camera begin within the frame
    has_image: Bools  # (T, cameras)
    log_static: Array  # (m,)
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
