"""OpenCV for reading pictures and videos: imported when first needed, silent on standard error."""

from __future__ import annotations

import os
from functools import cache
from types import ModuleType


@cache
def load_cv2() -> ModuleType:
    """The module cv2, set so that neither it nor FFmpeg writes to standard error about damage that beampose reports.

    The setting holds for the rest of the process: the log level is shared by all threads, and any of them may decode.
    """
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # read by OpenCV when the first video is opened
    import cv2

    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    return cv2
