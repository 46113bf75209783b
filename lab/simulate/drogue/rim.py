"""Projections of the rim and the markers: the truth of a drogue's picture."""

from __future__ import annotations

import numpy as np

from geometry.arrays import Array
from lab.simulate.drogue.scene import DrogueScene, Ellipse

RIM_POINTS = 360


def rim_points_px(scene: DrogueScene, points: int = RIM_POINTS) -> Array:
    """Images (points, 2), px, of points at equal angles on the rim; nan where there is no projection."""
    angle = np.arange(points) * (2 * np.pi / points)
    rim = scene.radius_m * np.stack([np.cos(angle), np.sin(angle), np.zeros(points)], axis=1)
    return scene.camera.project(scene.world_from_drogue.apply(rim))


def ellipse_through(points_px: Array) -> Ellipse:
    """The ellipse through points (n, 2): least squares of the conic's equation, scaled about their mean.

    Exact for the image of a circle by a camera without distortion.

    Raises:
        ValueError: fewer than five points, or the conic is no ellipse.
    """
    points = np.asarray(points_px, dtype=float)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 5:
        raise ValueError(f"an ellipse needs five points, got {len(points)}")
    mean = points.mean(axis=0)
    scale = float(np.sqrt(np.mean(np.sum((points - mean) ** 2, axis=1))))
    x, y = ((points - mean) / scale).T
    a, b, c, d, e, f = np.linalg.svd(np.stack([x * x, x * y, y * y, x, y, np.ones_like(x)], axis=1))[2][-1]
    M = np.array([[a, b / 2], [b / 2, c]])
    if np.linalg.det(M) <= 0:
        raise ValueError("the points lie on no ellipse")
    centre = np.linalg.solve(-2 * M, [d, e])
    level = centre @ M @ centre - f
    size, axes = np.linalg.eigh(M / level)  # increasing: the first belongs to the major axis
    angle = np.degrees(np.arctan2(axes[1, 0], axes[0, 0]))
    angle = 90.0 - (90.0 - angle) % 180.0  # into (-90, 90]
    major, minor = scale / np.sqrt(size)
    return Ellipse(mean + scale * centre, float(major), float(minor), float(angle))


def ellipse_points(ellipse: Ellipse, angle_rad: Array) -> Array:
    """Points (..., 2), px, of an ellipse at parametric angles (...)."""
    turn = np.radians(ellipse.angle_deg)
    along = np.array([np.cos(turn), np.sin(turn)])
    across = np.array([-np.sin(turn), np.cos(turn)])
    return (
        ellipse.centre_px
        + ellipse.major_px * np.cos(angle_rad)[..., None] * along
        + ellipse.minor_px * np.sin(angle_rad)[..., None] * across
    )
