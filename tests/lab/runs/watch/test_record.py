"""`beampose record`: no picture is lost without being counted, and what is in the folder is a valid run at any time."""

from __future__ import annotations

import dataclasses
import errno
import http.server
import os
import random
import re
import signal
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from lab.errors import InputError
from lab.files.rig.rig_file import load_rig, save_rig
from lab.files.run.run_file import load_run
from lab.pictures import live_source
from lab.pictures.live_source import GenicamSource, OpenCvSource, ReplaySource, open_live
from lab.pictures.picture_file import MissingPicture, decode, read_picture
from lab.pictures.png import encoded
from lab.runs.frames.frames import open_frames
from lab.runs.watch import record as recording
from lab.runs.watch.cameras import FrameClock
from lab.runs.watch.record import RecordOptions, record
from tests.lab.tables import rows_of
from tests.paths import ROOT

SIZE = (160, 128)  # of the rig's cameras
PROGRAM = f"import sys; sys.path.insert(0, {str(ROOT)!r}); from cli import main; main(prog_name='beampose')"


@pytest.fixture(scope="module")
def rig(tmp_path_factory) -> Path:
    """The rig of the sample run with small pictures."""
    usual = load_rig(ROOT / "sample_runs" / "huo2015" / "rig.yaml")
    cameras = {n: dataclasses.replace(c, image_size_px=SIZE) for n, c in usual.cameras.items()}
    path = tmp_path_factory.mktemp("rig") / "rig.yaml"
    save_rig(dataclasses.replace(usual, cameras=cameras), path)
    return path


@pytest.fixture(scope="module")
def shown(tmp_path_factory) -> Path:
    """Pictures of the rig's size, all different."""
    folder = tmp_path_factory.mktemp("shown")
    for k in range(12):
        picture = np.full((SIZE[1], SIZE[0]), 10 + k, np.uint8)
        picture[k * 10 : k * 10 + 5] = 200
        (folder / f"{k}.png").write_bytes(encoded(picture))
    return folder


def valid(folder: Path) -> dict[str, list[int]]:
    """Checks that a folder is a valid run: `run` can read every picture, each has its time. Returns the numbers."""
    run = load_run(folder)
    out = {}
    for name in run.cameras:
        pictures = sorted((folder / "frames" / name).glob("*.png"))
        assert pictures
        assert not [p for p in pictures if isinstance(read_picture(p, SIZE), MissingPicture)]
        out[name] = [int(p.stem) for p in pictures]
        rows = rows_of(folder / f"times-{name}.csv")
        # A process that is killed may have written a time whose picture is missing: it counts as dropped.
        timed = [int(r["frame"]) for r in rows]
        assert out[name] in (timed, timed[:-1])
        assert np.all(np.diff([float(r["t_s"]) for r in rows]) > 0)
    open_frames(run)
    return out


class Fake:
    """A camera whose pictures come at once; `at_s`: its own clock at each picture."""

    endless = True

    def __init__(self, at_s, counted=None, size=SIZE, then=None):
        self.at_s, self.counted, self.size, self.then, self.k = list(at_s), counted, size, then, -1
        self.released = False

    def grab(self):
        self.k += 1
        if self.k < len(self.at_s):
            time.sleep(0.002)
            return True
        if self.then is not None:
            raise self.then
        return False

    def clock_s(self):
        return self.at_s[self.k]

    def number(self):
        return None if self.counted is None else self.counted[self.k]

    def picture(self, size_px):
        found = np.full((self.size[1], self.size[0]), self.k, np.uint8)
        return found if size_px in (None, self.size) else MissingPicture("wrong size")

    def release(self):
        self.released = True


def recorded(monkeypatch, out, cameras, **options):
    """Record fake cameras."""
    monkeypatch.setattr(recording, "open_live", lambda source, *_: cameras[source])
    return record({name: name for name in cameras}, out, RecordOptions(**options))


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_pictures_are_written_without_loss(kind):
    grey = np.random.default_rng(1).integers(0, np.iinfo(kind).max, (37, 53), endpoint=True).astype(kind)
    data = encoded(grey)
    np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED), grey)
    np.testing.assert_array_equal(decode(np.frombuffer(bytearray(data), np.uint8), (53, 37)), grey)


def test_two_cameras_are_recorded_and_every_picture_is_written_or_counted(shown, tmp_path, rig):
    lines = []
    options = RecordOptions(rig=rig, rate_hz=60.0, seconds=1.3)
    sources = dict.fromkeys(("left", "right"), f"replay:{shown}")
    done = record(sources, tmp_path / "run", options, line=lines.append)
    numbers = valid(tmp_path / "run")
    counts = [tuple(map(int, re.findall(r"\d+", part)))[:3] for part in done.lines[0].split("; ")]
    for name, (written, lost, unwritten) in zip(numbers, counts, strict=True):
        assert written == len(numbers[name])
        assert numbers[name][-1] + 1 <= written + lost + unwritten
        assert written + lost + unwritten > 60
        for k in numbers[name]:
            turn = k % 22
            expected = read_picture(shown / f"{min(turn, 22 - turn)}.png", SIZE)
            np.testing.assert_array_equal(
                read_picture(tmp_path / "run" / "frames" / name / f"{k:06d}.png", SIZE), expected
            )
    assert lines
    assert lines[0].startswith("1 s: left ")
    assert done.exit_status == 0


def test_pictures_that_the_camera_loses_leave_gaps_by_its_count_and_by_its_clock(monkeypatch, tmp_path, rig):
    kept = [k for k in range(30) if k not in (7, 8, 20)]
    times = [100 + k / 50 for k in kept]
    cameras = {"left": Fake(times), "right": Fake(times, counted=[(k + 65_520) % 65_536 for k in kept])}
    done = recorded(monkeypatch, tmp_path / "run", cameras, rig=rig, rate_hz=50.0)
    numbers = valid(tmp_path / "run")
    assert numbers["left"] == kept
    assert "left 27 pictures, 3 lost, 0 not written; right 27 pictures, " in done.lines[0]
    t_s = np.array([float(r["t_s"]) for r in rows_of(tmp_path / "run" / "times-left.csv")])
    np.testing.assert_allclose(np.diff(t_s), np.diff(times), atol=2e-6)
    assert all(camera.released for camera in cameras.values())


def test_a_camera_count_that_starts_again_loses_nothing():
    clock = FrameClock(50.0)
    assert [clock.number(0.0, k) for k in (65_533, 65_534, 65_535, 1, 2, 5)] == [0, 1, 2, 3, 4, 7]
    assert clock.lost == 2


@pytest.mark.slow
def test_a_disk_that_is_too_slow_drops_pictures_which_are_counted(monkeypatch, tmp_path, rig):
    monkeypatch.setattr(recording, "_WAITING", 64)
    slow = recording.encoded
    monkeypatch.setattr(recording, "encoded", lambda picture: (time.sleep(0.02), slow(picture))[1])
    done = recorded(
        monkeypatch, tmp_path / "run", {"left": Fake([k / 100 for k in range(140)])}, rig=rig, rate_hz=100.0
    )
    numbers = valid(tmp_path / "run")["left"]
    written, unwritten = len(numbers), 140 - len(numbers)
    assert unwritten > 10
    assert f"left {written} pictures, 0 lost, {unwritten} not written" in done.lines[0]


@pytest.mark.parametrize("where", ["picture", "time"])
def test_a_full_disk_ends_the_recording_and_what_was_recorded_is_a_run(monkeypatch, tmp_path, where, rig):
    count = []

    def full(function, *arguments):
        count.append(1)
        if len(count) > 10:
            raise OSError(errno.ENOSPC, "No space left on device")
        return function(*arguments)

    if where == "picture":
        monkeypatch.setattr(recording.os, "replace", partial(full, os.replace))
    else:
        append = recording.CameraRecorder._append
        monkeypatch.setattr(recording.CameraRecorder, "_append", lambda self, line: full(append, self, line))
    done = recorded(monkeypatch, tmp_path / "run", {"left": Fake([k / 50 for k in range(40)])}, rig=rig, rate_hz=50.0)
    assert done.exit_status == 1
    assert done.notes == ("left: cannot be written: No space left on device",)
    assert len(valid(tmp_path / "run")["left"]) in (9, 10)
    assert not list((tmp_path / "run").rglob("*.part"))
    assert ", 0 lost, 0 not written" not in done.lines[0]


def test_at_every_instant_each_picture_in_the_folder_has_its_time(monkeypatch, tmp_path, rig):
    """Whenever a recording is killed: the time is in the table before the picture is in the folder."""
    replace, timed = os.replace, []

    def replaced(part, path):
        if Path(path).suffix == ".png":
            timed.append(f"\n{int(Path(path).stem)}," in (tmp_path / "run" / "times-left.csv").read_text())
        replace(part, path)

    monkeypatch.setattr(recording.os, "replace", replaced)
    recorded(monkeypatch, tmp_path / "run", {"left": Fake([k / 50 for k in range(10)])}, rig=rig, rate_hz=50.0)
    assert timed == [True] * 10


@pytest.mark.parametrize("then", [None, OSError("the bus is gone")])
def test_an_unplugged_camera_ends_its_recording_and_the_other_one_goes_on(monkeypatch, tmp_path, then, rig):
    cameras = {"left": Fake([k / 50 for k in range(5)], then=then), "right": Fake([k / 50 for k in range(60)])}
    done = recorded(monkeypatch, tmp_path / "run", cameras, rig=rig, rate_hz=50.0)
    assert {name: len(numbers) for name, numbers in valid(tmp_path / "run").items()} == {"left": 5, "right": 60}
    assert done.exit_status == 1
    assert "unplugged" in done.notes[0] if then is None else "the bus is gone" in done.notes[0]


def test_equal_numbers_of_triggered_cameras_are_one_instant(monkeypatch, tmp_path, rig):
    late = Fake([k / 50 for k in range(10)])
    arrivals = late.grab
    late.grab = lambda: (time.sleep(0.06 if late.k < 0 else 0), arrivals())[1]  # its first picture is that of pulse 3
    cameras = {"left": Fake([k / 50 for k in range(12)]), "right": late}
    recorded(monkeypatch, tmp_path / "run", cameras, rig=rig, rate_hz=50.0, triggered=True)
    run = load_run(tmp_path / "run")
    assert not run.clocks
    first = {name: min(int(p.stem) for p in (tmp_path / "run" / "frames" / name).glob("*.png")) for name in run.cameras}
    assert first["left"] == 0
    assert first["right"] in (3, 4)


def test_clocks_that_stand_still_or_are_missing_give_rising_times(monkeypatch, tmp_path, rig):
    # The last time is late: on a busy machine the other camera, whose times are those of arrival, may start late.
    cameras = {"left": Fake([0.0, 0.02, 0.02, 0.01, 60.0]), "right": Fake([None] * 5)}
    done = recorded(monkeypatch, tmp_path / "run", cameras, rig=rig, rate_hz=50.0)
    assert {len(n) for n in valid(tmp_path / "run").values()} == {5}
    assert "right: the camera states no times; those of arrival are used" in done.notes


def video(path: Path, pictures: int = 25) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"FFV1"), 25.0, SIZE, isColor=False)
    for k in range(pictures):
        writer.write(np.full((SIZE[1], SIZE[0]), 3 * k, np.uint8))
    writer.release()
    return path


@pytest.mark.parametrize("served", [False, True])
def test_a_video_and_a_video_served_as_a_stream_are_recorded_picture_by_picture(tmp_path, served, rig):
    source = video(tmp_path / "film.avi")
    server = None
    if served:
        quiet = type("Quiet", (http.server.SimpleHTTPRequestHandler,), {"log_message": lambda *_: None})
        server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), partial(quiet, directory=str(tmp_path)))
        threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
        source = f"http://127.0.0.1:{server.server_port}/film.avi"
    done = record({"left": str(source)}, tmp_path / "run", RecordOptions(rig=rig, rate_hz=25.0))
    if server is not None:
        server.shutdown()
        server.server_close()
    assert valid(tmp_path / "run")["left"] == list(range(25))
    for k in (0, 24):
        assert read_picture(tmp_path / "run/frames/left" / f"{k:06d}.png", SIZE)[5, 5] == 3 * k
    t_s = [float(r["t_s"]) for r in rows_of(tmp_path / "run" / "times-left.csv")]
    if not served:
        np.testing.assert_allclose(t_s, np.arange(25) / 25, atol=1e-6)
    assert ", 0 lost, 0 not written" in done.lines[0]


def started(out: Path, shown: Path, rig: Path) -> subprocess.Popen:
    words = ["record", "--out", str(out), "--rig", str(rig), "--rate", "100"]
    words += [w for name in ("left", "right") for w in ("--camera", f"{name}=replay:{shown}")]
    return subprocess.Popen(
        [sys.executable, "-P", "-c", PROGRAM, *words], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )


def killed(tmp_path: Path, shown: Path, rig: Path, seeds: range) -> None:
    """Recordings that are killed at random times, at the same time, are valid runs."""
    processes = [(started(tmp_path / str(seed), shown, rig), seed) for seed in seeds]
    for process, seed in processes:
        end = time.monotonic() + 60
        while not (tmp_path / str(seed) / "run.yaml").exists():
            assert time.monotonic() < end
            time.sleep(0.005)
        time.sleep(random.Random(seed).uniform(0, 0.4))
        process.kill()
        process.communicate()
        valid(tmp_path / str(seed))


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_a_recording_that_is_killed_is_a_valid_run(tmp_path, shown, rig):
    killed(tmp_path, shown, rig, range(2))


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.parametrize("first", range(10, 60, 5))
def test_fifty_recordings_that_are_killed_are_valid_runs(tmp_path, shown, rig, first):
    killed(tmp_path, shown, rig, range(first, first + 5))


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_ctrl_c_and_a_termination_end_a_recording_with_everything_written(tmp_path, shown, rig):
    wanted = {signal.SIGINT: 0, signal.SIGTERM: 128 + signal.SIGTERM}
    processes = {number: started(tmp_path / number.name, shown, rig) for number in wanted}
    for number, process in processes.items():
        while not (tmp_path / number.name / "run.yaml").exists():
            time.sleep(0.01)
        time.sleep(0.1)
        process.send_signal(number)
        _, errors = process.communicate(timeout=60)
        assert process.returncode == wanted[number], errors
        assert set(valid(tmp_path / number.name)) == {"left", "right"}


@pytest.mark.parametrize(
    ("cameras", "options", "words"),
    [
        ({"lft": "0"}, {"rig": True}, "expected a camera of the rig, got 'lft'; did you mean 'left'"),
        ({"left": "nothing-there"}, {}, "--camera left=nothing-there: expected a camera that OpenCV can open"),
        ({"left": "replay:nothing"}, {}, "--camera left=replay:nothing: nothing: expected a picture"),
        ({"left": "genicam:7"}, {}, "--camera left=genicam:7: expected the"),
    ],
)
def test_a_camera_that_cannot_be_opened_leaves_no_folder(tmp_path, rig, cameras, options, words):
    with pytest.raises(InputError, match=words):
        record(cameras, tmp_path / "run", RecordOptions(rig=rig if options else None))
    assert not (tmp_path / "run").exists()


def test_recordings_are_not_overwritten_and_pictures_of_another_size_are_named(monkeypatch, tmp_path, rig):
    with pytest.raises(InputError, match="nothing was recorded: left: wrong size"):
        recorded(monkeypatch, tmp_path / "run", {"left": Fake([0.0], size=(64, 48))}, rig=rig)
    with pytest.raises(InputError, match="expected a new or empty folder"):
        recorded(monkeypatch, tmp_path / "run", {"left": Fake([0.0])}, rig=rig)


def test_a_replayed_camera_shows_its_pictures_forth_and_back_and_misses_some_when_read_late(shown):
    camera = ReplaySource(shown, 400.0)
    numbers = []
    for k in range(40):
        camera.grab()
        numbers.append(camera.number())
        if k == 20:
            time.sleep(0.1)
    assert all(np.diff(numbers) >= 1)
    assert max(np.diff(numbers)) > 25
    assert camera.picture(SIZE)[min(numbers[-1] % 22, 22 - numbers[-1] % 22) * 10 + 2, 0] == 200


def test_a_genicam_camera_delivers_grey_pictures_with_its_count(monkeypatch):
    pytest.importorskip("harvesters")
    import genicam

    producer = Path(genicam.__file__).parent
    if not list(producer.glob("*.cti")):
        pytest.skip("this package of genicam has no simulated camera")
    monkeypatch.setenv(live_source._PRODUCERS, str(producer))
    with pytest.raises(InputError, match="expected the serial number of a GenICam camera, got 'none'; found: "):
        open_live("genicam:none")
    camera = open_live("genicam:0")
    assert isinstance(camera, GenicamSource)
    try:
        assert camera.grab()
        first = camera.number()
        assert camera.grab()
        assert camera.number() == first + 1
        picture = camera.picture(None)
        assert picture.ndim == 2
        assert picture.dtype == np.uint8
    finally:
        camera.release()


def test_devices_of_opencv_have_the_same_interface(tmp_path):
    camera = open_live(str(video(tmp_path / "film.avi", 3)))
    assert isinstance(camera, OpenCvSource)
    assert not camera.endless
    assert [camera.grab() for _ in range(4)] == [True, True, True, False]
