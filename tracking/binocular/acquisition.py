"""The pose without a prediction: poses of three markers (P3P), tested against all candidates of both pictures.

Three candidates of one picture and three markers have up to four poses. Each is scored by the markers that it explains
in both pictures; the best ones are labelled and fitted. Candidates with an epipolar partner of the same colour in the
other picture come first. Source: ours, with the compiled solver geometry/pose_solver/three_spots.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, permutations

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.pose import Pose
from geometry.pose_solver.three_spots import poses_from_three_spots
from geometry.rotations import angle
from tracking.binocular.labelling import Images, LabelledPose, labelled_pose
from tracking.binocular.marker_model import MarkerImages, MarkerModel, StereoPair
from tracking.binocular.parameters import MatchParameters
from tracking.binocular.triangulation import triangulate, undistorted_pixels

_MOST_CANDIDATES = 12  # of a picture, in triples: 1,320 ordered ones
_FIRST_TRIPLES = 8  # of markers: enough where most of them are seen
_MOST_TRIPLES = 60  # of markers: all triples of eight
_MOST_TRIED = 20_000  # ordered triples of candidates times triples of markers, beyond the first triples
_REFINED, _REFINED_SHARE = 24, 0.6  # best hypotheses that are fitted: at most so many, of this share of the best score
_CHUNK = 4000  # hypotheses scored at once: 15 MB
_COARSE_PX, _COARSE_SHARE = 2.0, 0.04  # gate of the scoring: px, and share of the target's size in the picture
_SAME_RAD, _SAME_SHARE = np.deg2rad(6.0), 0.02  # poses that differ by less, the position relative to the distance
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
    expected = sum(min(len(model), len(candidates)) for candidates in images)
    triples = marker_triples(model)
    # The first triples in both pictures, then the others: any four markers of eight contain four triples.
    for c, some in [(c, part) for part in (triples[:_FIRST_TRIPLES], triples[_FIRST_TRIPLES:]) for c in (0, 1)]:
        if c == 0 and any(_explains_a_picture(f, model, images) for f in found):
            break  # a camera that contradicts is not reconciled by other triples
        poses = _hypotheses(pair, model, images[c], ranked[c], c, some)
        found += [
            fitted
            for pose in _best(pair, model, images, poses)
            if (fitted := labelled_pose(pair, model, images, pose, near_pose(pose), p)) is not None
        ]
        found = distinct(found)
        if found and (found[0].index >= 0).sum() >= _ENOUGH * expected:
            break
    return found


def _explains_a_picture(found: LabelledPose, model: MarkerModel, images: Images) -> bool:
    """Whether a pose explains nearly all candidates of one picture, or all its markers."""
    explained = (found.index >= 0).sum(axis=1)
    return any(n >= _ENOUGH * min(len(model), len(own)) > 0 for n, own in zip(explained, images, strict=True))


def distinct(found: list[LabelledPose]) -> list[LabelledPose]:
    """The different poses, the best first."""
    kept: list[LabelledPose] = []
    for candidate in sorted(found, key=lambda f: -f.score):
        if not any(same_pose(candidate.fit.pose, other.fit.pose) for other in kept):
            kept.append(candidate)
    return kept


def same_pose(one: Pose, other: Pose) -> bool:
    """Whether two poses are the same solution."""
    turn = float(angle(one.rotation.T @ other.rotation))
    shift = float(np.linalg.norm(one.translation - other.translation))
    return turn < _SAME_RAD and shift < _SAME_SHARE * (1 + float(np.linalg.norm(one.translation)))


def mirrored(pair: StereoPair, model: MarkerModel, pose: Pose) -> Pose:
    """The pose of a flat target with nearly the same images: its normal is reflected at the line of sight.

    Seen from far away, a flat target has two attitudes with almost equal images. Source: ours; Schweighofer & Pinz
    (2006), "Robust pose estimation from a planar target", IEEE Trans. PAMI 28, describe the ambiguity.
    """
    centred = model.positions - model.positions.mean(axis=0)
    normal = pose.rotation @ np.linalg.svd(centred)[2][-1]
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
    return np.lexsort((-area, ~has_partner))[:_MOST_CANDIDATES].astype(np.int64)


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
                apart = uv[:, own, None] - same
                nearest[:, own] = np.nan_to_num((apart * apart).sum(axis=-1).min(axis=2), nan=np.inf)
        score += np.maximum(0.0, 1 - nearest / gate2).sum(axis=1)
    return score
