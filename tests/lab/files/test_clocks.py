"""The clocks of single cameras in run.yaml: what is read, and what is refused in one line."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from lab.errors import BeamposeError
from lab.files.run.clocks import CameraClock, Times, stamp_sigmas
from lab.files.run.run_file import load_run
from lab.report.frames.content import pictures_of
from lab.runs.frames.frames import open_frames, pictures_at
from tests.lab.run_folders import RIG

FRAMES = 20


def run_with(folder: Path, right: str, more: str = "") -> Path:
    """A run of 20 frames of points whose right camera has these fields."""
    (folder / "rig.yaml").write_text(RIG)
    rows = [f"{k},{camera},{20 + k},20,.1,.1" for k in range(FRAMES) for camera in ("left", "right")]
    (folder / "detections.csv").write_text("frame,camera,u_px,v_px,sigma_u_px,sigma_v_px\n" + "\n".join(rows) + "\n")
    (folder / "run.yaml").write_text(
        "schema: beampose/run/1\nrig: rig.yaml\nframe_rate_hz: 100\n" + more + "cameras:\n"
        "  left: {detections: detections.csv}\n  right: {detections: detections.csv, " + right + "}\n"
    )
    return folder


def times(folder: Path, t_s: np.ndarray, name: str = "times.csv") -> None:
    rows = "\n".join(f"{k},{t:.9f}" for k, t in enumerate(t_s))
    (folder / name).write_text(f"frame,t_s\n{rows}\n")


def opened(folder: Path) -> None:
    open_frames(load_run(folder))


def test_a_camera_without_a_clock_of_its_own_has_that_of_the_run(tmp_path):
    run = load_run(run_with(tmp_path, "time_offset_s: 0, row_time_s: 0"))
    assert not run.clocks


def test_offset_row_time_and_times_are_read(tmp_path):
    times(tmp_path, 0.011 * np.arange(FRAMES))
    run = load_run(run_with(tmp_path, "time_offset_s: 0.002, row_time_s: 5.0e-5, timestamps: times.csv"))
    clock = run.clocks["right"]
    assert clock.row_time_s == 5e-5
    np.testing.assert_allclose(clock.instants_s(run.times, np.array([0, 10])), [0.002, 0.112])
    assert tmp_path / "times.csv" in run.times_paths


def test_what_is_to_be_estimated_starts_at_zero_with_the_sigma_of_its_prior(tmp_path):
    clock = load_run(run_with(tmp_path, "time_offset_s: estimate, row_time_s: estimate")).clocks["right"]
    assert (clock.offset_s, clock.row_time_s) == (0.0, 0.0)
    assert clock.offset_prior_s == clock.offset_sigma_s == pytest.approx(0.01)
    assert clock.row_time_prior_s == pytest.approx(0.01 / 48)


@pytest.mark.parametrize(
    ("right", "says"),
    [
        ("time_offset_s: estimated", "expected a finite number"),
        ("row_time_s: 15", "give seconds for one row, not microseconds"),
        ("timestamps: none.csv", "expected a table frame,t_s, found none"),
        ("time_offset_s: 2.1", "expected pictures within the run"),
        ("time_offset_s: soon", "expected a finite number or `estimate`, got 'soon'"),
    ],
)
def test_a_clock_in_other_units_or_without_a_table_is_refused(tmp_path, right, says):
    with pytest.raises(BeamposeError, match=says) as caught:
        opened(run_with(tmp_path, right))
    assert "right" in str(caught.value)


@pytest.mark.parametrize(
    ("t_s", "says"),
    [
        (np.r_[0.0:0.1:0.01, 0.05:0.15:0.01], "expected increasing times"),
        (10.0 * np.arange(FRAMES), "give seconds, not milliseconds"),
        (0.01 * np.arange(FRAMES) + 60, "expected pictures within the run"),
        (0.01 * np.arange(FRAMES - 5), "got none for 5 of them"),
    ],
    ids=["not monotonic", "milliseconds", "another clock", "too short"],
)
def test_times_that_contradict_the_run_are_refused(tmp_path, t_s, says):
    times(tmp_path, t_s)
    with pytest.raises(BeamposeError, match=says):
        opened(run_with(tmp_path, "timestamps: times.csv"))


def test_the_spot_tracker_takes_all_pictures_for_those_of_one_instant(tmp_path):
    with pytest.raises(BeamposeError, match=r"expected tracker\.method rigid"):
        load_run(run_with(tmp_path, "time_offset_s: 0.002", "tracker: {method: spots}\n"))


def test_pictures_of_a_camera_with_times_of_its_own_are_those_nearest_to_the_rows(tmp_path):
    folder = run_with(tmp_path, "timestamps: times.csv")
    times(folder, 0.003 + np.arange(FRAMES // 2) / 50)  # half as many pictures as rows
    text = (folder / "run.yaml").read_text().replace("right: {detections: detections.csv", "right: {frames: right")
    (folder / "run.yaml").write_text(text)
    (folder / "right").mkdir()
    run = load_run(folder)
    width, height = run.rig.cameras["right"].image_size_px
    for number in range(FRAMES // 2):
        cv2.imwrite(str(folder / "right" / f"{number:03d}.png"), np.full((height, width), number, np.uint8))
    shown = pictures_at(run, "right", range(6))
    values = {row: int(p[0, 0]) for row, p in shown.items() if isinstance(p, np.ndarray)}
    assert values == {0: 0, 2: 1, 4: 2}
    assert sorted(shown) == list(range(6))
    drawn = [found["right"] for found in pictures_of(run, ["right"], range(6))]
    assert {row: int(p[0, 0]) for row, p in enumerate(drawn) if isinstance(p, np.ndarray)} == values


PICTURES = np.arange(300)


def stamped(times_s: np.ndarray, numbers: np.ndarray = PICTURES) -> Times:
    times = Times(100.0, numbers, np.asarray(times_s))
    times.sigma_s = stamp_sigmas(times)
    return times


@pytest.mark.parametrize(
    "times_s",
    [
        pytest.param(PICTURES / 97, id="constant"),
        pytest.param(np.round(PICTURES / 97, 6), id="written to a microsecond"),
        pytest.param(np.concatenate([PICTURES[:150] / 97, 0.003 + PICTURES[150:] / 97]), id="a jump that stays"),
        pytest.param(np.cumsum(np.random.default_rng(1).uniform(0.004, 0.016, 300)), id="at any time"),
        pytest.param(np.arange(300) / 97 + 2e-4 * np.sin(PICTURES / 300), id="a rate that changes slowly"),
        pytest.param(PICTURES[:11] / 97 + 1e-3 * (PICTURES[:11] == 5), id="too few"),
    ],
)
def test_stamps_that_do_not_scatter_about_a_constant_rate_are_exact(times_s):
    assert stamped(times_s, PICTURES[: len(times_s)]).sigma_s is None


@pytest.mark.parametrize("dropped", [False, True])
def test_the_scatter_of_stamps_is_the_sigma_of_each(dropped):
    t_s = PICTURES / 97 + np.random.default_rng(2).normal(0, 2e-4, 300)
    if dropped:  # and the camera has numbered those that are left
        t_s = np.delete(t_s, np.s_[30:60])
    times = stamped(t_s, np.arange(len(t_s)))
    np.testing.assert_allclose(times.sigma_s, 2e-4, rtol=0.2)
    assert "scatter by 0.2" in times.scatter


@pytest.mark.parametrize("away_s", [0.004, -0.006])
def test_a_stamp_far_from_the_others_has_that_distance_as_its_sigma(away_s):
    times = stamped(PICTURES / 97 + away_s * (PICTURES == 40))
    assert np.flatnonzero(times.sigma_s).tolist() == [40]
    # A picture that comes before its time by more than half a step is taken for the one before.
    clock = CameraClock(times=times)
    assert clock.stamp_sigma_s(40) == pytest.approx(min(abs(away_s), 1 / 97 - abs(away_s)), rel=1e-6)
    assert clock.stamp_sigma_s(41) == 0.0
    assert times.scatter.startswith("t_s of frame 40 is 4")
