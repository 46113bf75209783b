"""A scene as one coloured triangle mesh: lines as thin tubes, spots as balls, sigmas as ellipsoids."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from geometry.arrays import Array, Ints
from lab.report.calibration.calibration_scene import Frustum, Marker, Rectangle, SceneObject, outline
from lab.view.scene import Ellipsoid

_SIDES = 6  # of a tube
_GRID_LINES = 9  # across a screen
_THIN, _THICK = 0.0006, 0.0016  # radii of tubes, in shares of the scene's extent
_BALL = 0.005  # radius of a spot's ball, in the same shares


@dataclass(frozen=True, slots=True)
class Mesh:
    """A triangle mesh."""

    vertices: Array  # (n, 3), m, in world
    triangles: Ints  # (m, 3), counter-clockwise seen from outside
    colours: Array  # (n, 3), red, green, blue in [0, 1]


def mesh_of(things: Sequence[SceneObject], ellipsoids: Sequence[Ellipsoid], reach_m: float, extent_m: float) -> Mesh:
    """The mesh of a scene. reach_m: length of a field of view. extent_m: of the scene, which decides line widths."""
    parts: list[Mesh] = []
    for thing in things:
        if not np.isfinite(outline(thing, reach_m)).any():
            continue
        if isinstance(thing, Marker):
            parts.append(ball(thing.place, np.eye(3) * _BALL * extent_m, thing.colour))
            continue
        parts += [tube(line, _THICK * extent_m, thing.colour) for line in edges(thing, reach_m)]
        if isinstance(thing, Rectangle):
            parts += [tube(line, _THIN * extent_m, thing.colour) for line in _grid(thing)]
    parts += [ball(e.centre, e.axes, e.colour) for e in ellipsoids]
    return merged(parts)


def edges(thing: SceneObject, reach_m: float) -> list[Array]:
    """The lines (k, 3), m, of a thing; one point for a marker."""
    at = outline(thing, reach_m)
    if isinstance(thing, Frustum):
        return [at[[1, 2, 3, 4, 1]], *(at[[0, k]] for k in range(1, 5))]
    return [at[[0, 1, 2, 3, 0]]] if isinstance(thing, Rectangle) else [at]


def tube(line: Array, radius_m: float, colour: str) -> Mesh:
    """A tube around a line (k, 3); a piece with nan at an end is left out."""
    a, b = line[:-1], line[1:]
    use = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1) & (np.abs(b - a).max(axis=1, initial=0.0) > 0)
    a, b = a[use], b[use]
    along = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
    across = np.cross(along, np.eye(3)[np.argmin(np.abs(along), axis=1)])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
    ring = np.cos(angle)[:, None] * across[:, None] + np.sin(angle)[:, None] * np.cross(along, across)[:, None]
    vertices = np.stack([a[:, None] + radius_m * ring, b[:, None] + radius_m * ring], axis=1).reshape(-1, 3)
    k = np.arange(_SIDES)
    n = (k + 1) % _SIDES
    one = np.concatenate([np.stack([k, n, n + _SIDES], -1), np.stack([k, n + _SIDES, k + _SIDES], -1)])
    triangles = (2 * _SIDES * np.arange(len(a))[:, None, None] + one).reshape(-1, 3)
    return Mesh(vertices, triangles, _coloured(colour, len(vertices)))


def ball(centre: Array, axes: Array, colour: str, rows: int = 8, columns: int = 12) -> Mesh:
    """An ellipsoid: centre (3,) + axes (3, 3) @ u for u on the unit sphere."""
    latitude = np.pi * (np.arange(rows + 1) / rows - 0.5)
    longitude = 2 * np.pi * np.arange(columns) / columns
    up, round_ = np.meshgrid(latitude, longitude, indexing="ij")
    unit = np.stack([np.cos(up) * np.cos(round_), np.cos(up) * np.sin(round_), np.sin(up)], axis=-1).reshape(-1, 3)
    i, j = (v.ravel() for v in np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"))
    here, right = i * columns + j, i * columns + (j + 1) % columns
    triangles = np.concatenate(
        [np.stack([here, right, right + columns], -1), np.stack([here, right + columns, here + columns], -1)]
    )
    if np.linalg.det(axes) < 0:
        triangles = triangles[:, ::-1]
    return Mesh(centre + unit @ axes.T, triangles, _coloured(colour, len(unit)))


def merged(parts: Sequence[Mesh]) -> Mesh:
    """Several meshes as one."""
    if not parts:
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64), np.zeros((0, 3)))
    first = np.cumsum([0, *(len(p.vertices) for p in parts)])
    return Mesh(
        np.concatenate([p.vertices for p in parts]),
        np.concatenate([p.triangles + k for p, k in zip(parts, first, strict=False)]),
        np.concatenate([p.colours for p in parts]),
    )


def _grid(rectangle: Rectangle) -> list[Array]:
    """Lines (2, 3) across a rectangle, which stays transparent."""
    a, b, c, d = outline(rectangle, 0.0)
    shares = np.linspace(0, 1, _GRID_LINES + 2)[1:-1, None]
    across, along = (
        zip(a + shares * (b - a), d + shares * (c - d), strict=True),
        zip(a + shares * (d - a), b + shares * (c - b), strict=True),
    )
    return [np.stack(ends) for ends in (*across, *along)]


def _coloured(colour: str, n: int) -> Array:
    rgb = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    return np.tile(rgb, (n, 1))
