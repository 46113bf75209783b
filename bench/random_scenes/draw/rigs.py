"""Random rigs: screens, a vehicle with beams, and cameras aimed at the spots.

The rig is laid out in a base frame (x from the left screen to the right one, z up) and a vehicle frame; at the end it
is transformed to a random world frame and body frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bench.random_scenes.draw.cameras import FOCAL_PX, SIZES_PX, draw_camera
from bench.random_scenes.draw.vehicles import LEAST_SPOTS, LEFT, RIGHT, THIRD, Vehicle, draw_vehicle
from geometry import rotations
from geometry.arrays import Array
from geometry.camera import Camera
from geometry.pose import Pose
from geometry.rig import Beam, Rig, Screen, Spot

THIRD_SIDES = {
    "behind": np.array([0.0, 1, 0]),
    "in front": np.array([0.0, -1, 0]),
    "above": np.array([0.0, 0, 1]),
    "below": np.array([0.0, 0, -1]),
}


@dataclass(frozen=True, slots=True)
class Lab:
    """A rig, and the data that a motion needs to keep the spots in its pictures."""

    rig: Rig
    world_from_base: Pose
    vehicle_from_body: Pose
    rest: Array  # (6,) x, y, z (m), yaw, pitch, roll (rad) of the vehicle in base, about which it moves
    reach_m: float  # range of the spots on the screens, m
    lever_m: float  # the distance of the screens
    text: str

    def poses(self, q: Array) -> Pose:
        """world_from_body (T,) from x, y, z (m), yaw, pitch, roll (rad) of the vehicle in base, (T, 6)."""
        return self.world_from_base @ Pose.from_ypr(q[:, 3:], q[:, :3]) @ self.vehicle_from_body


def draw_lab(rng: np.random.Generator, sizes_px: Sequence[tuple[int, int]] = SIZES_PX) -> Lab:
    """A lab with at least LEAST_SPOTS spots on its screens with the vehicle at rest; sizes_px: of its pictures."""
    while True:
        lab = _attempt(rng, sizes_px)
        if lab is not None:
            return lab


def _attempt(rng: np.random.Generator, sizes_px: Sequence[tuple[int, int]]) -> Lab | None:
    screens, screen_text = draw_screens(rng)
    vehicle = draw_vehicle(rng, third=_towards(screens[THIRD]) if THIRD in screens else None)
    rest = np.concatenate([rng.uniform(-0.3, 0.3, 3), np.deg2rad(rng.uniform(-12, 12, 3))])
    reach = float(np.exp(rng.uniform(np.log(0.06), np.log(0.8))))
    lever = float(np.mean([abs(s.world_from_screen.translation).max() for s in screens.values()]))
    per_screen = [1 + int(rng.random() < 0.2) for _ in screens]
    if sum(per_screen) > 4:
        per_screen = [1] * len(screens)
    return assembled(rng, screens, vehicle, rest, reach, lever, per_screen, screen_text, sizes_px=sizes_px)


def assembled(
    rng: np.random.Generator,
    screens: dict[str, Screen],
    vehicle: Vehicle,
    rest: Array,
    reach_m: float,
    lever_m: float,
    cameras_per_screen: list[int],
    screen_text: str,
    focal_px: tuple[float, float] = FOCAL_PX,
    plain_frames: bool = False,
    sizes_px: Sequence[tuple[int, int]] = SIZES_PX,
) -> Lab | None:
    """The lab with cameras for the screens, in one world and body frame; None with too few spots on the screens.

    plain_frames: world is the base frame and body the vehicle frame.
    """
    hits = _hits(screens, vehicle, rest)
    ends = [e for e, hit in zip(vehicle.ends, hits, strict=True) if hit is not None]
    if len(ends) < LEAST_SPOTS or len({s for _, _, s in ends}) < min(2, len(screens)):
        return None
    cameras: dict[str, Camera] = {}
    sized: dict[str, Screen] = {}
    texts: list[str] = []
    for (name, screen), count in zip(screens.items(), cameras_per_screen, strict=True):
        mine = [hit for (_, _, s), hit in zip(vehicle.ends, hits, strict=True) if s == name and hit is not None]
        if not mine:
            continue
        centre = np.mean(mine, axis=0)
        radius = max(float(np.linalg.norm(hit - centre)) for hit in mine) + reach_m
        sized[name] = _with_size(rng, screen, centre, radius)
        azimuth = rng.uniform(0, 2 * np.pi)
        for i in range(count):
            label = name if count == 1 else f"{name}{i + 1}"
            towards = azimuth + i * rng.uniform(1.5, 4.5)
            cameras[label], text = draw_camera(
                rng, label, screen, centre, radius, towards, rest[:3], focal_px, sizes_px
            )
            texts.append(text)
    world_from_base, vehicle_from_body = Pose.identity(), Pose.identity()
    turned = not plain_frames and rng.random() < 0.3
    if turned:
        world_from_base = Pose(random_rotation(rng, np.pi), rng.uniform(-5, 5, 3))
    mounted = not plain_frames and rng.random() < 0.5
    if mounted:
        limit = np.pi if rng.random() < 0.2 else 0.5
        vehicle_from_body = Pose(random_rotation(rng, limit), rng.uniform(-0.3, 0.3, 3))
    rig = _in_world(sized, cameras, vehicle, ends, world_from_base, vehicle_from_body)
    text = f"{vehicle.text}, {len(ends)} spots; {screen_text}; cameras {', '.join(texts)}"
    text += "; world turned" * turned + "; body offset" * mounted
    return Lab(rig, world_from_base, vehicle_from_body, rest, reach_m, lever_m, text)


def draw_screens(rng: np.random.Generator) -> tuple[dict[str, Screen], str]:
    """Left and right screens in base, in four of ten scenes a third: behind, in front, above or below."""
    left, right = rng.uniform(1.5, 4.0, 2)
    screens = {LEFT: _screen(rng, LEFT, np.array([-left, 0, 0])), RIGHT: _screen(rng, RIGHT, np.array([right, 0, 0]))}
    text = f"screens at -{left:.1f} and {right:.1f} m"
    if rng.random() < 0.4:
        where = ("behind", "in front", "above", "below")[rng.integers(4)]
        away = rng.uniform(1.5, 3.5)
        screens[THIRD] = _screen(rng, THIRD, away * THIRD_SIDES[where])
        text += f", a third {where} at {away:.1f} m"
    return screens, text


def _screen(rng: np.random.Generator, name: str, at: Array) -> Screen:
    """A screen across the line from the base origin to `at`, slightly rotated in half of the scenes."""
    normal = at / np.linalg.norm(at) * (1 if rng.random() < 0.5 else -1)
    second = np.array([0.0, 1.0, 0.0]) if abs(normal[2]) > 0.5 else np.array([0.0, 0.0, 1.0])
    first = np.cross(second, normal)
    R = np.stack([first, second, normal], axis=1)
    if rng.random() < 0.5:
        R = random_rotation(rng, np.deg2rad(15)) @ R
    return Screen(name, Pose(R, at + rng.uniform(-0.1, 0.1, 3)))


def _towards(screen: Screen) -> Array:
    at = screen.world_from_screen.translation
    return at / np.linalg.norm(at)


def _with_size(rng: np.random.Generator, screen: Screen, centre: Array, radius: float) -> Screen:
    """The screen, in half of the scenes with a size; it is shifted within its plane to be centred on the spots."""
    if rng.random() < 0.5:
        return screen
    size = tuple((2 * radius * rng.uniform(0.95, 1.6, 2)).tolist())
    place = Pose(screen.world_from_screen.rotation, centre)
    return Screen(screen.name, place, (size[0], size[1]))


def random_rotation(rng: np.random.Generator, limit: float) -> Array:
    """A rotation (3, 3) by at most `limit`, rad, about a random axis."""
    axis = rng.normal(size=3)
    return rotations.exp(axis / np.linalg.norm(axis) * rng.uniform(0, limit))


def _hits(screens: dict[str, Screen], vehicle: Vehicle, rest: Array) -> list[Array | None]:
    """The spots of the beam ends at rest, in base, m; None where they miss their screen, or are too oblique."""
    place = Pose.from_ypr(rest[3:], rest[:3])
    out: list[Array | None] = []
    for name, sign, screen_name in vehicle.ends:
        direction, point = vehicle.beams[name]
        plane = screens[screen_name].world_from_screen
        normal = plane.rotation[:, 2]
        start, along = place.apply(point), sign * place.turn(direction)
        facing = along @ normal
        reach = (plane.translation - start) @ normal / facing if abs(facing) > 0.35 else -1.0
        out.append(start + reach * along if 0.3 < reach < 8 else None)
    return out


def _in_world(
    screens: dict[str, Screen],
    cameras: dict[str, Camera],
    vehicle: Vehicle,
    ends: list[tuple[str, int, str]],
    world_from_base: Pose,
    vehicle_from_body: Pose,
) -> Rig:
    base_from_world, body_from_vehicle = world_from_base.inverse(), vehicle_from_body.inverse()
    used = {n for n, _, _ in ends}
    return Rig(
        {n: Screen(n, world_from_base @ s.world_from_screen, s.size_m) for n, s in screens.items()},
        {
            n: Camera(n, c.screen, c.image_size_px, c.matrix, c.distortion, c.camera_from_world @ base_from_world)
            for n, c in cameras.items()
        },
        {
            n: Beam(n, body_from_vehicle.turn(d), body_from_vehicle.apply(p))
            for n, (d, p) in vehicle.beams.items()
            if n in used
        },
        {str(i): Spot(str(i), n, sign, screen) for i, (n, sign, screen) in enumerate(ends, 1)},
    )
