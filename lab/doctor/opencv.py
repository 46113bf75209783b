"""Checks of the picture and video formats that OpenCV reads here: each is written and read back."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from lab.doctor.lines import Line, State
from lab.pictures.opencv import load_cv2

# Suffix, depth in bits and largest error of a grey level that comes back: 0 for lossless formats.
PICTURES = ((".png", 8, 0), (".png", 16, 0), (".tiff", 8, 0), (".tiff", 16, 0), (".bmp", 8, 0), (".pgm", 16, 0),
            (".jpg", 8, 8))  # fmt: skip
VIDEOS = (("MJPG", ".avi"), ("mp4v", ".mp4"), ("FFV1", ".avi"))
_SIZE = (64, 48)  # width, height, px
_VIDEO_ERROR = 24  # grey levels, of a smooth picture after lossy compression


def check_opencv() -> list[Line]:
    """All checks of this module."""
    cv2 = load_cv2()
    return [check_pictures(cv2), check_videos(cv2), _threads(cv2)]


def check_pictures(cv2: Any) -> Line:
    """The formats of pictures, in memory."""
    missing = [
        f"{suffix} with {bits} bits" for suffix, bits, error in PICTURES if not _read_back(cv2, suffix, bits, error)
    ]
    if missing:
        remedy = "Install OpenCV again: `python -m pip install --force-reinstall opencv-python-headless`"
        return Line(
            "BP-D04", State.FAIL, f"pictures: OpenCV {cv2.__version__} cannot read {', '.join(missing)}", remedy
        )
    names = ", ".join(dict.fromkeys(suffix[1:].upper() for suffix, _, _ in PICTURES))
    return Line("BP-D04", State.OK, f"pictures: OpenCV {cv2.__version__} reads {names}")


def _ramp(bits: int) -> np.ndarray:
    ramp = np.linspace(0, 2**bits - 1, _SIZE[0])
    return np.tile(ramp, (_SIZE[1], 1)).astype(np.uint8 if bits == 8 else np.uint16)


def _read_back(cv2: Any, suffix: str, bits: int, error: float) -> bool:
    picture = _ramp(bits)
    try:
        written, data = cv2.imencode(suffix, picture)
        found = cv2.imdecode(data, cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE) if written else None
    except cv2.error:
        return False
    if found is None or found.shape != picture.shape or found.dtype != picture.dtype:
        return False
    return bool(np.max(np.abs(found.astype(float) - picture)) <= error)


def check_videos(cv2: Any) -> Line:
    """The video formats, in a temporary folder. H.264 can be read, but not written, by OpenCV's own packages."""
    missing = []
    with tempfile.TemporaryDirectory(prefix="beampose-") as folder:
        for codec, suffix in VIDEOS:
            if not _video_read_back(cv2, Path(folder) / f"{codec}{suffix}", codec):
                missing.append(codec)
    backends = [cv2.videoio_registry.getBackendName(b) for b in cv2.videoio_registry.getBackends()]
    text = f"OpenCV's readers: {', '.join(backends)}"
    if missing:
        remedy = "Install OpenCV from PyPI (opencv-python-headless), or convert videos to folders of pictures"
        return Line("BP-D05", State.WARN, f"videos: {', '.join(missing)} cannot be read back ({text})", remedy)
    return Line("BP-D05", State.OK, f"videos: {', '.join(codec for codec, _ in VIDEOS)} are read back ({text})")


def _video_read_back(cv2: Any, path: Path, codec: str) -> bool:
    frames = [np.roll(_ramp(8) // 2, shift, axis=1) for shift in (0, 8, 16)]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), 25.0, _SIZE)
    try:
        for frame in frames:
            writer.write(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))
    finally:
        writer.release()
    reader = cv2.VideoCapture(str(path))
    try:
        found = [reader.read()[1] for _ in frames]
    finally:
        reader.release()
    return all(
        f is not None and float(np.median(np.abs(f[..., 0].astype(float) - wanted))) <= _VIDEO_ERROR
        for f, wanted in zip(found, frames, strict=True)
    )


def _threads(cv2: Any) -> Line:
    count, processors = cv2.getNumThreads(), cv2.getNumberOfCPUs()
    return Line(
        "BP-D13", State.OK, f"processors: {processors}; OpenCV uses {count} threads; results do not depend on it"
    )
