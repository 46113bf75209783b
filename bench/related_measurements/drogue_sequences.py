"""Rendered sequences of one moving drogue: for the bench, the calibration of the confidence, and the tests.

Drawn at random: path, size, tilt, light, canopy, haze, defocus, noise, a moving background with distractors. Once in
each period something passes in front of the drogue and hides all of it for a few frames.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from geometry.arrays import Array
from geometry.camera import Camera
from geometry.pose import Pose
from studies.drogue.render import render_drogue
from studies.drogue.scene import BAR, DISC, DrogueBackground, DrogueLight, DrogueLook, DrogueScene, Occluder

SIZE_PX = (640, 480)
FOCAL_PX, RADIUS_M = 600.0, 0.3  # 9 px at 40 m
PERIOD = 100  # frames between two occlusions
HIDDEN_FRAMES = (3, 8)  # range of the frames in which all of the drogue is hidden
_BLUR_SHARE = 0.4  # of the motion between two frames that the exposure covers


_BESIDE = Pose(np.eye(3), np.array([60.0, 0.0, 20.0]))  # outside the picture


@dataclass(frozen=True, slots=True)
class SequenceFrame:
    """One picture and its drogue."""

    picture: NDArray[np.uint8]  # (h, w) grey
    centre_px: Array  # (2,) of the image of the rim
    diameter_px: float  # its longest
    hidden: float  # share of the rim


@dataclass(frozen=True, slots=True)
class _Course:
    """What a sequence draws once."""

    uv_px: Array  # (n, 2) path of the centre
    diameter_px: Array  # (n,)
    tilt_rad: Array  # (n, 3)
    scene: DrogueScene
    drift_px: Array  # (n, 2) of the background
    light: Array  # (n, 2) ambient, diffuse


def moving_drogue(
    seed: int, frames: int, diameters_px: tuple[float, float] = (9.0, 9.0), hiding: bool = True, empty: bool = False
) -> Iterator[SequenceFrame]:
    """A drogue whose diameter goes from one random value of a range to another one.

    hiding: something passes in front of it once in each PERIOD. empty: without a drogue; its centre is nan.
    """
    rng = np.random.default_rng([seed, 31])
    course = _course(rng, frames, diameters_px)
    passing = _passing(rng, frames) if hiding else {}
    for k in range(frames):
        centre, diameter = course.uv_px[k], float(course.diameter_px[k])
        last = course.uv_px[max(k - 1, 0)]
        motion = _BLUR_SHARE * (centre - last)
        ambient, diffuse = course.light[k].tolist()
        drift = course.drift_px[k].tolist()
        scene = replace(
            course.scene,
            world_from_drogue=_BESIDE if empty else _pose(centre, diameter, course.tilt_rad[k]),
            light=replace(course.scene.light, ambient=ambient, diffuse=diffuse),
            background=replace(course.scene.background, offset_px=(drift[0], drift[1])),
            motion_px=(float(motion[0]), float(motion[1])),
            occluders=_in_front(passing, k, centre, diameter),
        )  # fmt: skip
        drawn = render_drogue(scene, rng)
        grey = np.asarray(cv2.cvtColor(drawn.image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
        if empty:
            yield SequenceFrame(grey, np.full(2, np.nan), float("nan"), 1.0)
            continue
        yield SequenceFrame(grey, drawn.ellipse.centre_px, 2 * drawn.ellipse.major_px, drawn.hidden)


def _course(rng: np.random.Generator, frames: int, diameters_px: tuple[float, float]) -> _Course:
    first, last = rng.uniform(np.log(diameters_px[0]), np.log(diameters_px[1]), 2).tolist()
    diameter = np.exp(np.linspace(first, last, frames))
    t = np.arange(frames, dtype=float)
    largest = float(diameter.max())
    room = np.maximum(np.array(SIZE_PX) / 2 - 0.6 * largest - 10, 10)
    # Sway of the drogue and motion of the camera: slow large waves and fast small ones, px.
    uv = (np.array(SIZE_PX) - 1) / 2 + _waves(rng, t, rng.uniform(0.3, 0.8) * room, (120, 400))
    uv += _waves(rng, t, np.full(2, rng.uniform(0.5, 4.0)), (12, 40))
    # The background moves with the camera: in part as the drogue, in part against it.
    drift = _waves(rng, t, rng.uniform(20, 100, 2), (100, 400)) + _waves(rng, t, rng.uniform(0.2, 3.0, 2), (12, 40))
    tilt = np.radians(rng.uniform(3, 15)) * np.stack([_wave(rng, t, (60, 200)) for _ in range(3)], axis=1)
    ambient = rng.uniform(0.25, 0.75)
    level = 1 + rng.uniform(0, 0.2) * _wave(rng, t, (60, 300))  # clouds before the sun
    light = np.stack([ambient * level, (1 - ambient) * level], axis=1)
    towards = rng.normal([0.0, -0.8, -0.6], 1.0)
    towards /= np.linalg.norm(towards)
    shade = rng.uniform(0.5, 1.0)
    camera = Camera(
        "camera", "", SIZE_PX,
        np.array([[FOCAL_PX, 0, (SIZE_PX[0] - 1) / 2], [0, FOCAL_PX, (SIZE_PX[1] - 1) / 2], [0, 0, 1]]),
        (), Pose(np.eye(3), np.zeros(3)),
    )  # fmt: skip
    scene = DrogueScene(
        camera, _pose(uv[0], float(diameter[0]), tilt[0]), RADIUS_M,
        look=DrogueLook(
            canopy_bgr=(225 * shade, 228 * shade, 230 * shade), gore_contrast=float(rng.uniform(0.0, 0.3)),
            ribs=int(rng.integers(10, 25)), rib_share=float(rng.uniform(0.25, 0.55)),
        ),
        light=DrogueLight((float(towards[0]), float(towards[1]), float(towards[2])), 0.5, 0.5),
        background=DrogueBackground(
            ("sky", "clouds", "ground")[int(rng.integers(3))], int(rng.integers(2**31)),
            brightness_dn=float(rng.uniform(60, 180)), contrast_dn=float(rng.uniform(10, 60)),
            clutter=int(rng.integers(0, 5)),
        ),
        blur_px=float(rng.uniform(0.4, 1.0)), noise_dn=float(rng.uniform(0.5, 6)),
        haze=float((rng.random() < 0.4) * rng.uniform(0, 0.4)),
    )  # fmt: skip
    return _Course(uv, diameter, tilt, scene, drift, light)


def _wave(rng: np.random.Generator, t: Array, periods: tuple[float, float]) -> Array:
    """Values (n,) between -1 and 1 of a sum of two sines with random periods, frames."""
    own = rng.uniform(*periods, 2)
    phase = rng.uniform(0, 2 * np.pi, 2)
    return 0.5 * (np.sin(2 * np.pi * t / own[0] + phase[0]) + np.sin(2 * np.pi * t / own[1] + phase[1]))


def _waves(rng: np.random.Generator, t: Array, size_px: Array, periods: tuple[float, float]) -> Array:
    return np.stack([size * _wave(rng, t, periods) for size in size_px.tolist()], axis=1)


def _pose(centre_px: Array, diameter_px: float, tilt_rad: Array) -> Pose:
    distance = 2 * RADIUS_M * FOCAL_PX / diameter_px
    u, v = (centre_px - (np.array(SIZE_PX) - 1) / 2) / FOCAL_PX
    return Pose(Rotation.from_rotvec(tilt_rad).as_matrix(), distance * np.array([u, v, 1.0]))


@dataclass(frozen=True, slots=True)
class _Passing:
    """Something that passes in front of the drogue: in its diameters and frames, relative to the drogue."""

    middle: float  # frame in which it is in front of it
    frames: float  # in which it hides all of it
    angle_rad: float  # direction of its motion
    kind: str
    grey: float


_WIDTH = 2.0  # of what passes, in diameters of the drogue


def _passing(rng: np.random.Generator, frames: int) -> dict[int, _Passing]:
    """By number of the period."""
    out = {}
    for n in range(frames // PERIOD + 1):
        middle = n * PERIOD + rng.uniform(0.5, 0.8) * PERIOD
        kind = (BAR, DISC)[int(rng.integers(2))]
        out[n] = _Passing(
            middle,
            float(rng.uniform(*HIDDEN_FRAMES)),
            float(rng.uniform(0, 2 * np.pi)),
            kind,
            float(rng.uniform(30, 160)),
        )
    return out


def _in_front(passing: dict[int, _Passing], k: int, centre_px: Array, diameter_px: float) -> tuple[Occluder, ...]:
    p = passing.get(k // PERIOD)
    if p is None:
        return ()
    # All of the drogue is hidden while the centres are less than (width - 1) / 2 diameters apart.
    along = (k - p.middle) / p.frames * (_WIDTH - 1)
    if abs(along) > 2 * _WIDTH:
        return ()
    way = np.array([np.cos(p.angle_rad), np.sin(p.angle_rad)])
    end = centre_px + along * diameter_px * way
    side = np.array([-way[1], way[0]])
    if p.kind == BAR:
        end = end + 1.5 * diameter_px * side
    start = end - 900 * side
    grey = (p.grey,) * 3
    return (
        Occluder(
            (float(end[0]), float(end[1])), _WIDTH * diameter_px, (float(start[0]), float(start[1])), p.kind, grey
        ),
    )
