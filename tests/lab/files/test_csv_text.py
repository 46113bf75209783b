"""The CSV layer: all readers give the same table, and every error names the line of the file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from geometry.rig import Rig
from lab.errors import InputError
from lab.files.project.point_files import read_observations, read_poses, read_survey
from lab.files.rig.rig_file import load_rig
from lab.files.run.clocks import load_times
from lab.files.run.detections_file import read_detections
from lab.files.run.results import read_result_table
from lab.files.run.truth import load_truth
from lab.files.text import csv_text
from lab.files.text.csv_text import read_table
from tests.lab.run_folders import RIG

COLUMNS = ("frame", "a", "b", "camera")


def by_each_reader(path, monkeypatch, required=COLUMNS, optional=()):
    """The table as it is read and by the csv module; whether the first was split at its commas."""
    used, real = [], csv_text._read_regular
    with monkeypatch.context() as patched:
        patched.setattr(csv_text, "_read_regular", lambda *a: used.append(real(*a)) or used[-1])
        tables = [read_table(path, required, optional)]
        patched.setattr(csv_text, "_is_regular", lambda *_: False)
        tables.append(read_table(path, required, optional))
    return tables, bool(used)


def assert_equal(one, two):
    assert (one.numbers.keys(), one.words.keys()) == (two.numbers.keys(), two.words.keys())
    for name, values in one.numbers.items():
        np.testing.assert_array_equal(values, two.numbers[name], strict=True)
    for name, column in one.words.items():
        assert column.words == two.words[name].words
        np.testing.assert_array_equal(column.codes, two.words[name].codes, strict=True)
    np.testing.assert_array_equal(one.lines, two.lines, strict=True)
    assert (one.texts, one.long_lines, one.short_lines) == (two.texts, two.long_lines, two.short_lines)


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_numbers_words_lines_and_empty_fields_are_the_same_by_all_readers(newline, tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    values = np.concatenate([10 ** rng.uniform(-300, 300, 50_000), rng.normal(size=500), [0.1 + 0.2, 5e-324, 1e308]])
    rows = [
        f"{k},{v!r},{'' if k % 3 else 'inf'},{'NA' if k % 2 else 'x y '},more" for k, v in enumerate(values.tolist())
    ]
    path = tmp_path / "t.csv"
    path.write_text(newline.join(["frame,a,b,camera,other", *rows, ""]), newline="")
    (one, two), fast = by_each_reader(path, monkeypatch)
    assert fast
    np.testing.assert_array_equal(one.numbers["a"], values)
    assert one.words["camera"].words == ("x y", "NA")
    assert one.lines.tolist() == list(range(2, len(values) + 2))
    assert_equal(one, two)


def test_an_absent_optional_column_is_nan_by_all_readers(tmp_path, monkeypatch):
    path = tmp_path / "t.csv"
    path.write_text("frame,a,camera\n1,2,x\n2,3,x\n")
    tables, fast = by_each_reader(path, monkeypatch, ("frame", "a", "camera"), ("b", "spot"))
    assert fast
    for table in tables:
        assert np.isnan(table.numbers["b"]).all()
        assert "b" not in table
        assert "spot" not in table.words
        assert len(table) == 2


@pytest.mark.parametrize(
    ("text", "is_split"),
    [
        ("frame,a,b,camera\n1,2,five,x\n", True),
        ("frame,a,b,camera\n1,2,nan,x\n2, 3,1_0,y\n3,,  ,x \n", True),
        ("frame,a,b,camera\n1,2,3,x\n4,5\n4,5,6,x,8,9\n", False),  # a line too short, one too long: the usual commas
        ("frame,a,b,camera\n1,2,3,x\n\n4,5,6,x\n", False),
        ('frame,a,b,camera\n1,2,3,"x, y"\n', False),
        ("frame,a,b,camera\n1,2,3,x", False),
        ("\nframe,a,b,camera\n1,2,3,x\n", False),
        ("frame,a,b,camera\r1,2,3,x\r4,5,6,y\r", False),
    ],
)
def test_an_odd_table_is_the_same_by_all_readers(text, is_split, tmp_path, monkeypatch):
    path = tmp_path / "t.csv"
    path.write_bytes(text.encode())
    (one, two), fast = by_each_reader(path, monkeypatch)
    assert fast is is_split
    assert_equal(one, two)


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_lines_count_blank_lines_quoted_line_breaks_and_lines_left_out(newline, tmp_path):
    path = tmp_path / "t.csv"
    lines = ["", "frame,a,b,camera", "1,2,3,x", "  ", "2,2,3,x,4", '3,2,3,"x', 'y"', "", "4,2,3,x,", "5,2"]
    path.write_bytes(newline.join(lines).encode())
    table = read_table(path, COLUMNS)
    assert table.lines.tolist() == [3, 7, 9, 10]
    assert table.numbers["frame"].tolist() == [1, 3, 4, 5]
    assert (table.long_lines, table.short_lines) == ((5,), (10,))


@pytest.mark.parametrize("rows", ['1,2,3,"x\n2,2,3,y\n', '1,2,3,x\n2,2,3,"y"z\n'])
def test_unbalanced_quotes_are_refused(rows, tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("frame,a,b,camera\n" + rows)
    with pytest.raises(InputError, match=r"line 3: expected a CSV table, got unbalanced quotes"):
        read_table(path, COLUMNS)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("frame,a,camera\n1,2,x\n", "expected a column 'b'"),
        ("frame,a,b,camera\n1,2,3,x\n4,5\n", "line 3: expected 4 fields as in the header"),
        ("frame,a,b,camera\n1,2,3,x\n\n4,5,6,7,8\n", "line 4: expected 4 fields as in the header"),
        ("frame,a,b,camera\n1,2,five,x\n", "line 2: expected 4 fields as in the header, and numbers"),
        ("", "an empty file"),
    ],
)
def test_a_damaged_table_of_results_is_refused_with_its_line(text, words, tmp_path):
    path = tmp_path / "t.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        read_result_table(path, COLUMNS)


SURVEY, POINTS = "point,x_m,y_m,z_m,screen\n", "camera,point,u_px,v_px\n"
POSES, TIMES = "frame,t_s,x_m,y_m,z_m,qw,qx,qy,qz\n", "frame,t_s\n"
STILL = "0,0,0,0,0,1,0,0,0\n"
SPOTS = "frame,camera,spot,u_px,v_px,in_view\n"
CAMERAS = {"left": (64, 48)}


@pytest.fixture(scope="module")
def rig(tmp_path_factory) -> Rig:
    path = tmp_path_factory.mktemp("rig") / "rig.yaml"
    path.write_text(RIG)
    return load_rig(path)


@pytest.mark.parametrize(
    ("name", "text", "line"),
    [
        ("survey", f"{SURVEY}\nA,0,0,0,\n\nA,1,0,0,\n", 5),
        ("survey", f"{SURVEY}\nA,0,0,0,elsewhere\n", 3),
        ("survey", f"{SURVEY}\n,0,0,0,\n", 3),
        ("survey", f"{SURVEY}\nA,0,0,1e6,\n", 3),
        ("points", f"{POINTS}\nmiddle,A,1,2\n", 3),
        ("points", f"{POINTS}\nleft,A,1,2\n\nleft,A,1,2\n", 5),
        ("points", f"{POINTS}\nleft,A,1,9999\n", 3),
        ("poses", f"{POSES}\n{STILL}\n{STILL}", 5),
        ("poses", f"{POSES}\n0,0,0,0,0,2,0,0,0\n", 3),
        ("times", f"{TIMES}\n0,0\n\n0,1\n", 5),
        ("times", f"{TIMES}\n0,1\n\n1,1\n", 5),
        ("truth/pose", f"{POSES}\n{STILL}\n{STILL}", 5),
        ("truth/pose", f"{POSES}\n0,0,0,0,0,2,0,0,0\n", 3),
        ("truth/spots", f"{SPOTS}\n0,left,1,1,2,3\n", 3),
        ("truth/spots", f"{SPOTS}\n0,left,1,,2,1\n", 3),
        ("truth/spots", f"{SPOTS}\n0,left,1,1,2,1\n\n0,left,1,1,2,1\n", 5),
        ("truth/spots", f"{SPOTS}\n0,left,1,1,2,1\n\n0,middle,1,1,2,1\n", 5),
    ],
)
def test_errors_name_the_right_line_after_blank_lines(name, text, line, rig, tmp_path):
    path: Path = tmp_path / f"{name}.csv"
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)
    readers = {
        "survey": lambda: read_survey([path], ["front"]),
        "points": lambda: read_observations([path], CAMERAS, ["A"]),
        "poses": lambda: read_poses(path),
        "times": lambda: load_times(path, 100.0),
        "truth/pose": lambda: load_truth(tmp_path),
        "truth/spots": lambda: load_truth(tmp_path, tuple(rig.cameras), tuple(rig.spots)),
    }
    with pytest.raises(InputError, match=rf"\.csv: line {line}: "):
        readers[name]()


def test_a_note_about_detections_names_the_right_line_after_blank_lines(tmp_path):
    path = tmp_path / "detections.csv"
    path.write_text("frame,camera,u_px,v_px\n\n0,left,1,2\n\n0.5,left,1,2\n")
    assert any("the first in line 5, with frame 0.5" in note for note in read_detections(path).notes)


def test_a_missing_column_is_not_said_to_be_one_that_is_needed_itself(tmp_path):
    (tmp_path / "points.csv").write_text("frame,x,v_px\n0,1,2\n", "utf-8")
    with pytest.raises(InputError, match=r"expected a column 'u_px', got frame,x,v_px$"):
        read_table(tmp_path / "points.csv", ("frame", "u_px", "v_px"))
    (tmp_path / "points.csv").write_text("frame,U_px,v_px\n0,1,2\n", "utf-8")
    with pytest.raises(InputError, match=r"rename 'U_px' to 'u_px' if it is that column$"):
        read_table(tmp_path / "points.csv", ("frame", "u_px", "v_px"))
