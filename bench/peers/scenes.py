"""The five scenes of the comparison: six spots, two cameras, points only, with truth.

| scene | motion | nuisance |
| --- | --- | --- |
| standard | smooth, median 3 px per frame, up to 11 | 20 % clutter within 40 px of every spot, also occluded ones; |
|          | | 2 % misses; spots occluded for 5 to 20 frames, often where yaw reverses; 3 and 6 leave and return |
| fast | four times as fast: median 12, up to 46 px per frame | the same |
| reversal | straight segments, the velocity reverses within one frame | the same, occluded at the reversals |
| longout | smooth, 3 and 6 out of view for hundreds of frames | the same |
| dense | smooth | one false point per spot, six anywhere and two fixed ones per camera; |
|       |        | 5 % misses; spots occluded for 10 to 40 frames |

The scenes have their own projection from the rig parameters: the truth must not come from the tested code.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bench.peers import motions
from geometry.arrays import Array, Bools, Ints
from geometry.camera import Camera
from geometry.pose import Pose, look_at
from geometry.rig import Beam, Rig, Screen, Spot

FRAME_S = 1 / motions.RATE_HZ
NOISE_PX = 0.15  # 1 sigma per axis
SPOTS, CAMERAS = 6, 2
CAMERA_OF = np.array([0, 0, 0, 1, 1, 1])  # spots 1 to 3 are on the left screen, 4 to 6 on the right one
DETECTED, HIDDEN, OUTSIDE = 1, 0, -1
CLUTTER = -1  # origin of a false point
CLUTTER_RADIUS_PX = 40.0
CLEAN_START_FRAMES = 30  # without misses and occlusions: trackers without a rig get their labels from here

SIZE_PX = np.array([1280, 1024])
FOCAL_PX, RADIAL = 1090.0, -0.04
SCREEN_X_M = np.array([-2.5, 2.5])
FAN = np.deg2rad([-20.0, 0.0, 20.0])  # beams in the x-y plane of body, from x towards y
CAMERA_AT_M = np.array([[3.0, 0.6, 1.5], [-3.0, -0.6, 1.5]])
CAMERA_TOWARDS_M = np.array([[-2.5, 0.55, 0.0], [2.5, -0.55, 0.0]])

MOTIONS: dict[str, Callable[[int, np.random.Generator], tuple[Array, list[int]]]] = {
    "standard": motions.smooth,
    "fast": lambda frames, rng: motions.smooth(frames, rng, speed=4.0),
    "reversal": motions.reversals,
    "longout": lambda frames, rng: motions.smooth(frames, rng, stay_out=True),
    "dense": motions.smooth,
}


@dataclass(frozen=True, slots=True)
class Scene:
    """One recording of T frames with its truth."""

    name: str
    seed: int
    detections: tuple[tuple[Array, ...], ...]  # per frame and camera (n, 2), px, in random order
    origin: tuple[tuple[Ints, ...], ...]  # per frame and camera (n,): the spot (0 to 5) of each point, or CLUTTER
    uv_px: Array  # (T, 6, 2) noise-free, also outside the picture
    state: Ints  # (T, 6) DETECTED, HIDDEN (or missed) or OUTSIDE
    poses: Pose  # (T,) world_from_body
    start_px: Array  # (6, 2) the measured points of frame 0: labels for trackers without a rig

    def __len__(self) -> int:
        return len(self.detections)


@dataclass(frozen=True, slots=True)
class Nuisance:
    """Frequency of misses, occlusions and clutter."""

    missed: float  # probability per frame
    hidden_frames: tuple[int, int]  # shortest and longest
    around: Callable[[np.random.Generator], int]  # number of false points near one spot
    anywhere: float  # mean number of false points in a picture besides two fixed ones; 0: neither


USUAL = Nuisance(0.02, (5, 20), lambda rng: int(rng.random() < 0.20), 0.0)
DENSE = Nuisance(0.05, (10, 40), lambda rng: int(rng.poisson(1.0)), 6.0)


def rig() -> Rig:
    """The rig of all scenes: two screens across world x, a camera for each, three beams through one point."""
    turn = np.array([0.5, 0.5, 0.5, 0.5])  # screen x, y, z = world y, z, x
    matrix = np.array([[FOCAL_PX, 0, (SIZE_PX[0] - 1) / 2], [0, FOCAL_PX, (SIZE_PX[1] - 1) / 2], [0, 0, 1]])
    screens, cameras = {}, {}
    for c, name in enumerate(("left", "right")):
        screens[name] = Screen(name, Pose.from_quaternion(turn, np.array([SCREEN_X_M[c], 0.0, 0.0])))
        place = look_at(CAMERA_AT_M[c], CAMERA_TOWARDS_M[c])
        size = (int(SIZE_PX[0]), int(SIZE_PX[1]))
        cameras[name] = Camera(name, name, size, matrix, (RADIAL, 0.0, 0.0, 0.0), place)
    beams = {n: Beam(n, np.array([np.cos(a), np.sin(a), 0.0]), np.zeros(3)) for n, a in zip("ABC", FAN, strict=True)}
    ends = [(beam, sign, screen) for sign, screen in ((-1, "left"), (1, "right")) for beam in beams]
    spots = {str(i): Spot(str(i), beam, sign, screen) for i, (beam, sign, screen) in enumerate(ends, 1)}
    return Rig(screens, cameras, beams, spots)


def spot_pixels(q: Array) -> Array:
    """Pixels (T, 6, 2) of the spots, also outside the picture, for x, y, z (m), yaw, pitch, roll (rad) (T, 6)."""
    cy, cp, cr = np.cos(q[:, 3:].T)
    sy, sp, sr = np.sin(q[:, 3:].T)
    body_x = np.stack([cy * cp, sy * cp, -sp], axis=-1)  # in world: the first two columns of Rz(yaw) Ry(pitch) Rx(roll)
    body_y = np.stack([cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr], axis=-1)
    d = body_x[:, None] * np.cos(FAN)[:, None] + body_y[:, None] * np.sin(FAN)[:, None]
    pixels = []
    for c in range(CAMERAS):
        reach = (SCREEN_X_M[c] - q[:, None, 0]) / d[..., 0]
        on_screen = q[:, None, :3] + reach[..., None] * d
        place = look_at(CAMERA_AT_M[c], CAMERA_TOWARDS_M[c])
        in_camera = on_screen @ place.rotation.T + place.translation
        xy = in_camera[..., :2] / in_camera[..., 2:]
        bend = 1 + RADIAL * (xy[..., :1] ** 2 + xy[..., 1:] ** 2)
        pixels.append(FOCAL_PX * xy * bend + (SIZE_PX - 1) / 2)
    return np.concatenate(pixels, axis=1)


def make_scene(name: str, seed: int, frames: int = 2000) -> Scene:
    """One of SCENES. The points depend on name, seed and length."""
    rng = np.random.default_rng([seed, sum(map(ord, name))])
    q, bends = MOTIONS[name](frames, rng)
    nuisance = DENSE if name == "dense" else USUAL
    uv = spot_pixels(q)
    inside = np.all((uv >= 0) & (uv <= SIZE_PX - 1), axis=-1)
    seen = _seen(inside, bends, nuisance, rng)
    fixed = [rng.uniform([100, 100], SIZE_PX - 100, (2, 2)) for _ in range(2)]
    noisy = uv + rng.normal(0, NOISE_PX, uv.shape)
    frames_of: list[list[_Point]] = []
    for k in range(frames):
        points = _near_spots(uv[k], noisy[k], inside[k], seen[k], nuisance, rng)
        if nuisance.anywhere:
            points += _anywhere(fixed, nuisance.anywhere, rng)
        frames_of.append([points[i] for i in rng.permutation(len(points))])
    return Scene(
        name=name,
        seed=seed,
        detections=tuple(tuple(_of_camera(points, c)[0] for c in range(CAMERAS)) for points in frames_of),
        origin=tuple(tuple(_of_camera(points, c)[1] for c in range(CAMERAS)) for points in frames_of),
        uv_px=uv,
        state=np.where(inside, np.where(seen, DETECTED, HIDDEN), OUTSIDE),
        poses=Pose.from_ypr(q[:, 3:], q[:, :3]),
        start_px=noisy[0],
    )


_Point = tuple[int, float, float, int]  # camera, u, v, origin


def _seen(inside: Bools, bends: list[int], nuisance: Nuisance, rng: np.random.Generator) -> Bools:
    """The detected spots (T, 6): in the picture, not missed, not occluded."""
    shortest, longest = nuisance.hidden_frames

    def duration() -> int:
        return int(rng.integers(shortest, longest + 1))

    seen: Bools = inside & (rng.random(inside.shape) > nuisance.missed)
    seen[:CLEAN_START_FRAMES] = inside[:CLEAN_START_FRAMES]
    for s in range(SPOTS):
        k = int(rng.integers(60, 200))
        while k < len(inside):
            n = duration()
            seen[k : k + n, s] = False
            k += n + int(rng.integers(80, 220))
    for k in bends:
        if k > 60 and rng.random() < 0.6:
            n = duration()
            beam = int(rng.integers(0, 3))
            both = rng.random() < 0.3
            spots = [beam, beam + 3] if both else [beam + 3 * int(rng.integers(0, 2))]
            first = k - n // 2
            seen[max(CLEAN_START_FRAMES + 1, first) : first + n, spots] = False
    return seen


def _near_spots(
    uv: Array, noisy: Array, inside: Bools, seen: Bools, nuisance: Nuisance, rng: np.random.Generator
) -> list[_Point]:
    """The detected spots of one frame and false points near all spots, half as often near those out of the picture."""
    points: list[_Point] = []
    for s in range(SPOTS):
        camera = int(CAMERA_OF[s])
        if seen[s]:
            points.append((camera, noisy[s, 0], noisy[s, 1], s))
        if not inside[s] and rng.random() >= 0.5:
            continue
        for _ in range(nuisance.around(rng)):
            radius, turn = CLUTTER_RADIUS_PX * np.sqrt(rng.random()), rng.uniform(0, 2 * np.pi)
            at = uv[s] + radius * np.array([np.cos(turn), np.sin(turn)])
            if np.all((at >= 0) & (at <= SIZE_PX - 1)):
                points.append((camera, at[0], at[1], CLUTTER))
    return points


def _anywhere(fixed: list[Array], mean: float, rng: np.random.Generator) -> list[_Point]:
    """False points of one frame: at random places, and with a probability of 0.9 at the fixed ones (2, 2)."""
    points: list[_Point] = []
    for c in range(CAMERAS):
        points += [(c, *rng.uniform([0, 0], SIZE_PX - 1), CLUTTER) for _ in range(rng.poisson(mean))]
        for place in fixed[c]:
            if rng.random() < 0.9:
                u, v = place + rng.normal(0, NOISE_PX, 2)
                points.append((c, u, v, CLUTTER))
    return points


def _of_camera(points: list[_Point], camera: int) -> tuple[Array, Ints]:
    """Pixels (n, 2) and origins (n,) of one camera's points."""
    mine = [p for p in points if p[0] == camera]
    uv = np.array([p[1:3] for p in mine], dtype=float).reshape(-1, 2)
    return uv, np.array([p[3] for p in mine], dtype=np.int64)


SCENES = tuple(MOTIONS)
