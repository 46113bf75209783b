"""`beampose track lamps`, as typed: right poses of a renderer that shares no code with it, an honest no, bad input."""

import json
import re

import cv2
import numpy as np
import pytest
import yaml

from bench.related_measurements.lamps import judged, write_recording
from bench.related_measurements.renderers.second_renderer import background
from geometry.pose import Pose
from lab.report.page import PageDrawing
from lab.report.plot.series import Band
from lab.targets.stereo.page import pose_section
from tests.lab.command import typed
from tests.lab.tables import rows_of
from tests.marks import further_slow
from tracking.binocular.pose_tracker import BinocularFrame
from tracking.statuses import PoseStatus


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lamps") / "approach"
    position, attitude = write_recording(folder, 102, 24)
    statuses, errors = judged(folder, position, attitude, "spots")
    return folder, statuses, errors


def tracked(folder, *options, pictures="frames", target="lamps.yaml", camera="camera.yaml"):
    given = [folder / pictures, "--target", folder / target, "--camera", folder / camera, "--out", folder / "other"]
    return typed("track", "lamps", *given, *options)


def test_the_poses_are_within_the_papers_ten_centimetres_and_one_degree(recording):
    _, statuses, errors = recording
    assert statuses.count("measured") >= 22
    assert np.nanmax(errors[:, 0]) < 0.1
    assert np.nanmax(errors[:, 1]) < 1.0
    assert 0.3 < np.nanmean(errors[:, 2]) < 2


def test_the_summary_and_the_page_state_pose_and_verdict(recording):
    folder, _, _ = recording
    summary = json.loads((folder / "out" / "summary.json").read_text("utf-8"))
    assert summary["verdict"]["status"] == "pass"
    assert summary["target"]["lamps"] == ["L1", "L2", "L3", "L4", "L5"]
    assert "Yaw, pitch and roll" in (folder / "out" / "report.html").read_text("utf-8")


def test_harris_corners_give_the_same_motion(recording):
    folder, _, _ = recording
    assert tracked(folder, "--detector", "harris", "--limit", "6").exit_code == 0
    rows = [rows_of(folder / out / "attitude.csv") for out in ("out", "other")]
    for one, other in zip(*rows, strict=False):
        assert abs(float(one["z_m"]) - float(other["z_m"])) < 0.05


@pytest.mark.parametrize("count", further_slow([1, 6]))
@pytest.mark.parametrize("kind", further_slow(["cloud", "water", "ground"], fast=2))
def test_pictures_without_the_target_have_no_pose(recording, kind, count):
    folder, _, _ = recording
    (folder / kind).mkdir(exist_ok=True)
    rng = np.random.default_rng(3)
    for k in range(count):
        scene = background(kind, rng, (640, 480)) + 2 * rng.normal(size=(480, 640))
        cv2.imwrite(str(folder / kind / f"{k}.png"), np.clip(scene, 0, 255).astype(np.uint8))
    done = tracked(folder, pictures=kind)
    assert done.exit_code == 4
    assert f"no target was found in {count} frame" in done.output


def test_a_lens_without_covariance_is_at_best_a_check(recording):
    folder, _, _ = recording
    content = yaml.safe_load((folder / "camera.yaml").read_text())
    (folder / "bare.yaml").write_text(yaml.safe_dump({k: v for k, v in content.items() if k != "covariance"}))
    done = tracked(folder, "--limit", "4", camera="bare.yaml")
    assert done.exit_code == 0
    assert "CHECK" in done.output
    assert "BP-J06" in (folder / "other" / "report.html").read_text("utf-8")


@pytest.mark.parametrize("error", further_slow([-0.03, 0.02]))
def test_a_wrong_focal_length_is_named_with_its_correction(recording, error):
    folder, _, _ = recording
    content = yaml.safe_load((folder / "camera.yaml").read_text())
    for name in ("fx", "fy"):
        content["camera_matrix"][name] *= 1 + error
    (folder / "zoomed.yaml").write_text(yaml.safe_dump(content))
    done = tracked(folder, camera="zoomed.yaml")
    assert done.exit_code == 4
    found = re.search(r"focal length of nose by ([-+.\d]+) ± ([.\d]+) %", done.output)
    correction, sigma = map(float, found.groups())
    assert abs(correction - 100 * (1 / (1 + error) - 1)) < 4 * sigma
    assert sigma < 0.6  # %: errors of 3 % and more are then certain (4.5 sigma)


def test_a_pass_states_the_error_of_the_focal_length_that_would_not_show(recording):
    folder, _, _ = recording
    page = (folder / "out" / "report.html").read_text("utf-8")
    assert re.search(r"an error of the focal length below [.\d]+ % would not show", page)
    assert "BP-J07" not in page


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"markers": {n: {"position_m": [0, 0, 1]} for n in "ab"}}, "markers: expected four or more, got 2"),
        (
            {"markers": {str(k): {"position_m": [k, 0, 0]} for k in range(5)}},
            "expected markers that are not on one line",
        ),
        ({"markers": {str(k): {"place": [k, 0, 0]} for k in range(5)}}, "position_m"),
    ],
)
def test_a_wrong_target_is_one_plain_line(recording, change, words):
    folder, _, _ = recording
    (folder / "wrong.yaml").write_text(yaml.safe_dump(change))
    done = tracked(folder, target="wrong.yaml")
    assert done.exit_code == 2
    assert words in done.output
    assert "Traceback" not in done.output


def test_pictures_of_another_size_than_the_cameras_are_refused(recording):
    folder, _, _ = recording
    (folder / "small").mkdir()
    cv2.imwrite(str(folder / "small" / "0.png"), np.zeros((240, 320), np.uint8))
    done = tracked(folder, pictures="small")
    assert done.exit_code == 2
    assert "expected pictures of 640 x 480 px, as of camera.yaml, got 320 x 240 px" in done.output


def test_a_failed_calibration_is_not_used(recording):
    folder, _, _ = recording
    content = yaml.safe_load((folder / "camera.yaml").read_text())
    (folder / "failed.yaml").write_text(yaml.safe_dump({**content, "calibration": {"verdict": "FAIL"}}))
    assert tracked(folder, camera="failed.yaml").exit_code == 3


class Panels:
    """A time axis that keeps what is drawn."""

    def __init__(self) -> None:
        self.drawn: dict[str, tuple[np.ndarray, Band]] = {}

    def panel(self, name, unit, line, *, bands, **_):
        self.drawn[name] = line.y, bands[0]
        return PageDrawing("")


def test_a_target_that_turns_beyond_180_deg_is_drawn_without_a_jump():
    yaw = np.array([170.0, 175.0, 180.0, 185.0, 190.0])
    poses = [Pose.from_ypr(np.deg2rad([angle, 0.0, 0.0]), np.array([0.0, 0.0, 20.0])) for angle in yaw]
    statuses = [PoseStatus.MEASURED] * 3 + [PoseStatus.PREDICTED, PoseStatus.MEASURED]
    none = np.full((2, 1), -1)
    frames = [
        BinocularFrame(status, "", pose, 1e-6 * np.eye(6), None, None, none, np.full((2, 1, 2), np.nan))
        for status, pose in zip(statuses, poses, strict=True)
    ]
    axis = Panels()
    pose_section(axis, frames, "Pose")
    shown, band = axis.drawn["yaw"]
    np.testing.assert_allclose(np.diff(shown), 5.0, atol=1e-9)
    np.testing.assert_array_equal(np.isfinite(band.high), [True, True, True, False, True])
    assert list(axis.drawn) == ["x", "yaw", "y", "pitch", "z", "roll"]
