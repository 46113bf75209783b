"""Samples for the training of the learned detector: backgrounds, rendered drogues, and how they are varied."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from geometry.arrays import Array
from geometry.camera import Camera
from geometry.pose import Pose
from studies.drogue.render import fractal_noise, render_drogue
from studies.drogue.scene import PICTURE, DrogueBackground, DrogueLight, DrogueLook, DrogueScene, Floats32, Occluder

# Structured backgrounds of training: roads, arcs, letters and ridges.
#
# They teach the network that sharp man-made patterns are no drogue. None of them is of the kinds of the test (stripes,
# checks, blobs, walls of polygons; samples.py).

ROADS, ARCS, LETTERS, RIDGES = "roads", "arcs", "letters", "ridges"
KINDS = (ROADS, ARCS, LETTERS, RIDGES)
_FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_TRIPLEX, cv2.FONT_HERSHEY_SCRIPT_SIMPLEX)
_LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789&%#?"


def structured_picture(rng: np.random.Generator, size_px: tuple[int, int]) -> NDArray[np.uint8]:
    """A random picture (h, w, 3) of one of KINDS under an uneven light; size_px: width, height."""
    kind = KINDS[int(rng.integers(len(KINDS)))]
    draw = {ROADS: _roads, ARCS: _arcs, LETTERS: _letters, RIDGES: _ridges}[kind]
    field = cv2.GaussianBlur(draw(rng, size_px), (0, 0), float(rng.uniform(0.4, 2.0)))
    uneven = 12 * fractal_noise(rng, size_px, 3, 1.0)
    fine = rng.uniform(0, 12) * fractal_noise(rng, size_px, 12, float(rng.uniform(0.2, 0.8)))
    level = rng.uniform(50, 190) + rng.uniform(5, 55) * field + uneven + fine
    grey = np.clip(level, 0, 255).astype(np.uint8)
    return np.asarray(cv2.merge([grey, grey, grey]), dtype=np.uint8)


def _level(rng: np.random.Generator) -> float:
    return float(rng.choice([-1.0, 1.0]) * rng.uniform(0.3, 1.0))


def _roads(rng: np.random.Generator, size_px: tuple[int, int]) -> Floats32:
    """Straight and bent lines of all widths that cross each other."""
    width, height = size_px
    field = np.zeros((height, width), np.float32)
    for _ in range(int(rng.integers(4, 30))):
        start = rng.uniform([0, 0], [width, height])
        steps = rng.normal(0, 0.25 * width, (int(rng.integers(1, 5)), 2))
        path = np.concatenate([start[None], start + np.cumsum(steps, axis=0)]).astype(np.int32)
        thick = max(round(float(np.exp(rng.uniform(0, np.log(0.12 * width))))), 1)
        cv2.polylines(field, [path], False, _level(rng), thick, cv2.LINE_AA)
    return field


def _arcs(rng: np.random.Generator, size_px: tuple[int, int]) -> Floats32:
    """Parts of ellipses, thin and thick, open and closed."""
    width, height = size_px
    field = np.zeros((height, width), np.float32)
    for _ in range(int(rng.integers(4, 25))):
        at = tuple(int(x) for x in rng.uniform([0, 0], [width, height]))
        axes = tuple(max(int(x), 2) for x in np.exp(rng.uniform(np.log(0.04), np.log(0.6), 2)) * width)
        first, extent = rng.uniform(0, 360), rng.uniform(40, 330)
        thick = max(round(float(rng.uniform(0.03, 0.4) * min(axes))), 1)
        cv2.ellipse(field, at, axes, float(rng.uniform(0, 180)), first, first + extent, _level(rng), thick, cv2.LINE_AA)
    return field


def _letters(rng: np.random.Generator, size_px: tuple[int, int]) -> Floats32:
    """Letters and digits of all sizes."""
    width, height = size_px
    field = np.full((height, width), 128, np.uint8)  # OpenCV writes text on 8-bit pictures only
    for _ in range(int(rng.integers(4, 30))):
        text = "".join(rng.choice(list(_LETTERS), int(rng.integers(1, 5))))
        at = tuple(int(x) for x in rng.uniform([-0.1 * width, 0], [width, 1.1 * height]))
        scale = float(np.exp(rng.uniform(np.log(0.3), np.log(width / 60))))
        font, thick = _FONTS[int(rng.integers(len(_FONTS)))], max(round(scale * rng.uniform(0.7, 3)), 1)
        cv2.putText(field, text, at, font, scale, 128 + 127 * _level(rng), thick, cv2.LINE_AA)
    return (field.astype(np.float32) - 128) / np.float32(127)


def _ridges(rng: np.random.Generator, size_px: tuple[int, int]) -> Floats32:
    """Folds and cracks: the absolute value of smooth noise (Perlin 1985, turbulence), with either sign."""
    noise = fractal_noise(rng, size_px, int(rng.integers(3, 20)), float(rng.uniform(0.6, 1.2)))
    sharp = np.abs(noise) ** np.float32(rng.uniform(0.4, 1.0))
    return np.asarray((sharp - sharp.mean()) * np.float32(rng.choice([-2.0, 2.0])), np.float32)


# Rendered pictures of drogues with everything drawn at random, for training, validation and test.
#
# Training and validation have the backgrounds sky, clouds and ground, and roads, arcs, letters and ridges
# (structured.py); the test has backgrounds of its own kind, made of stripes, checks, blobs and walls of random
# polygons, which no training picture shows.


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
        background=_background(rng, size_px, unseen),
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


def _background(rng: np.random.Generator, size_px: tuple[int, int], unseen: bool) -> DrogueBackground:
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


# Pictures of one level of the detector's pyramid with their truth: rendered once, kept in files, changed at use.


RENDERED_PX, SIZE_PX = 144, 112  # sides of a rendered picture and of the part that is shown to the network
DIAMETERS_PX = (7.0, 44.0)  # one level of the pyramid; the detector uses 7 to 40
CHUNK = 1000  # samples in a file
# Levels of the pyramid: the picture itself and pictures reduced by these factors, with their shares of the samples.
REDUCED, REDUCED_SHARES = (1.0, 9 / 8, 9 / 4, 9 / 2), (0.35, 0.3, 0.27, 0.08)
_WARPED_SHARE, _LARGEST_SCALE = 0.5, 1.2

Pictures = NDArray[np.uint8]  # (n, side, side)


def level_sample(rng: np.random.Generator) -> Sample:
    """One random picture of RENDERED_PX squared as a level of the pyramid shows it: rendered larger, then reduced."""
    factor = float(rng.choice(REDUCED, p=REDUCED_SHARES))
    side = round(factor * RENDERED_PX)
    sample = draw_sample(rng, (side, side), (factor * DIAMETERS_PX[0], factor * DIAMETERS_PX[1]))
    if side == RENDERED_PX:
        return sample
    image = cv2.resize(sample.image, (RENDERED_PX, RENDERED_PX), interpolation=cv2.INTER_AREA)
    u, v = ((x + 0.5) / factor - 0.5 for x in sample.centre_px)
    return Sample(np.asarray(image, dtype=np.uint8), (u, v), sample.diameter_px / factor)


def rendered(number: int, seed: int, folder: Path) -> tuple[Pictures, Array]:
    """Pictures (n, RENDERED_PX, RENDERED_PX) and truths (n, 3): centre u, v and diameter, px; nan without one.

    Files of the folder are used again: an interrupted run continues where it was.
    """
    images, truths = [], []
    folder.mkdir(parents=True, exist_ok=True)
    for chunk in range(-(-number // CHUNK)):
        path = folder / f"samples_{seed}_{chunk}.npz"
        if not path.is_file():
            rng = np.random.default_rng([seed, chunk])
            drawn = [level_sample(rng) for _ in range(CHUNK)]
            part = path.with_suffix(".part.npz")
            truth = [(*s.centre_px, s.diameter_px) for s in drawn]
            np.savez(part, images=np.stack([s.image for s in drawn]), truth=np.array(truth))
            part.replace(path)
        with np.load(path) as file:
            images.append(file["images"])
            truths.append(file["truth"])
    return np.concatenate(images)[:number], np.concatenate(truths)[:number]


def augmented(images: Pictures, truth: Array, rng: np.random.Generator) -> tuple[NDArray[np.float32], Array]:
    """Parts (n, SIZE_PX, SIZE_PX) of pictures, in [0, 1], moved, mirrored, turned, scaled, with another contrast.

    A drogue whose centre leaves the part is no longer in the truth.
    """
    out, wanted = np.empty((len(images), SIZE_PX, SIZE_PX), np.float32), truth.copy()
    spare = RENDERED_PX - SIZE_PX
    for i, image in enumerate(images):
        left, top = rng.integers(0, spare + 1, 2)
        if rng.random() < _WARPED_SHARE:
            out[i], wanted[i] = _warped(image, truth[i], rng)
        else:
            out[i] = image[top : top + SIZE_PX, left : left + SIZE_PX]
            wanted[i, :2] -= left, top
    if rng.random() < 0.5:
        out, wanted = out[:, :, ::-1], wanted * [-1, 1, 1] + [SIZE_PX - 1, 0, 0]
    if rng.random() < 0.5:
        out, wanted = out.swapaxes(1, 2), wanted[:, [1, 0, 2]]
    gain = rng.uniform(0.5, 1.3, (len(out), 1, 1)).astype(np.float32)
    offset = rng.uniform(-25, 40, (len(out), 1, 1)).astype(np.float32)
    away = (wanted[:, :2] < -0.5).any(axis=1) | (wanted[:, :2] > SIZE_PX - 0.5).any(axis=1)
    wanted[away] = np.nan
    return np.asarray(np.clip(gain * out + offset, 0, 255) / 255, np.float32), wanted


def middle(images: Pictures, truth: Array) -> tuple[NDArray[np.float32], Array]:
    """The middle parts (n, SIZE_PX, SIZE_PX) of pictures, in [0, 1], for validation."""
    cut = (RENDERED_PX - SIZE_PX) // 2
    wanted = truth - [cut, cut, 0]
    wanted[(wanted[:, :2] < -0.5).any(axis=1) | (wanted[:, :2] > SIZE_PX - 0.5).any(axis=1)] = np.nan
    part = images[:, cut : cut + SIZE_PX, cut : cut + SIZE_PX]
    return part.astype(np.float32) / np.float32(255), wanted


def _warped(image: NDArray[np.uint8], truth: Array, rng: np.random.Generator) -> tuple[NDArray[np.float32], Array]:
    """A part of a picture, turned, scaled and moved by a random similarity, and its truth."""
    scale = float(np.exp(rng.uniform(-1, 1) * np.log(_LARGEST_SCALE)))
    turn, half = rng.uniform(0, 2 * np.pi), (RENDERED_PX - 1) / 2
    A = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    place = (SIZE_PX - 1) / 2 + rng.uniform(-16, 16, 2)
    M = np.column_stack([A, place - A @ [half, half]])
    size = (SIZE_PX, SIZE_PX)
    out = cv2.warpAffine(image, M, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    return np.asarray(out, dtype=np.float32), np.array([*(A @ truth[:2] + M[:, 2]), scale * truth[2]])
