"""Blocks that rig.yaml and camera.yaml share: the lens of a camera, and covariances."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import pydantic

from geometry import lens
from geometry.arrays import Array, symmetric
from geometry.camera import FISHEYE, LENSES, PERSPECTIVE
from geometry.uncertainty.rig_uncertainty import RigCovariance
from lab.files.text import fields

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


def lens_mapping(
    image_size_px: tuple[int, int], matrix: Array, distortion: tuple[float, ...], lens_name: str
) -> dict[str, Any]:
    """The plain mapping from which a `LensBlock` reads the same numbers. matrix (3, 3), px."""
    out: dict[str, Any] = {
        "image_size_px": [int(v) for v in image_size_px],
        "camera_matrix": {
            "fx": float(matrix[0, 0]),
            "fy": float(matrix[1, 1]),
            "cx": float(matrix[0, 2]),
            "cy": float(matrix[1, 2]),
        },
        "distortion": [float(v) for v in distortion],
    }
    if lens_name != PERSPECTIVE:
        out["lens"] = lens_name
    return out


def covariance_mapping(covariance: RigCovariance) -> dict[str, Any]:
    """The plain mapping from which a `CovarianceBlock` reads the same numbers."""
    return {
        "parameters": list(covariance.names),
        "matrix": [plain_floats(row) for row in covariance.matrix],
    }


def plain_floats(values: Array) -> list[float]:
    """Plain numbers for a file, without negative zeros."""
    return [float(v) + 0.0 for v in values]
