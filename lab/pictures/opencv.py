"""OpenCV for reading pictures and videos: loaded when first needed, without remarks on standard error."""

from __future__ import annotations

import os
from functools import cache
from types import ModuleType


@cache
def quiet_cv2() -> ModuleType:
    """The module cv2; from now on neither it nor FFmpeg writes to standard error about damage that we report ourselves.

    For the rest of the process: the level is one for all threads, and a picture may be decoded in any of them.
    """
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # read by OpenCV when the first video is opened
    import cv2

    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    return cv2
