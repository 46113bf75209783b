"""Writers of PNG and TIFF files with freely chosen contents, for tests."""

from __future__ import annotations

import struct
import zlib

import numpy as np

ADAM7 = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png(
    samples: np.ndarray,
    *,
    colour_type: int = 0,
    bits: int | None = None,
    filters: tuple[int, ...] = (0,),
    interlaced: bool = False,
    size: tuple[int, int] | None = None,
    before: bytes = b"",
    content: bytes | None = None,
    split: int = 1000,
) -> bytes:
    """A PNG of samples (h, w) or (h, w, channels). filters: of the rows in turn. size, content: false values."""
    height, width = samples.shape[:2]
    bits = bits or 8 * samples.dtype.itemsize
    raw = b"".join(_rows(samples[top::down, left::across], bits, filters) for left, top, across, down in ADAM7)
    if not interlaced:
        raw = _rows(samples, bits, filters)
    packed = zlib.compress(raw) if content is None else content
    header = struct.pack(">IIBBBBB", *(size or (width, height)), bits, colour_type, 0, 0, int(interlaced))
    parts = [chunk(b"IDAT", packed[i : i + split]) for i in range(0, len(packed), split)]
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + before + b"".join(parts) + chunk(b"IEND", b"")


def _rows(samples: np.ndarray, bits: int, filters: tuple[int, ...]) -> bytes:
    """Filtered rows. Source: PNG, ISO 15948, 9.2, implemented literally."""
    if not samples.size:
        return b""
    channels = 1 if samples.ndim == 2 else samples.shape[2]
    if bits < 8:
        ones = (samples[..., None] >> np.arange(bits)[::-1]) & 1
        rows = np.packbits(ones.reshape(len(samples), -1).astype(np.uint8), axis=1)
    else:
        rows = samples.reshape(len(samples), -1).astype(">u2" if bits == 16 else np.uint8).view(np.uint8)
    step = max(1, bits * channels // 8)
    out = bytearray()
    above = [0] * rows.shape[1]
    for y, line in enumerate(rows.tolist()):
        kind = filters[y % len(filters)]
        out.append(kind)
        for x, value in enumerate(line):
            a, c = (line[x - step], above[x - step]) if x >= step else (0, 0)
            b = above[x]
            p = a + b - c
            paeth = min((abs(p - a), 0, a), (abs(p - b), 1, b), (abs(p - c), 2, c))[2]
            out.append((value - (0, a, b, (a + b) // 2, paeth)[kind]) % 256)
        above = line
    return bytes(out)


def tiff(
    picture: np.ndarray,
    *,
    order: str = "<",
    big: bool = False,
    tile: tuple[int, int] | None = None,
    rows_per_strip: int | None = None,
    deflated: bool = False,
    predictor: int = 1,
    tags: dict[int, int] | None = None,
    pages: int = 1,
) -> bytes:
    """A grey TIFF of a picture (h, w). tags: further ones, or others than the picture's own, as single numbers."""
    height, width = picture.shape
    wide, high = tile or (width, rows_per_strip or height)
    pieces = []
    for top in range(0, height, high):
        for left in range(0, width, wide):
            piece = picture[top : top + high, left : left + wide]
            if tile:
                piece = np.pad(piece, ((0, high - piece.shape[0]), (0, wide - piece.shape[1])))
            if predictor == 2:
                piece = np.diff(piece, axis=1, prepend=piece.dtype.type(0))
            content = piece.astype(picture.dtype.newbyteorder(order)).tobytes()
            pieces.append(zlib.compress(content) if deflated else content)
    out = bytearray((b"II" if order == "<" else b"MM") + struct.pack(f"{order}H", 43 if big else 42))
    out += struct.pack(f"{order}HHQ", 8, 0, 0) if big else struct.pack(f"{order}I", 0)
    offsets = []
    for piece in pieces:
        offsets.append(len(out))
        out += piece
    fields = {256: width, 257: height, 258: 8 * picture.dtype.itemsize, 259: 8 if deflated else 1, 262: 1, 277: 1}
    fields |= {317: predictor} if predictor != 1 else {}
    fields |= {322: wide, 323: high} if tile else {278: high}
    fields |= ({"f": 3, "i": 2}.get(picture.dtype.kind, 0) and {339: {"f": 3, "i": 2}[picture.dtype.kind]}) or {}
    fields |= tags or {}
    lists = {324: offsets, 325: [len(p) for p in pieces]} if tile else {273: offsets, 279: [len(p) for p in pieces]}
    for _ in range(pages):
        _directory(out, order, big, fields, lists)
    return bytes(out)


def _directory(out: bytearray, order: str, big: bool, fields: dict[int, int], lists: dict[int, list[int]]) -> None:
    """Append a directory, to which the header points where it is the first."""
    word, entry = ("Q", "HHQ") if big else ("I", "HHI")
    many = {}
    for tag, numbers in lists.items():
        many[tag] = len(out)
        out += struct.pack(f"{order}{len(numbers)}I", *numbers)
    at = len(out)
    first = 8 if big else 4
    if not any(out[first : first + struct.calcsize(word)]):
        out[first : first + struct.calcsize(word)] = struct.pack(f"{order}{word}", at)
    everything = {
        **{t: (3 if v < 65536 else 4, [v]) for t, v in fields.items()},
        **{t: (4, n) for t, n in lists.items()},
    }
    out += struct.pack(f"{order}{'Q' if big else 'H'}", len(everything))
    for tag, (kind, numbers) in sorted(everything.items()):
        out += struct.pack(f"{order}{entry}", tag, kind, len(numbers))
        value = struct.pack(f"{order}{len(numbers)}{'H' if kind == 3 else 'I'}", *numbers)
        room = 8 if big else 4
        out += value.ljust(room, b"\0") if len(value) <= room else struct.pack(f"{order}{word}", many[tag])
    out += struct.pack(f"{order}{word}", 0)
