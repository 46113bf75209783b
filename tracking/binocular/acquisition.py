"""Which candidate is which marker, at a pose that is roughly known and without one; the fit of labelled markers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations

import numpy as np
from scipy.optimize import linear_sum_assignment

from geometry.arrays import Array, Bools, Ints
from geometry.camera import in_picture
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import PoseFit
from geometry.pose_solver.three_spots import poses_from_three_spots
from geometry.rotations import angle
from tracking.binocular.joint_fit import MarkerObservations, fit_pose, triangulate, undistorted_pixels
from tracking.binocular.marker_model import MarkerImages, MarkerModel, MatchParameters, StereoPair, project_markers

# Which candidate in each picture is which marker, for a pose that is roughly known; the fit and its evidence.
#
# Left and right images of a marker are matched through the marker model, the epipolar geometry, colour and size. The
# order of the candidates is not used: the paper's (section 3) fails as soon as a marker is hidden or a false one
# appears. Source: ours.

Images = tuple[MarkerImages, MarkerImages]  # candidates of the left and the right picture
_LARGEST_PX2 = 1e8  # of the variance of a predicted place: more than any picture
_ROUNDS = 4  # of labelling and fitting
_MOST_OUTLIERS = 4  # images that a fit may refuse
_PARAMETERS_IN_IMAGES = 3  # a pose has as many numbers as three images


@dataclass(frozen=True, slots=True)
class LabelledPose:
    """A pose with the candidates that it explains."""

    index: Ints  # (2, K): the candidate of each marker in each picture, -1: none
    fit: PoseFit
    score: float  # nats: log likelihood against "all candidates are false"
    evidence: float  # nats: the score without what six free numbers, and the best of many hypotheses, explain by chance

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
        pose, spread = fit.world_from_body, fit.covariance
    index, fit = _without_outliers(pair, model, images, index, fit, p)
    if fit is None or not fit.observable:
        return None
    score, chance = _score(pair, images, index, fit, p)
    return LabelledPose(index, fit, score, score - chance)


def _without_outliers(
    pair: StereoPair, model: MarkerModel, images: Images, index: Ints, fit: PoseFit | None, p: MatchParameters
) -> tuple[Ints, PoseFit | None]:
    """Removes images whose residual contradicts the others, the worst one first."""
    for _ in range(_MOST_OUTLIERS):
        if fit is None or fit.dof < 2:
            return index, fit
        chi2 = _image_chi2(images, index, fit)
        worst = np.unravel_index(int(np.argmax(chi2)), chi2.shape)
        if chi2[worst] < p.outlier_chi2:
            return index, fit
        index = index.copy()
        index[worst] = -1
        fit = fit_pose(pair, model, observations(images, index), fit.world_from_body)
    return index, fit


def _image_chi2(images: Images, index: Ints, fit: PoseFit) -> Array:
    """Squared residuals (2, K) in sigmas of their images, with the part that the pose covariance allows; 0: not seen.

    The variance of a residual is at most that of its image plus that of the prediction, so that calibration errors do
    not make outliers.
    """
    observed = observations(images, index)
    J = fit.jacobian.reshape(*observed.uv_px.shape, 6)
    S = observed.cov_px2 + J @ fit.systematic @ np.swapaxes(J, -1, -2)
    r = np.nan_to_num(observed.uv_px - fit.projected_px.reshape(observed.uv_px.shape))
    return np.asarray(np.einsum("cki,ckij,ckj->ck", r, np.linalg.inv(S), r))


def _score(pair: StereoPair, images: Images, index: Ints, fit: PoseFit, p: MatchParameters) -> tuple[float, float]:
    """Score of a labelling, and the part of it that false candidates explain by chance, nats.

    Three images of a free pose always fit; further ones fit by chance where the candidates are dense.
    """
    observed = observations(images, index)
    pixels = fit.projected_px.reshape(observed.uv_px.shape)
    score, chance, gains = -0.5 * fit.chi2, 0.0, []
    for c, (camera, found) in enumerate(zip(pair.cameras, images, strict=True)):
        if not len(found):
            continue  # a blind camera says nothing about hidden markers
        density = len(found) / float(np.prod(camera.image_size_px))
        seen = index[c] >= 0
        volume = 2 * np.pi * np.sqrt(np.linalg.det(observed.cov_px2[c, seen]))
        gain = np.log(p.detection_probability / (density * volume))
        gains += gain.tolist()
        crowded = np.log(max(_density(found.uv_px, pixels[c]) / density, 1.0))
        chance += max(int(seen.sum()) - _PARAMETERS_IN_IMAGES, 0) * crowded
        inside = in_picture(pixels[c], np.array(camera.image_size_px))
        score += float(gain.sum()) + float(np.sum(inside & ~seen)) * np.log(1 - p.detection_probability)
    return score, chance + _PARAMETERS_IN_IMAGES * float(np.mean(gains)) if gains else 0.0


def _density(uv_px: Array, projected_px: Array) -> float:
    """Candidates (n, 2) per px^2: where the markers are projected (K, 2), as far as twice their extent around them.

    Candidates come in groups: a small image of the target in the middle of one explains several by chance.
    """
    middle = np.nanmean(projected_px, axis=0)
    radius = 2 * float(np.nanmax(np.linalg.norm(projected_px - middle, axis=1)))
    inside = np.linalg.norm(uv_px - middle, axis=1) <= radius
    return float(inside.sum()) / (np.pi * radius**2) if radius > 0 else np.inf


# The pose without a prediction: poses of three markers (P3P), tested against all candidates of both pictures.
#
# Three candidates of one picture and three markers have up to four poses. Each is scored by the markers that it
# explains in both pictures; the best ones are labelled and fitted. Candidates with an epipolar partner of the same
# colour in the other picture come first. Source: ours, with the compiled solver geometry/pose_solver/three_spots.py.

_MOST_CANDIDATES = 12  # of a picture, in triples: 1,320 ordered ones
_MORE_CANDIDATES = 24  # ... where those explain no picture, with few triples of markers
_FIRST_TRIPLES, _LAST_TRIPLES = 8, 4  # of markers: enough where most of them are seen; with _MORE_CANDIDATES
_MOST_TRIPLES = 60  # of markers: all triples of eight
_MOST_TRIED = 20_000  # ordered triples of candidates times triples of markers, beyond the first triples
_REFINED, _REFINED_SHARE = 24, 0.6  # best hypotheses that are fitted: at most so many, of this share of the best score
_CHUNK = 4000  # hypotheses scored at once: 15 MB
_COARSE_PX, _COARSE_SHARE = 2.0, 0.04  # gate of the scoring: px, and share of the target's size in the picture
_SAME_RAD, _SAME_SHARE = np.deg2rad(6.0), 0.02  # poses that differ by less, the position relative to the distance
_BY_CHANCE = 4  # candidates of a picture that a wrong pose explains
_ENOUGH = 0.95  # share of the images explained at which the second camera's triples are not needed


def matching_pairs(pair: StereoPair, images: Images, p: MatchParameters) -> Bools:
    """(n, m): which left and right candidates may be images of one marker: epipolar distance, colour, size, depth."""
    left, right = images
    n, m = len(left), len(right)
    if not n or not m:
        return np.zeros((n, m), dtype=bool)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(n), np.arange(m), indexing="ij"))
    floor = p.epipolar_floor_px**2 / p.epipolar_sigmas**2 * np.eye(2)
    found = triangulate(
        pair,
        np.stack([left.uv_px[i], right.uv_px[j]]),
        np.stack([left.cov_px2[i], right.cov_px2[j]]) + floor,
    )
    with np.errstate(invalid="ignore"):
        near = found.chi2 < p.epipolar_sigmas**2
        size = np.abs(np.log(left.area_px2[i] / right.area_px2[j]))
    ahead = np.ones(len(i), dtype=bool)
    for camera in pair.cameras:
        with np.errstate(invalid="ignore"):
            ahead &= camera.camera_from_world.apply(found.points)[:, 2] > 0
    good = near & ahead & (left.colour[i] == right.colour[j]) & ~(size > np.log(p.area_factor))
    return np.asarray(good.reshape(n, m))


def acquire(pair: StereoPair, model: MarkerModel, images: Images, p: MatchParameters) -> list[LabelledPose]:
    """The poses that explain the candidates, different ones, the best first; empty where none does."""
    partners = matching_pairs(pair, images, p)
    left: Bools = np.asarray(partners.any(axis=1))
    right: Bools = np.asarray(partners.any(axis=0))
    ranked = [_ranked(images[0], left), _ranked(images[1], right)]
    found: list[LabelledPose] = []
    tried = 0
    expected = sum(min(len(model), len(candidates)) for candidates in images)
    triples = marker_triples(model)
    # The first triples in both pictures, then the others: any four markers of eight contain four triples.
    # Last, candidates that are not among the first: other lights may be brighter than the markers.
    parts = (
        (triples[:_FIRST_TRIPLES], _MOST_CANDIDATES),
        (triples[_FIRST_TRIPLES:], _MOST_CANDIDATES),
        (triples[:_LAST_TRIPLES], _MORE_CANDIDATES),
    )
    for c, (some, most) in [(c, part) for part in parts for c in (0, 1)]:
        if c == 0 and any(explains_a_picture(f, model, images) for f in found):
            break  # a camera that contradicts is not reconciled by other triples
        if most > _MOST_CANDIDATES >= len(ranked[c]):
            continue  # no further ones
        poses = _hypotheses(pair, model, images[c], ranked[c][:most], c, some)
        tried += len(poses.translation)
        fits = [
            labelled_pose(pair, model, images, pose, near_pose(pose), p) for pose in _best(pair, model, images, poses)
        ]
        found += [fit for fit in fits if fit is not None]
        found = distinct(found)
        enough = found and (found[0].index >= 0).sum() >= _ENOUGH * expected
        if enough and explains_a_picture(found[0], model, images):
            break  # four markers may lie as four others of the target do: then all triples are tried
    # The best of many hypotheses explains more by chance than a single one.
    return [replace(f, evidence=f.evidence - np.log(max(tried, 1))) for f in found]


def explains_a_picture(found: LabelledPose, model: MarkerModel, images: Images) -> bool:
    """Whether a pose explains nearly all candidates of one picture, or all its markers, and that not by chance.

    Three candidates give a pose, and among hundreds of hypotheses one explains a fourth one by chance.
    """
    explained = (found.index >= 0).sum(axis=1)
    return any(
        n >= max(_ENOUGH * min(len(model), len(own)), _BY_CHANCE + 1) for n, own in zip(explained, images, strict=True)
    )


def distinct(found: list[LabelledPose]) -> list[LabelledPose]:
    """The different poses, the best first."""
    kept: list[LabelledPose] = []
    for candidate in sorted(found, key=lambda f: -f.score):
        if not any(same_pose(candidate.fit.world_from_body, other.fit.world_from_body) for other in kept):
            kept.append(candidate)
    return kept


def same_pose(one: Pose, other: Pose) -> bool:
    """Whether two poses are the same solution."""
    shift = float(np.linalg.norm(one.translation - other.translation))
    near = shift < _SAME_SHARE * (1 + float(np.linalg.norm(one.translation)))  # cheaper, and mostly decides
    return near and float(angle(one.rotation.T @ other.rotation)) < _SAME_RAD


def mirrored(pair: StereoPair, model: MarkerModel, pose: Pose) -> Pose:
    """The pose of a flat target with nearly the same images: its normal is reflected at the line of sight.

    Seen from far away, a flat target has two attitudes with almost equal images. Source: ours; Schweighofer & Pinz
    (2006), "Robust pose estimation from a planar target", IEEE Trans. PAMI 28, describe the ambiguity.
    """
    normal = pose.rotation @ model.normal
    eye = np.mean([c.camera_from_world.inverse().translation for c in pair.cameras], axis=0)
    middle = pose.apply(model.positions.mean(axis=0))
    sight = (middle - eye) / np.linalg.norm(middle - eye)
    # Two reflections: at the plane across the normal, and at the one across its image; together a rotation.
    image = 2 * (sight @ normal) * sight - normal
    half = normal + image if normal @ image > -0.999999 else sight
    half = half / np.linalg.norm(half)
    turn = (2 * np.outer(half, half) - np.eye(3)) @ (2 * np.outer(normal, normal) - np.eye(3))
    rotation = turn @ pose.rotation
    return Pose(rotation, middle - rotation @ model.positions.mean(axis=0))


def near_pose(pose: Pose) -> Array:
    """Covariance (6, 6) of a pose from three noisy candidates: a few pixels for any focal length."""
    distance = float(np.linalg.norm(pose.translation))
    sideways, turn = 0.002 * distance, 0.03
    along = 0.02 * distance
    sight = pose.translation / max(distance, 1e-12)
    out = np.zeros((6, 6))
    out[:3, :3] = sideways**2 * np.eye(3) + along**2 * np.outer(sight, sight)
    out[3:, 3:] = turn**2 * np.eye(3)
    return out


def _ranked(candidates: MarkerImages, has_partner: Bools) -> Ints:
    """The candidates for triples: those with a partner first, then the larger ones."""
    area = np.nan_to_num(candidates.area_px2, nan=0.0)
    return np.lexsort((-area, ~has_partner))[:_MORE_CANDIDATES].astype(np.int64)


def marker_triples(model: MarkerModel) -> list[tuple[int, int, int]]:
    """Triples of markers, those of large area and of different markers first."""
    triples = list(combinations(range(len(model)), 3))
    x = model.positions
    area = {t: float(np.linalg.norm(np.cross(x[t[1]] - x[t[0]], x[t[2]] - x[t[0]]))) for t in triples}
    usable = [t for t in triples if area[t] > 1e-3 * max(area.values())]
    chosen: list[tuple[int, int, int]] = []
    used = np.zeros(len(model))
    while usable and len(chosen) < _MOST_TRIPLES:
        # Large triangles of markers that few chosen triples have.
        best = max(usable, key=lambda t: area[t] / (1.0 + used[list(t)].sum()))
        chosen.append(best)
        usable.remove(best)
        used[list(best)] += 1
    return chosen


def _hypotheses(
    pair: StereoPair,
    model: MarkerModel,
    found: MarkerImages,
    ranked: Ints,
    c: int,
    triples: Sequence[tuple[int, int, int]],
) -> Pose:
    """All poses (h), world_from_body, of triples of the ranked candidates of camera c and some triples of markers."""
    camera = pair.cameras[c]
    if len(ranked) < 3 or not triples:
        return Pose(np.zeros((0, 3, 3)), np.zeros((0, 3)))
    eye, rays = camera.rays(found.uv_px)
    ordered = np.array(list(permutations(ranked.tolist(), 3)))
    some_rays, some_markers = [], []
    for triple in triples[: max(_FIRST_TRIPLES, _MOST_TRIED // len(ordered))]:
        fits = np.all(found.colour[ordered] == model.colour[list(triple)], axis=1)
        some_rays.append(rays[ordered[fits]])
        some_markers.append(np.broadcast_to(model.positions[list(triple)], (int(fits.sum()), 3, 3)))
    all_rays, markers = np.concatenate(some_rays), np.concatenate(some_markers)
    good = np.isfinite(all_rays).all(axis=(1, 2))
    origin = np.broadcast_to(eye, (3, 3))
    poses = poses_from_three_spots(origin, all_rays[good], markers[good])
    solved: Bools = np.asarray(np.isfinite(poses.translation).all(axis=-1))
    return poses[solved].inverse()


def _best(pair: StereoPair, model: MarkerModel, images: Images, poses: Pose) -> list[Pose]:
    """The hypotheses that explain most candidates in both pictures, different ones."""
    if not len(poses.translation):
        return []
    flat = [undistorted_pixels(camera, found.uv_px) for camera, found in zip(pair.cameras, images, strict=True)]
    scores = np.concatenate(
        [_coarse(pair, model, flat, images, poses[i : i + _CHUNK]) for i in range(0, len(poses.translation), _CHUNK)]
    )
    kept: list[Pose] = []
    for i in np.argsort(-scores)[: 20 * _REFINED].tolist():
        if scores[i] < _REFINED_SHARE * scores.max() or len(kept) == _REFINED:
            break
        if not any(same_pose(poses[i], other) for other in kept):
            kept.append(poses[i])
    return kept


def _coarse(pair: StereoPair, model: MarkerModel, flat: Sequence[Array], images: Images, poses: Pose) -> Array:
    """Scores (h): the number of markers with a candidate of their colour near their projection, near ones more.

    flat: the candidates' pixels without distortion, so that thousands of poses are projected by pinhole cameras.
    """
    n = pair.numbers
    world = model.positions @ np.swapaxes(poses.rotation, -1, -2) + poses.translation[:, None]
    score = np.zeros(len(world))
    for c, (found, at) in enumerate(zip(images, flat, strict=True)):
        if not len(found):
            continue
        seen = world @ n.rotation[c].T + n.translation[c]
        with np.errstate(invalid="ignore", divide="ignore"):
            uv = np.where(seen[..., 2:] > 0, seen[..., :2] / seen[..., 2:], np.nan) * n.pinhole[c, 0, :2]
        uv += n.pinhole[c, 0, 2:]
        size = np.nan_to_num(np.ptp(uv, axis=1).max(axis=1))
        gate2 = (_COARSE_PX + _COARSE_SHARE * size)[:, None] ** 2
        nearest = np.full(uv.shape[:2], np.inf)
        for colour in np.unique(model.colour):
            own, same = np.flatnonzero(model.colour == colour), at[found.colour == colour]
            if len(same):
                du, dv = (uv[:, own, i, None] - same[:, i] for i in (0, 1))
                nearest[:, own] = np.nan_to_num((du * du + dv * dv).min(axis=2), nan=np.inf)
        score += np.maximum(0.0, 1 - nearest / gate2).sum(axis=1)
    return score
