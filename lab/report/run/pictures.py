"""Pictures of a run at selected events, with measured and predicted places of the spots drawn over them."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np

from geometry.arrays import Array
from lab.errors import BeamposeError
from lab.files.run.results import SPOT_STATUSES, read_result_table
from lab.files.run.run_file import DetectionsTable, LiveDevice
from lab.pictures.opencv import load_cv2
from lab.pictures.picture_file import GreyPicture, MissingPicture
from lab.report.plot import axes
from lab.report.plot.image import grey_limits, image_uri, stretched
from lab.report.run.events import ShownEvent
from lab.report.run.report_data import ReportData
from lab.report.run.tracks import SPOT_COLOURS
from lab.runs.frames.frames import pictures_at
from tracking.detections import Detections

_SHOWN_WIDTH = 400.0  # drawing units that a picture takes
_ZOOM_PX, _ZOOM_SHOWN = 64, 130.0  # side of the enlarged part: px, and drawing units


@dataclass(frozen=True, slots=True)
class _Shot:
    """One picture to draw."""

    m: ReportData
    event: ShownEvent
    views: list[int]  # of its camera
    size_px: tuple[int, int]
    detections: Array | None  # (n, 2), px; None: not known

    @property
    def frame(self) -> int:
        return int(self.m.spots.frames[self.event.index])


def pictures(m: ReportData, results: Path, selection: list[ShownEvent]) -> list[str]:
    """An SVG for each event: the picture with markers, an enlarged part beside it, and the statuses of the spots."""
    if m.run is None:
        return []
    points = _detections(results / "detections.csv", {int(m.spots.frames[e.index]) for e in selection})
    read: dict[tuple[str, int], GreyPicture | str] = {}
    for camera, source in m.run.cameras.items():
        frames = [int(m.spots.frames[e.index]) for e in selection if e.camera == camera]
        if not frames or isinstance(source, DetectionsTable | LiveDevice):
            continue
        try:
            found = pictures_at(m.run, camera, frames)
        except BeamposeError:
            continue
        for frame, picture in found.items():
            if isinstance(picture, MissingPicture):
                read[camera, frame] = picture.reason
            elif not isinstance(picture, Detections):
                read[camera, frame] = picture
    drawings = []
    for event in selection:
        views = [j for j, (c, _) in enumerate(m.spots.views) if c == event.camera]
        frame = int(m.spots.frames[event.index])
        shot = _Shot(m, event, views, m.picture_sizes[event.camera], points.get((frame, event.camera)))
        found_or_reason = read.get((event.camera, frame))
        if found_or_reason is not None:
            drawings.append(_drawing(shot, found_or_reason))
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


def _drawing(shot: _Shot, picture: GreyPicture | str) -> str:
    """picture: grey values (h, w), or the reason why there is none."""
    m, event = shot.m, shot.event
    w, h = shot.size_px
    scale = _SHOWN_WIDTH / w
    tall = h * scale
    when = f", t = {m.t_s[event.index]:.3f} s" if m.time_name != "frame" else ""
    head = f"frame {shot.frame}{when}, camera {event.camera}"
    out = [
        axes.text(0, 12, head, "title") + axes.text(0, 27, event.text),
        f'<svg x="0" y="34" width="{_SHOWN_WIDTH}" height="{tall:.1f}" viewBox="-0.5 -0.5 {w} {h}">',
    ]
    if isinstance(picture, str):
        out.append(f'<rect class="nopicture" x="-0.5" y="-0.5" width="{w}" height="{h}"/>')
        out.append(axes.text(w / 2, 0.09 * h, picture, "halo mid", f"fill:#fff;font-size:{14 / scale:.0f}px"))
    else:
        shown = stretched(picture, *grey_limits(picture))
        if w > 2 * _SHOWN_WIDTH:
            cv2 = load_cv2()
            shown = np.asarray(cv2.resize(shown, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)
        out.append(
            f'<image x="-0.5" y="-0.5" width="{w}" height="{h}" preserveAspectRatio="none"'
            f' href="{image_uri(shown, "jpeg")}"/>'
        )
    out += [*_markers(shot, 1 / scale, enlarged=False), *_names(shot, 1 / scale), "</svg>"]
    focus = _focus(shot)
    if not isinstance(picture, str) and focus is not None:
        out.append(_zoom(shot, picture, focus))
    out.append(_statuses(shot, tall))
    height = max(tall, _ZOOM_SHOWN + 96) + 36
    data = f' data-at="{float(m.t_s[event.index])!r}" data-frame="{shot.frame}"'
    return axes.figure(540, height, f"{head}: {event.text}", out, css="plot shot", data=data)


def _focus(shot: _Shot) -> Array | None:
    """The place (2,), px, to enlarge: the event's spot, otherwise the first spot in the picture; None without one."""
    m, index = shot.m, shot.event.index
    named = [j for j in shot.views if m.spots.views[j][1] == shot.event.spot]
    for j in named or shot.views:
        for uv in (m.spots.uv_px[index, j], m.spots.uv_px[max(index - 1, 0), j]):
            if np.isfinite(uv).all() and (uv > 0).all() and (uv < np.array(shot.size_px) - 1).all():
                return uv
    return None


def _markers(shot: _Shot, unit: float, enlarged: bool) -> list[str]:
    """Boxes at detections, crosses at predictions, rings at spots, arrows towards spots out of view.

    In pixels of the picture; unit: pixels per drawing unit.
    """
    spots, k = shot.m.spots, shot.event.index
    out: list[str] = []
    if shot.detections is not None and len(shot.detections):
        r = (9 if enlarged else 4) * unit
        d = "".join(
            f"M{u - r:.1f} {v - r:.1f}h{2 * r:.1f}v{2 * r:.1f}h{-2 * r:.1f}z" for u, v in shot.detections.tolist()
        )
        out.append(
            f'<path d="{d}" fill="none" stroke="#c8ccd2" stroke-width="{unit:.2f}"><title>detection</title></path>'
        )
    for j in shot.views:
        uv, predicted, spot = spots.uv_px[k, j], spots.predicted_px[k, j], spots.views[j][1]
        if spots.status[k, j] < 0:
            continue
        status = SPOT_STATUSES[int(spots.status[k, j])]
        colour, words = SPOT_COLOURS[status], escape(f"spot {spot}: {status}")
        if np.isfinite(predicted).all():
            r = 5 * unit
            a, b = predicted[0] - r, predicted[1] - r
            d = f"M{a:.2f} {b:.2f}l{2 * r:.2f} {2 * r:.2f}m0 {-2 * r:.2f}l{-2 * r:.2f} {2 * r:.2f}"
            out.append(
                f'<path d="{d}" fill="none" stroke="{axes.YELLOW}" stroke-width="{1.2 * unit:.2f}">'
                f"<title>{escape(f'spot {spot}: predicted')}</title></path>"
            )
        if not np.isfinite(uv).all():
            continue
        if _inside(uv, shot.size_px):
            dash = "" if status.measured else f' stroke-dasharray="{3 * unit:.1f} {2 * unit:.1f}"'
            ring = (14 if enlarged else 8) * unit
            out.append(
                f'<circle cx="{uv[0]:.2f}" cy="{uv[1]:.2f}" r="{ring:.2f}" fill="none" stroke="{colour}"'
                f' stroke-width="{1.8 * unit:.2f}"{dash}><title>{words}</title></circle>'
            )
        else:
            arrow = _arrow(uv, shot.size_px, unit)[2]
            out.append(f'<path d="{arrow}" fill="{colour}"><title>{words}</title></path>')
    return out


def _names(shot: _Shot, unit: float) -> list[str]:
    """The names of the spots, moved up or down so that they cover neither each other nor another spot's ring."""
    spots, k, (w, h), ring = shot.m.spots, shot.event.index, shot.size_px, 8 * unit
    out: list[str] = []
    taken: list[tuple[float, float]] = []
    for j in shot.views:
        uv, name = spots.uv_px[k, j], spots.views[j][1]
        if spots.status[k, j] < 0 or not np.isfinite(uv).all():
            continue
        if _inside(uv, shot.size_px):
            x, y = uv[0] + 11 * unit, uv[1] - 7 * unit
        else:
            x, y, _ = _arrow(uv, shot.size_px, unit)
            gap = float(np.linalg.norm(uv - np.clip(uv, -0.5, np.array(shot.size_px) - 0.5)))
            name = f"{name}: {gap:.0f} px out"
        x = min(max(x, 4 * unit), w - (8 * len(name) + 4) * unit)
        y = min(max(y, 14 * unit), h - 5 * unit)
        wide = 8 * len(name) * unit
        others = [c for i in shot.views if i != j and np.isfinite(c := spots.uv_px[k, i]).all()]
        for _ in range(2 * len(shot.views)):
            over_name = any(abs(x - tx) < wide and abs(y - ty) < 14 * unit for tx, ty in taken)
            over_ring = any(x - ring < u < x + wide + ring and y - 12 * unit - ring < v < y + ring for u, v in others)
            if not (over_name or over_ring):
                break
            y = y + 14 * unit if y < h / 2 else y - 14 * unit
        taken.append((x, y))
        out.append(axes.text(x, y, name, "halo", f"fill:#fff;font-size:{13 * unit:.1f}px"))
    return out


def _inside(uv: Array, size_px: tuple[int, int]) -> bool:
    return bool(-0.5 <= uv[0] < size_px[0] - 0.5 and -0.5 <= uv[1] < size_px[1] - 0.5)


def _arrow(uv: Array, size_px: tuple[int, int], unit: float) -> tuple[float, float, str]:
    """An arrowhead at the edge of the picture towards a place outside: the place of its name (x, y), and its path."""
    border = np.clip(uv, [2 * unit, 2 * unit], np.array(size_px) - 1 - 2 * unit)
    along = (uv - border) / max(float(np.linalg.norm(uv - border)), 1e-9)
    across = np.array([-along[1], along[0]])
    tip, foot = border, border - 16 * unit * along
    corners = (tip, foot + 7 * unit * across, foot - 7 * unit * across)
    d = "M" + "L".join(f"{c[0]:.1f} {c[1]:.1f}" for c in corners) + "z"
    name_at = border - 22 * unit * along
    return float(name_at[0]), float(name_at[1]) + 4 * unit, d


def _zoom(shot: _Shot, picture: GreyPicture, focus: Array) -> str:
    """The part of the picture around one place, enlarged without interpolation."""
    h, w = picture.shape
    side = min(_ZOOM_PX, w, h)
    corner = np.clip(np.round(focus).astype(int) - side // 2, 0, [w - side, h - side])
    part = picture[corner[1] : corner[1] + side, corner[0] : corner[0] + side]
    x0, y0 = corner - 0.5
    marks = "".join(_markers(shot, side / _ZOOM_SHOWN, enlarged=True))
    frame = f'x="{x0}" y="{y0}" width="{side}" height="{side}"'
    low, high = grey_limits(picture)
    data = image_uri(stretched(part, low, max(high, float(part.max()))), "png")
    inner = (
        f'<svg x="408" y="34" width="{_ZOOM_SHOWN}" height="{_ZOOM_SHOWN}" viewBox="{x0} {y0} {side} {side}">'
        f'<image {frame} style="image-rendering:pixelated" href="{data}"/>{marks}</svg>'
    )
    words = (f"enlarged: {side} × {side} px", f"from u = {corner[0]}, v = {corner[1]}")
    return inner + "".join(axes.text(408, 34 + _ZOOM_SHOWN + 15 + 14 * i, line) for i, line in enumerate(words))


def _statuses(shot: _Shot, tall: float) -> str:
    """The statuses of the spots in words, beside the bottom of the picture."""
    lines = []
    for j in shot.views:
        code = int(shot.m.spots.status[shot.event.index, j])
        if code >= 0:
            status = SPOT_STATUSES[code]
            lines.append((f"{shot.m.spots.views[j][1]}: {str(status).replace('_', ' ')}", SPOT_COLOURS[status]))
    shown = lines[: max(int((tall - _ZOOM_SHOWN - 40) / 15), 0)]
    last = 34 + tall - 4
    return "".join(
        f'<circle cx="413" cy="{last - 15 * (len(shown) - 1 - i) - 4:.1f}" r="4" fill="{colour}"/>'
        + axes.text(422, last - 15 * (len(shown) - 1 - i), words)
        for i, (words, colour) in enumerate(shown)
    )
