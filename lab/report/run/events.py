"""Events of a run: found in the tables, or recorded by the run itself; and those worth a picture.

Pictures of a run at selected events, with measured and predicted places of the spots drawn over them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geometry.arrays import true_ranges
from geometry.forward_model import SpotModel
from lab.errors import BeamposeError
from lab.files.run.run_file import DetectionsTable, LiveDevice, VideoFile
from lab.number_format import format_count
from lab.report.frames.content import CameraFrame, SpotMark, frame_content, result_data
from lab.report.plot import svg
from lab.report.plot.svg import image_uri
from lab.report.run.report_data import ReportData
from lab.runs.frames.frames import Recorded, pictures_at
from tracking.statuses import PoseStatus, SpotStatus

MOST_PICTURES = 8
_KINDS = ("turn", "exit", "return", "no usable picture", "pose lost", "occluded")
_COMMON = ("dropped", "labelled")  # the run's own kinds for an occluded spot and for the first frame
_VIDEO_REACH = 1000  # a video is decoded from its start: no picture after so many frames


@dataclass(frozen=True, slots=True)
class ShownEvent:
    """Something that happened in the pictures of one camera."""

    index: int  # among the frames
    camera: str
    spot: str | None
    kind: str
    text: str


def events(m: ReportData) -> list[ShownEvent]:
    """Turns, exits, returns, occlusions, missing pictures, lost poses and the run's own events, by frame."""
    cameras = m.spots.cameras
    out: list[ShownEvent] = []
    for camera in cameras:
        out += [
            ShownEvent(a, camera, None, "no usable picture", _for_frames("no usable picture", a, b))
            for a, b in m.spots.without_picture(camera)
        ]
    for j in range(len(m.spots.views)):
        out += _spot_events(m, j)
    if len(m.poses.frames) == len(m.spots.frames) and cameras:
        out += [
            ShownEvent(a, cameras[0], None, "pose lost", _for_frames("the pose is lost", a, b))
            for a, b in true_ranges(m.poses.has(PoseStatus.LOST))
        ]
    return sorted(out + _noted(m), key=lambda e: e.index)


def _spot_events(m: ReportData, j: int) -> list[ShownEvent]:
    """The exits, returns, occlusions and turns of view j."""
    camera, spot = m.spots.views[j]
    measured = m.spots.measured[:, j]
    out = []
    for a, b in true_ranges(m.spots.has(SpotStatus.OUT_OF_VIEW)[:, j]):
        if a > 0 and measured[a - 1]:
            out.append(ShownEvent(a, camera, spot, "exit", _for_frames(f"spot {spot} leaves the picture", a, b)))
        if b < len(measured) and measured[b]:
            words = f"spot {spot} returns after {format_count(b - a, 'frame')} out of view"
            out.append(ShownEvent(b, camera, spot, "return", words))
    out += [
        ShownEvent(a, camera, spot, "occluded", _for_frames(f"spot {spot} is expected in view but not found", a, b))
        for a, b in true_ranges(m.spots.has(SpotStatus.OCCLUDED)[:, j])
    ]
    return out + [
        ShownEvent(a, camera, spot, "turn", f"the trajectory of spot {spot} bends")
        for a, _ in true_ranges(m.spots.has(SpotStatus.TURNED)[:, j])
    ]


def _noted(m: ReportData) -> list[ShownEvent]:
    """The events in summary.json; those of the whole rig are listed under the first camera."""
    place = {f: i for i, f in enumerate(m.spots.frames.tolist())}
    out = []
    for noted in m.summary.events:
        if noted.frame in place and m.spots.cameras:
            words = (f"spot {noted.spot}: " if noted.spot else "") + (noted.text or noted.kind)
            if noted.last_frame is not None and noted.last_frame > noted.frame:
                words = _for_frames(words, noted.frame, noted.last_frame + 1)
            camera = noted.camera if noted.camera in m.spots.cameras else None
            out.append(ShownEvent(place[noted.frame], camera or m.spots.cameras[0], noted.spot, noted.kind, words))
    return out


def _for_frames(what: str, start: int, stop: int) -> str:
    return f"{what}, for {format_count(stop - start, 'frame')}"


def selected(m: ReportData, found: list[ShownEvent]) -> list[ShownEvent]:
    """At most MOST_PICTURES events, one of every kind before a second one of any kind."""
    if m.run is not None and any(isinstance(s, VideoFile) for s in m.run.cameras.values()):
        found = [e for e in found if e.index < _VIDEO_REACH]
    cameras = m.spots.cameras
    if not cameras:
        return []
    noted = [e.kind for e in found if e.kind not in (*_KINDS, *_COMMON)]
    kinds = list(dict.fromkeys((*noted, *_KINDS, *_COMMON)))  # rare events of the run first
    by_kind = [[e for e in found if e.kind == kind] for kind in kinds]
    # Of each kind: the first event, the last, the middle one.
    orders = [[group[i] for i in dict.fromkeys([0, len(group) - 1, len(group) // 2])] for group in by_kind if group]
    picked = [ShownEvent(0, camera, None, "start", "the first frame") for camera in cameras[:2]]
    for rank in range(3):
        for order in orders:
            if rank < len(order) and len(picked) < MOST_PICTURES:
                event = order[rank]
                if all((event.index, event.camera) != (p.index, p.camera) for p in picked):
                    picked.append(event)
    return sorted(picked, key=lambda e: e.index)


_SHOWN_WIDTH, _CUT_SHOWN = 400.0, 130.0  # drawing units that a picture and its enlarged part take
_FINE = 1.5  # pixels per drawing unit, for screens of high resolution
_LINE = 13.0  # height of a line of text, drawing units


def pictures(m: ReportData, results: Path, selection: list[ShownEvent]) -> list[str]:
    """An SVG for each event: the picture with its marks, and an enlarged part beside it."""
    if m.run is None or not np.array_equal(m.spots.frames, m.poses.frames):
        return []
    if not set(m.spots.views) <= set(SpotModel.of(m.run.rig).views):
        return []
    data = result_data(m.name, m.spots, m.poses, m.run, results)
    read: dict[tuple[str, int], Recorded] = {}
    for camera, source in m.run.cameras.items():
        frames = [int(m.spots.frames[e.index]) for e in selection if e.camera == camera]
        if not frames or isinstance(source, DetectionsTable | LiveDevice):
            continue
        try:
            read |= {(camera, frame): picture for frame, picture in pictures_at(m.run, camera, frames).items()}
        except BeamposeError:
            continue
    drawings = []
    for event in selection:
        key = event.camera, int(m.spots.frames[event.index])
        if key in read:
            shown = frame_content(data, event.index, {event.camera: read[key]}, [event.camera])
            drawings.append(_drawing(m, event, shown.cameras[0]))
    return drawings


def _drawing(m: ReportData, event: ShownEvent, camera: CameraFrame) -> str:
    from lab.report.frames.sheet import cut, grey_picture, panel  # with OpenCV: only where there are pictures

    w, h = camera.size_px
    tall = h * _SHOWN_WIDTH / w
    when = f", t = {m.t_s[event.index]:.3f} s" if m.time_name != "frame" else ""
    frame = int(m.spots.frames[event.index])
    head = f"frame {frame}{when}, camera {event.camera}"
    text = f"{event.text}; {camera.reason}" if camera.reason else event.text
    grey = grey_picture(camera)
    whole = panel(camera, grey, round(_FINE * _SHOWN_WIDTH), _FINE, _FINE * _LINE)
    out = [
        svg.text(0, 12, head, "title") + svg.text(0, 27, text),
        f'<image x="0" y="34" width="{_SHOWN_WIDTH}" height="{tall:.1f}" href="{image_uri(whole, "jpeg")}"/>',
    ]
    focus = _focus(event, camera)
    if focus is not None and grey is not None:
        part = cut(camera, grey, focus, round(_FINE * _CUT_SHOWN), _FINE, _FINE * 0.9 * _LINE)
        high = part.shape[0] / _FINE
        out.append(f'<image x="408" y="34" width="{_CUT_SHOWN}" height="{high:.1f}" href="{image_uri(part, "png")}"/>')
    height = max(tall, _CUT_SHOWN + 40) + 36
    data = f' data-at="{float(m.t_s[event.index])!r}" data-frame="{frame}"'
    return svg.figure(540, height, f"{head}: {text}", out, css="plot shot", data=data)


def _focus(event: ShownEvent, camera: CameraFrame) -> SpotMark | None:
    """The spot to enlarge: the event's, otherwise the first in the picture; None without one."""
    edge = np.array(camera.size_px) - 1
    inside = [k for k in camera.marks if (k.uv_px > 0).all() and (k.uv_px < edge).all()]
    return next((k for k in inside if k.spot == event.spot), inside[0] if inside else None)
