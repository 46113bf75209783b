"""A third renderer of drogues: for the choice between trainings of the learned detector, never for its figures.

It shares no code and no constants with the renderers of the training and of the figures. A drogue is a solid of flat
panels, projected from afar and drawn from the back to the front: cone, canopy, struts, coupling and hose.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array

BACKGROUNDS = ("sky", "cloud", "water", "ground", "trees")
SIZE = (640, 480)
_OVER = 4  # points of the canvas per pixel and axis


@dataclass(frozen=True, slots=True)
class Panels:
    """Flat panels with their corners in radii of the rim, z away from the camera, and their grey values."""

    corners: list[Array]  # each (n, 3)
    levels: list[float]
    hose: Array  # (n, 3)
    hose_level: float
    hose_radius: float


def background(kind: str, rng: np.random.Generator) -> Array:
    """A picture (h, w) in DN of one of BACKGROUNDS."""
    w, h = SIZE
    y, x = np.mgrid[:h, :w].astype(float)
    base, depth = rng.uniform(60, 190), rng.uniform(20, 60)
    fine = cv2.GaussianBlur(rng.normal(0, 1, (h, w)), (0, 0), 1.5) * rng.uniform(2, 12)
    if kind == "sky":
        return np.asarray(base + depth * (y / h - 0.5) + 0.1 * fine)
    if kind == "cloud":
        out = np.zeros((h, w))
        for _ in range(120):
            a, b, s = rng.uniform(0, w), rng.normal(h / 2, h / 4), rng.uniform(6, 60)
            out += s * np.exp(-((x - a) ** 2 + 2 * (y - b) ** 2) / (2 * s * s)) / 60
        return np.asarray(base + depth * np.tanh(out) + 0.15 * fine)
    if kind == "water":
        k = np.hypot(*np.meshgrid(np.fft.fftfreq(w), 2 * np.fft.fftfreq(h)))
        band = np.exp(-((np.log(k + 1e-9) - np.log(rng.uniform(0.02, 0.12))) ** 2))
        waves = np.fft.ifft2(band * np.fft.fft2(rng.normal(0, 1, (h, w)))).real
        waves /= waves.std()
        return np.asarray(base + 0.5 * depth * waves + 60 * np.maximum(waves - 2.3, 0))
    if kind == "trees":
        height = np.zeros((h, w))
        for a, b, s in zip(rng.uniform(0, w, 900), rng.uniform(0, h, 900), rng.uniform(4, 14, 900), strict=True):
            i, j, n = int(b), int(a), int(s)
            top, left = max(i - n, 0), max(j - n, 0)
            piece = height[top : i + n, left : j + n]
            gap = s * s - (x - a)[top : i + n, left : j + n] ** 2 - (y - b)[top : i + n, left : j + n] ** 2
            np.maximum(piece, np.sqrt(np.maximum(gap, 0)), out=piece)
        slope = np.gradient(height)
        return np.asarray(0.5 * base + depth * (np.tanh(height / 8) - 0.5 * np.tanh(slope[0] + slope[1])) + fine)
    seeds = rng.uniform([0, 0], [w, h], (int(rng.integers(8, 40)), 2))
    near = np.argmin([(x - a) ** 2 + (y - b) ** 2 for a, b in seeds], axis=0)
    out = base + depth * rng.uniform(-1, 1, len(seeds))[near] + fine
    for _ in range(int(rng.integers(0, 30))):
        turn, place = rng.uniform(0, np.pi), rng.uniform([0, 0], [w, h])
        box = cv2.boxPoints((tuple(place), tuple(rng.uniform(5, 30, 2)), np.degrees(turn)))
        cv2.fillConvexPoly(out, np.round(box).astype(np.int32), float(rng.uniform(10, 240)))
    for _ in range(int(rng.integers(0, 4))):
        ends = rng.uniform([0, 0], [w, h], (2, 2)).astype(int).tolist()
        cv2.line(out, ends[0], ends[1], float(rng.uniform(30, 220)), int(rng.integers(1, 9)))
    return np.asarray(cv2.GaussianBlur(out, (0, 0), 0.8))


def face(kind: str, rng: np.random.Generator, hose: bool = True) -> Panels:
    """A drogue, tilted by up to 20 degrees and lit from any side of the camera; kind: "drogue"."""
    count, struts = int(rng.integers(16, 40)), kind == "drogue"
    canopy, mouth = rng.uniform(0.62, 0.85), rng.uniform(0.15, 0.35)
    depth, end = rng.uniform(0.5, 1.2), rng.uniform(0.12, 0.3)
    cloth, metal, inside = rng.uniform(90, 245), rng.uniform(50, 230), rng.uniform(8, 80)
    if rng.random() < 0.25:
        cloth, inside = rng.uniform(10, 60), rng.uniform(110, 240)
    light = rng.normal(0, 1, 3) - [0, 0, 1]
    light /= np.linalg.norm(light)
    ambient = rng.uniform(0.3, 0.8)
    tilt = np.asarray(cv2.Rodrigues(np.radians(rng.uniform(-14, 14, 3)))[0], float)
    corners, levels = [], []

    def add(rows: list[tuple[float, float, float]], level: float) -> None:
        own = np.array(rows)
        normal = np.cross(own[1] - own[0], own[2] - own[0])
        normal /= np.linalg.norm(normal)
        cosine = abs(float(normal @ light)) if normal @ light * normal[2] > 0 else 0.1
        corners.append(own @ tilt.T)
        levels.append(level * (ambient + (1 - ambient) * cosine))

    def at(radius: float, z: float, step: float) -> tuple[float, float, float]:
        turn = 2 * np.pi * step / count
        return radius * np.cos(turn), radius * np.sin(turn), z

    for k in range(count):
        add([at(canopy, 0.1, k), at(canopy, 0.1, k + 1), at(end, depth, k + 1), at(end, depth, k)], inside)
        if struts:
            add(
                [
                    at(canopy, 0.1, k),
                    at(canopy, 0.1, k + 0.5),
                    at(mouth, 0.8 * depth, k + 0.5),
                    at(mouth, 0.8 * depth, k),
                ],
                metal,
            )
    add([at(end, 0.9 * depth, count * k / 12) for k in range(12)], rng.uniform(20, 230))
    for k in range(count):
        shade = cloth * (1 - 0.15 * (k % 2))
        add([at(1, 0, k), at(1, 0, k + 1), at(canopy, 0.1, k + 1), at(canopy, 0.1, k)], shade)
    sag = rng.normal(0, 0.02, 2)
    far = np.arange(0, 15) * 1.0
    line = np.stack([sag[0] * far**2, sag[1] * far**2, depth + far], axis=1) @ tilt.T
    return Panels(
        corners, levels, line[: None if hose else 1], float(rng.uniform(10, 200)), float(rng.uniform(0.05, 0.15))
    )


def draw(
    scene: Array, look: Panels | None, u: float, v: float, radius_px: float, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """The picture (h, w) of a background and a drogue whose rim has its centre at (u, v)."""
    canvas = scene.astype(np.float32)
    if look is not None:
        canvas = np.asarray(cv2.resize(canvas, None, fx=_OVER, fy=_OVER), np.float32)

        def image(points: Array) -> NDArray[np.int32]:
            place = (np.array([u, v]) + radius_px * points[:, :2] + 0.5) * _OVER - 0.5
            return np.round(place * 16).astype(np.int32)

        thick = max(round(2 * look.hose_radius * radius_px * _OVER), 1)
        cv2.polylines(canvas, [image(look.hose)], False, look.hose_level, thick, cv2.LINE_8, 4)
        for corners, level in zip(look.corners, look.levels, strict=True):
            cv2.fillConvexPoly(canvas, image(corners), level, cv2.LINE_8, 4)
        canvas = np.asarray(cv2.resize(canvas, SIZE, interpolation=cv2.INTER_AREA), np.float32)
    smooth = cv2.GaussianBlur(canvas, (0, 0), rng.uniform(0.5, 1.2))
    return np.clip(np.rint(smooth + rng.normal(0, rng.uniform(1, 5), smooth.shape)), 0, 255).astype(np.uint8)
