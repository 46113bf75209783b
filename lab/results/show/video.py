"""`beampose report --video`: all cameras side by side with detections, labels, tails of the tracks and the pose."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path

import numpy as np

from geometry.arrays import Ints
from lab.errors import InputError
from lab.findings.outcome import Done
from lab.pictures.overlay_video import write_overlay_video
from lab.progress import Progress
from lab.report.frames.canvas import Pixels
from lab.report.frames.content import ResultData, frame_content, pictures_of, pose_words, read_result_data
from lab.report.frames.sheet import Layout, Limits, limits_of, sheet

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
    pictures does not grow with their number.

    Raises:
        InputError: the results cannot be read, or have no such frames.
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
                limits[shown.camera], age = limits_of(shown.picture), 0
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
