"""`beampose show`: one annotated picture of one frame.

`beampose report --video`: all cameras side by side with detections, labels, tails of the tracks and the pose.
"""

from __future__ import annotations

import tempfile
from collections.abc import Generator, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from geometry.arrays import Ints
from lab.errors import InputError
from lab.files.text.atomic_write import atomic_write_bytes
from lab.files.text.error_text import suggest_name
from lab.findings.finding import Done
from lab.progress import Progress
from lab.report.frames.canvas import Pixels, png, write_overlay_video
from lab.report.frames.content import DrawnFrame, ResultData, frame_content, pictures_of, pose_words, read_result_data
from lab.report.frames.sheet import Layout, Limits, sheet
from lab.report.plot.svg import grey_limits
from lab.runs.frames.frames import Recorded, open_frames, pictures_at

if TYPE_CHECKING:
    from lab.runs.frames.pipeline import FrameRecord, Pipeline


PICTURE_SUFFIX = ".png"


@dataclass(frozen=True, slots=True)
class Shown:
    """An annotated picture, and what could not be shown."""

    image: Pixels
    content: DrawnFrame
    notes: tuple[str, ...]


def show_frame(
    path: Path,
    frame: int,
    *,
    camera: str | None = None,
    run_folder: Path | None = None,
    progress: Progress | None = None,
) -> Shown:
    """The annotated picture of a frame of results, or of a run folder.

    path: a results folder, or a run folder: its frames up to this one are then processed, without smoothing. camera:
    one camera; None: all side by side. run_folder: of the results, if it has moved. Raises InputError: the path is
    neither, or has no such frame or camera; BeamposeError: the run cannot be processed.
    """
    path = Path(path)
    if (path / "spots.csv").is_file() and (path / "attitude.csv").is_file():
        return _shown(read_result_data(path, run_folder), frame, camera)
    if not (path / "run.yaml").is_file():
        raise InputError(
            f"{path}: expected a folder of results (with spots.csv and attitude.csv) or a run folder (with run.yaml),"
            " found neither"
        )
    if run_folder is not None:
        raise InputError(f"--run: expected results to combine it with, got the run folder {path}; leave --run out")
    return _of_run(path, frame, camera, progress)


def write_picture(image: Pixels, path: Path) -> None:
    """Write a PNG file. Raises InputError."""
    if path.suffix.lower() != PICTURE_SUFFIX:
        raise InputError(f"--out {path}: expected the name of a {PICTURE_SUFFIX} file")
    atomic_write_bytes(png(image), path)


def chosen_cameras(data: ResultData, camera: str | None) -> list[str]:
    """The cameras to show. Raises InputError for one that the results do not have."""
    if camera is None:
        return list(data.spots.cameras)
    if camera not in data.spots.cameras:
        known = ", ".join(data.spots.cameras)
        raise InputError(f"camera {camera}: expected one of {known}{suggest_name(camera, data.spots.cameras)}")
    return [camera]


def _shown(data: ResultData, frame: int, camera: str | None) -> Shown:
    index = data.index_of(frame)
    cameras = chosen_cameras(data, camera)
    pictures: dict[str, Recorded] = {}
    if data.run is not None:
        pictures = {c: pictures_at(data.run, c, [frame])[frame] for c in cameras if c in data.run.cameras}
    content = frame_content(data, index, pictures, cameras)
    layout = Layout.of([data.sizes_px[c] for c in cameras])
    return Shown(sheet(content, layout), content, data.notes)


def _of_run(folder: Path, frame: int, camera: str | None, progress: Progress | None) -> Shown:
    """The frame of a run folder, processed up to it by the causal pass."""
    from lab.runs.frames.pipeline import Pipeline
    from lab.runs.process import ready_run
    from lab.runs.tables import TableWriter
    from lab.runs.verdict.run_statistics import FrameChecks

    run = ready_run(folder)
    reader = open_frames(run)
    last = np.inf if reader.last is None else reader.last
    if not reader.first <= frame <= last:
        end = "" if reader.last is None else f" to {reader.last}"
        raise InputError(f"frame {frame}: expected a frame of the run, {reader.first}{end}")
    pipeline = Pipeline.of(run)
    reached = False
    with tempfile.TemporaryDirectory(prefix="beampose-show-") as made:
        work = Path(made)
        with TableWriter(work, run.rig, run.covariance is not None) as tables:
            checks = FrameChecks(run.rig, run.covariance)
            for record, _ in checks.passed(_up_to(frame, pipeline, progress)):
                tables.write(record, None)
                reached = record.frame == frame
        if not reached:
            raise InputError(f"frame {frame}: the recording ends before it")
        data = replace(read_result_data(work, folder), name=run.name, run=run)
    notes = (f"processed up to frame {frame} without smoothing; for more pictures show the results of `beampose run`",)
    shown = _shown(data, frame, camera)
    return replace(shown, notes=(*shown.notes, *notes))


def _up_to(frame: int, pipeline: Pipeline, progress: Progress | None) -> Iterator[tuple[FrameRecord, None]]:
    """The records of the causal pass up to a frame."""
    for done, record in enumerate(pipeline.records(), start=1):
        if progress is not None:
            progress(done, done + frame - record.frame, "processing")
        yield record, None
        if record.frame >= frame:
            return


TAIL = 25  # frames
DEFAULT_FPS = 25.0
_SAME_LIMITS = 50  # frames for which the grey values that are shown as black and white stay
_MOST_TEXTS = 500  # poses whose texts are measured for the height of the head


def write_video(
    results: Path,
    run_folder: Path | None = None,
    *,
    first: int | None = None,
    last: int | None = None,
    every: int = 1,
    fps: float = DEFAULT_FPS,
    progress: Progress | None = None,
) -> Done[Path]:
    """Write overlay.mp4 (or .avi) into a results folder; it is complete or as it was before.

    first, last: frame numbers. every: show each so many frames. fps: frames per second of the video. The memory of
    pictures does not grow with their number. Raises InputError: the results cannot be read, or have no such frames;
    RunError: OpenCV cannot write a video here.
    """
    data = read_result_data(results, run_folder)
    indices = _selected(data, first, last, every)
    images = _images(data, indices, progress)
    try:
        path, notes = write_overlay_video(results, images, fps)
    finally:
        images.close()  # with its files and threads
    return Done(path, (f"video: {path} ({len(indices)} frames)",), (*data.notes, *notes))


def _selected(data: ResultData, first: int | None, last: int | None, every: int) -> Ints:
    """Indices of the frames to show. Raises InputError where there are none."""
    frames = data.spots.frames
    low, high = frames[0] if first is None else first, frames[-1] if last is None else last
    indices = np.flatnonzero((frames >= low) & (frames <= high))[::every]
    if not len(indices):
        raise InputError(f"--from {low} --to {high}: expected frames of the results, {frames[0]} to {frames[-1]}")
    return indices


def _images(data: ResultData, indices: Ints, progress: Progress | None) -> Generator[Pixels, None, None]:
    """The pictures of the video, all of one size with even sides."""
    cameras = list(data.spots.cameras)
    layout = Layout.of([data.sizes_px[c] for c in cameras], small=True)
    known = indices[data.poses.known[indices]]
    texts = [pose_words(data.poses, int(i)) for i in known[:: max(len(known) // _MOST_TEXTS, 1)]]
    longest = max(texts, key=len, default="no pose")
    limits: dict[str, Limits] = {}
    ages: dict[str, int] = {}
    size: tuple[int, int] | None = None
    numbers = [int(n) for n in data.spots.frames[indices]]
    shown_pictures = pictures_of(data.run, cameras, numbers)
    for done, (index, pictures) in enumerate(zip(indices.tolist(), shown_pictures, strict=True), start=1):
        content = frame_content(data, index, pictures, cameras, tail=TAIL)
        for shown in content.cameras:
            age = ages.get(shown.camera, _SAME_LIMITS)
            if shown.picture is not None and age >= _SAME_LIMITS:
                limits[shown.camera], age = grey_limits(shown.picture), 0
            ages[shown.camera] = age + 1
        image = sheet(content, layout, cuts=False, limits=limits, same_size=longest)
        if size is None:
            size = (image.shape[0] + image.shape[0] % 2, image.shape[1] + image.shape[1] % 2)
        out: Pixels = np.zeros((*size, 3), np.uint8)
        h, w = min(size[0], image.shape[0]), min(size[1], image.shape[1])
        out[:h, :w] = image[:h, :w]
        yield out
        if progress is not None:
            progress(done, len(indices), "video")
