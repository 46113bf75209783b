"""Annotated pairs of pictures for the report of a stereo run."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np

from geometry.arrays import Array
from lab.errors import InputError
from lab.files.run.detections_file import CameraPoints, is_too_sparse, read_detections
from lab.files.run.run_file import DetectionsTable, FramesFolder
from lab.pictures.colour import ColourPicture, colour_of, read_colour
from lab.pictures.picture_file import DROPPED, UNREADABLE, MissingPicture
from lab.report.plot.axes import GREEN, ORANGE
from lab.report.plot.image import image_uri
from lab.runs.frames.frame_sources import list_folder, open_video
from lab.targets.stereo.run import Source, StereoRecord, StereoResults, StereoRun
from tracking.binocular.marker_model import MarkerImages, project_markers

_MOST = 4  # pairs shown
_SIDE = 520.0  # width of one picture in the drawing
_LEAST_PX = 120  # smallest cut-out, px


def annotated_pictures(results: StereoResults) -> list[tuple[str, str]]:
    """Drawings of some frames with their captions: evenly spaced, and the first ones that are not measured."""
    chosen = _chosen(results)
    pictures = frames_at(results.run, [r.frame for r in chosen])
    out = []
    for record in chosen:
        content = pictures[record.frame].content
        if any(isinstance(c, np.ndarray) for c in content):
            state = record.tracked.status.value + (f": {record.tracked.reason}" if record.tracked.reason else "")
            out.append((_pair_drawing(results, record, content), f"frame {record.frame}, {state}"))
    return out


def _chosen(results: StereoResults) -> list[StereoRecord]:
    measured, other = results.measured, [r for r in results.records if not r.measured]
    few = [measured[int(i)] for i in np.unique(np.linspace(0, len(measured) - 1, 3).astype(int))] if measured else []
    few += other[: _MOST - len(few)]
    return sorted(few, key=lambda r: r.frame)


def _pair_drawing(results: StereoResults, record: StereoRecord, content: tuple[Content, Content]) -> str:
    sides = [_side(results, record, content[c], c) for c in range(2)]
    height = max(h for _, h in sides)
    title = f"frame {record.frame}: left and right picture"
    parts = "".join(
        f'<g transform="translate({c * (_SIDE + 20):.0f} 0)">{text}</g>' for c, (text, _) in enumerate(sides)
    )
    return (
        f'<svg class="plot" viewBox="0 0 {2 * _SIDE + 20:.0f} {height:.0f}" role="img" aria-label="{escape(title)}">'
        f"<title>{escape(title)}</title>{parts}</svg>"
    )


def _side(results: StereoResults, record: StereoRecord, content: Content, c: int) -> tuple[str, float]:
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
    scale = _SIDE / (x1 - x0)
    patch: Any = content[y0:y1, x0:x1]
    grown = max(1, min(6, round(scale)))
    patch = cv2.resize(patch, None, fx=grown, fy=grown, interpolation=cv2.INTER_NEAREST)
    wide = 2 * _SIDE  # for screens of high resolution
    if patch.shape[1] > wide:
        share = wide / patch.shape[1]
        patch = cv2.resize(patch, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
    high = (y1 - y0) * scale
    uri = image_uri(np.asarray(patch, dtype=np.uint8), "jpeg")
    out = [name, f'<image href="{uri}" x="0" y="20" width="{_SIDE:.0f}" height="{high:.1f}"/>']

    def place(uv: Array) -> tuple[float, float]:
        return float((uv[0] - x0 + 0.5) * scale), float((uv[1] - y0 + 0.5) * scale + 20)

    for i, uv in enumerate(at):
        inside = x0 <= uv[0] <= x1 and y0 <= uv[1] <= y1
        if inside and i not in used:
            out.append(_ring(*place(uv), ORANGE))
    for k, label in enumerate(results.run.target.model.names):
        if used[k] >= 0:
            u, v = place(at[used[k]])
            out.append(_ring(u, v, GREEN))
            style = "fill:#7dffce;font-weight:700;font-size:13px"
            out.append(f'<text x="{u + 9:.1f}" y="{v - 7:.1f}" style="{style}">{escape(label)}</text>')
        elif np.isfinite(expected[k]).all() and x0 <= expected[k, 0] <= x1 and y0 <= expected[k, 1] <= y1:
            u, v = place(expected[k])
            out.append(f'<path d="M{u - 5:.1f} {v:.1f}h10M{u:.1f} {v - 5:.1f}v10" stroke="#fff" stroke-width="1.5"/>')
    return "".join(out), high + 22


def _ring(u: float, v: float, colour: str) -> str:
    return f'<circle cx="{u:.1f}" cy="{v:.1f}" r="9" fill="none" stroke="{colour}" stroke-width="2"/>'


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


Content = ColourPicture | MarkerImages | MissingPicture


@dataclass(frozen=True, slots=True)
class StereoFrame:
    """One frame number of both cameras, the left one first."""

    frame: int
    content: tuple[Content, Content]


class _Reader(Protocol):
    """One camera's pictures; every frame number is requested once, in increasing order."""

    @property
    def first(self) -> int:
        """The first frame number."""

    @property
    def last(self) -> int | None:
        """The last frame number; None: known at the end of the video."""

    def at(self, frame: int) -> Content | None:
        """The content of a frame; None: the video has ended."""

    def skip(self, frame: int) -> None:
        """Passes over a frame whose content is not needed."""


class _Folder:
    def __init__(self, folder: Path, size_px: tuple[int, int]) -> None:
        self._listing, self._size = list_folder(folder), size_px
        numbers = self._listing.numbers
        self.first, self.last = int(numbers[0]), int(numbers[-1])
        if is_too_sparse(self.last - self.first + 1, len(numbers)):
            raise InputError(
                f"{folder}: expected frame numbers that follow each other, got {len(numbers)} pictures from"
                f" {self.first} to {self.last}; remove stray pictures"
            )

    def at(self, frame: int) -> Content | None:
        name = self._listing.names.get(frame)
        return MissingPicture(DROPPED) if name is None else read_colour(self._listing.folder / name, self._size)

    def skip(self, frame: int) -> None: ...


class _Video:
    def __init__(self, path: Path, size_px: tuple[int, int]) -> None:
        self._capture, self._size = open_video(path, colour=True), size_px
        self.first, self.last = 0, None

    def at(self, frame: int) -> Content | None:
        if frame < 0:
            return MissingPicture(DROPPED)
        if not self._capture.grab():
            self._capture.release()
            return None
        good, picture = self._capture.retrieve()
        return colour_of(picture, self._size) if good and picture is not None else MissingPicture(UNREADABLE)

    def skip(self, frame: int) -> None:
        if frame >= 0:
            self._capture.grab()


class _Table:
    def __init__(self, path: Path, camera: str) -> None:
        table = read_detections(path)
        if camera not in table.cameras:
            raise InputError(f"{path}: camera: expected rows of {camera!r}, got none")
        self._points: CameraPoints = table.cameras[camera]
        self.first, self.last = table.first, table.last

    def at(self, frame: int) -> Content | None:
        found = self._points.at(frame)
        n = len(found.uv_px)
        return MarkerImages(found.uv_px, found.cov_px2, np.full(n, np.nan), np.zeros(n, dtype=np.int64))

    def skip(self, frame: int) -> None: ...


def _reader(source: Source, camera: str, size_px: tuple[int, int]) -> _Reader:
    if isinstance(source, FramesFolder):
        return _Folder(source.path, size_px)
    if isinstance(source, DetectionsTable):
        return _Table(source.path, camera)
    return _Video(source.path, size_px)


def _readers(run: StereoRun) -> list[_Reader]:
    return [
        _reader(source, name, camera.image_size_px)
        for (name, source), camera in zip(run.cameras.items(), run.pair.cameras, strict=True)
    ]


def stereo_frames(run: StereoRun) -> Iterator[StereoFrame]:
    """All frames, from the first to the last of any camera.

    Raises:
        InputError: a folder is empty, or a video or table cannot be read.
    """
    readers = _readers(run)
    frame = min(r.first for r in readers)
    known = [r.last for r in readers if r.last is not None]
    last = max(known) if known else -1
    ended: set[int] = set()  # videos, by their index
    while True:
        got = [MissingPicture(DROPPED) if i in ended else r.at(frame) for i, r in enumerate(readers)]
        ended |= {i for i, content in enumerate(got) if content is None}
        running = any(r.last is None and i not in ended for i, r in enumerate(readers))
        if frame > last and not running:
            return
        left, right = (MissingPicture(DROPPED) if content is None else content for content in got)
        yield StereoFrame(frame, (left, right))
        frame += 1


def frames_at(run: StereoRun, wanted: Collection[int]) -> dict[int, StereoFrame]:
    """Some frames by number. A video is read from its start. Raises InputError as `stereo_frames`."""
    if not wanted:
        return {}
    readers = _readers(run)
    out = {}
    for frame in range(min(r.first for r in readers), max(wanted) + 1):
        if frame in wanted:
            left, right = (MissingPicture(DROPPED) if c is None else c for c in (r.at(frame) for r in readers))
            out[frame] = StereoFrame(frame, (left, right))
        else:
            for r in readers:
                r.skip(frame)
    return out
