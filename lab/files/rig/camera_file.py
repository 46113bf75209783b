"""camera.yaml: one camera's calibration; and the blocks that it shares with rig.yaml: lens, covariances, state.

The state of a calibration: its date, validity and verdict, and whether it may be used.
"""

from __future__ import annotations

import datetime
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pydantic

from geometry import lens
from geometry.arrays import Array, symmetric
from geometry.camera import FISHEYE, LENSES, PERSPECTIVE, Camera, pinhole_numbers
from geometry.pose import Pose
from geometry.uncertainty.rig_uncertainty import PINHOLE, RigCovariance, distortion_names
from lab.errors import CalibrationError
from lab.files.text import fields
from lab.files.text.error_text import suggest_name
from lab.files.text.fields import Block, Integer, Lines, NonNegative, Number, Positive, Text, one_of, unexpected_value
from lab.files.text.yaml_text import read_mapping, write_mapping
from lab.findings.finding import Level
from lab.number_format import format_count

VERDICTS = tuple(level.name for level in Level)


def iso_date(value: Any) -> datetime.date:
    """A date, or one written as 2026-03-14; a time of day after it is ignored."""
    if isinstance(value, datetime.date):
        return value
    if isinstance(value, str):
        try:
            return datetime.datetime.fromisoformat(value.strip()).date()
        except ValueError:
            pass
    raise unexpected_value("a date such as 2026-03-14", value)


def _day_or_none(value: Any) -> datetime.date | None:
    return None if value in (None, "") else iso_date(value)


Day = Annotated[datetime.date, pydantic.PlainValidator(iso_date)]
OptionalDay = Annotated[datetime.date | None, pydantic.PlainValidator(_day_or_none)]


class CalibrationState(Block):
    """Date, verdict and validity of a calibration: the block `calibration:` of a file."""

    date: Day
    verdict: Annotated[str, pydantic.PlainValidator(one_of(VERDICTS))]
    valid_until: OptionalDay = None  # the last valid day; without it, no limit
    reasons: Lines = ()  # a line for each finding that is not a PASS
    notes: Text = ""
    made_from: Lines = ()  # a line for each file from which it was made, with its SHA-256

    def days_left(self, day: datetime.date) -> int | None:
        """Days of validity after `day`: negative after its end, None without one."""
        return None if self.valid_until is None else (self.valid_until - day).days

    @property
    def validity(self) -> str:
        """The end of the validity in words."""
        return "without an expiry date" if self.valid_until is None else f"valid until {self.valid_until}"

    @property
    def failed(self) -> bool:
        """Whether the verdict is FAIL: it must not be used."""
        return self.verdict == Level.FAIL.name

    @property
    def reason(self) -> str:
        """The first reason of the verdict, such as ` (RMS 3 px)`; empty without one."""
        return f" ({self.reasons[0]})" if self.reasons else ""


class CameraCalibration(CalibrationState):
    """The state of a lens calibration with its quality: the block of a camera.yaml. All of it may be unknown."""

    date: OptionalDay = None  # type: ignore[assignment]  # a lens may have none, a rig has one
    verdict: Annotated[str, pydantic.PlainValidator(one_of((*VERDICTS, "")))] = ""
    rms_px: NonNegative | None = None  # of the corners' residuals, per axis
    sigma_px: NonNegative | None = None  # of one corner's coordinate, estimated by the solve
    hold_out_rms_px: NonNegative | None = None  # of corners not used by the solve
    views: Integer | None = None  # photographs used
    corners: Integer | None = None  # corners used
    board: Text = ""  # description of the board, or its file
    distance_m: Positive | None = None  # distance for figures in millimetres
    figures: dict[str, Number] = {}  # noqa: RUF012 - frozen  # further figures, with their unit in the name


def require_valid_calibration(
    state: CalibrationState | None, path: Path, recorded: datetime.date | None = None
) -> None:
    """Checks that a calibration may be used for a recording of that day, or of today; None (state unknown) may.

    Raises CalibrationError: the verdict is FAIL, or the calibration is out of date (exit status 3).
    """
    if state is None:
        return
    if state.failed:
        raise CalibrationError(
            f"{path}: calibration.verdict: FAIL{state.reason}: this calibration must not be used; correct the cause and"
            " calibrate again (`beampose calibrate rig`)"
        )
    on, what = (datetime.date.today(), "today") if recorded is None else (recorded, "the recording's day")
    left = state.days_left(on)
    if left is not None and left < 0:
        raise CalibrationError(
            f"{path}: calibration.valid_until: {state.valid_until} was {format_count(-left, 'day')}"
            f" before {on.isoformat()} ({what}): the calibration is out of date; calibrate again, or confirm it with"
            " `beampose calibrate check` and set a new date"
        )


# Tolerance of symmetry and of eigenvalues, relative to the diagonal: rounding of sums in double precision.
COVARIANCE_TOLERANCE = 1e-6


def _image_size(value: Any) -> list[int]:
    fields.numbers(2)(value)
    size = [fields.whole_number(v) for v in value]
    if min(size) < 1:
        raise fields.unexpected_value("a width and a height of at least 1 pixel", value)
    return size


def _distortion(value: Any) -> list[float]:
    words = "0, 4, 5, 8, 12 or 14 numbers"
    if not isinstance(value, list):
        raise fields.unexpected_value(f"a list of {words}", value)
    if len(value) not in lens.ALLOWED_LENGTHS:
        raise fields.field_error(f"expected {words}, got {len(value)}")
    return [fields.finite_number(v) for v in value]


def _parameter_names(value: Any) -> list[str]:
    if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
        raise fields.unexpected_value("a list of parameter names", value)
    return value


def _matrix(value: Any) -> list[list[float]]:
    if not isinstance(value, list) or not all(isinstance(row, list) and len(row) == len(value) for row in value):
        raise fields.unexpected_value("a square matrix, as a list of rows", value)
    return [[fields.finite_number(v) for v in row] for row in value]


class CovarianceBlock(fields.Block):
    """A covariance matrix and the ordered names of its parameters."""

    parameters: Annotated[list[str], pydantic.PlainValidator(_parameter_names)]
    matrix: Annotated[list[list[float]], pydantic.PlainValidator(_matrix)]

    @pydantic.model_validator(mode="after")
    def _same_size(self) -> CovarianceBlock:
        if len(self.matrix) != len(self.parameters):
            raise fields.field_error(
                f"expected a matrix row for each of {len(self.parameters)} parameters, got {len(self.matrix)}"
            )
        return self

    def check(self, known: Collection[str]) -> None:
        """Raises for a name that is not known or there twice, and for a matrix that is not a covariance."""
        for i, name in enumerate(self.parameters):
            if name not in known:
                raise fields.field_error(
                    f"covariance.parameters: unknown parameter {name!r}{suggest_name(name, known)}"
                )
            if name in self.parameters[:i]:
                raise fields.field_error(f"covariance.parameters: expected each name once, got {name!r} a second time")
        mistake = covariance_error(self.value())
        if mistake:
            raise fields.field_error(f"covariance.matrix: {mistake}")

    def value(self) -> RigCovariance:
        """The block as a value."""
        return RigCovariance(tuple(self.parameters), np.array(self.matrix, dtype=float).reshape(len(self.matrix), -1))


def covariance_error(covariance: RigCovariance) -> str:
    """The mistake of a matrix that is not a covariance, as text of a message; empty for a covariance."""
    C, names = covariance.matrix, covariance.names
    variances = np.diagonal(C)
    if not len(C):
        return ""
    if np.any(variances < 0):
        worst = int(np.argmin(variances))
        return f"expected variances of 0 or more on the diagonal, got {variances[worst]:.6g} for {names[worst]}"
    unit = np.sqrt(np.where(variances > 0, variances, 1.0))
    scaled = C / np.outer(unit, unit)
    apart = np.abs(scaled - scaled.T)
    if apart.max() > COVARIANCE_TOLERANCE:
        i, j = np.unravel_index(int(np.argmax(apart)), C.shape)
        return (
            f"expected a symmetric matrix, got {C[i, j]:.6g} for {names[i]}, {names[j]} and {C[j, i]:.6g}"
            f" for {names[j]}, {names[i]}"
        )
    if np.linalg.eigvalsh(symmetric(scaled))[0] < -COVARIANCE_TOLERANCE * len(C):
        return "expected a covariance, got a matrix with a negative eigenvalue: impossible correlations"
    return ""


class _MatrixBlock(fields.Block):
    fx: fields.Positive
    fy: fields.Positive
    cx: fields.Number
    cy: fields.Number


class LensBlock(fields.Block):
    """The lens of a camera: picture size, camera matrix, distortion and lens model."""

    image_size_px: Annotated[list[int], pydantic.PlainValidator(_image_size)]
    camera_matrix: _MatrixBlock
    distortion: Annotated[list[float], pydantic.PlainValidator(_distortion)] = []  # noqa: RUF012 - frozen
    lens: Annotated[str, pydantic.PlainValidator(fields.one_of(LENSES))] = PERSPECTIVE

    @pydantic.model_validator(mode="after")
    def _numbers_of_the_model(self) -> LensBlock:
        if self.lens == FISHEYE and len(self.distortion) not in (0, 4):
            raise fields.field_error(
                f"expected 4 distortion numbers (or none) for lens {FISHEYE!r}, got {len(self.distortion)}"
            )
        return self

    def size(self) -> tuple[int, int]:
        """Width and height, px."""
        return self.image_size_px[0], self.image_size_px[1]

    def matrix(self) -> Array:
        """The camera matrix (3, 3), px."""
        m = self.camera_matrix
        return np.array([[m.fx, 0, m.cx], [0, m.fy, m.cy], [0, 0, 1]])


def lens_mapping(camera: Camera) -> dict[str, Any]:
    """The plain mapping from which a `LensBlock` reads the same lens."""
    out: dict[str, Any] = {
        "image_size_px": [int(v) for v in camera.image_size_px],
        "camera_matrix": dict(zip(PINHOLE, map(float, pinhole_numbers(camera)), strict=True)),
        "distortion": [float(v) for v in camera.distortion],
    }
    if camera.lens != PERSPECTIVE:
        out["lens"] = camera.lens
    return out


def covariance_mapping(covariance: RigCovariance) -> dict[str, Any]:
    """The plain mapping from which a `CovarianceBlock` reads the same numbers."""
    return {"parameters": list(covariance.names), "matrix": [plain_floats(row) for row in covariance.matrix]}


def plain_floats(values: Array) -> list[float]:
    """Plain numbers for a file, without negative zeros."""
    return [float(v) + 0.0 for v in values]


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
        **lens_mapping(file.camera()),
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
        self.covariance.check(camera.parameter_names)
        return self
