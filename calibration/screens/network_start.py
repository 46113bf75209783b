"""Starts of a network: every camera, board and screen in one world, by chaining what shares points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calibration.screens.network import Network, Start
from calibration.screens.places import FEWEST, Place, on_a_line, places
from geometry.arrays import Array
from geometry.pose import Pose

WORLD = "the survey"


@dataclass(frozen=True, slots=True)
class CameraOnDots:
    """What the surveyed dots say of one camera's place."""

    places: tuple[Place, ...]  # the best first; a second one where the dots leave two
    problem: str = ""  # why there is none


@dataclass(frozen=True, slots=True)
class Chained:
    """Everything in one world."""

    camera_from_world: Mapping[int, Pose]
    world_from_board: Mapping[int, Pose]
    world_from_screen: Mapping[int, Pose]  # only those that a fixed board gave; dots give theirs apart


class NotConnectedError(ValueError):
    """Parts of a network that share nothing. The message names them."""


def camera_on_dots(network: Network, camera: int, within_px: float) -> CameraOnDots:
    """Poses of one camera by the dots that it sees."""
    s = network.sightings
    mine = np.flatnonzero(s.camera_of == camera)
    if len(mine) < FEWEST:
        return CameraOnDots((), f"sees {len(mine)} surveyed dots, expected {FEWEST} or more")
    points = network.dots.xyz[s.dot_of[mine]]
    if on_a_line(points):
        return CameraOnDots((), f"sees {len(mine)} surveyed dots that all lie on one line")
    found = places(list(network.rig.cameras.values())[camera], points, s.pixels[mine], within_px)
    return CameraOnDots(tuple(found), "" if found else "no place fits four of the surveyed dots that it sees")


def chain(
    network: Network,
    on_dots: Mapping[int, Pose],
    boards: Mapping[tuple[int, int], Pose],
    held_screen: int | None = None,
    held_camera: int | None = None,
    problems: Mapping[int, str] | None = None,
) -> Chained:
    """Walk from the world to every camera and board.

    on_dots: camera -> camera_from_world by surveyed dots; boards: (camera, placement) -> camera_from_board. Where there
    is no survey the world is held_screen's frame or else held_camera's. problems: camera -> why its dots give no place.
    Raises NotConnectedError: what shares nothing.
    """
    cameras: dict[int, Pose] = dict(on_dots)
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
            if s in screens and p not in placed and not _any_seen(boards, p, cameras):
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
        raise NotConnectedError("; ".join([_apart_in_words(lost, reached, boards, names), *why]))
    return Chained(cameras, placed, screens)


def start_of(
    network: Network,
    chained: Chained,
    frames: Mapping[int, Pose],
    bow: Array,
    held_camera: int | None = None,
    held_board: int | None = None,
) -> Start:
    """The chained poses as an adjustment's start. frames: screen -> world_from_screen by its dots or its scan.

    held_camera, held_board: which of them stays where it is, where there is no survey. Raises NotConnectedError for a
    screen that nothing was measured of.
    """
    screens = {**chained.world_from_screen, **frames}
    names = list(network.rig.screens)
    missing = [n for i, n in enumerate(names) if i not in screens]
    if missing:
        raise NotConnectedError(
            f"screen {missing[0]!r}: expected three or more surveyed dots, a board fixed to it or a scan, found none;"
            " name the dots that lie on it in the survey's column `screen`"
        )
    order = sorted(chained.world_from_board)
    if order != list(range(len(network.placements))):
        lost = [p for i, p in enumerate(network.placements) if i not in chained.world_from_board]
        raise NotConnectedError(f"board at {lost[0]!r}: no camera that sees it is in the network")
    return Start(
        camera_from_world=_stack([chained.camera_from_world[i] for i in range(len(network.rig.cameras))]),
        world_from_screen=_stack([screens[i] for i in range(len(names))]),
        world_from_board=_stack([chained.world_from_board[i] for i in order]),
        bow=bow,
        held_camera=held_camera,
        held_board=held_board,
    )


def boards_seen(network: Network, within_px: float) -> dict[tuple[int, int], Pose]:
    """camera_from_board (camera, placement) of every view of a board with four or more corners."""
    corners = network.corners
    out: dict[tuple[int, int], Pose] = {}
    if corners is None:
        return out
    cameras = list(network.rig.cameras.values())
    for c, p in sorted(set(zip(corners.camera.tolist(), corners.placement.tolist(), strict=True))):
        mine = np.flatnonzero((corners.camera == c) & (corners.placement == p))
        if len(mine) < FEWEST or on_a_line(corners.points[mine]):
            continue
        found = places(cameras[c], corners.points[mine], corners.pixels[mine], within_px)
        if found:
            out[c, p] = found[0].camera_from_world
    return out


def _screen_from_board(middle: Array, offset_m: float) -> Pose:
    """A board's place in the frame of the screen that it gives: the origin beneath its middle, x along its x, z up."""
    R = np.diag([1.0, -1.0, -1.0])
    return Pose(R, np.array([0.0, 0.0, offset_m]) - R @ middle)


def _any_seen(boards: Mapping[tuple[int, int], Pose], placement: int, cameras: Mapping[int, Pose]) -> bool:
    """Whether a camera that has its place sees the board: its place is then better known from there."""
    return any(p == placement and c in cameras for c, p in boards)


def _stack(poses: list[Pose]) -> Pose:
    return Pose(
        np.array([p.rotation for p in poses], dtype=float).reshape(-1, 3, 3),
        np.array([p.translation for p in poses], dtype=float).reshape(-1, 3),
    )


def _apart_in_words(
    lost: list[str], reached: list[str], boards: Mapping[tuple[int, int], Pose], names: list[str]
) -> str:
    """Which cameras share nothing with which, in groups."""
    group = {n: {n} for n in lost}
    for placement in {p for _, p in boards}:
        together = [names[c] for c, p in boards if p == placement and names[c] in group]
        merged: set[str] = set().union(*(group[n] for n in together)) if together else set()
        for n in merged:
            group[n] = merged
    parts = sorted({tuple(sorted(g)) for g in group.values()})
    words = "; ".join(f"{_listed(p)} share{'s' if len(p) == 1 else ''} nothing with the others" for p in parts)
    rest = f" ({_listed(tuple(reached))} have a place)" if reached else ""
    return (
        f"camera {words}{rest}: give each of them four surveyed dots, or a photograph of a board that another camera"
        " sees in the same place"
    )


def _listed(names: tuple[str, ...]) -> str:
    return ", ".join(repr(n) for n in names)
