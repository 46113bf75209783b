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
    """A camera of the project: its lens, known already, and what is known of its place."""

    name: str
    screen: str  # that it observes
    lens: CameraFile
    lens_path: Path
    near_m: Array | None = None  # (3,), world: where it stands by tape measure
    within_m: float = 0.5  # how far from there it may be


@dataclass(frozen=True, slots=True)
class FixedBoard:
    """A board fixed to a screen, its printed side to the cameras."""

    board: Board
    offset_m: float  # from the printed side into the board to the receiving surface; negative: the surface is in front
    sigma_m: float  # of that
    tilt_sigma_rad: float  # how parallel board and surface are
    photos: Mapping[str, Path]  # camera -> its photograph of the board where it is fixed


@dataclass(frozen=True, slots=True)
class Cloud:
    """A scanned cloud of points of a screen and perhaps its surroundings."""

    path: Path
    unit_m: float  # metres in one unit of the file
    world_from_cloud: Pose | None  # None: to be found from the targets
    targets: Path | None  # points that scan and survey share: point,x_m,y_m,z_m in the cloud's frame
    point_sigma_m: float | None  # of one scanned point; None: as the cloud's own scatter says


@dataclass(frozen=True, slots=True)
class ScreenFrame:
    """Dots that fix a screen's frame: the origin is at one, x runs towards another, y to a third one's side."""

    origin: str
    x: str
    y: str
    origin_at_m: tuple[float, float] = (0.0, 0.0)  # where the first dot lies in the screen's frame


@dataclass(frozen=True, slots=True)
class ScreenEntry:
    """A screen of the project and what was measured on it, besides the dots of the survey."""

    name: str
    size_m: tuple[float, float] | None = None  # extent along x and y, about the origin
    frame: ScreenFrame | None = None  # None: from the dots' own extent, see calibration/screens/screen_frame.py
    surface_sigma_m: float | None = None  # how far the surface may lie off its shape; None: as the survey shows
    bow: str = "auto"  # of BOW: whether the surface is described as bent
    boards: tuple[FixedBoard, ...] = ()
    cloud: Cloud | None = None


@dataclass(frozen=True, slots=True)
class SharedBoard:
    """A board that was carried about, photographed by several cameras at once."""

    board: Board
    photos: Mapping[str, Mapping[str, Path]]  # placement -> camera -> photograph


@dataclass(frozen=True, slots=True)
class Stand:
    """The turntable or stand that carries the vehicle."""

    world_from_stand: Pose | None  # None: unknown
    sigma_m: float  # of its position along each axis of world; inf where unknown
    sigma_rad: float  # of its attitude about each axis
    pose_sigma_m: float  # of each stand_from_body where the table of poses gives none
    pose_sigma_rad: float


@dataclass(frozen=True, slots=True)
class RecordingEntry:
    """Spots recorded while the stand stood at (or passed) known poses."""

    run: Path | None  # a run folder …
    spots: Path | None  # … or a spots.csv
    poses: Path | None  # stand_from_body by frame: columns of truth/pose.csv and perhaps sigmas; None: unknown


@dataclass(frozen=True, slots=True)
class Project:
    """What a calibration.yaml holds."""

    path: Path
    name: str
    date: datetime.date | None  # of the measurements; None: today
    valid_days: int | None  # None: for ever
    cameras: Mapping[str, CameraEntry]
    screens: Mapping[str, ScreenEntry]
    survey: tuple[Path, ...]  # point,x_m,y_m,z_m[,sigma_x_m,sigma_y_m,sigma_z_m][,screen]
    points: tuple[Path, ...]  # camera,point,u_px,v_px[,sigma_px]
    boards: tuple[SharedBoard, ...]
    world: str | None  # the screen whose frame is the world; None: the survey's frame is
    beams: Mapping[str, Beam] = field(default_factory=dict)  # as designed: where the calibration starts
    spots: Mapping[str, Spot] = field(default_factory=dict)
    stand: Stand | None = None
    recordings: tuple[RecordingEntry, ...] = ()
    notes: str = ""

    @property
    def inputs(self) -> tuple[Path, ...]:
        """All files that the project names, itself first; run folders count by their run.yaml."""
        out = [self.path, *(c.lens_path for c in self.cameras.values()), *self.survey, *self.points]
        for s in self.screens.values():
            out += [p for b in s.boards for p in b.photos.values()]
            out += [p for p in (s.cloud.path, s.cloud.targets) if p] if s.cloud else []
        out += [p for b in self.boards for of_camera in b.photos.values() for p in of_camera.values()]
        for r in self.recordings:
            out += [p for p in (r.run / "run.yaml" if r.run else None, r.spots, r.poses) if p]
        return tuple(dict.fromkeys(out))
