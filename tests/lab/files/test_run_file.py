"""run.yaml and times.csv: values, and a line for each mistake."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from geometry import rotations
from lab.errors import InputError
from lab.files.run.clocks import Times, load_times
from lab.files.run.run_file import DetectionsTable, FramesFolder, VideoFile, load_run, save_run
from lab.files.text.dataclass_fields import dataclass_from_yaml
from tests.lab.run_folders import RUN, edit, write_run
from tracking.parameters import DetectParameters, TrackerParameters


def test_a_run_has_the_values_of_its_file(tmp_path):
    run = load_run(write_run(tmp_path / "a"))
    assert (run.name, run.frame_rate_hz, run.exposure_s, run.notes) == ("small", 100.0, None, "")
    assert run.cameras == {
        "left": FramesFolder(tmp_path / "a/frames/left"),
        "right": FramesFolder(tmp_path / "a/frames/right"),
    }
    assert list(run.rig.cameras) == ["left", "right"]
    assert run.tracker == TrackerParameters()
    assert run.times.t_s(7) == 0.07
    assert load_run(tmp_path / "a" / "run.yaml").name == "small"


def test_the_prior_is_in_radians_with_the_angles_of_the_contract(tmp_path):
    folder = write_run(tmp_path / "a")
    edit(folder / "run.yaml", "yaw_pitch_roll_deg: [0.0, 0.0, 0.0]", "yaw_pitch_roll_deg: [90, 0, 20]")
    edit(folder / "run.yaml", "position_m: [0.0, 0.0, 0.0]", "position_m: [1, 2, 3]")
    prior = load_run(folder).prior
    np.testing.assert_allclose(prior.centre.ypr, np.deg2rad([90, 0, 20]), atol=1e-15)
    np.testing.assert_allclose(prior.centre.turn([1, 0, 0]), [0, 1, 0], atol=1e-15)  # yaw carries body x to world y
    np.testing.assert_array_equal(prior.centre.translation, [1, 2, 3])
    assert prior.within_m == 0.3
    np.testing.assert_allclose(rotations.angle(rotations.exp(np.array([prior.within_rad, 0, 0]))), np.deg2rad(10))


def test_a_camera_that_is_left_out_is_not_in_the_rig_of_the_run(tmp_path):
    folder = write_run(tmp_path / "a")
    edit(folder / "run.yaml", "  right: {frames: frames/right}\n", "")
    run = load_run(folder)
    assert list(run.rig.cameras) == ["left"]
    assert run.left_out == ("right",)
    assert set(run.rig.spots) == {"1", "2", "3", "4", "5", "6"}


def test_the_kind_of_source_follows_from_the_path(tmp_path):
    folder = write_run(tmp_path / "a")
    (folder / "left.avi").write_bytes(b"x")
    (folder / "found.csv").write_text("frame,camera,u_px,v_px\n")
    edit(folder / "run.yaml", "{frames: frames/left}", "{frames: left.avi}")
    edit(folder / "run.yaml", "{frames: frames/right}", "{detections: found.csv}")
    cameras = load_run(folder).cameras
    assert cameras["left"] == VideoFile(folder / "left.avi")
    assert cameras["right"] == DetectionsTable(folder / "found.csv")


def test_tracker_parameters_are_read_and_others_keep_their_default(tmp_path):
    folder = write_run(tmp_path / "a")
    with (folder / "run.yaml").open("a") as file:
        file.write("tracker: {method: spots, r1_px: 7, detect: {max_detections: 9, saturation_dn: null}}\n")
    expected = TrackerParameters(
        method="spots", r1_px=7.0, detect=dataclasses.replace(DetectParameters(), max_detections=9)
    )
    assert load_run(folder).tracker == expected


@dataclass(frozen=True)
class _Inner:
    width_px: float | None = None
    count: int = 3


@dataclass(frozen=True)
class _Outer:
    method: Literal["rigid", "spots"] = "rigid"
    inner: _Inner = field(default_factory=_Inner)
    weights: tuple[float, ...] = (1.0,)
    on: bool = True

    def __post_init__(self) -> None:
        if self.inner.count < 1:
            raise ValueError(f"inner.count: expected 1 or more, got {self.inner.count}")


def test_parameters_of_every_kind_are_read():
    block = {"method": "spots", "inner": {"width_px": 2, "count": 4.0}, "weights": [1, 2], "on": False}
    assert dataclass_from_yaml(_Outer, block, "run.yaml", "t") == _Outer("spots", _Inner(2.0, 4), (1.0, 2.0), False)
    assert dataclass_from_yaml(_Outer, None, "run.yaml", "t") == _Outer()


@pytest.mark.parametrize(
    ("block", "words"),
    [
        ({"metod": "spots"}, "t: unknown key 'metod'; did you mean 'method'?"),
        ({"method": "spot"}, "t.method: expected 'rigid' or 'spots', got 'spot'; did you mean 'spots'?"),
        ({"method": None}, "t.method: expected 'rigid' or 'spots', got nothing"),
        ({"inner": {"cuont": 1}}, "t.inner: unknown key 'cuont'; did you mean 'count'?"),
        ({"inner": {"count": 1.5}}, "t.inner.count: expected a whole number, got 1.5"),
        ({"inner": {"width_px": "wide"}}, "t.inner.width_px: expected a finite number, got 'wide'"),
        ({"inner": {"count": 0}}, "t: inner.count: expected 1 or more, got 0"),
        ({"inner": None}, "t.inner: expected a mapping with width_px, count, got nothing"),
        ({"weights": 1}, "t.weights: expected a list of numbers, got 1"),
        ({"on": "on"}, "t.on: expected true or false, got 'on'"),
        ({"on": 1}, "t.on: expected true or false, got 1"),
        (["rigid"], "t: expected a mapping, got ['rigid']"),
    ],
)
def test_a_wrong_parameter_is_reported_with_its_field(block, words):
    with pytest.raises(InputError) as caught:
        dataclass_from_yaml(_Outer, block, "run.yaml", "t")
    assert str(caught.value) == f"run.yaml: {words}"


BROKEN = [
    ("schema: beampose/run/1", "schema: beampose/rig/1", "schema: expected 'beampose/run/1', got 'beampose/rig/1'"),
    ("rig: rig.yaml\n", "", "run.yaml: rig: expected a value, got nothing; add it"),
    ("rig: rig.yaml", "rig: rigg.yaml", "run.yaml: rig: expected a rig file, found none at "),
    ("rig: rig.yaml", "rig:", "run.yaml: rig: expected a word, got nothing"),
    ("frame_rate_hz: 100.0", "frame_rate_hz: -100", "run.yaml: frame_rate_hz: expected a number above 0, got -100"),
    ("frame_rate_hz: 100.0", "frame_rate_hz: 0", "run.yaml: frame_rate_hz: expected a number above 0, got 0"),
    ("frame_rate_hz: 100.0", "frame_rate_hz: 100 Hz", "frame_rate_hz: expected a number above 0, got '100 Hz'"),
    ("frame_rate_hz: 100.0", "frame_rate: 100", "unknown key 'frame_rate'; did you mean 'frame_rate_hz'?"),
    ("name: small", "name: small\nexposure_s: 0", "run.yaml: exposure_s: expected a number above 0, got 0"),
    ("name: small", "name: [small]", "run.yaml: name: expected a word, got ['small']"),
    ("name: small", "name: small\nname: large", "line 3: expected YAML, found the key 'name' a second time"),
    ("{frames: frames/left}", "{frame: frames/left}", "cameras.left: unknown key 'frame'; did you mean 'frames'?"),
    ("{frames: frames/left}", "{}", "cameras.left: expected frames or detections, got neither"),
    ("{frames: frames/left}", "{frames: a, detections: b}", "cameras.left: expected frames or detections, got both"),
    ("{frames: frames/left}", "{frames: frames/lft}", "cameras.left.frames: expected a folder of pictures or a video,"),
    ("{frames: frames/left}", "{detections: d.csv}", "cameras.left.detections: expected a table, found none at "),
    ("{frames: frames/left}", "{frames: frames/left/000000.png}", "got the single picture "),
    (
        "{frames: frames/left}",
        "frames/left",
        "cameras.left: expected a mapping with frames, detections, device, time_offset_s, row_time_s,",
    ),
    ("  left: {", "  lefft: {", "cameras.lefft: expected a camera of rig.yaml, got 'lefft'; did you mean 'left'?"),
    ("position_m: [0.0, 0.0, 0.0]", "position_m: [0.0, 0.0]", "prior.position_m: expected 3 numbers, got 2"),
    ("  position_m: [0.0, 0.0, 0.0]\n", "", "prior.position_m: expected a value, got nothing; add it"),
    ("yaw_pitch_roll_deg: [0.0, 0.0, 0.0]", "ypr_deg: [0, 0, 0]", "prior: unknown key 'ypr_deg'"),
    ("within_m: 0.3", "within_m: -0.3", "prior.within_m: expected a number of 0 or more, got -0.3"),
    ("within_deg: 10.0", "within_deg: 200", "prior.within_deg: expected an angle above 0 and up to 180, got 200"),
    ("within_deg: 10.0", "within_deg: .nan", "prior.within_deg: expected an angle above 0 and up to 180, got nan"),
    ("within_deg: 10.0", "within_deg: 10.0\ntracker: {r1: 3}", "run.yaml: tracker: unknown key 'r1'"),
    ("within_deg: 10.0", "within_deg: 10.0\ntracker: 3", "run.yaml: tracker: expected a mapping, got 3"),
    (
        "within_deg: 10.0",
        "within_deg: 10.0\ntimestamps: t.csv",
        "t.csv: expected a table with columns frame,t_s, found no file",
    ),
    ("within_deg: 10.0", "within_deg: 10.0\nnotes: {a: 1}", "run.yaml: notes: expected a word, got a mapping with a"),
]


@pytest.mark.parametrize(("old", "new", "words"), BROKEN)
def test_a_mistake_is_one_line_with_field_expected_and_found(old, new, words, tmp_path):
    folder = write_run(tmp_path / "a", frames=1)
    edit(folder / "run.yaml", old, new)
    with pytest.raises(InputError) as caught:
        load_run(folder)
    message = str(caught.value)
    assert words in message
    assert len(message.splitlines()) <= 2
    assert caught.value.exit_status == 2


def test_no_cameras_at_all_are_refused(tmp_path):
    folder = write_run(tmp_path / "a", frames=1)
    (folder / "run.yaml").write_text(RUN.split("cameras:")[0] + "cameras: {}\n")
    with pytest.raises(InputError, match="cameras: expected one or more cameras, got none"):
        load_run(folder)


def test_a_mistake_in_the_rig_names_the_rig(tmp_path):
    folder = write_run(tmp_path / "a", frames=1)
    edit(folder / "rig.yaml", "distortion: []", "distortion: [1]")
    with pytest.raises(InputError, match=r"rig\.yaml: cameras\.left\.distortion: expected 0, 4, 5"):
        load_run(folder)


@pytest.mark.parametrize(("make", "words"), [(Path.touch, "found a file"), (lambda p: None, "found nothing")])
def test_a_path_that_is_not_a_folder_is_refused(make, words, tmp_path):
    make(tmp_path / "a")
    with pytest.raises(InputError, match=f"expected a run folder, {words}"):
        load_run(tmp_path / "a")


def test_a_saved_run_loads_to_the_same_values(tmp_path):
    folder = write_run(tmp_path / "a")
    content = {
        "name": "1e-3",
        "rig": "rig.yaml",
        "frame_rate_hz": 1000 / 3,
        "cameras": {"left": {"frames": "frames/left"}},
        "tracker": {"r2_px": 1 / 3},
        "notes": "two: lines\n# of text",
    }
    save_run(content, folder)
    run = load_run(folder)
    assert (run.name, run.frame_rate_hz, run.notes) == ("1e-3", 1000 / 3, "two: lines\n# of text")
    assert run.tracker.r2_px == 1 / 3
    assert run.prior is None


def test_a_run_that_could_not_be_loaded_is_not_saved(tmp_path):
    folder = write_run(tmp_path / "a")
    with pytest.raises(InputError, match=r"run\.yaml: tracker: unknown key 'r3_px'"):
        save_run({"rig": "rig.yaml", "frame_rate_hz": 1.0, "cameras": {"left": {"frames": "x"}},
                  "tracker": {"r3_px": 1.0}}, folder)  # fmt: skip
    assert (folder / "run.yaml").read_text() == RUN


# Times ----------------------------------------------------------------------------------------------------------


def test_times_of_dropped_frames_are_interpolated():
    times = Times(10.0, np.array([2, 3, 6]), np.array([1.0, 1.2, 2.1]))
    np.testing.assert_allclose(times.t_s(np.array([2, 3, 4, 5, 6])), [1.0, 1.2, 1.5, 1.8, 2.1])
    np.testing.assert_allclose(times.t_s(np.array([0, 8])), [0.8, 2.3])  # beyond: the nominal rate
    np.testing.assert_array_equal(times.without_time(np.array([1, 2, 4])), [1, 4])
    assert Times(10.0).without_time(np.array([1])).size == 0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("frame,t\n0,0\n", "times.csv: expected a column 't_s', got frame,t"),
        ("frame,t_s\n0,0\n1,zero\n", "times.csv: line 3: t_s: expected seconds, got 'zero'"),
        ("frame,t_s\n0,0\n1.5,1\n", "times.csv: line 3: frame: expected a whole number, got 1.5"),
        ("frame,t_s\n0,0\n0,1\n", "times.csv: line 3: frame: expected rising numbers, got 0 after 0"),
        (
            "frame,t_s\n0,0\n1,2\n2,1\n",
            "times.csv: line 4: t_s: expected increasing times, got 1 s of frame 2 after 2 s",
        ),
        ("frame,t_s\n", "times.csv: expected a row per frame, got none"),
        ("", "times.csv: expected columns frame,t_s, got an empty file"),
    ],
)
def test_wrong_timestamps_are_reported_with_their_line(text, words, tmp_path):
    folder = write_run(tmp_path / "a", frames=1)
    edit(folder / "run.yaml", "name: small", "name: small\ntimestamps: times.csv")
    (folder / "times.csv").write_text(text)
    with pytest.raises(InputError) as caught:
        load_run(folder)
    assert words in str(caught.value)


def test_a_folder_that_is_no_run_is_named_for_what_it_is(tmp_path):
    run = write_run(tmp_path / "lab" / "day-1")
    for name in ("day-2", "day-3", "day-4"):
        shutil.copytree(run, run.parent / name)
    results = tmp_path / "results"
    results.mkdir()
    (results / "summary.json").write_text(json.dumps({"run_folder": str(run)}), "utf-8")
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    (pictures / "0001.png").touch()
    empty = tmp_path / "empty"
    empty.mkdir()
    for folder, words in (
        (
            run.parent,
            "found run folders in it: day-1, day-2, day-3 and 1 more; name one, or give all to",
        ),
        (results, f"found results; they are of the run {run}"),
        (next(p for p in run.iterdir() if p.is_dir()), "found a part of one; name the run folder day-1"),
        (pictures, "found pictures; `beampose detect` needs no run.yaml"),
        (empty, "found none; check the path, or write one with `beampose init`"),
    ):
        with pytest.raises(InputError, match=re.escape(words)):
            load_run(folder)


@pytest.mark.parametrize(("step", "fits"), [(0.01, True), (0.1, True), (10.0, False), (10_000.0, False), (1e-5, False)])
def test_timestamps_in_another_unit_than_the_frame_rate_are_refused(tmp_path, step, fits):
    """0.1 s at 100 Hz is accepted: a camera that an instrument triggers may be slower than it can be."""
    (tmp_path / "times.csv").write_text(
        "frame,t_s\n" + "".join(f"{f},{f * step!r}\n" for f in range(0, 20, 2)), "utf-8"
    )
    if fits:
        assert load_times(tmp_path / "times.csv", 100.0).t_s(5) == pytest.approx(5 * step)
    else:
        with pytest.raises(
            InputError, match=r"times.csv: line 3: t_s: expected steps of about 0.01 s .* not milliseconds"
        ):
            load_times(tmp_path / "times.csv", 100.0)
