"""The video of annotated pictures, `overlay.mp4`: written by `report --video` and `track --video`."""

from __future__ import annotations

import secrets
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.errors import RunError
from lab.files.output.part_folder import removed_at_the_end

NAME = "overlay"
# MPEG-4 files are less than half as large as Motion JPEG (38 against 98 kB for a picture of two cameras), which is in
# every OpenCV and serves where one was built without the first.
CODECS = (("mp4v", ".mp4"), ("MJPG", ".avi"))


def write_overlay_video(folder: Path, images: Iterable[NDArray[np.uint8]], fps: float) -> tuple[Path, tuple[str, ...]]:
    """Write pictures (h, w, 3), BGR, of one size with even sides; the file is complete or as it was before.

    fps: frames per second of the video. Returns its path, and notes on codecs that this OpenCV lacks. A video that an
    earlier call wrote with another codec is removed. Raises RunError: OpenCV cannot write a video here, or the disk is
    full.
    """
    pictures = iter(images)
    one = next(pictures)
    notes: list[str] = []
    for codec, suffix in CODECS:
        path, part = folder / f"{NAME}{suffix}", folder / f".{NAME}.{secrets.token_hex(8)}{suffix}"
        with removed_at_the_end(part):
            writer = cv2.VideoWriter(str(part), cv2.VideoWriter.fourcc(*codec), fps, (one.shape[1], one.shape[0]))
            if not writer.isOpened():
                notes.append(f"this OpenCV cannot write {codec} videos ({suffix})")
                continue
            try:
                writer.write(one)
                for image in pictures:
                    writer.write(image)
            finally:
                writer.release()
            if not part.is_file() or not part.stat().st_size:
                raise RunError(f"{path}: the video could not be written; is the disk full?")
            part.replace(path)
        for _, other in CODECS:
            if other != suffix:
                (folder / f"{NAME}{other}").unlink(missing_ok=True)
        return path, tuple(notes)
    raise RunError(
        f"{folder}: no video could be written: {'; '.join(notes)}; install opencv-python-headless from PyPI, or leave"
        " the video out"
    )
