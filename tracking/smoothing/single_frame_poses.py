"""The pose of each frame of a run by itself, its misfit, and what the residuals say about the spots' variances."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Bools, Ints, evenly_spread
from geometry.compiled_projection import Views, project_all
from geometry.pose_solver.gauss_newton import SolveLimits, covariances_of
from geometry.uncertainty.chi_square import gamma_quantile
from tracking.rigid_body.association.frame_detections import BLENDED
from tracking.smoothing.motion.run_detections import Reference, RunDetections, fit_frames
from tracking.smoothing.place_errors import frames_with_same_error, usable_widths

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
    (motion.velocity_jumps.corner_offsets).
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
        worst = [np.sqrt(np.linalg.eigvalsh(covariance[:, i, i])[:, -1]) for i in (slice(0, 3), slice(3, 6))]
        good = (worst[0] <= limits.max_sigma_m) & (worst[1] <= limits.max_sigma_rad)
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


# Upper bounds of the spots' variances, from the residuals of single-frame poses.
#
# Noise is estimated, and the texture of the background and the misfit of the fits predict errors that belong to places,
# before any pose is known. All of them may be too large: too much light taken for noise, clipped spots with rings, a
# background that is not the screen. The residuals of a run with redundant spots contain the true errors, which
# therefore cannot be larger than the residuals. Source: ours.

_REACH = 2.0  # widths of the spot: assumed correlation length of the errors
_BELOW = 0.05  # share of the distribution of the residuals that is taken to be below them
_MOVING = 0.5  # share of the residuals that are independent in spite of errors of places, if the spots move
_FRAMES = 2000  # at most so many, evenly spaced
_PLACE_FACTORS = np.geomspace(1e-3, 1.0, 61)  # hypotheses
_LEAST_LIKELY = 1.35  # nats below the most likely factor: a one-sided bound of 95 %
_LEAST_FREEDOM = 4.0  # independent residuals from which the bound is used


class VarianceFactors(NamedTuple):
    """Factors (cameras,), at most 1, of the two parts of the spots' variances."""

    noise: Array
    place: Array  # of the part that belongs to places


def residual_bounds(
    views: Views, run: RunDetections, assigned: Ints, camera_of: Ints, place_px2: Array, ref: Reference,
    measured: Bools,
) -> VarianceFactors:  # fmt: skip
    """Factors with which each part of the variances alone is as large as the residuals allow.

    run: m detections of T frames; assigned (T, n): their labels; camera_of (n,): of the views; place_px2 (m,): part of
    their variances that belongs to places; ref (T,): motion near which the pose of each frame is found.

    The residuals are taken to be at the lower 5 % of their distribution. Noise differs in every frame, errors of one
    place count once: a vehicle at rest has few residuals that are independent of each other. Where the spots move on
    between the frames both parts have the same effect, and one factor.
    """
    noise, place = np.ones(run.has_image.shape[1]), np.ones(run.has_image.shape[1])
    labelled = (assigned >= 0) & (assigned < BLENDED)
    frames = evenly_spread(np.flatnonzero(measured & (labelled.sum(axis=1) > 3)), _FRAMES)
    if not len(frames):
        return VarianceFactors(noise, place)
    some, assigned, labelled = run._replace(begin=run.begin[frames]), assigned[frames], labelled[frames]
    row = np.where(labelled, some.begin[:, None] + assigned, 0)
    near = Reference(ref.R[frames], ref.t[frames], ref.m[frames])
    fits = fit_frames(views, some, assigned, np.zeros((len(camera_of), 2, 2)), near)
    uv, J = project_all(views, fits.R, fits.t)
    P = np.linalg.pinv(fits.information, hermitian=True)
    cov = run.cov[row]
    free = 1 - 0.5 * np.einsum("knia,kab,knjb,knji->kn", J, P, J, np.linalg.inv(cov))  # share not taken by the pose
    usable = labelled & np.isfinite(uv).all(axis=-1) & (free > 0)
    size2 = 0.5 * np.trace(cov, axis1=2, axis2=3)
    square = 0.5 * np.sum((run.uv[row] - uv) ** 2, axis=-1) / size2
    share = np.minimum(place_px2[row] / size2, 1.0)
    same = np.full(assigned.shape, np.nan)  # frames with the same error of a place
    measured_px = np.where(labelled[..., None], run.uv[row], np.nan)
    for i, width in enumerate(usable_widths(run.usual_size_px)):
        same[:, i] = frames_with_same_error(measured_px[:, i], _REACH * width)
    for camera in range(len(noise)):
        of_camera = usable & (camera_of == camera)
        weight = free[of_camera]
        freedom, places = 2 * float(np.sum(weight)), 2 * float(np.sum(weight / same[of_camera]))
        if freedom < _LEAST_FREEDOM:
            continue
        residual = float(np.sum(square[of_camera])) / float(np.sum(weight))
        ratio = square[of_camera] / weight
        likely = most_of_places(ratio, share[of_camera], weight / same[of_camera])
        of_place = float(np.sum(share[of_camera] * weight)) / float(np.sum(weight))
        most = residual / _lower_quantile(freedom)
        if places > _MOVING * freedom:
            noise[camera] = min(most, 1.0)
            place[camera] = min(noise[camera], likely)
            continue
        noise[camera] = min(most / max(1 - of_place, 1e-12), 1.0)
        if places >= _LEAST_FREEDOM:
            most = residual / (_lower_quantile(places) * max(of_place, 1e-12))
            place[camera] = min(most, likely, 1.0)
    return VarianceFactors(noise, place)


def most_of_places(ratio: Array, share: Array, weight: Array) -> float:
    """The largest factor of the part that belongs to places which is likely, given how the residuals vary with it.

    ratio (m,): of squares of residuals to stated variances; share (m,): of these, the part that belongs to places;
    weight (m,): independent pairs of coordinates. Where places differ, the even ones show the noise and the others the
    factor: a spot whose light the texture modulates by less than expected has smaller errors in all of them.
    """
    variance = 1 - share[:, None] * (1 - _PLACE_FACTORS)
    log_likelihood = -np.sum(weight[:, None] * (ratio[:, None] / variance + np.log(variance)), axis=0)
    likely = log_likelihood >= log_likelihood.max() - _LEAST_LIKELY
    return float(_PLACE_FACTORS[likely].max())


def _lower_quantile(freedom: float) -> float:
    """Quantile of chi-square over its degrees of freedom, which need not be whole."""
    return 2 * gamma_quantile(1 - _BELOW, freedom / 2) / freedom
