"""Lines, rings and words drawn on pictures. Every mark has a black edge, so that it is visible on any grey value."""

from __future__ import annotations

import unicodedata
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array, Bools
from lab.report.plot.thinning import true_ranges

Pixels: TypeAlias = NDArray[np.uint8]  # (h, w, 3), BGR
Colour: TypeAlias = tuple[int, int, int]  # BGR

PAPER, DESK, INK, SOFT, BLACK = (28, 24, 22), (14, 12, 11), (240, 237, 234), (182, 174, 168), (0, 0, 0)
FONT = cv2.FONT_HERSHEY_SIMPLEX
_DRAWS_UNICODE = int(cv2.__version__.split(".")[0]) >= 5
_SHIFT = 4  # binary digits of a pixel's fraction
_FAR = 4000.0  # px outside the canvas beyond which nothing is drawn
_TURN = np.linspace(0, 2 * np.pi, 73)


def bgr(colour: str) -> Colour:
    """A colour `#rrggbb` as OpenCV wants it."""
    return int(colour[5:7], 16), int(colour[3:5], 16), int(colour[1:3], 16)


def light(colour: Colour) -> Colour:
    """A lighter shade, for words on a black ground."""
    b, g, r = (round(c + 0.4 * (255 - c)) for c in colour)
    return b, g, r


def plain(words: str) -> str:
    """Words that this OpenCV can draw: before version 5 letters lose their accents, and others become `?`."""
    if not _DRAWS_UNICODE:
        words = "".join(c for c in unicodedata.normalize("NFKD", words) if not unicodedata.combining(c))
    return "".join(c if " " <= c <= "~" or (_DRAWS_UNICODE and c.isprintable()) else "?" for c in words)


def text_size(words: str, size: float, bold: bool = False) -> tuple[int, int]:
    """Width and height, px, of drawn words; size: height of a line, px."""
    (w, _), _ = cv2.getTextSize(plain(words), FONT, size / 26.0, 2 if bold else 1)
    return int(w), round(0.62 * size)


def write(
    image: Pixels, at: tuple[float, float], words: str, size: float, colour: Colour = INK, bold: bool = False
) -> None:
    """Draw words; at: left end of the base line."""
    place, thick = (round(at[0]), round(at[1])), 2 if bold else 1
    cv2.putText(image, plain(words), place, FONT, size / 26.0, colour, thick, cv2.LINE_AA)


@dataclass(frozen=True, slots=True)
class Canvas:
    """A drawing whose coordinates are the pixels of a camera's picture."""

    image: Pixels
    corner: Array  # (2,), px of the camera: its upper left edge
    scale: float  # pixels of the drawing per pixel of the camera
    unit: float  # width of a fine line, px of the drawing

    def at(self, uv_px: Array) -> Array:
        """Places (..., 2) in the drawing of pixels of the camera; integers are centres in both."""
        return (np.asarray(uv_px, dtype=float) - self.corner) * self.scale - 0.5

    def holds(self, uv_px: Array, margin: float = 0.0) -> bool:
        """Whether a pixel of the camera lies in the drawing; False for nan."""
        x, y = self.at(uv_px)
        h, w = self.image.shape[:2]
        return bool(-margin <= x < w + margin and -margin <= y < h + margin)

    def line(self, uv_px: Array, colour: Colour, width: float = 1.0, dash: float = 0.0) -> None:
        """A line through pixels of the camera (n, 2), interrupted at nan. dash: length of its dashes; 0: none."""
        places = self.at(uv_px).reshape(-1, 2)
        h, w = self.image.shape[:2]
        with np.errstate(invalid="ignore"):
            near: Bools = np.all((places > -_FAR) & (places < [w + _FAR, h + _FAR]), axis=1)
        pieces = [places[a:b] for a, b in true_ranges(near) if b - a > 1]
        if dash > 0:
            pieces = [p for piece in pieces for p in _dashes(piece, dash * self.unit)]
        fixed = [np.round(p * 2**_SHIFT).astype(np.int32) for p in pieces]
        thick = max(round(width * self.unit), 1)
        for tone, wide in ((BLACK, thick + 2), (colour, thick)):
            cv2.polylines(self.image, fixed, False, tone, wide, cv2.LINE_AA, _SHIFT)

    def ring(self, uv_px: Array, radius: float, colour: Colour, width: float = 1.0, dash: float = 0.0) -> None:
        """A circle of this radius, in units, about a pixel of the camera."""
        reach = radius * self.unit / self.scale
        self.line(uv_px + reach * np.stack([np.cos(_TURN), np.sin(_TURN)], axis=1), colour, width, dash)

    def box(self, uv_px: Array, radius: float, colour: Colour, width: float = 1.0) -> None:
        """A square about a pixel of the camera; radius: half its side, in units."""
        r = radius * self.unit / self.scale
        self.line(uv_px + r * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]), colour, width)

    def cross(self, uv_px: Array, radius: float, colour: Colour, width: float = 1.0) -> None:
        """A diagonal cross on a pixel of the camera; radius in units."""
        r = radius * self.unit / self.scale
        arms = np.array([[-1, -1], [1, 1], [np.nan, np.nan], [-1, 1], [1, -1]])
        self.line(uv_px + r * arms, colour, width)

    def ellipse(
        self, uv_px: Array, cov_px2: Array, sigmas: float, colour: Colour, width: float = 1.0, dash: float = 0.0
    ) -> None:
        """The ellipse of so many sigmas of a covariance (2, 2), px^2; nothing where it is unknown."""
        if not (np.isfinite(cov_px2).all() and np.isfinite(uv_px).all()):
            return
        values, vectors = np.linalg.eigh(cov_px2)
        axes = vectors * np.sqrt(np.maximum(values, 0.0))
        self.line(uv_px + sigmas * np.stack([np.cos(_TURN), np.sin(_TURN)], axis=1) @ axes.T, colour, width, dash)

    def words(self, xy: tuple[float, float], words: str, size: float, colour: Colour) -> None:
        """Words with a black edge at a place of the drawing: left end of the base line."""
        x, y = round(xy[0]), round(xy[1])
        # A thicker black text would have wider letters in OpenCV 5.
        for tone, places in ((BLACK, [(x + a, y + b) for a in (-1, 0, 1) for b in (-1, 0, 1)]), (colour, [(x, y)])):
            for place in places:
                cv2.putText(self.image, plain(words), place, FONT, size / 26.0, tone, 1, cv2.LINE_AA)


def _dashes(places: Array, length: float) -> list[Array]:
    """The dashes of a line (n, 2): as long as the gaps between them."""
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    total = float(along[-1])
    if total <= length:
        return [places]
    out = []
    for start in np.arange(0.0, total, 2 * length):
        end = min(start + length, total)
        inner = along[(along > start) & (along < end)]
        s = np.concatenate([[start], inner, [end]])
        out.append(np.stack([np.interp(s, along, places[:, 0]), np.interp(s, along, places[:, 1])], axis=1))
    return out
