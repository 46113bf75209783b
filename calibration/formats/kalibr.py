"""Kalibr's camchain.yaml: one or several pinhole cameras, each with its pose relative to the previous one.

Source: Kalibr's wiki, "Yaml formats" and "Supported models". radtan is OpenCV's k1, k2, p1, p2, and equidistant its
fisheye model. As in mrcal, a T_cn_cnm1 of cam0 is its pose relative to the common reference; Kalibr itself has none
there, its reference is cam0.
"""

from __future__ import annotations

import re
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
    mapping,
    numbers,
    one_of,
    picture_size,
    quoted,
    shown,
)
from geometry.arrays import Array
from geometry.camera import FISHEYE, PERSPECTIVE
from geometry.pose import Pose

NAME = "kalibr"
HOLDS_MANY = True
_LENS = {"radtan": PERSPECTIVE, "equidistant": FISHEYE, "none": PERSPECTIVE}
_KNOWN = {
    "camera_model", "intrinsics", "distortion_model", "distortion_coeffs", "resolution", "rostopic", "T_cn_cnm1",
    "cam_overlaps",
}  # fmt: skip
# Deviation of a rotation's rows from orthonormal that six written digits cause.
ROTATION_TOLERANCE = 1e-5


def read(content: Mapping[str, Any], name: str) -> Read:
    """The cameras of a parsed camchain, in the order of the chain.

    A camera is named by its rostopic (`/left/image_raw` gives left), otherwise cam0, cam1, ...; `name` is not used.
    Raises FormatError: the file is not valid.
    """
    keys = sorted((k for k in content if re.fullmatch(r"cam\d+", k)), key=lambda k: int(k[3:]))
    if not keys:
        raise FormatError("expected cameras cam0, cam1, ..., got none")
    blocks = [mapping(content[k], k) for k in keys]
    topics = [re.fullmatch(r"/([^/]+)/image_raw", str(b.get("rostopic", ""))) for b in blocks]
    names = [t.group(1) if t else k for t, k in zip(topics, keys, strict=True)]
    if len(set(names)) < len(names):
        names = keys
    several = len(keys) > 1
    poses: list[Pose | None] = []
    for i, (key, block) in enumerate(zip(keys, blocks, strict=True)):
        before = poses[-1] if poses else None
        if "T_cn_cnm1" in block:
            step = _pose(block["T_cn_cnm1"], f"{key}.T_cn_cnm1")
            poses.append(step if before is None else step @ before)
        elif i == 0:
            poses.append(Pose.identity() if several else None)
        else:
            raise FormatError(f"{key}.T_cn_cnm1: expected the pose relative to {keys[i - 1]}, got nothing; add it")
    cameras = tuple(_camera(k, n, b, p) for k, n, b, p in zip(keys, names, blocks, poses, strict=True))
    ignored = sorted({f for b in blocks for f in b} - _KNOWN)
    notes = (f"not read: {', '.join(ignored)} (beampose has no IMU)",) if ignored else ()
    return Read(cameras, notes)


def _camera(key: str, name: str, block: Mapping[str, Any], pose: Pose | None) -> CameraModel:
    kind = block.get("camera_model")
    if kind != "pinhole":
        raise FormatError(
            f"{key}.camera_model: expected 'pinhole', got {shown(kind)}; calibrate with pinhole-radtan or pinhole-equi"
        )
    lens = one_of(block.get("distortion_model"), _LENS, f"{key}.distortion_model")
    coefficients = block.get("distortion_coeffs", [] if lens == "none" else None)
    fx, fy, cx, cy = numbers(block.get("intrinsics"), f"{key}.intrinsics", 4)
    size = numbers(block.get("resolution"), f"{key}.resolution", 2)
    return CameraModel(
        name=name,
        image_size_px=picture_size(size[0], size[1], f"{key}.resolution"),
        pinhole=(fx, fy, cx, cy),
        distortion=numbers(coefficients, f"{key}.distortion_coeffs", 0 if lens == "none" else 4),
        lens=_LENS[lens],
        camera_from_reference=pose,
    )


def _pose(value: object, where: str) -> Pose:
    if not isinstance(value, list) or len(value) != 4:
        raise FormatError(f"{where}: expected a 4 x 4 matrix as a list of rows, got {shown(value)}")
    T = np.array([numbers(row, where, 4) for row in value])
    R = T[:3, :3]
    if np.abs(R.T @ R - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(R) < 0 or np.any(T[3] != [0, 0, 0, 1]):
        raise FormatError(f"{where}: expected a rotation and a translation over 0, 0, 0, 1, got {T.ravel().tolist()}")
    return Pose(R, T[:3, 3])


def write(cameras: Sequence[CameraModel]) -> Written:
    """The camchain of several cameras, in their order.

    Raises FormatError: the format cannot hold a lens, or a camera of several has no pose.
    """
    placed = [c.camera_from_reference is not None for c in cameras]
    if len(cameras) > 1 and not all(placed):
        missing = [c.name for c, p in zip(cameras, placed, strict=True) if not p]
        raise FormatError(
            f"a camchain contains every camera's pose relative to the previous one; {', '.join(missing)} has none:"
            " write each camera to a file of its own"
        )
    lines: list[str] = []
    before: Pose | None = None
    for i, camera in enumerate(cameras):
        distortion = fitted(camera, NAME)
        lines += [
            f"cam{i}:",
            "  camera_model: pinhole",
            f"  intrinsics: {exact_list(camera.pinhole)}",
            f"  distortion_model: {'equidistant' if camera.lens == FISHEYE else 'radtan'}",
            f"  distortion_coeffs: {exact_list(distortion)}",
            f"  resolution: [{camera.image_size_px[0]}, {camera.image_size_px[1]}]",
            f"  rostopic: {quoted(f'/{camera.name}/image_raw')}",
        ]
        pose = camera.camera_from_reference
        if pose is not None:
            step = pose if before is None else pose @ before.inverse()
            moved = not np.array_equal(step.rotation, np.eye(3)) or step.translation.any()
            if before is not None or moved or len(cameras) == 1:
                lines += ["  T_cn_cnm1:", *(f"  - {exact_list(row)}" for row in _rows(step))]
            before = pose
    return Written("\n".join(lines) + "\n")


def _rows(pose: Pose) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = pose.rotation, pose.translation
    return T
