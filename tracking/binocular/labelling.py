"""Which candidate in each picture is which marker, for a pose that is roughly known; the fit and its evidence.

Left and right images of a marker are matched through the marker model, the epipolar geometry, colour and size. The
order of the candidates is not used: the paper's (section 3) fails as soon as a marker is hidden or a false one appears.
Source: ours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from geometry.arrays import Array, Ints
from geometry.camera import in_picture
from geometry.pose import Pose
from tracking.binocular.joint_fit import JointFit, MarkerObservations, fit_pose
from tracking.binocular.marker_model import MarkerImages, MarkerModel, StereoPair, project_markers
from tracking.binocular.parameters import MatchParameters

Images = tuple[MarkerImages, MarkerImages]  # candidates of the left and the right picture
_LARGEST_PX2 = 1e8  # of the variance of a predicted place: more than any picture
_ROUNDS = 4  # of labelling and fitting
_MOST_OUTLIERS = 4  # images that a fit may refuse
_PARAMETERS_IN_IMAGES = 3  # a pose has as many numbers as three images


@dataclass(frozen=True, slots=True)
class LabelledPose:
    """A pose with the candidates that it explains."""

    index: Ints  # (2, K): the candidate of each marker in each picture, -1: none
    fit: JointFit
    score: float  # nats: log likelihood against "all candidates are false"
    evidence: float  # nats: the score without what six free numbers explain by chance

    @property
    def markers(self) -> int:
        """Number of different markers seen."""
        return int((self.index >= 0).any(axis=0).sum())


def observations(images: Images, index: Ints) -> MarkerObservations:
    """The labelled images (2, K)."""
    uv = np.full((*index.shape, 2), np.nan)
    cov = np.zeros((*index.shape, 2, 2))
    cov[..., :, :] = np.eye(2)
    for c, found in enumerate(images):
        seen = index[c] >= 0
        uv[c, seen], cov[c, seen] = found.uv_px[index[c, seen]], found.cov_px2[index[c, seen]]
    return MarkerObservations(uv, cov)


def expected_areas(pair: StereoPair, model: MarkerModel, pose: Pose) -> Array:
    """Areas (2, K), px^2, of round markers seen from the front; nan where a radius is not known."""
    out = []
    for camera in pair.cameras:
        depth = camera.camera_from_world.apply(pose.apply(model.positions))[:, 2]
        focal = camera.matrix[0, 0] * camera.matrix[1, 1]
        out.append(np.pi * model.radius_m**2 * focal / np.where(depth > 0, depth, np.nan) ** 2)
    return np.array(out)


def assign(pair: StereoPair, model: MarkerModel, images: Images, pose: Pose, spread: Array, p: MatchParameters) -> Ints:
    """The candidates (2, K) of all markers at a pose of covariance `spread` (6, 6); -1 where none fits."""
    pixels, J = project_markers(pair, model, pose)
    areas = expected_areas(pair, model, pose)
    out = np.full((2, len(model)), -1, dtype=np.int64)
    for c, found in enumerate(images):
        if not len(found):
            continue
        S = (J[c] @ spread @ np.swapaxes(J[c], -1, -2))[:, None] + found.cov_px2[None]
        S = S + 1e-4 * np.eye(2)
        usable = np.trace(S, axis1=-2, axis2=-1) < _LARGEST_PX2  # not of markers behind the camera, or beside it
        S = np.where(usable[..., None, None], S, np.eye(2))
        apart = found.uv_px[None] - pixels[c][:, None]
        with np.errstate(invalid="ignore", divide="ignore"):
            d2 = np.einsum("kni,knij,knj->kn", apart, np.linalg.inv(S), apart)
            size = np.abs(np.log(found.area_px2[None] / areas[c][:, None]))
        wrong_size = size > np.log(p.area_factor)  # False for nan: not known
        allowed = (d2 < p.gate_sigmas**2) & (model.colour[:, None] == found.colour[None]) & ~wrong_size & usable
        cost = np.where(allowed, d2 + np.linalg.slogdet(S)[1], 1e6)
        for k, n in zip(*linear_sum_assignment(cost), strict=True):
            if allowed[k, n]:
                out[c, k] = n
    return out


def labelled_pose(
    pair: StereoPair, model: MarkerModel, images: Images, start: Pose, spread: Array, p: MatchParameters
) -> LabelledPose | None:
    """The pose and labels near a start with covariance `spread` (6, 6); None where fewer than three images fit."""
    index, pose, fit = np.full((2, len(model)), -1, dtype=np.int64), start, None
    for _ in range(_ROUNDS):
        following = assign(pair, model, images, pose, spread, p)
        if np.array_equal(following, index):
            break
        index = following
        fit = fit_pose(pair, model, observations(images, index), pose)
        if fit is None or not fit.observable:
            return None
        pose, spread = fit.pose, fit.covariance
    index, fit = _without_outliers(pair, model, images, index, fit, p)
    if fit is None or not fit.observable:
        return None
    score, chance = _score(pair, model, images, index, fit, p)
    return LabelledPose(index, fit, score, score - chance)


def _without_outliers(
    pair: StereoPair, model: MarkerModel, images: Images, index: Ints, fit: JointFit | None, p: MatchParameters
) -> tuple[Ints, JointFit | None]:
    """Removes images whose residual contradicts the others, the worst one first."""
    for _ in range(_MOST_OUTLIERS):
        if fit is None or fit.dof < 2:
            return index, fit
        chi2 = _image_chi2(pair, model, images, index, fit)
        worst = np.unravel_index(int(np.argmax(chi2)), chi2.shape)
        if chi2[worst] < p.outlier_chi2:
            return index, fit
        index = index.copy()
        index[worst] = -1
        fit = fit_pose(pair, model, observations(images, index), fit.pose)
    return index, fit


def _image_chi2(pair: StereoPair, model: MarkerModel, images: Images, index: Ints, fit: JointFit) -> Array:
    """Squared residuals (2, K) in sigmas of their images, with the part that the pose covariance allows; 0: not seen.

    The variance of a residual is at most that of its image plus that of the prediction, so that calibration errors do
    not make outliers.
    """
    J = project_markers(pair, model, fit.pose)[1]
    S = observations(images, index).cov_px2 + J @ fit.systematic @ np.swapaxes(J, -1, -2)
    r = np.nan_to_num(fit.residuals_px)
    return np.asarray(np.einsum("cki,ckij,ckj->ck", r, np.linalg.inv(S), r))


def _score(
    pair: StereoPair, model: MarkerModel, images: Images, index: Ints, fit: JointFit, p: MatchParameters
) -> tuple[float, float]:
    """Score of a labelling, and the part of it that three images of a free pose reach by chance, nats."""
    pixels = project_markers(pair, model, fit.pose)[0]
    observed = observations(images, index)
    score, gains = -0.5 * fit.chi2, []
    for c, (camera, found) in enumerate(zip(pair.cameras, images, strict=True)):
        if not len(found):
            continue  # a blind camera says nothing about hidden markers
        density = max(len(found), 1) / float(np.prod(camera.image_size_px))
        seen = index[c] >= 0
        volume = 2 * np.pi * np.sqrt(np.linalg.det(observed.cov_px2[c, seen]))
        gain = np.log(p.detection_probability / (density * volume))
        gains += gain.tolist()
        inside = in_picture(pixels[c], np.array(camera.image_size_px))
        score += float(gain.sum()) + float(np.sum(inside & ~seen)) * np.log(1 - p.detection_probability)
    return score, _PARAMETERS_IN_IMAGES * float(np.mean(gains)) if gains else 0.0
