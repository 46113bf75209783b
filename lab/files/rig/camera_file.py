"""camera.yaml: one camera's calibration, read, checked and written."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import pydantic

from geometry.arrays import Array
from geometry.camera import PERSPECTIVE, Camera
from geometry.pose import Pose
from geometry.uncertainty.rig_uncertainty import PINHOLE, RigCovariance, distortion_names
from lab.files.rig.calibration_state import CameraCalibration
from lab.files.rig.camera_block import CovarianceBlock, LensBlock, covariance_error, covariance_mapping, lens_mapping
from lab.files.text import fields
from lab.files.text.error_text import suggest_name
from lab.files.text.yaml_text import read_mapping, write_mapping

SCHEMA = "beampose/camera/1"


@dataclass(frozen=True, slots=True)
class CameraFile:
    """The content of a camera.yaml."""

    name: str
    image_size_px: tuple[int, int]  # width, height
    camera_matrix: Array  # (3, 3), px: fx, fy, cx, cy; no skew
    distortion: tuple[float, ...]  # OpenCV order; 0, 4, 5, 8, 12 or 14 numbers
    lens: str = PERSPECTIVE  # or "fisheye": OpenCV's k1 ... k4
    covariance: RigCovariance | None = None  # of fx, fy, cx, cy, k1 ... or some of them
    calibration: CameraCalibration | None = None

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the camera's parameters, in order: fx, fy, cx, cy and its distortion coefficients."""
        return (*PINHOLE, *distortion_names(self.camera()))

    def camera(self, screen: str = "", camera_from_world: Pose | None = None) -> Camera:
        """The camera as a value of the geometry; without a pose, at the origin of the world."""
        pose = Pose.identity() if camera_from_world is None else camera_from_world
        return Camera(self.name, screen, self.image_size_px, self.camera_matrix, self.distortion, pose, lens=self.lens)


def load_camera(path: Path) -> CameraFile:
    """The camera of a camera.yaml. Raises InputError: one line for each mistake, with file and field."""
    path = Path(path)
    content = fields.validated(_CameraFileBlock, read_mapping(path), path)
    return CameraFile(
        name=content.name,
        image_size_px=content.size(),
        camera_matrix=content.matrix(),
        distortion=tuple(content.distortion),
        lens=content.lens,
        covariance=None if content.covariance is None else content.covariance.value(),
        calibration=content.calibration,
    )


def save_camera(file: CameraFile, path: Path) -> None:
    """Write a camera.yaml, atomically; it reads back to the last bit.

    Raises InputError: the camera could not be loaded again, or the file cannot be written; an old file stays as it was.
    """
    content = as_mapping(file)
    fields.validated(_CameraFileBlock, content, path)
    write_mapping(content, Path(path))


def as_mapping(file: CameraFile) -> dict[str, Any]:
    """The content of camera.yaml as a plain mapping."""
    content: dict[str, Any] = {
        "schema": SCHEMA,
        "name": file.name,
        **lens_mapping(file.image_size_px, file.camera_matrix, file.distortion, file.lens),
    }
    if file.covariance is not None:
        content["covariance"] = covariance_mapping(file.covariance)
    if file.calibration is not None:
        content["calibration"] = file.calibration.as_mapping()
    return content


# The schema of the file ----------------------------------------------------------------------------------------------


class _CameraFileBlock(LensBlock):
    schema_: Annotated[str, pydantic.PlainValidator(fields.one_of((SCHEMA,)))] = pydantic.Field(alias="schema")
    name: fields.Name
    covariance: CovarianceBlock | None = None
    calibration: CameraCalibration | None = None

    @pydantic.model_validator(mode="after")
    def _covariance_of_this_camera(self) -> _CameraFileBlock:
        if self.covariance is None:
            return self
        camera = CameraFile(self.name, self.size(), self.matrix(), tuple(self.distortion), self.lens)
        known = camera.parameter_names
        seen: set[str] = set()
        for name in self.covariance.parameters:
            if name not in known:
                raise fields.field_error(
                    f"covariance.parameters: unknown parameter {name!r}{suggest_name(name, known)}"
                )
            if name in seen:
                raise fields.field_error(f"covariance.parameters: expected each name once, got {name!r} a second time")
            seen.add(name)
        mistake = covariance_error(self.covariance.value())
        if mistake:
            raise fields.field_error(f"covariance.matrix: {mistake}")
        return self
