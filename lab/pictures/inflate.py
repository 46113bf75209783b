"""Zlib streams by Intel's ISA-L: 2.0 ms to decompress a grey 1280x1024 PNG (zlib: 6.2), 4.6 to compress it (16)."""

from __future__ import annotations

from typing import cast

from isal import isal_zlib

crc32 = isal_zlib.crc32
_Damaged = cast("type[Exception]", isal_zlib.error)


def decompress(data: object, size: int) -> bytes | None:
    """The content of a zlib stream of exactly `size` bytes; None where it is damaged, longer or shorter.

    The checksum (Adler-32) is verified. At most `size` + 1 bytes are decompressed, whatever the stream contains. The
    GIL is released.
    """
    stream = isal_zlib.decompressobj()
    try:
        out: bytes = stream.decompress(data, size + 1)
    except _Damaged:
        return None
    return out if stream.eof and len(out) == size else None


def compress(data: object) -> bytes:
    """A zlib stream of this content. The GIL is released."""
    return isal_zlib.compress(data, 1)
