"""Sizes, brightnesses and positions of the spots of many pictures, in bounded memory."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from geometry.arrays import Array
from lab.runs.frames.sensor_noise import CameraNoise
from tracking.detections import Detections

MOST_KEPT = 400_000  # spots kept for figures; beyond that every second one is dropped, repeatedly


def matched_snr(found: Detections, background_dn: float) -> Array:
    """Signal-to-noise ratio (n,) of spots after a matched filter, which decides whether a faint spot is found.

    background_dn: noise of a background pixel, 1 sigma. A Gaussian of flux F and axes a, b has F / (2 sqrt(pi a b)
    sigma); shot noise of the spot itself is not included. Source: Turin (1960), "An introduction to matched filters",
    IRE Trans. IT-6, for a two-dimensional Gaussian in white noise.
    """
    area = np.maximum(found.major_px * found.minor_px, 1e-12)
    return np.asarray(found.flux / (2 * np.sqrt(np.pi * area) * background_dn))


@dataclass(slots=True)
class SizeGroup:
    """Pictures of one size and depth, which share a noise model."""

    size_px: tuple[int, int]  # width, height
    bits: int  # of the data type: 8 or 16
    noise: CameraNoise
    pictures: int = 0

    def text(self) -> str:
        """`1280x1024, 8 bit`."""
        return f"{self.size_px[0]}x{self.size_px[1]}, {self.bits} bit"


@dataclass(slots=True)
class SpotCollection:
    """Spots of many pictures; columns frame, u, v, major, minor, snr, peak."""

    total: int = 0
    per_frame: list[tuple[int, int]] = field(default_factory=list)  # frame, number of its spots
    _kept: list[Array] = field(default_factory=list)
    _rows: int = 0
    _stride: int = 1

    def add(self, frame: int, found: Detections, snr: Array) -> None:
        """Add the spots of one picture."""
        self.per_frame.append((frame, len(found)))
        self.total += len(found)
        shape = (found.uv_px, found.major_px, found.minor_px, snr, found.peak)
        rows = np.column_stack([np.full(len(found), float(frame)), *shape])[:: self._stride]
        self._kept.append(rows)
        self._rows += len(rows)
        if self._rows > MOST_KEPT:
            self._kept = [self.table()[::2]]
            self._rows = len(self._kept[0])
            self._stride *= 2

    def table(self) -> Array:
        """(n, 7): the columns of the kept spots."""
        return np.concatenate([np.zeros((0, 7)), *self._kept])
