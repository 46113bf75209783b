"""Rigs drawn at random: screens, a vehicle with beams, and cameras that are aimed at where the spots fall.

All is laid out in a base frame (x from the left screen to the right one, z up) and a vehicle frame; at the end the
whole lab is moved to a world frame and the beams to a body frame of their own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.random_scenes.projection import fold_radius
from geometry import rotations
from geometry.arrays import Array
from geometry.camera import Camera
from geometry.pose import Pose
from geometry.rig import Beam, Rig, Screen, Spot

SIZES_PX = ((640, 480), (800, 600), (1280, 1024), (1280, 720), (1600, 1200), (1936, 1216), (2048, 2048), (2448, 2048))
LEFT, RIGHT, THIRD = "left", "right", "third"
FOCAL_PX = (300.0, 6000.0)
DISTANCE_M = (0.6, 15.0)  # of a camera from the spots that it films
THIRD_SIDES = {
    "behind": np.array([0.0, 1, 0]),
    "in front": np.array([0.0, -1, 0]),
    "above": np.array([0.0, 0, 1]),
    "below": np.array([0.0, 0, -1]),
}
LEAST_BETWEEN = np.deg2rad(4.0)  # between two beams
LEAST_SPOTS = 4


@dataclass(frozen=True, slots=True)
class Lab:
    """A rig, and what a motion needs to stay in its pictures."""

    rig: Rig
    world_from_base: Pose
    vehicle_from_body: Pose
    rest: Array  # (6,) x, y, z (m), yaw, pitch, roll (rad) of the vehicle in base, about which it moves
    reach_m: float  # how far the spots may move on the screens
    lever_m: float  # the distance of the screens
    text: str

    def poses(self, q: Array) -> Pose:
        """world_from_body (T,) of the vehicle's x, y, z (m), yaw, pitch, roll (rad) in base, (T, 6)."""
        return self.world_from_base @ Pose.from_ypr(q[:, 3:], q[:, :3]) @ self.vehicle_from_body


@dataclass(frozen=True, slots=True)
class Vehicle:
    """Beams in the vehicle frame and the ends that shine: (beam, sign, screen)."""

    beams: dict[str, tuple[Array, Array]]  # direction (3,), point (3,), m
    ends: tuple[tuple[str, int, str], ...]
    text: str


def draw_lab(rng: np.random.Generator) -> Lab:
    """A lab with at least LEAST_SPOTS spots on its screens when the vehicle rests."""
    while True:
        lab = _attempt(rng)
        if lab is not None:
            return lab


def _attempt(rng: np.random.Generator) -> Lab | None:
    screens, screen_text = draw_screens(rng)
    vehicle = draw_vehicle(rng, third=_towards(screens[THIRD]) if THIRD in screens else None)
    rest = np.concatenate([rng.uniform(-0.3, 0.3, 3), np.deg2rad(rng.uniform(-12, 12, 3))])
    reach = float(np.exp(rng.uniform(np.log(0.06), np.log(0.8))))
    lever = float(np.mean([abs(s.world_from_screen.translation).max() for s in screens.values()]))
    per_screen = [1 + int(rng.random() < 0.2) for _ in screens]
    if sum(per_screen) > 4:
        per_screen = [1] * len(screens)
    return assembled(rng, screens, vehicle, rest, reach, lever, per_screen, screen_text)


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
) -> Lab | None:
    """Cameras for the screens, and all of it in one world and body; None where too few spots fall on the screens.

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
            cameras[label], text = _draw_camera(rng, label, screen, centre, radius, towards, rest[:3], focal_px)
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
    """A screen across the line from base's origin to `at`, turned a little in half of the scenes."""
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
    """The screen with an extent in half of the scenes; it is moved along itself to lie about the spots."""
    if rng.random() < 0.5:
        return screen
    size = tuple((2 * radius * rng.uniform(0.95, 1.6, 2)).tolist())
    place = Pose(screen.world_from_screen.rotation, centre)
    return Screen(screen.name, place, (size[0], size[1]))


def draw_vehicle(rng: np.random.Generator, third: Array | None) -> Vehicle:
    """Two to six beams. third: the unit direction (3,) to a third screen, which one or two of them point to."""
    while True:
        count = int(rng.choice([2, 3, 4, 5, 6], p=[0.2, 0.35, 0.2, 0.15, 0.1]))
        aside = 0 if third is None else int(rng.integers(1, min(2, count - 1) + 1))
        along = max(count - aside, 1)
        kind = str(rng.choice(["equal fan", "unequal fan", "skew", "apart", "rolled fan"]))
        directions, points = _lines(rng, kind, along)
        side = [_within_cone(rng, third, np.deg2rad(25)) for _ in range(aside)] if third is not None else []
        all_of = [*directions, *side]
        points = [*points, *(rng.uniform(-0.15, 0.15, 3) for _ in side)]
        if _closest(all_of) < LEAST_BETWEEN:
            continue
        names = [chr(ord("A") + i) for i in range(len(all_of))]
        ends = [(n, sign, s) for sign, s in ((-1, LEFT), (1, RIGHT)) for n in names[:along]]
        ends += [(n, 1, THIRD) for n in names[along:]]
        single = rng.random() < 0.25
        if single:
            kept = [e for e in ends if e[2] == THIRD or rng.random() > 0.3]
            used = {n for n, _, _ in kept}
            if len(kept) < LEAST_SPOTS or used != set(names):
                continue
            ends = kept
        if len(ends) < LEAST_SPOTS:
            continue
        beams = {n: (d, p) for n, d, p in zip(names, all_of, points, strict=True)}
        text = f"{len(all_of)} beams ({kind}{', single-ended' * single}{f', {aside} aside' if aside else ''})"
        return Vehicle(beams, tuple(ends), text)


def _lines(rng: np.random.Generator, kind: str, count: int) -> tuple[list[Array], list[Array]]:
    """Directions and points of beams roughly along x."""
    if kind == "skew":
        directions = [_within_cone(rng, np.array([1.0, 0, 0]), np.deg2rad(28)) for _ in range(count)]
        return directions, [rng.uniform(-0.2, 0.2, 3) for _ in range(count)]
    if kind == "equal fan":
        angles = np.deg2rad(rng.uniform(5, min(25, 70 / max(count - 1, 1)))) * (np.arange(count) - (count - 1) / 2)
    else:
        steps = np.deg2rad(rng.uniform(4, 20, max(count - 1, 0)))
        angles = np.concatenate([[0.0], np.cumsum(steps)])
        angles = (angles - angles.mean()) * min(1.0, np.deg2rad(70) / max(np.ptp(angles), 1e-9))
    directions = np.stack([np.cos(angles), np.sin(angles), np.zeros(count)], axis=-1)
    points = np.zeros((count, 3))
    if kind == "apart":
        points = rng.uniform(-0.3, 0.3, (count, 3))
    elif rng.random() < 0.3:
        points += rng.uniform(-0.3, 0.3, 3)
    if kind == "rolled fan":
        roll = rotations.exp(np.array([rng.uniform(-np.pi, np.pi), 0, 0]))
        directions, points = directions @ roll.T, points @ roll.T
    return list(directions), list(points)


def _closest(directions: list[Array]) -> float:
    """The least angle between two lines, rad."""
    D = np.array(directions)
    c = np.abs(D @ D.T) - np.eye(len(D))
    return float(np.arccos(np.clip(c.max(), 0, 1)))


def _within_cone(rng: np.random.Generator, axis: Array, half_angle: float) -> Array:
    """A unit vector (3,) at most half_angle from the axis."""
    turn = rng.normal(size=3)
    turn -= axis * (turn @ axis)
    turn *= half_angle * np.sqrt(rng.random()) / np.linalg.norm(turn)
    return np.asarray(rotations.exp(turn) @ axis)


def random_rotation(rng: np.random.Generator, limit: float) -> Array:
    """A rotation (3, 3) by at most `limit`, rad, about a random axis."""
    axis = rng.normal(size=3)
    return rotations.exp(axis / np.linalg.norm(axis) * rng.uniform(0, limit))


def _hits(screens: dict[str, Screen], vehicle: Vehicle, rest: Array) -> list[Array | None]:
    """Where the ends fall on their screens at rest, in base, m; None where they do not, or too obliquely."""
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


def _draw_camera(
    rng: np.random.Generator,
    name: str,
    screen: Screen,
    centre: Array,
    radius: float,
    azimuth: float,
    vehicle_at: Array,
    focal_px: tuple[float, float],
) -> tuple[Camera, str]:
    """A camera that films a disc on its screen; `centre` (3,), `radius` in m, in base."""
    width, height = SIZES_PX[rng.integers(len(SIZES_PX))]
    fill = rng.uniform(0.75, 1.15) * 0.45 * min(width, height)  # px that the radius takes
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
    """k1, k2, p1, p2, k3 that bend the picture's corner by up to 25 % of its radius and grow all over the picture."""
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
