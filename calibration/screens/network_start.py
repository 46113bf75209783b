"""Start values of a network: robust resections, chained to poses of cameras, boards and screens in one world."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np

from calibration.screens.network import Network, Start
from geometry.arrays import Array, Bools, Ints, normalised
from geometry.camera import Camera, project_points
from geometry.pose import Pose

# Robust resection: the pose of a camera from points with outliers, as start value of an adjustment.
#
# OpenCV's perspective-n-point solvers on small sets of points (Fischler and Bolles 1981, "Random sample consensus");
# both poses of coplanar points are tried (Collins and Bartoli 2014, "Infinitesimal plane-based pose estimation").

FEWEST = 4  # points: three allow up to four poses
_COPLANAR = 0.01  # third over second extent, below which a set counts as coplanar
_COLLINEAR = 0.02  # second over largest extent, below which a set counts as collinear
_REFINED = 12  # best poses that are refined: with outliers the right one need not be first
_MOST_SETS = 80  # sets of four points: with a third of outliers, one in five is free of them, and none is with 0.8^80


@dataclass(frozen=True, slots=True)
class ResectedPose:
    """A pose with its inliers."""

    camera_from_world: Pose
    errors_px: Array  # (n,): reprojection error of each point; inf behind the camera
    inliers: Bools  # (n,): inliers
    rms_px: float  # of the inliers


def resect(camera: Camera, points: Array, pixels: Array, within_px: float) -> list[ResectedPose]:
    """Poses of a camera from points (n, 3), m, in world and their pixels (n, 2), the best first; at most two.

    within_px: largest reprojection error of an inlier. A second pose is returned if it has as many inliers, as with few
    coplanar points that appear small in the picture. Empty if no pose is found. Raises ValueError: fewer than four
    points, or all on one line.
    """
    if len(points) < FEWEST:
        raise ValueError(f"{len(points)} points, expected {FEWEST} or more")
    if are_collinear(points):
        raise ValueError("all points lie on one line")
    xy = normalised_image(camera, pixels)
    known: Bools = np.asarray(np.isfinite(xy).all(axis=1))
    refined: list[ResectedPose] = []
    for stage in (_all_known(known), _sets_of_four(points, known)):
        # If all points are inliers, sets of four are not tried, which takes a tenth of the time.
        if refined and min(refined, key=_rank).inliers.all():
            break
        tried: list[ResectedPose] = []
        for some in stage:
            tried += [
                _evaluated(camera, pose, points, pixels, within_px) for pose in _solutions(points[some], xy[some])
            ]
        best = sorted(tried, key=_rank)[:_REFINED]
        refined += [_refined(camera, start, points, pixels, xy, within_px) for start in best]
    refined.sort(key=_rank)
    out: list[ResectedPose] = []
    for p in refined:
        if np.sum(p.inliers) < FEWEST or (out and np.sum(p.inliers) < np.sum(out[0].inliers)):
            continue
        if all(_are_distinct(p, q, points) for q in out) and len(out) < 2:
            out.append(p)
    return out


def normalised_image(camera: Camera, pixels: Array) -> Array:
    """X/Z, Y/Z (n, 2) of the rays of pixels (n, 2) in the camera frame; nan where the lens has no ray."""
    rays = replace(camera, camera_from_world=Pose.identity()).rays(pixels)[1]
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(rays[:, 2:] > 1e-3, rays[:, :2] / rays[:, 2:], np.nan)


def are_collinear(points: Array) -> bool:
    """Whether points (n, 3) are collinear or coincide."""
    s = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(len(s) < 2 or s[1] <= _COLLINEAR * s[0])


def _all_known(known: Bools) -> Iterator[Ints]:
    """All points at once."""
    if known.sum() >= FEWEST:
        yield np.flatnonzero(known)


def _sets_of_four(points: Array, known: Bools) -> Iterator[Ints]:
    """Sets of four points that are not collinear: all of them, or a random selection."""
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
        if not are_collinear(points[some]):
            yield some


def _solutions(points: Array, xy: Array) -> list[Pose]:
    """Poses of a pinhole camera of focal length 1 from points (n, 3) at xy (n, 2)."""
    middle = points.mean(axis=0)
    _, s, axes = np.linalg.svd(points - middle, full_matrices=True)
    axes = axes * np.sign(np.linalg.det(axes))
    # Centred and scaled: a survey's coordinates may be kilometres, and the solvers have absolute thresholds.
    size = s[0] / np.sqrt(len(points))
    own = (points - middle) @ axes.T / size
    method = cv2.SOLVEPNP_SQPNP
    if len(s) < 3 or s[2] < _COPLANAR * s[1]:
        method, own[:, 2] = cv2.SOLVEPNP_IPPE, 0.0  # IPPE rejects points a thousandth off a plane
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


def _evaluated(camera: Camera, pose: Pose, points: Array, pixels: Array, within_px: float) -> ResectedPose:
    # As camera.project, without creating a camera for each of hundreds of poses.
    seen, _ = project_points(pose.apply(points), *camera.lens_numbers)
    distances = np.linalg.norm(seen - pixels, axis=1)
    errors = np.where(np.isfinite(distances), distances, np.inf)
    inliers = errors < within_px
    rms = float(np.sqrt(np.mean(errors[inliers] ** 2))) if inliers.any() else float("inf")
    return ResectedPose(pose, errors, inliers, rms)


def _refined(
    camera: Camera, start: ResectedPose, points: Array, pixels: Array, xy: Array, within_px: float
) -> ResectedPose:
    """Least squares over the inliers, repeated until they do not change. At least the better half is used."""
    best = start
    for _ in range(5):
        nearest = np.argsort(best.errors_px)[: max(FEWEST, len(points) // 2)]
        some = np.union1d(np.flatnonzero(best.inliers), nearest)
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
        new = _evaluated(camera, Pose(R, tvec.ravel() * size - R @ middle), points, pixels, within_px)
        if _rank(new) >= _rank(best):
            break
        best = new
    return best


def _rank(place: ResectedPose) -> tuple[int, float]:
    """Sort key: more inliers, then the smaller error."""
    return -int(np.sum(place.inliers)), place.rms_px


def _are_distinct(a: ResectedPose, b: ResectedPose, points: Array) -> bool:
    """Whether two poses are distinct: the centres differ by a hundredth of the distance, or the axes by 2.6 deg."""
    centres = [p.camera_from_world.inverse().translation for p in (a, b)]
    distance = np.linalg.norm(centres[0] - points.mean(axis=0))
    turned = normalised(a.camera_from_world.rotation[2]) @ normalised(b.camera_from_world.rotation[2])
    return bool(np.linalg.norm(centres[0] - centres[1]) > 0.01 * distance or turned < 0.999)


@dataclass(frozen=True, slots=True)
class CameraOnDots:
    """Poses of one camera from its surveyed dots."""

    poses: tuple[ResectedPose, ...]  # the best first; two if the dots allow two
    problem: str = ""  # the reason if there is none


@dataclass(frozen=True, slots=True)
class ChainedPoses:
    """Poses of all cameras, boards and screens in one world."""

    camera_from_world: Mapping[int, Pose]
    world_from_board: Mapping[int, Pose]
    world_from_screen: Mapping[int, Pose]  # only from boards fixed to screens; those from dots are separate


class NotConnectedError(ValueError):
    """Parts of a network are not connected. The message lists them."""


def camera_on_dots(network: Network, camera: int, within_px: float) -> CameraOnDots:
    """Poses of one camera from the dots that it observes."""
    s = network.point_observations
    mine = np.flatnonzero(s.camera_of == camera)
    if len(mine) < FEWEST:
        return CameraOnDots((), f"sees {len(mine)} surveyed dots, expected {FEWEST} or more")
    points = network.control_points.xyz[s.point_of[mine]]
    if are_collinear(points):
        return CameraOnDots((), f"sees {len(mine)} surveyed dots that all lie on one line")
    found = resect(list(network.rig.cameras.values())[camera], points, s.pixels[mine], within_px)
    return CameraOnDots(tuple(found), "" if found else "has no pose that fits four of the surveyed dots that it sees")


def chain(
    network: Network,
    poses_by_camera: Mapping[int, Pose],
    boards: Mapping[tuple[int, int], Pose],
    held_screen: int | None = None,
    problems: Mapping[int, str] | None = None,
) -> ChainedPoses:
    """Propagate poses from the world to every camera and board.

    on_dots: camera -> camera_from_world by surveyed dots; boards: (camera, placement) -> camera_from_board. Without a
    survey the world is the frame of held_screen. problems: camera -> why its dots give no pose. Raises
    NotConnectedError: some cameras are not connected with the others.
    """
    cameras: dict[int, Pose] = dict(poses_by_camera)
    placed: dict[int, Pose] = {}
    screens: dict[int, Pose] = {}
    fixed = (
        {}
        if network.fixed is None
        else {
            int(p): (int(s), _screen_from_board(network.fixed.middle[i], float(network.fixed.offset_m[i])))
            for i, (p, s) in enumerate(zip(network.fixed.placement_of, network.fixed.screen_of, strict=True))
        }
    )
    if not cameras and held_screen is not None:
        screens[held_screen] = Pose.identity()
    while True:
        before = len(cameras) + len(placed) + len(screens)
        for p, (s, screen_from_board) in fixed.items():
            # The pose of a board that a camera with a known pose sees is more accurate from there.
            if s in screens and p not in placed and not any(seen == p and c in cameras for c, seen in boards):
                placed[p] = screens[s] @ screen_from_board
            elif p in placed and s not in screens:
                screens[s] = placed[p] @ screen_from_board.inverse()
        for (c, p), camera_from_board in boards.items():
            if c in cameras and p not in placed:
                placed[p] = cameras[c].inverse() @ camera_from_board
            elif p in placed and c not in cameras:
                cameras[c] = camera_from_board @ placed[p].inverse()
        if len(cameras) + len(placed) + len(screens) == before:
            break
    names = list(network.rig.cameras)
    lost = [n for i, n in enumerate(names) if i not in cameras]
    if lost:
        reached = [n for i, n in enumerate(names) if i in cameras]
        why = [f"camera {names[c]!r} {words}" for c, words in (problems or {}).items() if c not in cameras and words]
        raise NotConnectedError("; ".join([_unconnected(lost, reached, boards, names), *why]))
    return ChainedPoses(cameras, placed, screens)


def start_of(
    network: Network,
    chained: ChainedPoses,
    frames: Mapping[int, Pose],
    bow: Array,
    held_board: int | None = None,
) -> Start:
    """The start values of an adjustment. frames: screen -> world_from_screen from its dots or its scan.

    held_board: board whose pose is fixed if there is no survey. Raises NotConnectedError: a screen or a board has no
    pose.
    """
    screens = {**chained.world_from_screen, **frames}
    names = list(network.rig.screens)
    missing = [n for i, n in enumerate(names) if i not in screens]
    if missing:
        raise NotConnectedError(
            f"screen {missing[0]!r}: expected three or more surveyed dots, a board fixed to it or a scan, found none;"
            " assign dots to it in the survey's column `screen`"
        )
    order = sorted(chained.world_from_board)
    if order != list(range(len(network.placements))):
        lost = [p for i, p in enumerate(network.placements) if i not in chained.world_from_board]
        raise NotConnectedError(f"board at {lost[0]!r}: it is not seen by any camera of the network")
    return Start(
        camera_from_world=Pose.stack(chained.camera_from_world[i] for i in range(len(network.rig.cameras))),
        world_from_screen=Pose.stack(screens[i] for i in range(len(names))),
        world_from_board=Pose.stack(chained.world_from_board[i] for i in order),
        bow=bow,
        held_board=held_board,
    )


def boards_seen(network: Network, within_px: float) -> dict[tuple[int, int], Pose]:
    """camera_from_board by (camera, placement), for every view of a board with four or more corners."""
    corners = network.corners
    out: dict[tuple[int, int], Pose] = {}
    if corners is None:
        return out
    cameras = list(network.rig.cameras.values())
    for c, p in sorted(set(zip(corners.camera.tolist(), corners.placement.tolist(), strict=True))):
        mine = np.flatnonzero((corners.camera == c) & (corners.placement == p))
        if len(mine) < FEWEST or are_collinear(corners.points[mine]):
            continue
        found = resect(cameras[c], corners.points[mine], corners.pixels[mine], within_px)
        if found:
            out[c, p] = found[0].camera_from_world
    return out


def _screen_from_board(middle: Array, offset_m: float) -> Pose:
    """Pose of a board in the frame of the screen that it defines: origin below its middle, x along its x, z out."""
    R = np.diag([1.0, -1.0, -1.0])
    return Pose(R, np.array([0.0, 0.0, offset_m]) - R @ middle)


def _unconnected(lost: list[str], reached: list[str], boards: Mapping[tuple[int, int], Pose], names: list[str]) -> str:
    """Groups of cameras without connections to the others, in words."""
    group = {n: {n} for n in lost}
    for placement in {p for _, p in boards}:
        together = [names[c] for c, p in boards if p == placement and names[c] in group]
        merged: set[str] = set().union(*(group[n] for n in together)) if together else set()
        for n in merged:
            group[n] = merged
    parts = sorted({tuple(sorted(g)) for g in group.values()})
    words = "; ".join(f"{_listed(p)} {'is' if len(p) == 1 else 'are'} not connected with the others" for p in parts)
    rest = f" ({_listed(tuple(reached))} have a pose)" if reached else ""
    return (
        f"camera {words}{rest}: give each of them four surveyed dots, or a photograph of a board that another camera"
        " sees at the same position"
    )


def _listed(names: tuple[str, ...]) -> str:
    return ", ".join(repr(n) for n in names)
