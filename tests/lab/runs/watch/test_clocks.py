"""`beampose watch` with cameras that have clocks of their own: late, of different rates, with rolling shutters."""

from __future__ import annotations

import shutil
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from lab.errors import InputError
from lab.files.run.clocks import CameraClock, Times
from lab.files.text import columns
from lab.runs.watch.inbox import Inbox, PictureTimes, TimesFollower, is_complete
from lab.runs.watch.live_frames import WatchOptions
from lab.runs.watch.live_output import LIVE_TABLE
from lab.runs.watch.watch import watch_run
from lab.simulate.write import simulate
from tests.lab.runs.watch.test_watch import run_of_first_pictures
from tests.lab.tables import rows_of
from tracking.detections import Detections

FRAMES, EVERY = 24, 2
OPTIONS = WatchOptions(idle_s=1.5, timeout_s=5.0)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A left camera of 100 Hz, and a right one that is 1.3 frames late and takes every second picture."""
    run = simulate("clocks", tmp_path_factory.mktemp("clocks") / "run", seed=3, frames=FRAMES, scale=0.25)
    content = yaml.safe_load((run / "run.yaml").read_text())
    late_s = content["cameras"]["right"].pop("time_offset_s")
    folder = run / "frames/right"
    for number in range(FRAMES):
        picture = folder / f"{number:06d}.png"
        picture.rename(folder / f"{number // EVERY:06d}.png") if number % EVERY == 0 else picture.unlink()
    times = [f"{k},{k * EVERY / 100 + late_s:.9g}" for k in range(FRAMES // EVERY)]
    (run / "times-right.csv").write_text("\n".join(["frame,t_s", *times, ""]))
    content["cameras"]["right"]["timestamps"] = "times-right.csv"
    (run / "run.yaml").write_text(yaml.safe_dump(content))
    return run


def feed(recorded: Path, run: Path) -> None:
    """Copy the pictures of both cameras as they were taken; every time of the right one comes after its picture."""
    times = (recorded / "times-right.csv").read_text().splitlines(keepends=True)
    with (run / "times-right.csv").open("a") as table:
        table.write(times[0])
        for frame in range(FRAMES):
            for camera, number in [("left", frame), ("right", frame // EVERY)][: 2 if frame % EVERY == 0 else 1]:
                name = f"frames/{camera}/{number:06d}.png"
                shutil.copy(recorded / name, run / f"{name}.part")
                (run / f"{name}.part").rename(run / name)
                if camera == "right":
                    time.sleep(0.01)
                    table.write(times[1 + number])
                    table.flush()
            time.sleep(0.005)


@pytest.fixture(scope="module")
def watched(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("watched") / "run"
    for camera in ("left", "right"):
        (run / "frames" / camera).mkdir(parents=True)
    for name in ("rig.yaml", "run.yaml"):
        shutil.copy(recorded / name, run / name)
    thread = threading.Thread(target=feed, args=(recorded, run))
    thread.start()
    try:
        assert watch_run(run, run.parent / "out", options=OPTIONS).exit_status in (0, 4)
    finally:
        thread.join()
    return run.parent / "out"


def test_the_live_poses_are_the_causal_ones_of_the_finished_run(watched, recorded, tmp_path):
    causal = rows_of(run_of_first_pictures(recorded, tmp_path / "causal", causal=True) / "attitude.csv")
    live = rows_of(watched / LIVE_TABLE)
    assert len(live) == FRAMES
    assert sum(row["status"] == "measured" for row in live) > FRAMES // 4
    assert [{k: v for k, v in row.items() if k != columns.PICTURES} for row in live] == causal


def test_the_results_are_those_of_the_finished_run(watched, recorded, tmp_path):
    run_of_first_pictures(recorded, tmp_path / "again")
    for name in ("attitude.csv", "spots.csv", "covariance.csv", "detections.csv"):
        assert (watched / name).read_bytes() == (tmp_path / "again" / name).read_bytes()


def test_a_row_names_the_pictures_that_it_has_used(watched):
    used = [row[columns.PICTURES].split() for row in rows_of(watched / LIVE_TABLE)]
    assert used[0] == ["left:0"]
    assert used[1] == ["left:1", "right:0"]  # taken 1.3 frames after row 0
    both = [f"left:{k}" for k in range(FRAMES)] + [f"right:{k}" for k in range(FRAMES // EVERY)]
    assert sorted(name for row in used for name in row) == sorted(both)


@pytest.mark.parametrize(
    ("latest_s", "waited_s", "expected"),
    [
        (-0.003, 0.0, True),  # its next picture belongs to row 1
        (-0.012, 0.0, False),  # its next picture belongs to row 0, and is waited for ...
        (-0.012, 0.3, True),  # ... no longer than the timeout
    ],
)
def test_a_row_waits_for_the_next_picture_of_a_camera_with_times_of_its_own(latest_s, waited_s, expected):
    inbox = Inbox(("a", "b"), interval_s=0.01, timeout_s=0.2)
    inbox.queues["a"].times = PictureTimes(100.0)
    inbox.queues["b"].times = PictureTimes(100.0, CameraClock(times=Times(100.0)))
    inbox.add_times("b", [(0, latest_s - 0.01), (1, latest_s)])
    inbox.take(-1)
    inbox.put("b", 1, Detections.none(), None)
    inbox.put("a", 0, Detections.none(), None)
    now = time.perf_counter()
    assert is_complete(0, list(inbox.queues.values()), now + waited_s, now, 0.2, 0.01)[0] == expected


def test_a_picture_whose_time_comes_after_its_row_is_late():
    inbox = Inbox(("a",), interval_s=0.01, timeout_s=0.2)
    queue = inbox.queues["a"]
    queue.times = PictureTimes(100.0, CameraClock(times=Times(100.0)))
    inbox.put("a", 0, Detections.none(), None)
    inbox.take(5)
    inbox.add_times("a", [(0, 0.03)])
    assert (queue.late, list(queue.pictures)) == (1, [])


@pytest.mark.parametrize(("scatter_s", "wrong_s"), [(0.0, 0.004), (2e-4, 0.004), (2e-4, 0.0)])
def test_the_error_of_a_time_is_known_when_its_picture_comes(scatter_s, wrong_s):
    rng = np.random.default_rng(1)
    times = PictureTimes(100.0, CameraClock(times=Times(100.0)))
    for number in range(300):
        times.add([(number, number / 97 + rng.normal(0, scatter_s) + wrong_s * (number == 200))])
        sigma_s = times.clock.stamp_sigma_s(number)
        if number == 200 and wrong_s:
            assert sigma_s == pytest.approx(wrong_s, rel=0.2)
        elif number > 60:
            assert sigma_s == pytest.approx(scatter_s, rel=0.6, abs=1e-7)


def test_a_table_of_times_is_read_as_it_grows_and_must_rise(tmp_path):
    follower = TimesFollower(tmp_path / "times.csv", 100.0)
    assert follower.new() == []
    with follower.path.open("w") as table:
        for text, found in [("frame,t_s\n0,0.0", []), ("1\n1,0.02\n", [(0, 0.01), (1, 0.02)]), ("", [])]:
            table.write(text)
            table.flush()
            assert follower.new() == found
        table.write("2,0.015\n")
        table.flush()
        with pytest.raises(InputError, match="expected increasing times"):
            follower.new()


def test_times_in_another_unit_end_the_watch(tmp_path):
    follower = TimesFollower(tmp_path / "times.csv", 100.0)
    follower.path.write_text("frame,t_s\n0,0\n1,10\n")
    with pytest.raises(InputError, match="not milliseconds"):
        follower.new()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"frames": "frames/right", "time_offset_s": "estimate"}, "expected a known clock in a run that is watched"),
        ({"device": "nothing", "timestamps": "t.csv"}, "timestamps: expected none for a device"),
    ],
)
def test_clocks_that_cannot_be_used_live_are_an_input_error(recorded, tmp_path, change, words):
    run = tmp_path / "run"
    (run / "frames/left").mkdir(parents=True)
    (run / "frames/right").mkdir()
    shutil.copy(recorded / "rig.yaml", run / "rig.yaml")
    content = yaml.safe_load((recorded / "run.yaml").read_text())
    content["cameras"]["right"] = change
    (run / "run.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(InputError, match=words):
        watch_run(run, tmp_path / "out", options=OPTIONS)
