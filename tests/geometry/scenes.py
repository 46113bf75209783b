"""Rigs for the tests: that of the paper, and random ones without its symmetries."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from geometry.camera import FISHEYE, Camera
from geometry.pose import Pose
from geometry.rig import Beam, Rig, Screen, Spot

# Typical models, one for each allowed number of coefficients, all one to one over a normalised radius of 0.8.
LENSES = {
    0: (),
    4: (-0.21, 0.06, 0.0011, -0.0007),
    5: (-0.28, 0.11, -0.0009, 0.0004, -0.019),
    8: (0.4, -0.2, 0.0006, 0.001, 0.01, 0.62, -0.1, 0.02),
    12: (-0.17, 0.05, 0.0008, -0.0012, 0.004, 0.05, 0.01, 0.002, 0.0015, -0.0004, -0.0009, 0.0002),
    14: (-0.17, 0.05, 0.0008, -0.0012, 0.004, 0.05, 0.01, 0.002, 0.0015, -0.0004, -0.0009, 0.0002, 0.03, -0.02),
}


def random_pose(rng: np.random.Generator, shift_m: float = 1.0, turn_rad: float = np.pi) -> Pose:
    """A random pose: a turn of up to turn_rad about any axis, a shift of up to shift_m in each coordinate."""
    axis = rng.normal(size=3)
    rotvec = axis / np.linalg.norm(axis) * rng.uniform(0, turn_rad)
    return Pose(Rotation.from_rotvec(rotvec).as_matrix(), rng.uniform(-shift_m, shift_m, 3))


def camera_that_looks_at(
    name: str, screen: Screen, from_screen: np.ndarray, lens: tuple[float, ...], roll_rad: float = 0.0
) -> Camera:
    """A camera at a point (3,), m, of the screen's frame, with its optical axis through the screen's origin."""
    forward = -from_screen / np.linalg.norm(from_screen)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    screen_from_camera = Pose(
        np.column_stack([right, np.cross(forward, right), forward])
        @ Rotation.from_rotvec([0, 0, roll_rad]).as_matrix(),
        from_screen,
    )
    return Camera(
        name=name,
        screen=screen.name,
        image_size_px=(1280, 1024),
        matrix=np.array([[1180.0, 0, 639.5], [0, 1175.0, 511.5], [0, 0, 1]]),
        distortion=lens,
        camera_from_world=(screen.world_from_screen @ screen_from_camera).inverse(),
    )


def paper_rig(lens: tuple[float, ...] = (), size_m: tuple[float, float] | None = None) -> Rig:
    """Two parallel screens 5 m apart, and three coplanar beams through one point, 30 degrees apart."""
    axes = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # screen x, y, z = world y, z, x
    screens = {
        "left": Screen("left", Pose(axes, np.array([-2.5, 0, 0])), size_m),
        "right": Screen("right", Pose(axes, np.array([2.5, 0, 0])), size_m),
    }
    cameras = {
        "left": camera_that_looks_at("left", screens["left"], np.array([0.0, 0, -3.5]), lens),
        "right": camera_that_looks_at("right", screens["right"], np.array([0.0, 0, 3.5]), lens),
    }
    turns = np.radians([0.0, 30.0, -30.0])
    beams = {n: Beam(n, np.array([np.cos(a), np.sin(a), 0.0]), np.zeros(3)) for n, a in zip("ABC", turns, strict=True)}
    spots = {str(i + 1): Spot(str(i + 1), beam, -1, "left") for i, beam in enumerate("ABC")}
    spots |= {str(i + 4): Spot(str(i + 4), beam, +1, "right") for i, beam in enumerate("ABC")}
    return Rig(screens, cameras, beams, spots)


def random_rig(rng: np.random.Generator) -> Rig:
    """Three tilted, unlimited screens, two cameras on one of them, skew beams, any lens models."""
    screens, cameras, beams, spots = {}, {}, {}, {}
    for name, azimuth in (("left", np.pi), ("right", 0.0), ("roof", 0.5 * np.pi)):
        outwards = Rotation.from_euler("ZY", [azimuth, np.pi / 2])  # screen z points outwards
        tilt = Rotation.from_rotvec(rng.normal(0, 0.2, 3))
        centre = outwards.apply([0, 0, 2.5]) + rng.normal(0, 0.2, 3)
        screens[name] = Screen(name, Pose((outwards * tilt).as_matrix(), centre))
    for name, screen in (("left", "left"), ("right", "right"), ("roof", "roof"), ("second", "left")):
        seat = np.array([*rng.uniform(-0.8, 0.8, 2), rng.choice([-1, 1]) * rng.uniform(2.5, 4)])
        lens = LENSES[int(rng.choice(list(LENSES)))]
        cameras[name] = camera_that_looks_at(name, screens[screen], seat, lens, rng.uniform(-np.pi, np.pi))
    for i in range(4):
        along = np.array([1.0, 0, 0]) if i < 3 else np.array([0.0, 1, 0])
        beams[f"b{i}"] = Beam(f"b{i}", along + rng.normal(0, 0.25, 3), rng.normal(0, 0.1, 3))
    for i in range(3):
        spots[f"-{i}"] = Spot(f"-{i}", f"b{i}", -1, "left")
        spots[f"+{i}"] = Spot(f"+{i}", f"b{i}", +1, "right")
    spots["up"] = Spot("up", "b3", +1, "roof")
    return Rig(screens, cameras, beams, spots)


def uncommon_rig(rng: np.random.Generator) -> Rig:
    """A random rig with bent screens, one fisheye camera, and fourteen distortion coefficients in the others."""
    rig = random_rig(rng)
    screens = {n: replace(s, bow=tuple(rng.normal(0, 0.004, 3))) for n, s in rig.screens.items()}
    cameras = {}
    for i, (name, camera) in enumerate(rig.cameras.items()):
        if i == 0:
            cameras[name] = replace(camera, lens=FISHEYE, distortion=(0.01, -0.02, 0.003, 0.001))
        else:
            cameras[name] = replace(camera, distortion=LENSES[14])
    return Rig(screens, cameras, rig.beams, rig.spots)
