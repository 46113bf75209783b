"""`beampose track drogue`: files, statuses and messages, with rendered drogues and the learned detector."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from bench.related_measurements.drogue_sequences import moving_drogue
from geometry.camera import Camera
from geometry.pose import Pose
from lab.targets.drogue import DROGUE, DrogueOptions, DrogueTarget
from lab.targets.track import track_target
from studies.drogue.render import render_drogue
from studies.drogue.scene import PICTURE, SKY, DrogueBackground, DrogueScene
from tests.lab.command import typed
from tests.lab.tables import rows_of

SIZE, FOCAL = (224, 160), 400.0


def drogue(u: float, v: float, diameter: float, seed: int, before: np.ndarray | None = None) -> np.ndarray:
    """(h, w, 3) a drogue before the sky, or before another picture. u is beyond the picture for none."""
    matrix = np.array([[FOCAL, 0, (SIZE[0] - 1) / 2], [0, FOCAL, (SIZE[1] - 1) / 2], [0, 0, 1]])
    camera = Camera("camera", "", SIZE, matrix, (), Pose(np.eye(3), np.zeros(3)))
    distance = 0.6 * FOCAL / diameter
    x, y = (u - matrix[0, 2]) / FOCAL, (v - matrix[1, 2]) / FOCAL
    behind = DrogueBackground(SKY, 3)
    if before is not None:
        # The background is larger than the picture and its middle is shown: a border keeps the picture's scale.
        border = SIZE[1] // 4, SIZE[1] // 4, SIZE[0] // 4, SIZE[0] // 4
        behind = DrogueBackground(PICTURE, 3, picture=cv2.copyMakeBorder(before, *border, cv2.BORDER_REPLICATE))
    pose = Pose(np.eye(3), distance * np.array([x, y, 1.0]))
    return render_drogue(DrogueScene(camera, pose, background=behind), np.random.default_rng(seed)).image


def place(k: int) -> tuple[float, float, float]:
    return 70.0 + 3.0 * k, 80.0 - 1.0 * k, 26.0 + 0.4 * k


@pytest.fixture(scope="module")
def pictures() -> list[np.ndarray]:
    return [drogue(*place(k), seed=k) for k in range(14)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory, pictures) -> Path:
    """Fourteen pictures; number 6 is missing and number 8 is damaged."""
    path = tmp_path_factory.mktemp("recording") / "drogue"
    path.mkdir()
    for k, picture in enumerate(pictures):
        if k != 6:
            cv2.imwrite(str(path / f"{k:04d}.png"), picture)
    (path / "0008.png").write_bytes(b"\x89PNG damaged")
    return path


def video(path: Path, pictures: list[np.ndarray]) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), 50.0, SIZE)
    for one in pictures:
        writer.write(one)
    writer.release()
    return path


def rows(out: Path) -> list[dict[str, str]]:
    return rows_of(out / "drogue.csv")


def test_a_folder_of_pictures_gives_all_files(folder, tmp_path):
    done = typed("track", "drogue", folder, "--out", tmp_path / "out", "--rate", 50, "--video")
    assert done.exit_code == 0, done.output
    assert "12 of 14 frames measured" in done.output
    table = rows(tmp_path / "out")
    assert tuple(table[0]) == DROGUE
    assert [int(r["frame"]) for r in table] == list(range(14))
    assert [r["frame"] for r in table if r["status"] == "predicted" and r["cause"] == "no_image"] == ["6", "8"]
    for k, row in enumerate(table):
        u, v, diameter = place(k)
        assert float(row["t_s"]) == pytest.approx(k / 50)
        assert np.hypot(float(row["u_px"]) - u, float(row["v_px"]) - v) < 0.12 * diameter
        assert float(row["diameter_px"]) == pytest.approx(diameter, rel=0.2)
        assert row["status"] != "measured" or float(row["confidence"]) >= 0.5
    assert {r["source"] for r in table} == {"detector", "light", "both", ""}
    assert float(table[-1]["rate_u_px_s"]) == pytest.approx(150.0, abs=25)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text("utf-8"))
    assert summary["schema"] == "beampose/drogue/1"
    assert summary["verdict"]["status"] == "check"
    assert summary["counts"]["status"] == {"measured": 12, "predicted": 2, "lost": 0}
    assert summary["events"] == [{"frame": 0, "kind": "acquired", "drogues": 1}]
    assert sum(summary["drogue"]["sources"].values()) == 12
    assert sum(summary["drogue"]["detector_searched"].values()) == 14
    assert summary["parameters"]["tracker"]["check_every"] == 5
    assert summary["inputs"][0]["sha256"]
    assert summary["command"].startswith("beampose track drogue")
    page = (tmp_path / "out" / "report.html").read_text("utf-8")
    assert page.rstrip().endswith("</html>")
    assert "tracked drogue" in page
    assert "BP-G03" in page
    assert not any(word in page for word in ("http://", "https://", ">nan<"))
    capture = cv2.VideoCapture(str(tmp_path / "out" / "overlay.mp4"))
    assert int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) == 14


def test_a_video_has_its_own_rate_and_the_same_drogue(tmp_path, pictures):
    outcome = track_target(
        DrogueTarget(DrogueOptions(check_every=2)), video(tmp_path / "drogue.avi", pictures[:6]), tmp_path / "out"
    )
    assert (len(outcome.result.frames), outcome.result.measured.sum(), outcome.exit_status) == (6, 6, 0)
    assert float(rows(tmp_path / "out")[5]["t_s"]) == pytest.approx(0.1)


def test_without_one_clear_drogue_the_quality_gate_fails(tmp_path):
    left = drogue(60.0, 80.0, 40.0, 1)
    both = drogue(165.0, 80.0, 40.0, 1, before=left)
    cases = {"empty": drogue(2000.0, 80.0, 40.0, 1), "two": both}
    for name, picture in cases.items():
        (tmp_path / name).mkdir()
        for k in range(3):
            cv2.imwrite(str(tmp_path / name / f"{k}.png"), picture)
        done = typed("track", "drogue", tmp_path / name, "--out", tmp_path / f"out-{name}")
        assert done.exit_code == 4, name
        assert "no drogue was found" in done.output
        cause = "ambiguous" if name == "two" else "not_found"
        table = rows(tmp_path / f"out-{name}")
        assert {(r["status"], r["cause"], r["u_px"], r["confidence"]) for r in table} == {("lost", cause, "", "0.0000")}
    assert "--near" in done.output
    assert typed("track", "drogue", tmp_path / "two", "--out", tmp_path / "out-two", "--near", 165, 80).exit_code == 0
    assert float(rows(tmp_path / "out-two")[0]["u_px"]) == pytest.approx(165.0, abs=3)


@pytest.mark.parametrize("truth", [(112.0, 80.0, 900.0), (420.0, 80.0, 700.0), (300.0, 260.0, 500.0)])
def test_of_a_drogue_larger_than_the_picture_no_wrong_place_is_reported(tmp_path, truth):
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"{k}.png"), drogue(*truth, seed=k))
    done = typed("track", "drogue", tmp_path, "--out", tmp_path / "out")
    places = [(float(r["u_px"]), float(r["v_px"])) for r in rows(tmp_path / "out") if r["status"] == "measured"]
    # The rear end of the basket is a circle too: where it is in view it has the right centre.
    assert all(np.hypot(u - truth[0], v - truth[1]) < truth[2] / 4 for u, v in places)
    assert done.exit_code == (0 if len(places) == 3 else 4)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--min-diameter", 60, "--max-diameter", 40), "--max-diameter: expected more than --min-diameter (60 px)"),
        (("--min-diameter", 3), "--min-diameter"),
        (("--every", 0), "--every"),
        (("--near", "nan", 3), "finite"),
    ],
)
def test_a_wrong_option_is_one_message(folder, tmp_path, arguments, words):
    done = typed("track", "drogue", folder, "--out", tmp_path / "out", *arguments)
    assert done.exit_code == 2
    assert words in done.output
    assert not (tmp_path / "out").exists()


def test_a_sequence_has_its_drogue_where_it_says_and_hides_it_at_times():
    every = list(moving_drogue(5, 3, (40.0, 60.0)))
    for frame in every:
        assert frame.hidden == 0
        assert 35 < frame.diameter_px < 65
        # Seen from the front a drogue is no part of the smooth sky: its surroundings have the larger contrast.
        u, v, reach = *np.rint(frame.centre_px).astype(int), int(frame.diameter_px / 2)
        assert frame.picture[v - reach : v + reach, u - reach : u + reach].std() > 10
    assert np.array_equal(every[0].picture, next(iter(moving_drogue(5, 3, (40.0, 60.0)))).picture)
    assert np.isnan(next(iter(moving_drogue(5, 2, empty=True))).centre_px).all()


@pytest.mark.slow
def test_small_drogues_are_held_where_the_detector_alone_misses_them():
    from bench.related_measurements.light_tracker import ALL_PX, compare

    record = compare(77, 6, 120, ALL_PX, 5, rivals=False)
    error, hidden = np.array(record.errors), np.array(record.hidden)
    assert np.mean(error[hidden < 0.5] < 0.25) > 0.9
