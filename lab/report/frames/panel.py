"""One camera's picture with its marks, and enlarged parts of it around each spot."""

from __future__ import annotations

from typing import TypeAlias

import cv2
import numpy as np

from lab.pictures.picture_file import GreyPicture
from lab.report.frames.canvas import INK, PAPER, SOFT, Canvas, Colour, Pixels, bgr, ground, light, text_size, write
from lab.report.frames.content import SIGMAS, CameraFrame, SpotMark
from lab.report.plot.axes import GREY, SPOT_COLOURS, YELLOW
from lab.report.plot.image import grey_limits, stretched
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
