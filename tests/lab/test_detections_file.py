"""detections.csv: every good point comes back where it belongs, and bad rows are counted, not fatal."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from lab import columns
from lab.detections_file import read_detections
from lab.errors import InputError
from lab.frames import Missing, open_frames
from lab.run_file import load_run
from tests.lab.run_folders import edit, write_run
from tracking.detections import Detections

HEADER = ",".join(columns.DETECTIONS)


def table(folder: Path, *rows: str, header: str = HEADER) -> Path:
    path = folder / "detections.csv"
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


def row(
    frame: object, camera: str, u: object, v: object, sigma: object = 0.1, flux: object = 1.0, cov: object = 0
) -> str:
    return f"{frame},{camera},{u},{v},{sigma},{sigma},{flux},2.0,1.5,1.2,30.0,{cov}"


def test_a_point_comes_back_with_all_that_the_file_says(tmp_path):
    path = table(tmp_path, "3,left,10.25,-7.5,0.1,0.2,900,50,1.5,1.25,30,0.005")
    file = read_detections(path)
    assert (file.first, file.last, file.notes) == (3, 3, ())
    points = file.cameras["left"].at(3)
    np.testing.assert_array_equal(points.uv_px, [[10.25, -7.5]])
    np.testing.assert_allclose(points.cov_px2, [[[0.01, 0.005], [0.005, 0.04]]])
    assert (points.flux[0], points.peak[0], points.major_px[0], points.minor_px[0], points.angle_deg[0]) == (
        900, 50, 1.5, 1.25, 30,
    )  # fmt: skip


def test_rows_in_any_order_come_by_camera_and_frame_the_brightest_first(tmp_path):
    rng = np.random.default_rng(1)
    truth = [(f, c, rng.uniform(0, 64), rng.uniform(1, 9)) for f in range(30) for c in "ab" for _ in range(3)]
    order = rng.permutation(len(truth))
    file = read_detections(
        table(tmp_path, *(row(truth[i][0], truth[i][1], truth[i][2], 1.0, flux=truth[i][3]) for i in order))
    )
    for frame in range(30):
        for camera in "ab":
            expected = sorted((t for t in truth if t[:2] == (frame, camera)), key=lambda t: -t[3])
            np.testing.assert_array_equal(file.cameras[camera].at(frame).uv_px[:, 0], [t[2] for t in expected])
    assert len(file.cameras["a"].at(30)) == 0


def test_without_sigmas_a_tenth_of_a_pixel_is_assumed_and_said(tmp_path):
    file = read_detections(table(tmp_path, "0,left,1,2", header="frame,camera,u_px,v_px"))
    np.testing.assert_allclose(file.cameras["left"].at(0).cov_px2, [np.eye(2) * 0.01])
    assert np.isnan(file.cameras["left"].at(0).flux[0])
    assert file.notes[0].endswith("no column sigma_u_px and sigma_v_px: 0.1 px is assumed")


AGAIN = "the same point a second time, or one less than 0.05 px from it"
BAD_ROWS = [
    (row(1.5, "left", 1, 2), "the frame is no whole number", "frame 1.5"),
    (row("", "left", 1, 2), "the frame is no whole number", "frame nothing"),
    (row("1e300", "left", 1, 2), "the frame is no whole number", "frame 1e+300"),
    (row("one", "left", 1, 2), "the frame is no whole number", "frame 'one'"),
    (row(-1, "left", 1, 2), "the frame is negative; frames count from 0", "frame -1"),
    (row(1, "", 1, 2), "no camera is named", ""),
    (row(1, "left", "nan", 2), "u_px or v_px is no finite number", "u_px 'nan' and v_px 2"),
    (row(1, "left", 1, "inf"), "u_px or v_px is no finite number", "u_px 1 and v_px inf"),
    (row(1, "left", 1, "12;5"), "u_px or v_px is no finite number", "u_px 1 and v_px '12;5'"),
    (row(1, "left", -1e12, 2), "u_px or v_px is beyond 1000000 px: no picture is so wide", "u_px -1e+12 and v_px 2"),
    (row(1, "left", 1, 2, sigma=0), "a sigma is not above 0", "sigma_u_px 0 and sigma_v_px 0"),
    (row(1, "left", 1, 2, sigma=-0.1), "a sigma is not above 0", "sigma_u_px -0.1 and sigma_v_px -0.1"),
    (row(1, "left", 1, 2, sigma="nan"), "a sigma is not above 0", "sigma_u_px 'nan' and sigma_v_px 'nan'"),
    (row(1, "left", 1, 2, sigma=""), "a sigma is not above 0", "sigma_u_px nothing and sigma_v_px nothing"),
    (row(1, "left", 1, 2, sigma=1e-7),
     "a sigma is below 0.0001 px: no camera measures so well; is it in another unit?",
     "sigma_u_px 1e-07 and sigma_v_px 1e-07"),
    (row(1, "left", 1, 2, sigma=1e200), "a sigma is beyond 1000000 px", "sigma_u_px 1e+200 and sigma_v_px 1e+200"),
    (row(1, "left", 1, 2, cov=0.01), "cov_uv_px2 is not below the product of the sigmas", "cov_uv_px2 0.01"),
    (row(0, " left", 5, 6), AGAIN, "u_px 5 and v_px 6"),
    (row(0, "left", 5.02, 5.98), AGAIN, "u_px 5.02 and v_px 5.98"),
    # the last line of a writer that was killed
    ("1,le", "u_px or v_px is no finite number", "u_px nothing and v_px nothing"),
]  # fmt: skip


@pytest.mark.parametrize(("bad", "why", "found"), BAD_ROWS)
def test_a_row_that_cannot_be_used_is_left_out_and_said(bad, why, found, tmp_path):
    file = read_detections(table(tmp_path, row(0, "left", 5, 6), bad))
    assert list(file.cameras) == ["left"]
    assert len(file.cameras["left"].points) == 1
    assert (file.first, file.last) == (0, 0)
    shown = f", with {found}" if found else ""
    assert [n.split(": ", 1)[1] for n in file.notes] == [f"1 of 2 rows left out: {why} (the first near line 3{shown})"]


def test_a_line_with_too_many_fields_is_left_out_and_said(tmp_path):
    file = read_detections(table(tmp_path, row(0, "left", 5, 6), row(1, "left", 5, 6) + ",7,8", row(2, "left", 5, 6)))
    assert list(file.cameras["left"].frames) == [0, 2]
    assert file.notes[0].endswith("1 lines left out: more fields than the header has")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "expected columns frame,camera,u_px,v_px, got an empty file"),
        ("frame,camera,u,v_px\n0,left,1,2\n", "expected a column 'u_px', got frame,camera,u,v_px"),
        ("frame;camera;u_px;v_px\n0;left;1;2\n", "expected columns separated by commas, got semicolons"),
        ("frame,camera,u_px,v_px,u_px\n0,left,1,2,3\n", "expected each column once, got 'u_px' twice"),
    ],
)
def test_a_table_without_its_columns_is_told_so(text, words, tmp_path):
    path = tmp_path / "detections.csv"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_detections(path)
    assert words in str(caught.value)


@pytest.mark.parametrize("rows", [[], [row("x", "left", 1, 2)]])
def test_a_table_without_a_usable_row_stops_the_run_with_a_plain_line(rows, tmp_path):
    folder = write_run(tmp_path / "a")
    table(folder, *rows)
    edit(folder / "run.yaml", "{frames: frames/right}", "{detections: detections.csv}")
    with pytest.raises(InputError, match=r"detections\.csv: expected rows with frame, camera, .* got none that can be"):
        open_frames(load_run(folder))


def test_pictures_of_one_camera_and_points_of_the_other_come_together(tmp_path):
    folder = write_run(tmp_path / "a")
    table(folder, row(1, "right", 3, 4), row(3, "right", 5, 6), row(3, "right", 7, 8), row(3, "middle", 1, 1))
    edit(folder / "run.yaml", "{frames: frames/right}", "{detections: detections.csv}")
    reader = open_frames(load_run(folder))
    got = {s.frame: s.images for s in reader}
    assert list(got) == [0, 1, 2, 3, 4]
    assert all(isinstance(images["left"], np.ndarray) for images in got.values())
    # nothing found between two rows is a picture without points; beyond the rows there is no picture
    assert [type(got[f]["right"]) for f in range(5)] == [Missing, Detections, Detections, Detections, Missing]
    assert [len(got[f]["right"]) for f in (1, 2, 3)] == [1, 0, 2]
    assert any(n.endswith("rows of cameras that the rig does not have are not used: middle") for n in reader.notes)


@pytest.mark.slow
def test_a_million_rows_are_read_in_seconds(tmp_path):
    frames = np.repeat(np.arange(100_000), 10)
    with (tmp_path / "detections.csv").open("w") as file:
        file.write("frame,camera,u_px,v_px,sigma_u_px,sigma_v_px\n")
        file.writelines(f"{f},left,{i % 640}.{i % 97},{i % 10}.5,0.1,0.1\n" for i, f in enumerate(frames))
    started = time.process_time()
    points = read_detections(tmp_path / "detections.csv").cameras["left"]
    found = sum(len(points.at(f)) for f in range(100_000))
    assert found == 1_000_000
    assert time.process_time() - started < 20  # s; 4 measured: a frame table filtered per frame would take an hour
