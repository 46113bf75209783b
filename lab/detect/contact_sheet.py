"""Many pictures on one sheet, evenly chosen, their contrast stretched, the spots that were found circled."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.pictures.picture_file import Grey
from lab.report.plot.image import grey_limits, stretched
from tracking.detections import Detections

Colour: TypeAlias = NDArray[np.uint8]  # (h, w, 3), BGR

MOST = 24  # pictures on a sheet
# Up to so many pictures: columns, and the width of each, px.
_GRIDS = ((1, 1, 1280), (4, 2, 860), (9, 3, 600), (16, 4, 460), (24, 6, 320))
_STRIP = 22  # px, above each picture, for its words
_GAP = 8
_NUMBERED = 30  # spots of a picture that get a number
_LARGEST_ZOOM = 8
_RING, _PAPER, _INK, _SOFT = (80, 200, 255), (24, 28, 32), (236, 233, 230), (170, 176, 184)
_FONT = cv2.FONT_HERSHEY_SIMPLEX


@dataclass(frozen=True, slots=True)
class _Kept:
    frame: int
    picture: Grey
    found: Detections


@dataclass(slots=True)
class ContactSheet:
    """Offer it every picture; it keeps some, evenly over all.

    total: how many there will be; None: not known, and every second one is given up whenever there are too many.
    """

    total: int | None
    _kept: dict[int, _Kept] = field(default_factory=dict)  # by place in the series
    _stride: int = 1

    def offer(self, place: int, frame: int, picture: Grey, found: Detections) -> None:
        """The picture at this place of the series, from 0, and what was found in it."""
        if self._wants(place):
            self._kept[place] = _Kept(frame, picture.copy(), found)
        if len(self._kept) > MOST:
            self._stride *= 2
            self._kept = {k: kept for k, kept in self._kept.items() if k % self._stride == 0}

    def write(self, path: Path) -> None:
        """Write the sheet as PNG."""
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

    def _wants(self, place: int) -> bool:
        if self.total is None or place >= self.total:
            return place % self._stride == 0
        # Of n pictures the k-th of m is at (n - 1) k / (m - 1), rounded: the first and the last are among them.
        m = min(MOST, self.total)
        k = round(place * (m - 1) / max(self.total - 1, 1))
        return place == round(k * (self.total - 1) / max(m - 1, 1))


def _tile(one: _Kept, width: int, height: int) -> Colour:
    """One picture with its words above it."""
    out: Colour = np.full((_STRIP + height, width, 3), _PAPER, np.uint8)
    spots = f"{len(one.found)} spot{'' if len(one.found) == 1 else 's'}"
    cv2.putText(out, f"frame {one.frame}", (2, 15), _FONT, 0.45, _INK, 1, cv2.LINE_AA)
    wide = cv2.getTextSize(spots, _FONT, 0.45, 1)[0][0]
    cv2.putText(out, spots, (width - wide - 3, 15), _FONT, 0.45, _SOFT, 1, cv2.LINE_AA)
    h, w = one.picture.shape
    scale = min(width / w, height / h, _LARGEST_ZOOM)
    size = (max(round(w * scale), 1), max(round(h * scale), 1))
    grey = stretched(one.picture.astype(np.float32), *grey_limits(one.picture.astype(np.float32)))
    # A maximum keeps spots of few pixels visible where several pixels become one.
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
    """Rings about the spots, the brightest with numbers, those that crowd without."""
    taken: list[tuple[int, int, int]] = []
    font = 0.38 if picture.shape[1] < 400 else 0.5
    for i in range(len(found)):
        # OpenCV's whole pixels are centres; here the picture's edge is at -0.5.
        u, v = ((found.uv_px[i] + 0.5) * scale - 0.5).tolist()
        major = float(found.major_px[i]) if np.isfinite(found.major_px[i]) else 1.0
        radius = round(max(3.5 * major * scale, 5.0 if font < 0.5 else 8.0))
        centre = (round(u), round(v))
        cv2.circle(picture, centre, radius, _RING, 1, cv2.LINE_AA)
        if i < _NUMBERED:
            _number(picture, str(i + 1), centre, radius, font, taken)


def _number(
    picture: Colour, words: str, centre: tuple[int, int], radius: int, font: float, taken: list[tuple[int, int, int]]
) -> None:
    """A spot's number beside its ring, at the first corner that is free; none where all are taken.

    taken: left end, foot and width of the numbers that stand already; this one is added.
    """
    height, width = picture.shape[:2]
    wide = int(cv2.getTextSize(words, _FONT, font, 1)[0][0])
    for side, down in ((1, -1), (-1, -1), (1, 1), (-1, 1)):
        x = centre[0] + radius + 2 if side > 0 else centre[0] - radius - 2 - wide
        y = centre[1] - radius + 4 if down < 0 else centre[1] + radius + 8
        inside = 0 <= x <= width - wide and 10 <= y < height
        if inside and not any(x < a + w + 3 and a < x + wide + 3 and abs(y - b) < 13 for a, b, w in taken):
            taken.append((x, y, wide))
            cv2.putText(picture, words, (x, y), _FONT, font, (0, 0, 0), 3, cv2.LINE_AA)
            cv2.putText(picture, words, (x, y), _FONT, font, _RING, 1, cv2.LINE_AA)
            return
