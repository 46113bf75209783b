"""`beampose track circle`: files, statuses and messages."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from cli import main
from lab.targets.circle import CIRCLE, DETECTORS, FORMS, CircleOptions, CircleTarget
from lab.targets.track import track_target
from tests.lab.command import typed
from tests.lab.tables import rows_of
from tests.tracking.drogue_circle.discs import discs

SIZE = (128, 96)


def place(k: int) -> tuple[float, float, float]:
    return 50.0 + 1.5 * k, 45.0 + 0.5 * k, 14.0


def picture(k: int) -> np.ndarray:
    return discs([place(k)], SIZE, seed=k)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Twelve pictures; number 5 is missing and number 7 is damaged."""
    path = tmp_path_factory.mktemp("recording") / "drogue"
    path.mkdir()
    for k in range(12):
        if k != 5:
            cv2.imwrite(str(path / f"{k:04d}.png"), picture(k))
    (path / "0007.png").write_bytes(b"\x89PNG damaged")
    return path


def video(path: Path, pictures: list[np.ndarray]) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), 50.0, SIZE, isColor=False)
    for one in pictures:
        writer.write(one)
    writer.release()
    return path


def rows(out: Path) -> list[dict[str, str]]:
    return rows_of(out / "circle.csv")


def test_a_folder_of_pictures_gives_all_files(folder, tmp_path):
    done = typed("track", "circle", folder, "--out", tmp_path / "out", "--rate", 50, "--video")
    assert done.exit_code == 0, done.output
    assert "10 of 12 frames measured" in done.output
    table = rows(tmp_path / "out")
    assert tuple(table[0]) == CIRCLE
    assert [int(r["frame"]) for r in table] == list(range(12))
    assert [r["frame"] for r in table if r["status"] == "predicted" and r["cause"] == "no_image"] == ["5", "7"]
    for k, row in enumerate(table):
        assert float(row["t_s"]) == pytest.approx(k / 50)
        if k > 2:
            assert np.hypot(float(row["u_px"]) - place(k)[0], float(row["v_px"]) - place(k)[1]) < 0.3
    assert float(table[-1]["rate_u_px_s"]) == pytest.approx(75.0, abs=4.0)
    assert table[5]["measured_u_px"] == table[5]["coverage"] == ""
    summary = json.loads((tmp_path / "out" / "summary.json").read_text("utf-8"))
    assert summary["verdict"]["status"] == "check"
    assert summary["counts"]["status"] == {"measured": 10, "predicted": 2, "lost": 0}
    assert summary["events"][0] == {"frame": 0, "kind": "acquired", "circles": 1}
    assert summary["inputs"][0]["sha256"]
    assert summary["command"].startswith("beampose track circle")
    page = (tmp_path / "out" / "report.html").read_text("utf-8")
    assert page.rstrip().endswith("</html>")
    assert "BP-T03" in page
    events = page.partition("circles in the picture")[2]
    assert re.findall(r"<td[^>]*>([^<]*)</td>", events)[:3:2] == ["0", "1"]
    assert not any(word in page for word in ("http://", "https://", ">nan<"))
    capture = cv2.VideoCapture(str(tmp_path / "out" / "overlay.mp4"))
    assert int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) == 12


def test_a_video_has_its_own_rate_and_the_same_circle(tmp_path):
    file = video(tmp_path / "drogue.avi", [picture(k) for k in range(6)])
    outcome = track_target(CircleTarget(), file, tmp_path / "out")
    assert (len(outcome.result.frames), outcome.result.measured.sum(), outcome.exit_status) == (6, 6, 0)
    assert float(rows(tmp_path / "out")[5]["t_s"]) == pytest.approx(0.1)
    assert not (tmp_path / "out" / "overlay.mp4").exists()


def test_several_edges_about_one_centre_are_reported_unless_one_is_chosen(tmp_path):
    file = video(
        tmp_path / "ring.avi", [cv2.circle(picture(k), (50 + round(1.5 * k), 45), 40, 20, 3) for k in range(6)]
    )
    done = typed("track", "circle", file, "--out", tmp_path / "out")
    assert "CHECK" in done.output
    assert "edges about one centre" in done.output
    evidence = json.loads((tmp_path / "out" / "summary.json").read_text("utf-8"))["verdict"]["evidence"]
    assert "BP-T06" in {e["code"] for e in evidence}
    assert "edges about" not in typed("track", "circle", file, "--out", tmp_path / "out", "--edge", "outer").output
    assert float(rows(tmp_path / "out")[0]["radius_px"]) == pytest.approx(41.5, abs=1.2)


def test_a_disc_without_the_chosen_edge_is_not_found_and_the_message_names_the_option(folder, tmp_path):
    done = typed("track", "circle", folder, "--out", tmp_path / "out", "--edge", "inner")
    assert done.exit_code == 4
    assert "has the target the chosen edge (--edge)" in done.output


def test_the_printed_form_is_another_tracker(folder, tmp_path):
    track_target(CircleTarget(CircleOptions(form="printed")), folder, tmp_path / "out")
    table = rows(tmp_path / "out")
    assert table[3]["measured_u_px"] == ""  # whole pixels, without a fit
    assert abs(float(table[3]["u_px"]) - place(3)[0]) < 4


@pytest.mark.parametrize(
    ("circles", "cause"),
    [([], "not_found"), ([(40.0, 48.0, 14.0), (90.0, 48.0, 14.0)], "ambiguous"), ([(64.0, 48.0, 100.0)], "not_found")],
)
def test_without_one_clear_circle_the_quality_gate_fails(tmp_path, circles, cause):
    (tmp_path / "pictures").mkdir()
    for k in range(3):
        cv2.imwrite(str(tmp_path / "pictures" / f"{k}.png"), discs(circles, SIZE, seed=k))
    done = typed("track", "circle", tmp_path / "pictures", "--out", tmp_path / "out")
    assert done.exit_code == 4
    assert "no circle was found" in done.output
    table = rows(tmp_path / "out")
    assert {(r["status"], r["cause"], r["u_px"]) for r in table} == {("lost", cause, "")}
    if cause == "ambiguous":
        assert "--near" in done.output
        assert (
            typed("track", "circle", tmp_path / "pictures", "--out", tmp_path / "out", "--near", 90, 48).exit_code == 0
        )
        assert float(rows(tmp_path / "out")[0]["u_px"]) == pytest.approx(90.0, abs=0.1)


def test_a_video_that_is_cut_off_is_tracked_to_its_end(tmp_path):
    whole = video(tmp_path / "whole.avi", [picture(k) for k in range(12)])
    (tmp_path / "cut.avi").write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    done = typed("track", "circle", tmp_path / "cut.avi", "--out", tmp_path / "out")
    if done.exit_code != 2:  # OpenCV may refuse such a file
        table = rows(tmp_path / "out")
        assert 1 <= len(table) < 12
        assert float(table[0]["u_px"]) == pytest.approx(place(0)[0], abs=0.1)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--min-radius", 20, "--max-radius", 10), "--max-radius: expected more than --min-radius (20 px), got 10"),
        (("--near", "nan", 3), "finite"),
        (("--rate", 0), "0.01"),
    ],
)
def test_a_wrong_option_is_one_plain_line(folder, tmp_path, arguments, words):
    done = typed("track", "circle", folder, "--out", tmp_path / "out", *arguments)
    assert done.exit_code == 2
    assert words in done.output
    assert not (tmp_path / "out").exists()


def test_the_command_offers_the_detectors_and_forms_that_exist():
    parameters = main.commands["track"].commands["circle"].params
    options = {p.name: p.type.choices for p in parameters if p.name in ("detector", "form")}
    assert tuple(options["detector"]) == tuple(DETECTORS)
    assert tuple(options["form"]) == FORMS
