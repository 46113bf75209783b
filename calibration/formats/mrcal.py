"""mrcal's .cameramodel: a Python-like dictionary of literals, parsed and never executed.

Reads and writes the lens models of OpenCV: LENSMODEL_PINHOLE and LENSMODEL_OPENCV4, 5, 8 and 12, under the current and
the older keys. The pose is `rt_cam_ref` (`extrinsics` in older files): a rotation vector, rad, and a translation, m,
from the reference's coordinates to the camera's. mrcal's pixels are OpenCV's. Source: mrcal,
"Camera model representation in memory and on disk" and "Lens models".
"""

from __future__ import annotations

import ast
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from calibration.formats.model import (
    CameraModel,
    FormatError,
    Read,
    Written,
    exact,
    fitted,
    numbers,
    picture_size,
    shown,
)
from geometry import rotations
from geometry.pose import Pose

NAME = "mrcal"
HOLDS_MANY = False
_LENS_KEYS = ("lensmodel", "lens_model", "distortion_model")
_POSE_KEYS = ("rt_cam_ref", "extrinsics")
_MODELS = ("LENSMODEL_PINHOLE", *(f"LENSMODEL_OPENCV{n}" for n in (4, 5, 8, 12)))
_KNOWN = {*_LENS_KEYS, *_POSE_KEYS, "intrinsics", "imagersize"}


def looks_like(text: str) -> bool:
    """Whether a text has the keys of a camera model."""
    return all(re.search(rf"['\"]{key}['\"]\s*:", text) for key in ("intrinsics", "imagersize"))


def read(text: str, name: str) -> Read:
    """The camera of a file, which gets this name because the file contains none.

    Raises FormatError: the file is not valid.
    """
    content = _dictionary(text)
    model = next((content[k] for k in _LENS_KEYS if k in content), None)
    lens = str(model).replace("DISTORTION_NONE", _MODELS[0]).replace("DISTORTION_", "LENSMODEL_")
    if lens not in _MODELS:
        raise FormatError(
            f"lensmodel: expected one of {', '.join(_MODELS)}, got {shown(model)};"
            " mrcal-convert-lensmodel fits one of these"
        )
    expected = 4 + int(re.sub(r"\D", "", lens) or 0)
    fx, fy, cx, cy, *distortion = numbers(content.get("intrinsics"), f"intrinsics of {lens}", expected)
    size = numbers(content.get("imagersize"), "imagersize", 2)
    key = next((k for k in _POSE_KEYS if k in content), None)
    pose = None
    if key is not None:
        rt = np.array(numbers(content[key], key, 6))
        pose = Pose(rotations.exp(rt[:3]), rt[3:])
    camera = CameraModel(
        name=name,
        image_size_px=picture_size(size[0], size[1], "imagersize"),
        pinhole=(fx, fy, cx, cy),
        distortion=tuple(distortion),
        camera_from_reference=pose,
    )
    ignored = sorted(set(content) - _KNOWN)
    return Read((camera,), (f"not read: {', '.join(ignored)}",) if ignored else ())


def _dictionary(text: str) -> dict[str, Any]:
    """The literals of a file. Expressions are an error."""
    try:
        content = ast.literal_eval(text.strip())
    except SyntaxError as error:
        raise FormatError(f"line {error.lineno}: expected a Python dictionary of literals, got {error.msg}") from None
    except (ValueError, TypeError):
        raise FormatError("expected a Python dictionary of numbers, texts and lists, got an expression") from None
    except (RecursionError, MemoryError):
        raise FormatError("expected a Python dictionary, got one that is nested too deeply") from None
    if not isinstance(content, dict) or not all(isinstance(k, str) for k in content):
        raise FormatError(f"expected a Python dictionary, got {shown(content)}")
    return content


def write(cameras: Sequence[CameraModel]) -> Written:
    """The file of one camera.

    The pose is written under both keys, because releases before 2.5 read the older one. A missing pose is written as
    the identity. Raises FormatError: the format cannot hold the lens.
    """
    (camera,) = cameras
    distortion = fitted(camera, NAME)
    pose = camera.camera_from_reference
    rt = np.zeros(6) if pose is None else np.concatenate([rotations.log(pose.rotation), pose.translation])
    lens = f"LENSMODEL_OPENCV{len(distortion)}" if distortion else "LENSMODEL_PINHOLE"
    lines = [
        "{",
        f"    'lensmodel':  '{lens}',",
        "",
        "    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....",
        f"    'intrinsics': [ {_listed((*camera.pinhole, *distortion))} ],",
        "",
        "    # rt_cam_ref: rotation vector (rad) and translation (m), camera from reference",
        f"    'rt_cam_ref': [ {_listed(rt.tolist())} ],",
        f"    'extrinsics': [ {_listed(rt.tolist())} ],",
        "",
        f"    'imagersize': [ {camera.image_size_px[0]}, {camera.image_size_px[1]} ]",
        "}",
    ]
    notes = [f"mrcal's format has no camera name: name the file {camera.name}"]
    if pose is None:
        notes.append("mrcal requires a pose: the identity is written")
    return Written("\n".join(lines) + "\n", tuple(notes))


def _listed(values: Sequence[float]) -> str:
    return "".join(f"{exact(v)}, " for v in values).rstrip()
