"""Transforms, screens' corners and beams in YAML files, in each form in which they are measured.

A file is written with quaternions, and with directions and points; what was read in another form stands beside them as
a comment (`measured_forms`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any, ClassVar

import numpy as np
import pydantic
import yaml

from geometry.arrays import Array, cross, normalised
from geometry.pose import Pose, look_at
from geometry.rotations import matrix_from_ypr, nearest_rotation, quaternion_from_matrix
from lab.files.rig.camera_file import plain_floats
from lab.files.text.error_text import describe_value
from lab.files.text.fields import Block, Vector3, field_error, numbers, unexpected_value, vector3

QUATERNION_TOLERANCE = 1e-6  # deviation from length 1 of a quaternion written with seven digits
MATRIX_TOLERANCE = 1e-5  # deviation of R^T R from the identity, of a matrix written with six digits
MIN_LENGTH_M = 1e-6  # between two points that state a direction
MIN_SINE = 1e-3  # between two directions that state an orientation
# Deviation from 90 deg of an angle between measured corners. 5 mm on a side of 1 m make .3 deg; a wrong order of the
# corners, or a wrong corner, makes much more.
MAX_CORNER_DEVIATION_DEG = 2.0


def unit_quaternion(value: Any) -> list[float]:
    """Four numbers of length 1 within QUATERNION_TOLERANCE."""
    q = numbers(4)(value)
    length = float(np.linalg.norm(q))
    if abs(length - 1) > QUATERNION_TOLERANCE:
        raise field_error(
            f"expected a quaternion of length 1, got one of length {length:.7g}; divide its numbers by that"
        )
    return q


def rotation_rows(value: Any) -> list[list[float]]:
    """Three rows of three numbers that are a rotation within MATRIX_TOLERANCE."""
    if not isinstance(value, list) or len(value) != 3:
        raise unexpected_value("three rows of three numbers", value)
    rows = [numbers(3)(row) for row in value]
    R = np.array(rows)
    if np.abs(R.T @ R - np.eye(3)).max() > MATRIX_TOLERANCE:
        raise field_error("expected a rotation matrix; its rows are not perpendicular to each other and of length 1")
    if np.linalg.det(R) < 0:
        raise field_error("expected a rotation matrix, got a mirroring (determinant -1); change the sign of one axis")
    return rows


def nonzero_vector(value: Any) -> list[float]:
    """Three numbers that are not all zero."""
    d = numbers(3)(value)
    if np.linalg.norm(d) < 1e-9:
        raise unexpected_value("a direction, not the zero vector", value)
    return d


def _points(points: int) -> Callable[[Any], list[list[float]]]:

    def check(value: Any) -> list[list[float]]:
        if not isinstance(value, list) or len(value) != points:
            raise unexpected_value(f"a list of {points} points of three numbers each", value)
        return [vector3(point) for point in value]

    return check


class _Forms(Block):
    """A mapping that is written in one of several forms."""

    forms: ClassVar[tuple[str, ...]]  # keys, first that of the form in which files are written

    def form(self) -> str:
        """The key of the form that is used."""
        return next(name for name in self.forms if getattr(self, name) is not None)

    @pydantic.model_validator(mode="after")
    def _one_form(self) -> Any:
        used = [name for name in self.forms if getattr(self, name) is not None]
        words = ", ".join(self.forms[:-1]) + f" or {self.forms[-1]}"
        if not used:
            raise field_error(f"expected {words}, got none of them; add one")
        if len(used) > 1:
            raise field_error(f"expected one of {words}, got {' and '.join(used)}; keep one of them")
        self._check()
        return self

    def _check(self) -> None:
        """Raise a field error where the numbers of the form do not fit together."""

    def in_words(self) -> str | None:
        """The form as it stands in the file, on one line; None for the one in which files are written."""
        if self.form() == self.forms[0]:
            return None
        content = self.model_dump(exclude_unset=True)
        return yaml.safe_dump(content, default_flow_style=True, sort_keys=False, width=1_000_000).strip()


class PoseBlock(_Forms):
    """A transform a_from_b."""

    forms: ClassVar[tuple[str, ...]] = ("quaternion_wxyz", "rotation_matrix", "yaw_pitch_roll_deg")
    quaternion_wxyz: Annotated[list[float] | None, pydantic.PlainValidator(unit_quaternion)] = None
    rotation_matrix: Annotated[list[list[float]] | None, pydantic.PlainValidator(rotation_rows)] = None  # rows
    yaw_pitch_roll_deg: Vector3 | None = None  # R = Rz(yaw) Ry(pitch) Rx(roll)
    translation_m: Vector3 | None = None

    def _check(self) -> None:
        if (self.translation_m is None) == (self.form() in PoseBlock.forms):
            if self.translation_m is None:
                raise field_error(f"expected translation_m beside {self.form()}, got nothing; add it")
            raise field_error(f"expected no translation_m beside {self.form()}, which has the position; remove it")

    def pose(self) -> Pose:
        """The transform."""
        t = np.array(self.translation_m)
        if self.quaternion_wxyz is not None:
            return Pose.from_quaternion(np.array(self.quaternion_wxyz), t)
        if self.rotation_matrix is not None:
            return Pose(nearest_rotation(np.array(self.rotation_matrix)), t)
        return Pose(matrix_from_ypr(np.deg2rad(np.array(self.yaw_pitch_roll_deg))), t)


class _LookAtBlock(Block):
    eye_m: Vector3  # centre of projection, in world
    target_m: Vector3  # a point in the middle of the picture
    up: Annotated[list[float], pydantic.PlainValidator(nonzero_vector)] = [0.0, 0.0, 1.0]  # noqa: RUF012 - frozen


class CameraPoseBlock(PoseBlock):
    """The transform camera_from_world of a camera."""

    forms: ClassVar[tuple[str, ...]] = (*PoseBlock.forms, "look_at")
    look_at: _LookAtBlock | None = None  # where the camera is, and what is in the middle of its picture

    def _check(self) -> None:
        super()._check()
        if self.look_at is not None:
            along = np.subtract(self.look_at.target_m, self.look_at.eye_m)
            if np.linalg.norm(along) < MIN_LENGTH_M:
                raise field_error("look_at: expected two different points, got the same eye_m and target_m")
            up = self.look_at.up
            if np.linalg.norm(np.cross(along, up)) / (np.linalg.norm(along) * np.linalg.norm(up)) < MIN_SINE:
                raise field_error(
                    f"look_at.up: expected a direction that is not the line of sight, got"
                    f" {describe_value(self.look_at.up)}; name the direction that is up in the picture, such as"
                    " [1, 0, 0]"
                )

    def pose(self) -> Pose:
        """The transform."""
        if self.look_at is None:
            return super().pose()
        return look_at(np.array(self.look_at.eye_m), np.array(self.look_at.target_m), np.array(self.look_at.up))


class ScreenPoseBlock(PoseBlock):
    """The transform world_from_screen of a screen."""

    forms: ClassVar[tuple[str, ...]] = (*PoseBlock.forms, "corner_m")
    # Three corners in world: the one at -x -y of the screen, the next along x, the next along y. They are the ends of
    # the screen, which is centred on them.
    corner_m: Annotated[list[list[float]] | None, pydantic.PlainValidator(_points(3))] = None

    def _check(self) -> None:
        super()._check()
        if self.corner_m is None:
            return
        x, y = self._sides()
        if min(np.linalg.norm(x), np.linalg.norm(y)) < MIN_LENGTH_M:
            raise field_error("corner_m: expected three different corners, got two at the same place")
        off = abs(np.degrees(np.arccos(np.clip(x @ y / (np.linalg.norm(x) * np.linalg.norm(y)), -1, 1))) - 90)
        if off > MAX_CORNER_DEVIATION_DEG:
            raise field_error(
                f"corner_m: expected a right angle at the first corner, got {90 - off:.1f} or {90 + off:.1f} deg; the"
                " order is: a corner, the next one along the screen's x axis, the one along its y axis"
            )

    def _sides(self) -> tuple[Array, Array]:
        corner, along_x, along_y = np.array(self.corner_m)
        return along_x - corner, along_y - corner

    def size_m(self) -> tuple[float, float] | None:
        """Extent along x and y between measured corners; None in the other forms."""
        if self.corner_m is None:
            return None
        x, y = self._sides()
        return float(np.linalg.norm(x)), float(np.linalg.norm(y))

    def pose(self) -> Pose:
        """The transform. The error of the right angle is divided between both sides."""
        if self.corner_m is None:
            return super().pose()
        x, y = self._sides()
        axes = np.stack([normalised(x), normalised(y), normalised(cross(x, y))], axis=1)
        return Pose(nearest_rotation(axes), np.array(self.corner_m[0]) + (x + y) / 2)


class BeamBlock(_Forms):
    """A beam of the vehicle, in its body frame."""

    forms: ClassVar[tuple[str, ...]] = ("direction", "azimuth_elevation_deg", "points_m")
    direction: Annotated[list[float] | None, pydantic.PlainValidator(nonzero_vector)] = None
    # From the x axis towards y, and up from the x-y plane towards z.
    azimuth_elevation_deg: Annotated[list[float] | None, pydantic.PlainValidator(numbers(2))] = None
    # Two points of the beam; its + end lies beyond the second.
    points_m: Annotated[list[list[float]] | None, pydantic.PlainValidator(_points(2))] = None
    point_m: Vector3 | None = None

    def _check(self) -> None:
        if self.points_m is None and self.point_m is None:
            raise field_error(f"expected point_m beside {self.form()}, got nothing; add it")
        if self.points_m is not None and self.point_m is not None:
            raise field_error("expected no point_m beside points_m; remove it")
        if self.points_m is not None and np.linalg.norm(np.diff(self.points_m, axis=0)) < MIN_LENGTH_M:
            raise field_error("points_m: expected two different points, got the same point twice")

    def line(self) -> tuple[Array, Array]:
        """Direction (3,), of any length, and a point (3,), m."""
        if self.points_m is not None:
            first, second = np.array(self.points_m)
            return second - first, first
        if self.azimuth_elevation_deg is not None:
            azimuth, elevation = np.deg2rad(self.azimuth_elevation_deg)
            level = np.cos(elevation)
            along = np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
            return along, np.array(self.point_m)
        return np.array(self.direction), np.array(self.point_m)


def pose_mapping(pose: Pose) -> dict[str, Any]:
    """The plain mapping from which a `PoseBlock` reads the same transform, its rotation matrix to 4e-16."""
    return {
        "quaternion_wxyz": plain_floats(quaternion_from_matrix(pose.rotation)),
        "translation_m": plain_floats(pose.translation),
    }


def measured_forms(content: Block, where: str = "") -> Iterator[tuple[str, str]]:
    """Places in a file whose content is not in the form in which it is written, and their form on one line.

    A place is as screens.left.world_from_screen.
    """
    for name in type(content).model_fields:
        value = getattr(content, name)
        entries: Mapping[str, Any] = value if isinstance(value, dict) else {"": value}
        for key, entry in entries.items():
            place = ".".join(part for part in (where, name, key) if part)
            if isinstance(entry, _Forms):
                words = entry.in_words()
                if words is not None:
                    yield place, f"measured as {words}"
            elif isinstance(entry, Block):
                yield from measured_forms(entry, place)
