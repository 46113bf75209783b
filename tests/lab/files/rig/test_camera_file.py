"""camera.yaml: saving and loading is exact, and each mistake has its own line."""

from __future__ import annotations

import datetime

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geometry.uncertainty.rig_uncertainty import RigCovariance
from lab.errors import InputError
from lab.files.rig.camera_file import CameraCalibration, CameraFile, load_camera, save_camera
from lab.files.rig.rig_file import load_rig, save_rig
from tests.lab.run_folders import RIG

TEXT = """\
schema: beampose/camera/1
name: left
image_size_px: [1280, 1024]
camera_matrix: {fx: 1180.0, fy: 1181.0, cx: 639.5, cy: 511.5}
distortion: [-0.1, 0.02, 0.001, -0.0005, 0.0]
covariance: {parameters: [fx, fy, k1], matrix: [[4.0, 1.0, 0.0], [1.0, 4.0, 0.0], [0.0, 0.0, 1e-8]]}
calibration: {date: 2026-03-14, verdict: PASS, rms_px: 0.15, views: 24, corners: 1800, board: chessboard 9x6}
"""


def written(folder, text):
    path = folder / "camera.yaml"
    path.write_text(text)
    return path


def test_a_camera_has_the_values_of_its_file(tmp_path):
    camera = load_camera(written(tmp_path, TEXT))
    assert (camera.name, camera.image_size_px, camera.lens) == ("left", (1280, 1024), "perspective")
    np.testing.assert_array_equal(camera.camera_matrix, [[1180, 0, 639.5], [0, 1181, 511.5], [0, 0, 1]])
    assert camera.distortion == (-0.1, 0.02, 0.001, -0.0005, 0.0)
    assert camera.parameter_names == ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    assert camera.covariance is not None
    assert camera.covariance.names == ("fx", "fy", "k1")
    assert camera.covariance.matrix[2, 2] == 1e-8
    assert camera.calibration == CameraCalibration(
        date=datetime.date(2026, 3, 14), verdict="PASS", rms_px=0.15, views=24, corners=1800, board="chessboard 9x6"
    )


def same(a: CameraFile, b: CameraFile) -> None:
    """Fails unless two cameras are equal to the last bit."""
    for name in ("name", "image_size_px", "distortion", "lens", "calibration"):
        assert getattr(a, name) == getattr(b, name)
    np.testing.assert_array_equal(a.camera_matrix, b.camera_matrix)
    assert (a.covariance is None) == (b.covariance is None)
    if a.covariance is not None and b.covariance is not None:
        assert a.covariance.names == b.covariance.names
        np.testing.assert_array_equal(a.covariance.matrix, b.covariance.matrix)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.sampled_from([0, 4, 5, 8, 12, 14]), judged=st.booleans())
def test_saving_and_loading_changes_no_bit(seed, count, judged, tmp_path_factory):
    rng = np.random.default_rng(seed)
    fx, fy, cx, cy = rng.uniform(1, 5e3, 4)
    A = rng.normal(size=(4 + count, 30)) * 10.0 ** rng.uniform(-6, 2, (4 + count, 1))
    camera = CameraFile(
        "1e-3",
        (640, 480),
        np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
        tuple((rng.normal(size=count) * 10.0 ** rng.uniform(-9, 0, count)).tolist()),
        "fisheye" if count == 4 and judged else "perspective",
    )
    names = camera.parameter_names
    covariance = np.cov(A)
    camera = CameraFile(
        camera.name, camera.image_size_px, camera.camera_matrix, camera.distortion, camera.lens,
        RigCovariance(names, (covariance + covariance.T) / 2),
        CameraCalibration(
            date=datetime.date(2026, 1, 2), verdict="WARN", rms_px=rng.uniform(), sigma_px=rng.uniform(), views=7,
            corners=99, board="on: 1e3", distance_m=2.5, reasons=("too few: 3", "- tilt"),
            figures={"focal_sigma_px": rng.uniform()}, notes="#1",
        ) if judged else None,
    )  # fmt: skip
    path = tmp_path_factory.mktemp("cameras") / "camera.yaml"
    save_camera(camera, path)
    same(camera, load_camera(path))


BROKEN = [
    ("beampose/camera/1", "beampose/rig/1", "schema: expected 'beampose/camera/1', got 'beampose/rig/1'"),
    ("name: left\n", "", "name: expected a value, got nothing; add it"),
    ("distortion:", "distorsion:", "unknown key 'distorsion'; did you mean 'distortion'?"),
    ("-0.0005, 0.0]", "-0.0005, 0.0, 1]", "distortion: expected 0, 4, 5, 8, 12 or 14 numbers, got 6"),
    ("name: left", "name: left\nlens: fish", "lens: expected 'perspective' or 'fisheye', got 'fish'"),
    (
        "name: left",
        "name: left\nlens: fisheye",
        "expected 4 distortion numbers (or none) for lens 'fisheye', got 5",
    ),
    ("[fx, fy, k1]", "[fx, fy, k4]", "covariance.parameters: unknown parameter 'k4'; known: fx, fy, cx, cy, k1"),
    ("[fx, fy, k1]", "[fx, fy, fy]", "covariance.parameters: expected each name once, got 'fy' a second time"),
    (
        "[1.0, 4.0, 0.0]",
        "[2.0, 4.0, 0.0]",
        "covariance.matrix: expected a symmetric matrix, got 1 for fx, fy and 2 for fy, fx",
    ),
    (
        "0.0, 1e-8]",
        "0.0, -1e-8]",
        "covariance.matrix: expected variances of 0 or more on the diagonal, got -1e-08 for k1",
    ),
    ("[[4.0, 1.0", "[[0.1, 1.0", "covariance.matrix: expected a covariance, got a matrix with a negative eigenvalue"),
    ("verdict: PASS", "verdict: GOOD", "calibration.verdict: expected 'PASS', 'WARN', 'FAIL' or '', got 'GOOD'"),
    ("views: 24", "view: 24", "calibration: unknown key 'view'; did you mean 'views'?"),
    ("rms_px: 0.15", "rms_px: -1", "calibration.rms_px: expected a number of 0 or more, got -1"),
]


@pytest.mark.parametrize(("old", "new", "words"), BROKEN)
def test_a_mistake_is_one_line_with_field_expected_and_found(old, new, words, tmp_path):
    assert old in TEXT
    path = written(tmp_path, TEXT.replace(old, new, 1))
    with pytest.raises(InputError) as caught:
        load_camera(path)
    message = str(caught.value).replace(f"{tmp_path}/", "")
    assert message.startswith("camera.yaml: ")
    assert words in message


def test_a_camera_that_could_not_be_loaded_is_not_saved(tmp_path):
    path = written(tmp_path, TEXT)
    camera = load_camera(path)
    broken = CameraFile("left", (0, 5), camera.camera_matrix, camera.distortion)
    with pytest.raises(InputError, match="a width and a height of at least 1 pixel"):
        save_camera(broken, path)
    assert path.read_text() == TEXT


def test_the_lens_of_a_camera_of_a_rig_is_saved_and_loaded(tmp_path):
    (tmp_path / "rig.yaml").write_text(RIG.replace("distortion: []", "distortion: [0.1, 0, 0, 0]\n    lens: fisheye"))
    rig = load_rig(tmp_path / "rig.yaml")
    assert (rig.cameras["left"].lens, rig.cameras["right"].lens) == ("fisheye", "perspective")
    save_rig(rig, tmp_path / "again.yaml")
    assert load_rig(tmp_path / "again.yaml").cameras["left"].lens == "fisheye"
    (tmp_path / "rig.yaml").write_text(RIG.replace("distortion: []", "distortion: [1, 2, 3, 4, 5]\n    lens: fisheye"))
    with pytest.raises(
        InputError, match=r"cameras\.left: expected 4 distortion numbers \(or none\) for lens 'fisheye'"
    ):
        load_rig(tmp_path / "rig.yaml")
