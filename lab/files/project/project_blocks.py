"""The blocks of a calibration.yaml, and their content as values."""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pydantic

from calibration.boards import board_types
from calibration.boards.board_types import Board
from geometry.arrays import Array
from geometry.pose import Pose
from geometry.rig import Beam, Spot
from lab.files.rig.calibration_state import Day
from lab.files.rig.camera_file import CameraFile
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

# The content of a calibration.yaml as values.


@dataclass(frozen=True, slots=True)
class CameraEntry:
    """A camera of the project: its calibrated lens, and its approximate position."""

    name: str
    screen: str  # the screen that it observes
    lens: CameraFile
    lens_path: Path
    near_m: Array | None = None  # (3,), in world: position by tape measure
    within_m: float = 0.5  # largest distance from near_m


@dataclass(frozen=True, slots=True)
class FixedBoard:
    """A board fixed to a screen, printed side towards the cameras."""

    board: Board
    offset_m: float  # from the printed side into the board to the receiving surface; negative: the surface is in front
    sigma_m: float  # of offset_m
    tilt_sigma_rad: float  # of the angle between board and surface
    photos: Mapping[str, Path]  # camera -> photograph of the fixed board


@dataclass(frozen=True, slots=True)
class Cloud:
    """A scanned point cloud of a screen, possibly with its surroundings."""

    path: Path
    unit_m: float  # metres in one unit of the file
    world_from_cloud: Pose | None  # None: determined from the targets
    targets: Path | None  # points in both scan and survey: point,x_m,y_m,z_m in the cloud's frame
    point_sigma_m: float | None  # of one scanned point; None: from the scatter of the cloud
    also: tuple[Path, ...] = ()  # further scans in the same unit, aligned with the first by what they share


@dataclass(frozen=True, slots=True)
class ScreenFrame:
    """Dots that define the frame of a screen: origin, a dot on the x axis, and a dot on the side of positive y."""

    origin: str
    x: str
    y: str
    origin_at_m: tuple[float, float] = (0.0, 0.0)  # position of the dot `origin` in the screen's frame


@dataclass(frozen=True, slots=True)
class ScreenEntry:
    """A screen of the project and its measurements, except the dots of the survey."""

    name: str
    size_m: tuple[float, float] | None = None  # extent along x and y, about the origin
    frame: ScreenFrame | None = None  # None: from the extent of the dots, see calibration/screens/screen_frame.py
    surface_sigma_m: float | None = None  # deviation of the surface from its shape; None: from the survey
    bow: str = "auto"  # one of BOW: whether the surface is modelled as curved
    boards: tuple[FixedBoard, ...] = ()
    cloud: Cloud | None = None


@dataclass(frozen=True, slots=True)
class SharedBoard:
    """A board in several placements, each photographed by several cameras at once."""

    board: Board
    photos: Mapping[str, Mapping[str, Path]]  # placement -> camera -> photograph


@dataclass(frozen=True, slots=True)
class Stand:
    """The turntable or stand that carries the vehicle."""

    world_from_stand: Pose | None  # None: unknown
    sigma_m: float  # of its position, each axis of world; inf where unknown
    sigma_rad: float  # of its attitude, each axis; inf where unknown
    pose_sigma_m: float  # of stand_from_body, where the table of poses has no sigma
    pose_sigma_rad: float


@dataclass(frozen=True, slots=True)
class RecordingEntry:
    """Spots recorded at poses of the stand, static or moving."""

    run: Path | None  # a run folder, or ...
    spots: Path | None  # ... a spots.csv
    poses: Path | None  # stand_from_body by frame: columns of truth/pose.csv, optionally sigmas; None: unknown


@dataclass(frozen=True, slots=True)
class Project:
    """The content of a calibration.yaml."""

    path: Path
    name: str
    date: datetime.date | None  # of the measurements; None: today
    valid_days: int | None  # None: no limit
    cameras: Mapping[str, CameraEntry]
    screens: Mapping[str, ScreenEntry]
    survey: tuple[Path, ...]  # point,x_m,y_m,z_m[,sigma_x_m,sigma_y_m,sigma_z_m][,screen]
    points: tuple[Path, ...]  # camera,point,u_px,v_px[,sigma_px]
    boards: tuple[SharedBoard, ...]
    world: str | None  # the screen whose frame is the world frame; None: the frame of the survey
    beams: Mapping[str, Beam] = field(default_factory=dict)  # as designed: start values of the calibration
    spots: Mapping[str, Spot] = field(default_factory=dict)
    stand: Stand | None = None
    recordings: tuple[RecordingEntry, ...] = ()
    notes: str = ""

    @property
    def inputs(self) -> tuple[Path, ...]:
        """The project file and all files that it names; of a run folder its run.yaml."""
        out = [self.path, *(c.lens_path for c in self.cameras.values()), *self.survey, *self.points]
        for s in self.screens.values():
            out += [p for b in s.boards for p in b.photos.values()]
            out += [p for p in (s.cloud.path, *s.cloud.also, s.cloud.targets) if p] if s.cloud else []
        out += [p for b in self.boards for of_camera in b.photos.values() for p in of_camera.values()]
        for r in self.recordings:
            out += [p for p in (r.run / "run.yaml" if r.run else None, r.spots, r.poses) if p]
        return tuple(dict.fromkeys(out))


# The schema of a calibration.yaml: its fields, and the names that must exist in it.


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
