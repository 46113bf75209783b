"""screens.yaml: cameras and screens in one world frame, with their joint covariance."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import pydantic

from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigCovariance
from lab.files.rig.calibration_state import CalibrationState
from lab.files.rig.camera_block import CovarianceBlock, covariance_mapping
from lab.files.rig.rig_file import (
    TARGET,
    CameraBlock,
    ScreenBlock,
    camera_mapping,
    joint_covariance,
    screen_mapping,
    unknown_name,
)
from lab.files.text.error_text import FileError
from lab.files.text.fields import Block, Word, one_of, validated
from lab.files.text.yaml_text import read_mapping, write_mapping

SCHEMA = "beampose/screens/1"


@dataclass(frozen=True, slots=True)
class ScreensFile:
    """Cameras and screens; the rig has no beams and no spots."""

    name: str
    rig: Rig
    covariance: RigCovariance | None
    calibration: CalibrationState | None


class _ScreensBlock(Block):
    schema_: Annotated[str, pydantic.PlainValidator(one_of((SCHEMA,)))] = pydantic.Field(alias="schema")
    name: Word
    screens: dict[str, ScreenBlock]
    cameras: dict[str, CameraBlock]
    covariance: CovarianceBlock | None = None
    calibration: CalibrationState | None = None


def load_screens(path: Path) -> ScreensFile:
    """The cameras and screens of a screens.yaml. Raises InputError: one line for each mistake, with file and field."""
    path = Path(path)
    content = validated(_ScreensBlock, read_mapping(path), path)
    mistakes = [
        unknown_name("screen", c.screen, f"cameras.{n}.screen", content.screens)
        for n, c in content.cameras.items()
        if c.screen not in content.screens
    ]
    if mistakes:
        raise FileError(f"{path}: {m}" for m in mistakes)
    rig = Rig(
        screens={n: s.value(n) for n, s in content.screens.items()},
        cameras={n: c.value(n) for n, c in content.cameras.items()},
        beams={},
        spots={},
    )
    block = content.covariance
    covariance = None if block is None else joint_covariance(rig, {TARGET: block.value()}, path)
    return ScreensFile(content.name, rig, covariance, content.calibration)


def save_screens(file: ScreensFile, path: Path) -> None:
    """Write a screens.yaml, atomically; it reads back to the same rig as with `save_rig`. Raises InputError."""
    content: dict[str, Any] = {
        "schema": SCHEMA,
        "name": file.name,
        "screens": {n: screen_mapping(s) for n, s in file.rig.screens.items()},
        "cameras": {n: camera_mapping(c) for n, c in file.rig.cameras.items()},
    }
    if file.covariance is not None:
        content["covariance"] = covariance_mapping(file.covariance)
    if file.calibration is not None:
        content["calibration"] = file.calibration.as_mapping()
    validated(_ScreensBlock, content, path)
    write_mapping(content, Path(path))
