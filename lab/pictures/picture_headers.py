"""Headers of picture files: kind, size and depth, read before anything is decoded.

A small file can declare a picture of any size: a PNG of 0.9 MB with 30000x30000 px needs 3.7 GB to decode.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from lab.pictures.inflate import crc32
from lab.pictures.tiff import KNOWN_COMPRESSIONS, TIFF_SIGNATURES, Tiff

Bytes: TypeAlias = memoryview  # content of a file

MAX_PIXELS = 2**28  # of one picture: the largest sensors have 2^27.3; a header with more is wrong
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
JPEG_END, JPEG_SCAN = 0xD9, 0xDA  # EOI, SOS
_JPEG_FRAMES = {0xC0 + k for k in range(16)} - {0xC4, 0xC8, 0xCC}  # SOF0 to SOF15 without DHT, JPG, DAC
_PNM_WORD = re.compile(rb"(?:\s|#[^\r\n]*[\r\n])+([0-9]+)")


class DamagedError(Exception):
    """A picture that cannot be used. The message is the reason, to follow `unreadable: `."""


@dataclass(frozen=True, slots=True)
class Header:
    """The header of a picture file."""

    kind: str  # "png", "jpeg", "tiff", "bmp", "pnm"
    width: int  # px
    height: int  # px
    numbers: str = ""  # sample type such as "float32"; empty: unsigned, 16 bits or fewer
    tiff: Tiff | None = None
    pnm: tuple[int, int, int] = (0, 0, 0)  # digit after the P, largest value, first byte of the content
    jpeg_components: int = 0

    def require_sound(self) -> None:
        """Raises DamagedError for a size or depth that no camera of a rig can have."""
        if self.width < 1 or self.height < 1:
            raise DamagedError(f"damaged (the header says {self.width}x{self.height} px)")
        if self.width * self.height > MAX_PIXELS:
            raise DamagedError(
                f"the header says {self.width}x{self.height} px, more than the limit of {MAX_PIXELS / 1e6:.0f} million"
            )
        if self.numbers:
            raise DamagedError(f"{self.numbers} numbers, expected 8 or 16 bits without sign")


def read_header(data: NDArray[np.uint8]) -> Header:
    """The header of a picture file, (n,) bytes. Raises DamagedError where it is not a picture, or truncated."""
    view = data.data
    start = bytes(view[:8])
    try:
        if start == PNG_SIGNATURE:
            return _png(view)
        if start.startswith(b"\xff\xd8"):
            return _jpeg(view)
        if start[:4] in TIFF_SIGNATURES:
            return _tiff(view)
        if start.startswith(b"BM"):
            return _bmp(view)
        if re.match(rb"P[1-6]\s", start):
            return _pnm(view)
    except (struct.error, IndexError):  # the file ends within the header
        raise DamagedError("cut short") from None
    raise DamagedError("damaged, or no picture (PNG, TIFF, BMP, PGM or JPEG)")


def _png(view: Bytes) -> Header:
    """Source: PNG, ISO 15948, 11.2.2: IHDR is the first chunk."""
    length, kind, width, height = struct.unpack_from(">I4sII", view, 8)
    if kind != b"IHDR" or length != 13:
        raise DamagedError("damaged (a PNG without its header)")
    if crc32(view[12:29]) != struct.unpack_from(">I", view, 29)[0]:
        raise DamagedError("damaged (a checksum is wrong)")
    return Header("png", width, height)


def jpeg_segments(view: Bytes) -> Iterator[tuple[int, int, int]]:
    """Marker, first byte of the content and end of each segment of a JPEG up to the first scan.

    Source: ITU T.81, B.1.1.4. Raises IndexError or struct.error where the file ends within a segment, DamagedError
    where a marker is missing.
    """
    at = 2
    while True:
        if view[at] != 0xFF:
            raise DamagedError("damaged (no marker where one must be)")
        marker = view[at + 1]
        if marker == 0xFF:  # a fill byte
            at += 1
            continue
        end = at + 2 if marker == JPEG_END else at + 2 + struct.unpack_from(">H", view, at + 2)[0]
        yield marker, at + 4, end
        if marker in (JPEG_END, JPEG_SCAN):
            return
        at = end


def _jpeg(view: Bytes) -> Header:
    """The frame header. Source: ITU T.81, B.2.2."""
    for marker, at, _ in jpeg_segments(view):
        if marker in _JPEG_FRAMES:
            bits, height, width, components = struct.unpack_from(">BHHB", view, at)
            return Header("jpeg", width, height, "" if bits in (8, 16) else f"{bits} bit", jpeg_components=components)
    raise DamagedError("damaged (no frame header before the first scan)")


def _tiff(view: Bytes) -> Header:
    tiff = Tiff.read(view)
    if tiff.tile is not None and tiff.tile[0] * tiff.tile[1] > MAX_PIXELS:
        raise DamagedError(f"damaged (tiles of {tiff.tile[0]}x{tiff.tile[1]} px)")
    if tiff.compression not in KNOWN_COMPRESSIONS:
        raise DamagedError(f"unknown compression (TIFF compression {tiff.compression})")
    signs = {1: "uint", 2: "int", 3: "float"}
    usual = tiff.sample_format in (1, 4) and tiff.bits in (1, 4, 8, 10, 12, 14, 16)  # 4: not said
    numbers = "" if usual else f"{signs.get(tiff.sample_format, 'unknown')}{tiff.bits}"
    return Header("tiff", tiff.width, tiff.height, numbers, tiff=tiff)


def _bmp(view: Bytes) -> Header:
    """Source: BITMAPFILEHEADER, then BITMAPCOREHEADER (12 bytes) or BITMAPINFOHEADER (40 and more)."""
    (size,) = struct.unpack_from("<I", view, 14)
    if size == 12:
        width, height = struct.unpack_from("<HH", view, 18)
    else:
        width, height = struct.unpack_from("<ii", view, 18)
    return Header("bmp", width, abs(height))  # a negative height: rows from top to bottom


def _pnm(view: Bytes) -> Header:
    """Source: netpbm's pgm(5): P5, width, height, the largest value, one white space, the content."""
    kind = view[1] - ord("0")
    start = bytes(view[: 1 << 16])
    words, at = [], 2
    for _ in range(2 if kind in (1, 4) else 3):
        match = _PNM_WORD.match(start, at)
        if match is None or len(match[1]) > 9:
            raise DamagedError("cut short" if match is None and start[at:].strip() == b"" else "damaged (its header)")
        words.append(int(match[1]))
        at = match.end()
    largest = words[2] if len(words) == 3 else 1
    if not 1 <= largest <= 65535:
        raise DamagedError(f"damaged (its largest value is {largest})")
    return Header("pnm", words[0], words[1], pnm=(kind, largest, at + 1))
