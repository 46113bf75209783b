"""TIFF files: the tags of the first picture, and grey content in the usual encodings.

OpenCV reads the others (colour, palettes, JPEG and other compressions). From damaged 8-bit content it returns zeros,
with a message on standard error only. It applies the orientation tag even with IMREAD_IGNORE_ORIENTATION (5.0.0), so
that tag is set to "as stored" before. Strips of LZW and PackBits are decompressed by compiled functions for 8 bits
only: from damaged ones of 16 bits OpenCV returns no picture, and is faster (LZW: 6 ms, here 9 ms, for 1280x1024).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from geometry.compilation.jit import compiled_for_threads
from lab.pictures.inflate import decompress

Bytes: TypeAlias = NDArray[np.uint8]

CLEAR, END, FIRST = 256, 257, 258  # LZW codes: clear the table, end of data, first table entry
TABLE_SIZE = 4096  # table size, codes
_OVERRUN = 8  # bytes that may be written after the end


def decompress_lzw(packed: Bytes, size: int) -> Bytes | None:
    """Decompress LZW to `size` bytes; None for an invalid code or missing data. Source: TIFF 6.0, section 13."""
    out = np.empty(CLEAR + size + _OVERRUN, np.uint8)
    return out[CLEAR : CLEAR + size] if _decompress_lzw(packed, out, size) == size else None


@compiled_for_threads
def _decompress_lzw(packed: Bytes, out: Bytes, size: int) -> int:
    """Decompress LZW into `out` after its first 256 bytes; returns the number of bytes, or -1 for an invalid code.

    Codes have 9 to 12 bits, highest bit first; the width grows one entry before the table is full for it. A table entry
    is a range of `out`: start and length. The first 256 bytes of `out` are the single-byte entries. The entry that a
    code adds is the previous string and the first byte of its own string; it is added before that byte is written, so
    that a code may refer to its own entry.
    """
    start, length = np.zeros(TABLE_SIZE, np.int64), np.ones(TABLE_SIZE, np.int64)
    for k in range(CLEAR):
        out[k], start[k] = k, k
    entries, bits, fresh = FIRST, 9, True
    last_start, last_length = 0, 0
    buffer, held, at, done, end = 0, 0, 0, CLEAR, CLEAR + size
    while done < end:
        while held < bits:
            if at >= packed.size:
                return done - CLEAR
            buffer = ((buffer << 8) | int(packed[at])) & 0xFFFFFFFF
            at += 1
            held += 8
        code = (buffer >> (held - bits)) & ((1 << bits) - 1)
        held -= bits
        if code == CLEAR:
            entries, bits, fresh = FIRST, 9, True
            continue
        if code == END:
            return done - CLEAR
        if fresh:
            fresh = False
        elif entries < TABLE_SIZE:
            start[entries], length[entries] = last_start, last_length + 1
            entries += 1
            if entries + 1 >= 1 << bits and bits < 12:
                bits += 1
        if code >= entries or (code >= CLEAR and code < FIRST):
            return -1
        begin, count = int(start[code]), int(length[code])
        for k in range(_OVERRUN):  # most strings are shorter; copying a fixed number is faster
            out[done + k] = out[begin + k]
        if count > _OVERRUN:
            count = min(count, end - done)
            for k in range(_OVERRUN, count):
                out[done + k] = out[begin + k]
        last_start, last_length = done, count
        done += count
    return min(done, end) - CLEAR


@compiled_for_threads
def decompress_pack_bits(packed: Bytes, out: Bytes) -> int:
    """Decompress PackBits into `out`; returns the number of bytes, or -1 where data are missing.

    Source: TIFF 6.0 (1992), section 9.
    """
    at, done = 0, 0
    while done < out.size and at < packed.size:
        count = int(packed[at])
        at += 1
        if count < 128:
            size = min(count + 1, out.size - done)
            if at + count + 1 > packed.size:
                return -1
            out[done : done + size] = packed[at : at + size]
            at += count + 1
            done += size
        elif count > 128:
            size = min(257 - count, out.size - done)
            if at >= packed.size:
                return -1
            out[done : done + size] = packed[at]
            at += 1
            done += size
    return done


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
            and len(self.offsets) == len(self.counts) == self._across * -(-self.height // self._segment[1])
        )

    @property
    def _segment(self) -> tuple[int, int]:
        """Width and height of a tile or strip, px."""
        return self.tile or (self.width, self.rows_per_strip)

    @property
    def _across(self) -> int:
        return -(-self.width // self._segment[0])

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
