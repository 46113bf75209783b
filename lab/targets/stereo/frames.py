"""Pictures of a stereo run: read in pairs, and annotated pairs for its report."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from html import escape
from itertools import takewhile

import cv2
import numpy as np

from geometry.arrays import Array, evenly_spread
from lab.errors import InputError
from lab.files.run.detections_file import read_detections
from lab.files.run.run_file import DetectionsTable, RecordedSource
from lab.pictures.picture_file import DROPPED, ColourPicture, MissingPicture
from lab.pictures.source import pictures
from lab.report.frames.canvas import INK, Canvas, bgr, light
from lab.report.plot.svg import GREEN, ORANGE, Box, figure, image_uri
from lab.runs.frames.frames import recorded_pictures
from lab.targets.stereo.run import StereoRecord, StereoResults, StereoRun
from tracking.binocular.marker_model import MarkerImages, project_markers

# Annotated pairs of pictures for the report of a stereo run.

_MOST = 4  # pairs shown
_SIDE = 520.0  # width of one picture in the drawing
_FINE = 2.0  # pixels per unit of the drawing, for screens of high resolution
_LEAST_PX = 120  # smallest cut-out, px


def annotated_pictures(results: StereoResults) -> list[tuple[str, str]]:
    """Drawings of some frames with their captions: evenly spaced, and the first ones that are not measured."""
    records = {r.frame: r for r in _chosen(results)}
    out = []
    last = max(records, default=-1)
    for frame in takewhile(lambda f: f.frame <= last, stereo_frames(results.run, records)):
        record, content = records.get(frame.frame), frame.content
        if record is None:
            continue
        if any(isinstance(c, np.ndarray) for c in content):
            state = record.tracked.status.value + (f": {record.tracked.reason}" if record.tracked.reason else "")
            out.append((_pair_drawing(results, record, content), f"frame {record.frame}, {state}"))
    return out


def _chosen(results: StereoResults) -> list[StereoRecord]:
    measured, other = results.measured, [r for r in results.records if not r.measured]
    few = [measured[i] for i in evenly_spread(np.arange(len(measured)), 3).tolist()]
    few += other[: _MOST - len(few)]
    return sorted(few, key=lambda r: r.frame)


def _pair_drawing(
    results: StereoResults, record: StereoRecord, content: tuple[RecordedMarkers, RecordedMarkers]
) -> str:
    sides = [_side(results, record, content[c], c) for c in range(2)]
    height = max(h for _, h in sides)
    title = f"frame {record.frame}: left and right picture"
    parts = [f'<g transform="translate({c * (_SIDE + 20):.0f} 0)">{text}</g>' for c, (text, _) in enumerate(sides)]
    return figure(2 * _SIDE + 20, height, title, parts)


def _side(results: StereoResults, record: StereoRecord, content: RecordedMarkers, c: int) -> tuple[str, float]:
    """One camera's cut-out as SVG, _SIDE wide, and its height."""
    camera = results.run.pair.cameras[c]
    name = f'<text x="2" y="14" class="title">{escape(camera.name)}</text>'
    if not isinstance(content, np.ndarray):
        return f'{name}<text x="2" y="40">no picture</text>', 60.0
    found, t = record.candidates[c], record.tracked
    at = np.zeros((0, 2)) if found is None else found.uv_px
    used = t.index[c]
    expected = np.full((len(used), 2), np.nan)
    if t.pose is not None:
        expected = project_markers(results.run.pair, results.run.target.model, t.pose)[0][c]
    x0, y0, x1, y1 = _cut(expected if np.isfinite(expected).any() else at, camera.image_size_px)
    size = round(_FINE * _SIDE), max(round(_FINE * _SIDE * (y1 - y0) / (x1 - x0)), 1)
    scale = size[0] / (x1 - x0)
    how = cv2.INTER_NEAREST if scale > 1 else cv2.INTER_AREA
    patch = np.asarray(cv2.resize(np.ascontiguousarray(content[y0:y1, x0:x1]), size, interpolation=how), np.uint8)
    canvas = Canvas(patch, np.array([x0 - 0.5, y0 - 0.5]), scale, _FINE)
    for i, uv in enumerate(at):
        if canvas.holds(uv) and i not in used:
            canvas.ring(uv, 9, bgr(ORANGE), 2)
    taken: list[Box] = []
    for k, label in enumerate(results.run.target.model.names):
        if used[k] >= 0:
            u, v = canvas.at(at[used[k]]).tolist()
            canvas.ring(at[used[k]], 9, bgr(GREEN), 2)
            canvas.label((u, v), 9 * _FINE, label, 13 * _FINE, light(bgr(GREEN)), taken)
        elif canvas.holds(expected[k]):
            canvas.cross(expected[k], 5, INK, 1.5)
    high = size[1] / _FINE
    uri = image_uri(canvas.image, "jpeg")
    return f'{name}<image href="{uri}" x="0" y="20" width="{_SIDE:.0f}" height="{high:.1f}"/>', high + 22


def _cut(uv: Array, size_px: tuple[int, int]) -> tuple[int, int, int, int]:
    """The cut-out (x0, y0, x1, y1) around points (n, 2): 4 to 3, with a margin; the whole picture without points."""
    good = uv[np.isfinite(uv).all(axis=1)] if len(uv) else uv
    size = np.array(size_px)
    if len(good):
        good = good[np.all((good > -0.5) & (good < size - 0.5), axis=1)]
    if not len(good):
        return 0, 0, size_px[0], size_px[1]
    middle, extent = (good.min(axis=0) + good.max(axis=0)) / 2, np.ptp(good, axis=0)
    half = max(float(extent[0]), 4 / 3 * float(extent[1]), _LEAST_PX) * 0.75
    low = np.clip(np.floor(middle - np.array([half, 0.75 * half])), 0, size - 2).astype(int)
    high = np.clip(np.ceil(middle + np.array([half, 0.75 * half])), low + 2, size).astype(int)
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


# The frames of a stereo run: colour pictures or detected points of both cameras, by frame number.


RecordedMarkers = ColourPicture | MarkerImages | MissingPicture


@dataclass(frozen=True, slots=True)
class StereoFrame:
    """One frame number of both cameras, the left one first."""

    frame: int
    content: tuple[RecordedMarkers, RecordedMarkers]


def _contents(
    source: RecordedSource, name: str, size_px: tuple[int, int], wanted: Collection[int] | None
) -> Iterator[tuple[int, RecordedMarkers]]:
    """One camera's frames by increasing number. wanted: as for `stereo_frames`. Raises InputError."""
    if isinstance(source, DetectionsTable):
        table = read_detections(source.path)
        if name not in table.cameras:
            raise InputError(f"{source.path}: camera: expected rows of {name!r}, got none")
        for frame in range(table.first, table.last + 1):
            found = table.cameras[name].at(frame)
            n = len(found.uv_px)
            yield frame, MarkerImages(found.uv_px, found.cov_px2, np.full(n, np.nan), np.zeros(n, dtype=np.int64))
        return
    chosen = None if wanted is None else sorted(wanted)
    yield from pictures(recorded_pictures(name, source), size_px, colour=True, wanted=chosen)


def stereo_frames(run: StereoRun, wanted: Collection[int] | None = None) -> Iterator[StereoFrame]:
    """All frames, from the first to the last of any camera.

    wanted: the others need not be read, and may be missing. Raises InputError: a folder is empty, or a video or table
    cannot be read.
    """
    sides = [
        _contents(source, name, camera.image_size_px, wanted)
        for (name, source), camera in zip(run.cameras.items(), run.pair.cameras, strict=True)
    ]
    following = [next(side, None) for side in sides]
    frame: int | None = None
    while known := [f[0] for f in following if f is not None]:
        frame = min(known) if frame is None else frame + 1
        content: list[RecordedMarkers] = []
        for c, side in enumerate(sides):
            at = following[c]
            if at is None or at[0] != frame:
                content.append(MissingPicture(DROPPED))
            else:
                content.append(at[1])
                following[c] = next(side, None)
        yield StereoFrame(frame, (content[0], content[1]))
