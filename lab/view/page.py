"""view.html: the scene to turn and to play in a browser, and still drawings of it, in one file that works offline."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from geometry.arrays import Array
from lab.files.text.atomic_write import atomic_write_text
from lab.report.calibration.calibration_scene import Marker, Ray, Rectangle, scene_views
from lab.report.html import environment
from lab.view.scene import View, thinned
from lab.view.solids import edges

MOST_MOMENTS = 800  # of the playback


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
            frame=None if index is None else int(content.frames[index]),
            moments=int(content.known.sum()),
            ellipsoids=len(view.ellipsoids),
            too_large=view.too_large,
            scale=f"{view.sigma_scale:g}",
            drawings=[Markup(d) for d in scene_views(things)],
            data=Markup(json.dumps(scene_data(view, index), separators=(",", ":")).replace("<", "\\u003c")),
        )
    )
    atomic_write_text(html, path)


def scene_data(view: View, index: int | None) -> dict[str, Any]:
    """The scene for the page's program: lines, labels and moments; coordinates in m, rounded to 0.1 mm."""
    lines = []
    for thing in view.fixed:
        for number, line in enumerate(edges(thing, view.reach_m)):
            label = thing.name if number == 0 and not thing.name.startswith("trajectory") else ""
            lines.append({"c": thing.colour, "n": label, "f": isinstance(thing, Rectangle), "p": _rounded(line)})
    for e in view.ellipsoids:
        lines += [{"c": e.colour, "n": "", "f": False, "p": _rounded(c.places)} for c in e.circles()]
    content = view.content
    moments = []
    indices = thinned(np.flatnonzero(content.known), MOST_MOMENTS)
    for i in indices:
        things = view.moving(int(i))
        rays = [t for t in things if isinstance(t, Ray)]
        spots = [t for t in things if isinstance(t, Marker)]
        moments.append(
            {
                "k": int(content.frames[i]),
                "t": round(float(content.t_s[i]), 4),
                "m": bool(content.measured[i]),
                "r": [_rounded(np.stack([t.start, t.end])) for t in rays],
                "s": [[t.name, t.colour, *t.place.round(4).tolist()] for t in spots if np.isfinite(t.place).all()],
            }
        )
    first = 0 if index is None else min(int(np.searchsorted(indices, index)), len(indices) - 1)
    return {"lines": lines, "moments": moments, "first": first}


def _rounded(points: Array) -> list[list[float] | None]:
    """Points (n, 3) as lists; None where not finite."""
    return [[round(v, 4) for v in p] if np.isfinite(p).all() else None for p in points.tolist()]
