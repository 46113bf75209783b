"""`beampose check`: each problem is reported with a remedy, and a correct rig or run is reported as fine."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from geometry import rotations
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from geometry.pose_solver import visibility
from geometry.pose_solver.gauss_newton import SolveLimits
from lab.files.rig.rig_file import load_rig
from lab.files.text.error_text import FileError
from lab.runs.input_check import check
from tests.lab.files.test_truth import write_truth
from tests.lab.run_folders import edit, picture_of, write_run


@pytest.fixture
def folder(tmp_path) -> Path:
    return write_run(tmp_path / "a")


def checked(path: Path) -> tuple[str, int]:
    result = check(path)
    return "\n".join(result.lines), result.exit_status


def test_a_correct_run_is_fine_and_its_pictures_are_counted(folder):
    text, status = checked(folder)
    assert status == 0
    assert text.splitlines()[0] == f"{folder} (small): fine"
    assert "left         5  0 to 4        0           0           0  8-bit" in text
    assert "Pictures: frames 0 to 4, 5 in all, 0.050 s at 100 Hz" in text
    assert "within 0.3 m of (0, 0, 0), within 10 deg of yaw, pitch, roll (0, 0, 0)" in text


def test_a_correct_rig_is_fine_and_the_assumed_range_is_reported(folder):
    text, status = checked(folder / "rig.yaml")
    assert status == 0
    assert text.splitlines()[0] == f"{folder / 'rig.yaml'}: fine"
    assert "an assumed range, since there is no prior: within 0.5 m of (0, 0, 0), within 30 deg" in text


def test_all_errors_of_a_file_are_listed_at_once(folder):
    text = (folder / "rig.yaml").read_text().replace("fx: 40.0", "fx: -1").replace("size_m: [4.0", "size_m: [0")
    (folder / "rig.yaml").write_text(text)
    for path in (folder, folder / "rig.yaml"):
        text, status = checked(path)
        assert status == 2
        assert "4 problems" in text
        for field in ("screens.left.size_m", "screens.right.size_m", "left.camera_matrix.fx", "right.camera_matrix.fx"):
            assert field in text


@pytest.mark.parametrize("name", ["nothing", "run.yaml", "empty"])
def test_a_path_that_is_neither_a_rig_nor_a_run_is_a_problem(name, tmp_path):
    (tmp_path / "empty").mkdir()
    text, status = checked(tmp_path / name)
    assert status == 2
    assert "1 problem" in text


def test_missing_and_damaged_pictures_are_remarks(folder):
    left, right = folder / "frames/left", folder / "frames/right"
    (left / "000002.png").unlink()
    (right / "000003.png").write_bytes((right / "000003.png").read_bytes()[:50])
    cv2.imwrite(str(right / "000004.png"), np.zeros((4, 4), np.uint8))
    (left / "Thumbs.db").write_bytes(b"")
    cv2.imwrite(str(left / "000001.png"), picture_of(1, np.uint16))
    text, status = checked(folder)
    assert status == 0
    for words in (
        "left: 1 frame dropped (2)",
        "right: 1 frame unreadable: cut short (3)",
        "right: 1 frame wrong size 4x4, the rig says 64x48 (4)",
        "3 of 5 frames are missing in at least one camera",
        "1 files of 'left' are no frames: Thumbs.db",
        "pictures of different kinds: ",
        "left         4  0 to 4        1           0           0  16-bit, 8-bit",
        "right        3  0 to 2        0           1           1  8-bit",
    ):
        assert words in text, text


def test_a_camera_without_any_usable_picture_is_a_problem(folder):
    text = (folder / "rig.yaml").read_text().replace("image_size_px: [64, 48]", "image_size_px: [640, 480]", 1)
    (folder / "rig.yaml").write_text(text)
    text, status = checked(folder)
    assert status == 2
    assert "camera 'left' has no usable picture: all are of the wrong size" in text


def test_cameras_without_a_common_frame_are_a_problem(folder):
    for path in sorted((folder / "frames/left").iterdir()):
        path.rename(path.with_name(f"{int(path.stem) + 100:06d}.png"))
    text, status = checked(folder)
    assert status == 2
    assert "no frame number is common to all cameras; the same number must mean the same instant" in text


def test_black_pictures_are_remarks(folder):
    for path in (folder / "frames/left").iterdir():
        cv2.imwrite(str(path), np.zeros((48, 64), np.uint8))
    assert "left: all pictures are black; is the lens covered?" in checked(folder)[0]
    assert "right: all pictures are black" not in checked(folder)[0]


def test_overexposed_pictures_are_remarks(folder):
    for path in (folder / "frames/left").iterdir():
        cv2.imwrite(str(path), np.full((48, 64), 255, np.uint8))
    remark = "left: all pictures have the value 255 in every pixel; is the camera overexposed?"
    assert remark in checked(folder)[0]
    cv2.imwrite(str(folder / "frames/left/000000.png"), np.eye(48, 64, dtype=np.uint8))
    assert remark not in checked(folder)[0]


def test_the_consequences_of_a_missing_prior_or_camera_are_reported(folder):
    edit(folder / "run.yaml", "  right: {frames: frames/right}\n", "")
    (folder / "run.yaml").write_text((folder / "run.yaml").read_text().split("prior:")[0])
    text, status = checked(folder)
    assert status == 0
    assert "camera 'right' of the rig is left out" in text
    assert "Prior: none given; the first pose is searched for among all that show enough spots" in text


def test_uneven_timestamps_are_a_remark_and_missing_ones_a_problem(folder):
    edit(folder / "run.yaml", "name: small", "name: small\ntimestamps: times.csv")
    (folder / "times.csv").write_text("frame,t_s\n0,0\n1,0.01\n2,0.06\n3,0.07\n4,0.08\n")
    text, status = checked(folder)
    assert status == 0
    assert "after frame 1 the frame interval is 5 times the nominal one (frame_rate_hz: 100)" in text
    (folder / "times.csv").write_text("frame,t_s\n0,0\n1,0.01\n2,0.02\n3,0.03\n")
    text, status = checked(folder)
    assert status == 2
    assert "got none for 1 of them (the first is frame 4)" in text


def test_truth_is_compared_with_the_frames_the_times_and_the_rig(folder):
    write_truth(folder, load_rig(folder / "rig.yaml"))
    text, status = checked(folder)
    assert status == 0
    assert "remark" not in text
    assert "Truth: pose.csv frames 0 to 4; spots.csv frames 0 to 4; poses and spots agree through the rig to " in text

    pose = folder / "truth/pose.csv"
    pose.write_text("\n".join(pose.read_text().splitlines()[:-1]) + "\n")
    edit(folder / "rig.yaml", "translation_m: [-2.5, 0, 0]", "translation_m: [-2.4, 0, 0]")
    edit(folder / "run.yaml", "frame_rate_hz: 100.0", "frame_rate_hz: 50")
    text, status = checked(folder)
    assert status == 0
    assert "pose.csv: has no rows for 1 of 5 frames (the first is 4)" in text
    assert "does the truth belong to another rig?" in text
    assert "pose.csv: t_s: differs by up to 0.03 s from the run's own times" in text

    pose.write_text("frame,t_s\n")
    assert checked(folder)[1] == 2


# What the rig can see -------------------------------------------------------------------------------------------


def test_an_inverted_camera_pose_is_recognised(folder):
    pose = load_rig(folder / "rig.yaml").cameras["left"].camera_from_world.inverse()
    q, t = pose.quaternion_wxyz.tolist(), pose.translation.tolist()
    edit(
        folder / "rig.yaml",
        "{quaternion_wxyz: [0.5, -0.5, 0.5, 0.5], translation_m: [0, 0.4, 0]}",
        f"{{quaternion_wxyz: {q}, translation_m: {t}}}",
    )
    text, status = checked(folder)
    assert status == 2
    assert "cameras.left: never sees a spot" in text
    assert "it would be otherwise if camera_from_world of camera `left` is world_from_camera: the inverse" in text
    assert "cameras.right: never" not in text


def test_a_wrong_end_of_a_beam_is_recognised(folder):
    edit(folder / "rig.yaml", '"1": {beam: A, end: "-", screen: left}', '"1": {beam: A, end: "+", screen: left}')
    edit(folder / "rig.yaml", '"4": {beam: A, end: "+", screen: right}', '"4": {beam: A, end: "-", screen: right}')
    text, status = checked(folder)
    assert status == 2
    assert "target.spots.1: never hits its screen 'left'" in text
    assert "the ends of beam `A` are exchanged" in text
    assert "target.spots.4: never hits its screen 'right'" in text


def test_with_an_assumed_range_the_same_is_a_remark(folder):
    edit(folder / "rig.yaml", '"1": {beam: A, end: "-", screen: left}', '"1": {beam: A, end: "+", screen: left}')
    edit(folder / "rig.yaml", '"4": {beam: A, end: "+", screen: right}', '"4": {beam: A, end: "-", screen: right}')
    text, status = checked(folder / "rig.yaml")
    assert status == 0
    assert "target.spots.1: never hits its screen" in text


def test_one_screen_alone_never_determines_a_pose(folder):
    """Three spots of one screen on coplanar beams are collinear: whatever the pose, it is not observable."""
    edit(folder / "run.yaml", "  right: {frames: frames/right}\n", "")
    text, status = checked(folder)
    assert status == 2
    assert "the pose is observable in none of 2000 poses of the range" in text
    assert "pose observable from one frame: 0 % of the poses" in text


def test_shares_equal_a_direct_count_over_the_same_poses(folder):
    rig = load_rig(folder / "rig.yaml")
    prior = PosePrior(Pose.from_ypr(np.array([0.1, 0, 0]), np.array([0.1, 0.2, 0])), 0.8, np.deg2rad(40))
    seen = visibility.visibility_of(rig, prior, SolveLimits(), count=300)
    poses = visibility.poses_within(prior, 300)
    model = SpotModel.of(rig)
    for i, (camera, spot) in enumerate(seen.views):
        counts = {"in": 0, "outside": 0, "off": 0}
        for k in range(300):
            u, v = model.project(poses[k])[0][i]
            if not np.isfinite(u):
                counts["off"] += 1
            elif -0.5 <= u < 63.5 and -0.5 <= v < 47.5:
                counts["in"] += 1
            else:
                counts["outside"] += 1
        got = (seen.in_picture[i], seen.outside[i], seen.off_screen[i])
        np.testing.assert_allclose(got, [counts[k] / 300 for k in ("in", "outside", "off")], err_msg=f"{camera} {spot}")
    assert 0 < seen.observable < 1
    assert min(seen.in_picture) < 0.99


@pytest.mark.parametrize("within_deg", [5.0, 60.0, 180.0])
def test_poses_fill_the_prior_uniformly_and_never_leave_it(within_deg):
    prior = PosePrior(Pose.from_ypr(np.array([1.0, 0.5, -0.2]), np.array([1.0, 2, 3])), 0.4, np.deg2rad(within_deg))
    poses = visibility.poses_within(prior, 20_000)
    shift = poses.translation - prior.centre.translation
    assert np.abs(shift).max() <= 0.4
    # A uniform coordinate has the variance w^2 / 3; its estimate from 20,000 samples has a scatter of 0.6 %.
    np.testing.assert_allclose(shift.var(axis=0), 0.4**2 / 3, rtol=0.03)
    angle = rotations.angle(prior.centre.rotation.T @ poses.rotation)
    assert angle.max() <= prior.within_rad + 1e-9
    # Uniform over the rotation group: the share of rotations below half the angle is the ratio of (a - sin a).
    half = prior.within_rad / 2
    expected = (half - np.sin(half)) / (prior.within_rad - np.sin(prior.within_rad))
    assert abs((angle < half).mean() - expected) < 5 * np.sqrt(expected / 20_000)


def test_the_message_of_many_errors_shows_the_first_and_counts_the_rest():
    error = FileError(["a: one", "a: two", "a: three"])
    assert str(error) == "a: one\n(and 2 more in this file: `beampose check` lists them)"
    assert str(FileError(["a: one"])) == "a: one"


def test_an_expired_calibration_is_exit_status_3_and_its_age_and_covariance_are_reported(folder):
    text, status = checked(folder)
    assert status == 0
    assert "does not state when it was calibrated" in text
    assert "no covariance: sigmas will include the noise only" in text
    block = "    covariance: {parameters: [fx, fy], matrix: [[1.0, 0.1], [0.1, 2.0]]}\n"
    rig = (folder / "rig.yaml").read_text()
    first = rig.index("camera_from_world")
    rig = rig[:first].rstrip(" ") + block + rig[rig.rindex("\n", 0, first) + 1 :]
    dated = rig + "calibration: {date: 2025-01-02, verdict: PASS, valid_until: 2025-07-02}\n"
    (folder / "rig.yaml").write_text(dated)
    for path in (folder, folder / "rig.yaml"):
        text, status = checked(path)
        assert status == 3
        assert "calibrated 2025-01-02: PASS, valid until 2025-07-02" in text
        assert "the calibration is out of date" in text
        assert "covariance of 2 numbers" in text
    with (folder / "run.yaml").open("a") as file:
        file.write("recorded: 2025-07-02\n")
    assert checked(folder)[1] == 0
    assert "(today)" not in checked(folder)[0]


def test_a_calibration_of_a_day_to_come_is_a_remark(folder):
    with (folder / "rig.yaml").open("a") as file:
        file.write("calibration: {date: 2999-01-02, verdict: PASS}\n")
    for path in (folder, folder / "rig.yaml"):
        assert "rig.yaml: calibration.date: 2999-01-02 is after" in checked(path)[0]
