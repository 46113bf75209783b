"""OpenCV's FileStorage YAML with one camera, as its calibration samples write it.

Reads both headers, `%YAML:1.0` (OpenCV up to 4) and `%YAML 1.2` (5), and matrices as `opencv-matrix` or, as OpenCV 5
writes one-dimensional arrays, `opencv-nd-matrix`. Writes the old header, and the distortion as a 1 x N matrix, which
all releases read. Source: OpenCV, samples/cpp/tutorial_code/calib3d/camera_calibration (the keys), core/persistence
(the syntax).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from calibration.formats.model import (
    CameraModel,
    FormatError,
    Read,
    Written,
    exact,
    fitted,
    lost_poses,
    matrix,
    number,
    one_of,
    picture_size,
    pinhole_of,
    quoted,
)
from geometry.camera import FISHEYE, PERSPECTIVE

NAME = "opencv"
HOLDS_MANY = False
_MATRIX = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K")
_DISTORTION = ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "dist_coeffs", "D")
_WIDTH = ("image_width", "image_Width", "width")
_LENS_WORDS = {"plumb_bob": PERSPECTIVE, "rational_polynomial": PERSPECTIVE, "equidistant": FISHEYE}
_HEIGHT = ("image_height", "image_Height", "height")


def read(content: Mapping[str, Any], name: str) -> Read:
    """The camera of a parsed file; `name` is used if the file contains none.

    Raises FormatError: the file is not valid.
    """
    K = matrix(_first(content, _MATRIX), _MATRIX[0])
    distortion = tuple(matrix(_first(content, _DISTORTION), _DISTORTION[0]).ravel().tolist())
    size = picture_size(_first(content, _WIDTH), _first(content, _HEIGHT), "image_width, image_height")
    return Read(
        (
            CameraModel(
                name=str(content.get("camera_name", name)),
                image_size_px=size,
                pinhole=pinhole_of(K, _MATRIX[0]),
                distortion=distortion,
                lens=_lens(content),
            ),
        )
    )


def _lens(content: Mapping[str, Any]) -> str:
    """The lens model, from OpenCV's flag, or from ROS's key in a file that mixes both styles."""
    if number(content.get("fisheye_model", 0), "fisheye_model"):
        return FISHEYE
    return _LENS_WORDS[one_of(content.get("distortion_model", "plumb_bob"), _LENS_WORDS, "distortion_model")]


def _first(content: Mapping[str, Any], keys: Sequence[str]) -> Any:
    """The value of the first of several alternative keys that is present."""
    for key in keys:
        if key in content:
            return content[key]
    raise FormatError(f"{keys[0]}: expected a value, got nothing; add it")


def write(cameras: Sequence[CameraModel]) -> Written:
    """The file of one camera. Raises FormatError: the format cannot hold the lens."""
    (camera,) = cameras
    fx, fy, cx, cy = camera.pinhole
    distortion = fitted(camera, NAME)
    lines = [
        "%YAML:1.0",
        "---",
        f"camera_name: {quoted(camera.name)}",
        f"image_width: {camera.image_size_px[0]}",
        f"image_height: {camera.image_size_px[1]}",
        *_matrix("camera_matrix", 3, (fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0)),
        *_matrix("distortion_coefficients", 1, distortion),
    ]
    if camera.lens == FISHEYE:
        lines.append("fisheye_model: 1")
    return Written("\n".join(lines) + "\n", lost_poses(cameras, NAME))


def _matrix(key: str, rows: int, values: Sequence[float]) -> list[str]:
    columns = len(values) // rows
    # FileStorage reads lines of any length; short ones are easier to read.
    rows_of_text = [", ".join(exact(v) for v in values[i : i + 4]) for i in range(0, len(values), 4)]
    data = ",\n       ".join(rows_of_text)
    return [
        f"{key}: !!opencv-matrix",
        f"   rows: {rows}",
        f"   cols: {columns}",
        "   dt: d",
        f"   data: [ {data} ]",
    ]
