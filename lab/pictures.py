"""One picture file: decoded to grey, or the reason why it cannot be."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias, cast

import cv2
import numpy as np
from numpy.typing import NDArray

SUFFIXES = (".png", ".tif", ".tiff", ".bmp", ".pgm", ".jpg", ".jpeg")
UNREADABLE = "unreadable"
DROPPED = "dropped"

Grey: TypeAlias = NDArray[np.uint8] | NDArray[np.uint16]  # (h, w), DN

# Colour becomes grey by OpenCV's weights. A camera's pixels are where the sensor has them: a turn that the file
# wishes for display (EXIF) is not applied.
_AS_STORED = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION


@dataclass(frozen=True, slots=True)
class Missing:
    """There is no usable picture: why."""

    reason: str  # "dropped", "unreadable: ...", "wrong size ..."


def read_picture(path: Path, size_px: tuple[int, int] | None) -> Grey | Missing:
    """The picture in a file as grey (h, w), 8 or 16 bit; Missing where it is damaged or not of this (width, height).

    size_px None: of any size.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        return Missing(f"{UNREADABLE}: {error.strerror}")
    return decode(data, size_px)


def decode(data: bytes, size_px: tuple[int, int] | None) -> Grey | Missing:
    """As `read_picture`, from the bytes of a file."""
    if not data:
        return Missing(f"{UNREADABLE}: the file is empty")
    damage = _damage(data)
    if damage:
        return Missing(f"{UNREADABLE}: {damage}")
    try:
        picture = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), _AS_STORED)
    except (cv2.error, MemoryError):  # a header that asks for an absurd size
        picture = None
    if picture is None:
        return Missing(f"{UNREADABLE}: damaged, or no picture")
    return checked(picture, size_px)


def checked(picture: NDArray[np.generic], size_px: tuple[int, int] | None) -> Grey | Missing:
    """The picture itself, if it has this width and height and 8 or 16 bits."""
    height, width = picture.shape[:2]
    if size_px is not None and (width, height) != size_px:
        return Missing(f"wrong size {width}x{height}, the rig says {size_px[0]}x{size_px[1]}")
    if picture.dtype not in (np.uint8, np.uint16):
        return Missing(f"{UNREADABLE}: {picture.dtype} numbers, expected 8 or 16 bits without sign")
    return cast(Grey, picture)


def _damage(data: bytes) -> str:
    """What is missing of a PNG or JPEG, or "".

    Of a JPEG file that was cut short cv2.imread gives the upper part as if it were the picture (5.0.0; imdecode gives
    nothing), and some versions do so for PNG; the others (TIFF, BMP, PGM) come back empty when cut. The PNG's checksums
    are verified here as libpng writes its complaint straight to standard error; that costs 0.1 ms of the 7 ms that
    1280x1024 take.
    """
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        return _png_damage(data)
    if data.startswith(b"\xff\xd8"):
        return _jpeg_damage(data)
    return ""


def _png_damage(data: bytes) -> str:
    """Walks the chunks: length (4), type (4), content, CRC of type and content (4). Source: PNG, ISO 15948, 5.3."""
    view, at = memoryview(data), 8
    while at + 12 <= len(data):
        end = at + 8 + int.from_bytes(view[at : at + 4], "big")
        if end + 4 > len(data):
            break
        if zlib.crc32(view[at + 4 : end]) != int.from_bytes(view[end : end + 4], "big"):
            return "damaged (a checksum is wrong)"
        if data[at + 4 : at + 8] == b"IEND":
            return ""
        at = end + 4
    return "cut short"


def _jpeg_damage(data: bytes) -> str:
    """Walks the segments to the first scan; after it an end marker must come. Source: ITU T.81, B.1.

    Within a scan the byte FF is always followed by 00 or a restart marker, so FF D9 there is the end and nothing else.
    """
    at = 2
    while at + 4 <= len(data):
        if data[at] != 0xFF:
            return "damaged (no marker where one must be)"
        marker = data[at + 1]
        if marker == 0xFF:  # a fill byte
            at += 1
            continue
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        if marker == 0xDA:
            return "" if data.find(b"\xff\xd9", at) >= 0 else "cut short"
    return "cut short"
