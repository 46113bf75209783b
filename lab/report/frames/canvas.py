"""A picture that marks and names are drawn on, and the video of such pictures, `overlay.mp4`.

Every mark has a black edge, so that it is visible on any grey value. `report --video` and `track --video` write videos.
"""

from __future__ import annotations

import secrets
import unicodedata
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array, Bools, true_ranges
from lab.errors import RunError
from lab.files.output.part_folder import removed_at_the_end
from lab.report.plot.svg import Box, free_box

Pixels: TypeAlias = NDArray[np.uint8]  # (h, w, 3), BGR
Colour: TypeAlias = tuple[int, int, int]  # BGR

PAPER, DESK, INK, SOFT, BLACK = (28, 24, 22), (14, 12, 11), (240, 237, 234), (182, 174, 168), (0, 0, 0)
FONT = cv2.FONT_HERSHEY_SIMPLEX
_DRAWS_UNICODE = int(cv2.__version__.split(".")[0]) >= 5
_SHIFT = 4  # binary digits of a pixel's fraction
_FAR = 4000.0  # px outside the canvas beyond which nothing is drawn
_TURN = np.linspace(0, 2 * np.pi, 73)
# Where a name is put, in order: right or left, and how far below (+) or above its place.
_SIDES = tuple((dx, dy) for step in range(1, 15, 2) for dx, dy in ((1, -step), (1, step), (-1, -step), (-1, step)))
_KEEP_SPOTS = 0.6  # scale below which a maximum filter keeps small spots visible


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
    scale: float | Array  # pixels of the drawing per pixel of the camera; (2,) where they differ in u and v
    unit: float  # width of a fine line, px of the drawing

    def at(self, uv_px: Array) -> Array:
        """Places (..., 2) in the drawing of pixels of the camera; integers are centres in both."""
        return (np.asarray(uv_px, dtype=float) - self.corner) * self.scale - 0.5

    def holds(self, uv_px: Array) -> bool:
        """Whether a pixel of the camera lies in the drawing; False for nan."""
        x, y = self.at(uv_px)
        h, w = self.image.shape[:2]
        return bool(0 <= x < w and 0 <= y < h)

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

    def box(self, uv_px: Array, radius: float, colour: Colour) -> None:
        """A square about a pixel of the camera; radius: half its side, in units."""
        r = radius * self.unit / self.scale
        self.line(uv_px + r * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]), colour)

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

    def arrow(self, uv_px: Array, colour: Colour) -> tuple[float, float]:
        """An arrowhead at the edge of the drawing towards a pixel outside; returns the place of its name."""
        h, w = self.image.shape[:2]
        at, u = self.at(uv_px), self.unit
        tip = np.clip(at, [2 * u, 2 * u], [w - 2 * u, h - 2 * u])
        along = (at - tip) / max(float(np.linalg.norm(at - tip)), 1e-9)
        across = np.array([-along[1], along[0]])
        foot = tip - 16 * u * along
        corners = np.stack([tip, foot + 7 * u * across, foot - 7 * u * across]).round().astype(np.int32)
        cv2.fillPoly(self.image, [corners], colour, cv2.LINE_AA)
        x, y = foot - 10 * u * along
        return float(x), float(y)

    def label(
        self, at: tuple[float, float], gap: float, words: str, size: float, colour: Colour, taken: list[Box]
    ) -> None:
        """Words beside a place of the drawing, `gap` px from it, where they cover none of the boxes `taken`.

        Their own box is added. Where no place is free, they cover another label.
        """
        h, w = self.image.shape[:2]
        (x, y), (wide, tall) = at, text_size(words, size)
        boxes: list[Box] = []
        for dx, dy in _SIDES:
            left = float(np.clip(x + 1.2 * gap if dx > 0 else x - 1.2 * gap - wide, 3, max(w - wide - 3, 3)))
            base = float(np.clip(y + dy * 0.8 * gap + tall / 2, tall + 3, h - 5))
            boxes.append((left, base - tall, left + wide, base))
        box = free_box(boxes, taken) or boxes[-1]
        self.words((box[0], box[3]), words, size, colour)


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


def ground(grey: Pixels | None, size: tuple[int, int], scale: float) -> Pixels:
    """The picture (h, w, 3) at this (width, height), or an empty one."""
    if grey is None:
        return np.full((size[1], size[0], 3), (40, 36, 34), np.uint8)
    if scale < _KEEP_SPOTS:
        reach = max(round(0.7 / scale), 1)
        grey = np.asarray(cv2.dilate(grey, np.ones((reach, reach), np.uint8)), np.uint8) if reach > 1 else grey
    if (grey.shape[1], grey.shape[0]) != size:
        grey = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST))
    return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), np.uint8)


def png(image: Pixels) -> bytes:
    """The picture as a PNG file."""
    return bytes(cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 6])[1].tobytes())


# The video of annotated pictures, `overlay.mp4`: written by `report --video` and `track --video`.


NAME = "overlay"
# MPEG-4 files are less than half as large as Motion JPEG (38 against 98 kB for a picture of two cameras), which is in
# every OpenCV and serves where one was built without the first.
CODECS = (("mp4v", ".mp4"), ("MJPG", ".avi"))


def write_overlay_video(folder: Path, images: Iterable[NDArray[np.uint8]], fps: float) -> tuple[Path, tuple[str, ...]]:
    """Write pictures (h, w, 3), BGR, of one size with even sides; the file is complete or as it was before.

    fps: frames per second of the video. Returns its path, and notes on codecs that this OpenCV lacks. A video that an
    earlier call wrote with another codec is removed. Raises RunError: OpenCV cannot write a video here, or the disk is
    full.
    """
    pictures = iter(images)
    one = next(pictures)
    notes: list[str] = []
    for codec, suffix in CODECS:
        path, part = folder / f"{NAME}{suffix}", folder / f".{NAME}.{secrets.token_hex(8)}{suffix}"
        with removed_at_the_end(part):
            writer = cv2.VideoWriter(str(part), cv2.VideoWriter.fourcc(*codec), fps, (one.shape[1], one.shape[0]))
            if not writer.isOpened():
                notes.append(f"this OpenCV cannot write {codec} videos ({suffix})")
                continue
            try:
                writer.write(one)
                for image in pictures:
                    writer.write(image)
            finally:
                writer.release()
            if not part.is_file() or not part.stat().st_size:
                raise RunError(f"{path}: the video could not be written; is the disk full?")
            part.replace(path)
        for _, other in CODECS:
            if other != suffix:
                (folder / f"{NAME}{other}").unlink(missing_ok=True)
        return path, tuple(notes)
    raise RunError(
        f"{folder}: no video could be written: {'; '.join(notes)}; install opencv-python-headless from PyPI, or leave"
        " the video out"
    )
