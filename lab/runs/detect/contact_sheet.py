"""Contact sheet: evenly spaced pictures with stretched contrast, and rings around the detected spots."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lab.pictures.picture_file import GreyPicture
from lab.report.frames.canvas import PAPER, SOFT, Box, Canvas, Pixels, ground, png, text_size, write
from lab.report.plot.image import grey_limits, stretched
from tracking.detections import Detections

MOST = 24  # pictures on a sheet
# Largest number of pictures, columns, and width of each picture, px.
_GRIDS = ((1, 1, 1280), (4, 2, 860), (9, 3, 600), (16, 4, 460), (24, 6, 320))
_STRIP = 22  # px, height of the strip above each picture, for its caption
_GAP = 8  # px, between pictures
_NUMBERED = 30  # spots per picture that get a number
_LARGEST_ZOOM = 8
_RING = (80, 200, 255)  # BGR
_TEXT = 12.0  # px, height of a line of text


@dataclass(frozen=True, slots=True)
class _Kept:
    frame: int
    picture: GreyPicture
    found: Detections


@dataclass(slots=True)
class ContactSheet:
    """Selects evenly spaced pictures from all that are offered.

    total: number of pictures; None: unknown. Every second selected picture is then dropped whenever there are too many.
    """

    total: int | None
    _kept: dict[int, _Kept] = field(default_factory=dict)  # by index in the series
    _stride: int = 1

    def offer(self, index: int, frame: int, picture: GreyPicture, found: Detections) -> None:
        """Offer the picture at this index of the series, from 0, with its detections."""
        if self._selects(index):
            self._kept[index] = _Kept(frame, picture.copy(), found)
        if len(self._kept) > MOST:
            self._stride *= 2
            self._kept = {k: kept for k, kept in self._kept.items() if k % self._stride == 0}

    def write(self, path: Path) -> None:
        """Write the sheet as a PNG file."""
        path.write_bytes(png(self.drawn()))

    def drawn(self) -> Pixels:
        """The sheet (h, w, 3), 8 bit, BGR."""
        kept = [self._kept[k] for k in sorted(self._kept)]
        columns, width = next((c, w) for most, c, w in _GRIDS if len(kept) <= most)
        columns = min(columns, max(len(kept), 1))
        height = round(width * max((k.picture.shape[0] / k.picture.shape[1] for k in kept), default=0.75))
        height = min(height, 2 * width)
        rows = -(-len(kept) // columns)
        across, down = width + _GAP, height + _STRIP + _GAP
        sheet = np.full((max(rows, 1) * down + _GAP, columns * across + _GAP, 3), PAPER, np.uint8)
        for i, one in enumerate(kept):
            top, left = _GAP + (i // columns) * down, _GAP + (i % columns) * across
            sheet[top : top + _STRIP + height, left : left + width] = _tile(one, width, height)
        return sheet

    def _selects(self, index: int) -> bool:
        if self.total is None or index >= self.total:
            return index % self._stride == 0
        # The k-th of m selected pictures of n has the index (n - 1) k / (m - 1), rounded: first and last are included.
        m = min(MOST, self.total)
        k = round(index * (m - 1) / max(self.total - 1, 1))
        return index == round(k * (self.total - 1) / max(m - 1, 1))


def _tile(one: _Kept, width: int, height: int) -> Pixels:
    """One picture with its caption above it, and rings around its spots; the brightest have a number."""
    out: Pixels = np.full((_STRIP + height, width, 3), PAPER, np.uint8)
    spots = f"{len(one.found)} spot{'' if len(one.found) == 1 else 's'}"
    write(out, (2, 15), f"frame {one.frame}", _TEXT)
    write(out, (width - text_size(spots, _TEXT)[0] - 3, 15), spots, _TEXT, SOFT)
    h, w = one.picture.shape
    scale = min(width / w, height / h, _LARGEST_ZOOM)
    size = (max(round(w * scale), 1), max(round(h * scale), 1))
    grey = stretched(one.picture, *grey_limits(one.picture))
    canvas = Canvas(ground(grey, size, scale), np.array([-0.5, -0.5]), scale, 1.0)
    small = width < 400
    taken: list[Box] = []
    for i, uv in enumerate(one.found.uv_px):
        major = float(one.found.major_px[i]) if np.isfinite(one.found.major_px[i]) else 1.0
        radius = max(3.5 * major * scale, 5.0 if small else 8.0)
        canvas.ring(uv, radius, _RING)
        if i < _NUMBERED:
            u, v = canvas.at(uv).tolist()
            canvas.label((u, v), radius + 2, str(i + 1), 10.0 if small else _TEXT, _RING, taken)
    left, top = (width - size[0]) // 2, _STRIP + (height - size[1]) // 2
    out[top : top + size[1], left : left + size[0]] = canvas.image
    return out
