"""`beampose stereo` on simulated recordings: the files of the contract, honest sigmas, and plain messages."""

import csv
import json
import shutil

import cv2
import numpy as np
import pytest
import yaml

from bench.related_measurements.stereo_checks import STATED, processed, stated_eyes
from bench.related_measurements.stereo_generator import approach, write_recording
from lab.errors import InputError
from lab.files.text import columns
from lab.findings.finding import Verdict
from lab.number_format import decimals_of
from lab.targets.stereo.process import findings_of, process_stereo_run
from lab.targets.stereo.simulated_recording import write_stereo_recording
from tests.lab.command import typed
from tests.lab.tables import rows_of
from tests.marks import further_slow

FRAMES = 12  # of the recording of points


@pytest.fixture(scope="module")
def drogue(tmp_path_factory):
    """A recording of points."""
    return write_stereo_recording(tmp_path_factory.mktemp("points") / "run", seed=5, frames=FRAMES, points=True)


@pytest.fixture(scope="module")
def result(drogue, tmp_path_factory):
    return process_stereo_run(drogue, tmp_path_factory.mktemp("results") / "out")


def changed(drogue, folder, **fields):
    """A copy of a run folder with other fields in run.yaml; None removes one."""
    shutil.copytree(drogue, folder)
    content = yaml.safe_load((folder / "run.yaml").read_text(encoding="utf-8")) | fields
    content = {key: value for key, value in content.items() if value is not None}
    (folder / "run.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    return folder


def first_frames(run, count, shift=0):
    """Leaves the first frames of a run, those of the right camera with other numbers."""
    table = [r for r in rows_of(run / "detections.csv") if int(r["frame"]) < count]
    with (run / "detections.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, table[0])
        writer.writeheader()
        writer.writerows({**r, "frame": int(r["frame"]) + shift * (r["camera"] == "right")} for r in table)


def test_the_tables_have_the_columns_of_the_contract_and_a_row_per_frame(result):
    for name, header in (
        ("attitude.csv", columns.ATTITUDE), ("covariance.csv", columns.COVARIANCE), ("spots.csv", columns.SPOTS),
        ("detections.csv", columns.DETECTIONS),
    ):  # fmt: skip
        assert tuple(rows_of(result.out / name)[0]) == header
    attitude = rows_of(result.out / "attitude.csv")
    assert [int(r["frame"]) for r in attitude] == list(range(FRAMES))
    assert {r["status"] for r in attitude} == {"measured"}
    assert len(rows_of(result.out / "spots.csv")) == FRAMES * 2 * 7


def test_the_pose_errors_agree_with_the_stated_covariance(result):
    assert result.exit_status == 0
    nees = result.result.errors.nees
    assert 3.0 < nees.mean() < 10.0  # 6 expected; sigma of the mean: 1.2
    assert np.abs(result.result.errors.range_m).max() < 0.05


def test_the_triangulated_points_are_where_the_pose_puts_the_markers(result):
    record = result.result.records[0]
    points = {r["spot"]: r for r in rows_of(result.out / "points.csv") if r["frame"] == "0"}
    model = result.result.run.target.model
    both = (record.tracked.index >= 0).all(axis=0)
    assert both.sum() > 3
    assert list(points) == [name for name, seen in zip(model.names, both, strict=True) if seen]
    for name, x in zip(model.names, record.tracked.pose.apply(model.positions), strict=True):
        if name in points:
            at, sigma = (np.array([float(points[name][f"{p}{a}_m"]) for a in "xyz"]) for p in ("", "sigma_"))
            assert np.all(np.abs(at - x) < 5 * sigma + 0.01)


def test_the_summary_has_fingerprints_versions_and_the_verdict_of_the_exit_status(result):
    summary = json.loads((result.out / "summary.json").read_text(encoding="utf-8"))
    assert summary["verdict"]["exit_status"] == result.exit_status == 0
    assert summary["verdict"]["status"] == "pass"
    assert {e["level"] for e in summary["verdict"]["evidence"]} == {"pass"}
    # What no recording shows is on the line, also of a PASS.
    shown = f"both focal lengths below {result.result.calibration.hidden_focal_percent:.2g} % would not show"
    assert result.said.startswith("PASS")
    assert shown in result.said
    assert {"run.yaml", "pair.yaml", "detections.csv"} <= {i["path"].rsplit("/", 1)[-1] for i in summary["inputs"]}
    assert "numpy" in summary["versions"]
    report = (result.out / "report.html").read_text(encoding="utf-8")
    assert "Content-Security-Policy" in report
    assert "http" not in report.replace("http-equiv", "").replace("http://www.w3.org", "")


def test_pictures_are_segmented_and_hidden_markers_do_not_disturb(tmp_path):
    assert typed("simulate", "stereo-drogue", "--seed", 4, "--frames", 3, "--out", tmp_path / "run").exit_code == 0
    done = typed("stereo", tmp_path / "run", "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    errors = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))["errors"]
    assert errors["frames"] == 3
    assert errors["position_rms_m"] < 0.015
    assert errors["nees_mean"] < 15
    assert "data:image/jpeg" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    again = typed("stereo", tmp_path / "run", "--out", tmp_path / "out")  # earlier results are replaced
    assert again.exit_code == 0


def test_unsynchronised_pictures_fail_the_run_and_say_by_how_much(tmp_path):
    run = write_stereo_recording(tmp_path / "run", seed=5, frames=25, points=True, noise_px=0.03, right_delay_s=0.0015)
    outcome = process_stereo_run(run, tmp_path / "out")
    assert outcome.exit_status == 4
    clock = outcome.result.clock
    assert clock.offset_s == pytest.approx(0.0015, abs=5 * clock.sigma_s)
    assert any(f.code == "BP-W05" for f in outcome.findings)


@pytest.mark.parametrize(
    ("frames", "shift", "words"),
    further_slow([(7, 200, "right: 200 to 206"), (4, 2, "0 of 2 frames with markers in both pictures")]),
)
def test_frame_numbers_of_one_camera_that_are_shifted_fail_the_run(drogue, tmp_path, frames, shift, words):
    """Frames that only one camera has are measured by it alone: without the others they would seem right."""
    run = changed(drogue, tmp_path / "run")
    shutil.rmtree(run / "truth")
    first_frames(run, frames, shift)
    outcome = process_stereo_run(run, tmp_path / "out")
    assert outcome.exit_status == 4
    assert any(f.code == "BP-W09" and words in f.what for f in outcome.findings)


@pytest.mark.parametrize(("frames", "untested"), [(2, 2), (6, 1), (12, 0)])
def test_a_recording_too_short_to_test_the_pair_does_not_pass(drogue, tmp_path, frames, untested):
    run = changed(drogue, tmp_path / "run")
    first_frames(run, frames)
    outcome = process_stereo_run(run, tmp_path / "out")
    assert outcome.exit_status == 0
    assert sum(f.code == "BP-W11" for f in outcome.findings) == untested
    assert (outcome.verdict.status == "pass") == (untested == 0)


def test_markers_that_are_not_where_run_yaml_says_are_reported(drogue, tmp_path):
    target = yaml.safe_load((drogue / "run.yaml").read_text(encoding="utf-8"))["target"]
    target["markers"]["3"]["position_m"][0] += 0.02
    outcome = process_stereo_run(changed(drogue, tmp_path / "run", target=target), tmp_path / "out")
    assert [r for r in outcome.result.records if r.measured and (r.tracked.index[:, 2] >= 0).all()] == []
    stated = {**target, "sigma_m": 0.02}
    outcome = process_stereo_run(changed(drogue, tmp_path / "known", target=stated), tmp_path / "again")
    assert len(outcome.result.measured) == FRAMES
    assert outcome.result.errors.nees.mean() < 15  # the survey's error is part of the covariance


def test_two_cameras_exchanged_give_no_confident_pose(tmp_path):
    drogue = write_stereo_recording(tmp_path / "drogue", seed=6, frames=2, points=True)
    pair = yaml.safe_load((drogue / "pair.yaml").read_text(encoding="utf-8"))
    left, right = pair["cameras"]["left"], pair["cameras"]["right"]
    pair["cameras"] = {"left": right, "right": left}
    run = changed(drogue, tmp_path / "run")
    (run / "pair.yaml").write_text(yaml.safe_dump(pair), encoding="utf-8")
    outcome = process_stereo_run(run, tmp_path / "out")
    assert outcome.exit_status == 4
    assert outcome.result.measured == []


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"cameras": {"left": {"detections": "detections.csv"}}}, "expected two cameras, got the single camera left"),
        ({"cameras": {"left": {"detections": "detections.csv"}, "rihgt": {"detections": "detections.csv"}}}, "right"),
        ({"cameras": {"left": {"device": 0}, "right": {"detections": "detections.csv"}}}, "got a live camera"),
        ({"pair": "nothing.yaml"}, "beampose calibrate pair"),
        ({"target": None}, "target: expected a value"),
        ({"target": {"colours": {"red": {"hue_deg": [0, 500]}}, "markers": {}}}, "hue_deg: expected 0 to 360"),
        ({"target": "markers.yaml"}, "found nothing"),
        ({"match": {"gate_sigma": 3}}, "gate_sigma"),
        ({"segmentation": {"median_px": 4}}, "odd"),
        ({"schema": "beampose/run/1"}, "beampose run"),
    ],
)
def test_a_mistake_in_run_yaml_is_one_plain_line(drogue, tmp_path, fields, message):
    run = changed(drogue, tmp_path / "run", **fields)
    done = typed("stereo", run, "--out", tmp_path / "out")
    assert done.exit_code == 2
    assert message in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "out").exists()


def test_a_pair_without_poses_names_the_command_that_makes_one(drogue, tmp_path):
    run = changed(drogue, tmp_path / "run")
    pair = yaml.safe_load((drogue / "pair.yaml").read_text(encoding="utf-8"))
    camera = {k: v for k, v in pair["cameras"]["left"].items() if k != "camera_from_world"}
    (run / "pair.yaml").write_text(yaml.safe_dump({"schema": "beampose/camera/1", "name": "left", **camera}))
    done = typed("stereo", run, "--out", tmp_path / "out")
    assert done.exit_code == 2
    assert "beampose calibrate pair" in done.stderr


def test_a_rig_and_a_foreign_file_with_poses_are_pairs_too(drogue, tmp_path):
    run = changed(drogue, tmp_path / "run")
    chain = {
        name: {
            "camera_model": "pinhole", "distortion_model": "radtan", "distortion_coeffs": c["distortion"],
            "intrinsics": [c["camera_matrix"][k] for k in ("fx", "fy", "cx", "cy")], "resolution": c["image_size_px"],
        }
        for name, c in zip(
            ("cam0", "cam1"),
            yaml.safe_load((drogue / "pair.yaml").read_text(encoding="utf-8"))["cameras"].values(),
            strict=True,
        )
    }  # fmt: skip
    from lab.files.rig.pair_file import load_pair_file

    T = np.eye(4)
    right = load_pair_file(drogue / "pair.yaml").cameras["right"].camera_from_world
    T[:3, :3], T[:3, 3] = right.rotation, right.translation
    chain["cam1"]["T_cn_cnm1"] = T.tolist()
    (run / "camchain.yaml").write_text(yaml.safe_dump(chain), encoding="utf-8")
    cameras = load_pair_file(run / "camchain.yaml").cameras
    np.testing.assert_allclose(cameras["cam1"].camera_from_world.minus(right), 0, atol=1e-9)


def test_a_symmetric_target_is_refused(drogue, tmp_path):
    angles = np.deg2rad(np.arange(7) * 360 / 7)
    markers = {
        str(i): {"position_m": [float(np.cos(a)), float(np.sin(a)), 0.0], "colour": "red"} for i, a in enumerate(angles)
    }
    target = {"colours": {"red": {"hue_deg": [340, 20]}, "blue": {"hue_deg": [200, 250]}}, "markers": markers}
    with pytest.raises(InputError, match="symmetric"):
        process_stereo_run(changed(drogue, tmp_path / "run", target=target), tmp_path / "out")


def test_empty_and_grey_and_missing_pictures_are_plain_errors(tmp_path):
    import cv2

    run = write_stereo_recording(tmp_path / "run", seed=4, frames=1, scale=0.3)
    for path in sorted((run / "frames" / "right").iterdir()):
        path.write_bytes(b"")
    with pytest.raises(InputError, match="camera right: expected pictures"):
        process_stereo_run(run, tmp_path / "out")
    for camera in ("left", "right"):
        for i in range(6):
            cv2.imwrite(str(run / "frames" / camera / f"{i:06d}.png"), np.full((216, 288), 90, np.uint8))
    with pytest.raises(InputError, match="expected colour pictures"):
        process_stereo_run(run, tmp_path / "out")
    shutil.rmtree(run / "frames" / "left")
    with pytest.raises(InputError, match="found nothing"):
        process_stereo_run(run, tmp_path / "out")


def test_colour_videos_give_the_markers_that_their_pictures_show(tmp_path):
    """Videos of cameras are YUV: their colour must be decoded, not only the brightness."""
    run = write_stereo_recording(tmp_path / "run", seed=5, frames=1, scale=0.75)
    content = yaml.safe_load((run / "run.yaml").read_text(encoding="utf-8"))
    for name, source in content["cameras"].items():
        files = sorted((run / source["frames"]).iterdir())
        pictures = [cv2.imread(str(f)) for f in files if f.suffix == ".png"]
        path = run / f"{name}.avi"
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, pictures[0].shape[1::-1])
        writer.set(cv2.VIDEOWRITER_PROP_QUALITY, 98)
        for picture in pictures:
            writer.write(picture)
        writer.release()
        content["cameras"][name] = {"frames": path.name}
    (run / "run.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    done = process_stereo_run(run, tmp_path / "out")
    assert len(rows_of(done.out / "detections.csv")) >= 10
    assert np.abs(done.result.errors.range_m).max() < 0.3


def test_a_long_recording_shows_an_error_of_both_focal_lengths_that_few_of_its_frames_do_not(tmp_path):
    """1 %, of which the depth within the target shows .35 % (1 sigma) in 24 frames."""
    rng, places = np.random.default_rng(3), approach(150, 20, 5, np.random.default_rng(4))
    eyes = stated_eyes("focal both", 0.01)
    write_recording(tmp_path / "run", places, eyes, rng, pictures=False, noise_px=0.04, sigmas=STATED)
    results, _ = processed(tmp_path / "run")
    assert Verdict(findings_of(results)).status != "pass"
    (suspect,) = results.calibration.suspects
    assert suspect.name == "focal length of both cameras"
    assert suspect.value == pytest.approx(-1, abs=3 * suspect.sigma)


@pytest.mark.parametrize(("sigma", "decimals"), [(230.0, 0), (23.0, 0), (2.3, 1), (0.23, 2), (0.00023, 5), (0.0, 6)])
def test_a_stated_sigma_has_two_digits(sigma, decimals):
    assert decimals_of(sigma) == decimals
