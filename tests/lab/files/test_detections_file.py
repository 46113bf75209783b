"""detections.csv: good rows are read, bad rows are left out and counted."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lab.errors import InputError
from lab.files.run.detections_file import read_detections
from lab.files.run.run_file import load_run
from lab.files.text import columns
from lab.pictures.picture_file import MissingPicture
from lab.runs.frames.frames import open_frames
from lab.runs.input_check import check
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


def test_a_point_has_all_values_of_its_row(tmp_path):
    path = table(tmp_path, "3,left,10.25,-7.5,0.1,0.2,900,50,1.5,1.25,30,0.005")
    file = read_detections(path)
    assert (file.first, file.last, file.notes) == (3, 3, ())
    points = file.cameras["left"].at(3)
    np.testing.assert_array_equal(points.uv_px, [[10.25, -7.5]])
    np.testing.assert_allclose(points.cov_px2, [[[0.01, 0.005], [0.005, 0.04]]])
    assert (points.flux[0], points.peak[0], points.major_px[0], points.minor_px[0], points.angle_deg[0]) == (
        900, 50, 1.5, 1.25, 30,
    )  # fmt: skip


def test_rows_are_sorted_by_camera_and_frame_brightest_first(tmp_path):
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


def test_without_sigmas_a_tenth_of_a_pixel_is_assumed_and_noted(tmp_path):
    file = read_detections(table(tmp_path, "0,left,1,2", header="frame,camera,u_px,v_px"))
    np.testing.assert_allclose(file.cameras["left"].at(0).cov_px2, [np.eye(2) * 0.01])
    assert np.isnan(file.cameras["left"].at(0).flux[0])
    assert file.notes[0].endswith("no column sigma_u_px and sigma_v_px: 0.1 px is assumed")


AGAIN = "the same point a second time, or one less than 0.05 px from it"
BAD_ROWS = [
    (row(1.5, "left", 1, 2), "the frame is not a whole number", "frame 1.5"),
    (row("", "left", 1, 2), "the frame is not a whole number", "frame nothing"),
    (row("1e300", "left", 1, 2), "the frame is not a whole number", "frame 1e+300"),
    (row("one", "left", 1, 2), "the frame is not a whole number", "frame 'one'"),
    (row(-1, "left", 1, 2), "the frame is negative; frames count from 0", "frame -1"),
    (row(1, "", 1, 2), "the camera is empty", ""),
    (row(1, "left", "nan", 2), "u_px or v_px is not a finite number", "u_px 'nan' and v_px 2"),
    (row(1, "left", 1, "inf"), "u_px or v_px is not a finite number", "u_px 1 and v_px inf"),
    (row(1, "left", 1, "12;5"), "u_px or v_px is not a finite number", "u_px 1 and v_px '12;5'"),
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
    ("1,le", "u_px or v_px is not a finite number", "u_px nothing and v_px nothing"),
]  # fmt: skip


@pytest.mark.parametrize(("bad", "why", "found"), BAD_ROWS)
def test_an_unusable_row_is_left_out_and_noted(bad, why, found, tmp_path):
    file = read_detections(table(tmp_path, row(0, "left", 5, 6), bad))
    assert list(file.cameras) == ["left"]
    assert len(file.cameras["left"].points) == 1
    assert (file.first, file.last) == (0, 0)
    shown = f", with {found}" if found else ""
    assert [n.split(": ", 1)[1] for n in file.notes] == [f"1 of 2 rows left out: {why} (the first in line 3{shown})"]


def test_a_line_that_is_cut_short_after_its_point_is_used_and_noted(tmp_path):
    cut = row(1, "left", 5, 6).rsplit(",", 2)[0]
    file = read_detections(table(tmp_path, row(0, "left", 5, 6), cut, row(2, "left", 5, 6)))
    assert list(file.cameras["left"].frames) == [0, 1, 2]
    assert [n.split(": ", 1)[1] for n in file.notes] == [
        "1 line with fewer fields than the header, the first in line 3; their missing fields are taken as empty"
    ]


def test_a_line_with_too_many_fields_is_left_out_and_noted(tmp_path):
    file = read_detections(table(tmp_path, row(0, "left", 5, 6), row(1, "left", 5, 6) + ",7,8", row(2, "left", 5, 6)))
    assert list(file.cameras["left"].frames) == [0, 2]
    assert file.notes[0].endswith(
        "1 line left out: more fields than the header has (a comma too many, or a decimal comma)"
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "expected columns frame,camera,u_px,v_px, got an empty file"),
        ("frame,camera,u,v_px\n0,left,1,2\n", "expected a column 'u_px', got frame,camera,u,v_px"),
        ("frame;camera;u_px;v_px\n0;left;1;2\n", "expected columns separated by commas, got semicolons"),
        ("frame,camera,u_px,v_px,u_px\n0,left,1,2,3\n", "expected each column once, got 'u_px' twice"),
    ],
)
def test_a_table_without_its_columns_is_refused(text, words, tmp_path):
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
    with pytest.raises(
        InputError, match=r"detections\.csv: expected rows with frame, camera, .* got none that can be used"
    ):
        open_frames(load_run(folder))


def test_pictures_of_one_camera_and_points_of_the_other_can_be_combined(tmp_path):
    folder = write_run(tmp_path / "a")
    table(folder, row(1, "right", 3, 4), row(3, "right", 5, 6), row(3, "right", 7, 8), row(3, "middle", 1, 1))
    edit(folder / "run.yaml", "{frames: frames/right}", "{detections: detections.csv}")
    reader = open_frames(load_run(folder))
    got = {s.frame: s.images for s in reader}
    assert list(got) == [0, 1, 2, 3, 4]
    assert all(isinstance(images["left"], np.ndarray) for images in got.values())
    # nothing found between two rows is a picture without points; beyond the rows there is no picture
    assert [type(got[f]["right"]) for f in range(5)] == [MissingPicture, *3 * [Detections], MissingPicture]
    assert [len(got[f]["right"]) for f in (1, 2, 3)] == [1, 0, 2]
    assert any(n.endswith("rows of cameras that the rig does not have are not used: middle") for n in reader.notes)


def points_for_right(folder: Path, *rows: str) -> Path:
    """A run where camera `right` has detected points, and `left` five pictures."""
    write_run(folder)
    table(folder, *rows)
    edit(folder / "run.yaml", "{frames: frames/right}", "{detections: detections.csv}")
    return folder


def test_the_order_of_columns_and_unknown_columns_do_not_matter(tmp_path):
    usual = read_detections(table(tmp_path, row(0, "left", 5, 6, sigma=0.2), row(2, "left", 7, 8)))
    header = "v_px,quality,camera,sigma_v_px,u_px,frame,sigma_u_px"
    other = read_detections(table(tmp_path, "8,good,left,0.1,7,2,0.1", "6,bad,left,0.2,5,0,0.2", header=header))
    assert other.notes == ()
    for frame in (0, 2):
        np.testing.assert_array_equal(other.cameras["left"].at(frame).uv_px, usual.cameras["left"].at(frame).uv_px)
        np.testing.assert_array_equal(other.cameras["left"].at(frame).cov_px2, usual.cameras["left"].at(frame).cov_px2)


@given(
    bad=st.lists(st.tuples(st.sampled_from(BAD_ROWS), st.integers(0, 12)), max_size=8),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=20, deadline=None, derandomize=True)
def test_bad_rows_do_not_affect_good_ones(bad, seed, tmp_path_factory):
    rng = np.random.default_rng(seed)
    # the frames 0 and 1 have other points than BAD_ROWS are beside
    good = [row(f, "left", round(u, 3), 40.0 + k) for f in range(4) for k, u in enumerate(rng.uniform(9, 60, 3))]
    lines = [*good, row(0, "left", 5, 6)]
    for (text, _, _), place in bad:
        lines.insert(place, text)
    folder = tmp_path_factory.mktemp("bad")
    expected = read_detections(table(folder, *good)).cameras["left"]
    got = read_detections(table(folder, *lines)).cameras["left"]
    for frame in range(4):
        uv = got.at(frame).uv_px
        beside = (uv[:, 1] < 7) if frame == 0 else np.zeros(len(uv), dtype=bool)  # of the twins one is kept
        assert beside.sum() == (frame == 0)
        np.testing.assert_array_equal(uv[~beside], expected.at(frame).uv_px)


def test_of_two_points_of_one_spot_the_more_precise_one_is_kept(tmp_path):
    rows = [
        row(0, "left", 5, 6, sigma=0.3),
        row(0, "left", 5.03, 6.03, sigma=0.1),
        row(0, "left", 5.06, 6.0, sigma=0.2),
    ]
    file = read_detections(table(tmp_path, *rows, row(1, "left", 5, 6), row(1, "right", 5, 6)))
    np.testing.assert_array_equal(file.cameras["left"].at(0).uv_px, [[5.03, 6.03]])
    # in another frame, or to another camera, it is another point
    assert (len(file.cameras["left"].at(1)), len(file.cameras["right"].at(1))) == (1, 1)


def test_two_spots_a_tenth_of_a_pixel_apart_are_both_kept(tmp_path):
    file = read_detections(table(tmp_path, row(0, "left", 5, 6), row(0, "left", 5.1, 6), row(0, "left", 5, 6.1)))
    assert len(file.cameras["left"].at(0)) == 3


def test_a_few_frames_far_from_all_others_are_left_out_and_the_run_is_kept(tmp_path):
    rows = [row(f, "right", 5 + f % 50, 6) for f in range(600)]
    rows.insert(300, row(10**9, "right", 9, 9))
    folder = points_for_right(tmp_path / "a", *rows)
    reader = open_frames(load_run(folder))
    assert (reader.first, reader.last) == (0, 599)
    far = "1 of 601 rows left out: the frame is more than 10000 numbers away from the others (the first in line 302,"
    assert any(far in n and n.endswith("with frame 1e+09)") for n in reader.notes)


def test_one_row_after_a_gap_longer_than_the_recording_is_left_out_too(tmp_path):
    rows = [row(f, "right", 5 + f % 50, 6) for f in range(600)]
    folder = points_for_right(tmp_path / "a", *rows, row(90000, "right", 9, 9))
    reader = open_frames(load_run(folder))
    assert (reader.first, reader.last) == (0, 599)
    assert any("1 of 601 rows left out: the frame is more than 10000 numbers away" in n for n in reader.notes)


def test_time_stamps_as_frame_numbers_are_refused(tmp_path):
    folder = points_for_right(tmp_path / "a", *(row(f * 10_000_000, "right", 5, 6) for f in range(100)))
    with pytest.raises(InputError, match="expected frame numbers without gaps of many thousands, got 105 pictures"):
        open_frames(load_run(folder))


def test_rows_of_a_misspelt_camera_are_refused_with_a_suggestion(tmp_path):
    folder = points_for_right(tmp_path / "a", row(0, "rigth", 5, 6))
    words = "camera: expected rows of 'right', got none, but rows of 'rigth', which the rig does not have; did you mean"
    with pytest.raises(InputError, match=words + r" 'right'\?$"):
        open_frames(load_run(folder))


def test_a_camera_without_rows_in_a_shared_table_has_no_spots_which_is_noted(tmp_path):
    folder = points_for_right(tmp_path / "a", row(0, "right", 5, 6))
    edit(folder / "run.yaml", "{frames: frames/left}", "{detections: detections.csv}")
    reader = open_frames(load_run(folder))
    assert any(n.endswith("no rows of camera 'left'; all its pictures count as empty") for n in reader.notes)
    assert [len(s.images["left"]) for s in reader] == [0]


def test_a_camera_without_a_usable_row_is_refused_with_the_reason(tmp_path):
    rows = [row(f, "right", 5, 6, sigma=0) for f in range(3)]
    folder = points_for_right(tmp_path / "a", *rows, row(0, "left", 5, 6))
    words = (
        r"camera 'right': expected rows that can be used, got none: a sigma is not above 0 \(the first in line 2,"
        r" with sigma_u_px 0 and sigma_v_px 0\); put them right, or leave 'right' out of `cameras` in .*run\.yaml"
    )
    with pytest.raises(InputError, match=words):
        open_frames(load_run(folder))


def test_a_picture_without_a_usable_row_is_unreadable_not_empty(tmp_path):
    rows = [row(0, "right", 5, 6), row(1, "right", 5, 6, sigma="nan"), row(2, "right", 5, 6, sigma="nan")]
    folder = points_for_right(tmp_path / "a", *rows, row(2, "right", 9, 9), row(4, "right", 5, 6))
    reader = open_frames(load_run(folder))
    images = [s.images["right"] for s in reader]
    assert images[1] == MissingPicture("unreadable: no row of it can be used")
    assert [len(images[k]) for k in (0, 2, 3, 4)] == [1, 1, 0, 1]
    assert "right: 1 frame unreadable: no row of it can be used (1)" in reader.notes
    lines = check(folder).lines
    assert any("2 of 5 rows left out: a sigma is not above 0" in line for line in lines)
    assert any("right: 1 frame unreadable: no row of it can be used (1)" in line for line in lines)


def test_points_far_outside_the_picture_are_left_out_and_a_table_of_them_is_refused(tmp_path):
    # 64x48 px
    folder = points_for_right(tmp_path / "a", row(0, "right", 5, 6), row(1, "right", 7, 8), row(1, "right", 900, 8))
    reader = open_frames(load_run(folder))
    assert [len(s.images["right"]) for s in reader if s.frame < 2] == [1, 1]
    text = "1 of 3 points more than 32 px outside its picture of 64x48 px (the first in frame 1, at 900, 8)"
    assert any(n.endswith(text) for n in reader.notes)
    folder = points_for_right(tmp_path / "b", row(0, "right", 5, 600), row(1, "right", 7, 800))
    with pytest.raises(InputError, match=r"got 2 of 2 points more than 32 px outside .*; are u and v exchanged, or"):
        open_frames(load_run(folder))


def test_a_picture_full_of_points_is_kept_and_noted(tmp_path):
    many = [row(2, "right", 5 + i % 100 / 2, 1 + i // 100 / 4) for i in range(10_000)]
    reader = open_frames(load_run(points_for_right(tmp_path / "a", row(0, "right", 5, 6), *many)))
    assert [len(s.images["right"]) for s in reader if s.frame in (0, 2)] == [1, 10_000]
    assert any("up to 10000 points in one picture (frame 2)" in n for n in reader.notes)


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
