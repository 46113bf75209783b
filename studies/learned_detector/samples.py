"""Samples for the training of the learned detector: backgrounds, rendered drogues, and how they are varied."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from geometry.arrays import Array, Bools
from geometry.camera import Camera
from geometry.pose import Pose
from studies.drogue.render import background_picture, fractal_noise, render_drogue
from studies.drogue.scene import PICTURE, DrogueBackground, DrogueLight, DrogueLook, DrogueScene, Floats32, Occluder

# Structured backgrounds of training.
#
# They teach the network that patterns of all kinds are no drogue. None of them is of the kinds of the test (stripes,
# checks, blobs, walls of polygons; samples.py).

_FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_TRIPLEX, cv2.FONT_HERSHEY_SCRIPT_SIMPLEX)
_LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789&%#?"


def structured_picture(rng: np.random.Generator, size_px: tuple[int, int]) -> NDArray[np.uint8]:
    """A random picture (h, w, 3) of one or two kinds under an uneven light; size_px: width, height."""
    draw = (_roads, _arcs, _letters, _ridges, _plots, _crowns, _boxes, _swell)
    field = draw[int(rng.integers(len(draw)))](rng, size_px)
    if rng.random() < 0.35:
        field = field + np.float32(rng.uniform(0.3, 1.0)) * draw[int(rng.integers(len(draw)))](rng, size_px)
    smooth = cv2.GaussianBlur(field, (0, 0), float(np.exp(rng.uniform(np.log(0.3), np.log(2.0)))))
    uneven = 12 * fractal_noise(rng, size_px, 3, 1.0)
    fine = rng.uniform(0, 12) * fractal_noise(rng, size_px, 12, float(rng.uniform(0.2, 0.8)))
    level = rng.uniform(30, 210) + rng.uniform(5, 90) * smooth + uneven + fine
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


def _plots(rng: np.random.Generator, size_px: tuple[int, int]) -> Floats32:
    """Land or walls, divided by straight or bent borders; each plot has its level, and some have rows."""
    width, height = size_px
    v, u = np.mgrid[:height, :width].astype(np.float32)
    bend = np.float32(rng.choice([0.0, rng.uniform(0, 0.1) * width]))
    u, v = u + bend * fractal_noise(rng, size_px, 3, 1.0), v + bend * fractal_noise(rng, size_px, 3, 1.0)
    plot = np.zeros((height, width), int)
    for turn in rng.uniform(0, np.pi, int(rng.integers(2, 8))):
        offset = (u - rng.uniform(0, width)) * np.cos(turn) + (v - rng.uniform(0, height)) * np.sin(turn)
        plot = 2 * plot + (offset > 0)
    level, rows = rng.uniform(-1, 1, 128), rng.uniform(0, 0.5, 128) * (rng.random(128) < 0.4)
    turns, pitch = rng.uniform(0, np.pi, 128), 2 * np.pi / np.exp(rng.uniform(np.log(3), np.log(25), 128))
    phase = pitch[plot] * (u * np.cos(turns)[plot] + v * np.sin(turns)[plot])
    return np.asarray(level[plot] + rows[plot] * np.sin(phase), np.float32)


def _crowns(rng: np.random.Generator, size_px: tuple[int, int]) -> Floats32:
    """Trees, bushes or stones: rounded bodies with a lit side, a shaded side and black gaps between them."""
    width, height = size_px
    field = np.asarray(rng.uniform(-1, 0.3) + 0.2 * fractal_noise(rng, size_px, 6, 0.8), np.float32)
    largest = float(np.exp(rng.uniform(np.log(2.0), np.log(14.0))))
    light = rng.normal(0, 0.3, 2)
    for _ in range(int(min(rng.uniform(0.1, 1.2) * width * height / largest**2 / 2, 150))):
        at, radius = rng.uniform([0, 0], [width, height]), largest * rng.uniform(0.4, 1.0)
        level, axes = float(rng.uniform(-0.7, 0.3)), rng.uniform(0.7, 1.0, 2) * radius
        for share, gain in ((1.0, 0.0), (0.75, 0.35), (0.4, 0.6)):
            place = tuple(int(8 * x) for x in at + (1 - share) * radius * light)
            reach = tuple(max(int(8 * share * x), 4) for x in axes)
            cv2.ellipse(field, place, reach, float(rng.uniform(0, 180)), 0, 360, level + gain, -1, cv2.LINE_AA, 3)
    return field


def _boxes(rng: np.random.Generator, size_px: tuple[int, int]) -> Floats32:
    """Houses with roofs of two sides and a shadow, furniture, windows: rectangles, alone or in rows."""
    width, height = size_px
    field = np.zeros((height, width), np.float32)
    grid, largest = rng.uniform(0, np.pi), float(np.exp(rng.uniform(np.log(5), np.log(0.5 * width))))
    for _ in range(int(rng.integers(3, 40))):
        at = rng.uniform([0, 0], [width, height])
        a, b = largest * rng.uniform(0.2, 0.6, 2)
        turn = grid + rng.choice([0.0, np.pi / 2, rng.normal(0, 0.3)])
        axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        shadow, level, fold = rng.uniform(-0.4, 0.4, 2) * b, _level(rng), float(rng.normal(0, 0.4))
        sides = ((shadow, -1.0, 1.0, -1.0), ((0, 0), -1.0, 1.0, level), ((0, 0), 0.0, 1.0, level + fold))
        for move, low, high, value in sides:
            corners = np.array([[-a, low * b], [a, low * b], [a, high * b], [-a, high * b]]) @ axes + at + move
            cv2.fillPoly(field, [np.round(8 * corners).astype(np.int32)], value, cv2.LINE_AA, 3)
    return field


def _swell(rng: np.random.Generator, size_px: tuple[int, int]) -> Floats32:
    """Water: waves of near directions, shorter towards the horizon, with bright glints."""
    width, height = size_px
    v, u = np.mgrid[:height, :width].astype(np.float32)
    depth = np.log1p(rng.uniform(0.1, 3) * v / height) * height
    field, main = np.zeros((height, width), np.float32), rng.uniform(0, np.pi)
    for _ in range(int(rng.integers(2, 7))):
        turn, pitch = main + rng.normal(0, 0.5), 2 * np.pi / np.exp(rng.uniform(np.log(4), np.log(60)))
        field += np.sin(pitch * (u * np.cos(turn) + depth * np.sin(turn)) + rng.uniform(0, 6) + 2 * field)
    glint = fractal_noise(rng, size_px, width // 4, 0.3) + 0.3 * field > rng.uniform(2.2, 4)
    return np.asarray(0.4 * field + rng.uniform(0, 3) * glint, np.float32)


# Pictures of drogues with everything drawn at random, for training, validation and test.
#
# Training and validation have the backgrounds sky, clouds and ground, and those above; the test has backgrounds of its
# own kind, made of stripes, checks, blobs and walls of random polygons, which no training picture shows. Half of the
# drogues of training are those of studies/drogue, the others are painted: of any level, inside and light.


Grey = NDArray[np.uint8]

EMPTY_SHARE = 0.4  # of the samples that show no drogue
STRUCTURED_SHARE = 0.75  # of the backgrounds of training
PAINTED_SHARE = 0.6  # of the drogues of training
_LEAST_CONTRAST_DN = 35.0  # between the canopy and what it encloses
RADIUS_M = 0.3


@dataclass(frozen=True, slots=True)
class Sample:
    """A picture and its drogue: centre and diameter of the rim, px; nan without one."""

    image: Grey  # (h, w)
    centre_px: tuple[float, float]
    diameter_px: float
    beside: tuple[tuple[float, float, float], ...] = ()  # further drogues: centre u, v and diameter, px


def draw_sample(
    rng: np.random.Generator,
    size_px: tuple[int, int],
    diameters_px: tuple[float, float],
    unseen: bool = False,
    empty: bool | None = None,
    beside: int = 0,
) -> Sample:
    """A random picture (size_px: width, height) whose drogue has a diameter in a range (log-uniform).

    unseen: with a background that training never shows. empty: without a drogue; None: at random. beside: largest
    number of further drogues, which cost no time in training; with them comes what is no drogue (`_paint_decoy`).
    """
    if empty is None:
        empty = bool(rng.random() < EMPTY_SHARE)
    u, v, diameter = _place(rng, size_px, diameters_px)
    painted = empty or (not unseen and rng.random() < PAINTED_SHARE)
    if painted:
        colours: np.ndarray = background_picture(_background(rng, size_px, unseen), size_px)
    else:
        drawn = render_drogue(_scene(rng, size_px, (u, v), diameter, unseen), rng)
        colours, (u, v) = drawn.image, drawn.ellipse.centre_px.tolist()
        diameter = 2 * drawn.ellipse.major_px
    grey = np.asarray(cv2.cvtColor(colours, cv2.COLOR_BGR2GRAY), np.float32)
    if unseen and not empty:
        return Sample(grey.astype(np.uint8), (u, v), diameter)
    truth = [] if empty else [(u, v, diameter)]
    for _ in range(int(rng.integers(0, 7)) if painted and beside else 0):
        _paint_decoy(rng, grey, diameters_px)
    for number in range(0 if empty else 1 + beside):
        own = truth[0] if number == 0 else _place(rng, size_px, diameters_px)
        apart = all(np.hypot(own[0] - t[0], own[1] - t[1]) > 0.7 * (own[2] + t[2]) for t in truth)
        if apart or (number == 0 and painted):
            _paint_drogue(rng, grey, own[:2], own[2])
        truth += [own] if apart else []
    nothing = float("nan")
    u, v, size = truth[0] if truth else (nothing, nothing, nothing)
    return Sample(_exposed(rng, grey, diameter), (u, v), size, tuple(truth[1:]))


def _place(
    rng: np.random.Generator, size_px: tuple[int, int], diameters_px: tuple[float, float]
) -> tuple[float, float, float]:
    """Centre u, v and diameter, px, of a drogue that is for the most part in the picture, if it is no larger."""
    width, height = size_px
    diameter = float(np.exp(rng.uniform(*np.log(diameters_px))))
    u, v = rng.uniform([0.0, 0.0], [width - 1.0, height - 1.0])
    if min(width, height) > 1.5 * diameter:
        u, v = rng.uniform([0.3 * diameter] * 2, [width - 1 - 0.3 * diameter, height - 1 - 0.3 * diameter])
    return float(u), float(v), diameter


def _scene(
    rng: np.random.Generator,
    size_px: tuple[int, int],
    centre: tuple[float, float],
    diameter: float,
    unseen: bool,
) -> DrogueScene:
    width, height = size_px
    focal = 2.0 * max(width, 200)
    distance = 2 * RADIUS_M * focal / diameter
    matrix = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    camera = Camera("camera", "", size_px, matrix, (), Pose(np.eye(3), np.zeros(3)))
    place = distance * np.array([(centre[0] - matrix[0, 2]) / focal, (centre[1] - matrix[1, 2]) / focal, 1.0])
    tilt = Rotation.from_rotvec(np.radians(rng.normal(0, 12, 3).clip(-30, 30))).as_matrix()
    towards = rng.normal([0.0, -0.8, -0.6], 1.0)
    towards /= np.linalg.norm(towards)
    ambient = rng.uniform(0.25, 0.75)
    light = DrogueLight((float(towards[0]), float(towards[1]), float(towards[2])), ambient, float(1 - ambient))
    shade = rng.uniform(0.35, 1.0)
    # The test keeps the look of standard drogues; training has inner parts of all levels.
    usual = DrogueLook()
    inner = (usual.rib_bgr, usual.lining_bgr, usual.coupling_bgr)
    if not unseen:
        rib, lining, coupling = rng.uniform([30, 5, 20], [250, 150, 255]).tolist()
        inner = ((rib,) * 3, (lining,) * 3, (coupling,) * 3)
    look = DrogueLook(
        canopy_bgr=(225 * shade, 228 * shade, 230 * shade),
        canopy_inner=float(rng.uniform(0.72 if unseen else 0.55, 0.88)),
        rib_bgr=inner[0],
        lining_bgr=inner[1],
        coupling_bgr=inner[2],
        hose_radius=0.1 if unseen else float(rng.uniform(0.04, 0.2)),
        gore_contrast=float(rng.uniform(0.0, 0.3)),
        ribs=int(rng.integers(10, 25)),
        rib_share=float(rng.uniform(0.25, 0.55)),
        depth=float(rng.uniform(0.6, 1.2)),
        rear=float(rng.uniform(0.2, 0.45)),
    )
    # Training adds defocus and noise later, for all drogues of a picture.
    blur = float(unseen) * float(rng.uniform(0.4, 1.0) + (rng.random() < 0.3) * rng.uniform(0, 0.05) * diameter)
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
        noise_dn=float(unseen) * float(rng.uniform(0.5, 8)),
        haze=float((rng.random() < 0.4) * rng.uniform(0, 0.5)),
        occluders=_occluders(rng, centre, diameter),
    )


def _paint_drogue(rng: np.random.Generator, picture: Floats32, centre: tuple[float, float], diameter: float) -> None:
    """Blend a drogue of any look into a picture (h, w): hose, cone, canopy, ribs, ring, coupling, probe, shadow.

    Lengths in radii of the rim; its plane is tilted about an axis across `axis`, in whose direction deeper parts move.
    """
    radius, fine = diameter / 2, int(np.clip(np.ceil(60 / diameter), 2, 6))
    turn, tilt = rng.uniform(0, 2 * np.pi), np.radians(min(abs(rng.normal(0, 16)), 40))
    axis, deep = np.array([np.cos(turn), np.sin(turn)]), rng.uniform(0.3, 1.4)
    inner, hub, rear = rng.uniform(0.5, 0.93), rng.uniform(0.1, 0.38), rng.uniform(0.3, 0.7)
    side, towards = rng.uniform(0, 0.9), rng.uniform(0, 2 * np.pi)
    canopy = float(rng.uniform(15, 250))
    floor = float(rng.choice([rng.uniform(5, 0.6 * canopy + 5), rng.uniform(5, 250)]))
    if abs(floor - canopy) < _LEAST_CONTRAST_DN:
        floor = canopy + (_LEAST_CONTRAST_DN + 30) * (1 if canopy < 90 else -1)
    _paint_hose(
        rng, picture, np.array(centre) + radius * np.sin(tilt) * deep * axis, radius, axis if tilt > 0.1 else None
    )
    low = np.floor(np.array(centre)).astype(int) - round(0.9 * diameter) - 3
    n = 2 * round(0.9 * diameter) + 7
    points = (np.arange(n * fine) + 0.5) / fine - 0.5
    x = ((points + low[0] - centre[0]) / radius)[None, :].astype(np.float32)
    y = ((points + low[1] - centre[1]) / radius)[:, None].astype(np.float32)
    across, along0 = y * axis[0] - x * axis[1], x * axis[0] + y * axis[1]
    along = along0 / np.cos(tilt)
    rho, theta = np.hypot(along, across), np.arctan2(y, x)
    lit = (1 - side / 2 + side / 2 * np.cos(theta - towards)).astype(np.float32)
    level, alpha = np.full(rho.shape, canopy * rng.uniform(0.3, 0.9), np.float32), np.zeros(rho.shape, np.float32)
    if rng.random() < 0.6:  # the outer side of the cone
        for share in (0.25, 0.5, 0.75, 1.0):
            cone = np.hypot(along - share * deep * np.tan(tilt), across) < 1 + share * (rear - 1)
            alpha[cone] = 1
        level *= lit
    ribs, phase, duty = int(rng.integers(6, 33)), rng.uniform(0, 1), rng.uniform(0.1, 0.7)
    turns = (theta / (2 * np.pi) * ribs + phase) % 1
    frill = 1 + rng.choice([0.0, rng.uniform(0, 0.04)]) * np.cos(2 * np.pi * turns)
    disc, ring = rho < frill, rho < inner
    level[disc], alpha[disc] = (canopy * lit * (1 - rng.uniform(0, 0.4) * rng.integers(0, 2) * (turns < 0.5)))[disc], 1
    if rng.random() < 0.3:
        level[disc & (rho > 1 - rng.uniform(0.03, 0.15))] = rng.uniform(10, 250)
    opposite = 1 - side / 2 - side / 2 * np.cos(theta - towards) * np.minimum(rho / inner, 1)
    inside = floor * opposite * (1 + rng.uniform(-0.6, 0.4) * (1 - rho / inner))
    level[ring] = inside[ring]
    if rng.random() < 0.7:
        rib = ring & (np.abs(turns - 0.5) < duty / 2)
        level[rib] = (rng.uniform(10, 250) * opposite)[rib]
        if rng.random() < 0.25:
            alpha[ring & ~rib] = rng.choice([0.0, 0.5])
    if rng.random() < 0.3:
        level[np.abs(rho - rng.uniform(0.35, 0.9) * inner) < rng.uniform(0.02, 0.08)] = rng.uniform(10, 250)
    if rng.random() < 0.75:
        away = np.hypot(along - min(deep * np.tan(tilt), inner - hub), across)
        level[away < hub], alpha[away < hub] = rng.uniform(10, 250), 1
        if rng.random() < 0.5:
            level[away < rng.uniform(0.3, 0.8) * hub] = rng.uniform(5, 250)
    if rng.random() < 0.15:  # a shadow across it
        level[x * np.cos(towards) + y * np.sin(towards) > rng.uniform(-0.7, 0.7)] *= np.float32(rng.uniform(0.3, 0.9))
    level += np.float32(rng.uniform(0, 0.5) * (rng.random() < 0.4)) * (picture.mean() - level)  # haze
    cover = cv2.resize(alpha, (n, n), interpolation=cv2.INTER_AREA)
    paint = cv2.resize(level * alpha, (n, n), interpolation=cv2.INTER_AREA)
    if rng.random() < 0.35:
        motion = np.zeros((2 * n + 1, 2 * n + 1), np.float32)
        line = np.round(16 * (n + np.outer([-1, 1], rng.normal(0, 0.05 * diameter, 2)))).astype(int)
        cv2.line(motion, tuple(line[0].tolist()), tuple(line[1].tolist()), 1.0, 1, cv2.LINE_AA, 4)
        kernel = motion[n - 4 : n + 5, n - 4 : n + 5] / motion[n - 4 : n + 5, n - 4 : n + 5].sum()
        cover, paint = cv2.filter2D(cover, -1, kernel), cv2.filter2D(paint, -1, kernel)
    first, last = np.maximum(low, 0), np.minimum(low + n, picture.shape[::-1])
    part = (slice(first[1] - low[1], last[1] - low[1]), slice(first[0] - low[0], last[0] - low[0]))
    piece = picture[first[1] : last[1], first[0] : last[0]]
    piece += paint[part] - cover[part] * piece
    for occluder in _occluders(rng, centre, diameter):
        ends = [tuple(int(8 * c) for c in p) for p in (occluder.start_px, occluder.end_px)]
        cv2.line(picture, ends[0], ends[1], occluder.bgr[0], max(round(occluder.width_px), 1), cv2.LINE_AA, 3)


def _paint_hose(rng: np.random.Generator, picture: Floats32, start: Array, radius: float, axis: Array | None) -> None:
    """A hose, straight or bent, from a point in the direction of an axis; None: in any direction, or hidden behind."""
    if rng.random() < 0.4:
        return
    turn = rng.uniform(0, 2 * np.pi) if axis is None else np.arctan2(axis[1], axis[0]) + rng.normal(0, 0.3)
    bends = turn + np.cumsum(np.concatenate([[0], rng.normal(0, rng.uniform(0, 0.15), 9)]))
    steps = radius * 3 * np.stack([np.cos(bends), np.sin(bends)], axis=1)
    path = start + np.concatenate([[[0, 0]], np.cumsum(steps, axis=0)])
    thick = max(round(radius * float(rng.uniform(0.06, 0.35))), 1)
    cv2.polylines(picture, [np.round(8 * path).astype(np.int32)], False, rng.uniform(5, 250), thick, cv2.LINE_AA, 3)


def _paint_decoy(rng: np.random.Generator, picture: Floats32, diameters_px: tuple[float, float]) -> None:
    """What a drogue is not: a plain disc or ball, a thin ring, a flat ellipse, half a ring, a square, a star, a roof.

    Small plain discs are none: a small drogue looks like one.
    """
    height, width = picture.shape
    at = rng.uniform([0, 0], [width, height])
    kind, level, turn = int(rng.integers(9)), float(rng.uniform(5, 250)), float(rng.uniform(0, 180))
    radius = float(np.exp(rng.uniform(np.log(0.15), 0))) * diameters_px[1] / 2
    radius = max(radius, 1.2 * diameters_px[0]) if kind < 2 else radius
    flat = float(rng.uniform(0.15, 0.5)) if kind == 2 else float(rng.uniform(0.75, 1))
    place, axes = tuple(int(8 * c) for c in at), (int(8 * radius), max(int(8 * flat * radius), 4))
    thick = -1 if kind < 2 else max(round((0.08 if kind == 3 else rng.uniform(0.1, 0.5)) * radius), 1)
    turns = np.radians(turn) + np.arange(4) * np.pi / 2
    if kind >= 7:
        turns = np.sort(turns + rng.normal(0, rng.choice([0.02, 0.3]), 4))[int(rng.random() < 0.25) :]
    corners = at + radius * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    outline = [np.round(8 * corners).astype(np.int32)]
    if kind == 4:
        cv2.ellipse(picture, place, axes, turn, 0, rng.uniform(60, 200), level, thick, cv2.LINE_AA, 3)
    elif kind == 5:
        cv2.polylines(picture, outline, True, level, thick, cv2.LINE_AA, 3)
    elif kind == 6:
        for far in corners:
            way = tuple(int(8 * c) for c in far)
            cv2.line(picture, place, way, level, max(round(0.2 * radius), 1), cv2.LINE_AA, 3)
    elif kind >= 7:  # roofs, patches, stones
        cv2.fillPoly(picture, outline, level, cv2.LINE_AA, 3)
    else:
        cv2.ellipse(picture, place, axes, turn, 0, 360, level, thick, cv2.LINE_AA, 3)
    if kind == 1:  # a ball
        for share in (0.8, 0.6, 0.4, 0.2):
            lit = tuple(int(8 * c) for c in at + 0.4 * (1 - share) * (corners[0] - at))
            inner = (max(int(share * axes[0]), 2), max(int(share * axes[1]), 2))
            cv2.ellipse(picture, lit, inner, turn, 0, 360, level + 60 * (1 - share), -1, cv2.LINE_AA, 3)


def _exposed(rng: np.random.Generator, picture: Floats32, diameter: float) -> Grey:
    """The picture (h, w) of a camera: defocus, gamma, noise fine and coarse, compression."""
    blur = float(rng.uniform(0.3, 1.0) + (rng.random() < 0.25) * rng.uniform(0, 0.05) * diameter)
    seen = np.asarray(cv2.GaussianBlur(picture, (0, 0), blur), np.float32)
    if rng.random() < 0.4:
        share = np.clip(seen, 0, 255) / 255
        seen = np.asarray(255 * share ** np.exp(rng.normal(0, 0.3)), np.float32)
    noise = rng.standard_normal(picture.shape, dtype=np.float32)
    if rng.random() < 0.25:
        noise = np.asarray(2 * cv2.GaussianBlur(noise, (0, 0), 0.7), np.float32)
    sigma = np.exp(rng.uniform(np.log(0.5), np.log(9)))
    grey = np.clip(np.rint(seen + np.float32(sigma) * noise), 0, 255).astype(np.uint8)
    if rng.random() < 0.3:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(25, 95))]
        grey = np.asarray(cv2.imdecode(cv2.imencode(".jpg", grey, quality)[1], cv2.IMREAD_GRAYSCALE), np.uint8)
    return grey


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
        clutter = int(rng.integers(0, 2))
        return DrogueBackground(PICTURE, seed, picture=structured_picture(rng, size_px), clutter=clutter)
    kind = ("sky", "clouds", "ground")[int(rng.integers(3))]
    return DrogueBackground(
        kind,
        seed,
        brightness_dn=float(rng.uniform(50, 200)),
        contrast_dn=float(rng.uniform(10, 70)),
        clutter=int(rng.integers(0, 3)),
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


RENDERED_PX, SIZE_PX = 128, 96  # sides of a rendered picture and of the part that is shown to the network
DIAMETERS_PX = (5.8, 44.0)  # one level of the pyramid; the detector uses 7 to 40
SMALL_PX, BESIDE = 16.0, 3  # largest diameter of half of the samples; further drogues of a picture
CHUNK = 1000  # samples in a file
# Levels of the pyramid: the picture itself and pictures reduced by these factors, with their shares of the samples.
REDUCED, REDUCED_SHARES = (1.0, 9 / 8, 9 / 4), (0.55, 0.35, 0.1)
_WARPED_SHARE, _LARGEST_SCALE = 0.5, 1.2

Pictures = NDArray[np.uint8]  # (n, side, side)


def level_sample(rng: np.random.Generator) -> Sample:
    """One random picture of RENDERED_PX squared as a level of the pyramid shows it: rendered larger, then reduced."""
    factor = float(rng.choice(REDUCED, p=REDUCED_SHARES))
    side = round(factor * RENDERED_PX)
    # Small ones are the harder ones: half of the samples show no large ones.
    largest = DIAMETERS_PX[1] if rng.random() < 0.5 else SMALL_PX
    sample = draw_sample(rng, (side, side), (factor * DIAMETERS_PX[0], factor * largest), beside=BESIDE)
    if side == RENDERED_PX:
        return sample
    image = cv2.resize(sample.image, (RENDERED_PX, RENDERED_PX), interpolation=cv2.INTER_AREA)
    middle_px = np.array([0.5, 0.5, 0.0])
    u, v, diameter = ((_truth(sample) + middle_px) / factor - middle_px).T
    others = tuple(zip(u[1:].tolist(), v[1:].tolist(), diameter[1:].tolist(), strict=True))
    return Sample(np.asarray(image, dtype=np.uint8), (float(u[0]), float(v[0])), float(diameter[0]), others)


def _truth(sample: Sample) -> Array:
    """Centre and diameter (1 + n, 3), px, of a sample's drogues."""
    return np.array([(*sample.centre_px, sample.diameter_px), *sample.beside])


def rendered(number: int, seed: int, folder: Path) -> tuple[Pictures, Array]:
    """Pictures (n, RENDERED_PX, RENDERED_PX) and truths (n, 1 + BESIDE, 3): centre u, v and diameter, px; nan: none.

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
            truth = np.full((CHUNK, 1 + BESIDE, 3), np.nan)
            for own, sample in zip(truth, drawn, strict=True):
                own[: 1 + len(sample.beside)] = _truth(sample)
            np.savez(part, images=np.stack([s.image for s in drawn]), truth=truth)
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
            wanted[i, ..., :2] -= left, top
    if rng.random() < 0.5:
        out, wanted = out[:, :, ::-1], wanted * [-1, 1, 1] + [SIZE_PX - 1, 0, 0]
    if rng.random() < 0.5:
        out, wanted = out.swapaxes(1, 2), wanted[..., [1, 0, 2]]
    gain = rng.uniform(0.5, 1.3, (len(out), 1, 1)).astype(np.float32)
    offset = rng.uniform(-25, 40, (len(out), 1, 1)).astype(np.float32)
    wanted[_outside(wanted)] = np.nan
    return np.asarray(np.clip(gain * out + offset, 0, 255) / 255, np.float32), wanted


def _outside(truth: Array) -> Bools:
    """Whether the centres of truths (..., 3) lie outside the part that is shown."""
    return np.asarray(((truth[..., :2] < -0.5) | (truth[..., :2] > SIZE_PX - 0.5)).any(axis=-1))


def middle(images: Pictures, truth: Array) -> tuple[NDArray[np.float32], Array]:
    """The middle parts (n, SIZE_PX, SIZE_PX) of pictures, in [0, 1], for validation."""
    cut = (RENDERED_PX - SIZE_PX) // 2
    wanted = truth - [cut, cut, 0]
    wanted[_outside(wanted)] = np.nan
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
    return np.asarray(out, dtype=np.float32), np.concatenate(
        [truth[..., :2] @ A.T + M[:, 2], scale * truth[..., 2:]], axis=-1
    )
