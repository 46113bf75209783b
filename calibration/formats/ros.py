"""ROS's camera_info: the YAML file of camera_calibration_parsers, or a printed CameraInfo message.

Source: ROS, sensor_msgs/CameraInfo (plumb_bob: k1, k2, p1, p2, k3; rational_polynomial: eight numbers) and
image_geometry (equidistant: OpenCV's fisheye). Rectification and projection matrices describe a rectified
picture, not the camera; they are not read, and written as those of a single camera.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from calibration.formats.model import (
    CameraModel,
    FormatError,
    Read,
    Written,
    exact_list,
    fitted,
    lost_poses,
    matrix,
    one_of,
    picture_size,
    pinhole_of,
    quoted,
)
from geometry.camera import FISHEYE, PERSPECTIVE

NAME = "ros"
HOLDS_MANY = False
_LENGTHS = {"plumb_bob": (0, 4, 5), "rational_polynomial": (8,), "equidistant": (4,)}
# Key in the file, and in the message of ROS 1 and 2.
_KEYS = {
    "image_width": ("image_width", "width"),
    "image_height": ("image_height", "height"),
    "camera_matrix": ("camera_matrix", "K", "k"),
    "distortion_coefficients": ("distortion_coefficients", "D", "d"),
    "rectification_matrix": ("rectification_matrix", "R", "r"),
}


def read(content: Mapping[str, Any], name: str) -> Read:
    """The camera of a parsed file; `name` is used if the file contains none.

    Raises FormatError: the file is not valid.
    """
    found = {ours: next((content[k] for k in keys if k in content), None) for ours, keys in _KEYS.items()}
    for key in ("image_width", "image_height", "camera_matrix", "distortion_coefficients"):
        if found[key] is None:
            raise FormatError(f"{key}: expected a value, got nothing; add it")
    notes = []
    model = content.get("distortion_model")
    if model is None:
        model = "plumb_bob"
        notes.append("distortion_model is missing: plumb_bob is assumed, as in ROS")
    model = one_of(model, _LENGTHS, "distortion_model")
    distortion = tuple(matrix(found["distortion_coefficients"], "distortion_coefficients").ravel().tolist())
    if len(distortion) not in _LENGTHS[model]:
        words = " or ".join(map(str, _LENGTHS[model]))
        raise FormatError(f"distortion_coefficients: expected {words} numbers for {model}, got {len(distortion)}")
    if found["rectification_matrix"] is not None:
        R = matrix(found["rectification_matrix"], "rectification_matrix")
        if R.size == 9 and not np.array_equal(R.reshape(3, 3), np.eye(3)):
            notes.append("rectification_matrix is not read: it rotates the picture, not the camera")
    camera = CameraModel(
        name=str(content.get("camera_name", name)),
        image_size_px=picture_size(found["image_width"], found["image_height"], "image_width, image_height"),
        pinhole=pinhole_of(matrix(found["camera_matrix"], "camera_matrix"), "camera_matrix"),
        distortion=distortion,
        lens=FISHEYE if model == "equidistant" else PERSPECTIVE,
    )
    return Read((camera,), tuple(notes))


def write(cameras: Sequence[CameraModel]) -> Written:
    """The file of one camera. Raises FormatError: the format cannot hold the lens."""
    (camera,) = cameras
    fx, fy, cx, cy = camera.pinhole
    distortion = fitted(camera, NAME)
    if camera.lens == FISHEYE:
        model = "equidistant"
    else:
        model = "plumb_bob" if len(distortion) == 5 else "rational_polynomial"
    lines = [
        f"image_width: {camera.image_size_px[0]}",
        f"image_height: {camera.image_size_px[1]}",
        f"camera_name: {quoted(camera.name)}",
        *_matrix("camera_matrix", 3, (fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0)),
        f"distortion_model: {model}",
        *_matrix("distortion_coefficients", 1, distortion),
        *_matrix("rectification_matrix", 3, np.eye(3).ravel().tolist()),
        *_matrix("projection_matrix", 3, (fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0)),
    ]
    return Written("\n".join(lines) + "\n", lost_poses(cameras, NAME))


def _matrix(key: str, rows: int, values: Sequence[float]) -> list[str]:
    return [f"{key}:", f"  rows: {rows}", f"  cols: {len(values) // rows}", f"  data: {exact_list(values)}"]
