"""overlay.avi: the pictures with the circle, its centre and the status drawn into them."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array
from lab.errors import RunError
from lab.pictures.picture_file import GreyPicture
from tracking.statuses import PoseStatus

FILE_NAME = "overlay.avi"
_SHIFT = 4  # bits of sub-pixel positions in OpenCV's drawing functions
_COLOURS = {PoseStatus.MEASURED: (60, 220, 60), PoseStatus.PREDICTED: (30, 160, 255), PoseStatus.LOST: (60, 60, 230)}
_LEAST_RATE_HZ, _MOST_RATE_HZ = 1.0, 60.0  # of the video: players do not show others well


def drawn(
    picture: GreyPicture | None, size_px: tuple[int, int], label: str, status: PoseStatus, circle: Array
) -> NDArray[np.uint8]:
    """One picture (h, w, 3), BGR, of size_px (width, height); black where there is none.

    circle: u, v, radius, px; nan where nothing is known. label: words in the corner.
    """
    width, height = size_px
    grey = np.zeros((height, width), np.uint8)
    if picture is not None:
        eight = picture if picture.dtype == np.uint8 else (picture >> 8).astype(np.uint8)
        h, w = min(height, eight.shape[0]), min(width, eight.shape[1])
        grey[:h, :w] = eight[:h, :w]
    image = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    colour = _COLOURS[status]
    line = max(1, round(min(size_px) / 500))
    if np.isfinite(circle).all() and np.abs(circle).max() < 1e5:
        u, v, radius = circle
        at = (round(float(u) * 2**_SHIFT), round(float(v) * 2**_SHIFT))
        size = max(round(float(radius) * 2**_SHIFT), 1)
        cv2.circle(image, at, size, colour, line, cv2.LINE_AA, _SHIFT)
        cv2.drawMarker(image, (round(float(u)), round(float(v))), colour, cv2.MARKER_CROSS, 9 * line, line)
    scale = 0.45 * line
    cv2.putText(image, label, (6, 8 + round(14 * scale / 0.45)), cv2.FONT_HERSHEY_SIMPLEX, scale, colour, line)
    return np.asarray(image, np.uint8)


def label_of(number: int, status: PoseStatus, cause: str) -> str:
    """Frame number, status and cause as words."""
    return f"{number}  {status.value}" + (f" ({cause})" if cause else "")


class OverlayVideo:
    """Writes the video (Motion JPEG), a picture per frame."""

    def __init__(self, folder: Path, rate_hz: float) -> None:
        self._path = folder / FILE_NAME
        self._rate_hz = float(np.clip(rate_hz, _LEAST_RATE_HZ, _MOST_RATE_HZ))
        self._writer: cv2.VideoWriter | None = None
        self._size_px = (0, 0)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._writer is not None:
            self._writer.release()

    def add(self, picture: GreyPicture | None, label: str, status: PoseStatus, circle: Array) -> None:
        """Add a frame; the first picture decides the size. Raises RunError where OpenCV cannot write the video."""
        if self._writer is None:
            if picture is None:
                return
            self._size_px = (picture.shape[1], picture.shape[0])
            code = cv2.VideoWriter.fourcc(*"MJPG")
            self._writer = cv2.VideoWriter(str(self._path), code, self._rate_hz, self._size_px)
            if not self._writer.isOpened():
                raise RunError(f"{FILE_NAME}: OpenCV cannot write a Motion JPEG video here; leave out --video")
        self._writer.write(drawn(picture, self._size_px, label, status, circle))
