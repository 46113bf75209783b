"""Ratio of the spots' errors to their stated sigmas, from the residuals of the single-frame poses of a run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from geometry.arrays import Array, Bools, Ints, evenly_spread
from geometry.compiled_projection import Views, project_all
from geometry.forward_model import SpotModel
from tracking.rigid_body.association.frame_detections import BLENDED
from tracking.rigid_body.models.information import single_frame_pose
from tracking.rigid_body.online_estimates import DEADBAND
from tracking.shapes import DEVELOPED_SPECKLE
from tracking.smoothing.motion.run_detections import Reference, RunDetections, fit_frames, labelled_points
from tracking.smoothing.place_errors import (
    PLACE_FACTOR,
    PLACE_REACH,
    correlation,
    frames_with_same_error,
    usable_widths,
)

# Largest shift of a spot's centre by texture, speckle and its shape, as a share of its width (1 sigma): 4 % texture
# makes 0.04, speckle of contrast 0.3 up to 0.16.
LARGEST_WIDTH_SHARE = 0.16
_FRAMES = 300  # from which the width share is estimated
_LEAST_CHANGES = 20  # changes of the widths in a camera from which their scatter is estimated
_RESOLVED_PX = 1.8  # width of a spot from which its fit shows misfits
_LEAST_OF_VIEW = 6  # changes from which a view counts
_MEDIAN_CHI2 = 0.4549364  # median of chi-square with one degree of freedom
_LAGS = 1, 2, 4, 8, 16  # frames between the compared widths of a spot
_APART = 2.0  # widths between places with different errors
MOST_MOTION = 2.0  # ratio of a moved detection's variance to its own, up to which its residual shows its own errors
_CLEAR_SCATTER = 2.0  # ratio of the widths' variance to the stated one from which it is used


@dataclass(frozen=True, slots=True)
class ErrorScale:
    """Corrections of the stated covariances of the spots, from a whole run."""

    misfit_share: Array  # (cameras,) least error by misfits of the fits (speckle, texture), as a share of the widths
    width_share: Array  # (cameras,) errors beyond the stated ones, as a share of the spots' widths (1 sigma)
    factors: VarianceFactors  # of the parts of the stated variances

    @staticmethod
    def of(
        model: SpotModel, run: RunDetections, place_px2: Array, assigned: Ints, calibration_cov: Array, ref: Reference,
        measured: Bools, motion_cov: Array,
    ) -> ErrorScale:  # fmt: skip
        """The corrections from the labelled spots of T frames, with their single-frame poses near a reference motion.

        place_px2 (m,): variances of the detections that belong to their places; calibration_cov (n, 2, 2): as in
        `variance_factors`. motion_cov (m, 2, 2): of where the detections are at the instants of their frames, beyond
        their own.
        """
        views, camera = model.numbers, model.camera_of
        misfit = usual_misfit(run, place_px2, assigned, camera)
        own = _cameras_of(run)
        least = _least_variance(place_px2, run.size_px, misfit[own])
        even = run._replace(cov=_with_more(run.cov, least))

        def factors_of(some: RunDetections) -> VarianceFactors:
            return variance_factors(
                views, some, assigned, camera, place_px2, least, calibration_cov, ref, measured, motion_cov
            )

        seen = scattered_width_share(even, assigned, camera)
        wider = widened(even, seen)
        factors = factors_of(wider)
        if seen.any():
            seen = _less(seen, factors.noise, wider, even)
            factors = factors_of(widened(even, seen))
        even = even._replace(cov=_within(factors, even.cov, place_px2, least, own))
        wider = widened(even, seen)
        wider = wider._replace(cov=wider.cov + motion_cov)
        # A vehicle at rest has few residuals that are independent of each other.
        usual = max(DEADBAND, 1 + 3 * np.sqrt(2 / max(factors.freedom, 1e-9)))
        more = width_share(views, wider, assigned, calibration_cov, ref, measured, usual)
        return ErrorScale(misfit, np.hypot(seen, more), factors)

    def covariance(self, stated: Array, width_px: Array, place_px2: Array, camera: Ints | int) -> Array:
        """Covariances (m, 2, 2), px^2, of spots with these widths (m,), px, and stated covariances (m, 2, 2).

        place_px2 (m,): part of the stated variances that belongs to the place. Unknown widths (nan) add nothing.
        """
        least = _least_variance(place_px2, width_px, self.misfit_share[camera])
        within = _within(self.factors, _with_more(stated, least), place_px2, least, camera)
        return _with_more(within, _variance_of_share(width_px, self.width_share[camera]))

    def place_px2(self, run: RunDetections, stated_px2: Array) -> Array:
        """(m,): variances of a run's detections that belong to their places."""
        camera = _cameras_of(run)
        least = _least_variance(stated_px2, run.size_px, self.misfit_share[camera])
        place = stated_px2 * self.factors.place[camera] + least * self.factors.misfit[camera]
        # Speckle and texture that were not stated belong to places, too.
        return np.asarray(place + _variance_of_share(run.size_px, self.width_share[camera]))

    def of_run(self, run: RunDetections, place_px2: Array) -> Array:
        """Covariances (m, 2, 2) of all detections of a run."""
        return self.covariance(run.cov, run.size_px, place_px2, _cameras_of(run))


def _cameras_of(run: RunDetections) -> Ints:
    """(m,): the camera of each detection."""
    cameras = run.has_image.shape[1]
    return np.repeat(np.tile(np.arange(cameras), len(run.first)), np.diff(run.first, axis=1).ravel())


def _variance_of_share(width_px: Array, share: Array | float) -> Array:
    """(m,): variances, px^2, of errors that are shares of the widths (m,), px; 0 where a width is not known."""
    return np.asarray((share * np.where(np.isnan(width_px), 0.0, width_px)) ** 2)


def _least_variance(stated_px2: Array, width_px: Array, share: Array | float) -> Array:
    """(m,): what is missing, px^2, in the stated variances of places to those of a share of the widths (m,), px."""
    return np.asarray(np.maximum(_variance_of_share(width_px, share) - stated_px2, 0.0))


def _with_more(cov: Array, variance_px2: Array) -> Array:
    """Covariances (m, 2, 2) with further variances (m,), the same in all directions."""
    return np.asarray(cov + variance_px2[:, None, None] * np.eye(2))


def _within(factors: VarianceFactors, cov: Array, place_px2: Array, least_px2: Array, camera: Ints | int) -> Array:
    """Covariances (m, 2, 2) with their parts multiplied by their factors; their shape is kept.

    place_px2, least_px2 (m,): the parts that belong to places.
    """
    own = np.maximum(0.5 * np.trace(cov, axis1=1, axis2=2), 1e-300)
    place = np.minimum(place_px2 / own, 1.0)
    least = np.minimum(least_px2 / own, 1.0 - place)
    noise = (1 - place - least) * factors.noise[camera]
    return np.asarray(cov * (noise + place * factors.place[camera] + least * factors.misfit[camera])[:, None, None])


def _less(share: Array, factor: Array, wider: RunDetections, stated: RunDetections) -> Array:
    """The shares (cameras,) of the widths that widened the stated covariances, less what exceeds factors (cameras,)."""
    total, before = (0.5 * np.trace(run.cov, axis1=1, axis2=2) for run in (wider, stated))
    out, own = share.copy(), _cameras_of(stated)
    for camera in np.flatnonzero((share > 0) & (factor < 1)):
        all_of_it = float(np.sum(total[own == camera]))
        added = all_of_it - float(np.sum(before[own == camera]))
        out[camera] *= np.sqrt(max(1 - (1 - factor[camera]) * all_of_it / max(added, 1e-300), 0.0))
    return out


def usual_misfit(run: RunDetections, place_px2: Array, assigned: Ints, camera_of: Ints) -> Array:
    """Errors (cameras,) of the labelled spots that belong to their places, as a share of the widths.

    The grain of the light is the same for all spots of a camera, but does not show in each fit: each spot has at least
    half of their mean variance, or the median where few spots, on edges of the background, have most of it. A camera
    whose spots are too narrow to show it takes that of the others. Developed speckle is larger than what else leaves a
    misfit: there narrow spots show it, too, and a fit hardly shows its own error, so that each has the mean.
    """
    share2, size = np.full(assigned.shape, np.nan), np.full(assigned.shape, np.nan)
    labelled = (assigned >= 0) & (assigned < BLENDED)
    rows = (run.begin[: len(assigned), None] + assigned)[labelled]
    size[labelled] = run.size_px[rows]
    share2[labelled] = place_px2[rows] / run.size_px[rows] ** 2
    out = np.full(run.has_image.shape[1], np.nan)
    for camera in range(len(out)):
        some, wide = share2[:, camera_of == camera], size[:, camera_of == camera] > _RESOLVED_PX
        every, shares = (np.sort(some[which & np.isfinite(some)]) for which in (True, wide))
        if len(every) >= _LEAST_CHANGES and min(_middle(every), np.median(every)) > DEVELOPED_SPECKLE**2:
            out[camera] = np.sqrt(_middle(every))
        elif len(shares) >= _LEAST_CHANGES:
            out[camera] = np.sqrt(min(0.5 * _middle(shares), np.median(shares)))
    usual = float(np.nanmax(out)) if np.isfinite(out).any() else 0.0
    return np.where(np.isnan(out), usual, out)


def _middle(values: Array) -> float:
    """The mean of sorted values without a tenth at each end."""
    cut = len(values) // 10
    return float(np.mean(values[cut : len(values) - cut]))


def widened(detections: RunDetections, share: Array | float) -> RunDetections:
    """The detections with covariances that include errors of these shares (cameras,) of the spots' widths."""
    own = np.broadcast_to(share, (detections.has_image.shape[1],))[_cameras_of(detections)]
    return detections._replace(cov=_with_more(detections.cov, _variance_of_share(detections.size_px, own)))


def width_share(
    views: Views, detections: RunDetections, assigned: Ints, calibration_cov: Array, ref: Reference, measured: Bools,
    usual: float,
) -> float:  # fmt: skip
    """Errors beyond the stated ones as a share of the spots' widths (1 sigma); 0 if the stated sigmas are correct.

    Also 0 up to a `usual` variance factor, and if no width is known. Texture and speckle shift a spot in proportion to
    its width, whatever its noise is: if the residuals are larger than stated, such errors are added.
    """
    if not np.isfinite(detections.size_px).any():
        return 0.0
    frames = evenly_spread(np.flatnonzero(measured), _FRAMES)

    def variance_factor(share: float) -> float:
        return _mean_variance_factor(views, widened(detections, share), assigned, calibration_cov, ref, frames)

    if variance_factor(0.0) <= usual:
        return 0.0
    return _share_with(variance_factor)


def scattered_width_share(run: RunDetections, assigned: Ints, camera_of: Ints) -> Array:
    """Errors beyond the stated ones of each camera (cameras,) as a share of the spots' widths, from their scatter.

    0 if none show. The widths are the larger half axes: the length of a streak changes with the speed, which adds to
    the scatter; its centre is less certain, too. camera_of (n,): of the views.

    Whatever changes the light from place to place (noise, texture, speckle) shifts a fitted Gaussian and changes its
    width by the same amount: the derivatives with respect to both have the same norm once that of the amplitude is
    projected out. The second difference of three widths therefore has six times the variance of a coordinate of the
    centre. It needs no other spot, and motion that is steady in the picture cancels. Errors that last are compared over
    as many frames as the spot needs to move by two widths; those of a spot at rest do not show: a lower bound. Source:
    ours; measured on 60 random recordings, where both scatters have a correlation of 0.96 and agree within 20 %
    (1 sigma).
    """
    labelled = (assigned >= 0) & (assigned < BLENDED)
    row = np.where(labelled, run.begin[: len(assigned), None] + assigned, 0)
    out = np.zeros(run.has_image.shape[1])
    if not len(run.size_px):
        return out
    size, uv = np.where(labelled, run.size_px[row], np.nan), run.uv[row]
    largest = np.linalg.eigvalsh(run.cov)[row, 1]
    farther = np.zeros(len(out), bool)  # compared in different places of the screen
    for lag in (x for x in _LAGS if 2 * x < len(size)):
        before, middle, after = np.s_[: -2 * lag], np.s_[lag : len(size) - lag], np.s_[2 * lag :]
        change = size[after] - 2 * size[middle] + size[before]
        if lag > 1:
            moved = np.minimum(*(np.linalg.norm(uv[end] - uv[middle], axis=-1) for end in (before, after)))
            change[moved < _APART * size[middle]] = np.nan
        square, width2, known, stated = change**2 / 6, size[middle] ** 2, np.isfinite(change), largest[middle]
        for camera in range(len(out)):
            some: list[int] = [
                int(i) for i in np.flatnonzero(camera_of == camera) if np.count_nonzero(known[:, i]) >= _LEAST_OF_VIEW
            ]
            if farther[camera] or np.count_nonzero(known[:, some]) < _LEAST_CHANGES:
                continue
            farther[camera] = lag > 1

            # The mean over the views: speckle may show in the sigmas of wide spots and not in those of narrow ones.
            def ratio(
                share: float, some: list[int] = some, square: Array = square, stated: Array = stated,
                width2: Array = width2,
            ) -> float:  # fmt: skip
                of_views = np.nanmedian(square[:, some] / (stated + share**2 * width2)[:, some], axis=0)
                return float(np.mean(of_views)) / _MEDIAN_CHI2

            if ratio(0.0) > _CLEAR_SCATTER:
                out[camera] = max(_share_with(ratio), out[camera])
    return out


def _share_with(variance_factor: Callable[[float], float]) -> float:
    """The share of the widths, at most LARGEST_WIDTH_SHARE, with which a decreasing variance factor is 1."""
    low, high = 0.0, LARGEST_WIDTH_SHARE
    if variance_factor(high) > 1.0:
        return high
    for _ in range(8):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if variance_factor(middle) > 1.0 else (low, middle)
    return 0.5 * (low + high)


def _mean_variance_factor(
    views: Views, detections: RunDetections, assigned: Ints, calibration_cov: Array, ref: Reference, frames: Ints
) -> float:
    """Chi-square per degree of freedom of the single-frame poses, robust to outliers; 1 without redundant frames."""
    shares = []
    for k in frames.tolist():
        use, uv, cov = labelled_points(detections, k, assigned[k], calibration_cov)
        _, _, _, chi2, count = single_frame_pose(views, ref.R[k], ref.t[k], use, uv, cov)
        if count > 3:
            shares.append(chi2 / (2 * count - 6))
    return float(np.mean(np.minimum(shares, 3 * np.median(shares)))) if shares else 1.0


def well_known(moved: RunDetections, seen: RunDetections, assigned: Ints) -> Ints:
    """The labels (T, n) of the detections that say something about their own errors.

    moved: the detections where they would have been at the instants of their frames. Where the motion in between is
    less certain than the detections, residuals are those of the motion.
    """
    certain = np.trace(moved.cov, axis1=1, axis2=2) <= MOST_MOTION * np.trace(seen.cov, axis1=1, axis2=2)
    rows = seen.begin[: len(assigned), None] + np.maximum(assigned, 0) % BLENDED
    labelled = assigned >= 0
    return np.where(labelled & certain[np.where(labelled, rows, 0)], assigned, -1)


def usual_sizes(detections: RunDetections, assigned: Ints) -> Array:
    """Median larger half axis (n,) of each view's labelled points, px; nan where none is known."""
    out = np.full(assigned.shape[1], np.nan)
    for i in range(assigned.shape[1]):
        k = np.flatnonzero(assigned[:, i] >= 0)
        sizes = detections.size_px[detections.begin[k] + assigned[k, i] % BLENDED]
        if np.isfinite(sizes).any():
            out[i] = np.nanmedian(sizes)
    return out


# Factors of the spots' variances, from the residuals of single-frame poses.
#
# Noise is estimated, and the texture of the background and the misfit of the fits predict errors that belong to places,
# before any pose is known. All of them may be wrong: too much light taken for noise, clipped spots with rings, a
# background that modulates the light less than a screen would. The residuals of a run with redundant spots contain the
# true errors. Source: ours.

_ALIKE = 0.9  # least correlation, with a length of one width, of errors whose difference shows the noise
_MOST_FRAMES = 2000  # at most so many, evenly spaced
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
    frames = evenly_spread(np.flatnonzero(measured & (labelled.sum(axis=1) > 3)), _MOST_FRAMES)
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
    free = np.where(usable, free, 1.0)
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
    weight = usable * free
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
