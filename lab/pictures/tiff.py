"""TIFF files: the tags of the first picture, and grey content in the usual encodings.

OpenCV reads the others (colour, palettes, JPEG and other compressions). From damaged 8-bit content it returns zeros,
with a message on standard error only. It applies the orientation tag even with IMREAD_IGNORE_ORIENTATION (5.0.0), so
that tag is set to "as stored" before.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lab.pictures.inflate import decompress

TIFF_SIGNATURES = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")  # the last two: BigTIFF
_TYPES = {1: "B", 3: "H", 4: "I", 16: "Q"}  # BYTE, SHORT, LONG, LONG8
_ORIENTATION = 274
_MAX_SEGMENTS = 1 << 20  # strips or tiles: one per row is 65536 at most
PLAIN, LZW, DEFLATE, PACK_BITS, OLD_DEFLATE = 1, 5, 8, 32773, 32946
_OWN_COMPRESSIONS = (PLAIN, LZW, DEFLATE, PACK_BITS, OLD_DEFLATE)
# Compressions of OpenCV's libtiff: CCITT (2, 3, 4), LZW, JPEG, PackBits, LZMA, Zstandard. For others it returns zeros.
KNOWN_COMPRESSIONS = (PLAIN, 2, 3, 4, LZW, 7, DEFLATE, PACK_BITS, OLD_DEFLATE, 34925, 50000)


@dataclass(frozen=True, slots=True)
class Tiff:
    """The first directory of a TIFF file. Source: TIFF 6.0 (1992), section 8; BigTIFF for long offsets."""

    width: int
    height: int
    bits: int  # per sample
    samples: int  # per pixel
    sample_format: int  # 1 unsigned, 2 signed, 3 floating point, 4 undefined
    compression: int
    photometric: int  # 1: 0 is black
    predictor: int  # 2: horizontal differences
    fill_order: int
    orientation_at: int  # position, bytes, of the value of an orientation tag other than "as stored"; 0: none
    order: str  # "<" or ">"
    tile: tuple[int, int] | None  # width and height; None: strips
    rows_per_strip: int
    offsets: tuple[int, ...]  # of the strips or tiles
    counts: tuple[int, ...]  # their lengths, bytes

    @staticmethod
    def read(view: memoryview) -> Tiff:
        """From the content of a file. Raises struct.error or IndexError where it ends within the directory."""
        order = "<" if view[0] == ord("I") else ">"
        big = bytes(view[2:4]) in (b"+\0", b"\0+")
        tags = _directory(view, order, big)

        def number(tag: int, default: int) -> int:
            return _numbers(view, tags, tag, order, big, (default,))[0]

        width, height = number(256, 0), number(257, 0)
        tiled = 322 in tags
        at = tags[_ORIENTATION][2] if number(_ORIENTATION, 1) != 1 else 0
        return Tiff(
            width,
            height,
            bits=number(258, 1),
            samples=number(277, 1),
            sample_format=number(339, 1),
            compression=number(259, 1),
            photometric=number(262, 1),
            predictor=number(317, 1),
            fill_order=number(266, 1),
            orientation_at=at,
            order=order,
            tile=(number(322, 0), number(323, 0)) if tiled else None,
            rows_per_strip=min(number(278, height), max(height, 1)),
            offsets=_numbers(view, tags, 324 if tiled else 273, order, big, ()),
            counts=_numbers(view, tags, 325 if tiled else 279, order, big, ()),
        )

    @property
    def is_simple(self) -> bool:
        """Whether `content` reads it: one grey sample of 8 or 16 bits, uncompressed or in a usual compression."""
        return (
            self.samples == 1
            and self.bits in (8, 16)
            and self.sample_format in (1, 4)
            and self.photometric == 1
            and self.fill_order == 1
            and self.compression in ((PLAIN, DEFLATE, OLD_DEFLATE) if self.bits == 16 else _OWN_COMPRESSIONS)
            and self.predictor in (1, 2)
            and min(self.tile or (1, self.rows_per_strip)) >= 1
            and len(self.offsets) == len(self.counts) == self._across * self._down
        )

    @property
    def _segment(self) -> tuple[int, int]:
        """Width and height of a tile or strip, px."""
        return self.tile or (self.width, self.rows_per_strip)

    @property
    def _across(self) -> int:
        return -(-self.width // self._segment[0])

    @property
    def _down(self) -> int:
        return -(-self.height // self._segment[1])

    def content(self, data: NDArray[np.uint8]) -> NDArray[np.uint8] | NDArray[np.uint16] | None:
        """The pixels (height, width) of a file that `is_simple`; None where a strip or tile is incomplete.

        Where the strips are contiguous in the file, 8-bit pixels are a view of `data`.
        """
        wide, high = self._segment
        dtype = np.dtype(f"{self.order}u{self.bits // 8}")
        whole = self.width * self.height * dtype.itemsize
        if self.compression == PLAIN and self.tile is None and self._in_one_piece(high * wide * dtype.itemsize):
            piece = data[self.offsets[0] : self.offsets[0] + whole]
            if len(piece) < whole:
                return None
            return _native(piece.view(dtype).reshape(self.height, self.width))
        out = np.empty((self.height, self.width), dtype.newbyteorder("="))
        for k, (at, count) in enumerate(zip(self.offsets, self.counts, strict=True)):
            row, column = k // self._across * high, k % self._across * wide
            rows = high if self.tile else min(high, self.height - row)
            stored = self._stored(data[at : at + count], rows * wide * dtype.itemsize)
            if stored is None:
                return None
            pixels = stored.view(dtype).reshape(rows, wide)
            if self.compression in (LZW, DEFLATE, OLD_DEFLATE) and self.predictor == 2:
                pixels = np.cumsum(pixels, axis=1, dtype=out.dtype)
            target = out[row : row + high, column : column + wide]
            target[:] = pixels[: target.shape[0], : target.shape[1]]
        return out

    def _in_one_piece(self, strip: int) -> bool:
        ends = [at + strip for at in self.offsets[:-1]]
        return list(self.offsets[1:]) == ends

    def _stored(self, piece: NDArray[np.uint8], size: int) -> NDArray[np.uint8] | None:
        """The decompressed content of a strip or tile; None where it does not have `size` bytes."""
        if self.compression == PLAIN:
            return piece[:size] if len(piece) >= size else None
        if self.compression in (DEFLATE, OLD_DEFLATE):
            unpacked = decompress(piece, size)
            return None if unpacked is None else np.frombuffer(unpacked, np.uint8)
        from lab.pictures.tiff_packing import (  # compiled code: imported only where needed
            decompress_lzw,
            decompress_pack_bits,
        )

        if self.compression == LZW:
            return decompress_lzw(piece, size)
        out = np.empty(size, np.uint8)
        return out if decompress_pack_bits(piece, out) == size else None

    def as_stored(self, data: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The bytes of the file with orientation "as stored"; a copy where that changes them."""
        if not self.orientation_at:
            return data
        out = data.copy()
        out[self.orientation_at : self.orientation_at + 2] = list(struct.pack(f"{self.order}H", 1))
        return out


def _native(pixels: NDArray[np.generic]) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """In the byte order of the machine, aligned."""
    if pixels.dtype.itemsize == 1:
        return pixels.view(np.uint8)
    return np.require(pixels, np.uint16, ["C", "ALIGNED", "WRITEABLE"])


def _directory(view: memoryview, order: str, big: bool) -> dict[int, tuple[int, int, int]]:
    """Tags of the first directory: type, count, and position of the value (or of its offset), bytes."""
    if big:
        (at,) = struct.unpack_from(f"{order}Q", view, 8)
        (count,) = struct.unpack_from(f"{order}Q", view, at)
        at, size, entry = at + 8, 20, f"{order}HHQ"
    else:
        (at,) = struct.unpack_from(f"{order}I", view, 4)
        (count,) = struct.unpack_from(f"{order}H", view, at)
        at, size, entry = at + 2, 12, f"{order}HHI"
    if count > 65535:
        raise struct.error("a directory with more tags than exist")
    tags: dict[int, tuple[int, int, int]] = {}
    for k in range(count):
        tag, kind, number = struct.unpack_from(entry, view, at + k * size)
        tags.setdefault(tag, (kind, number, at + k * size + (12 if big else 8)))
    return tags


def _numbers(
    view: memoryview,
    tags: dict[int, tuple[int, int, int]],
    tag: int,
    order: str,
    big: bool,
    default: tuple[int, ...],
) -> tuple[int, ...]:
    """The values of a tag; the default where it is absent or not integer."""
    kind, count, at = tags.get(tag, (0, 0, 0))
    if kind not in _TYPES or not 1 <= count <= _MAX_SEGMENTS:
        return default
    size = count * struct.calcsize(_TYPES[kind])
    if size > (8 if big else 4):
        (at,) = struct.unpack_from(f"{order}{'Q' if big else 'I'}", view, at)
    return struct.unpack_from(f"{order}{count}{_TYPES[kind]}", view, at)
