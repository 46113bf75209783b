"""One camera's picture with its marks, and the canvas that they are drawn on."""

from __future__ import annotations

import unicodedata
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.arrays import Array, Bools
from lab.pictures.picture_file import GreyPicture
from lab.report.plot.axes import GREY, YELLOW, true_ranges
from lab.report.plot.image import grey_limits, stretched
from lab.report.run.tracks import SPOT_COLOURS
from lab.results.show.data import SIGMAS, CameraFrame, SpotMark
from tracking.statuses import SpotStatus

# Lines, rings and words drawn on pictures. Every mark has a black edge, so that it is visible on any grey value.

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


# One camera's picture with its marks, and enlarged parts of it around each spot.


Limits: TypeAlias = tuple[float, float]  # grey values shown as black and as white

BEAM, BOX, PREDICTED = (200, 170, 120), (215, 210, 205), bgr(YELLOW)
_RING = 9.0  # units
_CUT_MOST, _CUT_LEAST = 64.0, 10.0  # px: half the side of an enlarged part
# Where a name is put, in order: right or left, and how far below (+) or above its spot.
_SIDES = tuple((dx, dy) for step in range(1, 15, 2) for dx, dy in ((1, -step), (1, step), (-1, -step), (-1, step)))
_KEEP_SPOTS = 0.6  # scale below which a maximum filter keeps small spots visible


def colour_of(status: SpotStatus | None) -> Colour:
    """The colour of a status, as in the report."""
    return bgr(GREY if status is None else SPOT_COLOURS[status])


def status_words(mark: SpotMark) -> str:
    """The name and the status of a spot, with the label's probability where it is doubtful."""
    words = "not in the results" if mark.status is None else str(mark.status).replace("_", " ")
    doubt = f" (p {mark.label_probability:.2f})" if mark.label_probability < 0.995 else ""
    return f"{mark.spot} {words}{doubt}"


def limits_of(picture: GreyPicture) -> Limits:
    """The grey values of a picture that are shown as black and as white."""
    return grey_limits(picture)


def grey_picture(camera: CameraFrame, limits: Limits | None = None) -> Pixels | None:
    """The picture with stretched contrast (h, w), or None without one. limits: None: those of the picture."""
    if camera.picture is None:
        return None
    low, high = limits_of(camera.picture) if limits is None else limits
    return stretched(camera.picture, low, high)


def panel(camera: CameraFrame, grey: Pixels | None, width: int, unit: float, size: float) -> Pixels:
    """The whole picture of a camera, `width` px wide, with all marks. size: height of a line of text, px."""
    w, h = camera.size_px
    scale = width / w
    height = max(round(h * scale), 1)
    canvas = Canvas(_ground(grey, (width, height), scale), np.array([-0.5, -0.5]), scale, unit)
    if grey is None:
        canvas.words((10 * unit, size + 6 * unit), camera.reason, size, SOFT)
    for uv in camera.detections:
        canvas.box(uv, 4.5, BOX)
    for mark in camera.marks:
        _tracks(canvas, mark)
    for mark in camera.marks:
        _spot(canvas, mark, _RING)
    _names(canvas, camera.marks, size)
    return canvas.image


def cut(camera: CameraFrame, grey: Pixels | None, mark: SpotMark, side: int, unit: float, size: float) -> Pixels:
    """The part of a picture around one spot, `side` px wide, below its name and status."""
    head = round(2.5 * size)
    out: Pixels = np.full((head + side, side, 3), PAPER, np.uint8)
    write(out, (2, 0.9 * size), _fitting(status_words(mark), side, size), size, light(colour_of(mark.status)))
    w, h = camera.size_px
    if not (np.isfinite(mark.uv_px).all() and 0 <= mark.uv_px[0] <= w - 1 and 0 <= mark.uv_px[1] <= h - 1):
        return out
    half = _half_side(mark, min(w, h) / 2)
    away = float(np.linalg.norm(mark.uv_px - mark.predicted_px))
    measured = mark.status is not None and mark.status.measured
    words = f"{away:.2g} px off" if measured and np.isfinite(away) else f"{2 * half:.0f} px wide"
    write(out, (2, 2.0 * size), _fitting(words, side, size), 0.9 * size, SOFT)
    corner = np.clip(mark.uv_px - half, -0.5, np.array([w, h]) - 0.5 - 2 * half)
    scale = side / (2 * half)
    ground: Pixels = np.full((side, side, 3), (40, 36, 34), np.uint8)
    if grey is not None:
        # The drawing's pixel k shows the camera's corner + (k + 0.5) / scale.
        moved = np.array([[1 / scale, 0, corner[0] + 0.5 / scale], [0, 1 / scale, corner[1] + 0.5 / scale]])
        flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
        part = cv2.warpAffine(grey, moved, (side, side), flags=flags, borderMode=cv2.BORDER_REPLICATE)
        ground = np.asarray(cv2.cvtColor(part, cv2.COLOR_GRAY2BGR), np.uint8)
    canvas = Canvas(ground, corner, scale, unit)
    for uv in camera.detections:
        if canvas.holds(uv):
            canvas.box(uv, 17, BOX)
    _tracks(canvas, mark)
    _spot(canvas, mark, 26.0)
    out[head:] = canvas.image
    return out


def _half_side(mark: SpotMark, most: float) -> float:
    """Half the side, px, of the part that shows a spot's ellipses."""
    reach = _CUT_LEAST
    for cov, at in ((mark.cov_px2, mark.uv_px), (mark.predicted_cov_px2, mark.predicted_px)):
        if np.isfinite(cov).all() and np.isfinite(at).all():
            off = float(np.linalg.norm(at - mark.uv_px))
            reach = max(reach, 1.2 * (off + SIGMAS * float(np.sqrt(max(np.linalg.eigvalsh(cov)[-1], 0.0)))))
    return float(min(reach, _CUT_MOST, most))


def _ground(grey: Pixels | None, size: tuple[int, int], scale: float) -> Pixels:
    """The picture (h, w, 3) at this (width, height), or an empty one."""
    if grey is None:
        return np.full((size[1], size[0], 3), (40, 36, 34), np.uint8)
    if scale < _KEEP_SPOTS:
        reach = max(round(0.7 / scale), 1)
        grey = np.asarray(cv2.dilate(grey, np.ones((reach, reach), np.uint8)), np.uint8) if reach > 1 else grey
    if (grey.shape[1], grey.shape[0]) != size:
        grey = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST))
    return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), np.uint8)


def _tracks(canvas: Canvas, mark: SpotMark) -> None:
    """The beam's image, where the spot can lie, and the past of the spot."""
    if len(mark.beam_px):
        canvas.line(mark.beam_px, BEAM, 2.0, dash=7.0)
    if len(mark.track_px):
        canvas.line(mark.track_px, colour_of(mark.status), 2.0)
    if len(mark.tail_px) > 1:
        canvas.line(mark.tail_px, colour_of(mark.status), 1.0)


def _spot(canvas: Canvas, mark: SpotMark, ring: float) -> None:
    """The prediction and the place of a spot with their ellipses, or an arrow towards a place outside."""
    if np.isfinite(mark.predicted_px).all():
        canvas.ellipse(mark.predicted_px, mark.predicted_cov_px2, SIGMAS, PREDICTED)
        canvas.cross(mark.predicted_px, 0.5 * ring, PREDICTED)
    if not np.isfinite(mark.uv_px).all():
        return
    colour, measured = colour_of(mark.status), mark.status is not None and mark.status.measured
    if not measured:
        canvas.ellipse(mark.uv_px, mark.cov_px2, SIGMAS, colour)
    if canvas.holds(mark.uv_px):
        canvas.ring(mark.uv_px, ring, colour, 2.0, 0.0 if measured else 4.0)
    else:
        _arrow(canvas, mark.uv_px, colour)


def _arrow(canvas: Canvas, uv_px: Array, colour: Colour) -> Array:
    """An arrowhead at the edge of the drawing towards a place outside; returns its foot (2,) in the drawing."""
    h, w = canvas.image.shape[:2]
    at, u = canvas.at(uv_px), canvas.unit
    tip = np.clip(at, [2 * u, 2 * u], [w - 2 * u, h - 2 * u])
    along = (at - tip) / max(float(np.linalg.norm(at - tip)), 1e-9)
    across = np.array([-along[1], along[0]])
    foot = tip - 16 * u * along
    corners = np.stack([tip, foot + 7 * u * across, foot - 7 * u * across]).round().astype(np.int32)
    cv2.fillPoly(canvas.image, [corners], colour, cv2.LINE_AA)
    return np.asarray(foot)


def _inwards(at: Array, w: int, h: int) -> Array:
    """The unit vector (2,) from a place outside a drawing of this size to its nearest point inside."""
    inside = np.clip(at, 0, [w, h])
    return np.asarray((inside - at) / max(float(np.linalg.norm(inside - at)), 1e-9))


def _names(canvas: Canvas, marks: tuple[SpotMark, ...], size: float) -> None:
    """The names of the spots beside their rings, where they cover neither each other nor another ring."""
    h, w = canvas.image.shape[:2]
    u = canvas.unit
    places = [canvas.at(m.uv_px) for m in marks]
    ring = (_RING + 3) * u
    taken = [(x - ring, y - ring, x + ring, y + ring) for x, y in places if np.isfinite([x, y]).all()]
    for mark, (x, y) in zip(marks, places, strict=True):
        if not np.isfinite([x, y]).all():
            continue
        measured = mark.status is not None and mark.status.measured
        words = mark.spot if measured and not mark.label_probability < 0.995 else status_words(mark)
        if not canvas.holds(mark.uv_px):
            gap = np.linalg.norm(
                mark.uv_px - (np.clip(canvas.at(mark.uv_px), 0, [w, h]) / canvas.scale + canvas.corner)
            )
            words = f"{words}, {gap:.0f} px outside"
        wide, tall = text_size(words, size)
        if not canvas.holds(mark.uv_px):  # beside the arrow
            x, y = (np.clip([x, y], 0, [w, h]) + 26 * u * _inwards(np.array([x, y]), w, h)).tolist()
        best = (0.0, 0.0)
        for dx, dy in _SIDES:
            left = x + 1.2 * ring if dx > 0 else x - 1.2 * ring - wide
            base = y + dy * 0.8 * ring + tall / 2
            best = (float(np.clip(left, 3, max(w - wide - 3, 3))), float(np.clip(base, tall + 3, h - 5)))
            box = (best[0], best[1] - tall, best[0] + wide, best[1])
            if not any(box[0] < t[2] and box[2] > t[0] and box[1] < t[3] and box[3] > t[1] for t in taken):
                break
        taken.append((best[0], best[1] - tall, best[0] + wide, best[1]))
        canvas.words(best, words, size, INK)


def _fitting(words: str, width: int, size: float) -> str:
    """The words, cut to a width."""
    while len(words) > 4 and text_size(words, size)[0] > width - 4:
        words = words[:-3].rstrip(" .") + ".."
    return words
