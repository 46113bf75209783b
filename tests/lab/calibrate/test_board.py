"""Printed boards are true to scale, agree with their description, and are written completely or not at all."""

from __future__ import annotations

import re
import struct
import zlib

import cv2
import numpy as np
import pytest

from calibration.boards.board_detection import find_board
from calibration.boards.board_types import parse
from calibration.boards.board_view import BoardView
from lab.calibrate.board import as_pdf, lay_out, write_board
from lab.errors import InputError
from lab.files.rig.board_file import load_board, load_board_or_text
from tests.marks import further_slow

TEXTS = ["chessboard:9x6:25mm", "acircles:4x11:20mm", "charuco:5x7:36mm:27mm:DICT_4X4_50:inverted"]


@pytest.mark.parametrize(("text", "dpi"), further_slow(zip(TEXTS, (300, 150, 300), strict=True)))
def test_a_printed_picture_shows_the_board_at_its_size(tmp_path, text, dpi):
    outcome = write_board(text, tmp_path / "b", dpi=dpi)
    data = (tmp_path / "b" / "board.png").read_bytes()
    at = data.index(b"pHYs")
    per_metre, same, unit = struct.unpack(">IIB", data[at + 4 : at + 13])
    assert (per_metre, unit) == (same, 1)
    image = np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
    view = find_board(image, outcome.result)
    assert isinstance(view, BoardView)
    assert len(view) == len(outcome.result.ids)
    mm = 1000 * view.pixels / per_metre
    np.testing.assert_allclose(mm - mm[0], 1000 * outcome.result.points[:, :2], atol=0.02)  # a printer's own error
    assert load_board(tmp_path / "b" / "board.yaml") == outcome.result
    assert outcome.exit_status == 0
    assert "measure the bar of 100 mm" in outcome.line()


@pytest.mark.parametrize("text", TEXTS)
def test_the_pdf_holds_the_same_shapes_in_millimetres(text):
    page = lay_out(parse(text))
    pdf = as_pdf(page)
    content = zlib.decompress(re.search(rb"stream\n(.*?)\nendstream", pdf, re.DOTALL)[1]).decode()
    mm = 25.4 / 72
    transforms = re.findall(r"(\S+) (\S+) (\S+) (\S+) (\S+) (\S+) cm", content)
    assert len(set(transforms)) == 1
    np.testing.assert_allclose(
        np.array(transforms[0], dtype=float) * mm, [mm, 0, 0, -mm, 0, page.size_mm[1]], atol=1e-4
    )
    found = np.array([[float(v) for v in row] for row in re.findall(r"(\S+) (\S+) (\S+) (\S+) re", content)])
    wanted = [page.rectangles_mm(layer) for layer in page.drawing.layers] + [page.bar_parts_mm()]
    np.testing.assert_allclose(found * mm, np.concatenate(wanted), atol=1e-4)
    circles = np.concatenate([page.circles_mm(layer) for layer in page.drawing.layers])
    curves = re.findall(r"(\S+) (\S+) m \S+ \S+ \S+ \S+ (\S+) (\S+) c", content)  # the first quarter of each circle
    start, end = np.split(np.array(curves, dtype=float).reshape(-1, 4) * mm, 2, axis=1)
    np.testing.assert_allclose(np.hypot(*(start - end).T), np.sqrt(2) * circles[:, 2], atol=2e-4)
    assert b"/PrintScaling /None" in pdf


def test_the_same_board_gives_the_same_pdf_at_any_time():
    board = parse("chessboard:9x6:25mm")
    assert as_pdf(lay_out(board)) == as_pdf(lay_out(board))
    assert b"CreationDate (D:20000101" in as_pdf(lay_out(board))


def test_a_board_too_large_for_the_page_is_refused_with_the_remedy(tmp_path):
    with pytest.raises(InputError, match=r"300 x 210 mm do not fit on A4; use A3 .*, or reduce the 30 mm to 25\.1 mm"):
        write_board("chessboard:9x6:30mm", tmp_path / "b")
    assert list(tmp_path.iterdir()) == []
    assert " on fit: " in write_board("chessboard:9x6:30mm", tmp_path / "b", page="fit").line()


def test_a_folder_with_something_else_in_it_is_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("years")
    with pytest.raises(InputError, match="choose another"):
        write_board("chessboard:9x6:20mm", tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_file_with_mistakes_is_refused_with_its_field(tmp_path):
    path = tmp_path / "board.yaml"
    path.write_text("schema: beampose/board/1\nkind: chessboard\ncolumns: 9\nrows: 6\nspacing_m: 0.025\n")
    with pytest.raises(InputError, match=r"board\.yaml: expected square_m for a board of kind 'chessboard'"):
        load_board_or_text(path)
    with pytest.raises(InputError, match=r"expected a length with its unit .* or name a board\.yaml"):
        load_board_or_text("chessboard:9x6:25")


@pytest.mark.parametrize("name", ["x.jpg", "board.yaml", "board.PDF2"])
def test_a_file_of_another_kind_is_refused_instead_of_becoming_a_folder(tmp_path, name):
    with pytest.raises(InputError, match=r"expected a folder, or a file ending in \.pdf, \.svg, \.png, got \."):
        write_board("chessboard:9x6:20mm", tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_may_have_a_dot_in_its_name(tmp_path):
    write_board("chessboard:9x6:20mm", tmp_path / "boards-v1.2", ["svg"])
    assert (tmp_path / "boards-v1.2" / "board.svg").is_file()


@pytest.mark.parametrize(
    ("out", "files"),
    [
        ("x.svg", ["x.svg", "x.yaml"]),
        ("new/x.png", ["x.png", "x.yaml"]),
        ("new", ["board.svg", "board.yaml"]),
        ("there.svg", ["board.svg", "board.yaml"]),
    ],
)
def test_the_files_that_the_line_names_are_written_and_no_others(tmp_path, out, files):
    (tmp_path / "there.svg").mkdir()
    for _ in range(2):  # the same board may be written again
        done = write_board("chessboard:9x6:20mm", tmp_path / out, ["svg"])
    found = [p for p in tmp_path.rglob("*") if p.is_file()]
    assert sorted(p.name for p in found) == files
    assert f": {', '.join(files)} in {found[0].parent}; " in done.line()
    assert load_board(next(p for p in found if p.suffix == ".yaml")) == done.result
    kind = found[0].read_bytes() if found[0].suffix != ".yaml" else found[1].read_bytes()
    assert kind.startswith(b"\x89PNG") == files[0].endswith(".png")


def test_a_description_of_another_board_is_not_replaced(tmp_path):
    write_board("chessboard:9x6:20mm", tmp_path / "x.svg")
    with pytest.raises(InputError, match="describes another board; choose another name"):
        write_board("chessboard:9x6:21mm", tmp_path / "x.svg")


def test_a_marker_too_large_for_its_square_is_not_printed_and_the_largest_size_is_reported(tmp_path):
    with pytest.raises(InputError, match=r"only 0\.01 marker modules .* make the markers 29\.1 mm or less"):
        write_board("charuco:5x7:36mm:35.9mm:DICT_4X4_50", tmp_path / "b")
    assert list(tmp_path.iterdir()) == []
    write_board("charuco:5x7:36mm:29.1mm:DICT_4X4_50", tmp_path / "b", ["svg"])
