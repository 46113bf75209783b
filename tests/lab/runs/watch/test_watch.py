"""`beampose watch`: a run that is processed while it is recorded."""

from __future__ import annotations

import json
import shutil
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from lab.errors import InputError, RunError
from lab.files.run.run_file import LiveDevice, load_run
from lab.files.text import columns
from lab.findings.finding import Outcome
from lab.pictures.live_source import OpenCvSource
from lab.pictures.picture_file import MissingPicture, read_picture
from lab.runs.frames import sensor_noise
from lab.runs.process import process_run
from lab.runs.verdict.run_statistics import RunStatistics
from lab.runs.watch import watch
from lab.runs.watch.cameras import DeviceCamera, FolderCamera, FolderPoll, FrameClock
from lab.runs.watch.inbox import MOST_WAITING, Inbox, is_complete
from lab.runs.watch.live_frames import FIRST, WatchOptions
from lab.runs.watch.live_output import LIVE_TABLE, Latency
from lab.runs.watch.watch import watch_run
from lab.simulate.scenarios import SCENARIOS, Light
from lab.simulate.write import simulate
from tests.lab.tables import rows_of
from tracking.detections import Detections

FRAMES = 24
FAST = WatchOptions(idle_s=1.0, timeout_s=5.0)  # long enough that no camera times out on a busy machine
IMPATIENT = WatchOptions(idle_s=1.5, timeout_s=1.0)
PATIENT = WatchOptions(idle_s=60.0, timeout_s=60.0)  # ends when it is stopped; no camera times out


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate("smooth", tmp_path_factory.mktemp("recorded") / "run", seed=3, frames=FRAMES, scale=0.25)


def run_of_first_pictures(run: Path, out: Path, causal: bool = False) -> Path:
    """The results of `beampose run` with the noise estimated from the first pictures, as in a watch."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sensor_noise, "noise_estimation_frames", lambda pictures: list(range(min(FIRST, pictures))))
        patch.setattr(sensor_noise, "VIDEO_PICTURES", tuple(range(FIRST)))
        return process_run(run, out, causal=causal).out


@pytest.fixture(scope="module")
def processed(recorded: Path) -> Path:
    return run_of_first_pictures(recorded, recorded.parent / "out")


def empty_copy(recorded: Path, folder: Path) -> Path:
    """The run before its first picture."""
    folder.mkdir()
    for name in ("rig.yaml", "run.yaml"):
        shutil.copy(recorded / name, folder / name)
    for camera in ("left", "right"):
        (folder / "frames" / camera).mkdir(parents=True)
    return folder


def write_picture(source: Path, target: Path, in_two: bool = False) -> None:
    data = source.read_bytes()
    with target.open("wb", buffering=0) as file:
        if in_two:
            file.write(data[: len(data) // 2])
            time.sleep(0.02)
            data = data[len(data) // 2 :]
        file.write(data)


def feed(recorded: Path, run: Path, given: Callable[[str, int], bool] = lambda camera, frame: True) -> None:
    """Copy the pictures one by one, every fourth in two writes."""
    for frame in range(FRAMES):
        for camera in ("left", "right"):
            name = f"frames/{camera}/{frame:06d}.png"
            if given(camera, frame):
                write_picture(recorded / name, run / name, in_two=frame % 4 == 1)
        time.sleep(0.005)


def feed_and_stop(recorded: Path, run: Path, out: Path, stop: threading.Event) -> bool:
    """Copy the pictures and stop the watch when the live table has all frames. Whether it had them within 20 s."""
    feed(recorded, run)
    until = time.monotonic() + 20
    while time.monotonic() < until and not _has_rows(out / LIVE_TABLE, FRAMES):
        time.sleep(0.02)
    stop.set()
    return _has_rows(out / LIVE_TABLE, FRAMES)


def watched(run: Path, out: Path, feeder: Callable[[], None], **options: object) -> Outcome[RunStatistics]:
    """Watch a run while a thread writes its pictures."""
    thread = threading.Thread(target=feeder)
    thread.start()
    try:
        return watch_run(run, out, **{"options": FAST, **options})
    finally:
        thread.join()


@pytest.fixture(scope="module")
def followed(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[dict]]:
    """The results of a watched run that is stopped after its last picture, and the lines received by UDP."""
    run, ready = empty_copy(recorded, tmp_path_factory.mktemp("live") / "run"), threading.Event()
    stop, all_there = threading.Event(), []
    load_compiled_code = watch._load_compiled_code

    def feeder() -> None:
        assert ready.wait(600)  # compiling takes minutes; without pictures the watch waits for ever
        all_there.append(feed_and_stop(recorded, run, run.parent / "out", stop))

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener, pytest.MonkeyPatch.context() as patch:
        patch.setattr(watch, "_load_compiled_code", lambda run: (load_compiled_code(run), ready.set()))
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(0.5)
        address = f"127.0.0.1:{listener.getsockname()[1]}"
        more = {"options": PATIENT, "stop": stop, "provenance": {"command": "beampose watch"}}
        outcome = watched(run, run.parent / "out", feeder, udp=address, **more)
        lines = [json.loads(listener.recv(10_000)) for _ in range(FRAMES)]
    assert outcome.exit_status == 0, outcome.line()
    assert all_there == [True]  # each frame is in the live table at once, not when a buffer is full
    assert outcome.result.frames == FRAMES
    return run.parent / "out", lines


@pytest.mark.parametrize("name", ["attitude.csv", "spots.csv", "beams.csv", "covariance.csv", "detections.csv"])
def test_the_results_are_those_of_the_finished_folder(followed, processed, name):
    assert (followed[0] / name).read_bytes() == (processed / name).read_bytes()


def test_the_live_table_is_that_of_a_causal_run(followed, recorded, tmp_path):
    causal = run_of_first_pictures(recorded, tmp_path / "causal", causal=True)
    assert (followed[0] / LIVE_TABLE).read_bytes() == (causal / "attitude.csv").read_bytes()


def test_a_line_of_json_is_sent_for_every_frame(followed):
    out, lines = followed
    live = rows_of(out / LIVE_TABLE)
    assert [line["frame"] for line in lines] == list(range(FRAMES))
    assert [line["status"] for line in lines] == [row["status"] for row in live]
    last, row = lines[-1], live[-1]
    assert last["position_m"] == pytest.approx([float(row[c]) for c in ("x_m", "y_m", "z_m")])
    assert last["quaternion_wxyz"] == pytest.approx([float(row[c]) for c in ("qw", "qx", "qy", "qz")])
    assert last["sigma_yaw_pitch_roll_deg"][0] == pytest.approx(float(row["sigma_yaw_deg"]))
    assert 0 <= last["latency_ms"] < 10_000


def test_the_summary_contains_the_latency_of_the_poses_and_the_command(followed):
    summary = json.loads((followed[0] / "summary.json").read_text("utf-8"))
    live = summary["live"]
    assert summary["command"] == "beampose watch"
    latency = live["latency_ms"]
    assert latency["frames"] + latency["start_frames"] == FRAMES
    assert live["udp"]["not_sent"] == 0


@pytest.mark.parametrize(
    ("latency", "late"),
    [
        (Latency(steady=[6.0, 1500.0, 6.0]), False),
        (Latency(start=[2500.0, 900.0]), False),
        (Latency(steady=[6.0, 400.0, 1400.0]), True),
        (Latency(start=[900.0, 2500.0]), True),  # the backlog of the start has grown
    ],
)
def test_a_watch_that_has_not_kept_up_says_what_became_of_the_pictures(latency, late):
    said = [line for line in latency.lines() if "faster than they were processed" in line]
    assert bool(said) == late
    assert all(f"{latency.as_mapping()['last'] / 1e3:.1f} s after" in line and "are all used" in line for line in said)


@pytest.mark.slow
def test_pictures_that_come_faster_than_they_are_searched_wait_for_the_first_background(tmp_path):
    """On a rough screen spots are found in front of a background only: here from the first picture on."""
    rough = replace(SCENARIOS["smooth"], light=Light(texture=0.12, peak_dn=20.0, background_dn=40.0))
    run = simulate(rough, tmp_path / "run", seed=3, frames=50, scale=0.25)
    shown = {}
    for rate_hz in (10.0, 10_000.0):
        text = yaml.safe_load((run / "run.yaml").read_text("utf-8"))
        (run / "run.yaml").write_text(yaml.safe_dump({**text, "frame_rate_hz": rate_hz, "exposure_s": 1e-5}), "utf-8")
        watch_run(run, tmp_path / "out", options=FAST)
        first = [row for row in rows_of(tmp_path / "out" / "detections.csv") if int(row["frame"]) < 30]
        shown[rate_hz] = [sum(row["camera"] == name for row in first) / 30 for name in ("left", "right")]
    assert max(shown[10.0]) < 1.0
    assert min(shown[10_000.0]) > 3.0


@pytest.mark.slow
def test_a_camera_that_stops_does_not_stop_the_other(recorded, tmp_path):
    run = empty_copy(recorded, tmp_path / "run")

    def feeder() -> None:
        feed(recorded, run, lambda camera, frame: camera == "left" or frame < 10)

    watched(run, tmp_path / "out", feeder, options=IMPATIENT)
    spots = rows_of(tmp_path / "out/spots.csv")
    assert {int(r["frame"]) for r in spots} == set(range(FRAMES))
    assert {r["status"] for r in spots if r["camera"] == "right" and int(r["frame"]) >= 10} == {"no_image"}
    assert all(r["status"] == "matched" for r in spots if r["camera"] == "left" and int(r["frame"]) == FRAMES - 1)
    reasons = json.loads((tmp_path / "out/summary.json").read_text("utf-8"))["counts"]["no_image_reasons"]
    assert reasons == {"right": {"dropped": FRAMES - 10}}
    run_of_first_pictures(run, tmp_path / "again")
    assert (tmp_path / "out/attitude.csv").read_bytes() == (tmp_path / "again/attitude.csv").read_bytes()


def test_dropped_and_damaged_pictures_are_treated_as_in_a_run(recorded, tmp_path):
    run = empty_copy(recorded, tmp_path / "run")

    def given(camera: str, frame: int) -> bool:
        if (camera, frame) == ("right", 15):
            whole = (recorded / "frames/right/000015.png").read_bytes()
            (run / "frames/right/000015.png").write_bytes(whole[:99])
        return frame != 9 and (camera, frame) not in {("left", 12), ("right", 15)}

    watched(run, tmp_path / "out", lambda: feed(recorded, run, given), options=IMPATIENT)
    run_of_first_pictures(run, tmp_path / "again")
    assert (tmp_path / "out/attitude.csv").read_bytes() == (tmp_path / "again/attitude.csv").read_bytes()


def test_reprocessed_results_are_those_of_a_run(recorded, tmp_path):
    run = empty_copy(recorded, tmp_path / "run")
    out, stop = tmp_path / "out", threading.Event()
    more = {"options": PATIENT, "stop": stop, "reprocess": True}
    watched(run, out, lambda: feed_and_stop(recorded, run, out, stop), **more)
    process_run(recorded, tmp_path / "again")
    for name in ("attitude.csv", "attitude_causal.csv", "detections.csv"):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "again" / name).read_bytes()
    assert len(rows_of(tmp_path / "out" / LIVE_TABLE)) == FRAMES


def test_stopping_ends_the_recording_and_writes_the_results(followed):
    assert (followed[0] / "report.html").is_file()


def _has_rows(path: Path, count: int) -> bool:
    return path.is_file() and len(path.read_text().splitlines()) >= 1 + count


def test_a_recording_without_a_picture_is_an_error_and_leaves_nothing(recorded, tmp_path):
    run, stop = empty_copy(recorded, tmp_path / "run"), threading.Event()
    stop.set()
    with pytest.raises(RunError, match="expected pictures while the run was watched, got none"):
        watch_run(run, tmp_path / "out", stop=stop)
    assert {p.name for p in tmp_path.iterdir()} == {"run"}


def test_only_the_live_table_of_a_killed_watch_may_be_replaced(recorded, tmp_path):
    run = empty_copy(recorded, tmp_path / "run")
    feed(recorded, run)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / LIVE_TABLE).write_text("frame\n")
    assert watch_run(run, tmp_path / "out", options=FAST).result.frames == FRAMES
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis/chapter.tex").write_text("years")
    with pytest.raises(InputError, match="something other than earlier results"):
        watch_run(run, tmp_path / "thesis", options=FAST)


def test_a_device_with_an_end_has_the_results_of_its_pictures(tmp_path):
    recorded = simulate("smooth", tmp_path / "video", seed=3, frames=FRAMES, scale=0.25, video=True)
    content = yaml.safe_load((recorded / "run.yaml").read_text())
    ordinary = run_of_first_pictures(recorded, tmp_path / "ordinary")
    for camera in content["cameras"].values():
        camera["device"] = str(recorded / camera.pop("frames"))
    (recorded / "run.yaml").write_text(yaml.safe_dump(content))
    outcome = watch_run(recorded, tmp_path / "out", options=FAST)
    assert (outcome.out / "attitude.csv").read_bytes() == (ordinary / "attitude.csv").read_bytes()
    with pytest.raises(InputError, match="a live camera; use `beampose watch`"):
        process_run(recorded, tmp_path / "again")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"timestamps": "times.csv"}, "timestamps: expected none in a run that is watched"),
        ({"cameras": {"left": {"detections": "points.csv"}}}, "expected a folder of pictures or a device to watch"),
        ({"cameras": {"left": {"device": "nothing-there"}}}, "expected a camera that OpenCV can open"),
        ({"cameras": {"left": {"device": -1}}}, "cameras.left.device: expected a camera's number from 0"),
        ({"cameras": {"left": {"device": 0, "frames": "frames/left"}}}, "got frames and device; keep one"),
    ],
)
def test_a_run_that_cannot_be_watched_is_an_input_error(recorded, tmp_path, change, words):
    run = empty_copy(recorded, tmp_path / "run")
    (run / "times.csv").write_text("frame,t_s\n0,0\n")
    (run / "points.csv").write_text("frame,camera,u_px,v_px\n0,left,1,1\n")
    content = yaml.safe_load((run / "run.yaml").read_text())
    (run / "run.yaml").write_text(yaml.safe_dump({**content, **change}))
    with pytest.raises(InputError) as raised:
        watch_run(run, tmp_path / "out", options=FAST)
    assert words in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("address", ["5005", "host:", "host:0", "host:70000", "no.such.host.invalid:5005"])
def test_an_invalid_address_is_an_error_before_the_watch_begins(recorded, tmp_path, address):
    run = empty_copy(recorded, tmp_path / "run")
    with pytest.raises(InputError, match="--udp"):
        watch_run(run, tmp_path / "out", udp=address)


def test_file_names_that_contain_a_time_are_an_error(recorded, tmp_path):
    run = empty_copy(recorded, tmp_path / "run")
    for k in range(6):
        for camera in ("left", "right"):
            target = run / f"frames/{camera}/{1_700_000_000_000 + 10_000 * k * k}.png"
            shutil.copy(recorded / f"frames/{camera}/{k:06d}.png", target)
    with pytest.raises(InputError, match="do the names contain a time"):
        watch_run(run, tmp_path / "out", options=FAST)


def test_a_device_is_a_number_or_a_name(recorded, tmp_path):
    run = empty_copy(recorded, tmp_path / "run")
    content = yaml.safe_load((run / "run.yaml").read_text())
    content["cameras"] = {"left": {"device": 2}, "right": {"device": "rtsp://camera/stream"}}
    (run / "run.yaml").write_text(yaml.safe_dump(content))
    assert list(load_run(run).cameras.values()) == [LiveDevice(2), LiveDevice("rtsp://camera/stream")]


# -- a folder that is being filled ------------------------------------------------------------------------------------


def names_of(poll: FolderPoll, until: int) -> dict[int, str]:
    """All pictures that a poll finds until there are `until`, or two seconds have passed."""
    end = time.monotonic() + 2
    while len(poll.names) < until and time.monotonic() < end:
        poll.new()
        time.sleep(0.001)
    return poll.names


@pytest.mark.parametrize(
    ("first", "later"),
    [
        ("000009.png", ["000010.png", "000011.png"]),
        ("img-9_left.tif", ["img-10_left.tif", "img-12_left.tif"]),
        ("a7.png", ["a300.png", "a301.png"]),
        ("a7.png", ["b8.png", "c0009.PNG"]),
        ("a7.png", ["a6.png", "a9.png", "a8.png"]),
    ],
)
def test_pictures_are_found_whatever_their_names_are(tmp_path, first, later):
    poll = FolderPoll(tmp_path)
    (tmp_path / first).touch()
    names_of(poll, 1)
    for name in ("notes.txt", ".a8.png.part", *later):
        (tmp_path / name).touch()
        poll.new()
    assert set(names_of(poll, 1 + len(later)).values()) == {first, *later}


def test_the_next_picture_costs_the_same_in_a_large_folder(tmp_path, monkeypatch):
    poll = FolderPoll(tmp_path)
    for k in range(500):
        (tmp_path / f"{k:06d}.png").touch()
    names_of(poll, 500)
    monkeypatch.setattr("os.scandir", lambda _: pytest.fail("the folder is listed"))
    for k in range(500, 520):
        (tmp_path / f"{k:06d}.png").touch()
        assert poll.new() == [(k, f"{k:06d}.png")]


def test_of_two_pictures_of_one_number_one_is_used_and_the_other_is_noted(tmp_path):
    poll = FolderPoll(tmp_path)
    for name in ("a1.png", "a1.tif"):
        (tmp_path / name).touch()
    assert poll.new() == [(1, "a1.png")]
    camera = FolderCamera("left", poll, (1, 1), Inbox(("left",), 0.01, 0.1), 0.1)
    assert camera.notes == [f"{tmp_path}: two pictures of one frame: a1.png was used, a1.tif not"]


def test_an_incomplete_picture_is_read_again_and_a_damaged_one_is_reported(recorded, tmp_path):
    inbox = Inbox(("left",), 0.01, 0.05)
    camera = FolderCamera("left", FolderPoll(tmp_path), (320, 256), inbox, patience_s=0.05)
    whole = (recorded / "frames/left/000000.png").read_bytes()
    for name in ("0.png", "1.png"):
        (tmp_path / name).write_bytes(whole[: len(whole) // 3])
    camera.poll_once()
    assert set(inbox.queues["left"].incomplete) == {0, 1}
    (tmp_path / "0.png").write_bytes(whole)
    time.sleep(0.06)
    camera.poll_once()
    queue = inbox.queues["left"]
    assert not queue.incomplete
    assert np.array_equal(queue.pictures[0].content, read_picture(recorded / "frames/left/000000.png", None))
    assert queue.pictures[1].content == MissingPicture("unreadable: cut short")


# -- when a frame is complete -----------------------------------------------------------------------------------------

FOUND = Detections.none()


def inbox_with(*given: tuple[str, int]) -> Inbox:
    inbox = Inbox(("a", "b"), interval_s=0.01, timeout_s=0.2)
    for camera, frame in given:
        inbox.put(camera, frame, FOUND, None)
    return inbox


def complete(inbox: Inbox, frame: int, waited_s: float) -> tuple[bool, list[str]]:
    now = time.perf_counter()
    names = {id(queue): name for name, queue in inbox.queues.items()}
    done, now_timed_out = is_complete(frame, list(inbox.queues.values()), now + waited_s, now, 0.2, 0.01)
    return done, [names[id(queue)] for queue in now_timed_out]


def test_a_frame_is_complete_when_all_cameras_have_delivered_it():
    assert complete(inbox_with(("a", 0), ("b", 0)), 0, 0.0) == (True, [])
    assert complete(inbox_with(("a", 0)), 0, 0.0) == (False, [])


def test_a_camera_with_a_later_frame_for_a_frame_interval_has_dropped_this_one():
    inbox = inbox_with(("a", 0), ("b", 1))
    assert complete(inbox, 0, 0.0) == (False, [])
    assert complete(inbox, 0, 0.011) == (True, [])


def test_a_silent_camera_times_out_once():
    inbox = inbox_with(("a", 0), ("a", 1))
    assert complete(inbox, 0, 0.19) == (False, [])
    assert complete(inbox, 0, 0.21) == (True, ["b"])
    inbox.queues["b"].timed_out = True
    assert complete(inbox, 1, 0.0) == (True, [])
    inbox.next_row = 1
    inbox.put("b", 0, FOUND, None)  # it is late, but there again
    assert inbox.queues["b"].late == 1
    assert complete(inbox, 1, 0.0) == (False, [])


def test_a_camera_that_lags_by_more_than_the_timeout_is_not_waited_for():
    inbox = inbox_with(("a", 100))
    inbox.next_row, inbox.queues["b"].timed_out = 100, True
    inbox.put("b", 70, FOUND, None)
    assert complete(inbox, 100, 0.0) == (True, [])


def test_no_frame_is_complete_before_any_camera_has_a_picture():
    assert complete(inbox_with(), 0, 100.0) == (False, [])


def test_a_stray_number_is_ignored():
    inbox = inbox_with(("a", 5))
    inbox.next_row = 5
    inbox.put("a", 90_000, FOUND, None)
    assert (inbox.queues["a"].strays, set(inbox.queues["a"].pictures)) == ([90_000], {5})


# -- devices ----------------------------------------------------------------------------------------------------------


def test_frames_of_a_device_that_loses_none_are_counted():
    clock = FrameClock(100.0)
    jitter = np.random.default_rng(1).normal(0, 0.002, 300)
    assert [clock.number(0.01 * k + float(jitter[k])) for k in range(300)] == list(range(300))
    assert clock.lost == 0


def test_lost_pictures_of_a_device_leave_a_gap_and_a_burst_does_not():
    clock = FrameClock(100.0)
    times = [0.01 * k for k in range(50)]
    burst = [0.55 + 0.0005 * k for k in range(6)]  # 50 to 55 were held back
    lost = [0.01 * k for k in range(56, 100) if k not in (70, 71, 72)]
    numbers = [clock.number(t) for t in times + burst + lost]
    assert numbers[:70] == list(range(70))
    assert numbers[-1] == 99
    assert clock.lost == 3


class FakeCapture:
    """A device with uniform pictures, all available immediately."""

    def __init__(self, pictures: int, shape: tuple[int, ...] = (4, 6)) -> None:
        self.left, self.shape, self.released = pictures, shape, False

    def grab(self) -> bool:
        self.left -= 1
        return self.left >= 0

    def retrieve(self) -> tuple[bool, np.ndarray]:
        return True, np.full(self.shape, 7, np.uint8)

    def release(self) -> None:
        self.released = True


@pytest.mark.parametrize("shape", [(4, 6), (4, 6, 1), (4, 6, 3)])
def test_a_device_that_is_faster_than_the_processing_loses_pictures(shape):
    inbox, capture = Inbox(("left",), 0.01, 0.1), FakeCapture(MOST_WAITING + 5, shape)
    camera = DeviceCamera("left", OpenCvSource(capture), (6, 4), inbox, FrameClock(100.0))
    inbox.wanted.set()
    camera.run()
    queue = inbox.queues["left"]
    assert (len(queue.pictures), queue.refused, capture.released) == (MOST_WAITING, 5, True)
    assert all(np.array_equal(w.content, np.full((4, 6), 7)) for w in queue.pictures.values())


def test_the_live_table_has_the_columns_of_the_contract(followed):
    assert (followed[0] / LIVE_TABLE).read_text().splitlines()[0] == ",".join(columns.ATTITUDE)
