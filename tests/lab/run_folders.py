"""A small lab as files: two screens at x = -2.5 and 2.5 m, three coplanar beams, two cameras of 64x48 px."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

# The cameras stand at (0, 0, -0.4) m, upside down, looking along -x, and near (0, 0, 0.4) m, looking along +x: places
# that are the same after half a turn of the world would let cameras have each other's place without a sign.
RIG = """\
schema: beampose/rig/1
screens:
  left:
    world_from_screen: {quaternion_wxyz: [0.5, 0.5, 0.5, 0.5], translation_m: [-2.5, 0, 0]}
    size_m: [4.0, 3.0]
  right:
    world_from_screen: {quaternion_wxyz: [0.5, 0.5, 0.5, 0.5], translation_m: [2.5, 0, 0]}
    size_m: [4.0, 3.0]
cameras:
  left:
    screen: left
    image_size_px: [64, 48]
    camera_matrix: {fx: 40.0, fy: 40.0, cx: 31.5, cy: 23.5}
    distortion: []
    camera_from_world: {quaternion_wxyz: [0.5, -0.5, 0.5, 0.5], translation_m: [0, 0.4, 0]}
    noise: {gain_e_per_dn: 38.0, read_noise_e: 30.0, black_dn: 8.0}
  right:
    screen: right
    image_size_px: [64, 48]
    camera_matrix: {fx: 40.0, fy: 40.0, cx: 31.5, cy: 23.5}
    distortion: [-0.05, 0.01, 1e-3, 0, 0]
    camera_from_world: {quaternion_wxyz: [0.5, 0.5, -0.5, 0.5], translation_m: [0.03, 0.4, 0.05]}
target:
  beams:
    A: {direction: [1.0, 0.0, 0.0], point_m: [0, 0, 0]}
    B: {direction: [1.0, 0.3, 0.0], point_m: [0, 0, 0]}
    C: {direction: [1.0, -0.3, 0.0], point_m: [0, 0, 0]}
  spots:
    "1": {beam: A, end: "-", screen: left}
    "2": {beam: B, end: "-", screen: left}
    "3": {beam: C, end: "-", screen: left}
    "4": {beam: A, end: "+", screen: right}
    "5": {beam: B, end: "+", screen: right}
    "6": {beam: C, end: "+", screen: right}
"""

RUN = """\
schema: beampose/run/1
name: small
rig: rig.yaml
frame_rate_hz: 100.0
cameras:
  left: {frames: frames/left}
  right: {frames: frames/right}
prior:
  position_m: [0.0, 0.0, 0.0]
  yaw_pitch_roll_deg: [0.0, 0.0, 0.0]
  within_m: 0.3
  within_deg: 10.0
"""


def picture_of(frame: int, dtype: type = np.uint8) -> np.ndarray:
    """The uniform picture (48, 64) of a frame; each frame has another grey value."""
    return np.full((48, 64), frame + 1, dtype=dtype)


def write_run(folder: Path, frames: int = 5) -> Path:
    """A run folder with PNG pictures of both cameras, frames 0 to frames - 1."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "rig.yaml").write_text(RIG)
    (folder / "run.yaml").write_text(RUN)
    for camera in ("left", "right"):
        (folder / "frames" / camera).mkdir(parents=True)
        for frame in range(frames):
            cv2.imwrite(str(folder / "frames" / camera / f"{frame:06d}.png"), picture_of(frame))
    return folder


def edit(path: Path, old: str, new: str) -> None:
    """Replace a text that occurs once in a file."""
    text = path.read_text()
    assert text.count(old) == 1, f"{old!r} stands {text.count(old)} times in {path.name}"
    path.write_text(text.replace(old, new))
