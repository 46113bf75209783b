"""One camera as represented by the exchange formats, and the lenses that each format can hold.

Lenses are OpenCV's: the perspective model with 0, 4, 5, 8, 12 or 14 coefficients (k1, k2, p1, p2, k3, k4, k5, k6,
s1 ... s4, tau_x, tau_y), or the fisheye model with k1 ... k4. Pixels are OpenCV's too: (0, 0) is the centre of the
top-left pixel.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from geometry.arrays import Array
from geometry.camera import FISHEYE, LENSES, PERSPECTIVE, camera_matrix
from geometry.lens import ALLOWED_LENGTHS
from geometry.pose import Pose

# Numbers of distortion coefficients that a format can hold, perspective and fisheye.
ROOM: Mapping[str, Mapping[str, tuple[int, ...]]] = {
    "opencv": {PERSPECTIVE: (4, 5, 8, 12, 14), FISHEYE: (4,)},
    "kalibr": {PERSPECTIVE: (4,), FISHEYE: (4,)},
    "ros": {PERSPECTIVE: (5, 8), FISHEYE: (4,)},
    "colmap": {PERSPECTIVE: (0, 4, 8), FISHEYE: (4,)},
    "mrcal": {PERSPECTIVE: (0, 4, 5, 8, 12), FISHEYE: ()},
}


class FormatError(ValueError):
    """A file is not valid, or a format cannot hold a camera. The message starts with the field."""


@dataclass(frozen=True, slots=True)
class CameraModel:
    """A camera's lens, and its pose if the file contains it."""

    name: str
    image_size_px: tuple[int, int]  # width, height
    pinhole: tuple[float, float, float, float]  # fx, fy, cx, cy, px
    distortion: tuple[float, ...] = ()
    lens: str = PERSPECTIVE
    camera_from_reference: Pose | None = None  # the reference is common to the cameras of a file

    def __post_init__(self) -> None:
        where = f"camera {self.name!r}"
        if min(self.image_size_px) < 1:
            raise FormatError(f"{where}: expected a picture of at least 1 pixel, got {self.image_size_px}")
        if not all(map(math.isfinite, (*self.pinhole, *self.distortion))):
            raise FormatError(f"{where}: expected finite numbers, got {[*self.pinhole, *self.distortion]}")
        if min(self.pinhole[:2]) <= 0:
            raise FormatError(f"{where}: expected focal lengths above 0, got {list(self.pinhole[:2])}")
        if self.lens not in LENSES:
            raise FormatError(f"{where}: expected a lens of {', '.join(LENSES)}, got {self.lens!r}")
        allowed = (0, 4) if self.lens == FISHEYE else ALLOWED_LENGTHS
        if len(self.distortion) not in allowed:
            words = ", ".join(map(str, allowed[:-1])) + f" or {allowed[-1]}"
            raise FormatError(f"{where}: expected {words} coefficients ({self.lens}), got {len(self.distortion)}")

    @property
    def matrix(self) -> Array:
        """The camera matrix (3, 3), px."""
        return camera_matrix(self.pinhole)


@dataclass(frozen=True, slots=True)
class Read:
    """The contents of a file. The notes list what was not read, one per line."""

    cameras: tuple[CameraModel, ...]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Written:
    """The text of a file. The notes list what was not written, one per line."""

    text: str
    notes: tuple[str, ...] = ()


def fitted(camera: CameraModel, format_name: str) -> tuple[float, ...]:
    """A camera's distortion, with as many coefficients as it has or as the format can hold without loss.

    Zeros are added or removed at the end, which does not change the lens. Raises FormatError: the format cannot hold
    this lens; the message lists the formats that can.
    """
    needed, room = len(significant(camera.distortion)), ROOM[format_name][camera.lens]
    if len(camera.distortion) in room:
        return camera.distortion
    for length in room:
        if length >= needed:
            return (*camera.distortion, *(0.0,) * length)[:length]
    others = [name for name, room in ROOM.items() if any(length >= needed for length in room[camera.lens])]
    raise FormatError(
        f"camera {camera.name!r}: {format_name} cannot hold this lens ({camera.lens}, {needed} coefficients);"
        f" {', '.join(others)} or beampose can"
    )


def significant(distortion: Sequence[float]) -> tuple[float, ...]:
    """The coefficients up to the last one that is not zero."""
    values = list(distortion)
    while values and values[-1] == 0:
        values.pop()
    return tuple(values)


def lost_poses(cameras: Sequence[CameraModel], format_name: str) -> tuple[str, ...]:
    """A note if cameras have poses, which the format cannot hold."""
    lost = [c.name for c in cameras if c.camera_from_reference is not None]
    return (f"{format_name} cannot hold poses: the pose of {', '.join(lost)} is not written",) if lost else ()


# Parts of files ---------------------------------------------------------------------------------------------------


def number(value: object, where: str) -> float:
    """A finite number.

    Raises FormatError: it is not one; the message starts with the field. The same holds for the functions below.
    """
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise FormatError(f"{where}: expected a finite number, got {shown(value)}")
    return float(value)


def numbers(value: object, where: str, count: int | None = None) -> tuple[float, ...]:
    """A list of finite numbers, with `count` entries unless None."""
    if not isinstance(value, list | tuple):
        words = "a list of numbers" if count is None else f"a list of {count} numbers"
        raise FormatError(f"{where}: expected {words}, got {shown(value)}")
    if count is not None and len(value) != count:
        raise FormatError(f"{where}: expected {count} numbers, got {len(value)}")
    return tuple(number(v, where) for v in value)


def picture_size(width: object, height: object, where: str) -> tuple[int, int]:
    """Width and height, px, as integers."""
    sizes = [number(v, where) for v in (width, height)]
    if any(v != int(v) or v < 1 for v in sizes):
        raise FormatError(f"{where}: expected a width and a height in whole pixels, got {sizes}")
    return int(sizes[0]), int(sizes[1])


def one_of(value: object, options: Iterable[str], where: str) -> str:
    """One of the words."""
    known = list(options)
    if not isinstance(value, str) or value not in known:
        raise FormatError(f"{where}: expected {', '.join(known)}, got {shown(value)}")
    return value


def mapping(value: object, where: str) -> Mapping[str, Any]:
    """A mapping."""
    if not isinstance(value, Mapping):
        raise FormatError(f"{where}: expected a mapping, got {shown(value)}")
    return value


def matrix(value: object, where: str) -> Array:
    """A 2-D array from {rows, cols, data}, {sizes, data}, or a plain list (one row)."""
    if isinstance(value, list):
        return np.array([numbers(value, where)])
    block = mapping(value, where)
    data = numbers(block.get("data"), f"{where}.data")
    if "sizes" in block:
        shape = [int(v) for v in numbers(block["sizes"], f"{where}.sizes")]
        shape = [1, *shape] if len(shape) == 1 else shape
    else:
        shape = [int(number(block.get(k), f"{where}.{k}")) for k in ("rows", "cols")]
    if len(shape) != 2 or shape[0] * shape[1] != len(data):
        raise FormatError(f"{where}: expected {' x '.join(map(str, shape))} numbers, got {len(data)}")
    return np.array(data).reshape(shape)


def pinhole_of(K: Array, where: str) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy of a camera matrix (3, 3) without skew, or of its nine entries in a row."""
    if K.size != 9:
        raise FormatError(f"{where}: expected a 3 x 3 matrix, got {' x '.join(map(str, K.shape))}")
    K = K.reshape(3, 3)
    rest = np.array([K[0, 1], K[1, 0], K[2, 0], K[2, 1], K[2, 2] - 1])
    if np.any(rest != 0):
        raise FormatError(
            f"{where}: expected [fx, 0, cx, 0, fy, cy, 0, 0, 1], got {K.ravel().tolist()}; skew is not supported"
        )
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])


def shown(value: object) -> str:
    """A value as shown in a message, shortened."""
    if value is None:
        return "nothing"
    text = repr(value)
    return text if len(text) <= 50 else text[:46] + " ..."


def exact(value: float) -> str:
    """The shortest text of a number that reads back to the same bits and is a number in YAML 1.1: `1.0e-05`."""
    text = repr(float(value))
    if "e" in text and "." not in text:
        text = text.replace("e", ".0e")
    return text


def exact_list(values: Sequence[float] | Array) -> str:
    """`[a, b, c]`."""
    return "[" + ", ".join(exact(float(v)) for v in values) + "]"


def quoted(text: str) -> str:
    """A text in double quotes, valid in YAML and JSON."""
    return json.dumps(text, ensure_ascii=False)
