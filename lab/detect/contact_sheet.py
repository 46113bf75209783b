"""Contact sheet: evenly spaced pictures with stretched contrast, and rings around the detected spots."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.pictures.picture_file import GreyPicture
from lab.report.plot.image import grey_limits, stretched
from tracking.detections import Detections

Colour: TypeAlias = NDArray[np.uint8]  # (h, w, 3), BGR

MOST = 24  # pictures on a sheet
# Largest number of pictures, columns, and width of each picture, px.
_GRIDS = ((1, 1, 1280), (4, 2, 860), (9, 3, 600), (16, 4, 460), (24, 6, 320))
_STRIP = 22  # px, height of the strip above each picture, for its caption
_GAP = 8  # px, between pictures
_NUMBERED = 30  # spots per picture that get a number
_LARGEST_ZOOM = 8
_RING, _PAPER, _INK, _SOFT = (80, 200, 255), (24, 28, 32), (236, 233, 230), (170, 176, 184)
_FONT = cv2.FONT_HERSHEY_SIMPLEX


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
        path.write_bytes(cv2.imencode(".png", self.drawn(), [cv2.IMWRITE_PNG_COMPRESSION, 6])[1].tobytes())

    def drawn(self) -> Colour:
        """The sheet (h, w, 3), 8 bit, BGR."""
        kept = [self._kept[k] for k in sorted(self._kept)]
        columns, width = next((c, w) for most, c, w in _GRIDS if len(kept) <= most)
        columns = min(columns, max(len(kept), 1))
        height = round(width * max((k.picture.shape[0] / k.picture.shape[1] for k in kept), default=0.75))
        height = min(height, 2 * width)
        rows = -(-len(kept) // columns)
        across, down = width + _GAP, height + _STRIP + _GAP
        sheet = np.full((max(rows, 1) * down + _GAP, columns * across + _GAP, 3), _PAPER, np.uint8)
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


def _tile(one: _Kept, width: int, height: int) -> Colour:
    """One picture with its caption above it."""
    out: Colour = np.full((_STRIP + height, width, 3), _PAPER, np.uint8)
    spots = f"{len(one.found)} spot{'' if len(one.found) == 1 else 's'}"
    cv2.putText(out, f"frame {one.frame}", (2, 15), _FONT, 0.45, _INK, 1, cv2.LINE_AA)
    wide = cv2.getTextSize(spots, _FONT, 0.45, 1)[0][0]
    cv2.putText(out, spots, (width - wide - 3, 15), _FONT, 0.45, _SOFT, 1, cv2.LINE_AA)
    h, w = one.picture.shape
    scale = min(width / w, height / h, _LARGEST_ZOOM)
    size = (max(round(w * scale), 1), max(round(h * scale), 1))
    grey = stretched(one.picture, *grey_limits(one.picture))
    # A maximum filter keeps small spots visible in a reduced picture.
    if scale < 0.6:
        reach = max(round(0.7 / scale), 1)
        grey = np.asarray(cv2.dilate(grey, np.ones((reach, reach), np.uint8)), np.uint8) if reach > 1 else grey
    shown = cv2.resize(grey, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST)
    picture: Colour = np.asarray(cv2.cvtColor(shown, cv2.COLOR_GRAY2BGR), np.uint8)
    _circle(picture, one.found, scale)
    left, top = (width - size[0]) // 2, _STRIP + (height - size[1]) // 2
    out[top : top + size[1], left : left + size[0]] = picture
    return out


def _circle(picture: Colour, found: Detections, scale: float) -> None:
    """Draw rings around the spots; the brightest get a number where there is room."""
    taken: list[tuple[int, int, int]] = []
    font = 0.38 if picture.shape[1] < 400 else 0.5
    for i in range(len(found)):
        # Integer coordinates are pixel centres, so the picture's edge is at -0.5.
        u, v = ((found.uv_px[i] + 0.5) * scale - 0.5).tolist()
        major = float(found.major_px[i]) if np.isfinite(found.major_px[i]) else 1.0
        radius = round(max(3.5 * major * scale, 5.0 if font < 0.5 else 8.0))
        centre = (round(u), round(v))
        cv2.circle(picture, centre, radius, _RING, 1, cv2.LINE_AA)
        if i < _NUMBERED:
            _number(picture, str(i + 1), centre, radius, font, taken)


def _number(
    picture: Colour, label: str, centre: tuple[int, int], radius: int, font: float, taken: list[tuple[int, int, int]]
) -> None:
    """Draw a spot's number beside its ring, at the first free corner; none if all are taken.

    taken: left end, baseline and width of the numbers drawn so far; this one is added.
    """
    height, width = picture.shape[:2]
    wide = int(cv2.getTextSize(label, _FONT, font, 1)[0][0])
    for side, down in ((1, -1), (-1, -1), (1, 1), (-1, 1)):
        x = centre[0] + radius + 2 if side > 0 else centre[0] - radius - 2 - wide
        y = centre[1] - radius + 4 if down < 0 else centre[1] + radius + 8
        inside = 0 <= x <= width - wide and 10 <= y < height
        if inside and not any(x < a + w + 3 and a < x + wide + 3 and abs(y - b) < 13 for a, b, w in taken):
            taken.append((x, y, wide))
            cv2.putText(picture, label, (x, y), _FONT, font, (0, 0, 0), 3, cv2.LINE_AA)
            cv2.putText(picture, label, (x, y), _FONT, font, _RING, 1, cv2.LINE_AA)
            return
