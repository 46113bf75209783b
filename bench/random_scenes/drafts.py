"""Common parts of the families of scenes: drafts, rigs, zig-zags with given bends, occlusions across corners."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from bench.random_scenes import scene
from bench.random_scenes.draw import rigs
from bench.random_scenes.draw.motions import Motion
from bench.random_scenes.draw.nuisances import CLEAN_FRAMES, FalsePoints
from bench.random_scenes.draw.rigs import Lab
from bench.random_scenes.draw.vehicles import LEFT, RIGHT, Vehicle
from bench.random_scenes.projection import spot_pixels
from bench.random_scenes.scene import Scene, draw_amplitudes, draw_prior, fitted_motion, view_indices
from geometry.arrays import Array, Bools, Ints
from geometry.pose import Pose
from geometry.rig import Screen
from lab.simulate.scenarios import RIGS

SCREENS_M = 2.5  # of the rigs for a family


@dataclass(frozen=True, slots=True)
class Draw:
    """The input of a family of scenes."""

    seed: int
    frames: int
    key: list[int]  # of the random numbers

    def rng(self, purpose: int) -> np.random.Generator:
        """The stream of random numbers for one purpose."""
        return np.random.default_rng([*self.key, purpose])


@dataclass(slots=True)
class Draft:
    """A scene before its points are drawn; a family changes it before `scene` is called."""

    draw: Draw
    lab: Lab
    q: Array  # (T, 6) of the vehicle in base
    rate_hz: float
    noise_px: float
    false: FalsePoints
    corner_frames: Array
    text: str
    poses: Pose = field(init=False)  # (T,) world_from_body
    uv: Array = field(init=False)  # (T, n, 2) px
    camera_of: Ints = field(init=False)  # (n,)
    spot_of: Ints = field(init=False)  # (n,)
    hidden: Bools = field(init=False)  # (T, n)
    has_image: Bools = field(init=False)  # (T, c)

    def __post_init__(self) -> None:
        self.poses = self.lab.poses(self.q)
        self.uv = spot_pixels(self.lab.rig, self.poses)
        self.camera_of, self.spot_of = view_indices(self.lab.rig)
        self.hidden = np.zeros(self.uv.shape[:2], dtype=bool)
        self.has_image = np.ones((len(self.q), len(self.lab.rig.cameras)), dtype=bool)

    def scene(self) -> Scene:
        """The scene of this draft."""
        step = np.nanmedian(np.linalg.norm(np.diff(self.uv, axis=0), axis=-1))
        text = (
            f"{self.text}; {self.rate_hz:.0f} Hz, {step:.2g} px/frame, noise {self.noise_px:.2g} px, {self.false.text}"
        )
        return scene.composed(
            key=self.draw.key,
            seed=self.draw.seed,
            rig=self.lab.rig,
            poses=self.poses,
            rate_hz=self.rate_hz,
            sigma_px=np.full(len(self.camera_of), self.noise_px),
            false=self.false,
            hidden=self.hidden,
            has_image=self.has_image,
            corner_frames=self.corner_frames,
            text=f"{text}; {self.lab.text}",
            prior=draw_prior(self.draw.rng(scene.PRIOR), self.poses[0]),
        )


def paper_lab(name: str = "fan", reach_m: float = 0.5) -> Lab:
    """One of the example rigs, with the vehicle near its origin."""
    return Lab(RIGS[name](), Pose.identity(), Pose.identity(), np.zeros(6), reach_m, SCREENS_M, f"{name} rig")


def usual_lab(draw: Draw) -> Lab:
    """The rig of the paper for even seeds, a random one for odd seeds."""
    return paper_lab() if draw.seed % 2 == 0 else rigs.draw_lab(draw.rng(scene.LAB))


def fan_lab(
    rng: np.random.Generator, angles_deg: Array, reach_m: float, focal_px: tuple[float, float], name: str
) -> Lab:
    """A fan of beams visible at both ends, with screens at SCREENS_M and random cameras."""
    angles = np.deg2rad(angles_deg)
    names = [chr(ord("A") + i) for i in range(len(angles))]
    beams = {n: (np.array([np.cos(a), np.sin(a), 0.0]), np.zeros(3)) for n, a in zip(names, angles, strict=True)}
    ends = tuple((n, sign, s) for sign, s in ((-1, LEFT), (1, RIGHT)) for n in names)
    turn = np.array([0.5, 0.5, 0.5, 0.5])
    screens = {
        s: Screen(s, Pose.from_quaternion(turn, np.array([x, 0.0, 0.0])))
        for s, x in ((LEFT, -SCREENS_M), (RIGHT, SCREENS_M))
    }
    vehicle = Vehicle(beams, ends, name)
    lab = rigs.assembled(
        rng, screens, vehicle, np.zeros(6), reach_m, SCREENS_M, [1, 1], f"screens at {SCREENS_M} m", focal_px, True
    )
    assert lab is not None
    return lab


def false_points(lab: Lab, beside: float = 0.0, anywhere: float = 0.0) -> FalsePoints:
    """False points beside spots and anywhere, as given, without reflections."""
    return FalsePoints(beside, (15.0, 40.0), anywhere, tuple(np.zeros((0, 2)) for _ in lab.rig.cameras))


def corners_between(rng: np.random.Generator, frames: int, apart: tuple[float, float]) -> tuple[Array, Motion]:
    """A zig-zag over `frames` with corners at this distance in frames, at random times between frames.

    In half of the scenes it connects random poses, in the others it goes back and forth at constant speed. Returns the
    corners in frames and the motion over times in frames.
    """
    corners = [-rng.uniform(1, apart[0])]
    while corners[-1] < frames:
        corners.append(corners[-1] + rng.uniform(*apart))
    if rng.random() < 0.5:
        values = rng.uniform(-1, 1, (len(corners), 6))
    else:
        pieces = np.diff(corners, prepend=corners[0]) * (-1.0) ** np.arange(len(corners))
        path = np.cumsum(pieces) - np.mean(np.cumsum(pieces))
        values = path[:, None] / np.abs(path).max() * rng.uniform(-1, 1, 6)
    t = np.arange(frames, dtype=float)
    shape = np.stack([np.interp(t, corners, v) for v in values.T], axis=-1)
    inside = np.array([c for c in corners if 3 < c < frames - 3])
    return inside, Motion(shape, inside, "zig-zag")


def bends_px(uv: Array, corner_frames: Array) -> Array:
    """(k,): the largest change of the step of any spot at each corner, px."""
    out = []
    for corner in corner_frames:
        k = int(np.floor(corner))
        if 1 <= k < len(uv) - 2:
            change = (uv[k + 2] - uv[k + 1]) - (uv[k] - uv[k - 1])
            out.append(float(np.nanmax(np.linalg.norm(change, axis=-1), initial=0.0)))
    return np.array(out)


def zigzag_with_bends(
    lab: Lab, rng: np.random.Generator, frames: int, apart: tuple[float, float], bend_px: float, fastest_px: float
) -> tuple[Array, Array] | None:
    """x, y, z, yaw, pitch, roll (T, 6) of a zig-zag whose median bend is bend_px, and its corners in frames."""
    corners, motion = corners_between(rng, frames, apart)
    amplitudes = draw_amplitudes(rng, lab)
    bends = bends_px(spot_pixels(lab.rig, lab.poses(lab.rest + amplitudes * motion.shape)), corners)
    if not bends.size or not np.median(bends) > 0:
        return None
    size = bend_px / np.median(bends)
    q = fitted_motion(lab, motion, size * amplitudes, fastest_px, 0.9)
    if q is None:
        return None
    reached = bends_px(spot_pixels(lab.rig, lab.poses(q)), corners)
    return (q, corners) if 0.5 * bend_px < np.median(reached) < 2 * bend_px else None


def hide_across(
    draft: Draft, rng: np.random.Generator, length: tuple[int, int], which: tuple[str, ...], share: float = 0.6
) -> None:
    """Occlude spots for some frames across corners, in separate intervals."""
    free = CLEAN_FRAMES + 2
    spots = np.unique(draft.spot_of)
    for corner in draft.corner_frames:
        frames = int(rng.integers(length[0], length[1] + 1))
        first = int(corner) + 1 - int(rng.integers(1, frames))
        if first < free or first + frames > len(draft.q) - 3 or rng.random() > share:
            continue
        free = first + frames + 8
        what = which[int(rng.integers(len(which)))]
        if what == "all":
            views = np.ones(len(draft.camera_of), dtype=bool)
        elif what == "screen":
            views = draft.camera_of == rng.integers(draft.camera_of.max() + 1)
        else:
            views = np.isin(draft.spot_of, rng.choice(spots, {"one": 1, "two": 2}[what], replace=False))
        draft.hidden[first : first + frames, views] = True
