"""Simulated networks of cameras and screens with known truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibration.boards.board_types import Charuco
from calibration.screens.network import ControlPoints, Network, PointObservations
from calibration.terms.corners import CornerTerm
from calibration.terms.surveyed import BoardOnScreenTerm
from geometry.camera import Camera
from geometry.pose import Pose
from geometry.rig import Rig, Screen

SURVEY_SIGMA_M, PIXEL_SIGMA_PX = 3e-4, 0.1
SIZE_PX = (1280, 1024)
MATRIX = np.array([[1180.0, 0, 639.5], [0, 1180.0, 511.5], [0, 0, 1]])
LENS = (-0.12, 0.05, 3e-4, -2e-4, 0.0)
BOARD = Charuco(12, 9, 0.04, 0.03, "DICT_5X5_100")


def look_at(position, target):
    """camera_from_world of a camera that looks at a target, world z up in its picture."""
    z = np.asarray(target, dtype=float) - position
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    return Pose(R, -R @ np.asarray(position, dtype=float))


def lab(bow=0.0):
    """Two screens at x = -2.5 m and 2.5 m, 2.4 m x 2 m, and the camera of each across the room."""
    turn = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # screen x, y, z = world y, z, x
    screens = {
        name: Screen(name, Pose(turn, np.array([x, 0.0, 0.0])), (2.4, 2.0), (bow, 0.0, 0.0))
        for name, x in (("left", -2.5), ("right", 2.5))
    }
    cameras = {
        "left": Camera("left", "left", SIZE_PX, MATRIX, LENS, look_at((1.6, 0.6, 1.5), (-2.5, 0.1, 0.0))),
        "right": Camera("right", "right", SIZE_PX, MATRIX, LENS, look_at((-1.6, -0.6, 1.5), (2.5, -0.1, 0.0))),
    }
    return Rig(screens, cameras, {}, {})


def measured(seed=0, bow=0.0, control_points=12, rig=None):
    """Dots on each screen, surveyed and observed with noise."""
    rng = np.random.default_rng(seed)
    rig = lab(bow) if rig is None else rig
    names, places, on = [], [], []
    cameras, seen, pixels = [], [], []
    screens = list(rig.screens)
    for c, camera in enumerate(rig.cameras.values()):
        screen = rig.screens[camera.screen]
        for i in range(control_points):
            for _ in range(1000):
                x, y = rng.uniform(-1.1, 1.1), rng.uniform(-0.9, 0.9)
                place = screen.world_from_screen.apply(np.array([x, y, screen.bow[0] * x * x]))
                pixel = camera.project(place)
                if camera.sees(pixel):
                    break
            names.append(f"{camera.screen[0].upper()}{i + 1}")
            places.append(place)
            on.append(screens.index(camera.screen))
            cameras.append(c)
            seen.append(len(names) - 1)
            pixels.append(pixel + PIXEL_SIGMA_PX * rng.normal(size=2))
    true = np.array(places)
    surveyed = true + SURVEY_SIGMA_M * rng.normal(size=true.shape)
    C = np.tile(np.eye(3) * SURVEY_SIGMA_M**2, (len(true), 1, 1))
    return Network(
        rig,
        ControlPoints(tuple(names), surveyed, C, np.array(on)),
        PointObservations(np.array(cameras), np.array(seen), np.array(pixels), np.full(len(seen), PIXEL_SIGMA_PX)),
    )


def corners_of(rig, boards, sigma_px=0.1, seed=0):
    """Corners of boards (world_from_board by placement) in the pictures that contain the whole board."""
    rng = np.random.default_rng(seed)
    rows = {"pixels": [], "points": [], "camera": [], "placement": []}
    for p, world_from_board in enumerate(boards):
        for c, camera in enumerate(rig.cameras.values()):
            pixels = camera.project(world_from_board.apply(BOARD.points))
            if not camera.sees(pixels).all():
                continue
            rows["pixels"].append(pixels + sigma_px * rng.normal(size=pixels.shape))
            rows["points"].append(BOARD.points)
            rows["camera"].append(np.full(len(pixels), c))
            rows["placement"].append(np.full(len(pixels), p))
    joined = {k: np.concatenate(v) for k, v in rows.items()}
    n = len(joined["pixels"])
    return CornerTerm(
        **joined,
        from_middle=joined["points"][:, :2] - BOARD.middle[:2],
        board=np.zeros(n, dtype=np.int64),
        sigma_px=np.full(n, 0.2),
        fisheye=np.zeros(len(rig.cameras), dtype=bool),
    )


def fixed_to(screens, placements, offset_m=0.003):
    """Boards of thickness offset_m fixed to screens."""
    n = len(screens)
    return BoardOnScreenTerm(
        np.array(screens),
        np.array(placements),
        np.tile(BOARD.middle, (n, 1)),
        np.full(n, offset_m),
        np.full(n, 2e-4),
        np.full(n, 5e-4),
    )


def lying_on(screen, x, y, offset_m=0.003):
    """world_from_board of a board fixed to a screen, its first corner at x, y."""
    return screen.world_from_screen @ Pose(np.diag([1.0, -1, -1]), np.array([x, y, offset_m]))


def without_dots(network):
    """The network without a survey."""
    none = np.empty(0, dtype=np.int64)
    return replace(
        network,
        control_points=ControlPoints((), np.empty((0, 3)), np.empty((0, 3, 3)), none),
        point_observations=PointObservations(none, none, np.empty((0, 2)), np.empty(0)),
    )
