"""overlay.mp4: the pictures with the target's position, its 3-sigma ellipse and its path."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from geometry.arrays import Array
from lab.detect.inputs import open_inputs
from lab.errors import InputError
from lab.pictures.picture_file import GreyPicture, MissingPicture
from lab.report.plot.image import grey_limits, stretched
from lab.targets.point_recording import PointRecording
from tracking.single_target.parameters import TargetStatus
from tracking.single_target.point_tracker import PointEstimate

_LARGEST_SIDE = 1280  # px of the video
_PATH_FRAMES = 100  # frames of the path that are drawn
_DEFAULT_RATE_HZ = 25.0  # where the recording's rate is not known
_COLOURS = {TargetStatus.MEASURED: (80, 220, 80), TargetStatus.PREDICTED: (60, 170, 255)}  # BGR


def write_overlay(recording: PointRecording, track: list[PointEstimate], path: Path, limit: int | None = None) -> None:
    """Write the video; pictures that are missing or of another size are left out.

    Raises:
        InputError: OpenCV cannot write the video.
    """
    assert recording.size_px is not None
    scale = min(1.0, _LARGEST_SIDE / max(recording.size_px))
    size = (2 * round(recording.size_px[0] * scale / 2), 2 * round(recording.size_px[1] * scale / 2))
    rate = min(recording.rate_hz or _DEFAULT_RATE_HZ, 240.0)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), rate, (max(size[0], 2), max(size[1], 2)))
    if not writer.isOpened():
        raise InputError(f"{path}: cannot be written: OpenCV has no encoder for mp4; leave out --overlay")
    limits: tuple[float, float] | None = None
    try:
        for done, (frame, picture) in enumerate(open_inputs([recording.path]).pictures(1)):
            if limit is not None and done >= limit:
                break
            if isinstance(picture, MissingPicture) or (picture.shape[1], picture.shape[0]) != recording.size_px:
                continue
            limits = limits or grey_limits(picture)
            k = frame - int(recording.frames[0])
            writer.write(drawn(picture, limits, track, k, size))
    finally:
        writer.release()


def drawn(
    picture: GreyPicture, limits: tuple[float, float], track: list[PointEstimate], k: int, size: tuple[int, int]
) -> np.ndarray:
    """The picture of frame k, (h, w, 3), 8 bit, BGR, reduced to `size` (width, height), with the track up to it."""
    scale = np.array(size) / np.array([picture.shape[1], picture.shape[0]])
    grey = cv2.resize(stretched(picture, *limits), size, interpolation=cv2.INTER_AREA)
    out = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)

    def place(uv_px: Array) -> tuple[int, int]:
        u, v = ((np.clip(uv_px, -1e5, 1e5) + 0.5) * scale - 0.5).round().astype(int).tolist()
        return u, v

    first = max(0, k - _PATH_FRAMES)
    for before, e in zip(track[first:k], track[first + 1 : k + 1], strict=True):
        if np.isfinite([before.x[0], e.x[0]]).all():
            cv2.line(out, place(before.x[:2]), place(e.x[:2]), _COLOURS[e.status], 1, cv2.LINE_AA)
    e = track[k]
    if np.isfinite(e.x[0]):
        colour, centre = _COLOURS[e.status], place(e.x[:2])
        values, vectors = np.linalg.eigh(e.P[:2, :2])
        axes = np.maximum(3 * np.sqrt(np.maximum(values, 0.0)) * scale.mean(), 4.0).round().astype(int)
        angle = float(np.rad2deg(np.arctan2(vectors[1, 1], vectors[0, 1])))
        cv2.ellipse(out, centre, (int(axes[1]), int(axes[0])), angle, 0, 360, colour, 1, cv2.LINE_AA)
        cv2.drawMarker(out, centre, colour, cv2.MARKER_CROSS, 14, 1, cv2.LINE_AA)
    word = f"frame {k}  {e.status.value}"
    cv2.putText(out, word, (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 3, cv2.LINE_AA)
    cv2.putText(out, word, (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (240, 240, 240), 1, cv2.LINE_AA)
    return np.asarray(out)
