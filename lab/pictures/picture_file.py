"""Decodes one picture file to grey or colour, or gives the reason why it cannot be used.

The header is read first: a picture of another size than the rig's, or of an absurd size, is not decoded. Checksums are
verified where a format has them. Libraries do not write about damage to standard error.
"""

from __future__ import annotations

import os
import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias, cast

import numpy as np
from numpy.typing import NDArray

from lab.pictures.opencv import load_cv2
from lab.pictures.picture_headers import JPEG_SCAN, DamagedError, Header, jpeg_segments, read_header

PICTURE_SUFFIXES = (".png", ".tif", ".tiff", ".bmp", ".pgm", ".jpg", ".jpeg")
UNREADABLE = "unreadable"
DROPPED = "dropped"
REPEATED = "repeated: the picture is that of the frame before"
TORN = "torn: rows of the picture are those of the frame before"
_MAX_PADDING_BYTES = 16  # bytes that some cameras add before the end of a JPEG; damage leaves about fifty or more
_LARGE_BYTES = 1 << 26  # bytes: a larger file is mapped, not read, since its header may show that it is unusable

GreyPicture: TypeAlias = NDArray[np.uint8] | NDArray[np.uint16]  # (h, w), DN
ColourPicture: TypeAlias = NDArray[np.uint8]  # (h, w, 3), BGR


@dataclass(frozen=True, slots=True)
class MissingPicture:
    """The reason why there is no usable picture."""

    reason: str  # "dropped", "repeated: ...", "torn: ...", "unreadable: ...", "wrong size ..."


def read_picture(path: Path, size_px: tuple[int, int] | None, colour: bool = False, used_bits: int | None = 16) -> Any:
    """The picture in a file as grey (h, w), 8 or 16 bit; Missing where it is damaged or has another (width, height).

    size_px None: any size. colour: (h, w, 3), BGR, 8 bits, instead; a grey picture has three equal channels. used_bits:
    as for `as_colour`; None: colours of 16 bits as stored. The caller owns the array. Thread-safe.
    """
    try:
        data = _content(path)
    except OSError as error:
        return MissingPicture(f"{UNREADABLE}: {error.strerror}")
    found = decode(data, size_px, colour)  # its checks find damage that OpenCV passes over
    if not colour or isinstance(found, MissingPicture) or found.ndim == 3:
        return found
    cv2 = load_cv2()
    picture = cv2.imdecode(data, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)
    if picture is None:
        return MissingPicture(f"{UNREADABLE}: damaged, or no picture")
    return picture if used_bits is None else as_colour(picture, used_bits)


def as_colour(picture: NDArray[Any], used_bits: int = 16) -> ColourPicture:
    """A picture of 8 or 16 bits, grey or BGR, as (h, w, 3), BGR, 8 bits.

    used_bits: of pictures of 16 bits, 8 to 16; the upper 8 of them are taken, and values with more bits are clipped.
    """
    cv2 = load_cv2()
    if picture.dtype == np.uint16:
        picture = np.minimum(picture >> (used_bits - 8), 255).astype(np.uint8)
    if picture.ndim == 2 or picture.shape[2] == 1:
        return cast(ColourPicture, cv2.cvtColor(picture.reshape(picture.shape[:2]), cv2.COLOR_GRAY2BGR))
    return cast(ColourPicture, picture[..., :3])


def require_format(picture: NDArray[np.generic], size_px: tuple[int, int] | None) -> GreyPicture | MissingPicture:
    """The picture itself if it has this width and height and 8 or 16 bits; else Missing."""
    height, width = picture.shape[:2]
    if size_px is not None and (width, height) != size_px:
        return MissingPicture(_wrong_size(width, height, size_px))
    if picture.dtype not in (np.uint8, np.uint16):
        return MissingPicture(f"{UNREADABLE}: {picture.dtype} numbers, expected 8 or 16 bits without sign")
    return cast(GreyPicture, picture)


def _without_waiting(path: str, flags: int) -> int:
    """Opens a file; a named pipe, too, at once (it would wait for a writer, perhaps for ever)."""
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def _content(path: Path) -> NDArray[np.uint8]:
    """The bytes of a file; writing to them does not change the file. Raises OSError."""
    with open(path, "rb", buffering=0, opener=_without_waiting) as file:
        size = file.seek(0, 2)  # OSError for a pipe
        if size > _LARGE_BYTES:
            return np.memmap(file, np.uint8, "c", shape=(size,))
        file.seek(0)
        data = np.empty(size, np.uint8)
        got = 0
        while got < size and (more := file.readinto(data[got:].data)):
            got += more
        return data[:got]


def _wrong_size(width: int, height: int, size_px: tuple[int, int]) -> str:
    return f"wrong size {width}x{height}, the rig says {size_px[0]}x{size_px[1]}"


def decode(
    data: NDArray[np.uint8], size_px: tuple[int, int] | None, colour: bool = False
) -> GreyPicture | MissingPicture:
    """As `read_picture`, from the bytes (n,) of a file; with `colour`, those decoded in one step are (h, w, 3), BGR."""
    if not data.size:
        return MissingPicture(f"{UNREADABLE}: the file is empty")
    try:
        header = read_header(data)
        header.require_sound()
        if size_px is not None and (header.width, header.height) != size_px:
            return MissingPicture(_wrong_size(header.width, header.height, size_px))
        decoder = _png_in_colour if colour and header.kind == "png" else _DECODERS[header.kind]
        picture = decoder(data, header)
    except DamagedError as error:
        return MissingPicture(f"{UNREADABLE}: {error}")
    except MemoryError:
        return MissingPicture(f"{UNREADABLE}: not enough memory for it")
    return require_format(picture, size_px)


def _png(data: NDArray[np.uint8], header: Header) -> NDArray[np.generic]:
    from lab.pictures.png import Png  # compiled code: only where there are such pictures

    png = Png.read(data)
    return png.stored() if png.is_simple else _by_opencv(np.frombuffer(png.plain_file(), np.uint8))


def _png_in_colour(data: NDArray[np.uint8], header: Header) -> NDArray[np.generic]:
    """Grey and palette pictures as `_png`; RGB of 8 bits as BGR: half the cost of two decodings by OpenCV."""
    from lab.pictures.png import Png

    png = Png.read(data)
    if not png.is_rgb:
        return _png(data, header)
    cv2 = load_cv2()
    return cast("NDArray[np.generic]", cv2.cvtColor(png.stored(), cv2.COLOR_RGB2BGR))


def _jpeg(data: NDArray[np.uint8], header: Header) -> NDArray[np.generic]:
    """By libjpeg-turbo, which reports damage; OpenCV writes it to standard error and continues."""
    import simplejpeg

    _require_jpeg_end(data)
    grey = header.jpeg_components in (1, 3)
    try:
        picture = simplejpeg.decode_jpeg(data, "GRAY" if grey else "CMYK", strict=True)
    except ValueError as error:
        left_over = re.search(r"(\d+) extraneous bytes", str(error))
        if left_over is None or int(left_over[1]) > _MAX_PADDING_BYTES:
            raise DamagedError(f"damaged ({_first_line(error)})") from None
        picture = simplejpeg.decode_jpeg(data, "GRAY" if grey else "CMYK", strict=False)
    return picture[..., 0] if grey else _by_opencv(data)


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0][:80] if str(error) else type(error).__name__


def _require_jpeg_end(data: NDArray[np.uint8]) -> None:
    """Raises DamagedError unless an end marker comes after the first scan. Source: ITU T.81, B.1.

    Decoders accept a truncated file and return its upper part. Within a scan the byte FF is always followed by 00 or a
    restart marker, so FF D9 is the end marker.
    """
    view = data.data
    try:
        *_, (marker, _, end) = jpeg_segments(view)
    except (struct.error, IndexError):
        raise DamagedError("cut short") from None
    if marker != JPEG_SCAN or bytes(view[end:]).find(b"\xff\xd9") < 0:
        raise DamagedError("cut short")


def _tiff(data: NDArray[np.uint8], header: Header) -> NDArray[np.generic]:
    tiff = header.tiff
    assert tiff is not None
    if not tiff.is_simple:
        return _by_opencv(tiff.as_stored(data))
    picture = tiff.content(data)
    if picture is None:
        raise DamagedError("damaged, or cut short")
    return picture


def _pnm(data: NDArray[np.uint8], header: Header) -> NDArray[np.generic]:
    """Grey pictures with their values as stored, whatever the stated maximum. Source: netpbm's pgm(5)."""
    kind, largest, start = header.pnm
    dtype, shape = np.dtype(np.uint8 if largest < 256 else ">u2"), (header.height, header.width)
    count = header.height * header.width
    if kind == 5:
        stored = data[start : start + count * dtype.itemsize]
        if len(stored) < count * dtype.itemsize:
            raise DamagedError("cut short")
        if dtype.itemsize == 1:
            return stored.reshape(shape)
        pixels = np.frombuffer(stored.tobytes(), dtype)  # a copy is aligned: the header can have any length
        return pixels.astype(np.uint16).reshape(shape)
    if kind == 2:
        return _plain_numbers(bytes(data[start - 1 :]), largest, count).reshape(shape)
    return _by_opencv(data)


def _plain_numbers(text: bytes, largest: int, count: int) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """The first `count` numbers of a plain PGM. Raises DamagedError."""
    words = text.split(None, count)[:count]
    if len(words) < count:
        raise DamagedError("cut short")
    try:
        values = np.fromiter(map(int, words), np.int64, count)
    except (ValueError, OverflowError):
        raise DamagedError("damaged (expected whole numbers)") from None
    if values.min() < 0 or values.max() > largest:
        raise DamagedError(f"damaged (a value is not within 0 and {largest})")
    return values.astype(np.uint8) if largest < 256 else values.astype(np.uint16)


def _bmp(data: NDArray[np.uint8], header: Header) -> NDArray[np.generic]:
    return _by_opencv(data)


def _by_opencv(data: NDArray[np.uint8]) -> NDArray[np.generic]:
    """Decoded by OpenCV; colour is converted to grey with its weights. An EXIF orientation is not applied: pixels stay
    where the sensor has them. Raises DamagedError.
    """
    cv2 = load_cv2()
    as_stored = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        picture = cv2.imdecode(data, as_stored)
    except cv2.error:
        picture = None
    if picture is None:
        raise DamagedError("damaged, or no picture")
    return cast("NDArray[np.generic]", picture)


_DECODERS = {"png": _png, "jpeg": _jpeg, "tiff": _tiff, "bmp": _bmp, "pnm": _pnm}
