"""Where a camera stands, from points that it sees: a start for an adjustment that wrong points do not spoil.

Perspective-n-point solvers of OpenCV on few points at a time (Fischler and Bolles 1981, "Random sample consensus");
both of a plane's two poses are tried (Collins and Bartoli 2014, "Infinitesimal plane-based pose estimation").
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

from geometry.arrays import Array, Bools, Ints, normalised
from geometry.camera import FISHEYE, Camera, pinhole_numbers, project_points
from geometry.lens import padded
from geometry.pose import Pose

FEWEST = 4  # points: three leave up to four poses
_COPLANAR = 0.01  # of the middle extent: flatter sets are taken for planes
_ON_A_LINE = 0.02  # of the largest extent: narrower sets are taken for lines
_POLISHED = 12  # of the poses tried, the best ones: outliers can make a wrong one look better at first
_MOST_SETS = 80  # of four points tried: with a third of the points wrong one in five is good, none with 0.8^80 = 1e-8


@dataclass(frozen=True, slots=True)
class Place:
    """One pose that explains most points."""

    camera_from_world: Pose
    errors_px: Array  # (n,): distance of each point from where it should be; inf behind the camera
    fits: Bools  # (n,): which points it explains
    rms_px: float  # of those


def places(camera: Camera, points: Array, pixels: Array, within_px: float) -> list[Place]:
    """Poses of a camera from points (n, 3), m, of world and their pixels (n, 2), the best first; at most two.

    within_px: how far a right point's pixel may lie from where the pose puts it. A second pose is given where it
    explains as many points: few points of a plane, seen small, leave two. Empty where nothing is found. ValueError
    where the points cannot tell: fewer than four, or on one line.
    """
    if len(points) < FEWEST:
        raise ValueError(f"{len(points)} points, expected {FEWEST} or more")
    if on_a_line(points):
        raise ValueError("all points lie on one line")
    xy = normalised_image(camera, pixels)
    known: Bools = np.asarray(np.isfinite(xy).all(axis=1))
    polished: list[Place] = []
    for stage in (_all_known(known), _sets_of_four(points, known)):
        # Where all points agree no four of them need to be tried: a tenth of the time.
        if polished and min(polished, key=_rank).fits.all():
            break
        tried: list[Place] = []
        for some in stage:
            tried += [_judged(camera, pose, points, pixels, within_px) for pose in _solutions(points[some], xy[some])]
        best = sorted(tried, key=_rank)[:_POLISHED]
        polished += [_polished(camera, start, points, pixels, xy, within_px) for start in best]
    polished.sort(key=_rank)
    out: list[Place] = []
    for p in polished:
        if np.sum(p.fits) < FEWEST or (out and np.sum(p.fits) < np.sum(out[0].fits)):
            continue
        if all(_apart(p, q, points) for q in out) and len(out) < 2:
            out.append(p)
    return out


def normalised_image(camera: Camera, pixels: Array) -> Array:
    """X/Z, Y/Z (n, 2) of the rays of pixels (n, 2) in the camera's own frame; nan where the lens maps nothing there."""
    rays = replace(camera, camera_from_world=Pose.identity()).rays(pixels)[1]
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(rays[:, 2:] > 1e-3, rays[:, :2] / rays[:, 2:], np.nan)


def on_a_line(points: Array) -> bool:
    """Whether points (n, 3) lie on one line, or all in one place."""
    s = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(len(s) < 2 or s[1] <= _ON_A_LINE * s[0])


def _all_known(known: Bools) -> Iterator[Ints]:
    """All points at once."""
    if known.sum() >= FEWEST:
        yield np.flatnonzero(known)


def _sets_of_four(points: Array, known: Bools) -> Iterator[Ints]:
    """Sets of four points that do not lie on a line: all sets, or so many by chance."""
    usable = np.flatnonzero(known)
    combinations = list(itertools.combinations(range(len(usable)), FEWEST)) if len(usable) <= 9 else None
    rng = np.random.default_rng(0)
    if combinations is None:
        combinations = [tuple(rng.choice(len(usable), FEWEST, replace=False).tolist()) for _ in range(_MOST_SETS)]
    elif len(combinations) > _MOST_SETS:
        order = rng.permutation(len(combinations))[:_MOST_SETS]
        combinations = [combinations[int(i)] for i in order]
    for chosen in combinations:
        some = usable[list(chosen)]
        if not on_a_line(points[some]):
            yield some


def _solutions(points: Array, xy: Array) -> list[Pose]:
    """Poses of a pinhole of focal length 1 that sees points (n, 3) at xy (n, 2)."""
    middle = points.mean(axis=0)
    _, s, axes = np.linalg.svd(points - middle, full_matrices=True)
    axes = axes * np.sign(np.linalg.det(axes))
    # About their middle and by their size: a survey's coordinates can be kilometres, the solvers' limits are absolute.
    size = s[0] / np.sqrt(len(points))
    own = (points - middle) @ axes.T / size
    method = cv2.SOLVEPNP_SQPNP
    if len(s) < 3 or s[2] < _COPLANAR * s[1]:
        method, own[:, 2] = cv2.SOLVEPNP_IPPE, 0.0  # which takes points a thousandth off a plane for none of its kind
    try:
        answer = cv2.solvePnPGeneric(own.reshape(-1, 1, 3), xy.reshape(-1, 1, 2), np.eye(3), None, flags=method)
    except cv2.error:
        return []
    out = []
    for rvec, tvec in zip(answer[1], answer[2], strict=True):
        R = np.asarray(cv2.Rodrigues(np.asarray(rvec, dtype=float))[0], dtype=float) @ axes
        t = np.asarray(tvec, dtype=float).ravel() * size - R @ middle
        if np.isfinite(R).all() and np.isfinite(t).all():
            out.append(Pose(R, t))
    return out


def _judged(camera: Camera, pose: Pose, points: Array, pixels: Array, within_px: float) -> Place:
    # As camera.project, without a new camera for each of hundreds of poses.
    seen, _ = project_points(
        pose.apply(points),
        pinhole_numbers(camera),
        padded(camera.distortion),
        np.asarray(camera.fold_r2),
        np.asarray(camera.lens == FISHEYE),
    )
    away = np.linalg.norm(seen - pixels, axis=1)
    errors = np.where(np.isfinite(away), away, np.inf)
    fits = errors < within_px
    rms = float(np.sqrt(np.mean(errors[fits] ** 2))) if fits.any() else float("inf")
    return Place(pose, errors, fits, rms)


def _polished(camera: Camera, start: Place, points: Array, pixels: Array, xy: Array, within_px: float) -> Place:
    """Least squares over the points that fit, until these stay the same. Starts with the nearer half at least."""
    best = start
    for _ in range(5):
        nearest = np.argsort(best.errors_px)[: max(FEWEST, len(points) // 2)]
        some = np.union1d(np.flatnonzero(best.fits), nearest)
        some = some[np.isfinite(xy[some]).all(axis=1) & np.isfinite(best.errors_px[some])]
        if len(some) < FEWEST:
            break
        middle = points[some].mean(axis=0)
        size = float(np.max(np.abs(points[some] - middle)))
        R0, t0 = best.camera_from_world.rotation, best.camera_from_world.apply(middle)
        try:
            rvec, tvec = cv2.solvePnPRefineLM(
                ((points[some] - middle) / size).reshape(-1, 1, 3),
                xy[some].reshape(-1, 1, 2),
                np.eye(3),
                None,
                cv2.Rodrigues(R0)[0].astype(float),
                (t0 / size).reshape(3, 1).astype(float),
            )
        except cv2.error:
            break
        R = np.asarray(cv2.Rodrigues(rvec)[0], dtype=float)
        if not (np.isfinite(R).all() and np.isfinite(tvec).all()):
            break
        new = _judged(camera, Pose(R, tvec.ravel() * size - R @ middle), points, pixels, within_px)
        if _rank(new) >= _rank(best):
            break
        best = new
    return best


def _rank(place: Place) -> tuple[int, float]:
    """Smaller is better: more points explained, then less error."""
    return -int(np.sum(place.fits)), place.rms_px


def _apart(a: Place, b: Place, points: Array) -> bool:
    """Whether two poses are not one found twice: the camera stands elsewhere by a hundredth of its distance."""
    centres = [p.camera_from_world.inverse().translation for p in (a, b)]
    distance = np.linalg.norm(centres[0] - points.mean(axis=0))
    turned = normalised(a.camera_from_world.rotation[2]) @ normalised(b.camera_from_world.rotation[2])
    return bool(np.linalg.norm(centres[0] - centres[1]) > 0.01 * distance or turned < 0.999)
