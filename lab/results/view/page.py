"""`beampose view`: view.html, the scene to turn and to play in a browser with still drawings, and scene.glb.

view.html is one file that works offline; it opens in the browser where there is a display.
"""

from __future__ import annotations

import os
import sys
import webbrowser
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from geometry.arrays import Array, Ints, evenly_spaced
from geometry.forward_model import SpotModel
from lab.files.text.atomic_write import atomic_write_text, made_folder
from lab.findings.outcome import Done
from lab.report.calibration.calibration_scene import Rectangle, outline, scene_views
from lab.report.html import as_script, environment
from lab.report.plot.svg import ORANGE, PURPLE
from lab.results.view.scene import RigAndPoses, View, edges, mesh_of, read_content, view_of, write_glb

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
    html = (
        environment()
        .get_template("view.html.j2")
        .render(
            name=content.name,
            poses=content.poses_from,
            space=_space(view),
            frame=None if index is None or not content.poses_from else int(content.frames[index]),
            moments=int(content.known.sum()),
            ellipsoids=len(view.ellipsoids),
            too_large=view.too_large,
            scale=f"{view.sigma_scale:g}",
            drawings=[Markup(d) for d in scene_views(things)],
            data=as_script(scene_data(view, index)),
        )
    )
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
    for thing in view.fixed:
        for number, line in enumerate(edges(thing, view.reach_m)):
            label = thing.name if number == 0 and not thing.name.startswith(("trajectory", "workspace")) else ""
            lines.append(
                {"c": thing.colour, "n": label, "f": isinstance(thing, Rectangle), "p": _rounded(line, digits)}
            )
    for e in view.ellipsoids:
        lines += [{"c": e.colour, "n": "", "f": False, "p": _rounded(c.places, digits)} for c in e.circles()]
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
        out.append(
            {
                "k": int(content.frames[i]),
                "t": round(float(content.t_s[i]), 4),
                "m": bool(content.measured[i]),
                "r": rays,
                "s": spots,
            }
        )
    return out


def _rounded(points: Array, digits: int) -> list[list[float] | None]:
    """Points (n, 3) as lists; None where not finite."""
    return [[round(v, digits) for v in p] if np.isfinite(p).all() else None for p in points.tolist()]
