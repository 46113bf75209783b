"""Pictures of a run at the moments worth looking at, with what was measured and predicted drawn over them."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array
from lab.errors import BeamposeError
from lab.files.run.results import SPOT_STATUSES, read_result_table
from lab.files.run.run_file import DetectionsTable, LiveDevice, VideoFile
from lab.pictures.picture_file import Grey, Missing
from lab.report.plot import svg
from lab.report.run.report_data import ReportData
from lab.report.run.tracks import SPOT_COLOURS
from lab.runs.frames.frames import pictures_at
from tracking.detections import Detections
from tracking.statuses import PoseStatus, SpotStatus

Bytes: TypeAlias = NDArray[np.uint8]
MOST_PICTURES = 8
_KINDS = ("turn", "exit", "return", "no usable picture", "pose lost", "hidden")
_USUAL = ("dropped", "labelled")  # the run's own words for a hidden spot and for the first frame
_VIDEO_REACH = 1000  # a video is decoded from its start: look no farther than so many frames
_SHOWN_WIDTH = 400.0  # drawing units that a picture takes
_ZOOM_PX, _ZOOM_SHOWN = 64, 130.0  # side of the enlarged part, px, and what it takes


@dataclass(frozen=True, slots=True)
class ShownEvent:
    """Something that happened in one camera's picture."""

    index: int  # place among the frames
    camera: str
    spot: str | None
    kind: str
    text: str


def events(m: ReportData) -> list[ShownEvent]:
    """What happened, found in the tables: turns, exits, returns, hidden spots, missing pictures, a lost pose."""
    out: list[ShownEvent] = []
    cameras = m.spots.cameras
    for camera in cameras:
        own = [j for j, (c, _) in enumerate(m.spots.views) if c == camera]
        gone = np.any(m.spots.has(SpotStatus.NO_IMAGE)[:, own], axis=1)
        out += [
            ShownEvent(a, camera, None, "no usable picture", _for_frames("no usable picture", a, b))
            for a, b in svg.runs(gone)
        ]
    for j, (camera, spot) in enumerate(m.spots.views):
        outside = m.spots.has(SpotStatus.OUT_OF_VIEW)[:, j]
        hidden = m.spots.has(SpotStatus.OCCLUDED)[:, j]
        turned = m.spots.has(SpotStatus.TURNED)[:, j]
        measured = m.spots.measured[:, j]
        for a, b in svg.runs(outside):
            if a > 0 and measured[a - 1]:
                out.append(ShownEvent(a, camera, spot, "exit", _for_frames(f"spot {spot} leaves the picture", a, b)))
            if b < len(outside) and measured[b]:
                text = f"spot {spot} returns after {_frames(b - a)} out of view"
                out.append(ShownEvent(b, camera, spot, "return", text))
        out += [
            ShownEvent(a, camera, spot, "hidden", _for_frames(f"spot {spot} is not found where it should be", a, b))
            for a, b in svg.runs(hidden)
        ]
        out += [
            ShownEvent(a, camera, spot, "turn", f"the trajectory of spot {spot} bends") for a, _ in svg.runs(turned)
        ]
    if len(m.poses.frames) == len(m.spots.frames) and cameras:
        lost = m.poses.has(PoseStatus.LOST)
        out += [
            ShownEvent(a, cameras[0], None, "pose lost", _for_frames("the pose is lost", a, b))
            for a, b in svg.runs(lost)
        ]
    out += _noted(m)
    return sorted(out, key=lambda e: e.index)


def _noted(m: ReportData) -> list[ShownEvent]:
    """What the run itself noted in summary.json; one of the whole rig stands under the first camera."""
    listed = m.summary.get("events")
    place = {f: i for i, f in enumerate(m.spots.frames.tolist())}
    out = []
    for noted in listed if isinstance(listed, list) else []:
        if isinstance(noted, dict) and noted.get("frame") in place and m.spots.cameras:
            camera, spot = noted.get("camera"), noted.get("spot")
            kind = str(noted.get("kind") or "noted")
            words = (f"spot {spot}: " if spot else "") + str(noted.get("text") or kind)
            last = noted.get("last_frame")
            if isinstance(last, int) and last > noted["frame"]:
                words = _for_frames(words, noted["frame"], last + 1)
            known = camera if camera in m.spots.cameras else m.spots.cameras[0]
            out.append(ShownEvent(place[noted["frame"]], known, None if spot is None else str(spot), kind, words))
    return out


def _frames(n: int) -> str:
    return "1 frame" if n == 1 else f"{n} frames"


def _for_frames(what: str, start: int, stop: int) -> str:
    return f"{what}, for {_frames(stop - start)}"


def chosen(m: ReportData, found: list[ShownEvent]) -> list[ShownEvent]:
    """At most MOST_PICTURES events, every kind before any second one."""
    if m.run is not None and any(isinstance(s, VideoFile) for s in m.run.cameras.values()):
        found = [e for e in found if e.index < _VIDEO_REACH]
    cameras = m.spots.cameras
    if not cameras:
        return []
    noted = [e.kind for e in found if e.kind not in (*_KINDS, *_USUAL)]
    kinds = list(dict.fromkeys((*noted, *_KINDS, *_USUAL)))  # what a run rarely notes comes first
    piles = [[e for e in found if e.kind == kind] for kind in kinds]
    # of each kind: its first, its last, its middle ...
    orders = [[pile[i] for i in dict.fromkeys([0, len(pile) - 1, len(pile) // 2])] if pile else [] for pile in piles]
    picked = [ShownEvent(0, camera, None, "start", "the first frame") for camera in cameras[:2]]
    for turn in range(3):
        for order in orders:
            if turn < len(order) and len(picked) < MOST_PICTURES:
                event = order[turn]
                if all((event.index, event.camera) != (p.index, p.camera) for p in picked):
                    picked.append(event)
    return sorted(picked, key=lambda e: e.index)


def pictures(m: ReportData, results: Path, selection: list[ShownEvent]) -> list[str]:
    """An SVG for each event: the picture with its overlay, an enlarged part beside it, and what it shows."""
    if m.run is None:
        return []
    points = _detections(results / "detections.csv", {int(m.spots.frames[e.index]) for e in selection})
    read: dict[tuple[str, int], Grey | str] = {}
    for camera, source in m.run.cameras.items():
        frames = [int(m.spots.frames[e.index]) for e in selection if e.camera == camera]
        if not frames or isinstance(source, DetectionsTable | LiveDevice):
            continue
        try:
            found = pictures_at(m.run, camera, frames)
        except BeamposeError:
            continue
        for frame, picture in found.items():
            if isinstance(picture, Missing):
                read[camera, frame] = picture.reason
            elif not isinstance(picture, Detections):
                read[camera, frame] = picture  # as they come: eight as floats would be 80 MB
    drawings = []
    for event in selection:
        picture_or_reason = read.get((event.camera, int(m.spots.frames[event.index])))
        if picture_or_reason is not None:
            shown = picture_or_reason if isinstance(picture_or_reason, str) else picture_or_reason.astype(float)
            drawings.append(_drawing(m, event, shown, points))
    return drawings


def _detections(path: Path, frames: set[int]) -> dict[tuple[int, str], Array]:
    """Detected points (n, 2), px, of some frames, by frame and camera."""
    if not path.exists() or not frames:
        return {}
    table = read_result_table(path, ("frame", "camera", "u_px", "v_px"))
    frame, camera = table.numbers["frame"], table.words["camera"]
    out = {}
    for f in frames:
        rows = np.flatnonzero(frame == f)
        for code, name in enumerate(camera.words):
            out[f, name] = table.stack("u_px", "v_px")[rows[camera.codes[rows] == code]]
    return out


def _drawing(m: ReportData, event: ShownEvent, picture: Array | str, points: dict[tuple[int, str], Array]) -> str:
    """picture: grey values (h, w), or why there is none."""
    w, h = m.picture_sizes[event.camera]
    frame = int(m.spots.frames[event.index])
    scale = _SHOWN_WIDTH / w
    tall = h * scale
    views = [j for j, (c, _) in enumerate(m.spots.views) if c == event.camera]
    focus = _focus(m, event, views, (w, h))
    height = max(tall, _ZOOM_SHOWN + 96) + 36
    when = f"t = {m.t_s[event.index]:.3f} s" if m.time_name != "frame" else ""
    head = f"frame {frame}" + (f", {when}" if when else "") + f", camera {event.camera}"
    out = [
        f'<svg class="plot shot" viewBox="0 0 540 {height:.0f}" role="img">'
        f"<title>{escape(f'{head}: {event.text}')}</title>",
        svg.text(0, 12, head, "title") + svg.text(0, 27, event.text, "tick"),
        f'<svg x="0" y="34" width="{_SHOWN_WIDTH}" height="{tall:.1f}" viewBox="-0.5 -0.5 {w} {h}">',
    ]
    if isinstance(picture, str):
        out.append(f'<rect class="nopicture" x="-0.5" y="-0.5" width="{w}" height="{h}"/>')
        out.append(svg.text(w / 2, 0.09 * h, picture, "halo mid", f"fill:#fff;font-size:{14 / scale:.0f}px"))
    else:
        shown = stretched(picture, *grey_limits(picture))
        if w > 2 * _SHOWN_WIDTH:
            shown = np.asarray(cv2.resize(shown, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)
        out.append(
            f'<image x="-0.5" y="-0.5" width="{w}" height="{h}" preserveAspectRatio="none"'
            f' href="{_data_uri(shown, ".jpg")}"/>'
        )
    out.append(_overlay(m, event.index, views, (w, h), 1 / scale, points.get((frame, event.camera))))
    out.append("</svg>")
    if not isinstance(picture, str) and focus is not None:
        out.append(_zoom(m, event, picture, focus, views, points.get((frame, event.camera))))
    out.append(_statuses(m, event.index, views, tall))
    return "".join(out) + "</svg>"


def _focus(m: ReportData, event: ShownEvent, views: list[int], size: tuple[int, int]) -> Array | None:
    """Where to look closer (2,), px: at the event's spot, or else at the first that is in the picture."""
    named = [j for j in views if m.spots.views[j][1] == event.spot]
    for j in named or views:
        for uv in (m.spots.uv_px[event.index, j], m.spots.uv_px[max(event.index - 1, 0), j]):
            if np.isfinite(uv).all() and (uv > 0).all() and (uv < np.array(size) - 1).all():
                return uv
    return None


def grey_limits(picture: Array) -> tuple[float, float]:
    """The grey values to show as black and as white: what is brighter than 3 pixels in 10,000 clips.

    At least eight times the spread of the background lies between them, so that a dark picture does not become noise.
    """
    low, usual, high = np.percentile(picture, [1.0, 50.0, 99.97])
    return float(low), float(max(high, low + 8.0 * (usual - low), low + 8.0))


def stretched(picture: Array, low: float, high: float) -> Bytes:
    """Eight bits, so that the background is just seen and the spots do not all clip."""
    shares = np.clip((picture - low) / max(high - low, 1.0), 0.0, 1.0)
    return (255 * np.sqrt(shares)).astype(np.uint8)


def _data_uri(picture: Bytes, kind: str) -> str:
    options = [cv2.IMWRITE_JPEG_QUALITY, 72] if kind == ".jpg" else [cv2.IMWRITE_PNG_COMPRESSION, 9]
    data = cv2.imencode(kind, picture, options)[1].tobytes()
    return f"data:image/{'jpeg' if kind == '.jpg' else 'png'};base64,{base64.b64encode(data).decode()}"


def _overlay(
    m: ReportData,
    k: int,
    views: list[int],
    size: tuple[int, int],
    unit: float,
    points: Array | None,
    enlarged: bool = False,
) -> str:
    """Markers, and names where not enlarged, in picture pixels; `unit`: pixels that one drawing unit takes."""
    ring = (14 if enlarged else 8) * unit
    w, h = size
    out: list[str] = []
    taken: list[tuple[float, float]] = []
    if points is not None and len(points):
        r = (9 if enlarged else 4) * unit
        d = "".join(f"M{u - r:.1f} {v - r:.1f}h{2 * r:.1f}v{2 * r:.1f}h{-2 * r:.1f}z" for u, v in points.tolist())
        out.append(
            f'<path d="{d}" fill="none" stroke="#c8ccd2" stroke-width="{unit:.2f}"><title>detection</title></path>'
        )
    for j in views:
        uv, early, spot = m.spots.uv_px[k, j], m.spots.predicted_px[k, j], m.spots.views[j][1]
        code = int(m.spots.status[k, j])
        if code < 0:
            continue
        status = SPOT_STATUSES[code]
        colour = SPOT_COLOURS[status]
        if np.isfinite(early).all():
            r = 5 * unit
            a, b = early[0] - r, early[1] - r
            d = f"M{a:.2f} {b:.2f}l{2 * r:.2f} {2 * r:.2f}m0 {-2 * r:.2f}l{-2 * r:.2f} {2 * r:.2f}"
            out.append(
                f'<path d="{d}" fill="none" stroke="{svg.YELLOW}" stroke-width="{1.2 * unit:.2f}">'
                f"<title>{escape(f'spot {spot}: predicted')}</title></path>"
            )
        if not np.isfinite(uv).all():
            continue
        inside = -0.5 <= uv[0] < w - 0.5 and -0.5 <= uv[1] < h - 0.5
        if inside:
            dash = "" if status.measured else f' stroke-dasharray="{3 * unit:.1f} {2 * unit:.1f}"'
            out.append(
                f'<circle cx="{uv[0]:.2f}" cy="{uv[1]:.2f}" r="{ring:.2f}" fill="none" stroke="{colour}"'
                f' stroke-width="{1.8 * unit:.2f}"{dash}><title>{escape(f"spot {spot}: {status}")}</title></circle>'
            )
            name, x, y = spot, uv[0] + 11 * unit, uv[1] - 7 * unit
        else:
            x, y, arrow = _arrow(uv, size, unit)
            out.append(f'<path d="{arrow}" fill="{colour}"><title>{escape(f"spot {spot}: {status}")}</title></path>')
            gap = float(np.linalg.norm(uv - np.clip(uv, -0.5, np.array(size) - 0.5)))
            name = f"{spot}: {gap:.0f} px out"
        if not enlarged:
            x = min(max(x, 4 * unit), w - (8 * len(name) + 4) * unit)
            y = min(max(y, 14 * unit), h - 5 * unit)
            wide = 8 * len(name) * unit
            crossed = [c for i in views if i != j and np.isfinite(c := m.spots.uv_px[k, i]).all()]
            for _ in range(2 * len(views)):
                over_name = any(abs(x - tx) < wide and abs(y - ty) < 14 * unit for tx, ty in taken)
                over_ring = any(
                    x - ring < u < x + wide + ring and y - 12 * unit - ring < v < y + ring for u, v in crossed
                )
                if not (over_name or over_ring):
                    break
                y = y + 14 * unit if y < h / 2 else y - 14 * unit
            taken.append((x, y))
            out.append(svg.text(x, y, name, "halo", f"fill:#fff;font-size:{13 * unit:.1f}px"))
    return "".join(out)


def _arrow(uv: Array, size: tuple[int, int], unit: float) -> tuple[float, float, str]:
    """A wedge at the picture's border that points to a place outside it: where its name may stand, and its path."""
    border = np.clip(uv, [2 * unit, 2 * unit], np.array(size) - 1 - 2 * unit)
    along = (uv - border) / max(float(np.linalg.norm(uv - border)), 1e-9)
    across = np.array([-along[1], along[0]])
    tip, foot = border, border - 16 * unit * along
    corners = (tip, foot + 7 * unit * across, foot - 7 * unit * across)
    d = "M" + "L".join(f"{c[0]:.1f} {c[1]:.1f}" for c in corners) + "z"
    name_at = border - 22 * unit * along
    return float(name_at[0]), float(name_at[1]) + 4 * unit, d


def _zoom(
    m: ReportData, event: ShownEvent, picture: Array, focus: Array, views: list[int], points: Array | None
) -> str:
    """The surroundings of one spot, enlarged, pixel by pixel."""
    h, w = picture.shape
    side = min(_ZOOM_PX, w, h)
    corner = np.clip(np.round(focus).astype(int) - side // 2, 0, [w - side, h - side])
    part = picture[corner[1] : corner[1] + side, corner[0] : corner[0] + side]
    unit = side / _ZOOM_SHOWN
    x0, y0 = corner - 0.5
    marks = _overlay(m, event.index, views, (w, h), unit, points, enlarged=True)
    frame = f'x="{x0}" y="{y0}" width="{side}" height="{side}"'
    low, high = grey_limits(picture)
    data = _data_uri(stretched(part, low, max(high, float(part.max()))), ".png")
    inner = (
        f'<svg x="408" y="34" width="{_ZOOM_SHOWN}" height="{_ZOOM_SHOWN}" viewBox="{x0} {y0} {side} {side}">'
        f'<image {frame} style="image-rendering:pixelated" href="{data}"/>{marks}</svg>'
    )
    words = (f"enlarged: {side} × {side} px", f"from u = {corner[0]}, v = {corner[1]}")
    return inner + "".join(svg.text(408, 34 + _ZOOM_SHOWN + 15 + 14 * i, line, "tick") for i, line in enumerate(words))


def _statuses(m: ReportData, k: int, views: list[int], tall: float) -> str:
    """The spots' statuses in words, beside the foot of the picture."""
    lines = []
    for j in views:
        code = int(m.spots.status[k, j])
        if code >= 0:
            status = SPOT_STATUSES[code]
            lines.append((f"{m.spots.views[j][1]}: {str(status).replace('_', ' ')}", SPOT_COLOURS[status]))
    fits = max(int((tall - _ZOOM_SHOWN - 40) / 15), 0)
    foot = 34 + tall - 4
    shown = lines[:fits]
    return "".join(
        f'<circle cx="413" cy="{foot - 15 * (len(shown) - 1 - i) - 4:.1f}" r="4" fill="{colour}"/>'
        + svg.text(422, foot - 15 * (len(shown) - 1 - i), words, "tick")
        for i, (words, colour) in enumerate(shown)
    )
