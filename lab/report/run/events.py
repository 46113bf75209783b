"""Events of a run: found in the tables, or recorded by the run itself; and those worth a picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lab.files.run.run_file import VideoFile
from lab.report.plot.axes import true_ranges
from lab.report.run.report_data import ReportData
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
        own = [j for j, (c, _) in enumerate(m.spots.views) if c == camera]
        missing = np.any(m.spots.has(SpotStatus.NO_IMAGE)[:, own], axis=1)
        out += [
            ShownEvent(a, camera, None, "no usable picture", _for_frames("no usable picture", a, b))
            for a, b in true_ranges(missing)
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
            words = f"spot {spot} returns after {_frames(b - a)} out of view"
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


def _frames(n: int) -> str:
    return "1 frame" if n == 1 else f"{n} frames"


def _for_frames(what: str, start: int, stop: int) -> str:
    return f"{what}, for {_frames(stop - start)}"


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
