"""Hostile files end in one line, quickly, without an echo of what they hold."""

from __future__ import annotations

import os
import re
import time

import pytest
import yaml

from lab.errors import InputError
from lab.files.project.point_files import read_point_cloud
from lab.files.rig.rig_file import load_rig
from lab.files.run.results import read_summary
from lab.files.run.run_file import load_run
from lab.files.run.truth import load_truth
from lab.files.text.csv_text import csv_text, read_table
from lab.files.text.error_text import is_formula, name_of_path, printable
from lab.files.text.json_text import has_schema
from lab.files.text.yaml_text import parse_mapping, parse_value, read_mapping, write_mapping
from lab.pictures.source import open_video
from lab.runs.batch.batch import read_rows
from lab.runs.batch.task import allotted, listed_runs
from lab.setup.plan_findings import options_of
from tests.paths import ROOT

CALIBRATED = ROOT / "sample_runs" / "calibrated"
BOMB = "a: &a [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{new}: &{new} [{', '.join([f'*{old}'] * 10)}]\n" for old, new in zip("abcdefghi", "bcdefghij", strict=True)
)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (BOMB, "line 5: expected YAML, found aliases that stand for more than 100000 values"),
        ("a: &a [*a]", "found an alias inside the value that it stands for"),
        ("a: " + "[" * 70 + "]" * 70, "found a nesting deeper than 60 levels"),
        ("a: " + "{a: " * 70 + "1" + "}" * 70, "found a nesting deeper than 60 levels"),
        ("a: " + "9" * 309, "found an integer of more than 100 digits"),
        ("a: " + "9" * 5000, "found an integer of more than 100 digits"),
        ('a: "\\ud800"', "found an escape that is no character"),
        ('"\\0": 1', "found an escape that is no character"),
        ("a: !!int abc", "found a word that is not an integer, tagged as !!int"),
        ("a: !!float abc", "found a word that is not a number, tagged as !!float"),
        ("a: !!bool 7", "found a word that is not true or false, tagged as !!bool"),
        ("a: !!timestamp x", "found a tag of another program"),
        ("a: !!map 3", "found a value where a mapping is expected"),
        ("a: !!str [1]", "found a list or mapping where one value is expected"),
        ("a: {<<: {[1]: 2}}", "found a key that is not a word"),
    ],
)
def test_a_hostile_yaml_text_is_refused_in_a_line_and_at_once(text, words):
    started = time.process_time()
    with pytest.raises(InputError) as caught:
        parse_mapping(text, "run.yaml")
    assert words in str(caught.value)
    assert len(str(caught.value)) < 200
    assert time.process_time() - started < 2


def test_aliases_that_stand_for_few_values_are_read():
    assert parse_mapping("a: &a {x: [1, 2]}\nb: {<<: *a, y: 3}\nc: *a", "f")["b"] == {"x": [1, 2], "y": 3}


@pytest.mark.parametrize(
    "text", ["a:\t1", "a: [b?c]", "a: {b?: 1}", "a: [1\t,2]", "a: [x:, y]", "a: [x:y, -, 1e-3]", "a: 1\na: 2", "a: 'b"]
)
def test_a_text_has_the_same_values_or_message_without_libyaml(text, monkeypatch):
    def outcome():
        try:
            return parse_mapping(text, "run.yaml")
        except InputError as error:
            return str(error)

    given = outcome()
    monkeypatch.setattr(yaml, "__with_libyaml__", False)
    assert outcome() == given


def test_a_rig_of_a_calibration_is_the_same_without_libyaml(monkeypatch):
    given = read_mapping(CALIBRATED / "rig.yaml")
    monkeypatch.setattr(yaml, "__with_libyaml__", False)
    assert read_mapping(CALIBRATED / "rig.yaml") == given


@pytest.mark.parametrize(
    "content",
    [
        read_mapping(CALIBRATED / "rig.yaml"),
        {"a b": [1.0, -0.0, 1e-300, float("nan"), -float("inf"), 10**20, None, True, "1e3", "yes", "~", "2026-01-01"]},
        {"a": {"b": "two\nlines\n", "c": " x ", "d": "#no: comment", "e": "\u00fc\u2013\U0001f642", "f": "x\ty?"}},
        {"many": [f"word {i}, with a comma" for i in range(60)], "deep": [[1, 2], {"x": []}, {}, {"y": {"z": "-"}}]},
    ],
)
def test_a_file_is_written_the_same_without_libyaml(content, tmp_path, monkeypatch):
    write_mapping(content, tmp_path / "given.yaml")
    monkeypatch.setattr(yaml, "__with_libyaml__", False)
    write_mapping(content, tmp_path / "without.yaml")
    assert (tmp_path / "without.yaml").read_bytes() == (tmp_path / "given.yaml").read_bytes()


def test_deep_brackets_on_the_command_line_are_refused_in_a_line():
    with pytest.raises(InputError, match="nesting deeper"):
        parse_value("[" * 5000, "r1_px")


def test_a_pipe_in_place_of_a_file_is_refused_and_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="found a named pipe"):
        read_mapping(tmp_path / "pipe")
    with pytest.raises(InputError, match="found a named pipe"):
        read_table(tmp_path / "pipe", ("frame",))
    with pytest.raises(InputError, match="found a named pipe"):
        open_video(tmp_path / "pipe")


@pytest.mark.parametrize("name", ["batch.csv", "summary.json", ".batch-folders.json", "runs.txt", "scan.xyz"])
def test_a_pipe_in_place_of_a_file_that_the_program_wrote_or_lists_is_refused_too(tmp_path, name):
    os.mkfifo(tmp_path / name)
    readers = {
        "batch.csv": lambda: read_rows(tmp_path / name),
        "summary.json": lambda: (has_schema(tmp_path, "any"), read_summary(tmp_path)),
        ".batch-folders.json": lambda: allotted(tmp_path, [tmp_path], {}),
        "runs.txt": lambda: listed_runs((), [tmp_path / name]),
        "scan.xyz": lambda: read_point_cloud(tmp_path / name, 1.0),
    }
    with pytest.raises(InputError, match="found a named pipe"):
        readers[name]()


def test_files_of_users_are_read_through_the_helpers_that_refuse_pipes():
    """Reading a pipe waits for ever. The others read what the program itself holds, or have asked for a file before."""
    asked = {
        "findings/finding.py", "results/certificate.py", "results/compare.py", "results/export.py", "setup/doctor.py",
        "runs/detect/detect.py", "files/project/point_files.py", "setup/init.py", "runs/batch/task.py",
    }  # fmt: skip
    found = {
        path.relative_to(ROOT / "lab").as_posix()
        for path in (ROOT / "lab").rglob("*.py")
        if re.search(r"\.read_(text|bytes)\(", path.read_text("utf-8")) and path.parent.name != "text"
    }
    assert found == asked


@pytest.mark.parametrize(
    ("table", "row"), [("spots.csv", "0,left,1,-1e300,5,1"), ("pose.csv", "0,0,1e300,0,0,1,0,0,0")]
)
def test_a_truth_whose_squares_are_not_finite_is_refused(table, row, tmp_path):
    (tmp_path / "truth").mkdir()
    header = "frame,camera,spot,u_px,v_px,in_view" if table == "spots.csv" else "frame,t_s,x_m,y_m,z_m,qw,qx,qy,qz"
    (tmp_path / "truth" / table).write_text(f"{header}\n{row}\n")
    with pytest.raises(InputError, match="within 1e\\+09, got"):
        load_truth(tmp_path)


@pytest.mark.parametrize("text", ["secret:x:0:0:root", "secret word", "- secret", "secret"])
def test_a_file_that_is_no_mapping_is_not_shown(text, tmp_path):
    (tmp_path / "rig.yaml").write_text(text)
    with pytest.raises(InputError) as caught:
        load_rig(tmp_path / "rig.yaml")
    assert "secret" not in str(caught.value)
    with pytest.raises(InputError) as caught:
        read_table(tmp_path / "rig.yaml", ("frame",))
    assert "secret" not in str(caught.value)


def run_with(tmp_path, **changes):
    """A copy of the calibrated sample's run.yaml with other values, in a folder of links."""
    for name in ("rig.yaml", "detections.csv"):
        (tmp_path / name).symlink_to(CALIBRATED / name)
    lines = (CALIBRATED / "run.yaml").read_text().splitlines()
    kept = [line for line in lines if line.split(":")[0] not in changes]
    (tmp_path / "run.yaml").write_text("\n".join([*kept, *(f"{k}: {v}" for k, v in changes.items())]) + "\n")
    return tmp_path


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"frame_rate_hz": "1e300"}, "frame_rate_hz: expected 1e-06 to 1e+07 Hz, got 1e+300"),
        ({"frame_rate_hz": "1e-300"}, "frame_rate_hz: expected 1e-06 to 1e+07 Hz, got 1e-300"),
        ({"frame_rate_hz": ".nan"}, "frame_rate_hz: expected a number above 0, got nan"),
        ({"exposure_s": "10"}, "exposure_s: expected at most the 0.01 s between two frames (100 Hz), got 10"),
        ({"exposure_s": "9" * 90}, "exposure_s: expected a number from 1e-15 to 1e+15"),
        ({"name": "'=cmd()'"}, "name: expected a name that a spreadsheet does not read as a formula"),
        ({"name": '"\\e[2J"'}, "name: expected a name without control characters"),
        ({"name": "a" * 500}, "name: expected a name of up to 200 characters"),
    ],
)
def test_a_run_with_an_impossible_value_is_refused(changes, words, tmp_path):
    with pytest.raises(InputError) as caught:
        load_run(run_with(tmp_path, **changes))
    assert words in str(caught.value)


def test_a_run_notes_the_files_outside_its_folder(tmp_path):
    assert load_run(CALIBRATED).paths_outside == ()
    run = load_run(run_with(tmp_path))
    assert [p.name for p in run.paths_outside] == ["rig.yaml", "detections.csv"]


@pytest.mark.parametrize("old", ["left:", "fan-1:", "'1':"])
def test_no_name_of_a_rig_is_a_formula(old, tmp_path):
    text = (ROOT / "sample_runs" / "huo2015" / "rig.yaml").read_text()
    name = next((line.strip() for line in text.splitlines() if line.strip() == old), "left:")
    (tmp_path / "rig.yaml").write_text(text.replace(name, "'@SUM(A1)':"))
    with pytest.raises(InputError, match="does not read as a formula"):
        load_rig(tmp_path / "rig.yaml")


@pytest.mark.parametrize("text", ["=1+1", "@x", "+cmd()", "-1+cmd|' /C calc'!A0", " =x"])
def test_a_formula_is_known_and_gets_an_apostrophe_in_tables(text):
    assert is_formula(text)
    assert csv_text(("run",), [(text,)]).splitlines()[1].strip('"').startswith("'")


@pytest.mark.parametrize("text", ["+x", "-1", "-1.5e-05", "left", "1", "a=b", "", "+"])
def test_a_name_with_a_sign_is_no_formula_and_keeps_its_bytes(text):
    assert not is_formula(text)
    assert csv_text(("run", "n"), [(text, 1)]).splitlines()[1] == f"{text},1"


def test_lines_and_names_from_paths_hold_no_control_characters(tmp_path):
    assert printable("a\x1b[2J\udce9\nb") == "a?[2J?\nb"
    assert name_of_path(tmp_path / "=+cmd()\x07") == "cmd()?"
    assert name_of_path(tmp_path / "=") == "unnamed"


def test_a_plan_beyond_any_lab_is_refused():
    for name, ends in (("x_m", (-1e300, 1e300, 5)), ("yaw_deg", (-1e5, 0, 2)), ("x_m", (0, 1, 10**30))):
        with pytest.raises(InputError):
            options_of({name: ends})
