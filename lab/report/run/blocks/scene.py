"""The scene of a run in three dimensions: two drawings, and data for a scene that turns and follows the cursor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from geometry.rig import Rig
from lab.files.run.results import PoseTrack
from lab.report.calibration.calibration_scene import LAB_VIEWS, scene_views
from lab.results.view.page import as_script, scene_data
from lab.results.view.scene import content_of_poses, view_of

_MOMENTS, _POINTS = 40, 160  # of the playback and of the trajectory: together 9 kB
_DIGITS = 3  # of coordinates in m


@dataclass(frozen=True, slots=True)
class ReportScene:
    """What the template shows."""

    stills: list[Markup]
    data: Markup
    frame: int  # of the drawings
    moments: int
    poses: int


def scene_of(name: str, rig: Rig | None, poses: PoseTrack) -> ReportScene | None:
    """The scene of a run; None without its rig, or without a pose."""
    if rig is None or not poses.known.any():
        return None
    content = content_of_poses(name, rig, poses)
    index = content.at_frame(None)
    assert index is not None  # a pose is known
    view = view_of(content, index, most_points=_POINTS, most_ellipsoids=0)
    known = int(np.count_nonzero(content.known))
    data = _packed(scene_data(view, index, _MOMENTS, _DIGITS))
    stills = scene_views([*view.fixed, *view.moving(index)], "Screens, cameras and beams", LAB_VIEWS[:2])
    return ReportScene(
        [Markup(s) for s in stills], as_script(data), int(content.frames[index]), len(data["packed"]), known
    )


def _packed(data: dict[str, Any]) -> dict[str, Any]:
    """The data of `scene_data` in a quarter of the bytes, which view.js expands: whole mm, and each spot's name once.

    A moment is frame, time, whether measured, place of the vehicle, and for each spot its number, its place and, where
    its beam does not start at the vehicle, that start.
    """
    lines = [{**line, "p": [p and _mm(p) for p in line["p"]]} for line in data["lines"]]
    names: list[str] = []
    packed = []
    for moment in data["moments"]:
        *spots, vehicle = moment["s"]
        origin = _mm(vehicle[2:])
        parts = []
        for (name, _, *place), (start, _) in zip(spots, moment["r"], strict=True):
            if name not in names:
                names.append(name)
            begin = _mm(start)
            parts.append([names.index(name), *_mm(place), *([] if begin == origin else begin)])
        packed.append([moment["k"], moment["t"], int(moment["m"]), origin, parts])
    return {"first": data["first"], "lines": lines, "names": names, "packed": packed}


def _mm(place: Sequence[float]) -> list[int]:
    """A place (3,) in m as whole mm."""
    return [round(1000 * v) for v in place]
