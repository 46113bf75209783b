"""Pictures of a run at selected events, with measured and predicted places of the spots drawn over them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geometry.forward_model import SpotModel
from lab.errors import BeamposeError
from lab.files.run.run_file import DetectionsTable, LiveDevice
from lab.report.frames.content import CameraFrame, SpotMark, frame_content, result_data
from lab.report.plot import axes
from lab.report.plot.image import image_uri
from lab.report.run.events import ShownEvent
from lab.report.run.report_data import ReportData
from lab.runs.frames.frames import Picture, pictures_at

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
    read: dict[tuple[str, int], Picture] = {}
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
    from lab.report.frames.panel import cut, grey_picture, panel  # with OpenCV: only where there are pictures

    w, h = camera.size_px
    tall = h * _SHOWN_WIDTH / w
    when = f", t = {m.t_s[event.index]:.3f} s" if m.time_name != "frame" else ""
    frame = int(m.spots.frames[event.index])
    head = f"frame {frame}{when}, camera {event.camera}"
    text = f"{event.text}; {camera.reason}" if camera.reason else event.text
    grey = grey_picture(camera)
    whole = panel(camera, grey, round(_FINE * _SHOWN_WIDTH), _FINE, _FINE * _LINE)
    out = [
        axes.text(0, 12, head, "title") + axes.text(0, 27, text),
        f'<image x="0" y="34" width="{_SHOWN_WIDTH}" height="{tall:.1f}" href="{image_uri(whole, "jpeg")}"/>',
    ]
    focus = _focus(event, camera)
    if focus is not None and grey is not None:
        part = cut(camera, grey, focus, round(_FINE * _CUT_SHOWN), _FINE, _FINE * 0.9 * _LINE)
        high = part.shape[0] / _FINE
        out.append(f'<image x="408" y="34" width="{_CUT_SHOWN}" height="{high:.1f}" href="{image_uri(part, "png")}"/>')
    height = max(tall, _CUT_SHOWN + 40) + 36
    data = f' data-at="{float(m.t_s[event.index])!r}" data-frame="{frame}"'
    return axes.figure(540, height, f"{head}: {text}", out, css="plot shot", data=data)


def _focus(event: ShownEvent, camera: CameraFrame) -> SpotMark | None:
    """The spot to enlarge: the event's, otherwise the first in the picture; None without one."""
    edge = np.array(camera.size_px) - 1
    inside = [k for k in camera.marks if (k.uv_px > 0).all() and (k.uv_px < edge).all()]
    return next((k for k in inside if k.spot == event.spot), inside[0] if inside else None)
