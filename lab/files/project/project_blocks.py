"""The schema of a calibration.yaml: its fields, and the names that must exist in it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
import pydantic

from calibration.boards import board_types
from lab.files.project.project_types import ScreenFrame, Stand
from lab.files.rig.calibration_state import Day
from lab.files.rig.rig_file import PoseBlock, TargetBlock, unknown_name
from lab.files.text.fields import (
    Block,
    NonNegative,
    Number,
    Positive,
    Text,
    Vector3,
    Word,
    boolean,
    field_error,
    numbers,
    one_of,
    positive_numbers,
    printable_name,
    unexpected_value,
)

SCHEMA = "beampose/calibration/1"
BOW = ("auto", "always", "never")
CLOUD_UNITS: Mapping[str, float] = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254, "ft": 0.3048}


def _paths(value: Any) -> list[str]:
    values = [value] if isinstance(value, str) else value
    if not isinstance(values, list) or not all(isinstance(v, str) and v.strip() for v in values):
        raise unexpected_value("a file or a list of files", value)
    return values


def _board(value: Any) -> str:
    if not isinstance(value, str) or not value.strip():
        raise unexpected_value(f"a board such as {board_types.EXAMPLES['chessboard']}", value)
    return value


def _days(value: Any) -> int | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise unexpected_value("a whole number of days, 1 or more", value)
    return value


def _name(value: Any) -> str:
    text = printable_name(value)
    if any(c in text for c in "/\\"):
        raise unexpected_value("a name without / and \\", value)
    return text


_Name = Annotated[str, pydantic.PlainValidator(_name)]
_Paths = Annotated[list[str], pydantic.PlainValidator(_paths)]
_BoardText = Annotated[str, pydantic.PlainValidator(_board)]


class CameraBlock(Block):
    intrinsics: Word
    screen: Word
    camera: Word | None = None  # the camera, where the file has several
    near_m: Vector3 | None = None
    within_m: Positive = 0.5


class FixedBoardBlock(Block):
    board: _BoardText
    photos: dict[str, Word]
    offset_m: Number = 0.0
    sigma_m: Positive = 0.0002
    tilt_sigma_deg: Positive = 0.05


class CloudBlock(Block):
    file: Word
    also: list[Word] = []  # noqa: RUF012 - frozen
    unit: Annotated[str, pydantic.PlainValidator(one_of(tuple(CLOUD_UNITS)))] = "m"
    world_from_cloud: PoseBlock | None = None
    targets: Word | None = None
    point_sigma_m: Positive | None = None

    @pydantic.model_validator(mode="after")
    def _one_of_them(self) -> CloudBlock:
        if self.world_from_cloud is not None and self.targets is not None:
            raise field_error("expected world_from_cloud or targets, got both; keep one")
        return self


class FrameBlock(Block):
    origin: Word
    x: Word
    y: Word
    origin_at_m: Annotated[list[float], pydantic.PlainValidator(numbers(2))] = [0.0, 0.0]  # noqa: RUF012 - frozen

    def value(self) -> ScreenFrame:
        return ScreenFrame(self.origin, self.x, self.y, (self.origin_at_m[0], self.origin_at_m[1]))


class ScreenBlock(Block):
    size_m: Annotated[list[float] | None, pydantic.PlainValidator(positive_numbers(2))] = None
    frame: FrameBlock | None = None
    surface_sigma_m: Positive | None = None
    bow: Annotated[str, pydantic.PlainValidator(one_of(BOW))] = "auto"
    boards: list[FixedBoardBlock] = []  # noqa: RUF012 - frozen
    cloud: CloudBlock | None = None


class SharedBoardBlock(Block):
    board: _BoardText
    photos: dict[str, _Paths]


class StandBlock(Block):
    world_from_stand: PoseBlock | None = None
    sigma_m: NonNegative | None = None
    sigma_deg: NonNegative | None = None
    pose_sigma_m: NonNegative = 0.0
    pose_sigma_deg: NonNegative = 0.0

    @pydantic.model_validator(mode="after")
    def _known_or_not(self) -> StandBlock:
        if self.world_from_stand is None and (self.sigma_m is not None or self.sigma_deg is not None):
            raise field_error(
                "sigma_m, sigma_deg: expected world_from_stand with them, got none; add it or leave them out"
            )
        return self

    def value(self) -> Stand:
        known = self.world_from_stand is not None
        return Stand(
            world_from_stand=None if self.world_from_stand is None else self.world_from_stand.pose(),
            sigma_m=(self.sigma_m or 0.0) if known else np.inf,
            sigma_rad=float(np.radians(self.sigma_deg or 0.0)) if known else np.inf,
            pose_sigma_m=self.pose_sigma_m,
            pose_sigma_rad=float(np.radians(self.pose_sigma_deg)),
        )


class RecordingBlock(Block):
    run: Word | None = None
    spots: Word | None = None
    poses: Word | None = None
    use_truth: Annotated[bool, pydantic.PlainValidator(boolean)] = False

    @pydantic.model_validator(mode="after")
    def _one_of_them(self) -> RecordingBlock:
        if (self.run is None) == (self.spots is None):
            raise field_error(f"expected run or spots, got {'both; keep one' if self.run else 'neither'}")
        if self.use_truth and (self.run is None or self.poses is not None):
            raise field_error("use_truth: expected with a run and without poses: it means the run's own truth/pose.csv")
        return self


class ProjectBlock(Block):
    schema_: Annotated[str, pydantic.PlainValidator(one_of((SCHEMA,)))] = pydantic.Field(alias="schema")
    name: Annotated[str | None, pydantic.PlainValidator(lambda v: None if v is None else _name(v))] = None
    date: Day | None = None
    valid_days: Annotated[int | None, pydantic.PlainValidator(_days)] = None
    cameras: dict[_Name, CameraBlock] = {}  # noqa: RUF012 - frozen
    screens: dict[_Name, ScreenBlock] = {}  # noqa: RUF012 - frozen
    survey: _Paths = []  # noqa: RUF012 - frozen
    points: _Paths = []  # noqa: RUF012 - frozen
    boards: list[SharedBoardBlock] = []  # noqa: RUF012 - frozen
    world: Word | None = None
    target: TargetBlock | None = None
    stand: StandBlock | None = None
    recordings: list[RecordingBlock] = []  # noqa: RUF012 - frozen
    notes: Text = ""


def broken_references(content: ProjectBlock, lab_known: bool) -> list[str]:
    """Mistakes of names that do not exist in the file. lab_known: cameras and screens may be in a rig.yaml instead."""
    out: list[str] = []
    if not lab_known:
        empty = [what for what in ("cameras", "screens") if not getattr(content, what)]
        out = [
            f"{what}: expected one or more, got none; only `calibrate beams` takes them from a rig" for what in empty
        ]
    elsewhere = lab_known and not content.screens
    for name, camera in content.cameras.items():
        if camera.screen not in content.screens and not elsewhere:
            out.append(unknown_name("screen", camera.screen, f"cameras.{name}.screen", content.screens))
    places: list[tuple[str, Mapping[str, Any]]] = [
        (f"screens.{s}.boards.{i}.photos", b.photos)
        for s, block in content.screens.items()
        for i, b in enumerate(block.boards)
    ]
    places += [(f"boards.{i}.photos", b.photos) for i, b in enumerate(content.boards)]
    for where, photos in places:
        if not photos:
            out.append(f"{where}: expected a photograph per camera, got none")
        out += [unknown_name("camera", c, f"{where}.{c}", content.cameras) for c in photos if c not in content.cameras]
    if content.world is not None and content.world not in content.screens and not elsewhere:
        out.append(unknown_name("screen", content.world, "world", content.screens))
    if content.target is not None:  # `calibrate beams` checks the screens of the spots against the rig
        named = {s.screen for s in content.target.spots.values()} if elsewhere else content.screens
        out += content.target.mistakes(named)
    return out
