"""`beampose view`: view.html, the scene to turn and to play in a browser with still drawings, and scene.glb.

view.html is one file that works offline; it opens in the browser where there is a display.
"""

from __future__ import annotations

import json
import os
import struct
import sys
import webbrowser
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from geometry.arrays import Array, Bools, Ints, evenly_spaced
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_solver.visibility import assumed_range
from geometry.rig import Rig
from lab.errors import InputError
from lab.files.rig.rig_file import load_rig
from lab.files.run.results import PoseTrack, ResultFolder
from lab.files.run.run_file import load_run
from lab.files.run.truth import load_run_truth
from lab.files.text.atomic_write import atomic_write_bytes, atomic_write_text, made_folder
from lab.findings.finding import Done
from lab.report.calibration.calibration_scene import (
    Frustum,
    Marker,
    Ray,
    Rectangle,
    SceneObject,
    Trail,
    frustum_length,
    outline,
    rig_things,
    scene_views,
)
from lab.report.page import as_script, environment
from lab.report.plot.svg import GREY, ORANGE, PURPLE, round_size
from tracking.statuses import PoseStatus

# What `beampose view` shows: a rig, and the poses of a run's truth or of results.


@dataclass(frozen=True, slots=True)
class RigAndPoses:
    """A rig and F poses of the vehicle; for a rig alone, one in the middle of what it sees."""

    name: str
    poses_from: str  # what the poses are, in words; empty without poses
    rig: Rig
    frames: Ints  # (F,), rising
    t_s: Array  # (F,), or frame numbers where times are missing
    world_from_body: Pose  # (F,); nan translation where unknown
    position_covariance: Array  # (F, 3, 3), m^2, in world; nan where unknown
    measured: Bools  # (F,)

    @property
    def known(self) -> Bools:
        """(F,): whether there is a pose."""
        return np.all(np.isfinite(self.world_from_body.translation), axis=-1)

    def at_frame(self, frame: int | None) -> int | None:
        """Index of a frame; None: the middle one of the known poses, or None without any.

        Raises InputError: there is no such frame, or it has no pose.
        """
        known = np.flatnonzero(self.known)
        if frame is None:
            return int(known[len(known) // 2]) if len(known) else None
        if not (len(known) and self.poses_from):
            raise InputError(f"--frame {frame}: {self.name} has no poses; leave --frame out")
        numbers = self.frames[known]
        if frame not in numbers:
            raise InputError(f"--frame {frame}: expected a frame with a pose, {numbers[0]} to {numbers[-1]}")
        return int(known[np.flatnonzero(numbers == frame)[0]])


def read_content(path: Path, rig_path: Path | None) -> RigAndPoses:
    """A rig.yaml, a run folder (with the poses of its truth) or a results folder.

    rig_path: a rig.yaml in place of the one that the run names. Raises InputError: the path is none of these, or a file
    is not as it should be.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: expected a rig.yaml, a run folder or a folder of results, found nothing")
    if path.is_dir() and (path / "attitude.csv").is_file():
        return _of_results(path, rig_path)
    if path.is_dir() or path.name == "run.yaml":
        return _of_run(path, rig_path)
    rig = load_rig(path)
    if rig_path is not None:
        raise InputError(f"--rig: expected a run or results to combine it with, got the rig {path}; leave --rig out")
    return _without_poses(path.name, rig)


def _of_results(results: Path, rig_path: Path | None) -> RigAndPoses:
    folder = ResultFolder(results)
    rig = load_rig(rig_path) if rig_path is not None else folder.run("name its rig: --rig rig.yaml").rig
    return content_of_poses(folder.name, rig, folder.poses)


def content_of_poses(name: str, rig: Rig, track: PoseTrack) -> RigAndPoses:
    """The poses of attitude.csv with the covariances of their positions."""
    covariance = track.covariance[:, :3, :3].copy()
    without = ~np.isfinite(covariance).all(axis=(1, 2))
    covariance[without] = track.sigma_position_m[without][:, :, None] ** 2 * np.eye(3)
    measured = track.has(PoseStatus.MEASURED)
    t_s = track.t_s if np.isfinite(track.t_s).all() else track.frames.astype(float)
    return RigAndPoses(name, "attitude.csv", rig, track.frames, t_s, track.world_from_body, covariance, measured)


def _of_run(path: Path, rig_path: Path | None) -> RigAndPoses:
    run = load_run(path)
    rig = run.rig if rig_path is None else load_rig(rig_path)
    truth = load_run_truth(run)
    if truth is not None and truth.pose is not None:
        t = truth.pose
        n = len(t.frame)
        poses = Pose.from_quaternion(t.quaternion_wxyz, t.position_m)
        unknown = np.full((n, 3, 3), np.nan)
        return RigAndPoses(run.name, "truth/pose.csv", rig, t.frame, t.t_s, poses, unknown, np.ones(n, dtype=bool))
    if run.prior is None:
        return _without_poses(run.name, rig)
    # An even spread within a cube has this variance along each axis.
    return _of_one(run.name, "the prior of run.yaml", rig, run.prior.centre, run.prior.within_m**2 / 3)


def _without_poses(name: str, rig: Rig) -> RigAndPoses:
    """A rig with the vehicle in the middle of what it sees."""
    return _of_one(name, "", rig, assumed_range(rig).centre, np.nan)


def _of_one(name: str, poses_from: str, rig: Rig, pose: Pose, variance_m2: float) -> RigAndPoses:
    """One pose that was not measured, with the variance of its position along each axis."""
    first, not_measured = np.zeros(1, dtype=np.int64), np.zeros(1, dtype=bool)
    covariance = variance_m2 * np.eye(3)[None]
    return RigAndPoses(name, poses_from, rig, first, np.zeros(1), Pose.stack([pose]), covariance, not_measured)


def workspace(rig: Rig, middle: Pose) -> Trail | None:
    """The box along the world's axes in which half of the spots stay in view, with the attitude of the middle; ours.

    Each side ends where, on the line through the middle, fewer spots are in view. None: too few in the middle.
    """
    model = SpotModel.of(rig)

    def seen(places: Array) -> Ints:
        """Spots (n,) in view at positions (n, 3)."""
        poses = Pose(np.broadcast_to(middle.rotation, (len(places), 3, 3)), places)
        inside = model.in_picture(model.project(poses)[0])
        return np.sum([inside[:, model.spot_of == k].any(axis=1) for k in range(len(model.spot_names))], axis=0)

    enough = max(3, -(-int(seen(middle.translation[None])[0]) // 2))
    if seen(middle.translation[None])[0] < enough:
        return None
    steps = np.linspace(0.0, _FAR_M, _STEPS)[1:]
    ends = np.zeros((2, 3))
    for side, sign in enumerate((-1.0, 1.0)):
        for axis in range(3):
            few = seen(middle.translation + sign * steps[:, None] * np.eye(3)[axis]) < enough
            first = int(np.argmax(few)) if few.any() else len(few)
            ends[side, axis] = sign * (steps[first - 1] if first else 0.0)
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    places = np.append(np.where(corners == 0, ends[0], ends[1]) + middle.translation, np.full((1, 3), np.nan), axis=0)
    edges_of = [(a, b, -1) for a in range(8) for b in range(a) if np.sum(corners[a] != corners[b]) == 1]
    return Trail("workspace", places[np.ravel(edges_of)][:-1], GREY)


# A scene as one coloured triangle mesh: lines as thin tubes, spots as balls, sigmas as ellipsoids.


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


def ball(centre: Array, axes: Array, colour: str) -> Mesh:
    """An ellipsoid: centre (3,) + axes (3, 3) @ u for u on the unit sphere."""
    rows, columns = 8, 12
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
    parts = [Mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64), np.zeros((0, 3))), *parts]
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


# The objects of a view: what stays, and what moves with the vehicle; sigma ellipsoids at a stated scale.


MOST_ELLIPSOIDS = 60
MOST_POINTS = 1500  # of the trajectory
_LARGEST = 0.2  # largest semi-axis that is drawn, in shares of the scene's extent: larger ones would cover it
_SHARE = 0.02  # of the scene's extent: the size at which a typical ellipsoid is drawn
_FAR_M, _STEPS = 10.0, 401  # how far from the middle the workspace is looked for, and at how many places
_SIZING = 200  # poses whose spots decide the size of a screen that states none
_TURN = np.linspace(0, 2 * np.pi, 33)
_SIGMA = "sigma of the position"
_WITHOUT_LABEL = ("trajectory", "workspace", _SIGMA)  # on the page


@dataclass(frozen=True, slots=True)
class Ellipsoid:
    """The positions within k sigma of one pose: centre + axes @ u, u on the unit sphere."""

    centre: Array  # (3,), m, in world
    axes: Array  # (3, 3), m: columns are the semi-axes
    colour: str

    def circles(self) -> list[Trail]:
        """Its three principal ellipses."""
        ring = np.stack([np.cos(_TURN), np.sin(_TURN), 0 * _TURN])
        return [Trail(_SIGMA, self.centre + (self.axes @ np.roll(ring, k, axis=0)).T, self.colour) for k in range(3)]


@dataclass(frozen=True, slots=True)
class View:
    """A scene to be drawn."""

    content: RigAndPoses
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
    content: RigAndPoses,
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
    space = None if content.poses_from or pose is None else workspace(content.rig, pose)
    others = content.world_from_body[evenly_spaced(known, _SIZING)] if len(known) > 1 else None
    fixed: list[SceneObject] = [t for t in rig_things(content.rig, pose, others) if not isinstance(t, Ray | Marker)]
    if len(known) > 1:
        positions = content.world_from_body.translation  # nan where the pose is unknown
        fixed.append(Trail("trajectory", positions[evenly_spaced(np.arange(len(positions)), most_points)], PURPLE))
    fixed += [] if space is None else [space]
    reach = frustum_length(fixed)
    points = np.concatenate([outline(t, reach) for t in fixed])
    extent = float(np.ptp(points[np.isfinite(points).all(axis=1)], axis=0).max())
    with_sigma = known[np.isfinite(content.position_covariance[known]).all(axis=(1, 2))]
    scale = _scale(content, with_sigma, extent) if sigma_scale is None else sigma_scale
    ellipsoids = [ellipsoid(content, int(i), scale) for i in evenly_spaced(with_sigma, most_ellipsoids)]
    drawn = [e for e in ellipsoids if np.linalg.norm(e.axes, axis=0).max() <= _LARGEST * extent]
    return View(content, fixed, drawn, scale, len(ellipsoids) - len(drawn), reach, extent)


def ellipsoid(content: RigAndPoses, index: int, scale: float) -> Ellipsoid:
    """The ellipsoid of `scale` sigmas of one pose's position; grey where the pose is predicted."""
    values, vectors = np.linalg.eigh(content.position_covariance[index])
    axes = vectors * np.sqrt(np.maximum(values, 0.0)) * scale
    return Ellipsoid(content.world_from_body.translation[index], axes, PURPLE if content.measured[index] else GREY)


def _scale(content: RigAndPoses, indices: Ints, extent_m: float) -> float:
    """A round factor with which the median sigma is a share of the scene; at least 1."""
    if not len(indices):
        return 1.0
    sigmas = np.sqrt(np.linalg.eigvalsh(content.position_covariance[indices])[:, -1].clip(min=0.0))
    typical = float(np.median(sigmas))
    return max(1.0, round_size(_SHARE * extent_m / typical)) if typical > 0 else 1.0


# Scenes as binary glTF 2.0 (.glb), which browsers, Blender and presentation programs open.


_FLOAT, _UINT32, _VERTICES, _INDICES = 5126, 5125, 34962, 34963
_UPRIGHT = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]  # glTF's y is up, the lab's z: a turn of -90 degrees about x


def write_glb(mesh: Mesh, path: Path) -> None:
    """Write a mesh with vertex colours, complete or not at all. Raises InputError."""
    points = mesh.vertices.astype("<f4")
    blocks = [
        (points.tobytes(), _VERTICES),
        (_linear(mesh.colours).astype("<f4").tobytes(), _VERTICES),
        (mesh.triangles.astype("<u4").tobytes(), _INDICES),
    ]
    starts = np.cumsum([0, *(len(data) for data, _ in blocks)])
    n = len(points)
    span = {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()}
    tree = {
        "asset": {"version": "2.0", "generator": "beampose"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": _UPRIGHT}],
        "materials": [{"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.9}, "doubleSided": True}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}]}],
        "accessors": [
            {"bufferView": 0, "componentType": _FLOAT, "count": n, "type": "VEC3", **span},
            {"bufferView": 1, "componentType": _FLOAT, "count": n, "type": "VEC3"},
            {"bufferView": 2, "componentType": _UINT32, "count": mesh.triangles.size, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": int(start), "byteLength": len(data), "target": target}
            for (data, target), start in zip(blocks, starts, strict=False)
        ],
        "buffers": [{"byteLength": int(starts[-1])}],
    }
    text = json.dumps(tree, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    binary = b"".join(data for data, _ in blocks)  # float32 and uint32: a multiple of four bytes
    parts = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    atomic_write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(parts)) + parts, path)


def _linear(srgb: np.ndarray) -> np.ndarray:
    """Light intensities of sRGB colours, as glTF has them."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


DEFAULT_OUT = Path("results", "view")
MOST_MOMENTS = 800  # of the playback


def show(
    path: Path,
    out: Path | None,
    *,
    frame: int | None = None,
    rig: Path | None = None,
    sigma_scale: float | None = None,
) -> Done[tuple[Path, ...]]:
    """Write the scene of a rig.yaml, a run folder or results; without `out`, also open its page in the browser.

    frame: of the beams and spots; None: the middle one. sigma_scale: of the ellipsoids; None: a round number that makes
    them visible. rig: a rig.yaml in place of the run's. Raises InputError: an input is not as it should be, or a file
    cannot be written.
    """
    content = read_content(path, rig)
    index = content.at_frame(frame)
    view = view_of(content, index, sigma_scale)
    folder = made_folder(out or DEFAULT_OUT)
    files = folder / "view.html", folder / "scene.glb"
    write_page(view, index, files[0])
    if out is None and has_display():
        webbrowser.open(files[0].resolve().as_uri())
    write_glb(mesh_of([*view.fixed, *view.moving(index)], view.ellipsoids, view.reach_m, view.extent_m), files[1])
    return Done(files, tuple(map(str, files)))


def has_display() -> bool:
    """Whether a browser can show a page here, and not in the terminal."""
    names = ("DISPLAY", "WAYLAND_DISPLAY")
    return not sys.platform.startswith("linux") or any(os.environ.get(name) for name in names)


def write_page(view: View, index: int | None, path: Path) -> None:
    """Write view.html; index: of the pose in the still drawings. Raises InputError."""
    things = [*view.fixed, *view.moving(index), *(c for e in view.ellipsoids for c in e.circles())]
    content = view.content
    html = environment().get_template("view.html.j2").render(
        name=content.name, poses=content.poses_from, space=_space(view),
        frame=None if index is None or not content.poses_from else int(content.frames[index]),
        moments=int(content.known.sum()), ellipsoids=len(view.ellipsoids), too_large=view.too_large,
        scale=f"{view.sigma_scale:g}", drawings=[Markup(d) for d in scene_views(things)],
        data=as_script(scene_data(view, index)),
    )  # fmt: skip
    atomic_write_text(html, path)


def _space(view: View) -> str:
    """The size of a rig's workspace, in words; empty where there is none."""
    box = next((t for t in view.fixed if t.name == "workspace"), None)
    if box is None:
        return ""
    x, y, z = np.ptp(outline(box, 0.0)[np.isfinite(outline(box, 0.0)).all(axis=1)], axis=0)
    return f", in a grey box of {x:.2g} x {y:.2g} x {z:.2g} m in which at least half of them stay in view"


def scene_data(view: View, index: int | None, most_moments: int = MOST_MOMENTS, digits: int = 4) -> dict[str, Any]:
    """The scene for the page's program: lines, labels and moments; coordinates in m, rounded to so many digits."""
    lines = []
    for thing in (*view.fixed, *(c for e in view.ellipsoids for c in e.circles())):
        for number, line in enumerate(edges(thing, view.reach_m)):
            label = "" if number or thing.name in _WITHOUT_LABEL else thing.name
            filled = isinstance(thing, Rectangle)
            lines.append({"c": thing.colour, "n": label, "f": filled, "p": _rounded(line, digits)})
    content = view.content
    indices = evenly_spaced(np.flatnonzero(content.known), most_moments)
    first = 0 if index is None else min(int(np.searchsorted(indices, index)), len(indices) - 1)
    return {"lines": lines, "moments": _moments(content, indices, digits), "first": first}


def _moments(content: RigAndPoses, indices: Ints, digits: int) -> list[dict[str, Any]]:
    """Frame, time, status, rays and spots (name, colour and place) of some poses: as View.moving, all at once."""
    rig, poses = content.rig, content.world_from_body[indices]
    model = SpotModel.of(rig)
    hits = model.hits(poses)
    starts = {b.name: poses.apply(b.point) for b in rig.beams.values()} if len(indices) else {}
    out = []
    for k, i in enumerate(indices.tolist()):
        rays, spots, drawn = [], [], set()
        for j, (_, spot) in enumerate(model.views):
            if spot in drawn or not np.isfinite(hits[k, j]).all():
                continue
            drawn.add(spot)
            rays.append(_rounded(np.stack([starts[rig.spots[spot].beam][k], hits[k, j]]), digits))
            spots.append([spot, ORANGE, *hits[k, j].round(digits).tolist()])
        spots.append(["vehicle", PURPLE, *poses.translation[k].round(digits).tolist()])
        t, measured = round(float(content.t_s[i]), 4), bool(content.measured[i])
        out.append({"k": int(content.frames[i]), "t": t, "m": measured, "r": rays, "s": spots})
    return out


def _rounded(points: Array, digits: int) -> list[list[float] | None]:
    """Points (n, 3) as lists; None where not finite."""
    return [[round(v, digits) for v in p] if np.isfinite(p).all() else None for p in points.tolist()]
