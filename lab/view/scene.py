"""The objects of a view: what stays, and what moves with the vehicle; sigma ellipsoids at a stated scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Ints
from lab.report.calibration.calibration_scene import (
    Marker,
    Ray,
    SceneObject,
    Trail,
    frustum_length,
    outline,
    rig_things,
)
from lab.report.plot.scales import round_size
from lab.report.plot.svg import GREY, PURPLE
from lab.view.content import Content

MOST_ELLIPSOIDS = 60
MOST_POINTS = 1500  # of the trajectory
_LARGEST = 0.2  # largest semi-axis that is drawn, in shares of the scene's extent: larger ones would cover it
_SHARE = 0.02  # of the scene's extent: the size at which a typical ellipsoid is drawn
_SIZING = 200  # poses whose spots decide the size of a screen that states none
_TURN = np.linspace(0, 2 * np.pi, 33)


@dataclass(frozen=True, slots=True)
class Ellipsoid:
    """The positions within k sigma of one pose: centre + axes @ u, u on the unit sphere."""

    centre: Array  # (3,), m, in world
    axes: Array  # (3, 3), m: columns are the semi-axes
    colour: str

    def circles(self) -> list[Trail]:
        """Its three principal ellipses."""
        ring = np.stack([np.cos(_TURN), np.sin(_TURN), 0 * _TURN])
        return [
            Trail("sigma of the position", self.centre + (self.axes @ np.roll(ring, k, axis=0)).T, self.colour)
            for k in range(3)
        ]


@dataclass(frozen=True, slots=True)
class View:
    """A scene to be drawn."""

    content: Content
    fixed: Sequence[SceneObject]  # screens, cameras and the trajectory
    ellipsoids: list[Ellipsoid]
    sigma_scale: float  # the ellipsoids' semi-axes over the sigmas
    too_large: int  # ellipsoids that are not drawn, because they would cover the scene
    reach_m: float  # length of a field of view
    extent_m: float  # of the scene: the longest side of its box

    def moving(self, index: int | None) -> list[SceneObject]:
        """The beams, spots and vehicle at one pose of the content."""
        if index is None:
            return []
        things = rig_things(self.content.rig, self.content.world_from_body[index])
        return [t for t in things if isinstance(t, Ray | Marker)]


def view_of(
    content: Content,
    index: int | None,
    sigma_scale: float | None = None,
    most_points: int = MOST_POINTS,
    most_ellipsoids: int = MOST_ELLIPSOIDS,
) -> View:
    """The scene of a content. index: of the pose whose spots size screens without a size.

    sigma_scale: None: a round number that makes the ellipsoids visible. most_points: of the trajectory.
    """
    pose = None if index is None else content.world_from_body[index]
    known = np.flatnonzero(content.known)
    others = content.world_from_body[thinned(known, _SIZING)] if len(known) > 1 else None
    fixed: list[SceneObject] = [t for t in rig_things(content.rig, pose, others) if not isinstance(t, Ray | Marker)]
    if len(known) > 1:
        fixed.append(Trail("trajectory", _trajectory(content, most_points), PURPLE))
    reach = frustum_length(fixed)
    points = np.concatenate([outline(t, reach) for t in fixed])
    extent = float(np.ptp(points[np.isfinite(points).all(axis=1)], axis=0).max())
    with_sigma = known[np.isfinite(content.position_covariance[known]).all(axis=(1, 2))]
    scale = _scale(content, with_sigma, extent) if sigma_scale is None else sigma_scale
    ellipsoids = [ellipsoid(content, int(i), scale) for i in thinned(with_sigma, most_ellipsoids)]
    drawn = [e for e in ellipsoids if np.linalg.norm(e.axes, axis=0).max() <= _LARGEST * extent]
    return View(content, fixed, drawn, scale, len(ellipsoids) - len(drawn), reach, extent)


def ellipsoid(content: Content, index: int, scale: float) -> Ellipsoid:
    """The ellipsoid of `scale` sigmas of one pose's position; grey where the pose is predicted."""
    values, vectors = np.linalg.eigh(content.position_covariance[index])
    axes = vectors * np.sqrt(np.maximum(values, 0.0)) * scale
    return Ellipsoid(content.world_from_body.translation[index], axes, PURPLE if content.measured[index] else GREY)


def thinned(indices: Ints, most: int) -> Ints:
    """At most so many of the indices, evenly spread, with the first and the last."""
    if len(indices) <= most:
        return indices
    return indices[np.unique(np.linspace(0, len(indices) - 1, most).round().astype(np.int64))]


def _trajectory(content: Content, most: int) -> Array:
    """Positions (n, 3), at most so many, at even steps of the frames, with nan where the pose is unknown."""
    return content.world_from_body.translation[thinned(np.arange(len(content.frames)), most)]


def _scale(content: Content, indices: Ints, extent_m: float) -> float:
    """A round factor with which the median sigma is a share of the scene; at least 1."""
    if not len(indices):
        return 1.0
    sigmas = np.sqrt(np.linalg.eigvalsh(content.position_covariance[indices])[:, -1].clip(min=0.0))
    typical = float(np.median(sigmas))
    return max(1.0, round_size(_SHARE * extent_m / typical)) if typical > 0 else 1.0
