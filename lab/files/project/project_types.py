"""The content of a calibration.yaml as values."""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from calibration.boards.board_types import Board
from geometry.arrays import Array
from geometry.pose import Pose
from geometry.rig import Beam, Spot
from lab.files.rig.camera_file import CameraFile


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
