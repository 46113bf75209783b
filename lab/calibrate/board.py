"""`calibrate board`: writes a calibration board for printing, with its description.

Page with a calibration board to print: layout in millimetres, and output as PDF, SVG or PNG at exact scale.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from xml.sax.saxutils import escape

import cv2
import numpy as np

from calibration.boards.board_drawing import BoardShapes, Layer, draw
from calibration.boards.board_types import Board, Charuco
from geometry.arrays import Array
from lab.errors import InputError
from lab.files.rig.board_file import load_board, load_board_or_text, save_board
from lab.files.text.atomic_write import atomic_folder, atomic_write_bytes
from lab.files.text.error_text import suggest_name
from lab.findings.finding import Done

PAGES_MM = {"A4": (210.0, 297.0), "A3": (297.0, 420.0)}  # width, height in portrait; landscape is used as well
FIT = "fit"  # a page of the size that the board needs
MARGIN_MM = 10.0  # border that printers cannot print on
_FOOTER_MM = 14.0  # height under the board for scale bar and caption: 9x6 corners of 25 mm just fit on A4
_BAR_MM = 100.0  # length of the scale bar
_DATE = datetime(2000, 1, 1, tzinfo=UTC)
_FONT_MM = 3.2  # font size of the caption
_LINE_MM = 1.4 * _FONT_MM  # distance between the caption's baselines


@dataclass(frozen=True, slots=True)
class Page:
    """Layout of a page, mm from its top left corner, y down."""

    size_mm: tuple[float, float]
    drawing: BoardShapes
    board_at_mm: Array  # (2,) top left corner of the printed area
    bar_mm: tuple[float, float, float]  # left, top, length
    caption: tuple[str, ...]
    caption_at_mm: tuple[float, float]  # start of the first baseline
    name: str  # page format and orientation, for messages

    def rectangles_mm(self, layer: Layer) -> Array:
        """Rectangles of a layer (n, 4): left, top, width, height."""
        return layer.rectangles * 1000.0 + np.array([*self.board_at_mm, 0.0, 0.0])

    def circles_mm(self, layer: Layer) -> Array:
        """Circles of a layer (n, 3): centre x, y, radius."""
        return layer.circles * 1000.0 + np.array([*self.board_at_mm, 0.0])

    def bar_parts_mm(self) -> Array:
        """The scale bar and its two end marks (3, 4): left, top, width, height."""
        left, top, length = self.bar_mm
        return np.array([[left, top + 1.5, length, 0.4], [left, top, 0.2, 3.4], [left + length - 0.2, top, 0.2, 3.4]])

    def caption_lines_mm(self) -> list[tuple[float, float, str]]:
        """Start of the baseline (x, y) and text of each line of the caption."""
        x, y = self.caption_at_mm
        return [(x, y + _LINE_MM * i, line) for i, line in enumerate(self.caption)]


def lay_out(board: Board, page: str = "A4") -> Page:
    """Centre a board on a page.

    Raises InputError: for an unknown page format or a board that does not fit on the page.
    """
    drawing = draw(board)
    wide, high = (1000.0 * side for side in drawing.size_m)
    caption = (f"{board.describe()}   beampose", f"the bar is {_BAR_MM:.0f} mm: print at 100 %, then measure it")
    if page == FIT:
        size = (max(wide, _BAR_MM) + 2 * MARGIN_MM, high + 2 * MARGIN_MM + _FOOTER_MM)
        return _centred(drawing, size, caption, FIT)
    portrait = PAGES_MM.get(page.upper())
    if portrait is None:
        raise InputError(f"page: expected {', '.join(PAGES_MM)} or {FIT}, got {page!r}")
    landscape = portrait[::-1]
    sizes = [portrait, landscape] if high >= wide else [landscape, portrait]
    for size in sizes:
        if wide <= size[0] - 2 * MARGIN_MM and high <= size[1] - 2 * MARGIN_MM - _FOOTER_MM:
            orientation = "portrait" if size == portrait else "landscape"
            return _centred(drawing, size, caption, f"{page.upper()} {orientation}")
    share = max(min((w - 2 * MARGIN_MM) / wide, (h - 2 * MARGIN_MM - _FOOTER_MM) / high) for w, h in sizes)
    spacing_mm = np.floor(10_000.0 * board.spacing_m * share) / 10
    raise InputError(
        f"{board.describe()}: {wide:.0f} x {high:.0f} mm do not fit on {page.upper()}; use"
        f" {_larger_page(page, wide, high)}, or reduce the {1000 * board.spacing_m:g} mm to {spacing_mm:.1f} mm"
    )


def _larger_page(page: str, wide: float, high: float) -> str:
    """The page formats on which a board of this size (mm) fits, in words."""
    w, h = PAGES_MM["A3"]
    room = sorted((w - 2 * MARGIN_MM, h - 2 * MARGIN_MM - _FOOTER_MM))
    fits = page.upper() != "A3" and max(wide, high) <= room[1] and min(wide, high) <= room[0] - _FOOTER_MM
    return f"A3 or {FIT} (a page of the board's size)" if fits else f"{FIT} (a page of the board's size)"


def _centred(drawing: BoardShapes, size: tuple[float, float], caption: tuple[str, ...], name: str) -> Page:
    wide, high = (1000.0 * side for side in drawing.size_m)
    footer = size[1] - MARGIN_MM - _FOOTER_MM
    at = np.array([(size[0] - wide) / 2, MARGIN_MM + (footer - MARGIN_MM - high) / 2])
    return Page(size, drawing, at, (MARGIN_MM, footer + 2.0, _BAR_MM), caption, (MARGIN_MM, footer + 9.0), name)


# PDF ------------------------------------------------------------------------------------------------------------


def as_pdf(page: Page) -> bytes:
    """The page as vector PDF that viewers print unscaled. One path per layer: touching squares show no hairlines.

    Coordinates are in points with four decimals (4e-5 mm). A circle is four Bezier curves, which deviate by less than
    3e-4 of its radius, the same on every side.
    """
    from fpdf import FPDF, ViewerPreferences  # imported here: only PDF output needs it, and it takes 0.7 s
    from fpdf.enums import PathPaintRule

    pt = 72 / 25.4  # points per mm
    w, h = page.size_mm
    pdf = FPDF(unit="pt", format=(w * pt, h * pt))
    pdf.viewer_preferences = ViewerPreferences(print_scaling="None")
    pdf.set_creation_date(_DATE)  # the same board gives the same bytes
    pdf.add_page()
    layers = [(x.is_black, page.rectangles_mm(x), page.circles_mm(x)) for x in page.drawing.layers]
    for black, rectangles, circles in [*layers, (True, page.bar_parts_mm(), np.empty((0, 3)))]:
        with pdf.new_path() as path:
            path.style.fill_color = "#000" if black else "#fff"
            path.style.stroke_color = None
            path.style.paint_rule = PathPaintRule.FILL_NONZERO
            for left, top, width, height in (rectangles * pt).tolist():
                path.rectangle(left, top, width, height)
            for x, y, radius in (circles * pt).tolist():
                path.circle(x, y, radius)
    pdf.set_font("helvetica", size=_FONT_MM * pt)
    for x, y, line in page.caption_lines_mm():
        pdf.text(x * pt, y * pt, line)
    return bytes(pdf.output())


# SVG ------------------------------------------------------------------------------------------------------------


def as_svg(page: Page) -> str:
    """The page as SVG, in millimetres."""
    w, h = page.size_mm
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{w:.5f}mm" height="{h:.5f}mm" viewBox="0 0 {w:.5f} {h:.5f}">',
        f'<rect width="{w:.5f}" height="{h:.5f}" fill="#fff"/>',
    ]
    for layer in page.drawing.layers:
        path = "".join(f"M{x:.5f} {y:.5f}h{a:.5f}v{b:.5f}h{-a:.5f}z" for x, y, a, b in page.rectangles_mm(layer))
        colour = "#000" if layer.is_black else "#fff"
        if path:
            out.append(f'<path fill="{colour}" d="{path}"/>')
        out += [
            f'<circle fill="{colour}" cx="{x:.5f}" cy="{y:.5f}" r="{r:.5f}"/>' for x, y, r in page.circles_mm(layer)
        ]
    out += [f'<rect x="{x:.5f}" y="{y:.5f}" width="{a:.5f}" height="{b:.5f}"/>' for x, y, a, b in page.bar_parts_mm()]
    out += [
        f'<text x="{x:.4f}" y="{y:.4f}" font-family="Helvetica, Arial, sans-serif"'
        f' font-size="{_FONT_MM}">{escape(line)}</text>'
        for x, y, line in page.caption_lines_mm()
    ]
    return "\n".join([*out, "</svg>"]) + "\n"


# PNG ------------------------------------------------------------------------------------------------------------


def as_png(page: Page, dpi: float = 300.0) -> bytes:
    """The page as a grey PNG with its resolution, which programs print at true size; edges are antialiased.

    Raises InputError: for a resolution outside 50 to 2400 dpi or a picture of more than 400 megapixels.
    """
    if not 50 <= dpi <= 2400:
        raise InputError(f"dpi: expected 50 to 2400, got {dpi:g}")
    per_metre = round(dpi / 0.0254)  # PNG stores whole pixels per metre: the picture is drawn at exactly that scale
    per_mm = per_metre / 1000.0
    width, height = (int(np.ceil(side * per_mm - 1e-6)) for side in page.size_mm)
    if width * height > 400_000_000:
        raise InputError(f"dpi: at {dpi:g} dpi this page has {width}x{height} pixels; lower the dpi, or use the PDF")
    paper = np.full((height, width), 255, dtype=np.uint8)
    for layer in page.drawing.layers:
        grey = 0 if layer.is_black else 255
        _paint_rectangles(paper, page.rectangles_mm(layer) * per_mm, grey)
        for circle in page.circles_mm(layer) * per_mm:
            _paint_circle(paper, circle, grey)
    _paint_rectangles(paper, page.bar_parts_mm() * per_mm, 0)
    for x, y, line in page.caption_lines_mm():
        at = (int(x * per_mm), int(y * per_mm))
        scale = _FONT_MM * per_mm / 30.0
        cv2.putText(paper, line, at, cv2.FONT_HERSHEY_SIMPLEX, scale, (0,), max(1, round(0.3 * per_mm)), cv2.LINE_AA)
    good, data = cv2.imencode(".png", paper, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    if not good:
        raise InputError("the PNG picture cannot be encoded; use the PDF")
    return _with_resolution(data.tobytes(), per_metre)


def _with_resolution(png: bytes, per_metre: int) -> bytes:
    """Insert the pHYs chunk after the header (8 + 25 bytes). Source: PNG, ISO 15948, 11.3.5.3."""
    body = b"pHYs" + struct.pack(">IIB", per_metre, per_metre, 1)
    return png[:33] + struct.pack(">I", 9) + body + struct.pack(">I", zlib.crc32(body)) + png[33:]


def _paint_rectangles(paper: np.ndarray, rectangles: Array, grey: int) -> None:
    """Draw rectangles (n, 4), px, with exact pixel coverage; rectangles that touch leave no gap."""
    if len(rectangles) == 0:
        return
    cover = np.zeros(paper.shape, dtype=np.float32)
    for left, top, width, height in rectangles:
        columns, across = _covered(left, left + width, paper.shape[1])
        rows, down = _covered(top, top + height, paper.shape[0])
        cover[rows, columns] += (down[:, None] * across).astype(np.float32)
    cover = np.minimum(cover, 1)
    paper[:] = np.round(paper + cover * (np.float32(grey) - paper)).astype(np.uint8)


def _covered(first: float, last: float, count: int) -> tuple[slice, Array]:
    """The pixels that an interval covers, where pixel k extends from k to k + 1, and the covered share of each."""
    start, stop = max(int(np.floor(first)), 0), min(int(np.ceil(last)), count)
    k = np.arange(start, stop)
    return slice(start, stop), np.clip(np.minimum(k + 1, last) - np.maximum(k, first), 0, 1)


def _paint_circle(paper: np.ndarray, circle: Array, grey: int) -> None:
    """Draw a circle (x, y, radius), px, with its pixel coverage from 64 samples per pixel."""
    x, y, r = circle
    first = np.floor([x - r, y - r]).astype(int)
    n = int(np.ceil(2 * r)) + 2
    fine = (np.arange(8 * n) + 0.5) / 8
    inside = np.hypot(fine + first[0] - x, fine[:, None] + first[1] - y) < r
    cover = inside.reshape(n, 8, n, 8).mean(axis=(1, 3))
    piece = paper[first[1] : first[1] + n, first[0] : first[0] + n]
    piece[:] = np.round(piece + cover * (grey - piece.astype(float))).astype(np.uint8)


FORMATS = ("pdf", "svg", "png")
DESCRIPTION = "board.yaml"
# Smallest white rim around a marker, in marker modules. Measured on rendered boards of 7x5 squares of 36 mm, 960x720
# px, blur 0.7 and 1.2 px: with a rim of 0.05 no marker is detected; corner errors are 0.1 to 0.7 px with 0.2, 0.05 to
# 0.3 px with 0.4, and 0.03 to 0.06 px from 0.7 on. OpenCV recommends 0.7 too.
MIN_RIM_MODULES = 0.7


def write_board(
    board: Board | str | Path,
    out: Path,
    formats: Sequence[str] = FORMATS,
    page: str = "A4",
    dpi: float = 300.0,
) -> Done[Board]:
    """Write board.pdf, board.svg, board.png and board.yaml into the folder `out`.

    If `out` names a file with one of these suffixes, only that format and its description are written. All files are
    written or none. board: a value, its text, or the path of a board.yaml. Raises InputError: for an unknown format, a
    board that does not fit on the page, or files that cannot be written.
    """
    if isinstance(board, str | Path):
        board = load_board_or_text(board)
    out = Path(out)
    single = out.suffix.lower()[1:]
    if single in FORMATS and not out.is_dir():
        formats = (single,)
    for name in formats:
        if name not in FORMATS:
            raise InputError(f"format: expected {', '.join(FORMATS)}, got {name!r}{suggest_name(name, FORMATS)}")
    if out.suffix and not out.is_dir() and not (single in FORMATS or _is_number(single)):
        raise InputError(
            f"{out}: expected a folder, or a file ending in .{', .'.join(FORMATS)}, got {out.suffix};"
            " use one of these suffixes"
        )
    _check_rim(board)
    layout = lay_out(board, page)
    writers = {
        "pdf": lambda: as_pdf(layout),
        "svg": lambda: as_svg(layout).encode("utf-8"),
        "png": lambda: as_png(layout, dpi),
    }
    contents = {name: writers[name]() for name in dict.fromkeys(formats)}
    if single in FORMATS and not out.is_dir():
        description = out.with_suffix(".yaml")
        if description.exists() and load_board(description) != board:
            raise InputError(f"{description}: describes another board; choose another name")
        out.parent.mkdir(parents=True, exist_ok=True)
        atomic_write_bytes(contents[single], out)
        save_board(board, description)
        return _done(board, (out, description), layout.name)
    known = {DESCRIPTION, *(f"board.{name}" for name in FORMATS)}
    with atomic_folder(out, lambda folder: {path.name for path in folder.iterdir()} <= known) as work:
        for name, data in contents.items():
            (work / f"board.{name}").write_bytes(data)
        save_board(board, work / DESCRIPTION)
    return _done(board, (*(out / f"board.{name}" for name in contents), out / DESCRIPTION), layout.name)


def _done(board: Board, files: Sequence[Path], page: str) -> Done[Board]:
    names, folder = ", ".join(path.name for path in files), files[0].parent
    line = f"{board.describe()} on {page}: {names} in {folder}; print at 100 % and measure the bar of 100 mm"
    return Done(board, (line,))


def _is_number(suffix: str) -> bool:
    """Whether the part after the last dot belongs to a folder name, as in boards-v1.2 or 2026.11.21."""
    return suffix[:1].isdigit()


def _check_rim(board: Board) -> None:
    """Raise InputError for a ChArUco board whose markers nearly touch the squares.

    Only printing is refused. Photographs of existing boards show by themselves whether the markers can be read.
    """
    if isinstance(board, Charuco) and board.rim_modules < MIN_RIM_MODULES * (1 - 1e-9):
        largest_mm = math.floor(10_000 * board.marker_with_rim_m(MIN_RIM_MODULES)) / 10
        raise InputError(
            f"{board.describe()}: the white rim around the markers is only {board.rim_modules:.2f} marker modules wide,"
            f" at least {MIN_RIM_MODULES:g} are needed to find the corners; make the markers {largest_mm:g} mm or less"
        )
