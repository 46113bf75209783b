"""What `beampose track` does alike for every kind of target: bad input, gaps, other people's folders, the verdict."""

import json

import cv2
import numpy as np
import pytest

from lab.findings.finding import Level, finding
from tests.lab.command import typed
from tests.lab.tables import rows_of
from tests.tracking.drogue_circle.discs import discs

SIZE = (128, 96)
TABLES = {"circle": "circle.csv", "drogue": "drogue.csv", "point": "track.csv"}
pytestmark = pytest.mark.parametrize("kind", TABLES)


def picture(k):
    """A bright disc that moves."""
    return discs([(50.0 + 1.5 * k, 45.0 + 0.5 * k, 14.0)], SIZE, seed=k)


def tracked(kind, *arguments):
    detector = ["--detector", "brighter"] if kind == "point" else []
    return typed("track", kind, *arguments, *detector)


def result(kind, out):
    """Rows of the table, and the summary."""
    return rows_of(out / TABLES[kind]), json.loads((out / "summary.json").read_text("utf-8"))


def write(folder, pictures):
    folder.mkdir()
    for k, one in pictures.items():
        cv2.imwrite(str(folder / f"{k:04d}.png"), one)
    return folder


def test_an_empty_or_broken_video_is_one_line_and_leaves_the_results(kind, tmp_path):
    tracked(kind, write(tmp_path / "good", {k: picture(k) for k in range(3)}), "--out", tmp_path / "out")
    before = (tmp_path / "out" / TABLES[kind]).read_bytes()
    broken = {"empty.avi": b"", "broken.avi": b"RIFF\0\0\0\0AVI " + bytes(200), "text.mp4": b"hello" * 100}
    for name, content in broken.items():
        (tmp_path / name).write_bytes(content)
        done = tracked(kind, tmp_path / name, "--out", tmp_path / "out")
        assert done.exit_code == 2
        assert len(done.output.strip().splitlines()) == 1
        assert f"{name}: expected a picture" in done.output
    assert (tmp_path / "out" / TABLES[kind]).read_bytes() == before


def test_a_missing_input_and_a_folder_of_something_else_are_refused(kind, tmp_path):
    assert tracked(kind, tmp_path / "nothing", "--out", tmp_path / "out").exit_code == 2
    (tmp_path / "kept").mkdir()
    (tmp_path / "kept" / "thesis.txt").write_text("mine")
    done = tracked(kind, write(tmp_path / "disc", {0: picture(0)}), "--out", tmp_path / "kept")
    assert done.exit_code == 2
    assert "something other than earlier results" in done.output


def test_dropped_frames_and_pictures_of_another_size_are_rows_without_a_measurement(kind, tmp_path):
    pictures = {k: picture(k)[: 80 if k in (5, 6) else None] for k in range(12) if k != 8}
    done = tracked(kind, write(tmp_path / "disc", pictures), "--out", tmp_path / "out")
    rows, summary = result(kind, tmp_path / "out")
    assert [int(r["frame"]) for r in rows] == list(range(12))
    unmeasured = [k for k, row in enumerate(rows) if row["status"] != "measured"]
    assert unmeasured == [5, 6, 8] if kind != "drogue" else {5, 6, 8} <= set(unmeasured)  # a disc is no drogue
    size = "another size: 128x80 px, the first picture has 128x96"
    assert summary["counts"]["no_image_reasons"] == {size: 2, "dropped": 1}
    assert summary["counts"]["not_measured"]["no_image"] == 3
    assert f"3 of 12 frames have no usable picture (most frequent: {size})" in summary["verdict"]["reasons"]
    assert "more in the report" in done.output


def test_numbers_that_are_no_frame_numbers_are_refused(kind, tmp_path):
    done = tracked(kind, write(tmp_path / "disc", {0: picture(0), 90_000_000: picture(1)}), "--out", tmp_path / "out")
    assert done.exit_code == 2
    assert "expected pictures numbered by frame" in done.output


def test_without_a_target_the_verdict_has_the_shape_of_that_of_a_run(kind, tmp_path):
    empty = {k: np.full((96, 128), 60, np.uint8) for k in range(4)}
    done = tracked(kind, write(tmp_path / "empty", empty), "--out", tmp_path / "out")
    rows, summary = result(kind, tmp_path / "out")
    verdict = summary["verdict"]
    assert done.exit_code == verdict["exit_status"] == 4
    assert done.output.startswith("empty: FAIL: 0 of 4 frames measured (no ")
    assert {(r["status"], r["u_px"]) for r in rows} == {("lost", "")}
    assert verdict["status"] == "fail"
    assert verdict["reasons"] == [e["what"] for e in verdict["evidence"]]
    of_run = finding("BP-V02", Level.FAIL, "what").as_mapping()
    assert of_run.keys() == verdict["evidence"][0].keys()
    assert verdict["evidence"][0]["level"] == of_run["level"] == "fail"
    assert verdict["evidence"][0]["remedy"].split("? ")[0] in done.output  # its first sentence
    page = (tmp_path / "out" / "report.html").read_text("utf-8")
    assert verdict["evidence"][0]["code"] in page
    assert "FAIL" in page
