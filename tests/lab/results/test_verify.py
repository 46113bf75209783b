"""`beampose verify`: an unchanged result is the same; any change of a table or an input is found and named."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from lab.errors import InputError
from lab.files.run import fingerprints
from lab.results.verify import difference_of, read_recorded, verify
from lab.simulate.write import simulate
from tests.lab.command import typed


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run of points (`run`) and its results (`out`), made with a parameter that is not the default."""
    folder = tmp_path_factory.mktemp("verify")
    run = simulate("smooth", folder / "run", seed=5, frames=12, points=True)
    arguments = [
        "run",
        str(run),
        "--out",
        str(folder / "out"),
        "--set",
        "r1_px=12",
        "--set",
        "detect.threshold_sigma=6",
    ]
    done = typed(*arguments)
    assert done.exit_code == 0, done.output
    return folder


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    """The same in a folder of its own, where it may be changed; summary.json still names the first run folder."""
    shutil.copytree(made, tmp_path / "copy")
    return tmp_path / "copy"


def test_an_unchanged_result_is_the_same(made):
    found = verify(made / "out")
    assert (found.result.identical, found.exit_status, found.result.versions) == (True, 0, ())
    assert {"attitude.csv", "attitude_causal.csv", "spots.csv", "covariance.csv"} <= set(found.result.tables)
    assert found.lines[0].startswith(f"SAME: {len(found.result.tables)} of {len(found.result.tables)} tables")


def test_a_causal_result_with_full_fingerprints_is_computed_without_smoothing(made, tmp_path, monkeypatch):
    arguments = ["run", str(made / "run"), "--out", str(tmp_path / "out"), "--causal", "--full-hash"]
    read: list[Path] = []
    of_file = fingerprints._of_file
    with monkeypatch.context() as m:
        m.setattr(fingerprints, "MAX_HASHED_BYTES", 100)
        m.setattr(fingerprints, "_of_file", lambda path, full: read.append(path) or of_file(path, full))
        assert typed(*arguments).exit_code == 0
    inputs = json.loads((tmp_path / "out" / "summary.json").read_text())["inputs"]
    assert {entry["covers"] for entry in inputs} == {"contents"}
    assert sorted(map(str, read)) == sorted(entry["path"] for entry in inputs)  # each once
    found = verify(tmp_path / "out")
    assert found.result.identical
    assert "attitude_causal.csv" not in found.result.tables


def test_a_run_that_has_moved_is_compared_too(copy):
    assert verify(copy / "out", copy / "run").result.identical


def test_a_changed_digit_is_named_with_its_row_and_column(copy):
    path = copy / "out" / "attitude.csv"
    lines = path.read_text().splitlines(keepends=True)
    header, fields = lines[0].strip().split(","), lines[8].split(",")
    fields[header.index("z_m")] = "7"
    lines[8] = ",".join(fields)
    path.write_text("".join(lines))
    found = verify(copy / "out")
    assert (found.exit_status, len(found.result.differences)) == (4, 1)
    text = str(found.result.differences[0])
    assert text.startswith("attitude.csv: line 9 (frame 7): z_m: recorded '7', computed ")
    assert text.endswith(f"(1 of {len(lines)} lines differ)")


def test_a_table_that_is_missing_or_not_computed_any_more_is_a_difference(copy):
    (copy / "out" / "beams.csv").unlink()
    (copy / "out" / "systematic.csv").write_text("frame\n")
    texts = [str(d) for d in verify(copy / "out").result.differences]
    assert texts == [
        "beams.csv: is missing in the results",
        "systematic.csv: is in the results, but is not computed any more",
    ]


def test_changed_inputs_are_named(copy):
    path = copy / "run" / "detections.csv"
    path.write_text(path.read_text().replace("\n0,left,", "\n0,left,0", 1))
    found = verify(copy / "out", copy / "run")
    assert [t.split(": ")[0] for t in found.result.inputs.changed] == [str(path)]
    assert found.exit_status == 4


def test_an_input_that_was_not_recorded_is_not_compared_and_a_lost_one_is_a_change(copy):
    path = copy / "out" / "summary.json"
    content = json.loads(path.read_text())
    content["inputs"] = [i for i in content["inputs"] if not i["path"].endswith("rig.yaml")]
    content["inputs"].append({"path": "times.csv", "sha256": "0", "bytes": 1, "covers": "contents"})
    path.write_text(json.dumps(content))
    found = verify(copy / "out").result.inputs
    assert [t.split(": ")[1] for t in found.not_compared] == ["no fingerprint was recorded"]
    assert found.changed == ("times.csv: was an input, is none now",)


def test_other_versions_are_named_and_are_no_difference(copy):
    path = copy / "out" / "summary.json"
    content = json.loads(path.read_text())
    content["versions"]["numpy"] = "1.0"
    path.write_text(json.dumps(content))
    found = verify(copy / "out")
    assert found.result.identical
    assert [v.split(",")[0] for v in found.result.versions] == ["numpy 1.0"]


def test_the_parameters_of_the_command_line_are_those_of_the_recomputation(made):
    tracker = read_recorded(made / "out").tracker
    assert (tracker.r1_px, tracker.detect.threshold_sigma) == (12, 6)


def test_the_summary_has_the_command_line(made):
    content = json.loads((made / "out" / "summary.json").read_text())
    assert content["command"] == (
        f"beampose run {made / 'run'} --out {made / 'out'} --set r1_px=12 --set detect.threshold_sigma=6"
    )


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"schema": "beampose/summary/1"}', "{"])
def test_a_damaged_summary_is_an_input_error(tmp_path, text):
    (tmp_path / "summary.json").write_text(text)
    with pytest.raises(InputError, match=r"summary\.json"):
        verify(tmp_path)


def test_a_run_folder_that_has_gone_is_an_input_error(copy):
    path = copy / "out" / "summary.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps({**content, "run_folder": str(copy / "gone")}))
    with pytest.raises(InputError, match=r"its run folder .* is not there; name it with --run"):
        verify(copy / "out")


@pytest.mark.parametrize(
    ("recorded", "computed", "text"),
    [
        (
            "frame,a\n0,1\n",
            "frame,a\n0,1\n1,2\n",
            "line 3 is missing (1 of 3 lines differ; 2 lines recorded, 3 computed)",
        ),
        ("frame,a\n0,1\n1,2\n", "frame,a\n0,1\n", "line 3 is not computed"),
        ("frame,a\r\n0,1\n", "frame,a\n0,1\n", "line 1: other bytes at the same fields"),
        ("frame,a,b\n0,1,2\n", "frame,a\n0,1\n", "line 1: field 3: recorded 'b', computed 'nothing'"),
        ('spot,a\n"x,y",1\n', 'spot,a\n"x,y",2\n', "line 2: a: recorded '1', computed '2' (1 of 2 lines differ)"),
        ("frame,x\n0,1\r2\n", "frame,x\n0,1\n", "line 2 (frame 0): frame: recorded '0,1\\r2', computed '0'"),
        ("frame,x\n0," + "1" * 200_000, "frame,x\n0,1\n", "line 2 (frame 0): frame: recorded '0,111"),
    ],
)
def test_each_kind_of_difference_has_its_words(tmp_path, recorded, computed, text):
    for name, content in (("old", recorded), ("new", computed)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "t.csv").write_bytes(content.encode())
    found = difference_of(tmp_path / "old" / "t.csv", tmp_path / "new" / "t.csv")
    assert found is not None
    assert found.startswith(f"t.csv: {text}")
