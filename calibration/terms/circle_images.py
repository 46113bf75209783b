"""The centroid of the image of a circle, from images of points on its outline.

The centroid of a blob is not the image of the circle's centre: perspective and distortion enlarge the nearer half. For
a circle of 7 mm at 0.5 m under 45 deg the two differ by 0.1 to 0.3 px, in the same direction for all circles. Area and
centroid follow from the outline by Green's theorem; the tangent is the derivative of the trigonometric polynomial
through the nodes. Source: Heikkila (2000), "Geometric camera calibration using circular control points", IEEE Trans.
PAMI 22, for the effect under perspective; the nodes on the outline, which work with any lens model, are ours.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibration.boards.circle_detection import homography, mapped
from geometry.arrays import Array
from geometry.camera import Camera
from geometry.pose import Pose

# The images of circles contain harmonics 1 and 2 of the angle, the second a hundredth of the first. Products of three
# of them that six nodes cannot distinguish from a constant are below 1e-5 px. With five nodes errors reach 1e-3 px.
NODES = 6
_ANGLE = 2 * np.pi * np.arange(NODES) / NODES
ON_CIRCLE = np.stack([np.cos(_ANGLE), np.sin(_ANGLE)], axis=1)  # (NODES, 2): of radius 1


def _derivative_matrix(n: int) -> Array:
    """Matrix (n, n) from values at n (even) nodes to the derivatives of the trigonometric polynomial through them."""
    j = np.arange(n)
    steps = j[:, None] - j[None, :]
    with np.errstate(divide="ignore"):
        D = 0.5 * (-1.0) ** steps / np.tan(np.pi * steps / n)
    D[steps == 0] = 0.0
    return np.asarray(D, dtype=float)


_D = _derivative_matrix(NODES)
_W = 2 * np.pi / NODES


def centroid(outline: Array) -> tuple[Array, Array]:
    """Centroids (n, 2) of the areas within outlines (n, NODES, 2), and their derivatives by the nodes (n, 2, NODES, 2).

    The nodes are the images of ON_CIRCLE, in that order. nan where a node is nan.
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
    """The radius, m, of a board's circles from the areas (n,) of their blobs at pixels (n, 2).

    board_xy (n, 2), m: centres of the circles on the board. Each area is divided by pi and by the local scale of the
    image, in px^2 per m^2, which includes distortion; the result is the root of the median.

    Raises:
        ValueError: fewer than four pixels have a ray through the lens.
    """
    alone = replace(camera, camera_from_world=Pose.identity())
    _, rays = alone.rays(pixels)
    good = np.isfinite(rays).all(axis=1)
    if good.sum() < 4:
        raise ValueError(f"expected four or more pixels within the fold of the lens model, got {int(good.sum())}")
    H = homography(board_xy[good], rays[good, :2] / rays[good, 2:])

    def image_of(xy: Array) -> Array:
        flat = mapped(H, xy)
        return alone.project(np.concatenate([flat, np.ones((len(flat), 1))], axis=1))

    step = 1e-3 * float(np.ptp(board_xy))
    by_x, by_y = ((image_of(board_xy[good] + d) - image_of(board_xy[good] - d)) / (2 * step) for d in step * np.eye(2))

    scale = np.abs(by_x[:, 0] * by_y[:, 1] - by_x[:, 1] * by_y[:, 0])
    return float(np.sqrt(np.nanmedian(areas_px2[good] / (np.pi * scale))))
