"""Random cameras, aimed at the spots on a screen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bench.random_scenes.projection import fold_radius
from geometry import rotations
from geometry.arrays import Array
from geometry.camera import Camera
from geometry.pose import Pose
from geometry.rig import Screen

SIZES_PX = ((640, 480), (800, 600), (1280, 1024), (1280, 720), (1600, 1200), (1936, 1216), (2048, 2048), (2448, 2048))
FOCAL_PX = (300.0, 6000.0)
DISTANCE_M = (0.6, 15.0)  # of a camera from its spots


def draw_camera(
    rng: np.random.Generator,
    name: str,
    screen: Screen,
    centre: Array,
    radius: float,
    azimuth: float,
    vehicle_at: Array,
    focal_px: tuple[float, float],
    sizes_px: Sequence[tuple[int, int]] = SIZES_PX,
) -> tuple[Camera, str]:
    """A camera that sees a disc on its screen; `centre` (3,), `radius` in m, in base."""
    width, height = sizes_px[int(rng.integers(len(sizes_px)))]
    fill = rng.uniform(0.75, 1.15) * 0.45 * min(width, height)  # length of the radius, px
    shortest = max(focal_px[0], 0.5 * max(width, height))  # a field of view of 90 deg
    for _ in range(50):
        focal = float(np.exp(rng.uniform(*np.log(focal_px))))
        if focal >= shortest and DISTANCE_M[0] <= focal * radius / fill <= DISTANCE_M[1]:
            break
    focal = max(focal, shortest)
    distance = max(focal * radius / fill, DISTANCE_M[0])
    R_s = screen.world_from_screen.rotation
    normal = R_s[:, 2] * np.sign((vehicle_at - centre) @ R_s[:, 2])
    oblique = np.deg2rad(rng.uniform(0, 50))
    aside = R_s[:, 0] * np.cos(azimuth) + R_s[:, 1] * np.sin(azimuth)
    at = centre + distance * (np.cos(oblique) * normal + np.sin(oblique) * aside)
    aim = centre + 0.15 * radius * rng.uniform(-1, 1) * R_s[:, 0] + 0.15 * radius * rng.uniform(-1, 1) * R_s[:, 1]
    forward = (aim - at) / np.linalg.norm(aim - at)
    down = np.array([0.0, 0.0, -1.0]) if abs(forward[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    x = np.cross(down, forward)
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(forward, x), forward])
    roll = rng.uniform(-np.pi, np.pi) if rng.random() < 0.3 else rng.normal(0, 0.05)
    R = rotations.exp(np.array([0, 0, roll])) @ R
    matrix = np.array(
        [[focal, 0, (width - 1) / 2], [0, focal * rng.uniform(0.998, 1.002), (height - 1) / 2], [0, 0, 1]]
    )
    matrix[:2, 2] += rng.normal(0, 0.01, 2) * (width, height)
    distortion, bend = _draw_distortion(rng, width, height, focal)
    camera = Camera(name, screen.name, (width, height), matrix, distortion, Pose(R, -R @ at))
    text = f"{name} {width}x{height} f {focal:.0f} at {distance:.1f} m {np.rad2deg(oblique):.0f} deg oblique{bend}"
    return camera, text


def _draw_distortion(rng: np.random.Generator, width: int, height: int, focal: float) -> tuple[tuple[float, ...], str]:
    """k1, k2, p1, p2, k3 that move the corner of the picture by up to 25 % of its radius; monotonic in the picture."""
    corner = np.hypot(width, height) / 2 / focal
    kind = rng.random()
    if kind < 0.15:
        return (), ""
    share = rng.uniform(-0.25, 0.2) if kind > 0.65 and corner > 0.15 else rng.uniform(-0.03, 0.03)
    k = share * np.array([1.0, rng.uniform(-0.4, 0.4), rng.uniform(-0.15, 0.15)])
    p = 0.02 * share * rng.normal(size=2)
    while not _grows(k):
        k, p = k / 2, p / 2
    k1, k2, k3 = (float(a) for a in k / corner ** np.array([2, 4, 6]))
    p1, p2 = (float(a) for a in p / corner)
    return (k1, k2, p1, p2, k3), f" lens {100 * float(k.sum()):+.0f}%"


def _grows(k: Array) -> bool:
    """Whether r (1 + k1 r^2 + k2 r^4 + k3 r^6), r in corner radii, reaches 1.15 with a slope above 0.3."""
    r = np.linspace(0, 2.0, 201)
    bent = r * (1 + k[0] * r**2 + k[1] * r**4 + k[2] * r**6)
    slope = 1 + 3 * k[0] * r**2 + 5 * k[1] * r**4 + 7 * k[2] * r**6
    steep = np.flatnonzero(slope < 0.3)
    upto = steep[0] if steep.size else len(r)
    return upto > 1 and bent[upto - 1] >= 1.15 and fold_radius((k[0], k[1], k[2])) > 1.0
