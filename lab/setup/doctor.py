"""The checks of `beampose doctor`: installation, picture formats, places on disk, calibration files."""

from __future__ import annotations

import datetime
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import geometry
from geometry.compilation.compile_cache import cache_folder, is_empty
from lab.errors import InputError
from lab.files.rig.camera_file import CalibrationState, load_camera
from lab.files.rig.rig_file import load_lab_file
from lab.files.run.run_file import load_run
from lab.files.text.yaml_text import read_mapping
from lab.findings.finding import Finding, Level, finding
from lab.pictures.opencv import load_cv2
from lab.setup.installation import check_installation

# Checks of the picture and video formats that OpenCV reads here: each is written and read back.

# Suffix, depth in bits and largest error of a grey level that comes back: 0 for lossless formats.
PICTURES = ((".png", 8, 0), (".png", 16, 0), (".tiff", 8, 0), (".tiff", 16, 0), (".bmp", 8, 0), (".pgm", 16, 0),
            (".jpg", 8, 8))  # fmt: skip
VIDEOS = (("MJPG", ".avi"), ("mp4v", ".mp4"), ("FFV1", ".avi"))
_SIZE = (64, 48)  # width, height, px
_VIDEO_ERROR = 24  # grey levels, of a smooth picture after lossy compression


def check_opencv() -> list[Finding]:
    """All checks of this module."""
    cv2 = load_cv2()
    return [check_pictures(cv2), check_videos(cv2), _threads(cv2)]


def check_pictures(cv2: Any) -> Finding:
    """The formats of pictures, in memory."""
    missing = [
        f"{suffix} with {bits} bits" for suffix, bits, error in PICTURES if not _read_back(cv2, suffix, bits, error)
    ]
    if missing:
        remedy = "Install OpenCV again: `python -m pip install --force-reinstall opencv-python-headless`"
        return finding(
            "BP-D04", Level.FAIL, f"pictures: OpenCV {cv2.__version__} cannot read {', '.join(missing)}", remedy=remedy
        )
    names = ", ".join(dict.fromkeys(suffix[1:].upper() for suffix, _, _ in PICTURES))
    return finding("BP-D04", Level.PASS, f"pictures: OpenCV {cv2.__version__} reads {names}")


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


def check_videos(cv2: Any) -> Finding:
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
        return finding(
            "BP-D05", Level.WARN, f"videos: {', '.join(missing)} cannot be read back ({text})", remedy=remedy
        )
    return finding("BP-D05", Level.PASS, f"videos: {', '.join(codec for codec, _ in VIDEOS)} are read back ({text})")


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


def _threads(cv2: Any) -> Finding:
    count, processors = cv2.getNumThreads(), cv2.getNumberOfCPUs()
    return finding(
        "BP-D13", Level.PASS, f"processors: {processors}; OpenCV uses {count} threads; results do not depend on it"
    )


# Checks of folders: the compile cache, and the space on the disks that runs write to.


FEW_BYTES, TOO_FEW_BYTES = 5 * 10**9, 2 * 10**8  # free space below which to warn, and to fail
_GB = 1e9
_PACKAGES = ("geometry", "tracking", "calibration", "lab")


def check_places(out: Path) -> list[Finding]:
    """All checks of this module. out: where results will be written."""
    temporary = Path(tempfile.gettempdir())
    return [check_cache(), check_space(existing(out), "results"), check_space(temporary, "temporary files")]


def compiled_folders() -> list[Path]:
    """The source folders of the program that have compiled functions."""
    root = Path(geometry.__file__).parents[1]
    files = (f for package in _PACKAGES for f in (root / package).rglob("*.py"))
    return sorted({f.parent for f in files if "\n@compiled" in f.read_text("utf-8")})


def check_cache() -> Finding:
    """Whether compiled code can be kept, where, and how much of it is there."""
    folders = compiled_folders()
    kept = [cache_folder(f) for f in folders]
    places = {str(k.parent) for k in kept if k is not None}
    if None in kept:
        remedy = "Make one of these writable for you alone: beampose's own folder, ~/.cache, the temporary folder"
        return finding(
            "BP-D07", Level.WARN, "compiled code: cannot be kept; each run compiles for a minute", remedy=remedy
        )
    ready = sum(not is_empty(f) for f in folders)
    text = f"compiled code: {ready} of {len(folders)} parts are ready in {', '.join(sorted(places))}"
    if ready < len(folders):
        remedy = "The next run compiles the rest (a minute), or: `python -m lab.runs.warm_up`"
        return finding("BP-D07", Level.WARN, text, remedy=remedy)
    return finding("BP-D07", Level.PASS, text)


def existing(path: Path) -> Path:
    """The path, or the nearest folder above it that exists."""
    path = Path(path).absolute()
    return next(p for p in (path, *path.parents) if p.exists())


def check_space(folder: Path, what: str) -> Finding:
    """The free space of the disk of a folder."""
    try:
        free = shutil.disk_usage(folder).free
    except OSError as error:
        return finding(
            "BP-D08", Level.FAIL, f"disk: {folder} cannot be read: {error.strerror}", remedy="Choose another folder"
        )
    text = f"disk: {free / _GB:.1f} GB are free for {what} in {folder}"
    if free >= FEW_BYTES:
        return finding("BP-D08", Level.PASS, text)
    remedy = "Free some space, or write to another disk (--out; TMPDIR for temporary files)"
    return finding("BP-D08", Level.WARN if free >= TOO_FEW_BYTES else Level.FAIL, text, remedy=remedy)


# Checks of calibration files: verdict, age and expiry.


EXPIRES_SOON = 14  # days before the expiry from which to warn
OLD = 365  # days after which a calibration without an expiry date is reported
_AGAIN = "Confirm it with `beampose calibrate check`, or calibrate again (`beampose calibrate rig`)"


def check_calibration(path: Path, today: datetime.date) -> Finding:
    """The calibration of a rig.yaml, camera.yaml or screens.yaml, or of the rig of a run folder."""
    try:
        state = _state_of(Path(path))
    except InputError as error:
        text = str(error).splitlines()[0]
        remedy = "Correct the file: `beampose check` names all its mistakes"
        return finding("BP-D10", Level.FAIL, f"calibration: {text}", remedy=remedy)
    level, text, remedy = _judged(state, today)
    return finding("BP-D09", level, f"calibration: {path}{text}", remedy=remedy)


def _state_of(path: Path) -> CalibrationState | None:
    """None: the file states no date or no verdict."""
    if path.is_dir() or path.name == "run.yaml":
        return load_run(path).calibration
    schema = str(read_mapping(path).get("schema", ""))
    if schema.startswith("beampose/camera/"):
        return load_camera(path).calibration
    return load_lab_file(path).calibration


def _judged(state: CalibrationState | None, today: datetime.date) -> tuple[Level, str, str]:
    """Level, words and remedy of a calibration."""
    if state is None or state.date is None:
        return Level.WARN, " states no date of calibration", _AGAIN
    days, left = (today - state.date).days, state.days_left(today)
    text = f": {state.verdict or Level.PASS.name}, {days} days old"
    if state.failed:
        return Level.FAIL, text + state.reason, "Correct the cause and calibrate again"
    if days < 0:
        remedy = "Check the clock of this computer and the date in the file"
        return Level.WARN, f": its date {state.date} is in the future", remedy
    if left is not None and left < 0:
        return Level.FAIL, f"{text}, expired on {state.valid_until}", _AGAIN
    text += f", {state.validity}"
    if left is None and days > OLD:
        return Level.WARN, text, _AGAIN
    if left is not None and left <= EXPIRES_SOON:
        return Level.WARN, f"{text}, in {left} days", _AGAIN
    if state.verdict == Level.WARN.name:
        return Level.WARN, text + state.reason, "Read the report beside the file before using it"
    return Level.PASS, text, ""


def examine(files: Sequence[Path] = (), out: Path = Path()) -> list[Finding]:
    """A finding per check. files: calibration files or run folders. out: where results will be written."""
    lines = check_installation()
    if any(line.code == "BP-D02" and line.level > Level.PASS for line in lines):
        return lines  # the other checks need the libraries
    today = datetime.date.today()
    return [*lines, *check_opencv(), *check_places(out), *(check_calibration(f, today) for f in files)]
