"""Synthetic corners with known truth: one camera that sees a board in many poses, projected by OpenCV."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from calibration.lens.fit.corner_table import CornerTable
from geometry.arrays import Array
from geometry.rotations import exp

SIZE = (1280, 1024)
TRUTH = (1000.0, 1003.0, 630.0, 520.0, -0.2, 0.08, 0.001, -0.0008, -0.03)
WIDE = (500.0, 501.0, 640.0, 505.0, 0.02, -0.01, 0.002, 0.0)


@dataclass(frozen=True)
class Scene:
    """Camera, board and poses of a set of photographs."""

    lens: tuple[float, ...] = TRUTH  # fx, fy, cx, cy and distortion coefficients
    fisheye: bool = False
    views: int = 15
    sigma_px: float = 0.2
    warp: tuple[float, float, float] = (0.0, 0.0, 0.0)  # 1/m
    tilt_rad: float = 0.5  # the largest about x and y
    lean_rad: tuple[float, float] = (0.0, 0.0)  # about x and y, added to every pose
    roll_rad: float = 0.3  # the largest about z
    distance_m: tuple[float, float] = (0.35, 0.7)
    columns: int = 9
    rows: int = 6
    square_m: float = 0.03
    size_px: tuple[int, int] = SIZE
    at_most: float = 0.45  # of the board's middle from the picture's, in widths and heights


def board_points(scene: Scene) -> Array:
    """(P, 3), m."""
    x, y = np.meshgrid(np.arange(scene.columns) * scene.square_m, np.arange(scene.rows) * scene.square_m)
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)


def photographs(scene: Scene, seed: int) -> CornerTable:
    """The corners that lie in the picture, with normal errors."""
    rng = np.random.default_rng(seed)
    flat = board_points(scene)
    middle = flat.mean(axis=0)
    x, y = (flat - middle)[:, :2].T
    a, b, c = scene.warp
    points = flat + np.outer(a * x * x + b * x * y + c * y * y, [0.0, 0.0, 1.0])
    fx, fy, cx, cy, *distortion = scene.lens
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    d = np.array(distortion) if distortion else np.zeros(4)
    width, height = scene.size_px
    views: list[tuple[np.ndarray, np.ndarray]] = []
    while len(views) < scene.views:
        R = exp(rng.uniform(-1, 1, 3) * [scene.tilt_rad, scene.tilt_rad, scene.roll_rad] + [*scene.lean_rad, 0.0])
        z = rng.uniform(*scene.distance_m)
        u, v = rng.uniform(-scene.at_most, scene.at_most, 2)
        at = np.array([u * width / fx * z, v * height / fy * z, z])
        t = at - R @ middle
        if np.any(points @ R[2] + t[2] <= 0.02):
            continue
        rotvec = cv2.Rodrigues(R)[0]
        if scene.fisheye:
            pixels = cv2.fisheye.projectPoints(points[:, None], rotvec, t, K, d)[0].reshape(-1, 2)
        else:
            pixels = cv2.projectPoints(points, rotvec, t, K, d)[0].reshape(-1, 2)
        seen = np.all((pixels > -0.5) & (pixels < np.array(scene.size_px) - 0.5), axis=1)
        if seen.mean() > 0.6:
            views.append((np.flatnonzero(seen), pixels[seen] + rng.normal(0, scene.sigma_px, (int(seen.sum()), 2))))
    return CornerTable.of(views, flat, middle, scene.size_px)
