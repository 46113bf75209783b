"""calibration.yaml: what was measured to calibrate the screens, the cameras' places, the beams, and where that lies.

One file serves `calibrate screen`, `calibrate beams` and `calibrate rig`; each takes of it what it needs. Cameras and
screens (and the target, unless it is to start from another one) may be left out for `calibrate beams`, which takes them
from its rig.yaml. Paths start at the file's folder.
"""

from __future__ import annotations

import datetime
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pydantic

from calibration.boards import board_types as board_kinds
from calibration.boards.board_types import Board
from geometry.arrays import Array
from geometry.pose import Pose
from geometry.rig import Beam, Spot
from lab.errors import InputError
from lab.files.rig.board_file import load_board
from lab.files.rig.calibration_state import Day
from lab.files.rig.camera_file import CameraFile, load_camera
from lab.files.rig.interchange import read_cameras
from lab.files.rig.rig_file import PoseBlock, TargetBlock, no_such
from lab.files.text.error_text import FileError, did_you_mean
from lab.files.text.fields import (
    Block,
    FromZero,
    Number,
    Positive,
    Text,
    Vector3,
    Word,
    a_truth_value,
    a_word,
    numbers,
    one_of,
    positive_numbers,
    unexpected,
    validated,
    wrong,
)
from lab.files.text.yaml_text import read_mapping

SCHEMA = "beampose/calibration/1"
BOW = ("auto", "always", "never")
CLOUD_UNITS: Mapping[str, float] = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254, "ft": 0.3048}


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


def load_project(path: Path, lab_known: bool = False) -> Project:
    """Read and check a calibration.yaml and the lenses that it names; tables and photographs are not opened.

    path may be the folder of it. lab_known: cameras and screens come from a rig.yaml and may be left out.
    Raises InputError: file, field, what was expected and what was found.
    """
    path = Path(path)
    if path.is_dir():
        path = path / "calibration.yaml"
    content = validated(_ProjectBlock, read_mapping(path), path)
    mistakes: list[str] = []
    reader = _Reader(path.parent, content, mistakes)
    cameras = {name: reader.camera(name, block) for name, block in content.cameras.items()}
    project = Project(
        path=path,
        name=content.name or path.resolve().parent.name,
        date=content.date,
        valid_days=content.valid_days,
        cameras={name: c for name, c in cameras.items() if c is not None},
        screens={name: reader.screen(name, block) for name, block in content.screens.items()},
        survey=reader.files(content.survey, "survey"),
        points=reader.files(content.points, "points"),
        boards=tuple(reader.shared_board(b, f"boards.{i}") for i, b in enumerate(content.boards)),
        world=content.world,
        beams={} if content.target is None else content.target.beam_values(),
        spots={} if content.target is None else content.target.spot_values(),
        stand=None if content.stand is None else content.stand.value(),
        recordings=tuple(reader.recording(r, f"recordings.{i}") for i, r in enumerate(content.recordings)),
        notes=content.notes,
    )
    mistakes += _broken_references(content, lab_known)
    if mistakes:
        raise FileError(f"{path}: {m}" for m in mistakes)
    return project


# What the file may hold -----------------------------------------------------------------------------------------


def _paths(value: Any) -> list[str]:
    values = [value] if isinstance(value, str) else value
    if not isinstance(values, list) or not all(isinstance(v, str) and v.strip() for v in values):
        raise unexpected("a file or a list of files", value)
    return values


def _board(value: Any) -> str:
    if not isinstance(value, str) or not value.strip():
        raise unexpected(f"a board such as {board_kinds.EXAMPLES['chessboard']}", value)
    return value


def _days(value: Any) -> int | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise unexpected("a whole number of days, 1 or more", value)
    return value


def _name(value: Any) -> str:
    name = a_word(value)
    if any(c in name for c in "/\\") or not name.isprintable():
        raise unexpected("a name without / and \\", value)
    return name


_Name = Annotated[str, pydantic.PlainValidator(_name)]
_Paths = Annotated[list[str], pydantic.PlainValidator(_paths)]
_BoardText = Annotated[str, pydantic.PlainValidator(_board)]


class _CameraBlock(Block):
    intrinsics: Word
    screen: Word
    camera: Word | None = None  # which camera of a file that holds several
    near_m: Vector3 | None = None
    within_m: Positive = 0.5


class _FixedBoardBlock(Block):
    board: _BoardText
    photos: dict[str, Word]
    offset_m: Number = 0.0
    sigma_m: Positive = 0.0002
    tilt_sigma_deg: Positive = 0.05


class _CloudBlock(Block):
    file: Word
    unit: Annotated[str, pydantic.PlainValidator(one_of(tuple(CLOUD_UNITS)))] = "m"
    world_from_cloud: PoseBlock | None = None
    targets: Word | None = None
    point_sigma_m: Positive | None = None

    @pydantic.model_validator(mode="after")
    def _one_of_them(self) -> _CloudBlock:
        if self.world_from_cloud is not None and self.targets is not None:
            raise wrong("expected world_from_cloud or targets, got both; keep one")
        return self


class _FrameBlock(Block):
    origin: Word
    x: Word
    y: Word
    origin_at_m: Annotated[list[float], pydantic.PlainValidator(numbers(2))] = [0.0, 0.0]  # noqa: RUF012 - frozen

    def value(self) -> ScreenFrame:
        return ScreenFrame(self.origin, self.x, self.y, (self.origin_at_m[0], self.origin_at_m[1]))


class _ScreenBlock(Block):
    size_m: Annotated[list[float] | None, pydantic.PlainValidator(positive_numbers(2))] = None
    frame: _FrameBlock | None = None
    surface_sigma_m: Positive | None = None
    bow: Annotated[str, pydantic.PlainValidator(one_of(BOW))] = "auto"
    boards: list[_FixedBoardBlock] = []  # noqa: RUF012 - frozen
    cloud: _CloudBlock | None = None


class _SharedBoardBlock(Block):
    board: _BoardText
    photos: dict[str, _Paths]


class _StandBlock(Block):
    world_from_stand: PoseBlock | None = None
    sigma_m: FromZero | None = None
    sigma_deg: FromZero | None = None
    pose_sigma_m: FromZero = 0.0
    pose_sigma_deg: FromZero = 0.0

    @pydantic.model_validator(mode="after")
    def _known_or_not(self) -> _StandBlock:
        if self.world_from_stand is None and (self.sigma_m is not None or self.sigma_deg is not None):
            raise wrong("sigma_m, sigma_deg: expected world_from_stand with them, got none; add it or leave them out")
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


class _RecordingBlock(Block):
    run: Word | None = None
    spots: Word | None = None
    poses: Word | None = None
    use_truth: Annotated[bool, pydantic.PlainValidator(a_truth_value)] = False

    @pydantic.model_validator(mode="after")
    def _one_of_them(self) -> _RecordingBlock:
        if (self.run is None) == (self.spots is None):
            raise wrong(f"expected run or spots, got {'both; keep one' if self.run else 'neither'}")
        if self.use_truth and (self.run is None or self.poses is not None):
            raise wrong("use_truth: expected with a run and without poses: it means the run's own truth/pose.csv")
        return self


class _ProjectBlock(Block):
    schema_: Annotated[str, pydantic.PlainValidator(one_of((SCHEMA,)))] = pydantic.Field(alias="schema")
    name: Annotated[str | None, pydantic.PlainValidator(lambda v: None if v is None else _name(v))] = None
    date: Day | None = None
    valid_days: Annotated[int | None, pydantic.PlainValidator(_days)] = None
    cameras: dict[_Name, _CameraBlock] = {}  # noqa: RUF012 - frozen
    screens: dict[_Name, _ScreenBlock] = {}  # noqa: RUF012 - frozen
    survey: _Paths = []  # noqa: RUF012 - frozen
    points: _Paths = []  # noqa: RUF012 - frozen
    boards: list[_SharedBoardBlock] = []  # noqa: RUF012 - frozen
    world: Word | None = None
    target: TargetBlock | None = None
    stand: _StandBlock | None = None
    recordings: list[_RecordingBlock] = []  # noqa: RUF012 - frozen
    notes: Text = ""


def _broken_references(content: _ProjectBlock, lab_known: bool) -> list[str]:
    """Names that nothing in the file bears. lab_known: what is not in it may be in a rig.yaml."""
    out: list[str] = []
    if not lab_known:
        empty = [what for what in ("cameras", "screens") if not getattr(content, what)]
        out = [
            f"{what}: expected one or more, got none; only `calibrate beams` takes them from a rig" for what in empty
        ]
    elsewhere = lab_known and not content.screens
    for name, camera in content.cameras.items():
        if camera.screen not in content.screens and not elsewhere:
            out.append(no_such("screen", camera.screen, f"cameras.{name}.screen", content.screens))
    places: list[tuple[str, Mapping[str, Any]]] = [
        (f"screens.{s}.boards.{i}.photos", b.photos)
        for s, block in content.screens.items()
        for i, b in enumerate(block.boards)
    ]
    places += [(f"boards.{i}.photos", b.photos) for i, b in enumerate(content.boards)]
    for where, photos in places:
        if not photos:
            out.append(f"{where}: expected a photograph per camera, got none")
        out += [no_such("camera", c, f"{where}.{c}", content.cameras) for c in photos if c not in content.cameras]
    if content.world is not None and content.world not in content.screens and not elsewhere:
        out.append(no_such("screen", content.world, "world", content.screens))
    if content.target is not None:  # `calibrate beams` asks the rig for the spots' screens
        named = {s.screen for s in content.target.spots.values()} if elsewhere else content.screens
        out += content.target.mistakes(named)
    return out


# From the file to values ------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Reader:
    """Turns blocks into values, and notes what is wrong instead of stopping at the first."""

    folder: Path
    content: _ProjectBlock
    mistakes: list[str]

    def file(self, name: str, where: str) -> Path:
        path = self.folder / name
        if path.is_dir():
            self.mistakes.append(f"{where}: expected a file, found a folder at {path}; name a file in it")
        elif not path.is_file():
            near = did_you_mean(path.name, [p.name for p in path.parent.glob("*")] if path.parent.is_dir() else [])
            hint = near if "did you mean" in near else "; paths start at this file's folder"
            self.mistakes.append(f"{where}: expected a file, found none at {path}{hint}")
        return path

    def files(self, names: Sequence[str], where: str) -> tuple[Path, ...]:
        """Several files, or the only one, which messages name without a number."""
        return tuple(self.file(p, where if len(names) == 1 else f"{where}.{i}") for i, p in enumerate(names))

    def camera(self, name: str, block: _CameraBlock) -> CameraEntry | None:
        where = f"cameras.{name}.intrinsics"
        path = self.file(block.intrinsics, where)
        if not path.is_file():
            return None
        try:
            lens = lens_of(path, block.camera)
        except InputError as error:
            self.mistakes.append(f"{where}: {error}")
            return None
        near = None if block.near_m is None else np.array(block.near_m)
        return CameraEntry(name, block.screen, lens, path, near, block.within_m)

    def screen(self, name: str, block: _ScreenBlock) -> ScreenEntry:
        where = f"screens.{name}"
        boards = tuple(self._fixed_board(b, f"{where}.boards.{i}") for i, b in enumerate(block.boards))
        return ScreenEntry(
            name=name,
            size_m=None if block.size_m is None else (block.size_m[0], block.size_m[1]),
            frame=None if block.frame is None else block.frame.value(),
            surface_sigma_m=block.surface_sigma_m,
            bow=block.bow,
            boards=tuple(b for b in boards if b is not None),
            cloud=None if block.cloud is None else self._cloud(block.cloud, f"{where}.cloud"),
        )

    def _cloud(self, block: _CloudBlock, where: str) -> Cloud:
        return Cloud(
            path=self.file(block.file, f"{where}.file"),
            unit_m=CLOUD_UNITS[block.unit],
            world_from_cloud=None if block.world_from_cloud is None else block.world_from_cloud.pose(),
            targets=None if block.targets is None else self.file(block.targets, f"{where}.targets"),
            point_sigma_m=block.point_sigma_m,
        )

    def _fixed_board(self, block: _FixedBoardBlock, where: str) -> FixedBoard | None:
        board = self._board(block.board, where)
        photos = {c: self.file(p, f"{where}.photos.{c}") for c, p in block.photos.items()}
        if board is None:
            return None
        tilt = float(np.radians(block.tilt_sigma_deg))
        return FixedBoard(board, block.offset_m, block.sigma_m, tilt, photos)

    def shared_board(self, block: _SharedBoardBlock, where: str) -> SharedBoard:
        board = self._board(block.board, where)
        photos: dict[str, dict[str, Path]] = {}
        for camera, patterns in block.photos.items():
            for path in self._pictures(patterns, f"{where}.photos.{camera}"):
                of_camera = photos.setdefault(placement_of(path), {})
                if camera in of_camera:
                    self.mistakes.append(
                        f"{where}.photos.{camera}: expected one photograph per placement, got {of_camera[camera].name}"
                        f" and {path.name} for {placement_of(path)!r}; the number at the end of a name tells it"
                    )
                of_camera[camera] = path
        nothing = board_kinds.Chessboard(3, 3, 1.0)  # never used: a mistake has been noted
        return SharedBoard(nothing if board is None else board, dict(sorted(photos.items())))

    def _pictures(self, patterns: Sequence[str], where: str) -> list[Path]:
        out: list[Path] = []
        for pattern in patterns:
            if any(c in pattern for c in "*?["):
                found = sorted(self.folder.glob(pattern))
                if not found:
                    self.mistakes.append(f"{where}: expected photographs, found none for {pattern!r} in {self.folder}")
                out += found
            else:
                out.append(self.file(pattern, where))
        return out

    def _board(self, text: str, where: str) -> Board | None:
        if text.lower().endswith((".yaml", ".yml")):
            try:
                return load_board(self.folder / text)
            except InputError as error:
                self.mistakes.append(f"{where}.board: {error}")
                return None
        try:
            return board_kinds.parse(text)
        except ValueError as error:
            self.mistakes.append(f"{where}.board: {str(error).removeprefix(f'board {text!r}: ')}")
            return None

    def recording(self, block: _RecordingBlock, where: str) -> RecordingEntry:
        run = None if block.run is None else self.folder / block.run
        if run is not None and not (run / "run.yaml").is_file():
            self.mistakes.append(f"{where}.run: expected a run folder, found no run.yaml in {run}")
        poses = None if block.poses is None else self.file(block.poses, f"{where}.poses")
        if run is not None and block.use_truth:
            poses = self.file(str(Path(str(block.run)) / "truth" / "pose.csv"), f"{where}.use_truth")
        return RecordingEntry(run, None if block.spots is None else self.file(block.spots, f"{where}.spots"), poses)


def placement_of(photo: Path) -> str:
    """What tells that photographs of different cameras show a board in the same place: the last number of the name.

    left01.jpg and right01.jpg share placement 1; names without a number are compared whole.
    """
    numbers = re.findall(r"\d+", photo.stem)
    return str(int(numbers[-1])).zfill(6) if numbers else photo.stem


def lens_of(path: Path, name: str | None = None) -> CameraFile:
    """One camera's lens from our camera.yaml or any exchange format. Raises InputError.

    name: which one, where a file holds several.
    """
    cameras = read_cameras(path)
    if name is None and len(cameras) != 1:
        names = ", ".join(c.name for c in cameras)
        raise InputError(f"{path}: expected one camera, got {len(cameras)} ({names}); say which with `camera: NAME`")
    known = {c.name: c for c in cameras}
    if name is not None and name not in known:
        raise InputError(f"{path}: expected a camera of this file, got {name!r}{did_you_mean(name, known)}")
    model = cameras[0] if name is None else known[name]
    if len(cameras) == 1 and _is_ours(path):
        return load_camera(path)
    fx, fy, cx, cy = model.pinhole
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return CameraFile(model.name, model.image_size_px, matrix, model.distortion, model.lens)


def _is_ours(path: Path) -> bool:
    return re.search(r"^schema:\s*['\"]?beampose/camera/", path.read_text(encoding="utf-8"), re.MULTILINE) is not None
