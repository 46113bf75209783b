"""Rendered pictures of drogues with everything drawn at random, for training, validation and test.

Training and validation have the backgrounds sky, clouds and ground, and roads, arcs, letters and ridges
(structured.py); the test has backgrounds of its own kind, made of stripes, checks, blobs and walls of random polygons,
which no training picture shows.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from geometry.camera import Camera
from geometry.pose import Pose
from lab.learned_detector.structured import structured_picture
from lab.simulate.drogue.background import fractal_noise
from lab.simulate.drogue.render import render_drogue
from lab.simulate.drogue.scene import PICTURE, DrogueBackground, DrogueLight, DrogueLook, DrogueScene, Occluder

Grey = NDArray[np.uint8]

EMPTY_SHARE = 0.3  # of the samples that show no drogue
STRUCTURED_SHARE = 0.5  # of the backgrounds of training
RADIUS_M = 0.3


@dataclass(frozen=True, slots=True)
class Sample:
    """A picture and its drogue: centre and diameter of the rim, px; nan without one."""

    image: Grey  # (h, w)
    centre_px: tuple[float, float]
    diameter_px: float


def draw_sample(
    rng: np.random.Generator,
    size_px: tuple[int, int],
    diameters_px: tuple[float, float],
    unseen: bool = False,
    empty: bool | None = None,
) -> Sample:
    """A random picture (size_px: width, height) whose drogue has a diameter in a range (log-uniform).

    unseen: with a background that training never shows. empty: without a drogue; None: at random.
    """
    width, height = size_px
    if empty is None:
        empty = bool(rng.random() < EMPTY_SHARE)
    diameter = float(np.exp(rng.uniform(*np.log(diameters_px))))
    centre = rng.uniform([0.0, 0.0], [width - 1.0, height - 1.0])
    if not empty and min(width, height) > 1.5 * diameter:
        centre = rng.uniform([0.3 * diameter] * 2, [width - 1 - 0.3 * diameter, height - 1 - 0.3 * diameter])
    scene = _scene(rng, size_px, (float(centre[0]), float(centre[1])), diameter, unseen, empty)
    drawn = render_drogue(scene, rng)
    grey = np.asarray(cv2.cvtColor(drawn.image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    if empty:
        return Sample(grey, (float("nan"), float("nan")), float("nan"))
    ellipse = drawn.ellipse
    return Sample(grey, (float(ellipse.centre_px[0]), float(ellipse.centre_px[1])), 2 * ellipse.major_px)


def _scene(
    rng: np.random.Generator,
    size_px: tuple[int, int],
    centre: tuple[float, float],
    diameter: float,
    unseen: bool,
    empty: bool,
) -> DrogueScene:
    width, height = size_px
    focal = 2.0 * max(width, 200)
    distance = 2 * RADIUS_M * focal / diameter
    matrix = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    camera = Camera("camera", "", size_px, matrix, (), Pose(np.eye(3), np.zeros(3)))
    place = distance * np.array([(centre[0] - matrix[0, 2]) / focal, (centre[1] - matrix[1, 2]) / focal, 1.0])
    tilt = Rotation.from_rotvec(np.radians(rng.normal(0, 12, 3).clip(-30, 30))).as_matrix()
    if empty:
        place, tilt = distance * np.array([3.0, 0.0, 1.0]), np.eye(3)  # beside the picture
    towards = rng.normal([0.0, -0.8, -0.6], 1.0)
    towards /= np.linalg.norm(towards)
    ambient = rng.uniform(0.25, 0.75)
    light = DrogueLight((float(towards[0]), float(towards[1]), float(towards[2])), ambient, float(1 - ambient))
    shade = rng.uniform(0.35, 1.0)
    look = DrogueLook(
        canopy_bgr=(225 * shade, 228 * shade, 230 * shade),
        canopy_inner=float(rng.uniform(0.72, 0.88)),
        gore_contrast=float(rng.uniform(0.0, 0.3)),
        ribs=int(rng.integers(10, 25)),
        rib_share=float(rng.uniform(0.25, 0.55)),
        depth=float(rng.uniform(0.6, 1.2)),
        rear=float(rng.uniform(0.2, 0.45)),
    )
    blur = float(rng.uniform(0.4, 1.0) + (rng.random() < 0.3) * rng.uniform(0, 0.05) * diameter)
    motion = rng.normal(0, 0.04 * diameter, 2)
    return DrogueScene(
        camera,
        Pose(tilt, place),
        RADIUS_M,
        look=look,
        light=light,
        background=_background(rng, size_px, unseen, diameter),
        blur_px=blur,
        motion_px=(float(motion[0]), float(motion[1])),
        noise_dn=float(rng.uniform(0.5, 8)),
        haze=float((rng.random() < 0.4) * rng.uniform(0, 0.5)),
        occluders=() if empty else _occluders(rng, centre, diameter),
    )


def _occluders(rng: np.random.Generator, centre: tuple[float, float], diameter: float) -> tuple[Occluder, ...]:
    """The probe in front of the drogue in a third of the samples."""
    if rng.random() > 0.35:
        return ()
    side = rng.uniform(0, 2 * np.pi)
    along = np.array([np.cos(side), np.sin(side)])
    end = np.array(centre) + rng.uniform(0.0, 0.6) * diameter * along
    start = end + 900 * along
    grey = float(rng.uniform(30, 160))
    return (
        Occluder(
            (float(end[0]), float(end[1])),
            float(rng.uniform(0.08, 0.22) * diameter),
            (float(start[0]), float(start[1])),
            bgr=(grey, grey, grey),
        ),
    )


def _background(rng: np.random.Generator, size_px: tuple[int, int], unseen: bool, diameter: float) -> DrogueBackground:
    seed = int(rng.integers(2**31))
    if unseen:
        return DrogueBackground(PICTURE, seed, picture=_unseen_picture(rng, size_px))
    if rng.random() < STRUCTURED_SHARE:
        clutter = int(rng.integers(0, 4))
        return DrogueBackground(PICTURE, seed, picture=structured_picture(rng, size_px), clutter=clutter)
    kind = ("sky", "clouds", "ground")[int(rng.integers(3))]
    return DrogueBackground(
        kind,
        seed,
        brightness_dn=float(rng.uniform(50, 200)),
        contrast_dn=float(rng.uniform(10, 70)),
        clutter=int(rng.integers(0, 6)),
    )


def _unseen_picture(rng: np.random.Generator, size_px: tuple[int, int]) -> NDArray[np.uint8]:
    """Stripes, checks, blobs or polygons under an uneven light: the backgrounds of the test."""
    width, height = size_px
    v, u = np.mgrid[:height, :width].astype(np.float32)
    kind = int(rng.integers(4))
    turn, period = rng.uniform(0, np.pi), float(np.exp(rng.uniform(np.log(6), np.log(80))))
    x, y = u * np.cos(turn) + v * np.sin(turn), v * np.cos(turn) - u * np.sin(turn)
    if kind == 0:
        field = np.sign(np.sin(2 * np.pi * x / period))
    elif kind == 1:
        field = np.sign(np.sin(2 * np.pi * x / period) * np.sin(2 * np.pi * y / period))
    elif kind == 2:
        field = np.tanh(3 * fractal_noise(rng, size_px, int(rng.integers(4, 16)), 0.5))
    else:
        picture = np.zeros((height, width), np.float32)
        for _ in range(int(rng.integers(10, 40))):
            at = rng.uniform([0, 0], [width, height]) + rng.normal(0, 0.15 * width, (int(rng.integers(3, 7)), 2))
            cv2.fillPoly(picture, [at.astype(np.int32)], float(rng.uniform(-1, 1)), cv2.LINE_AA)
        field = picture
    field = cv2.GaussianBlur(np.asarray(field, np.float32), (0, 0), float(rng.uniform(0.5, 2)))
    level = rng.uniform(60, 180) + rng.uniform(5, 45) * field + 10 * fractal_noise(rng, size_px, 3, 1.0)
    grey = np.clip(level, 0, 255).astype(np.uint8)
    return np.asarray(cv2.merge([grey, grey, grey]), dtype=np.uint8)
