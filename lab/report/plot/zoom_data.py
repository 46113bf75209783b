"""The series behind a page's time plots, compact enough to embed: cursor.js draws parts of them when a user zooms.

Each series of n values is a row of integers: asinh((y - centre) / scale), rounded. So a few large values cost no
resolution near the centre. Above a size limit each block of frames is stored as its smallest and largest value. The
integers are differenced, split into planes of bytes and deflated.
"""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from geometry.arrays import Array, Ints

_BITS, _FINE_BITS = 14, 20
_FINE_SHARE = 8  # blocks of fine series are shorter by this factor: they are smooth and so compress better
_SPARE_BYTES, _BYTES_PER_FRAME, _MOST_BYTES = 150_000, 65, 2_700_000


class ZoomData:
    """Collects the series of one page over common times t (n,), increasing, and frame numbers (n,)."""

    def __init__(self, t: Array, frames: Ints) -> None:
        self._t, self._frames = t, frames
        self._series: list[tuple[Array, int]] = []
        self._place: dict[tuple[bytes, int], int] = {}
        self._rows: list[dict[str, Any]] = []
        self._codes: list[Ints] = []

    @property
    def n(self) -> int:
        """The number of frames."""
        return len(self._t)

    def add(self, y: Array, fine: bool = False) -> str | None:
        """The name of a series (n,) for an attribute: its number, or `=value` for a constant.

        None for another number of values: such a plot shows the whole run only. fine: with more digits, for series
        whose axis follows the visible part.
        """
        if len(y) != len(self._t):
            return None
        if len(y) and np.isfinite(y).all() and np.ptp(y) == 0:
            return f"={float(y[0])!r}"
        y = np.ascontiguousarray(y, dtype=float)
        key = (y.tobytes(), _FINE_BITS if fine else _BITS)
        if key not in self._place:
            self._place[key] = len(self._series)
            self._series.append((y, key[1]))
        return str(self._place[key])

    def add_row(self, name: str, codes: Ints, words: Sequence[tuple[str, str]]) -> int:
        """The number of a row of statuses: codes (n,) index into `words`, (word, colour) each; negative: none."""
        self._rows.append({"name": name, "words": words})
        self._codes.append(codes)
        return len(self._rows) - 1

    def encoded(self) -> str:
        """JSON text: what the rows and series are, and their integers, deflated, in base64."""
        n = len(self._t)
        allowed = min(_SPARE_BYTES + _BYTES_PER_FRAME * n, _MOST_BYTES)
        fixed = [*_whole_numbers(self._t)[1], *_whole_numbers(self._frames.astype(float), 1.0)[1]]
        fixed += [_bytes(codes + 1, 1) for codes in self._codes]
        expected = 1.6 * n * len(self._series)
        block = 1 if expected <= 1.3 * allowed else max(2, int(1.4 * expected / allowed))
        while True:
            packed = [_packed(y, bits, _own(block, bits)) for y, bits in self._series]
            data = base64.b64encode(zlib.compress(b"".join([*fixed, *(p[1] for p in packed)]), 6)).decode("ascii")
            if len(data) <= allowed or block >= max(n, 1):
                break
            block = max(block + 1, int(block * 1.05 * len(data) / allowed))
        head = {
            "n": n,
            "t": _whole_numbers(self._t)[0],
            "frames": _whole_numbers(self._frames.astype(float), 1.0)[0],
            "rows": self._rows,
            "series": [p[0] for p in packed],
            "data": data,
        }
        return json.dumps(head, separators=(",", ":"), ensure_ascii=True).replace("<", "\\u003c")


def _own(block: int, bits: int) -> int:
    """The length of the blocks of a series where most have `block` frames."""
    return block if bits == _BITS else -(-block // _FINE_SHARE)


def _bytes(values: Ints, count: int) -> bytes:
    """The `count` low bytes of each integer, as planes: all lowest bytes first."""
    return b"".join(((values >> (8 * i)) & 255).astype(np.uint8).tobytes() for i in range(count))


def _whole_numbers(values: Array, least_step: float = 1e-6) -> tuple[list[float], list[bytes]]:
    """First value and step; and the second differences of the values (n,) in steps, four bytes each."""
    first = float(values[0]) if len(values) else 0.0
    largest = float(np.abs(values - first).max(initial=0.0))
    step = max(least_step, largest / 2**30)
    places = np.round((values - first) / step).astype(np.int64)
    return [first, step], [_bytes(np.diff(np.diff(places, prepend=0), prepend=0), 4)]


def _packed(y: Array, bits: int, block: int) -> tuple[list[float], bytes]:
    """Centre, scale, lowest asinh, its step, bytes per value, frames per block; and the integers, 0 for nan."""
    finite = y[np.isfinite(y)]
    centre = float(np.median(finite)) if finite.size else 0.0
    usual = float(np.percentile(np.abs(finite - centre), 75)) if finite.size else 0.0
    scale = usual or float(np.abs(finite - centre).max(initial=0.0)) or 1.0
    if block > 1:
        padded = np.full(-(-len(y) // block) * block, np.nan)
        padded[: len(y)] = y
        grid = padded.reshape(-1, block)
        low = np.where(np.isnan(grid), np.inf, grid).min(axis=1)
        high = np.where(np.isnan(grid), -np.inf, grid).max(axis=1)
        y = np.concatenate([low, high])
        y[~np.isfinite(y)] = np.nan
    u = np.arcsinh((y - centre) / scale)
    lowest = float(np.nanmin(u)) if finite.size else 0.0
    step = max((float(np.nanmax(u)) - lowest) if finite.size else 0.0, 1e-9) / (2**bits - 2)
    q = np.where(np.isfinite(u), 1 + np.round((np.nan_to_num(u) - lowest) / step), 0).astype(np.int64)
    count = (bits + 7) // 8
    return [centre, scale, lowest, step, count, block], _bytes(np.diff(q, prepend=0), count)
