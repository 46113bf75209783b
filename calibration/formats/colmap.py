"""COLMAP's cameras.txt, with one line per camera: CAMERA_ID MODEL WIDTH HEIGHT PARAMS[].

In COLMAP the centre of the top-left pixel is (0.5, 0.5), in OpenCV (0, 0). Principal points are therefore larger by
0.5 px in COLMAP, and are converted when reading and writing. Source: COLMAP's documentation, "Output Format" and
src/colmap/sensor/models.h (the models and the order of their parameters).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from calibration.formats.model import CameraModel, FormatError, Read, Written, exact, fitted, lost_poses, picture_size
from geometry.camera import FISHEYE, PERSPECTIVE

NAME = "colmap"
HOLDS_MANY = True
PIXEL_CENTRE = 0.5  # px: COLMAP's coordinate of the centre of pixel 0
# Whether there is a single focal length, number of distortion coefficients after cx, cy, and the lens.
_MODELS = {
    "SIMPLE_PINHOLE": (True, 0, PERSPECTIVE),
    "PINHOLE": (False, 0, PERSPECTIVE),
    "SIMPLE_RADIAL": (True, 1, PERSPECTIVE),
    "RADIAL": (True, 2, PERSPECTIVE),
    "OPENCV": (False, 4, PERSPECTIVE),
    "FULL_OPENCV": (False, 8, PERSPECTIVE),
    "SIMPLE_RADIAL_FISHEYE": (True, 1, FISHEYE),
    "RADIAL_FISHEYE": (True, 2, FISHEYE),
    "OPENCV_FISHEYE": (False, 4, FISHEYE),
}
_WRITTEN = {(PERSPECTIVE, 0): "PINHOLE", (PERSPECTIVE, 4): "OPENCV", (PERSPECTIVE, 8): "FULL_OPENCV"}


def looks_like(text: str) -> bool:
    """Whether the first line that is not a comment has the form of a camera's line."""
    for line in text.splitlines():
        words = line.split()
        if words and not words[0].startswith("#"):
            return len(words) >= 6 and words[0].isdigit() and words[1].isupper() and words[2].isdigit()
    return False


def read(text: str, name: str) -> Read:
    """The cameras of a file, named by their numbers; `name` is not used. Raises FormatError: the file is not valid."""
    cameras: list[CameraModel] = []
    for i, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if words and not words[0].startswith("#"):
            cameras.append(_camera(words, f"line {i}"))
    if not cameras:
        raise FormatError("expected lines `CAMERA_ID MODEL WIDTH HEIGHT PARAMS`, got none")
    names = [c.name for c in cameras]
    for n in names:
        if names.count(n) > 1:
            raise FormatError(f"expected each camera once, got camera {n} {names.count(n)} times")
    return Read(tuple(cameras))


def _camera(words: list[str], where: str) -> CameraModel:
    if len(words) < 4:
        raise FormatError(f"{where}: expected `CAMERA_ID MODEL WIDTH HEIGHT PARAMS`, got {' '.join(words)!r}")
    identity, model, *rest = words
    if model not in _MODELS:
        raise FormatError(f"{where}: expected one of {', '.join(_MODELS)}, got {model}; COLMAP can convert to these")
    one_focal, n_distortion, lens = _MODELS[model]
    try:
        values = [float(w) for w in rest]
    except ValueError:
        raise FormatError(f"{where}: expected numbers after {model}, got {' '.join(rest)!r}") from None
    if not all(map(math.isfinite, values)):
        raise FormatError(f"{where}: expected finite numbers, got {' '.join(rest)!r}")
    expected = (3 if one_focal else 4) + n_distortion
    if len(values) - 2 != expected:
        raise FormatError(f"{where}: expected {expected} parameters for {model}, got {len(values) - 2}")
    width, height, *parameters = values
    focal = [parameters[0], parameters[0]] if one_focal else parameters[:2]
    cx, cy, *distortion = parameters[1 if one_focal else 2 :]
    padding = [0.0] * (max(4 - n_distortion, 0) if n_distortion else 0)
    return CameraModel(
        name=identity,
        image_size_px=picture_size(width, height, where),
        pinhole=(focal[0], focal[1], cx - PIXEL_CENTRE, cy - PIXEL_CENTRE),
        distortion=(*distortion, *padding),
        lens=lens,
    )


def write(cameras: Sequence[CameraModel]) -> Written:
    """The file of several cameras, numbered from 1 in their order.

    Raises FormatError: the format cannot hold a lens.
    """
    lines = [
        "# Camera list with one line of data per camera:",
        "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]",
        f"# Number of cameras: {len(cameras)}",
    ]
    renamed = []
    for i, camera in enumerate(cameras, start=1):
        distortion = fitted(camera, NAME)
        model = "OPENCV_FISHEYE" if camera.lens == FISHEYE else _WRITTEN[camera.lens, len(distortion)]
        fx, fy, cx, cy = camera.pinhole
        parameters = (fx, fy, cx + PIXEL_CENTRE, cy + PIXEL_CENTRE, *distortion)
        lines.append(" ".join([str(i), model, *map(str, camera.image_size_px), *map(exact, parameters)]))
        if camera.name != str(i):
            renamed.append(f"{camera.name} is camera {i}")
    notes = (f"colmap numbers its cameras: {', '.join(renamed)}",) if renamed else ()
    return Written("\n".join(lines) + "\n", notes + lost_poses(cameras, NAME))
