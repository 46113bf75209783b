"""The image of a circle: where its centroid lies, from images of points on its outline.

The centroid of a blob is not the image of the circle's centre: perspective and lens draw the nearer half larger. For a
circle of 7 mm at .5 m under 45 deg the two differ by .1 to .3 px, all to one side. Area and centroid follow from the
outline by Green's theorem; its derivative along the outline is that of the trigonometric polynomial through the nodes.
Source: Heikkila (2000), "Geometric camera calibration using circular control points", IEEE Trans. PAMI 22, for the
effect under perspective; the outline's nodes, which serve any lens, are ours.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibration.boards.circle_detection import homography, mapped
from geometry.arrays import Array
from geometry.camera import Camera
from geometry.pose import Pose

# Images of circles hold harmonics 1 and 2 of the angle, the second a hundredth of the first; products of three of them
# that six nodes cannot tell from a constant are below 1e-5 px. Five nodes err by up to 1e-3 px.
NODES = 6
_ANGLE = 2 * np.pi * np.arange(NODES) / NODES
ON_CIRCLE = np.stack([np.cos(_ANGLE), np.sin(_ANGLE)], axis=1)  # (NODES, 2): of radius 1


def _derivative_matrix(n: int) -> Array:
    """(n, n), antisymmetric: the derivative of the trigonometric polynomial through n (even) nodes at the nodes."""
    j = np.arange(n)
    away = j[:, None] - j[None, :]
    with np.errstate(divide="ignore"):
        D = 0.5 * (-1.0) ** away / np.tan(np.pi * away / n)
    D[away == 0] = 0.0
    return np.asarray(D, dtype=float)


_D = _derivative_matrix(NODES)
_W = 2 * np.pi / NODES


def centroid(outline: Array) -> tuple[Array, Array]:
    """Centroid (n, 2) of the area within outlines (n, NODES, 2), and its derivative by the nodes (n, 2, NODES, 2).

    The nodes are images of ON_CIRCLE in that order. nan where a node is nan.
    """
    middle = outline.mean(axis=1)
    x, y = np.moveaxis(outline - middle[:, None], -1, 0)  # (n, NODES)
    dx, dy = x @ _D.T, y @ _D.T
    area = _W * np.sum(x * dy, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        cx = 0.5 * _W * np.sum(x * x * dy, axis=1) / area
        cy = -0.5 * _W * np.sum(y * y * dx, axis=1) / area
        G = np.empty((len(outline), 2, NODES, 2))
        share = (_W / area)[:, None]
        G[:, 0, :, 0] = share * (x - cx[:, None]) * dy
        G[:, 0, :, 1] = share * (-0.5 * (x * x) @ _D.T + cx[:, None] * dx)
        G[:, 1, :, 0] = share * (0.5 * (y * y) @ _D.T - cy[:, None] * dy)
        G[:, 1, :, 1] = share * (cy[:, None] - y) * dx
    return middle + np.stack([cx, cy], axis=1), G


def radius_by_areas(board_xy: Array, pixels: Array, areas_px2: Array, camera: Camera) -> float:
    """Of circles, m, by the areas (n,) of their blobs at pixels (n, 2); board_xy (n, 2), m: where their centres lie.

    Each area over that of a circle of 1 m by the local scale, through the lens; the median. Raises ValueError where the
    pixels are not of such a board.
    """
    alone = replace(camera, camera_from_world=Pose.identity())
    _, rays = alone.rays(pixels)
    good = np.isfinite(rays).all(axis=1)
    if good.sum() < 4:
        raise ValueError("expected pixels that the lens draws rays to")
    H = homography(board_xy[good], rays[good, :2] / rays[good, 2:])

    def seen(xy: Array) -> Array:
        flat = mapped(H, xy)
        return alone.project(np.concatenate([flat, np.ones((len(flat), 1))], axis=1))

    step = 1e-3 * float(np.ptp(board_xy))
    by_x, by_y = ((seen(board_xy[good] + d) - seen(board_xy[good] - d)) / (2 * step) for d in step * np.eye(2))
    scale = np.abs(by_x[:, 0] * by_y[:, 1] - by_x[:, 1] * by_y[:, 0])
    return float(np.sqrt(np.nanmedian(areas_px2[good] / (np.pi * scale))))
