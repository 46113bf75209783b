"""A calibration board on a page to print: laid out in millimetres, and written as PDF, SVG or PNG at exact scale."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from xml.sax.saxutils import escape

import cv2
import numpy as np

from calibration.boards.board_drawing import BoardShapes, Layer, draw
from calibration.boards.board_types import Board
from geometry.arrays import Array
from lab.errors import InputError

PAGES_MM = {"A4": (210.0, 297.0), "A3": (297.0, 420.0)}  # width, height, upright; either way round is used
FIT = "fit"  # a page as large as the board needs
MARGIN_MM = 10.0  # what printers leave white
_FOOT_MM = 14.0  # for the bar and the caption, under the board: 9x6 corners of 25 mm just fit on A4
_BAR_MM = 100.0
_LETTER_MM = 3.2  # height of the caption's letters


@dataclass(frozen=True, slots=True)
class Page:
    """Where everything lies, mm from the page's top left corner, y down."""

    size_mm: tuple[float, float]
    drawing: BoardShapes
    board_at_mm: Array  # (2,) top left corner of the printed area
    bar_mm: tuple[float, float, float]  # left, top, length
    caption: tuple[str, ...]
    caption_at_mm: tuple[float, float]  # baseline of the first line
    name: str

    def rectangles_mm(self, layer: Layer) -> Array:
        """(n, 4): left, top, width, height."""
        return layer.rectangles * 1000.0 + np.array([*self.board_at_mm, 0.0, 0.0])

    def circles_mm(self, layer: Layer) -> Array:
        """(n, 3): centre x, y, radius."""
        return layer.circles * 1000.0 + np.array([*self.board_at_mm, 0.0])

    def bar_parts_mm(self) -> Array:
        """The bar and its two end marks (3, 4)."""
        left, top, length = self.bar_mm
        return np.array([[left, top + 1.5, length, 0.4], [left, top, 0.2, 3.4], [left + length - 0.2, top, 0.2, 3.4]])


def lay_out(board: Board, page: str = "A4") -> Page:
    """A board in the middle of a page. Raises InputError with the remedy where it is too large or the page unknown."""
    drawing = draw(board)
    wide, high = (1000.0 * side for side in drawing.size_m)
    caption = (f"{board.describe()}   beampose", f"the bar is {_BAR_MM:.0f} mm: print at 100 %, then measure it")
    if page == FIT:
        size = (max(wide, _BAR_MM) + 2 * MARGIN_MM, high + 2 * MARGIN_MM + _FOOT_MM)
        return _placed(drawing, size, caption, FIT)
    upright = PAGES_MM.get(page.upper())
    if upright is None:
        raise InputError(f"page: expected {', '.join(PAGES_MM)} or {FIT}, got {page!r}")
    ways = [upright, upright[::-1]] if high >= wide else [upright[::-1], upright]
    for size in ways:
        if wide <= size[0] - 2 * MARGIN_MM and high <= size[1] - 2 * MARGIN_MM - _FOOT_MM:
            return _placed(drawing, size, caption, f"{page.upper()} {'upright' if size == upright else 'across'}")
    share = max(min((w - 2 * MARGIN_MM) / wide, (h - 2 * MARGIN_MM - _FOOT_MM) / high) for w, h in ways)
    step = np.floor(10_000.0 * board.spacing_m * share) / 10
    raise InputError(
        f"{board.describe()}: {wide:.0f} x {high:.0f} mm do not fit on {page.upper()}; take"
        f" {_larger(page, wide, high)}, or make {step:.1f} mm of the {1000 * board.spacing_m:g} mm"
    )


def _larger(page: str, wide: float, high: float) -> str:
    w, h = PAGES_MM["A3"]
    room = sorted((w - 2 * MARGIN_MM, h - 2 * MARGIN_MM - _FOOT_MM))
    fits = page.upper() != "A3" and max(wide, high) <= room[1] and min(wide, high) <= room[0] - _FOOT_MM
    return f"A3 or {FIT} (a page of the board's size)" if fits else f"{FIT} (a page of the board's size)"


def _placed(drawing: BoardShapes, size: tuple[float, float], caption: tuple[str, ...], name: str) -> Page:
    wide, high = (1000.0 * side for side in drawing.size_m)
    foot = size[1] - MARGIN_MM - _FOOT_MM
    at = np.array([(size[0] - wide) / 2, MARGIN_MM + (foot - MARGIN_MM - high) / 2])
    return Page(size, drawing, at, (MARGIN_MM, foot + 2.0, _BAR_MM), caption, (MARGIN_MM, foot + 9.0), name)


# PDF ------------------------------------------------------------------------------------------------------------


def as_pdf(page: Page) -> bytes:
    """One page of vectors, with the wish that programs print it unscaled. Source: ISO 32000-1, 7.5 and 8.5."""
    w, h = page.size_mm
    k = 72 / 25.4
    lines = [f"{k:.9f} 0 0 {-k:.9f} 0 {h * k:.6f} cm"]  # millimetres, y down
    for layer in page.drawing.layers:
        lines.append(f"{0 if layer.dark else 1} g")
        lines += [f"{x:.5f} {y:.5f} {a:.5f} {b:.5f} re" for x, y, a, b in page.rectangles_mm(layer)]
        lines += [_pdf_circle(x, y, r) for x, y, r in page.circles_mm(layer)]
        lines.append("f")  # one path: no hair lines between squares that touch
    lines.append("0 g")
    lines += [f"{x:.5f} {y:.5f} {a:.5f} {b:.5f} re" for x, y, a, b in page.bar_parts_mm()] + ["f", "BT"]
    lines.append(f"/F1 {_LETTER_MM:.2f} Tf")
    x, y = page.caption_at_mm
    for i, text in enumerate(page.caption):
        safe = text.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")
        lines.append(f"1 0 0 -1 {x:.4f} {y + 1.4 * _LETTER_MM * i:.4f} Tm ({safe}) Tj")
    lines.append("ET")
    content = zlib.compress("\n".join(lines).encode("latin-1"))
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {w * k:.6f} {h * k:.6f}] /Contents 4 0 R"
        " /Resources << /Font << /F1 5 0 R >> >> >>".encode(),
        b"<< /Length %d /Filter /FlateDecode >>\nstream\n%b\nendstream" % (len(content), content),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]
    out, places = b"%PDF-1.6\n%\xe2\xe3\xcf\xd3\n", []
    for number, body in enumerate(objects, 1):
        places.append(len(out))
        out += b"%d 0 obj\n%b\nendobj\n" % (number, body)
    table = b"".join(b"%010d 00000 n \n" % place for place in places)
    end = b"trailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (len(objects) + 1, len(out))
    return out + b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1) + table + end


def _pdf_circle(x: float, y: float, r: float) -> str:
    """Four Bezier curves; they leave the circle by less than 3e-4 of its radius, the same on every side."""
    c = 0.5522847498 * r
    arcs = (
        (x + r, y + c, x + c, y + r, x, y + r),
        (x - c, y + r, x - r, y + c, x - r, y),
        (x - r, y - c, x - c, y - r, x, y - r),
        (x + c, y - r, x + r, y - c, x + r, y),
    )
    return f"{x + r:.5f} {y:.5f} m " + " ".join(" ".join(f"{v:.5f}" for v in arc) + " c" for arc in arcs) + " h"


# SVG ------------------------------------------------------------------------------------------------------------


def as_svg(page: Page) -> str:
    """Vectors in millimetres."""
    w, h = page.size_mm
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{w:.5f}mm" height="{h:.5f}mm" viewBox="0 0 {w:.5f} {h:.5f}">',
        f'<rect width="{w:.5f}" height="{h:.5f}" fill="#fff"/>',
    ]
    for layer in page.drawing.layers:
        path = "".join(f"M{x:.5f} {y:.5f}h{a:.5f}v{b:.5f}h{-a:.5f}z" for x, y, a, b in page.rectangles_mm(layer))
        colour = "#000" if layer.dark else "#fff"
        if path:
            out.append(f'<path fill="{colour}" d="{path}"/>')
        out += [
            f'<circle fill="{colour}" cx="{x:.5f}" cy="{y:.5f}" r="{r:.5f}"/>' for x, y, r in page.circles_mm(layer)
        ]
    out += [f'<rect x="{x:.5f}" y="{y:.5f}" width="{a:.5f}" height="{b:.5f}"/>' for x, y, a, b in page.bar_parts_mm()]
    x, y = page.caption_at_mm
    out += [
        f'<text x="{x:.4f}" y="{y + 1.4 * _LETTER_MM * i:.4f}" font-family="Helvetica, Arial, sans-serif"'
        f' font-size="{_LETTER_MM}">{escape(text)}</text>'
        for i, text in enumerate(page.caption)
    ]
    return "\n".join([*out, "</svg>"]) + "\n"


# PNG ------------------------------------------------------------------------------------------------------------


def as_png(page: Page, dpi: float = 300.0) -> bytes:
    """A grey picture that says its scale, so that programs print it at its size; edges within a pixel are shaded."""
    if not 50 <= dpi <= 2400:
        raise InputError(f"dpi: expected 50 to 2400, got {dpi:g}")
    per_metre = round(dpi / 0.0254)  # whole in the file: the picture is drawn at exactly that scale
    per_mm = per_metre / 1000.0
    width, height = (int(np.ceil(side * per_mm - 1e-6)) for side in page.size_mm)
    if width * height > 400_000_000:
        raise InputError(f"dpi: {dpi:g} make {width}x{height} pixels of this page; take fewer, or the PDF")
    paper = np.full((height, width), 255, dtype=np.uint8)
    for layer in page.drawing.layers:
        grey = 0 if layer.dark else 255
        _paint_rectangles(paper, page.rectangles_mm(layer) * per_mm, grey)
        for circle in page.circles_mm(layer) * per_mm:
            _paint_circle(paper, circle, grey)
    _paint_rectangles(paper, page.bar_parts_mm() * per_mm, 0)
    x, y = page.caption_at_mm
    for i, text in enumerate(page.caption):
        at = (int(x * per_mm), int((y + 1.4 * _LETTER_MM * i) * per_mm))
        scale = _LETTER_MM * per_mm / 30.0
        cv2.putText(paper, text, at, cv2.FONT_HERSHEY_SIMPLEX, scale, (0,), max(1, round(0.3 * per_mm)), cv2.LINE_AA)
    good, data = cv2.imencode(".png", paper, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    if not good:
        raise InputError("the PNG picture cannot be made; take the PDF")
    return _with_scale(data.tobytes(), per_metre)


def _with_scale(png: bytes, per_metre: int) -> bytes:
    """The pHYs chunk behind the header (8 + 25 bytes). Source: PNG, ISO 15948, 11.3.5.3."""
    body = b"pHYs" + struct.pack(">IIB", per_metre, per_metre, 1)
    return png[:33] + struct.pack(">I", 9) + body + struct.pack(">I", zlib.crc32(body)) + png[33:]


def _paint_rectangles(paper: np.ndarray, rectangles: Array, grey: int) -> None:
    """Exact shares of the pixels that rectangles (n, 4), px, cover; those that touch add up to full pixels."""
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
    """Which pixels a stretch covers, pixel k reaching from k to k + 1, and their shares."""
    start, stop = max(int(np.floor(first)), 0), min(int(np.ceil(last)), count)
    k = np.arange(start, stop)
    return slice(start, stop), np.clip(np.minimum(k + 1, last) - np.maximum(k, first), 0, 1)


def _paint_circle(paper: np.ndarray, circle: Array, grey: int) -> None:
    x, y, r = circle
    first = np.floor([x - r, y - r]).astype(int)
    n = int(np.ceil(2 * r)) + 2
    fine = (np.arange(8 * n) + 0.5) / 8  # 64 places in a pixel
    inside = np.hypot(fine + first[0] - x, fine[:, None] + first[1] - y) < r
    cover = inside.reshape(n, 8, n, 8).mean(axis=(1, 3))
    piece = paper[first[1] : first[1] + n, first[0] : first[0] + n]
    piece[:] = np.round(piece + cover * (grey - piece.astype(float))).astype(np.uint8)
