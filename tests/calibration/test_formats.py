"""Camera files of other programs: round trips, agreement with OpenCV, and errors.

The texts follow the layouts that each program's documentation shows; their numbers are ours.
"""

from __future__ import annotations

from functools import partial
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.formats import colmap, kalibr, model, mrcal, opencv_yaml, ros
from calibration.formats.model import ROOM, CameraModel, FormatError, Read, significant
from geometry.camera import FISHEYE, PERSPECTIVE
from geometry.pose import Pose
from geometry.rotations import exp
from lab.files.text.yaml_text import parse_mapping

MODULES = {m.NAME: m for m in (opencv_yaml, kalibr, ros, colmap, mrcal)}


def parsed(module: ModuleType, text: str, name: str = "left") -> Read:
    """The result of a format's reader."""
    is_text = module.NAME in ("colmap", "mrcal")
    return module.read(text if is_text else parse_mapping(text, "file", module.NAME == "opencv"), name)


def some_camera(rng: np.random.Generator, name: str, count: int, lens: str, placed: bool) -> CameraModel:
    fx, fy = rng.uniform(10, 9000, 2)
    cx, cy = rng.uniform(-100, 5000, 2)
    pose = Pose(exp(rng.normal(size=3)), rng.normal(size=3) * 10.0 ** rng.integers(-3, 3)) if placed else None
    distortion = tuple((rng.normal(size=count) * 10.0 ** rng.uniform(-12, 0, count)).tolist())
    return CameraModel(name, (int(rng.integers(1, 9000)), 480), (fx, fy, cx, cy), distortion, lens, pose)


def assert_same(a: CameraModel, b: CameraModel, with_pose: bool) -> None:
    """Equal to 1e-12, relative; entries of a rotation relative to 1."""
    assert (a.image_size_px, a.lens) == (b.image_size_px, b.lens)
    np.testing.assert_allclose(b.pinhole, a.pinhole, rtol=1e-12)
    np.testing.assert_allclose(significant(b.distortion), significant(a.distortion), rtol=1e-12)
    if with_pose and a.camera_from_reference is not None:
        p, q = a.camera_from_reference, b.camera_from_reference
        np.testing.assert_allclose(q.rotation, p.rotation, atol=1e-12)
        np.testing.assert_allclose(q.translation, p.translation, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("format_name", MODULES)
@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), data=st.data())
def test_a_camera_survives_a_round_trip(format_name, seed, data):
    lens = data.draw(st.sampled_from([k for k, v in ROOM[format_name].items() if v]))
    most = max(ROOM[format_name][lens])
    allowed = (0, 4) if lens == FISHEYE else tuple(n for n in (0, 4, 5, 8, 12, 14) if n <= most)
    camera = some_camera(np.random.default_rng(seed), "left", data.draw(st.sampled_from(allowed)), lens, True)
    (back,) = parsed(MODULES[format_name], MODULES[format_name].write([camera]).text).cameras
    assert_same(camera, back, with_pose=format_name in ("kalibr", "mrcal"))
    if format_name in ("opencv", "ros", "kalibr", "mrcal"):
        assert back.name == "left"


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(2, 5))
def test_the_poses_of_a_chain_survive_a_round_trip(seed, count):
    rng = np.random.default_rng(seed)
    cameras = [some_camera(rng, f"c{i}", 4, FISHEYE if i % 2 else PERSPECTIVE, True) for i in range(count)]
    back = parsed(kalibr, kalibr.write(cameras).text).cameras
    assert [c.name for c in back] == [c.name for c in cameras]
    for a, b in zip(cameras, back, strict=True):
        # Rounding errors of the largest translation accumulate along a chain.
        size = max(float(np.linalg.norm(c.camera_from_reference.translation)) for c in cameras)
        assert_same(a, b, with_pose=False)
        np.testing.assert_allclose(b.camera_from_reference.rotation, a.camera_from_reference.rotation, atol=1e-12)
        np.testing.assert_allclose(
            b.camera_from_reference.translation, a.camera_from_reference.translation, atol=1e-12 * max(size, 1)
        )


# Against OpenCV itself --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("old_head", [True, False])
@pytest.mark.parametrize("flat", [True, False])
@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
def test_files_of_opencv_are_read_exactly(old_head, flat, count):
    if old_head and not hasattr(cv2, "FILE_STORAGE_FORMAT_YAML_1_0"):
        pytest.skip("this OpenCV writes one head only")
    rng = np.random.default_rng(count)
    K = np.array([[rng.uniform(100, 900), 0, 1e-7], [0, rng.uniform(100, 900), 1 / 3], [0, 0, 1]])
    d = rng.normal(size=count) * 10.0 ** rng.uniform(-15, 2, count)
    flags = cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY
    flags |= cv2.FILE_STORAGE_FORMAT_YAML_1_0 if old_head else cv2.FILE_STORAGE_FORMAT_YAML
    storage = cv2.FileStorage("x.yml", flags)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", K)
    storage.write("distortion_coefficients", d if flat else d[:, None])
    (camera,) = parsed(opencv_yaml, storage.releaseAndGetString()).cameras
    assert camera.pinhole == (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    assert camera.distortion == tuple(d)
    assert camera.image_size_px == (640, 480)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.sampled_from([0, 4, 5, 8, 12, 14]))
def test_opencv_reads_our_files_exactly(seed, count):
    camera = some_camera(np.random.default_rng(seed), 'le"ft: 1', count, PERSPECTIVE, False)
    text = opencv_yaml.write([camera]).text
    storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    K, d = storage.getNode("camera_matrix").mat(), storage.getNode("distortion_coefficients").mat()
    fx, fy, cx, cy = camera.pinhole
    np.testing.assert_array_equal(K, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    assert d.shape[0] == 1
    np.testing.assert_array_equal(significant(d.ravel()), significant(camera.distortion))
    assert storage.getNode("image_width").real() == camera.image_size_px[0]
    assert storage.getNode("camera_name").string() == camera.name


@pytest.mark.parametrize("format_name", ["kalibr", "ros"])
def test_numbers_are_valid_in_yaml_1_1(format_name):
    """Kalibr and ROS read YAML 1.1, where 1e-05 is a string."""
    camera = CameraModel("left", (640, 480), (500.0, 1e22, 1e-05, 240.0), (1e-05, -3e-12, 1e-300, 0.0))
    content = yaml.safe_load(MODULES[format_name].write([camera]).text)
    values = content["cam0"] if format_name == "kalibr" else content["distortion_coefficients"]
    numbers = values["distortion_coeffs"] if format_name == "kalibr" else values["data"]
    assert numbers[:3] == [1e-05, -3e-12, 1e-300]


# Examples from the documentation of the programs ------------------------------------------------------------------

CAMCHAIN = """\
cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.27, 0.06, 0.0008, 0.0001]
  distortion_model: radtan
  intrinsics: [461.5, 460.25, 362.5, 246.0]
  T_cam_imu:
  - [0.0, 1.0, 0.0, 0.07]
  - [-1.0, 0.0, 0.0, -0.02]
  - [0.0, 0.0, 1.0, 0.004]
  - [0.0, 0.0, 0.0, 1.0]
  timeshift_cam_imu: -8.1e-05
  resolution: [752, 480]
  rostopic: /cam0/image_raw
cam1:
  camera_model: pinhole
  distortion_coeffs: [0.01, 0.02, -0.03, 0.004]
  distortion_model: equidistant
  intrinsics: [460.5, 459.25, 365.5, 248.0]
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.11]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.001]
  - [0.0, 0.0, 0.0, 1.0]
  resolution: [752, 480]
  rostopic: /cam1/image_raw
"""
CAMERA_INFO = """\
image_width: 640
image_height: 480
camera_name: wrist
camera_matrix:
  rows: 3
  cols: 3
  data: [ 580.5,    0.     ,  315.25,
            0.     ,  576.5,  247.5,
            0.     ,    0.     ,    1.     ]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.13, -0.31, 0.002, 0.003, 0.000000]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1., 0., 0., 0., 1., 0., 0., 0., 1.]
projection_matrix:
  rows: 3
  cols: 4
  data: [587.7, 0., 316.8, 0., 0., 585.7, 248.3, 0., 0., 0., 1., 0.]
"""
CAMERAS_TXT = """\
# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
# Number of cameras: 3
1 SIMPLE_PINHOLE 3072 2304 2559.5 1536 1152
2 PINHOLE 3072 2304 2560.5 2561.5 1536 1152
3 SIMPLE_RADIAL 3072 2304 2559.5 1536 1152 -0.02
"""
CAMERAMODEL = """\
# generated on 2026-02-03 with   mrcal-calibrate-cameras
{
    'lensmodel':  'LENSMODEL_OPENCV8',

    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....
    'intrinsics': [ 1761.5, 1761.25, 1965.75, 1087.5, -0.0125, 0.036, -0.00025, 0.0005, 0.02, 0.015, -0.056, 0.05,],

    # extrinsics are rt_fromref
    'extrinsics': [ 0, 0, 1.5707963267948966, 1., 2, -3., ],

    'valid_intrinsics_region': [ [ 0, 0 ], [ 10, 0 ], [ 0, 0 ], ],
    'imagersize': [ 4000, 2200,],
    'icam_intrinsics': 0,
    'optimization_inputs': b'AAAA',
}
"""


def test_a_camchain_as_kalibr_writes_it():
    found = parsed(kalibr, CAMCHAIN)
    left, right = found.cameras
    assert (left.name, left.pinhole, left.lens) == ("cam0", (461.5, 460.25, 362.5, 246.0), PERSPECTIVE)
    assert (right.lens, right.distortion) == (FISHEYE, (0.01, 0.02, -0.03, 0.004))
    # T_cn_cnm1 takes coordinates of cam0 to cam1: the origin of cam0 is 0.11 m to the left of cam1.
    np.testing.assert_array_equal(right.camera_from_reference.apply([0, 0, 0]), [-0.11, 0, 0.001])
    assert found.notes == ("not read: T_cam_imu, timeshift_cam_imu (beampose has no IMU)",)


def test_a_camera_info_as_ros_writes_it():
    (camera,) = parsed(ros, CAMERA_INFO).cameras
    assert camera == CameraModel("wrist", (640, 480), (580.5, 576.5, 315.25, 247.5), (0.13, -0.31, 0.002, 0.003, 0.0))


def test_a_printed_camera_info_message():
    message = (
        "header: {seq: 1}\nheight: 480\nwidth: 640\ndistortion_model: rational_polynomial\n"
        "D: [1., 2., 3., 4., 5., 6., 7., 8.]\nK: [500.0, 0.0, 320.0, 0.0, 501.0, 240.0, 0.0, 0.0, 1.0]\n"
    )
    (camera,) = parsed(ros, message).cameras
    assert camera.distortion == (1, 2, 3, 4, 5, 6, 7, 8)
    assert camera.pinhole == (500, 501, 320, 240)


def test_colmaps_principal_point_is_shifted_by_half_a_pixel():
    """A principal point in the middle of a 3072 x 2304 picture is (1536, 1152) for COLMAP, (1535.5, 1151.5) for us."""
    simple, _, radial = parsed(colmap, CAMERAS_TXT).cameras
    assert simple.pinhole == (2559.5, 2559.5, 1535.5, 1151.5)
    assert radial.distortion == (-0.02, 0, 0, 0)
    assert "1 PINHOLE 3072 2304 2559.5 2559.5 1536.0 1152.0" in colmap.write([simple]).text


def test_a_cameramodel_as_mrcal_writes_it():
    found = parsed(mrcal, CAMERAMODEL, "cam0")
    (camera,) = found.cameras
    assert camera.distortion == (-0.0125, 0.036, -0.00025, 0.0005, 0.02, 0.015, -0.056, 0.05)
    np.testing.assert_allclose(camera.camera_from_reference.apply([1, 0, 0]), [1, 3, -3], atol=1e-15)
    assert found.notes == ("not read: icam_intrinsics, optimization_inputs, valid_intrinsics_region",)
    older = CAMERAMODEL.replace("'lensmodel':  'LENSMODEL_", "'distortion_model': 'DISTORTION_")
    assert parsed(mrcal, older, "cam0").cameras[0].distortion == camera.distortion
    newer = CAMERAMODEL.replace("'extrinsics'", "'rt_cam_ref'")
    np.testing.assert_array_equal(
        parsed(mrcal, newer, "cam0").cameras[0].camera_from_reference.rotation, camera.camera_from_reference.rotation
    )


# Errors ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("format_name", "count", "lens", "others"),
    [
        ("kalibr", 5, PERSPECTIVE, "opencv, ros, colmap, mrcal or beampose can"),
        ("kalibr", 12, PERSPECTIVE, "opencv, mrcal or beampose can"),
        ("ros", 12, PERSPECTIVE, "opencv, mrcal or beampose can"),
        ("colmap", 14, PERSPECTIVE, "opencv or beampose can"),
        ("mrcal", 14, PERSPECTIVE, "opencv or beampose can"),
        ("mrcal", 4, FISHEYE, "opencv, kalibr, ros, colmap or beampose can"),
    ],
)
def test_an_unsupported_lens_raises_and_lists_the_formats_that_support_it(format_name, count, lens, others):
    camera = CameraModel("left", (640, 480), (500, 500, 320, 240), (0.1,) * count, lens)
    with pytest.raises(FormatError) as caught:
        MODULES[format_name].write([camera])
    assert f"{format_name} cannot hold this lens ({lens}, {count} coefficients)" in str(caught.value)
    assert others in str(caught.value)


def test_trailing_zeros_are_dropped_to_fit_a_format():
    camera = CameraModel("left", (640, 480), (500, 500, 320, 240), (0.1, 0.2, 0.3, 0.4, 0, 0, 0, 0))
    assert parsed(kalibr, kalibr.write([camera]).text).cameras[0].distortion == (0.1, 0.2, 0.3, 0.4)


WRONG = [
    (kalibr, CAMCHAIN, "camera_model: pinhole", "camera_model: omni", "cam0.camera_model: expected 'pinhole'"),
    (kalibr, CAMCHAIN, "camera_model: pinhole", "camera_model: ds", "cam0.camera_model: expected 'pinhole', got 'ds'"),
    (kalibr, CAMCHAIN, "radtan", "fov", "cam0.distortion_model: expected radtan, equidistant, none, got 'fov'"),
    (kalibr, CAMCHAIN, "T_cn_cnm1", "T_c1_c0", "cam1.T_cn_cnm1: expected the pose relative to cam0, got nothing"),
    (kalibr, CAMCHAIN, "[1.0, 0.0, 0.0, -0.11]", "[1.1, 0.0, 0.0, -0.11]", "cam1.T_cn_cnm1: expected a rotation"),
    (kalibr, CAMCHAIN, "[461.5, ", "[", "cam0.intrinsics: expected 4 numbers, got 3"),
    (kalibr, CAMCHAIN, "[752, 480]", "[752.5, 480]", "cam0.resolution: expected a width and a height in whole pixels"),
    (ros, CAMERA_INFO, "plumb_bob", "thin_prism", "distortion_model: expected plumb_bob, rational_polynomial"),
    (ros, CAMERA_INFO, "plumb_bob", "rational_polynomial", "expected 8 numbers for rational_polynomial, got 5"),
    (ros, CAMERA_INFO, "0.13,", ".nan,", "distortion_coefficients.data: expected a finite number, got nan"),
    (ros, CAMERA_INFO, "580.5,    0. ", "580.5,    0.1 ", "camera_matrix: expected [fx, 0, cx, 0, fy, cy, 0, 0, 1]"),
    (ros, CAMERA_INFO, "image_width: 640\n", "", "image_width: expected a value, got nothing; add it"),
    (colmap, CAMERAS_TXT, "SIMPLE_RADIAL", "FOV", "line 6: expected one of SIMPLE_PINHOLE"),
    (colmap, CAMERAS_TXT, "SIMPLE_RADIAL", "RADIAL", "line 6: expected 5 parameters for RADIAL, got 4"),
    (colmap, CAMERAS_TXT, "2559.5 1536 1152 -", "x 1536 1152 -", "line 6: expected numbers after SIMPLE_RADIAL"),
    (colmap, CAMERAS_TXT, "\n2 ", "\n1 ", "expected each camera once, got camera 1 2 times"),
    (mrcal, CAMERAMODEL, "OPENCV8", "SPLINED_STEREOGRAPHIC_order=3", "lensmodel: expected one of LENSMODEL_PINHOLE"),
    (mrcal, CAMERAMODEL, "OPENCV8", "CAHVOR", "got 'LENSMODEL_CAHVOR'; mrcal-convert-lensmodel"),
    (mrcal, CAMERAMODEL, "OPENCV8", "OPENCV4", "intrinsics of LENSMODEL_OPENCV4: expected 8 numbers, got 12"),
    (mrcal, CAMERAMODEL, "b'AAAA'", "open('x', 'w')", "expected a Python dictionary of numbers, texts and lists"),
    (mrcal, CAMERAMODEL, "1761.5", "-1761.5", "camera 'left': expected focal lengths above 0"),
    (mrcal, CAMERAMODEL, "}", "", "expected a Python dictionary of literals"),
]


@pytest.mark.parametrize(("module", "text", "old", "new", "words"), WRONG)
def test_an_invalid_file_raises_with_the_field(module, text, old, new, words):
    assert old in text
    with pytest.raises(FormatError) as caught:
        parsed(module, text.replace(old, new, 1))
    assert words in str(caught.value)


@pytest.mark.parametrize("value", ["[1, 2]", "{a: 1}", "3", "true", "[]"])
@pytest.mark.parametrize(("module", "text", "word"), [(kalibr, CAMCHAIN, "radtan"), (ros, CAMERA_INFO, "plumb_bob")])
def test_a_lens_model_that_is_no_word_raises_with_the_field(module, text, word, value):
    with pytest.raises(FormatError, match="distortion_model: expected"):
        parsed(module, text.replace(word, value, 1))


def test_a_chain_requires_poses():
    cameras = [CameraModel(n, (640, 480), (500, 500, 320, 240)) for n in ("left", "right")]
    with pytest.raises(FormatError, match="left, right has none: write each camera to a file of its own"):
        kalibr.write(cameras)


LENS: dict[str, Any] = {"name": "left", "image_size_px": (1, 1), "pinhole": (1e-9, 1e-9, -5.0, 0.0)}


@pytest.mark.parametrize("fields", [{}, *({"distortion": (0.1,) * n} for n in (0, 4, 5, 8, 12)), {"lens": FISHEYE}])
def test_a_lens_at_the_limits_of_its_fields_is_accepted(fields):
    assert CameraModel(**LENS | fields).name == "left"


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"image_size_px": (0, 1)}, "a picture of at least 1 pixel"),
        ({"image_size_px": (1, 0)}, "a picture of at least 1 pixel"),
        ({"pinhole": (1.0, 1.0, np.inf, 0.0)}, "finite numbers"),
        ({"distortion": (0.1, 0.0, np.nan, 0.0)}, "finite numbers"),
        ({"pinhole": (0.0, 1.0, 0.0, 0.0)}, "focal lengths above 0"),
        ({"pinhole": (1.0, -1.0, 0.0, 0.0)}, "focal lengths above 0"),
        ({"lens": "mirror"}, "a lens of perspective, fisheye, got 'mirror'"),
        ({"distortion": (0.1,) * 3}, "coefficients .perspective., got 3"),
        ({"distortion": (0.1,) * 5, "lens": FISHEYE}, "0 or 4 coefficients .fisheye., got 5"),
    ],
)
def test_a_lens_that_no_camera_has_is_refused_with_its_name(fields, words):
    with pytest.raises(FormatError, match=f"camera 'left': expected .*{words}"):
        CameraModel(**LENS | fields)


@pytest.mark.parametrize(
    ("read", "value", "words"),
    [
        (model.number, True, "a finite number, got True"),
        (model.number, np.inf, "a finite number, got inf"),
        (model.number, None, "a finite number, got nothing"),
        (model.numbers, "1, 2", "a list of numbers, got '1, 2'"),
        (partial(model.numbers, count=3), [1, 2], "3 numbers, got 2"),
        (partial(model.numbers, count=3), 7, "a list of 3 numbers, got 7"),
        (model.mapping, [1], "a mapping, got"),
        (model.matrix, {"rows": 2, "cols": 2, "data": [1, 2, 3]}, "2 x 2 numbers, got 3"),
        (model.matrix, {"sizes": [4], "data": [1, 2, 3]}, "1 x 4 numbers, got 3"),
        (lambda v, where: model.pinhole_of(np.ones(v), where), (2, 4), "a 3 x 3 matrix, got 2 x 4"),
        (lambda v, where: model.pinhole_of(np.ones(v), where), (3, 3), "skew is not supported"),
        (lambda v, where: model.picture_size(*v, where), (640, 480.5), "a width and a height in whole pixels"),
        (lambda v, where: model.picture_size(*v, where), (0, 480), "a width and a height in whole pixels"),
    ],
)
def test_a_value_of_another_form_is_refused_with_its_field(read, value, words):
    with pytest.raises(FormatError, match=f"K: expected .*{words}"):
        read(value, where="K")


@pytest.mark.parametrize(
    "content", ["['lensmodel', 'LENSMODEL_PINHOLE']", "{1: 2}", "{'lensmodel': 'x', (1,): 3}", "7"]
)
def test_a_cameramodel_that_is_no_dictionary_of_names_is_refused(content):
    with pytest.raises(FormatError, match="expected a Python dictionary, got"):
        parsed(mrcal, content)
