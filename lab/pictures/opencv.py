"""OpenCV for reading pictures and videos: imported when first needed, silent on standard error."""

from __future__ import annotations

import os
from functools import cache
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import cv2


@cache
def load_cv2() -> ModuleType:
    """The module cv2, set so that neither it nor FFmpeg writes to standard error about damage that beampose reports.

    The setting holds for the rest of the process: the log level is shared by all threads, and any of them may decode.
    """
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # read by OpenCV when the first video is opened
    import cv2

    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    return cv2


def opened(source: str | int) -> cv2.VideoCapture:
    """A video or a device. An orientation flag is not applied, as in pictures: pixels stay in the sensor's order."""
    cv2 = load_cv2()
    capture = cv2.VideoCapture(source)
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    return capture
