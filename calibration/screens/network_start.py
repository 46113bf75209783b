"""Start values of a network: poses of cameras, boards and screens in one world, by chaining relative poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calibration.screens.network import Network, Start
from calibration.screens.resection import FEWEST, ResectedPose, are_collinear, resect
from geometry.arrays import Array
from geometry.pose import Pose

WORLD = "the survey"


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
    held_camera: int | None = None,
    problems: Mapping[int, str] | None = None,
) -> ChainedPoses:
    """Propagate poses from the world to every camera and board.

    on_dots: camera -> camera_from_world by surveyed dots; boards: (camera, placement) -> camera_from_board. Without a
    survey the world is the frame of held_screen or else of held_camera. problems: camera -> why its dots give no pose.

    Raises:
        NotConnectedError: some cameras are not connected with the others.
    """
    cameras: dict[int, Pose] = dict(poses_by_camera)
    if not cameras and held_camera is not None:
        cameras[held_camera] = Pose.identity()
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
            if s in screens and p not in placed and not _is_observed(boards, p, cameras):
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
    held_camera: int | None = None,
    held_board: int | None = None,
) -> Start:
    """The start values of an adjustment. frames: screen -> world_from_screen from its dots or its scan.

    held_camera, held_board: element whose pose is fixed if there is no survey.

    Raises:
        NotConnectedError: a screen or a board has no pose.
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
        camera_from_world=_stack([chained.camera_from_world[i] for i in range(len(network.rig.cameras))]),
        world_from_screen=_stack([screens[i] for i in range(len(names))]),
        world_from_board=_stack([chained.world_from_board[i] for i in order]),
        bow=bow,
        held_camera=held_camera,
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


def _is_observed(boards: Mapping[tuple[int, int], Pose], placement: int, cameras: Mapping[int, Pose]) -> bool:
    """Whether a camera with a known pose sees the board, from which the board's pose is more accurate."""
    return any(p == placement and c in cameras for c, p in boards)


def _stack(poses: list[Pose]) -> Pose:
    return Pose(
        np.array([p.rotation for p in poses], dtype=float).reshape(-1, 3, 3),
        np.array([p.translation for p in poses], dtype=float).reshape(-1, 3),
    )


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
