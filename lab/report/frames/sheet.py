"""One picture of a frame: all cameras side by side below a head with the pose, enlarged spots and a legend.

One camera's picture with its marks, and enlarged parts of it around each spot.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np

from lab.number_format import format_count
from lab.report.frames.canvas import (
    DESK,
    INK,
    PAPER,
    SOFT,
    Canvas,
    Colour,
    Pixels,
    bgr,
    ground,
    light,
    text_size,
    write,
)
from lab.report.frames.content import SIGMAS, CameraFrame, DrawnFrame, SpotMark
from lab.report.plot.svg import GREY, POSE_COLOURS, SPOT_COLOURS, YELLOW, grey_limits, stretched
from tracking.statuses import SpotStatus

Limits: TypeAlias = tuple[float, float]  # grey values shown as black and as white

BEAM, BOX, PREDICTED = (200, 170, 120), (215, 210, 205), bgr(YELLOW)
_RING = 9.0  # units
_CUT_MOST, _CUT_LEAST = 64.0, 10.0  # px: half the side of an enlarged part


def colour_of(status: SpotStatus | None) -> Colour:
    """The colour of a status, as in the report."""
    return bgr(GREY if status is None else SPOT_COLOURS[status])


def status_words(mark: SpotMark) -> str:
    """The name and the status of a spot, with the label's probability where it is doubtful."""
    words = "not in the results" if mark.status is None else str(mark.status).replace("_", " ")
    doubt = f" (p {mark.label_probability:.2f})" if mark.label_probability < 0.995 else ""
    return f"{mark.spot} {words}{doubt}"


def grey_picture(camera: CameraFrame, limits: Limits | None = None) -> Pixels | None:
    """The picture with stretched contrast (h, w), or None without one. limits: None: those of the picture."""
    if camera.picture is None:
        return None
    return stretched(camera.picture, *(limits or grey_limits(camera.picture)))


def panel(camera: CameraFrame, grey: Pixels | None, width: int, unit: float, size: float) -> Pixels:
    """The whole picture of a camera, `width` px wide, with all marks. size: height of a line of text, px."""
    w, h = camera.size_px
    scale = width / w
    height = max(round(h * scale), 1)
    canvas = Canvas(ground(grey, (width, height), scale), np.array([-0.5, -0.5]), scale, unit)
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


def _tracks(canvas: Canvas, mark: SpotMark) -> None:
    """The beam's image, where the spot can lie, and the past of the spot."""
    if len(mark.beam_px):
        canvas.line(mark.beam_px, BEAM, 2.0, dash=7.0)
    if len(mark.track_px):
        canvas.line(mark.track_px, colour_of(mark.status), 2.0)
    if len(mark.tail_px) > 1:
        canvas.line(mark.tail_px, colour_of(mark.status), 1.0)


def _spot(canvas: Canvas, mark: SpotMark, ring: float) -> None:
    """The prediction and the place of a spot with their ellipses."""
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


def _names(canvas: Canvas, marks: tuple[SpotMark, ...], size: float) -> None:
    """The names of the spots beside their rings or arrows, where they cover neither each other nor another ring."""
    h, w = canvas.image.shape[:2]
    ring = (_RING + 3) * canvas.unit
    shown = [m for m in marks if np.isfinite(m.uv_px).all()]
    taken = [(x - ring, y - ring, x + ring, y + ring) for x, y in (canvas.at(m.uv_px).tolist() for m in shown)]
    for mark in shown:
        measured = mark.status is not None and mark.status.measured
        words = mark.spot if measured and not mark.label_probability < 0.995 else status_words(mark)
        x, y = canvas.at(mark.uv_px).tolist()
        if not canvas.holds(mark.uv_px):
            edge = np.clip([x, y], 0, [w, h]) / canvas.scale + canvas.corner
            words = f"{words}, {np.linalg.norm(mark.uv_px - edge):.0f} px outside"
            x, y = canvas.arrow(mark.uv_px, colour_of(mark.status))
        canvas.label((x, y), ring, words, size, INK, taken)


def _fitting(words: str, width: int, size: float) -> str:
    """The words, cut to a width."""
    while len(words) > 4 and text_size(words, size)[0] > width - 4:
        words = words[:-3].rstrip(" .") + ".."
    return words


_GAP = 10  # px between parts
_LINE = 16.0  # px, height of a line of text
# Width of each camera's picture, px, by the number of cameras: small pictures are enlarged to the first,
# large ones reduced to the second; between them they keep their size.
_WIDTHS = {1: (960, 1600), 2: (760, 1280)}
_WIDTHS_OF_MORE = (600, 800)
_LARGEST_ZOOM = 12.0


@dataclass(frozen=True, slots=True)
class Layout:
    """The sizes of a sheet's parts, the same for all frames of a recording."""

    columns: int
    widths: tuple[int, ...]  # of the cameras' pictures, px
    unit: float  # width of a fine line, px
    line: float  # height of a line of text, px

    @staticmethod
    def of(sizes_px: list[tuple[int, int]], small: bool = False) -> Layout:
        """The layout for pictures of these (width, height). small: for a video, at most 960 px per camera."""
        n = len(sizes_px)
        least, most = _WIDTHS.get(n, _WIDTHS_OF_MORE)
        if small:
            most = min(most, 960)
            least = min(least, most)
        widths = []
        for w, h in sizes_px:
            wide = float(np.clip(w, min(least, _LARGEST_ZOOM * w), most))
            wide = min(wide, 1.6 * most * w / h)  # tall pictures are limited by their height
            widths.append(max(round(wide), 16))
        unit = 1.5 if max(widths) > 1100 else 1.0
        return Layout(min(n, 2 if n < 5 else 3), tuple(widths), unit, _LINE * unit)


def sheet(
    content: DrawnFrame,
    layout: Layout,
    cuts: bool = True,
    limits: Mapping[str, Limits] | None = None,
    same_size: str = "",
) -> Pixels:
    """The picture (h, w, 3), 8 bit, BGR.

    cuts: with an enlarged part for each spot. limits: the grey values shown as black and white, by camera; those of
    each picture where they are not given. same_size: for a video: the longest text of a pose; head and legend then have
    the same size in all frames.
    """
    known = {} if limits is None else limits
    blocks = [
        _camera_block(camera, layout.widths[i], layout, cuts, known.get(camera.camera))
        for i, camera in enumerate(content.cameras)
    ]
    rows = [blocks[k : k + layout.columns] for k in range(0, len(blocks), layout.columns)]
    wide = max(sum(b.shape[1] + _GAP for b in row) for row in rows) + _GAP
    wide = max(wide, round(40 * layout.line))
    parts = [_head(content, wide, layout, same_size)]
    for row in rows:
        tall = max(b.shape[0] for b in row)
        strip: Pixels = np.full((tall + _GAP, wide, 3), DESK, np.uint8)
        x = _GAP
        for b in row:
            strip[: b.shape[0], x : x + b.shape[1]] = b
            x += b.shape[1] + _GAP
        parts.append(strip)
    parts.append(_legend(content, wide, layout, bool(same_size)))
    return np.concatenate(parts)


def _head(content: DrawnFrame, wide: int, layout: Layout, longest: str) -> Pixels:
    """Frame number, time, name of the run and pose, with room for the longest text of a pose."""
    line = layout.line
    when = f"   t = {content.t_s:.4f} s" if np.isfinite(content.t_s) else ""
    status = content.pose_status
    state = "no row in the results" if status is None else str(status)
    room = wide - 4 * _GAP - text_size("predicted   ", line, bold=True)[0]
    lines = _wrapped(content.pose_words, room, line)
    rows = len(_wrapped(longest, room, line)) if longest else len(lines)
    out: Pixels = np.full((round((2.0 + 1.35 * rows) * line) + _GAP, wide, 3), DESK, np.uint8)
    write(out, (_GAP, 1.5 * line), f"frame {content.frame}{when}   {content.name}", 1.15 * line, INK, bold=False)
    colour = SOFT if status is None else light(bgr(POSE_COLOURS[status]))
    write(out, (_GAP, 2.9 * line), state, line, colour, bold=True)
    x = _GAP + text_size(state + "   ", line, bold=True)[0]
    for k, words in enumerate(lines):
        write(out, (x, (2.9 + 1.35 * k) * line), words, line, INK)
    return out


def _wrapped(words: str, wide: int, line: float) -> list[str]:
    """Words in lines of a width, broken at triple spaces."""
    lines: list[str] = []
    for part in words.split("   "):
        joined = f"{lines[-1]}   {part}" if lines else part
        if lines and text_size(joined, line)[0] <= wide:
            lines[-1] = joined
        else:
            lines.append(part)
    return lines


def _camera_block(camera: CameraFrame, wide: int, layout: Layout, cuts: bool, limits: Limits | None) -> Pixels:
    """A camera's caption, picture and enlarged spots."""
    line, unit = layout.line, layout.unit
    grey = grey_picture(camera, limits)
    measured = sum(m.status is not None and m.status.measured for m in camera.marks)
    n = len(camera.detections)
    words = f"{camera.camera}: {measured} of {len(camera.marks)} spots measured, {format_count(n, 'detection')}"
    caption: Pixels = np.full((round(1.5 * line), wide, 3), PAPER, np.uint8)
    write(caption, (4, 1.05 * line), words, line)
    parts = [caption, panel(camera, grey, wide, unit, line)]
    if cuts and camera.marks:
        side = round(144 * unit)
        per_row = max((wide + 6) // (side + 6), 1)
        if per_row == 1:
            side = wide
        tiles = [cut(camera, grey, mark, side, unit, 0.85 * line) for mark in camera.marks]
        for k in range(0, len(tiles), per_row):
            strip: Pixels = np.full((tiles[0].shape[0] + 6, wide, 3), PAPER, np.uint8)
            for i, tile in enumerate(tiles[k : k + per_row]):
                strip[6:, i * (side + 6) : i * (side + 6) + side] = tile
            parts.append(strip)
    return np.concatenate(parts)


def _legend(content: DrawnFrame, wide: int, layout: Layout, whole: bool) -> Pixels:
    """What the marks mean. whole: also those that are not drawn in this frame."""
    line, unit = layout.line, layout.unit
    marks = [m for c in content.cameras for m in c.marks]
    present = set(SpotStatus) if whole else {m.status for m in marks if m.status is not None}
    out = _Flow(wide, line, unit)
    out.add("detection", lambda c, at: c.box(at, 4.5, BOX))
    for status in SpotStatus:
        if status in present and status != SpotStatus.LOST:
            dash = 0.0 if status.measured else 4.0
            out.add(str(status).replace("_", " "), _ring_of(colour_of(status), dash))
    if whole or any(np.isfinite(m.predicted_px).all() for m in marks):
        out.add("predicted; ellipse: 3 sigma of its predictions nearby", _predicted)
    if whole or any(len(m.track_px) for m in marks):
        out.add("where the spot can lie (3 sigma of the pose)", _line_of(SOFT, 2.0, 0.0))
    if whole or any(len(m.beam_px) for m in marks):
        moved = not whole and content.beams_of_frame is not None and content.beams_of_frame != content.frame
        whose = f", with the pose of frame {content.beams_of_frame}" if moved else ""
        out.add(f"image of its beam, for a screen nearer or farther{whose}", _line_of(BEAM, 1.0, 7.0))
    return out.image()


def _ring_of(colour: Colour, dash: float) -> Callable[[Canvas, np.ndarray], None]:
    return lambda c, at: c.ring(at, 8.0, colour, 2.0, dash)


def _line_of(colour: Colour, width: float, dash: float) -> Callable[[Canvas, np.ndarray], None]:
    return lambda c, at: c.line(at + np.array([[-11.0, 0], [11, 0]]) * c.unit, colour, width, dash)


def _predicted(c: Canvas, at: np.ndarray) -> None:
    c.cross(at, 4.5, PREDICTED)
    c.ellipse(at, np.diag([9.0, 5.0]) * c.unit**2, 3.0, PREDICTED)


class _Flow:
    """Symbols with words, in as many rows as they need."""

    def __init__(self, wide: int, line: float, unit: float) -> None:
        self._wide, self._line, self._unit = wide, line, unit
        self._items: list[tuple[float, int, str, Callable[[Canvas, np.ndarray], None]]] = []
        self._x, self._row = float(_GAP), 0

    def add(self, words: str, symbol: Callable[[Canvas, np.ndarray], None]) -> None:
        """A symbol and its meaning."""
        width = 30 * self._unit + text_size(words, self._line)[0] + 24 * self._unit
        if self._x > _GAP and self._x + width > self._wide:
            self._x, self._row = float(_GAP), self._row + 1
        self._items.append((self._x, self._row, words, symbol))
        self._x += width

    def image(self) -> Pixels:
        """The rows (h, w, 3)."""
        tall = 1.6 * self._line
        out: Pixels = np.full((round(tall * (self._row + 1)) + _GAP, self._wide, 3), DESK, np.uint8)
        canvas = Canvas(out, np.zeros(2), 1.0, self._unit)
        for x, row, words, symbol in self._items:
            y = tall * (row + 0.5) + _GAP / 2
            symbol(canvas, np.array([x + 13 * self._unit, y]))
            write(out, (x + 30 * self._unit, y + 0.3 * self._line), words, self._line, SOFT)
        return out
