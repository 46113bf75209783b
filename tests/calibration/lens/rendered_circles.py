"""Rendered photographs of circle grids: several rays per pixel through OpenCV's lens, then blur, noise and rounding.

Independent of the code under test.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.boards.board_detection import find_board
from calibration.boards.board_types import CircleGrid
from calibration.boards.board_view import BoardView
from calibration.boards.circle_detection import fit_ellipses
from calibration.lens.fit.corner_table import CircleAreas, CornerTable
from geometry.arrays import Array
from geometry.rotations import exp

SIZE = (1280, 1024)
LENS = (1000.0, 1003.0, 630.0, 520.0, -0.2, 0.08, 0.001, -0.0008, -0.03)
_SAMPLES = 5  # along each side of a pixel
_MARGIN = 7  # px around a blob


@dataclass(frozen=True)
class CircleScene:
    """Camera, board and poses of a set of photographs."""

    board: CircleGrid
    lens: tuple[float, ...] = LENS  # fx, fy, cx, cy and distortion coefficients
    fisheye: bool = False
    views: int = 15
    blur_px: float = 0.7
    noise_dn: float = 2.0
    tilt_rad: float = 0.6
    fill: tuple[float, float] = (0.35, 0.7)  # the board's longer side over the picture's width
    diameter_m: float | None = None  # as printed; None: that of the board
    size_px: tuple[int, int] = SIZE


@dataclass(frozen=True)
class Shot:
    """A picture of a board with its true pose."""

    image: NDArray[np.uint8]
    rotation: Array
    translation: Array
    centres: Array  # (P, 2), px: images of the circles' centres
    radii_px: Array  # (P,), approximate


def shots(scene: CircleScene, seed: int) -> list[Shot]:
    """Pictures that contain the whole board."""
    rng = np.random.default_rng(seed)
    points, size = scene.board.points, np.array(scene.size_px)
    out: list[Shot] = []
    while len(out) < scene.views:
        turn = [scene.tilt_rad, scene.tilt_rad, 0.4] * rng.uniform(-1, 1, 3)
        R = exp(turn)
        away = scene.lens[0] * max(scene.board.size_m) / (size[0] * rng.uniform(*scene.fill))
        at = np.append(rng.uniform(-0.35, 0.35, 2) * size / np.array(scene.lens[:2]), 1.0) * away
        t = at - R @ scene.board.middle
        if np.any(points @ R[2] + t[2] <= 0.05):
            continue
        around = projected(scene, R, t, outlines(scene, 24).reshape(-1, 3)).reshape(len(points), -1, 2)
        if np.all((around > 12) & (around < size - 13)):
            out.append(_shot(scene, R, t, around, rng))
    return out


def projected(scene: CircleScene, R: Array, t: Array, points: Array) -> Array:
    """Pixels (n, 2) by OpenCV."""
    rotvec = cv2.Rodrigues(R)[0]
    K, d = _matrix(scene)
    if scene.fisheye:
        return np.asarray(cv2.fisheye.projectPoints(points[:, None], rotvec, t, K, d)[0]).reshape(-1, 2)
    return np.asarray(cv2.projectPoints(points, rotvec, t, K, d)[0]).reshape(-1, 2)


def _matrix(scene: CircleScene) -> tuple[Array, Array]:
    fx, fy, cx, cy, *d = scene.lens
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), np.array(d) if d else np.zeros(4)


def _radius(scene: CircleScene) -> float:
    return (scene.diameter_m or scene.board.diameter_m) / 2


def outlines(scene: CircleScene, count: int) -> Array:
    """Points (P, count, 3), m, on the circles of the board."""
    turn = np.linspace(0, 2 * np.pi, count, endpoint=False)
    ring = _radius(scene) * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    return scene.board.points[:, None] + ring


def _shot(scene: CircleScene, R: Array, t: Array, around: Array, rng: np.random.Generator) -> Shot:
    width, height = scene.size_px
    light = np.full((height, width), 200.0)
    for centre, outline in zip(scene.board.points[:, :2], around, strict=True):
        first = np.maximum(np.floor(outline.min(axis=0)).astype(int) - _MARGIN, 0)
        last = np.minimum(np.ceil(outline.max(axis=0)).astype(int) + _MARGIN, [width - 1, height - 1])
        patch = np.s_[first[1] : last[1] + 1, first[0] : last[0] + 1]
        light[patch] -= 160.0 * _ink(scene, R, t, centre, first, last)
    light = cv2.GaussianBlur(light, (0, 0), scene.blur_px, borderType=cv2.BORDER_REPLICATE)
    light = light + rng.normal(0, scene.noise_dn, light.shape)
    image = np.clip(np.round(light), 0, 255).astype(np.uint8)
    centres = projected(scene, R, t, scene.board.points)
    return Shot(image, R, t, centres, np.linalg.norm(around - centres[:, None], axis=2).mean(axis=1))


def _ink(scene: CircleScene, R: Array, t: Array, centre: Array, first: Array, last: Array) -> Array:
    """Share (h, w) of each pixel covered by a circle, with rays interpolated linearly between the pixels' corners."""
    u, v = np.meshgrid(np.arange(first[0], last[0] + 2) - 0.5, np.arange(first[1], last[1] + 2) - 0.5)
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    K, d = _matrix(scene)
    ends = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-10)
    undo = cv2.fisheye.undistortPoints if scene.fisheye else cv2.undistortPoints
    flat = np.asarray(undo(pixels[:, None], K, d, criteria=ends)).reshape(-1, 2)
    rays = np.column_stack([flat, np.ones(len(flat))]) @ R  # in the board's frame
    eye = -R.T @ t
    xy = (eye[:2] - eye[2] / rays[:, 2:] * rays[:, :2]).reshape(*u.shape, 2) - centre
    along, down = xy[:-1, 1:] - xy[:-1, :-1], xy[1:, :-1] - xy[:-1, :-1]
    side = np.linalg.norm(along, axis=-1) + np.linalg.norm(down, axis=-1)
    from_edge = np.linalg.norm(xy[:-1, :-1], axis=-1) - _radius(scene)
    covered = np.where(from_edge < 0, float(_SAMPLES**2), 0.0)
    edge = np.abs(from_edge) < 2 * side  # other pixels lie wholly inside or outside
    # Samples on the edge count partially: binary samples would shift blobs by 4e-3 px.
    along, down, total = along[edge], down[edge], np.zeros(np.count_nonzero(edge))
    corners = [part[edge] for part in (xy[:-1, :-1], xy[:-1, 1:], xy[1:, :-1], xy[1:, 1:])]
    steps = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    for a in steps:
        above, below = ((1 - a) * corners[k] + a * corners[k + 1] for k in (0, 2))
        for b in steps:
            place = (1 - b) * above + b * below
            away = np.linalg.norm(place, axis=-1)
            unit = place / np.maximum(away, 1e-12)[..., None]
            wide = np.abs(np.sum(unit * along, axis=-1)) + np.abs(np.sum(unit * down, axis=-1))
            total += np.clip(0.5 + (_radius(scene) - away) * _SAMPLES / wide, 0, 1)
    covered[edge] = total
    return covered / _SAMPLES**2


def table_of(scene: CircleScene, seed: int, searched: bool = False) -> CornerTable:
    """Blobs as detected in the pictures.

    searched: detect the board; otherwise the ellipses are fitted near their true positions, which is much faster and
    gives the same values.
    """
    board = scene.board
    views, areas = [], []
    for shot in shots(scene, seed):
        if searched:
            view = find_board(shot.image, board)
            if not isinstance(view, BoardView):  # a user would drop the picture
                continue
            assert view.areas_px2 is not None
            ids, pixels, area = view.ids, view.pixels, view.areas_px2
        else:
            found = fit_ellipses(shot.image, shot.centres, shot.radii_px[:, None, None] * np.eye(2))
            ids = np.flatnonzero(np.isfinite(found.areas))
            pixels, area = found.centres[ids], found.areas[ids]
        views.append((ids, pixels))
        areas.append(area)
    circles = CircleAreas(np.concatenate(areas), board.stated_diameter_m)
    return CornerTable.of(views, board.points, board.middle, scene.size_px, circles)
