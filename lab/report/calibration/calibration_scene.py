"""3-D views of cameras, screens, boards and beams: parallel projections from fixed directions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from geometry.arrays import Array
from geometry.camera import Camera, pinhole_numbers
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.rig import Rig
from lab.report.plot import svg


@dataclass(frozen=True, slots=True)
class Frustum:
    """The field of view of a camera."""

    name: str
    camera_from_world: Pose
    half_width: tuple[float, float]  # tangents of half the angle of view, horizontal and vertical
    colour: str = svg.BLUE


@dataclass(frozen=True, slots=True)
class Rectangle:
    """A screen; its origin is its centre."""

    name: str
    world_from_rectangle: Pose
    size_m: tuple[float, float]
    colour: str = svg.GREEN


@dataclass(frozen=True, slots=True)
class Ray:
    """A beam from its source to its spot."""

    name: str
    start: Array  # (3,), m, in world
    end: Array  # (3,), m, in world
    colour: str = svg.VERMILLION


@dataclass(frozen=True, slots=True)
class Marker:
    """A point: a spot, a control point or the body's origin."""

    name: str
    place: Array  # (3,), m, in world
    colour: str = svg.ORANGE


@dataclass(frozen=True, slots=True)
class Trail:
    """A line through points: a trajectory, or a curve on an ellipsoid."""

    name: str
    places: Array  # (n, 3), m, in world; interrupted at nan
    colour: str = svg.PURPLE


SceneObject = Frustum | Rectangle | Ray | Marker | Trail

# World directions that point right and up in the drawing. z is up in the world frame of a lab.
VIEWS: dict[str, tuple[Array, Array]] = {
    "seen obliquely": (np.array([0.82, 0.57, 0.0]), np.array([-0.285, 0.41, 0.866])),
    "from above (along −z)": (np.array([1.0, 0, 0]), np.array([0, 1.0, 0])),
    "from the front (along +y)": (np.array([1.0, 0, 0]), np.array([0, 0, 1.0])),
}
LAB_VIEWS = tuple(VIEWS)


def frustum_of(camera: Camera) -> Frustum:
    """The field of view of a calibrated camera; its distortion is neglected."""
    fx, fy, _, _ = pinhole_numbers(camera)
    half = (0.5 * camera.image_size_px[0] / fx, 0.5 * camera.image_size_px[1] / fy)
    return Frustum(camera.name, camera.camera_from_world, half, svg.BLUE)


def rig_things(rig: Rig, world_from_body: Pose | None = None, others: Pose | None = None) -> list[SceneObject]:
    """The cameras and screens of a rig and, if the vehicle's pose is given, its beams and spots.

    A screen without a size is drawn large enough for its spots, at least 1 m. others: a stack of poses (k,) for whose
    spots it is large enough too, but for the outermost of each hundred.
    """
    things: list[SceneObject] = []
    model = SpotModel.of(rig)
    hits = np.full((len(model), 3), np.nan) if world_from_body is None else model.hits(world_from_body)
    for screen in rig.screens.values():
        size = screen.size_m
        if size is None:
            on_screen = np.array([s.screen == screen.name for s in (rig.spots[v] for _, v in model.views)], dtype=bool)
            half = 1.2 * _reach(hits[on_screen], screen.world_from_screen, 1.0)
            if others is not None:
                half = np.maximum(half, 1.2 * _reach(model.hits(others)[:, on_screen], screen.world_from_screen, 0.99))
            half = np.maximum(half, 0.5)
            size = (2 * float(half[0]), 2 * float(half[1]))
        things.append(Rectangle(f"screen {screen.name}", screen.world_from_screen, size))
    things += [frustum_of(c) for c in rig.cameras.values()]
    if world_from_body is not None:
        drawn = set()
        for i, (_, spot) in enumerate(model.views):
            if spot in drawn or not np.isfinite(hits[i]).all():
                continue
            drawn.add(spot)
            start = world_from_body.apply(rig.beams[rig.spots[spot].beam].point)
            things += [Ray(rig.spots[spot].beam, start, hits[i]), Marker(spot, hits[i])]
        things.append(Marker("vehicle", world_from_body.translation, svg.PURPLE))
    return things


def _reach(hits: Array, world_from_screen: Pose, share: float) -> Array:
    """The distances (2,), m, along a screen's axes within which this share of points (..., 3) in world lies."""
    local = world_from_screen.inverse().apply(hits.reshape(-1, 3))[:, :2]
    local = local[np.isfinite(local).all(axis=1)]
    return np.asarray(np.quantile(np.abs(local), share, axis=0)) if len(local) else np.zeros(2)


def scene_views(
    things: Sequence[SceneObject], title: str = "Cameras, screens and beams", views: Sequence[str] = LAB_VIEWS
) -> list[str]:
    """Several views of the same scene."""
    return [scene_view(things, f"{title}, {name}", name) for name in views]


def scene_view(things: Sequence[SceneObject], title: str, view: str = LAB_VIEWS[0]) -> str:
    """Parallel projection of a scene. view: one of VIEWS. Lengths along the drawing's axes are to scale."""
    right, up = VIEWS[view]
    to_drawing = np.stack([right / np.linalg.norm(right), up / np.linalg.norm(up)])
    reach = frustum_length(things)
    outlines = [outline(t, reach) for t in things]
    flat = [o @ to_drawing.T for o in outlines]
    all_points = np.concatenate([*flat, np.zeros((1, 2))]) if flat else np.zeros((1, 2))
    all_points = all_points[np.isfinite(all_points).all(axis=1)]
    lo, hi = all_points.min(axis=0), all_points.max(axis=0)
    span = np.maximum(hi - lo, 1e-3 * max(float((hi - lo).max()), 1.0))
    scale = min(440 / span[0], 360 / span[1])
    high = span[1] * scale
    x0 = (540 - span[0] * scale) / 2
    p = svg.PlotArea(
        svg.Scale(lo[0], lo[0] + span[0], x0, x0 + span[0] * scale),
        svg.Scale(lo[1], lo[1] + span[1], 44 + high, 44),
        540,
        high + 92,
    )
    nearness = np.cross(to_drawing[0], to_drawing[1])
    far_first = sorted(range(len(things)), key=lambda i: float(np.nanmean(outlines[i] @ nearness)))
    out, labels = [svg.text(8, 15, title, "title")], []
    for i in far_first:
        parts, label = _drawn(things[i], p.at(flat[i]))
        out.append(parts)
        labels += [label] if label else []
    out += svg.names(labels, p)
    out += _axis_cross(p, to_drawing)
    long = svg.round_size(0.3 * float(span.max()))
    width = long * scale
    y = p.height - 12
    out.append(
        f'<path d="M{524 - width:.1f} {y:.1f}h{width:.1f}m0 -4v8m{-width:.1f} 0v-8" stroke="var(--ink)" fill="none"/>'
    )
    out.append(svg.text(524 - width - 6, y + 4, f"{svg.number(long)} m", "end"))
    return svg.svg_of(p, title, out)


def frustum_length(things: Sequence[SceneObject]) -> float:
    """Length of the drawn fields of view, m: a seventh of the scene."""
    points = [t.camera_from_world.inverse().translation for t in things if isinstance(t, Frustum)]
    points += [p for t in things if not isinstance(t, Frustum) for p in outline(t, 0.0)]
    cloud = np.array(points).reshape(-1, 3)
    cloud = cloud[np.isfinite(cloud).all(axis=1)]
    return max(float(np.ptp(cloud, axis=0).max()) / 7, 0.02) if len(cloud) else 1.0


def outline(thing: SceneObject, reach: float) -> Array:
    """Corners of a thing (k, 3), m, in world. reach: length of a field of view, m."""
    if isinstance(thing, Frustum):
        a, b = thing.half_width
        # Angles of view are limited to 120 degrees: larger ones would cover the drawing.
        a, b = min(a, 1.7) * reach, min(b, 1.7) * reach
        body = np.array([[0, 0, 0], [-a, -b, reach], [a, -b, reach], [a, b, reach], [-a, b, reach]])
        return thing.camera_from_world.inverse().apply(body)
    if isinstance(thing, Rectangle):
        w, h = np.array(thing.size_m) / 2
        return thing.world_from_rectangle.apply(np.array([[-w, -h, 0], [w, -h, 0], [w, h, 0], [-w, h, 0]]))
    if isinstance(thing, Ray):
        return np.stack([thing.start, thing.end])
    if isinstance(thing, Trail):
        return np.asarray(thing.places, dtype=float).reshape(-1, 3)
    return np.asarray(thing.place, dtype=float).reshape(1, 3)


def _drawn(thing: SceneObject, at: Array) -> tuple[str, tuple[float, float, str] | None]:
    """SVG of a thing, and its name: x, y, words."""
    c = thing.colour
    tip = f"<title>{escape(thing.name)}</title>"
    if isinstance(thing, Frustum):
        d = svg.polyline(at[1:], closed=True) + svg.segments(np.repeat(at[:1], 4, axis=0), at[1:])
        shape = f'<path d="{d}" fill="{c}" fill-opacity="0.13" stroke="{c}" stroke-width="1.3">{tip}</path>'
        return shape + f'<path d="{svg.dots(at[:1], 3)}" fill="{c}"/>', (*_pair(at[0]), thing.name)
    if isinstance(thing, Rectangle):
        d = svg.polyline(at, closed=True)
        shape = f'<path d="{d}" fill="{c}" fill-opacity="0.12" stroke="{c}" stroke-width="1.5">{tip}</path>'
        topmost = at[int(np.argmin(at[:, 1]))]
        return shape, (*_pair(topmost), thing.name)
    if isinstance(thing, Ray):
        d = svg.segments(at[:1], at[1:])
        return f'<path d="{d}" stroke="{c}" stroke-width="1.1" stroke-opacity="0.85">{tip}</path>', None
    if isinstance(thing, Trail):
        line = svg.line_path(at[:, 0], at[:, 1])
        return f'<path d="{line}" fill="none" stroke="{c}" stroke-width="1.1">{tip}</path>', None
    shape = f'<path d="{svg.dots(at, 3.2)}" fill="{c}" stroke="var(--paper)" stroke-width="0.6">{tip}</path>'
    return shape, (*_pair(at[0]), thing.name)


def _pair(at: Array) -> tuple[float, float]:
    return float(at[0]), float(at[1])


def _axis_cross(p: svg.PlotArea, to_drawing: Array) -> list[str]:
    """Directions of the world's axes, bottom left; an axis along the line of sight is omitted."""
    out = []
    origin = np.array([34.0, p.height - 30.0])
    for axis, name in zip(np.eye(3), "xyz", strict=True):
        flat = to_drawing @ axis
        if np.linalg.norm(flat) < 0.1:
            continue
        tip = origin + 24 * flat * [1, -1]
        out.append(f'<path d="{svg.segments(origin[None], tip[None])}" stroke="var(--ink)" stroke-width="1.4"/>')
        beyond = origin + 32 * flat * [1, -1]
        out.append(svg.text(float(beyond[0]), float(beyond[1]) + 4, name, "mid", "fill:var(--ink)"))
    return out
