"""The loop over the pictures of a recording, for any tracker of one target."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from itertools import islice
from pathlib import Path

from geometry.arrays import Array
from lab.detect.inputs import PictureFiles, Video
from lab.pictures.picture_file import GreyPicture
from lab.target.frame_series import F, FrameSeries, every_frame
from lab.target.overlay import OverlayVideo, label_of
from lab.target.results import Progress


def follow(
    series: FrameSeries[F],
    inputs: PictureFiles | Video,
    given: Path,
    step: Callable[[GreyPicture | None], F],
    circle: Callable[[F], Array],
    overlay_folder: Path | None,
    limit: int | None,
    progress: Progress | None,
) -> float:
    """Give every picture to a tracker, and its frames to the series. Returns the process time of the tracker, s.

    step: the tracker; circle: u, v, radius (3,), px, of a frame. overlay_folder: gets overlay.avi; None: no video.
    limit: largest number of frames.

    Raises:
        InputError: no picture could be read, or they are too small.
        RunError: OpenCV cannot write the video.
    """
    tracking_s = 0.0
    video = contextlib.nullcontext() if overlay_folder is None else OverlayVideo(overlay_folder, series.rate_hz)
    with video as overlay:
        total = inputs.count(1)
        for number, picture in islice(every_frame(inputs), limit):
            usable = series.usable(picture)
            begun = time.process_time()
            frame = step(usable)
            tracking_s += time.process_time() - begun
            series.add(number, frame)
            if overlay is not None:
                label = label_of(number, frame.status, frame.cause.value)
                overlay.add(usable, label, frame.status, circle(frame))
            if progress is not None:
                progress(len(series.frames), total)
    series.require_pictures(given, total, limit)
    return tracking_s
