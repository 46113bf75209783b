"""LZW and PackBits, in which TIFF files pack their strips; compiled.

For 8 bits: where a strip cannot be unpacked OpenCV makes zeros of it and says so on standard error only. Of 16 bits it
gives no picture then, in two thirds of the time (LZW: 6 ms against 9 for 1280x1024).
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from geometry.compilation.jit import compiled_for_threads

Bytes: TypeAlias = NDArray[np.uint8]

CLEAR, END, FIRST = 256, 257, 258  # codes of LZW: empty the table, end, the first of the table
LONGEST = 4096  # codes
_BEYOND = 8  # bytes that may be written behind the end


def unpacked_lzw(packed: Bytes, size: int) -> Bytes | None:
    """Unpack LZW to `size` bytes; None where a code is impossible, or it ends before. Source: TIFF 6.0, section 13."""
    out = np.empty(CLEAR + size + _BEYOND, np.uint8)
    return out[CLEAR : CLEAR + size] if _unpack_lzw(packed, out, size) == size else None


@compiled_for_threads
def _unpack_lzw(packed: Bytes, out: Bytes, size: int) -> int:
    """Unpack LZW behind the first 256 bytes of `out`; returns the number of bytes, or -1 where a code is impossible.

    Codes of 9 to 12 bits, the highest bit first; one bit more as soon as one entry less than fits is in the table. An
    entry is a piece of `out`: where it stands, and its length. The single bytes stand before all others. The entry that
    a code makes, the string before it and its own first byte, is there before that byte is, so it may name itself.
    """
    start, length = np.zeros(LONGEST, np.int64), np.ones(LONGEST, np.int64)
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
        elif entries < LONGEST:
            start[entries], length[entries] = last_start, last_length + 1
            entries += 1
            if entries + 1 >= 1 << bits and bits < 12:
                bits += 1
        if code >= entries or (code >= CLEAR and code < FIRST):
            return -1
        begin, count = int(start[code]), int(length[code])
        for k in range(_BEYOND):  # most are shorter: a fixed number is copied faster than a small unknown one
            out[done + k] = out[begin + k]
        if count > _BEYOND:
            count = min(count, end - done)
            for k in range(_BEYOND, count):
                out[done + k] = out[begin + k]
        last_start, last_length = done, count
        done += count
    return min(done, end) - CLEAR


@compiled_for_threads
def unpacked_bits(packed: Bytes, out: Bytes) -> int:
    """Unpack PackBits into `out`; returns the number of bytes, or -1 where they are not enough.

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
