"""Factors of the spots' variances, from the residuals of single-frame poses.

Noise is estimated, and the texture of the background and the misfit of the fits predict errors that belong to places,
before any pose is known. All of them may be wrong: too much light taken for noise, clipped spots with rings, a
background that modulates the light less than a screen would. The residuals of a run with redundant spots contain the
true errors. Source: ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Bools, Ints, evenly_spread
from geometry.compiled_projection import Views, project_all
from tracking.rigid_body.association.frame_detections import BLENDED
from tracking.smoothing.motion.run_detections import Reference, RunDetections, fit_frames
from tracking.smoothing.place_errors import (
    PLACE_FACTOR,
    PLACE_REACH,
    correlation,
    frames_with_same_error,
    usable_widths,
)

_ALIKE = 0.9  # least correlation, with a length of one width, of errors whose difference shows the noise
_FRAMES = 2000  # at most so many, evenly spaced
_NOISE_FACTOR = 1.25  # 1 sigma of the ratio of the stated sigma of the noise to the true one; of places PLACE_FACTOR
_STEPS = 12  # of Fisher scoring; it converges in about six
_LARGEST_STEP = 1.0  # of the logarithm of a factor
_LEAST_VARIANCE = 1e-3  # relative to the stated one
_ROBUST = 9.0  # times its median: most that a square of a residual counts; normal ones are larger in 0.2 %


class VarianceFactors(NamedTuple):
    """Factors (cameras,) of the three parts of the spots' variances."""

    noise: Array
    place: Array  # of the part that is stated for each place
    misfit: Array  # of the part that each spot has at least, which belongs to places, too
    freedom: float  # of the mean square of all residuals: twice its squared inverse scatter


class Squares(NamedTuple):
    """m mean squares of two coordinates each, and the parts of their expected values, all over the stated variances."""

    ratio: Array
    noise: Array
    place: Array
    misfit: Array
    known: Array  # errors of motion between the pictures
    weight: Array  # number of independent pairs of coordinates that each stands for


def variance_factors(
    views: Views, run: RunDetections, assigned: Ints, camera_of: Ints, place_px2: Array, misfit_px2: Array,
    calibration_cov: Array, ref: Reference, measured: Bools, motion_cov: Array,
) -> VarianceFactors:  # fmt: skip
    """The factors of the parts of the stated variances, as the residuals show them.

    run: m detections of T frames; assigned (T, n): their labels; camera_of (n,): of the views; place_px2, misfit_px2
    (m,): parts of their variances that belong to places, as stated for each and what each has at least;
    calibration_cov (n, 2, 2), px^2: of errors of the rig that the points may have lost, or kept, when those that the
    run shows were taken from them (`RigErrors`); ref (T,): motion near which the pose of each frame is found;
    motion_cov (m, 2, 2), px^2: further covariances of the detections, which are known.

    Noise differs in every frame, errors of one place count once: a vehicle at rest has few residuals that are
    independent of each other. There the change of a residual from frame to frame shows the noise alone.
    """
    factors = np.ones((3, run.has_image.shape[1]))
    labelled = (assigned >= 0) & (assigned < BLENDED)
    frames = evenly_spread(np.flatnonzero(measured & (labelled.sum(axis=1) > 3)), _FRAMES)
    if not len(frames):
        return VarianceFactors(factors[0], factors[1], factors[2], 0.0)
    some, assigned, labelled = run._replace(begin=run.begin[frames]), assigned[frames], labelled[frames]
    row = np.where(labelled, some.begin[:, None] + assigned, 0)
    near = Reference(ref.R[frames], ref.t[frames], ref.m[frames])
    total = run.cov + motion_cov
    fits = fit_frames(views, some._replace(cov=total), assigned, calibration_cov, near)
    uv, J = project_all(views, fits.R, fits.t)
    P = np.linalg.pinv(fits.information, hermitian=True)
    cov = total[row] + calibration_cov
    free = 1 - 0.5 * np.einsum("knia,kab,knjb,knji->kn", J, P, J, np.linalg.inv(cov))  # share not taken by the pose
    usable = labelled & np.isfinite(uv).all(axis=-1) & (free > 0)
    size2, own = 0.5 * np.trace(cov, axis1=2, axis2=3), 0.5 * np.trace(run.cov[row], axis1=2, axis2=3)
    residual = np.where(usable[..., None], run.uv[row] - uv, np.nan)
    part = np.minimum(place_px2[row], own)
    least = np.minimum(misfit_px2[row], own - part)
    parts = np.stack([own - part - least, part, least], axis=-1) / size2[..., None]  # the rest is known
    same = np.full(assigned.shape, np.nan)  # frames with the same error of a place
    rho = np.zeros((len(frames) - 1, assigned.shape[1]))  # correlation of such errors in successive frames
    measured_px = np.where(labelled[..., None], run.uv[row], np.nan)
    for i, width in enumerate(usable_widths(run.usual_size_px)):
        same[:, i] = frames_with_same_error(measured_px[:, i], PLACE_REACH * width)
        rho[:, i] = correlation(np.linalg.norm(np.diff(measured_px[:, i], axis=0), axis=-1), width)
    unknown = 0.5 * np.trace(calibration_cov, axis1=1, axis2=2) / size2
    square = 0.5 * np.sum(residual**2, axis=-1) / (size2 * free) + unknown / free
    step = 0.5 * np.sum(np.diff(residual, axis=0) ** 2, axis=-1) / (size2 * free)[1:]
    weight = np.where(usable, free, 0.0)
    of_place = float(np.sum(weight * parts[..., 1:].sum(axis=-1))) / max(float(weight.sum()), 1e-9)
    every, independent = 2 * float(weight.sum()), 2 * float(np.sum(weight / np.where(usable, same, 1.0)))
    freedom = 1 / ((1 - of_place) ** 2 / max(every, 1e-9) + of_place**2 / max(independent, 1e-9))
    for camera in range(factors.shape[1]):
        at = usable & (camera_of == camera)
        pair = at[1:] & at[:-1] & (rho > _ALIKE)
        of_step = (1 - rho)[..., None] * parts[1:, :, 1:]
        known, once = (1 - parts.sum(axis=-1) - unknown)[at], (free / same)[at]
        noise, places, again = parts[1:][pair][:, 0], of_step[pair], (free - free / same)[1:][pair]
        both = [
            Squares(square[at], parts[at][:, 0], parts[at][:, 1], parts[at][:, 2], known, once),
            Squares(0.5 * step[pair], noise, places[:, 0], places[:, 1], np.zeros(pair.sum()), again),
        ]
        if np.count_nonzero(at):
            squares = Squares._make(np.concatenate(a) for a in zip(*both, strict=True))
            factors[:, camera] = likely_factors(squares)
    return VarianceFactors(factors[0], factors[1], factors[2], freedom)


def likely_factors(squares: Squares) -> Array:
    """Means (3,) of the factors of noise, of errors of places and of misfits under their posterior distribution.

    Where places differ, the even ones show the noise and the others the factor. That each spot has a least error may
    be wrong while the errors of single places, such as edges, are right: so its factor is its own. Before the residuals
    are seen all factors are log-normal with a mean of 1.
    """
    precision = 1 / (2 * np.log([_NOISE_FACTOR, PLACE_FACTOR, PLACE_FACTOR])) ** 2
    usual = x = -0.5 / precision
    for _ in range(_STEPS):
        parts = np.stack([squares.noise, squares.place, squares.misfit]) * np.exp(x)[:, None]
        variance = np.maximum(parts.sum(axis=0) + squares.known, _LEAST_VARIANCE)
        slope, ratio = parts / variance, squares.ratio / variance
        ratio = np.minimum(ratio, _ROBUST * np.median(ratio))
        gradient = slope @ (squares.weight * (ratio - 1)) - precision * (x - usual)
        information = (squares.weight * slope) @ slope.T + np.diag(precision)
        x = x + np.clip(np.linalg.solve(information, gradient), -_LARGEST_STEP, _LARGEST_STEP)
    # Few residuals leave a skewed distribution: the mean of a logarithm is beyond its mode by 1/2 C sum(w s (s C s)).
    covariance = np.linalg.inv(information)
    skewed = slope @ (squares.weight * np.einsum("km,kl,lm->m", slope, covariance, slope))
    return np.asarray(np.exp(x + 0.5 * (covariance @ skewed + np.diag(covariance))))
