"""The overlay video: the pictures with the target's outline, its centre, its path and the status."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array
from lab.pictures.overlay_video import write_overlay_video
from lab.pictures.picture_file import MissingPicture
from lab.pictures.source import open_inputs
from lab.report.frames.canvas import Canvas, Pixels
from lab.report.plot.image import grey_limits, stretched
from lab.targets.recording import DEFAULT_RATE_HZ, every_frame
from lab.targets.target import F, Target, Track
from tracking.statuses import PoseStatus

_LARGEST_SIDE = 1920  # px of the video
_RATE_RANGE_HZ = (1.0, 240.0)  # of the video: players do not show others well
_PATH_FRAMES = 100  # frames of the path that are drawn
_COLOURS = {PoseStatus.MEASURED: (60, 220, 60), PoseStatus.PREDICTED: (30, 160, 255), PoseStatus.LOST: (60, 60, 230)}


def write_overlay(target: Target[F], track: Track[F], folder: Path) -> None:
    """Write the video, a picture per frame number; black where there is none.

    Raises:
        RunError: OpenCV cannot write it.
    """
    rate = float(np.clip(track.recording.rate_hz or DEFAULT_RATE_HZ, *_RATE_RANGE_HZ))
    write_overlay_video(folder, _images(target, track), rate)


def _images(target: Target[F], track: Track[F]) -> Iterator[NDArray[np.uint8]]:
    recording = track.recording
    assert recording.size_px is not None  # of pictures
    scale = min(1.0, _LARGEST_SIDE / max(recording.size_px))
    width, height = (2 * max(round(side * scale / 2), 1) for side in recording.size_px)
    limits: tuple[float, float] | None = None
    for k, (_, picture) in enumerate(every_frame(open_inputs([recording.path]), target.options.limit)):
        grey: NDArray[np.uint8] = np.zeros((height, width), np.uint8)
        if not isinstance(picture, MissingPicture):
            limits = limits or grey_limits(picture)
            shown = cv2.resize(stretched(picture, *limits), (width, height), interpolation=cv2.INTER_AREA)
            grey = np.asarray(shown, np.uint8)
        yield drawn(grey, target, track, k, np.array([width, height]) / recording.size_px)


def drawn(grey: NDArray[np.uint8], target: Target[F], track: Track[F], k: int, scale: Array) -> NDArray[np.uint8]:
    """A picture (h, w) of frame k (from 0) as (h, w, 3), BGR, with the track up to it.

    scale: (2,) of the picture, against that of the recording. The outline is a circle of the target's size; of a target
    without a size, of 3 sigma.
    """
    line = max(1, round(min(grey.shape) / 500))
    image: Pixels = np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), np.uint8)
    canvas = Canvas(image, np.array([-0.5, -0.5]), scale, line)
    path = track.frames[max(0, k - _PATH_FRAMES) : k + 1]
    for before, after in itertools.pairwise(path):
        canvas.line(np.array([before.place[:2], after.place[:2]]), _COLOURS[after.status], 1 / line)
    now = track.frames[k]
    colour = _COLOURS[now.status]
    if np.isfinite(now.place[:2]).all():
        size = now.place[2] / target.size_radii
        size = size if np.isfinite(size) else max(3 * float(now.sigmas[:2].max()), 4 / scale[0])
        canvas.ring(now.place[:2], float(np.clip(size, 0, 1e5)) * float(scale.mean()) / line, colour)
        canvas.cross(now.place[:2], 4.5, colour)
    label = f"{track.recording.numbers[k]}  {now.status.value}" + (f" ({now.cause})" if now.cause.value else "")
    canvas.words((6, 8 + 14 * line), label, 11.7 * line, colour)
    return canvas.image
