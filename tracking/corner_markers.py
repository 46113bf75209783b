"""Corners of lamps in a picture (Harris), and the pose that explains them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.forward_model import MarkerModel
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import PoseFit, fit_pose
from tracking.detections import UNMATCHED
from tracking.noise import Picture

# Corners by the Harris method, with the response and the window of Fu (2016).
#
# Source: Fu et al. (2016), eqs. (6) and (7); the response det(M) / (tr(M) + epsilon) is Noble's form, "Finding
# corners", Image and Vision Computing 6(2), 1988, of Harris & Stephens (1988).

GROUND_PERCENTILE = 95.0  # of the window's edge: above the noise of the sky, below a neighbouring lamp
LEAST_LIGHT_DN = 12.0  # of a lamp above it


@dataclass(frozen=True, slots=True)
class HarrisParameters:
    """Finding corners in one picture."""

    window_px: int = 5  # side of the Gaussian window; the paper: 5
    threshold_sigma: float = 40.0  # least response, in multiples of its median, which noise and sky determine
    threshold_share: float = 0.01  # ... and as a share of the largest response
    most: int = 60  # corners that are kept; the strongest
    bright: bool = True  # only corners brighter than their surroundings: markers are lamps
    centroid_px: int = 3  # half side of the window in which a lamp's centroid is measured


@dataclass(frozen=True, slots=True)
class Corners:
    """n corners of a picture, strongest first."""

    uv_px: Array  # (n, 2) centroid of the light around the corner
    response: Array  # (n,) eq. (7), DN^2

    def __len__(self) -> int:
        return len(self.uv_px)


def harris_response(picture: Picture, window_px: int = 5) -> Array:
    """The response det(M) / (tr(M) + epsilon) of every pixel (h, w), DN^2.

    M is the window's mean of the products of the first derivatives; eq. (6) prints the elements without the mean.
    """
    grey = picture.astype(np.float32)
    du = cv2.Sobel(grey, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
    dv = cv2.Sobel(grey, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8)
    side = (window_px, window_px)
    uu, uv, vv = (cv2.GaussianBlur(product, side, 0) for product in (du * du, du * dv, dv * dv))
    return np.asarray((uu * vv - uv * uv) / (uu + vv + 1e-6), dtype=float)


def harris_corners(picture: Picture, parameters: HarrisParameters | None = None) -> Corners:
    """The corners of a picture (h, w): local maxima of the response above the threshold."""
    p = HarrisParameters() if parameters is None else parameters
    response = harris_response(picture, p.window_px)
    limit = max(p.threshold_sigma * float(np.median(response)), p.threshold_share * float(response.max()), 1e-9)
    peaks = (response >= cv2.dilate(response, np.ones((p.window_px, p.window_px)))) & (response > limit)
    margin = p.centroid_px + 1
    peaks[:margin], peaks[-margin:], peaks[:, :margin], peaks[:, -margin:] = False, False, False, False
    v, u = np.nonzero(peaks)
    order = np.argsort(-response[v, u], kind="stable")
    v, u = v[order], u[order]
    places, good = _centroids(picture, u, v, p.centroid_px)
    if p.bright:
        places, u, v = places[good], u[good], v[good]
    return Corners(places[: p.most], response[v, u][: p.most])


def _centroids(picture: Picture, u: np.ndarray, v: np.ndarray, half: int) -> tuple[Array, np.ndarray]:
    """Centroids (n, 2) of the light above the window's edge, and whether the middle is brighter than the edge.

    The level is a high percentile of the edge: a lamp in front of a darker body has bright sky on one side only. Where
    the middle is not brighter, the corner's own pixel is its place.
    """
    offsets = np.arange(-half, half + 1)
    windows = picture[(v[:, None, None] + offsets[:, None]), (u[:, None, None] + offsets)].astype(float)
    edge = np.ones((len(offsets), len(offsets)), dtype=bool)
    edge[1:-1, 1:-1] = False
    ground = np.percentile(windows[:, edge], GROUND_PERCENTILE, axis=1)
    light = np.maximum(windows - ground[:, None, None], 0.0)
    total = light.sum(axis=(1, 2))
    good = (windows[:, half, half] > ground + LEAST_LIGHT_DN) & (total > 0)
    safe = np.where(total > 0, total, 1.0)
    du = (light * offsets).sum(axis=(1, 2)) / safe
    dv = (light * offsets[:, None]).sum(axis=(1, 2)) / safe
    centre = np.stack([u, v], -1).astype(float)
    return np.where(good[:, None], centre + np.stack([du, dv], -1), centre), good


# Which corner is which marker, and the pose: RANSAC over three-point poses, then a fit to all inliers.
#
# Source: Fischler & Bolles, "Random sample consensus", Comm. ACM 24(6), 1981; the three-point pose is OpenCV's
# solveP3P. Fu (2016), section 2, names RANSAC without its model; a rigid body with known markers is the model here.


DENSITY_PX = 40.0  # radius around a marker in which the density of corners is counted


@dataclass(frozen=True, slots=True)
class MatchParameters:
    """Assigning corners to markers."""

    gate_px: float = 25.0  # distance from the predicted marker within which its corner is searched
    inlier_px: float = 1.5  # largest distance between a corner and a marker of a pose
    least_inliers: int = 4  # three markers fit any corners exactly: a fourth must agree
    iterations: int = 300  # samples of three corners
    most_accidental: float = 0.05  # expected number of accidental matches as good as the one found
    sigma_px: float = 0.15  # 1-sigma error of a corner, per coordinate
    within_rad: float = float(np.deg2rad(35.0))  # largest rotation from the expected attitude


@dataclass(frozen=True, slots=True)
class MarkerMatch:
    """The markers found in a picture."""

    rows: Ints  # (n,) the corner of each marker, or UNMATCHED
    fit: PoseFit  # pose with covariance, from all matched markers


def match_markers(
    model: MarkerModel,
    corners_px: Array,
    expected: Pose,
    rng: np.random.Generator,
    parameters: MatchParameters | None = None,
) -> MarkerMatch | None:
    """The markers among corners (k, 2), near where an expected pose puts them.

    None where fewer than `least_inliers` markers agree with one pose, where so many can agree by accident, or where two
    poses explain the corners equally well with different labels.
    """
    p = MatchParameters() if parameters is None else parameters
    predicted, _ = model.project(expected)
    n = len(model.markers)
    if np.isnan(predicted).any() or not len(corners_px):
        return None
    distance = np.linalg.norm(corners_px[None] - predicted[:, None], axis=-1)  # (n, k)
    near = distance <= p.gate_px
    accidental = _accidental_matches(near, (distance <= DENSITY_PX).sum(axis=1) - 1, p.inlier_px)
    usable = np.flatnonzero(near.any(axis=1))
    if len(usable) < p.least_inliers:
        return None
    found: dict[tuple[int, ...], tuple[int, float, Pose]] = {}  # labels -> inliers, squared residuals, pose
    tried: set[tuple[int, ...]] = set()
    for _ in range(p.iterations):
        three = np.sort(rng.choice(usable, 3, replace=False))
        picked = np.array([rng.choice(np.flatnonzero(near[i])) for i in three])
        sample = (*three.tolist(), *picked.tolist())
        if len(set(picked.tolist())) < 3 or sample in tried:
            continue
        tried.add(sample)
        for pose in _three_point_poses(model, three, corners_px[picked], expected, p.within_rad):
            rows, cost = _inliers(model, pose, corners_px, near, p.inlier_px)
            count = int(np.count_nonzero(rows != UNMATCHED))
            key = tuple(rows.tolist())
            enough = count >= p.least_inliers and accidental[count] <= p.most_accidental
            if enough and (key not in found or cost < found[key][1]):
                found[key] = (count, cost, pose)
        if any(count == n for count, _, _ in found.values()) and len(usable) == n and not _more_than_one(near):
            break
    fits = [f for key, (_, _, pose) in found.items() if (f := _fitted(model, np.array(key), corners_px, pose, p))]
    fits.sort(key=lambda m: (-np.count_nonzero(m.rows != UNMATCHED), m.fit.chi2))
    if not fits:
        return None
    best, count = fits[0], int(np.count_nonzero(fits[0].rows != UNMATCHED))
    rivals = [
        m for m in fits[1:] if np.count_nonzero(m.rows != UNMATCHED) == count and m.fit.chi2 < best.fit.chi2 + 9.0
    ]
    return None if rivals else best


def _accidental_matches(near: Bools, others: Ints, inlier_px: float) -> Array:
    """Expected number (n + 1,) of label sets of each size in which the corners agree by accident.

    near (n, k): candidates; others (n,): further corners around a marker, which give their density. Three corners agree
    with any pose; each further one lies within inlier_px of its marker with the density's probability. Source: ours.
    """
    n = len(near)
    candidates = float(np.mean(np.maximum(near.sum(axis=1), 1)))
    p_inlier = float(np.mean(np.maximum(others, 0))) * (inlier_px / DENSITY_PX) ** 2
    return np.array([math.comb(n, k) * candidates**k * p_inlier ** max(k - 3, 0) for k in range(n + 1)])


def _more_than_one(near: Bools) -> bool:
    return bool((near.sum(axis=1) > 1).any())


def _three_point_poses(
    model: MarkerModel, three: Ints, corners_px: Array, expected: Pose, within_rad: float
) -> list[Pose]:
    """world_from_body for three markers at three corners; those near the expected attitude."""
    _, rays = model.camera.rays(corners_px)
    camera_from_world = model.camera.camera_from_world
    flat = camera_from_world.turn(rays)
    xy = (flat[:, :2] / flat[:, 2:]).reshape(3, 1, 2)
    _, turns, shifts = cv2.solveP3P(model.markers[three].reshape(3, 1, 3), xy, np.eye(3), None, cv2.SOLVEPNP_P3P)
    out = []
    for turn, shift in zip(turns, shifts, strict=True):
        R = np.asarray(cv2.Rodrigues(turn)[0], dtype=float)
        pose = camera_from_world.inverse() @ Pose(R, np.asarray(shift, dtype=float).ravel())
        if np.isfinite(pose.translation).all() and np.linalg.norm(pose.minus(expected)[3:]) <= within_rad:
            out.append(pose)
    return out


def _inliers(model: MarkerModel, pose: Pose, corners_px: Array, near: Bools, inlier_px: float) -> tuple[Ints, float]:
    """The nearest corner of each marker (n,) within `inlier_px`, each corner once, and the sum of their squares."""
    projected, _ = model.project(pose)
    squared = np.sum((corners_px[None] - projected[:, None]) ** 2, axis=-1)
    squared = np.where(near & np.isfinite(squared), squared, np.inf)
    rows = np.full(len(projected), UNMATCHED)
    cost = 0.0
    for flat in np.argsort(squared, axis=None, kind="stable").tolist():
        i, k = divmod(flat, squared.shape[1])
        if squared[i, k] > inlier_px**2:
            break
        if rows[i] == UNMATCHED and k not in rows:
            rows[i], cost = k, cost + float(squared[i, k])
    return rows, cost


def _fitted(
    model: MarkerModel, rows: Ints, corners_px: Array, start: Pose, parameters: MatchParameters
) -> MarkerMatch | None:
    """The least-squares pose of the matched markers; None where it is not observable."""
    matched = np.flatnonzero(rows != UNMATCHED)
    cov = np.tile(parameters.sigma_px**2 * np.eye(2), (len(matched), 1, 1))
    fit = fit_pose(model, matched, corners_px[rows[matched]], cov, start)
    if fit is None or not fit.observable or np.abs(fit.residuals_px).max() > parameters.inlier_px:
        return None
    return MarkerMatch(rows, fit)
