"""Written recordings are run folders of the contract, and the judge of runs sees what is right and what is wrong."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from bench.random_pictures.adapter import model_of_pictures, variance_at
from bench.random_pictures.judge import (
    LEAST_SNR,
    WIDEST_PX,
    compared,
    counted_pairs,
    judge,
    oracle_scene,
    visible,
    wrong_diagnoses,
)
from bench.random_pictures.looks import FAMILIES
from bench.random_pictures.render import Renderer
from bench.random_pictures.report import crashed, details, summary, write_rows
from bench.random_pictures.scene import picture_scene
from bench.random_pictures.sensors import Sensor, true_noise
from bench.random_pictures.write_folder import write_pictures
from bench.random_scenes.__main__ import main
from bench.random_scenes.write_folder import write_run_folder
from lab.files.run.run_file import load_run
from lab.pictures.picture_file import MissingPicture
from lab.runs.frames.frames import open_frames
from lab.runs.process import process_run
from tests.marks import further_slow
from tracking.noise import NoiseModel

SMALL = ((320, 256),)


@pytest.mark.parametrize("file_format", ["png", "jpg", "mjpg"])
def test_a_written_recording_is_a_run_folder_that_states_no_noise(tmp_path: Path, file_format):
    ps = picture_scene(2, None, 5, SMALL)
    sensor = Sensor(8, 20_000, 4.0, 0.02, file_format=file_format, quality=95)
    has_image = ps.scene.has_image.copy()
    has_image[3, 0] = file_format == "mjpg"
    ps = replace(ps, look=replace(ps.look, sensor=sensor), scene=replace(ps.scene, has_image=has_image))
    renderer = Renderer(ps)
    run = load_run(write_pictures(renderer, tmp_path / "run"))
    assert all(camera.noise is None for camera in run.rig.cameras.values())
    assert run.prior is not None
    assert run.exposure_s == pytest.approx(ps.look.exposure_share / ps.scene.frame_rate_hz)
    frames = list(open_frames(run))
    assert len(frames) == len(ps)
    for k in (0, 3, 4):
        for c, name in enumerate(run.rig.cameras):
            picture = frames[k].images[name]
            assert isinstance(picture, MissingPicture) != has_image[k, c]
            if isinstance(picture, np.ndarray):
                off = picture.astype(float) - renderer.raw(k, c)
                assert np.abs(off).max() == 0 if file_format == "png" else np.sqrt(np.mean(off**2)) < 4


@pytest.mark.parametrize("family", further_slow(FAMILIES, fast=5))
def test_each_family_gives_a_scene_with_spots_to_ask_for(family):
    renderer = Renderer(picture_scene(7, family, 12, SMALL))
    scene = renderer.ps.scene
    sizes = {camera.image_size_px for camera in scene.rig.cameras.values()}
    assert sizes == ({(1280, 1024)} if family == "issue" else set(SMALL))
    for c in range(len(renderer.still)):
        assert renderer.expected(0, c).min() >= 0
    first = np.flatnonzero(scene.shining[0])
    assert np.mean(renderer.snr[0, first] >= LEAST_SNR) > 0.4


def test_the_true_noise_is_stated_in_the_numbers_of_the_files_where_that_is_asked(tmp_path: Path):
    ps = picture_scene(2, None, 5, SMALL)
    sensor = Sensor(10, 20_000, 4.0, 0.02, row_e=3.0, shift=6)
    ps = replace(ps, look=replace(ps.look, sensor=sensor))
    rig = load_run(write_pictures(Renderer(ps), tmp_path / "run", state_noise=True)).rig
    noise = next(iter(rig.cameras.values())).noise
    assert noise is not None
    level, variance = true_noise(sensor, 4_000.0, np.random.default_rng(1))
    assert NoiseModel.of(noise).variance(level) == pytest.approx(variance, rel=0.05)


def test_the_same_seed_gives_the_same_pictures():
    first, again = (Renderer(picture_scene(3, None, 12, SMALL)) for _ in range(2))
    np.testing.assert_array_equal(first.picture(4, 0), again.picture(4, 0))
    assert (first.picture(4, 0) != first.picture(5, 0)).any()


def test_a_spot_beside_another_light_is_not_asked_for():
    renderer = Renderer(picture_scene(3, "16-bit", 4, SMALL))
    for k in range(4):
        for c in range(len(renderer.still)):
            renderer.expected(k, c)
    pairs = counted_pairs(renderer)
    k, view = np.argwhere(pairs)[0]
    c = renderer.ps.scene.camera_of[view]
    u, v = renderer.ps.scene.uv_px[k, view]
    beside = u + 3 * renderer.width_px[view] + 2
    renderer.still[c] = replace(renderer.still[c], bright=np.array([[beside, v, 1.0]]))
    assert not counted_pairs(renderer)[k, view]
    assert counted_pairs(renderer).sum() < pairs.sum()


def test_a_spot_wider_than_the_detector_accepts_is_not_asked_for():
    renderer = Renderer(picture_scene(3, "16-bit", 4, SMALL))
    for k in range(4):
        for c in range(len(renderer.still)):
            renderer.expected(k, c)
    view = int(np.argwhere(counted_pairs(renderer))[0, 1])
    renderer.width_px[view] = 1.1 * WIDEST_PX
    assert not counted_pairs(renderer)[:, view].any()
    assert not oracle_scene(renderer).shining[:, view].any()


@pytest.fixture(scope="module")
def solved(tmp_path_factory: pytest.TempPathFactory) -> tuple[Renderer, Path]:
    """A scene, and the results of a run on its spots as points at their true places: no detector is involved."""
    folder = tmp_path_factory.mktemp("solved")
    renderer = Renderer(picture_scene(3, "16-bit", 20, SMALL))
    for k in range(20):
        for c in range(len(renderer.still)):
            renderer.expected(k, c)
    process_run(write_run_folder(oracle_scene(renderer), folder / "run"), folder / "out")
    return renderer, folder / "out"


def test_a_right_answer_is_judged_right(solved):
    renderer, out = solved
    row = judge(renderer, out, 0, (0.0, 0.0))
    assert row.counts
    assert row.pairs > 0.8 * visible(renderer).sum()
    assert row.right == 1.0
    assert row.recall == 1.0
    assert row.wrong == row.wrong_poses == 0
    assert row.false_per_picture == 0
    assert row.scatter == pytest.approx(1, abs=0.4)
    assert not row.wrong_diagnoses
    assert row.classes == ()


def test_places_that_are_off_are_wrong_labels_and_missing_spots(solved, tmp_path: Path):
    renderer, out = solved
    for name in ("attitude.csv", "covariance.csv", "detections.csv", "summary.json"):
        (tmp_path / name).write_bytes((out / name).read_bytes())
    with (out / "spots.csv").open(newline="", encoding="utf-8") as file:
        header, *rows = csv.reader(file)
    u, spot = header.index("u_px"), header.index("spot")
    for row in rows:
        if row[spot] == rows[0][spot] and row[u]:
            row[u] = str(float(row[u]) + 30)
    with (tmp_path / "spots.csv").open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([header, *rows])
    row = judge(renderer, tmp_path, 4, (0.0, 0.0))
    assert row.wrong > 10
    assert row.right < 0.97
    assert {"wrong labels", "spots missing", "exit status"} <= set(row.classes)


def test_blaming_the_lasers_of_a_scene_with_light_is_a_wrong_diagnosis(solved):
    renderer, _ = solved
    camera = next(iter(renderer.ps.scene.rig.cameras))

    def said(kind: str, what: str = "", **numbers: object) -> tuple[str, ...]:
        evidence = {"kind": kind, "what": what, "numbers": numbers}
        return wrong_diagnoses(renderer, {"verdict": {"evidence": [evidence]}})

    assert said("nothing_detected", camera=camera)
    assert said("not_acquired")
    assert said("model", "the residuals do not fit the rig file, and no single camera explains it")
    assert said("missing_pictures", camera=camera)
    assert not said("model", "the spots' residuals are 2 times as large as the sigmas; they are random")
    assert not said("few_measured")
    spot = renderer.ps.scene.rig.views()[0][1]
    assert said("model", f"spot {spot} in camera `{camera}` was measured in 2 of 20 frames in which")


def test_a_true_model_is_right_at_both_levels_and_one_of_twice_the_variance_is_not():
    renderer = Renderer(picture_scene(5, "16-bit", 12, SMALL))
    sensor, c = renderer.ps.look.sensor, 0
    g = sensor.gain_e_per_dn
    true = NoiseModel((sensor.read_e**2 + sensor.row_e**2) / g**2 + 1 / 12, 1 / g, sensor.black_dn)
    figures = compared(renderer, c, "x", true)
    assert figures.background == pytest.approx(1, abs=0.05)
    assert figures.half == pytest.approx(1, abs=0.05)
    twice = NoiseModel(2 * true.floor_dn2, 2 * true.slope_dn, true.black_dn)
    assert compared(renderer, c, "x", twice).half == pytest.approx(2, rel=0.05)


def test_the_adapter_gives_a_model_of_pictures():
    rng = np.random.default_rng(0)
    pictures = [np.rint(rng.normal(50, 3, (200, 300))).astype(np.uint8) for _ in range(6)]
    model = model_of_pictures(6, lambda k: pictures[k])
    assert variance_at(model, 50.0) == pytest.approx(9, rel=0.3)


def test_compression_is_in_the_true_noise():
    raw, jpeg = (Sensor(8, 20_000, 4.0, 0.02, file_format=f, quality=85) for f in ("png", "jpg"))
    light = 4_000.0
    plain = true_noise(raw, light, np.random.default_rng(1))[1]
    packed = true_noise(jpeg, light, np.random.default_rng(1))[1]
    assert packed < 0.8 * plain  # at this quality JPEG takes part of the noise away


def test_a_crash_is_a_class_of_its_own_and_the_table_has_a_row_per_scene(tmp_path: Path):
    renderer = Renderer(picture_scene(3, "16-bit", 12, SMALL))
    row = crashed(renderer, 10, "ZeroDivisionError: division by zero")
    assert row.failure == "crash"
    assert "ZeroDivisionError" in details(row)
    assert "crash: 2 | 2" in summary([row, row])
    write_rows([row, row], tmp_path / "rows.csv")
    assert len((tmp_path / "rows.csv").read_text().splitlines()) == 3


def test_an_unknown_family_is_a_plain_line(capsys, monkeypatch):
    monkeypatch.setattr("sys.argv", ["bench", "--pictures", "--family", "faintest"])
    with pytest.raises(SystemExit) as caught:
        main()
    assert caught.value.code == 2
    assert "--family: expected one of all, issue, faint" in capsys.readouterr().err


def test_the_pictures_of_a_video_come_back(tmp_path: Path):
    ps = picture_scene(4, "mjpg", 12, SMALL)
    renderer = Renderer(ps)
    folder = write_pictures(renderer, tmp_path / "run")
    name = next(iter(ps.scene.rig.cameras))
    video = cv2.VideoCapture(str(folder / f"{name}.avi"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == len(ps)
    assert ps.scene.has_image.all()
