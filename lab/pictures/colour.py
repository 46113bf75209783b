"""Colour pictures (h, w, 3), BGR, of files and videos; the grey pictures of other measurements: picture_file.py."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from lab.pictures.opencv import load_cv2
from lab.pictures.picture_file import UNREADABLE, MissingPicture, decode, require_format

ColourPicture = NDArray[np.uint8]  # (h, w, 3), BGR


def read_colour(path: Path, size_px: tuple[int, int] | None) -> ColourPicture | MissingPicture:
    """The picture in a file as (h, w, 3), BGR, 8 bits; Missing where it is damaged or has another (width, height).

    A grey picture has three equal channels; pixels stay where the sensor has them (no EXIF orientation).
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        return MissingPicture(f"{UNREADABLE}: {error.strerror}")
    grey = decode(data, size_px)  # its checks find damage that OpenCV passes over
    if isinstance(grey, MissingPicture):
        return grey
    cv2 = load_cv2()
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if picture is None:
        return MissingPicture(f"{UNREADABLE}: damaged, or no picture")
    return cast(ColourPicture, picture)


def colour_of(picture: Any, size_px: tuple[int, int] | None) -> ColourPicture | MissingPicture:
    """A decoded video picture, grey or BGR, as (h, w, 3), 8 bits; Missing where it has another (width, height)."""
    cv2 = load_cv2()
    checked = require_format(picture, size_px)
    if isinstance(checked, MissingPicture):
        return checked
    if checked.dtype == np.uint16:
        checked = (checked >> 8).astype(np.uint8)
    if checked.ndim == 2 or checked.shape[2] == 1:
        return cast(ColourPicture, cv2.cvtColor(checked.reshape(checked.shape[:2]), cv2.COLOR_GRAY2BGR))
    return cast(ColourPicture, checked[..., :3])
