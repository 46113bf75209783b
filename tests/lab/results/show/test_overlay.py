"""Annotated pictures and videos: what is drawn, at which size, and what happens where something is missing."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from lab.errors import InputError, RunError
from lab.files.run.results import read_poses
from lab.report.frames import canvas
from lab.report.frames.canvas import bgr
from lab.report.frames.content import frame_content, pose_words, read_result_data
from lab.report.frames.sheet import Layout, sheet
from lab.report.plot.svg import SPOT_COLOURS
from lab.results.show import show_frame, write_picture, write_video
from lab.runs.process import process_run
from lab.simulate.write import simulate
from tests.lab.command import typed
from tests.lab.fake_results import make
from tracking.statuses import PoseStatus, SpotStatus


@pytest.fixture(scope="module")
def fake(tmp_path_factory):
    return make(tmp_path_factory.mktemp("fake"), 220)


@pytest.fixture(scope="module")
def data(fake):
    return read_result_data(fake.results, fake.run_folder)


def content_of(data, index, **more):
    return frame_content(data, index, {}, list(data.spots.cameras), **more)


def some_frame(data, status):
    found = np.flatnonzero(data.spots.has(status).any(axis=1) & data.poses.known)
    return int(found[0])


@pytest.mark.parametrize("status", [SpotStatus.OCCLUDED, SpotStatus.OUT_OF_VIEW])
def test_a_spot_that_is_not_measured_has_a_track_and_a_beam_through_its_place(data, status):
    index = some_frame(data, status)
    marks = [m for c in content_of(data, index).cameras for m in c.marks]
    assert any(m.status == status for m in marks)
    for m in marks:
        if m.status.measured:
            assert (len(m.track_px), len(m.beam_px)) == (0, 0)
        elif np.isfinite(m.uv_px).all():
            reach = 5 * np.sqrt(np.linalg.eigvalsh(m.cov_px2)[-1]) + 2
            assert np.nanmin(np.linalg.norm(m.track_px - m.uv_px, axis=1)) < reach
            between = np.linalg.norm(np.diff(m.beam_px, axis=0), axis=1).max()
            assert np.nanmin(np.linalg.norm(m.beam_px - m.uv_px, axis=1)) < reach + between


def test_without_a_pose_beams_are_those_of_the_nearest_known_pose(data):
    lost = np.flatnonzero(data.poses.has(PoseStatus.LOST))
    index = int(lost[len(lost) // 2])
    content = content_of(data, index)
    assert content.pose_words == "no pose"
    assert data.poses.known[np.flatnonzero(data.poses.frames == content.beams_of_frame)].all()
    assert all(len(m.track_px) == 0 and len(m.beam_px) > 0 for c in content.cameras for m in c.marks)


def test_the_ring_of_a_measured_spot_has_the_colour_of_its_status(data):
    index = int(np.flatnonzero(data.spots.measured.all(axis=1))[0])
    layout = Layout.of([data.sizes_px["left"]])
    picture = sheet(frame_content(data, index, {}, ["left"]), layout, cuts=False)
    wanted = np.abs(picture.astype(int) - np.array(bgr(SPOT_COLOURS[SpotStatus.MATCHED]))).max(axis=2) < 8
    count, _, boxes, centres = cv2.connectedComponentsWithStats(wanted.astype(np.uint8))
    rings = [
        tuple(centres[i])
        for i in range(1, count)
        if 15 < boxes[i, cv2.CC_STAT_WIDTH] < 60 and boxes[i, cv2.CC_STAT_HEIGHT] > 15
    ]
    scale = layout.widths[0] / data.sizes_px["left"][0]
    expected = (data.spots.uv_px[index, data.spots.views_of("left")] + 0.5) * scale
    offsets = [min(np.subtract(r, e)[0] for r in [min(rings, key=lambda r, e=e: abs(r[0] - e[0]))]) for e in expected]
    # One shift of the whole picture on the sheet explains all of them: its left margin.
    assert np.ptp(offsets) < 1.5


@pytest.mark.parametrize(
    ("size_px", "least", "most"),
    [((64, 48), 600, 800), ((320, 240), 900, 1000), ((1280, 1024), 1280, 1280), ((6000, 4000), 1500, 1700)],
)
def test_small_pictures_are_enlarged_and_large_ones_are_not(size_px, least, most):
    assert least <= Layout.of([size_px]).widths[0] <= most


def test_a_picture_of_any_size_can_be_drawn(data):
    index = some_frame(data, SpotStatus.OCCLUDED)
    for size_px in ((8, 6), (64, 48), (1000, 20), (20, 1000), (3000, 2000)):
        resized = replace(data, sizes_px=dict.fromkeys(data.sizes_px, size_px))
        grey = np.random.default_rng(1).integers(0, 4000, size_px[::-1]).astype(np.uint16)
        content = frame_content(resized, index, {"left": grey}, ["left", "right"])
        picture = sheet(content, Layout.of([size_px, size_px]))
        assert picture.shape[2] == 3
        assert max(picture.shape) < 4500


def test_prediction_ellipses_have_the_scatter_of_the_predictions(data):
    content = content_of(data, 100)
    spots = data.spots
    for mark, j in zip(content.cameras[0].marks, data.spots.views_of("left"), strict=True):
        part = slice(50, 151)
        e = (spots.uv_px[part, j] - spots.predicted_px[part, j])[spots.measured[part, j]]
        if len(e) > 30:
            ratio = np.sqrt(np.diag(mark.predicted_cov_px2)) / (1.4826 * np.median(np.abs(e), axis=0))
            assert (ratio > 0.6).all()
            assert (ratio < 1.7).all()


def test_results_without_their_run_folder_are_drawn_on_empty_pictures(fake, tmp_path):
    shutil.copytree(fake.results, tmp_path / "results", ignore=shutil.ignore_patterns("summary.json"))
    shown = show_frame(tmp_path / "results", 10)
    assert re.search(r"its run folder .* is not there; name it with --run", shown.notes[0])
    assert all(c.picture is None for c in shown.content.cameras)
    assert any(np.isfinite(m.uv_px).all() for c in shown.content.cameras for m in c.marks)


def test_the_pictures_and_detections_of_the_run_are_shown(tmp_path):
    fake = make(tmp_path, 3, pictures=True)
    shown = show_frame(fake.results, 1, run_folder=fake.run_folder)
    assert all(c.picture is not None and c.picture.shape == c.size_px[::-1] for c in shown.content.cameras)
    assert all(len(c.detections) > 0 for c in shown.content.cameras)
    assert shown.notes == ()
    pictures = played(write_video(fake.results, fake.run_folder).result)
    assert len(pictures) == 3
    assert pictures[0][200:-100].max() > 200


def test_a_run_folder_is_processed_up_to_the_frame(tmp_path):
    run = simulate("huo2015", tmp_path / "run", frames=30, points=True, seed=11)
    process_run(run, tmp_path / "out", causal=True)
    shown = show_frame(run, 20)
    assert shown.content.pose_words == pose_words(read_poses(tmp_path / "out"), 20)
    assert "beampose run" in shown.notes[-1]
    with pytest.raises(InputError, match="expected a frame of the run, 0 to 29"):
        show_frame(run, 30)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("{r}", "--frame", "900"), "expected a frame of the results, 0 to 219"),
        (("{r}", "--frame", "3", "--camera", "lfet"), "expected one of left, right"),
        (("{r}", "--frame", "3", "--out", "a.jpg"), "expected the name of a .png file"),
        (("{here}", "--frame", "3"), "found neither"),
        (("{run}", "--frame", "3", "--run", "{run}"), "leave --run out"),
    ],
)
def test_a_mistake_is_one_line_and_status_2(fake, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    known = {"r": fake.results, "run": fake.run_folder, "here": tmp_path}
    done = typed("show", *(a.format(**known) for a in arguments))
    assert (done.exit_code, done.stderr.count("\n")) == (2, 1)
    assert words in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_picture_is_written_whole_or_not_at_all(tmp_path):
    write_picture(np.zeros((4, 4, 3), np.uint8), tmp_path / "a.png")
    assert cv2.imread(str(tmp_path / "a.png")).shape == (4, 4, 3)
    with pytest.raises(InputError, match="make its folder first"):
        write_picture(np.zeros((4, 4, 3), np.uint8), tmp_path / "none" / "a.png")


def played(path):
    capture = cv2.VideoCapture(str(path))
    out = []
    while True:
        good, picture = capture.read()
        if not good:
            return out
        out.append(picture)


def test_a_video_has_the_selected_frames_with_tails(fake):
    written = write_video(fake.results, fake.run_folder, first=10, last=40, every=10)
    pictures = played(written.result)
    assert (len(pictures), written.result.name) == (4, "overlay.mp4")
    assert "(4 frames)" in written.line()
    assert np.abs(pictures[0].astype(int) - pictures[-1]).max() > 50
    assert len({p.shape for p in pictures}) == 1
    assert [p.name for p in fake.results.iterdir() if p.name.startswith(".")] == []


def test_a_tail_is_the_way_of_the_spot_until_now(data):
    content = content_of(data, 60, tail=20)
    for mark, j in zip(content.cameras[0].marks, data.spots.views_of("left"), strict=True):
        np.testing.assert_array_equal(mark.tail_px, data.spots.uv_px[40:61, j][::-1])


def test_where_a_codec_is_missing_the_next_one_is_used_and_named(fake, monkeypatch):
    monkeypatch.setattr(canvas, "CODECS", (("????", ".avi"), ("MJPG", ".avi")))
    written = write_video(fake.results, fake.run_folder, last=2)
    assert "cannot write ???? videos" in written.notes[-1]
    assert len(played(written.result)) == 3


def test_where_no_codec_works_nothing_is_left(fake, monkeypatch):
    before = sorted(p.name for p in fake.results.iterdir())
    monkeypatch.setattr(canvas, "CODECS", (("????", ".avi"),))
    with pytest.raises(RunError, match="no video could be written"):
        write_video(fake.results, fake.run_folder, last=2)
    assert sorted(p.name for p in fake.results.iterdir()) == before


def test_frames_that_the_results_do_not_have_and_options_without_a_video_are_refused(fake):
    with pytest.raises(InputError, match="--from 500"):
        write_video(fake.results, fake.run_folder, first=500)
    done = typed("report", fake.results, "--every", "2")
    assert done.exit_code == 2
    assert "add --video" in done.output


def test_names_are_drawn_as_far_as_this_opencv_can(monkeypatch):
    monkeypatch.setattr(canvas, "_DRAWS_UNICODE", False)
    assert canvas.plain("línks ü 屏 1\n") == "links u ? 1?"
    monkeypatch.setattr(canvas, "_DRAWS_UNICODE", True)
    assert canvas.plain("línks ü 1\n") == "línks ü 1?"
