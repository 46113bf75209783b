"""pair.yaml: two cameras with their relative pose; rig.yaml and foreign files with poses are read as pairs too."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import pydantic

from geometry.arrays import symmetric
from geometry.camera import Camera
from geometry.pose import Pose
from geometry.uncertainty.rig_uncertainty import RigCovariance, camera_names
from lab.errors import InputError
from lab.files.rig.camera_file import CalibrationState, CovarianceBlock, LensBlock, covariance_mapping, lens_mapping
from lab.files.rig.interchange import BEAMPOSE, RIG, read_cameras, recognised_format
from lab.files.rig.pose_block import CameraPoseBlock, pose_mapping
from lab.files.rig.rig_file import joint_covariance, load_rig_file
from lab.files.text.fields import Block, Name, one_of, validated
from lab.files.text.yaml_text import parse_mapping, read_text, write_mapping

SCHEMA = "beampose/pair/1"
REMEDY = "calibrate the pair with `beampose calibrate pair LEFT RIGHT --board BOARD --out DIR`"


@dataclass(frozen=True, slots=True)
class PairFile:
    """Calibrated cameras of a file, at least two, in a common frame."""

    cameras: Mapping[str, Camera]
    covariance: RigCovariance | None = None
    calibration: CalibrationState | None = None


class _CameraBlock(LensBlock):
    camera_from_world: CameraPoseBlock


class _PairBlock(Block):
    schema_: Annotated[str, pydantic.PlainValidator(one_of((SCHEMA,)))] = pydantic.Field(alias="schema")
    cameras: dict[Name, _CameraBlock]
    covariance: CovarianceBlock | None = None
    calibration: CalibrationState | None = None

    @pydantic.model_validator(mode="after")
    def _covariance_of_these_cameras(self) -> _PairBlock:
        if self.covariance is not None:
            self.covariance.check([f"cameras.{n}.{p}" for n, c in self.values().items() for p in camera_names(c)])
        return self

    def values(self) -> dict[str, Camera]:
        """The cameras by name."""
        return {
            name: Camera(name, "", b.size(), b.matrix(), tuple(b.distortion), b.camera_from_world.pose(), lens=b.lens)
            for name, b in self.cameras.items()
        }


def load_pair_file(path: Path) -> PairFile:
    """The cameras of a pair.yaml, a rig.yaml or a foreign file (Kalibr, OpenCV, mrcal ...) with poses.

    Raises InputError: with file and field; a file without poses or with one camera is not a calibrated pair.
    """
    path = Path(path)
    if not path.is_file():
        found = "a folder" if path.is_dir() else "nothing"
        raise InputError(f"{path}: expected a calibrated pair of cameras, found {found}; {REMEDY}")
    text = read_text(path)
    if SCHEMA in text:
        return _own(validated(_PairBlock, parse_mapping(text, path), path), path)
    kind = recognised_format(text, path)
    if kind == RIG:
        rig = load_rig_file(path)
        return PairFile(rig.rig.cameras, joint_covariance(rig.rig, rig.covariances, path), rig.calibration)
    models = read_cameras(path)
    if len(models) < 2:
        raise InputError(
            f"{path}: expected two cameras with their poses, got the single camera {models[0].name}; {REMEDY}"
        )
    lost = [m.name for m in models if m.camera_from_reference is None]
    if lost or kind == BEAMPOSE:
        raise InputError(
            f"{path}: expected cameras with their poses, got no pose of {', '.join(lost)}: the pair is not calibrated;"
            f" {REMEDY}"
        )
    cameras = {}
    for m in models:
        pose = m.camera_from_reference or Pose.identity()
        cameras[m.name] = Camera(m.name, "", m.image_size_px, m.matrix, m.distortion, pose, lens=m.lens)
    return PairFile(cameras)


def _own(content: _PairBlock, path: Path) -> PairFile:
    if len(content.cameras) < 2:
        raise InputError(f"{path}: cameras: expected two, got {len(content.cameras)}; {REMEDY}")
    covariance = None if content.covariance is None else content.covariance.value()
    if covariance is not None:
        covariance = RigCovariance(covariance.names, symmetric(covariance.matrix))
    return PairFile(content.values(), covariance, content.calibration)


def save_pair_file(file: PairFile, path: Path) -> None:
    """Write a pair.yaml, complete or not at all. Raises InputError."""
    content: dict[str, Any] = {
        "schema": SCHEMA,
        "cameras": {
            name: {
                **lens_mapping(c),
                "camera_from_world": pose_mapping(c.camera_from_world),
            }
            for name, c in file.cameras.items()
        },
    }
    if file.covariance is not None:
        content["covariance"] = covariance_mapping(file.covariance)
    if file.calibration is not None:
        content["calibration"] = file.calibration.as_mapping()
    validated(_PairBlock, content, path)
    write_mapping(content, Path(path))


def of_two_cameras(file: PairFile, names: Sequence[str]) -> tuple[tuple[Camera, Camera], RigCovariance | None]:
    """Two cameras of a file with their part of its covariance. Raises KeyError for an unknown name."""
    chosen = (file.cameras[names[0]], file.cameras[names[1]])
    if file.covariance is None:
        return chosen, None
    known = {f"cameras.{c.name}.{p}" for c in chosen for p in camera_names(c)}
    part = file.covariance.part([name in known for name in file.covariance.names])
    return chosen, part if part.names else None
