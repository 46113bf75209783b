"""Converts cameras between file formats: beampose, OpenCV, Kalibr, ROS, COLMAP, mrcal."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType

import numpy as np

from calibration.formats import colmap, kalibr, mrcal, opencv_yaml, ros
from calibration.formats.model import CameraModel, FormatError, Read, Written, significant
from geometry.camera import Camera, pinhole_numbers
from geometry.uncertainty.rig_uncertainty import RigCovariance
from lab.errors import InputError
from lab.files.rig.camera_file import CameraFile, load_camera, save_camera
from lab.files.rig.rig_file import SCHEMA as RIG_SCHEMA
from lab.files.rig.rig_file import RigFile, load_rig_file
from lab.files.text.atomic_write import atomic_write_text
from lab.files.text.error_text import suggest_name
from lab.files.text.yaml_text import parse_mapping, read_text
from lab.findings.finding import Done

BEAMPOSE, RIG = "beampose", "beampose-rig"
_FOREIGN: Mapping[str, ModuleType] = {m.NAME: m for m in (opencv_yaml, kalibr, ros, colmap, mrcal)}
FORMATS = (BEAMPOSE, *_FOREIGN)  # writable
READABLE = (BEAMPOSE, RIG, *_FOREIGN)
_LABELS = {
    BEAMPOSE: "beampose camera.yaml",
    RIG: "beampose rig.yaml",
    "opencv": "OpenCV YAML",
    "kalibr": "Kalibr camchain",
    "ros": "ROS camera_info",
    "colmap": "COLMAP cameras.txt",
    "mrcal": "mrcal .cameramodel",
}
ROUND_TRIP_TOLERANCE = 1e-12  # relative tolerance between a camera and the camera that is read from the written file


def convert(
    source: Path,
    destination: Path,
    from_format: str | None = None,
    to_format: str | None = None,
    camera: str | None = None,
) -> Done[tuple[CameraModel, ...]]:
    """Write the cameras of one file into another.

    Formats: beampose (camera.yaml), opencv, kalibr, ros, colmap, mrcal, and as a source beampose-rig (rig.yaml). By
    default the content determines the format of the source, and the name that of the destination. camera: the camera to
    convert; by default all, if the format of the destination allows several. What the destination cannot hold is an
    error (a lens), or a note (a pose, a covariance). Raises InputError: a file cannot be read, converted or written;
    the destination stays as it was.
    """
    source, destination = Path(source), Path(destination)
    text = read_text(source)
    origin = _known(from_format, READABLE, "--from") if from_format else recognised_format(text, source)
    target = _known(to_format, FORMATS, "--to") if to_format else _format_of_name(destination)
    found, covariances = _read(text, source, origin)
    models = _chosen(found.cameras, camera, source, target)
    _check_destination(source, destination, target)
    try:
        notes = found.notes + _write(models, covariances, destination, target)
    except FormatError as error:
        raise InputError(f"{source}: {error}") from None
    line = f"{', '.join(m.name for m in models)}: {_LABELS[origin]} -> {_LABELS[target]}, {destination}"
    return Done(tuple(models), (line, *(f"  note: {note}" for note in notes)))


def read_cameras(path: Path) -> tuple[CameraModel, ...]:
    """The cameras of a file of any known format. Raises InputError."""
    text = read_text(path)
    return _read(text, path, recognised_format(text, path))[0].cameras


# Formats -------------------------------------------------------------------------------------------------------------


def recognised_format(text: str, path: Path) -> str:
    """The format of a file, from its text. Raises InputError, with the known formats, where it is none of them."""
    body = text.lstrip("\ufeff \t\r\n")
    if body.startswith(("<?xml", "<opencv_storage")):
        raise InputError(f"{path}: expected YAML, got OpenCV's XML; save it as .yml from OpenCV")
    if re.search(r"^\s*Model\s*=\s*(CAHV|.*CAHV)", body):
        raise InputError(f"{path}: expected an OpenCV-like lens, got a CAHVOR model; mrcal-convert-lensmodel fits one")
    if body.startswith("%YAML:") or "!!opencv-" in body:
        return "opencv"
    if mrcal.looks_like(body):
        return "mrcal"
    if colmap.looks_like(body):
        return "colmap"
    try:
        content = parse_mapping(text, path)
    except InputError as error:
        raise InputError(f"{path}: {_unknown()} ({str(error).removeprefix(f'{path}: ')})") from None
    if content.get("schema") == RIG_SCHEMA:
        return RIG
    if str(content.get("schema", "")).startswith("beampose/"):
        return BEAMPOSE
    if any(re.fullmatch(r"cam\d+", key) for key in content):
        return "kalibr"
    if "camera_matrix" in content or {"width", "height"} <= set(content):
        return "ros"
    raise InputError(f"{path}: {_unknown()}; name it with --from if it is one")


def _unknown() -> str:
    return f"expected one of {', '.join(_LABELS.values())}, got something else"


def _known(name: str, allowed: Sequence[str], option: str) -> str:
    if name not in allowed:
        raise InputError(f"{option}: expected {', '.join(allowed)}, got {name!r}{suggest_name(name, allowed)}")
    return name


def _format_of_name(path: Path) -> str:
    """The format that a file name indicates. Raises InputError where it indicates none."""
    name = path.name.lower()
    for ending, format_name in ((".cameramodel", "mrcal"), (".txt", "colmap"), (".yml", "opencv")):
        if name.endswith(ending):
            return format_name
    for part, format_name in (("camchain", "kalibr"), ("camera_info", "ros"), ("camera.yaml", BEAMPOSE)):
        if part in name:
            return format_name
    raise InputError(f"{path}: the name does not indicate the format; add --to with one of {', '.join(FORMATS)}")


# Reading -------------------------------------------------------------------------------------------------------------


def _read(text: str, path: Path, origin: str) -> tuple[Read, dict[str, RigCovariance]]:
    """The cameras of a file, and the covariances of their parameters."""
    if origin == RIG:
        return _from_rig(load_rig_file(path))
    if origin == BEAMPOSE:
        file = load_camera(path)
        covariances = {} if file.covariance is None else {file.name: file.covariance}
        return Read((_model_of(file.camera(), placed=False),)), covariances
    module = _FOREIGN[origin]
    content = text if origin in ("colmap", "mrcal") else parse_mapping(text, path, opencv=origin == "opencv")
    try:
        found: Read = module.read(content, path.stem)
    except FormatError as error:
        raise InputError(f"{path}: {error}") from None
    return found, {}


def _model_of(camera: Camera, placed: bool) -> CameraModel:
    fx, fy, cx, cy = pinhole_numbers(camera).tolist()
    pose = camera.camera_from_world if placed else None
    return CameraModel(camera.name, camera.image_size_px, (fx, fy, cx, cy), camera.distortion, camera.lens, pose)


def _from_rig(file: RigFile) -> tuple[Read, dict[str, RigCovariance]]:
    """The cameras of a rig, each with its block of the joint covariance."""
    covariances = {}
    for name in file.rig.cameras:
        joint = file.covariances.get("target")
        own = None if joint is None else _share(joint, f"cameras.{name}.")
        alone = file.covariances.get(f"cameras.{name}")
        if own is None and alone is not None:
            own = _share(alone, "")
        if own is not None:
            covariances[name] = own
    return Read(tuple(_model_of(c, placed=True) for c in file.rig.cameras.values())), covariances


def _share(covariance: RigCovariance, prefix: str) -> RigCovariance | None:
    """The covariance of the lens parameters: with the prefix, not the pose's; None where there are none."""
    of_lens = re.compile(re.escape(prefix) + r"[^.]*(?<!_m)(?<!_rad)")
    own = covariance.part([of_lens.fullmatch(n) is not None for n in covariance.names])
    return RigCovariance(tuple(n.removeprefix(prefix) for n in own.names), own.matrix) if own.names else None


def _chosen(models: Sequence[CameraModel], camera: str | None, path: Path, target: str) -> tuple[CameraModel, ...]:
    """The cameras to write. Raises InputError where the file has several and the destination can hold only one."""
    names = [m.name for m in models]
    if camera is not None:
        if camera not in names:
            raise InputError(f"{path}: expected a camera {camera!r}, found none{suggest_name(camera, names)}")
        return tuple(m for m in models if m.name == camera)
    holds_many = target != BEAMPOSE and _FOREIGN[target].HOLDS_MANY
    if len(models) > 1 and not holds_many:
        raise InputError(
            f"{path}: has cameras {', '.join(names)}, but {_LABELS[target]} holds one; choose with --camera {names[0]}"
        )
    return tuple(models)


# Writing -------------------------------------------------------------------------------------------------------------


def _check_destination(source: Path, destination: Path, target: str) -> None:
    """Raises InputError where writing would overwrite the source, or anything but cameras in that format."""
    if not destination.exists():
        return
    if destination.is_dir():
        raise InputError(f"{destination}: expected a file to write, found a folder; name a file in it")
    if destination.samefile(source):
        raise InputError(f"{destination}: source and destination are the same file; choose another name")
    if not destination.stat().st_size:
        return
    try:
        text = read_text(destination)
        there = recognised_format(text, destination)
        if there == target:
            _read(text, destination, target)
    except InputError:
        there = ""  # a board.yaml is beampose's too, and OpenCV stores anything as YAML: the file must contain cameras
    if there == RIG:
        raise InputError(f"{destination}: is a rig; a camera must not replace it; choose another name")
    if there != target:
        raise InputError(
            f"{destination}: exists and is not {_LABELS[target]}; choose another name, or remove that file first"
        )


def _write(
    models: tuple[CameraModel, ...], covariances: Mapping[str, RigCovariance], path: Path, target: str
) -> tuple[str, ...]:
    """Write, and return notes of what the file does not contain."""
    if target == BEAMPOSE:
        return _write_ours(models[0], covariances.get(models[0].name), path)
    written: Written = _FOREIGN[target].write(models)
    _check_round_trip(models, written.text, path, target)
    atomic_write_text(written.text, path)
    lost = [m.name for m in models if m.name in covariances]
    if not lost:
        return written.notes
    return (*written.notes, f"{target} cannot hold a covariance: that of {', '.join(lost)} is not written")


def _write_ours(model: CameraModel, covariance: RigCovariance | None, path: Path) -> tuple[str, ...]:
    save_camera(
        CameraFile(model.name, model.image_size_px, model.matrix, model.distortion, model.lens, covariance), path
    )
    if model.camera_from_reference is None:
        return ()
    return (f"camera.yaml cannot hold a pose: that of {model.name} is not written",)


def _check_round_trip(models: Sequence[CameraModel], text: str, path: Path, target: str) -> None:
    """Raises InputError unless the text reads back to the same lenses; called before the file is written."""
    content = text if target in ("colmap", "mrcal") else parse_mapping(text, path, opencv=target == "opencv")
    reread: Read = _FOREIGN[target].read(content, path.stem)
    for before, after in zip(models, reread.cameras, strict=True):
        if not same_lens(before, after):
            raise InputError(f"{path}: {before.name} read back from {target} is another lens; please report this")


def same_lens(a: CameraModel, b: CameraModel) -> bool:
    """Whether two models are equal: picture size, and pinhole and distortion parameters to `ROUND_TRIP_TOLERANCE`."""
    if (a.image_size_px, a.lens) != (b.image_size_px, b.lens):
        return False
    numbers = [np.array([*m.pinhole, *significant(m.distortion)]) for m in (a, b)]
    scale = np.maximum(np.abs(numbers[0]), [1.0] * 4 + [0.0] * (len(numbers[0]) - 4))
    return len(numbers[0]) == len(numbers[1]) and bool(
        np.all(np.abs(numbers[0] - numbers[1]) <= ROUND_TRIP_TOLERANCE * scale)
    )
