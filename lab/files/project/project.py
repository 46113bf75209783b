"""calibration.yaml: the measurements for calibrating screens, camera poses and beams, and where their files are.

`calibrate screen`, `calibrate beams` and `calibrate rig` share this file; each uses the parts that it needs. For
`calibrate beams` the cameras and screens may be left out, since its rig.yaml has them; so may the target, unless the
calibration is to start from another one. Paths are relative to the folder of the file.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pydantic

from calibration.boards import board_types
from calibration.boards.board_types import Board
from geometry.rig import Beam, Spot
from lab.errors import InputError
from lab.files.rig.board_file import load_board
from lab.files.rig.camera_file import CameraFile, Day, load_camera
from lab.files.rig.interchange import read_cameras
from lab.files.rig.pose_block import PoseBlock
from lab.files.rig.rig_file import TargetBlock, unknown_name
from lab.files.text import fields
from lab.files.text.error_text import FileError, name_of_path, suggest_name
from lab.files.text.json_text import text_of_file
from lab.files.text.yaml_text import read_mapping

SCHEMA = "beampose/calibration/1"
BOW = ("auto", "always", "never")
CLOUD_UNITS: Mapping[str, float] = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254, "ft": 0.3048}


def load_project(path: Path, lab_known: bool = False) -> Project:
    """Read and check a calibration.yaml and the lenses that it names; tables and photographs are not opened.

    path: the file or its folder. lab_known: cameras and screens come from a rig.yaml and may be left out. Raises
    InputError: with file, field, what was expected and what was found; FileError for several mistakes.
    """
    path = Path(path)
    if path.is_dir():
        if not (path / "calibration.yaml").exists():
            raise InputError(
                f"{path}: expected a folder with a calibration.yaml, found none in it; `beampose calibrate simulate`"
                " writes an example"
            )
        path = path / "calibration.yaml"
    content = read_mapping(path)
    # Without a folder, files are not looked for: the form of the file and the names in it are reported beside them.
    form, mistakes = fields.mistakes_in(Project, content, path)
    project, with_files = fields.mistakes_in(Project, content, path, folder=path.parent)
    mistakes += [m for m in with_files if m not in mistakes]
    if form is not None:
        mistakes += [f"{path}: {m}" for m in _broken_references(form, lab_known)]
    if project is None or mistakes:
        raise FileError(mistakes)
    project._place = path
    return project


# Fields of the file. The validation's context is the folder of the file; without one, files are not looked for. -----


def _file(value: Any, info: pydantic.ValidationInfo) -> Path:
    name = fields.word(value)
    if info.context is None:
        return Path(name)
    path: Path = info.context / name
    if path.is_dir():
        raise fields.field_error(f"expected a file, found a folder at {path}; name a file in it")
    if not path.is_file():
        near = suggest_name(path.name, [p.name for p in path.parent.glob("*")] if path.parent.is_dir() else [])
        hint = near if "did you mean" in near else "; paths start at this file's folder"
        raise fields.field_error(f"expected a file, found none at {path}{hint}")
    return path


_File = Annotated[Path, pydantic.PlainValidator(_file)]
_SEVERAL = pydantic.TypeAdapter(tuple[_File, ...])


def _paths(value: Any, info: pydantic.ValidationInfo) -> tuple[Path, ...]:
    """A file or a list of files. In messages they are numbered, unless there is only one."""
    names = _names(value)
    return (_file(names[0], info),) if len(names) == 1 else _SEVERAL.validate_python(names, context=info.context)


def _names(value: Any) -> list[str]:
    values = [value] if isinstance(value, str) else value
    if not isinstance(values, list) or not all(isinstance(v, str) and v.strip() for v in values):
        raise fields.unexpected_value("a file or a list of files", value)
    return values


def _patterns(value: Any, info: pydantic.ValidationInfo) -> tuple[Path, ...]:
    """Files, or patterns of files such as boards/left*.png."""
    out: list[Path] = []
    for name in _names(value):
        if info.context is None or not any(c in name for c in "*?["):
            out.append(_file(name, info))
            continue
        found = sorted(info.context.glob(name))
        if not found:
            raise fields.field_error(f"expected photographs, found none for {name!r} in {info.context}")
        out += found
    return tuple(out)


def _board(value: Any, info: pydantic.ValidationInfo) -> Board:
    """A board.yaml, or a text such as chessboard:9x6:25mm."""
    if not isinstance(value, str) or not value.strip():
        raise fields.unexpected_value(f"a board such as {board_types.EXAMPLES['chessboard']}", value)
    try:
        if not value.lower().endswith((".yaml", ".yml")):
            return board_types.parse(value)
        if info.context is None:
            return board_types.Chessboard(3, 3, 1.0)  # not used
        return load_board(info.context / value)
    except InputError as error:
        raise fields.field_error(str(error)) from None
    except ValueError as error:
        raise fields.field_error(str(error).removeprefix(f"board {value!r}: ")) from None


def _run_folder(value: Any, info: pydantic.ValidationInfo) -> Path:
    path: Path = (info.context or Path()) / fields.word(value)
    if info.context is not None and not (path / "run.yaml").is_file():
        raise fields.field_error(f"expected a run folder, found no run.yaml in {path}")
    return path


def _days(value: Any) -> int | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise fields.unexpected_value("a whole number of days, 1 or more", value)
    return value


def _name(value: Any) -> str:
    text = fields.printable_name(value)
    if any(c in text for c in "/\\"):
        raise fields.unexpected_value("a name without / and \\", value)
    return text


_Name = Annotated[str, pydantic.PlainValidator(_name)]
_Files = Annotated[tuple[Path, ...], pydantic.PlainValidator(_paths)]
_Photos = Annotated[tuple[Path, ...], pydantic.PlainValidator(_patterns)]
_BoardText = Annotated[Board, pydantic.PlainValidator(_board)]


_Sigma = fields.Positive | None
_Two = Annotated[tuple[float, float], pydantic.PlainValidator(fields.numbers(2)), pydantic.AfterValidator(tuple)]
_Bow = Annotated[str, pydantic.PlainValidator(fields.one_of(BOW))]


class ProjectCamera(fields.Block):
    """A camera of the project: its calibrated lens, and its approximate position."""

    lens_path: _File = pydantic.Field(alias="intrinsics")
    screen: fields.Word  # the screen that it observes
    camera: fields.Word | None = None  # the camera, where the file has several
    near_m: fields.Vector3 | None = None  # in world: position by tape measure
    within_m: fields.Positive = 0.5  # largest distance from near_m
    _lens: CameraFile = pydantic.PrivateAttr()

    @pydantic.model_validator(mode="after")
    def _read_lens(self, info: pydantic.ValidationInfo) -> ProjectCamera:
        if info.context is not None:
            try:
                self._lens = load_lens(self.lens_path, self.camera)
            except InputError as error:
                raise fields.field_error(f"intrinsics: {error}") from None
        return self

    @property
    def lens(self) -> CameraFile:
        """The lens in the file."""
        return self._lens


class FixedBoard(fields.Block):
    """A board fixed to a screen, printed side towards the cameras."""

    board: _BoardText
    photos: dict[str, _File]  # photograph of the fixed board by camera
    offset_m: fields.Number = 0.0  # from the printed side into the board to the receiving surface; negative: before it
    sigma_m: fields.Positive = 0.0002  # of offset_m
    tilt_sigma_deg: fields.Positive = 0.05  # of the angle between board and surface

    @property
    def tilt_sigma_rad(self) -> float:
        """Sigma of the angle between board and surface."""
        return float(np.radians(self.tilt_sigma_deg))


class Cloud(fields.Block):
    """A scanned point cloud of a screen, possibly with its surroundings."""

    path: _File = pydantic.Field(alias="file")
    also: list[_File] = []  # noqa: RUF012 - frozen  # further scans in the same unit, aligned by what they share
    unit: Annotated[str, pydantic.PlainValidator(fields.one_of(tuple(CLOUD_UNITS)))] = "m"
    world_from_cloud: PoseBlock | None = None  # without it, from the targets
    targets: _File | None = None  # points in both scan and survey: point,x_m,y_m,z_m in the cloud's frame
    point_sigma_m: fields.Positive | None = None  # of one scanned point; without it, from the scatter of the cloud

    @pydantic.model_validator(mode="after")
    def _one_of_them(self) -> Cloud:
        if self.world_from_cloud is not None and self.targets is not None:
            raise fields.field_error("expected world_from_cloud or targets, got both; keep one")
        return self

    @property
    def unit_m(self) -> float:
        """Metres in one unit of the file."""
        return CLOUD_UNITS[self.unit]


class ScreenFrame(fields.Block):
    """Dots that define the frame of a screen: origin, a dot on the x axis, and a dot on the side of positive y."""

    origin: fields.Word
    x: fields.Word
    y: fields.Word
    origin_at_m: _Two = (0.0, 0.0)  # position of the dot `origin` in the screen's frame


class ProjectScreen(fields.Block):
    """A screen of the project and its measurements, except the dots of the survey."""

    size_m: Annotated[
        tuple[float, float] | None, pydantic.PlainValidator(fields.positive_numbers(2)), pydantic.AfterValidator(tuple)
    ] = None  # extent along x and y, about the origin
    frame: ScreenFrame | None = None  # without it, from the extent of the dots
    surface_sigma_m: _Sigma = None  # deviation of the surface from its shape; without it, from the survey
    bow: _Bow = "auto"  # whether the surface is modelled as curved
    boards: list[FixedBoard] = []  # noqa: RUF012 - frozen
    cloud: Cloud | None = None


class SharedBoard(fields.Block):
    """A board in several placements, each photographed by several cameras at once."""

    board: _BoardText
    photos: dict[str, _Photos]  # by camera

    @pydantic.model_validator(mode="after")
    def _one_photograph_per_placement(self) -> SharedBoard:
        for camera, photos in self.photos.items():
            seen: dict[str, Path] = {}
            for path in photos:
                first = seen.setdefault(placement_of(path), path)
                if first is not path:
                    raise fields.field_error(
                        f"photos.{camera}: expected one photograph per placement, got {first.name} and {path.name} for"
                        f" {placement_of(path)!r}; the last number of a name is the placement"
                    )
        return self

    @property
    def placements(self) -> Mapping[str, Mapping[str, Path]]:
        """The photograph of each camera, by placement."""
        out: dict[str, dict[str, Path]] = {}
        for camera, photos in self.photos.items():
            for path in photos:
                out.setdefault(placement_of(path), {})[camera] = path
        return dict(sorted(out.items()))


class Stand(fields.Block):
    """The turntable or stand that carries the vehicle."""

    world_from_stand: PoseBlock | None = None  # without it, unknown
    position_sigma_m: fields.NonNegative | None = pydantic.Field(None, alias="sigma_m")  # each axis of world
    attitude_sigma_deg: fields.NonNegative | None = pydantic.Field(None, alias="sigma_deg")  # each axis
    pose_sigma_m: fields.NonNegative = 0.0  # of the stand's poses, where their table has no sigma
    pose_sigma_deg: fields.NonNegative = 0.0

    @pydantic.model_validator(mode="after")
    def _known_or_not(self) -> Stand:
        sigmas = self.position_sigma_m, self.attitude_sigma_deg
        if self.world_from_stand is None and sigmas != (None, None):
            raise fields.field_error(
                "sigma_m, sigma_deg: expected world_from_stand with them, got none; add it or leave them out"
            )
        return self

    @property
    def sigma_m(self) -> float:
        """Sigma of its position; 0 where none is stated."""
        return self.position_sigma_m or 0.0

    @property
    def sigma_rad(self) -> float:
        """Sigma of its attitude; 0 where none is stated."""
        return float(np.radians(self.attitude_sigma_deg or 0.0))


class ProjectRecording(fields.Block):
    """Spots recorded at poses of the stand, static or moving."""

    run: Annotated[Path | None, pydantic.PlainValidator(_run_folder)] = None  # a run folder, or ...
    spots: _File | None = None  # ... a spots.csv
    stated_poses: _File | None = pydantic.Field(None, alias="poses")  # columns of truth/pose.csv, optionally sigmas
    use_truth: Annotated[bool, pydantic.PlainValidator(fields.boolean)] = False  # the run's own truth/pose.csv

    @pydantic.model_validator(mode="after")
    def _one_of_them(self, info: pydantic.ValidationInfo) -> ProjectRecording:
        if (self.run is None) == (self.spots is None):
            raise fields.field_error(f"expected run or spots, got {'both; keep one' if self.run else 'neither'}")
        if self.use_truth and (self.run is None or self.stated_poses is not None):
            raise fields.field_error(
                "use_truth: expected with a run and without poses: it means the run's own truth/pose.csv"
            )
        if self.use_truth and info.context is not None and not (self.poses or Path()).is_file():
            raise fields.field_error(f"use_truth: expected a file, found none at {self.poses}")
        return self

    @property
    def poses(self) -> Path | None:
        """The stand's poses by frame; None: unknown."""
        return self.run / "truth" / "pose.csv" if self.use_truth and self.run else self.stated_poses


class Project(fields.Block):
    """The content of a calibration.yaml."""

    schema_: Annotated[str, pydantic.PlainValidator(fields.one_of((SCHEMA,)))] = pydantic.Field(alias="schema")
    stated_name: Annotated[str | None, pydantic.PlainValidator(lambda v: None if v is None else _name(v))] = (
        pydantic.Field(None, alias="name")
    )
    date: Day | None = None  # of the measurements; without it, today
    valid_days: Annotated[int | None, pydantic.PlainValidator(_days)] = None  # without it, no limit
    cameras: dict[_Name, ProjectCamera] = {}  # noqa: RUF012 - frozen
    screens: dict[_Name, ProjectScreen] = {}  # noqa: RUF012 - frozen
    survey: _Files = ()  # point,x_m,y_m,z_m[,sigma_x_m,sigma_y_m,sigma_z_m][,screen]
    points: _Files = ()  # camera,point,u_px,v_px[,sigma_px]
    boards: list[SharedBoard] = []  # noqa: RUF012 - frozen
    world: fields.Word | None = None  # the screen whose frame is the world frame; without it, the frame of the survey
    target: TargetBlock | None = None  # as designed: start values of the calibration
    stand: Stand | None = None
    recordings: list[ProjectRecording] = []  # noqa: RUF012 - frozen
    notes: fields.Text = ""
    _place: Path = pydantic.PrivateAttr(Path("calibration.yaml"))

    @property
    def path(self) -> Path:
        """The file."""
        return self._place

    @property
    def name(self) -> str:
        """The stated name, or that of the folder."""
        return self.stated_name or name_of_path(self.path.resolve().parent)

    @property
    def beams(self) -> Mapping[str, Beam]:
        """The beams as designed."""
        return {} if self.target is None else self.target.beam_values()

    @property
    def spots(self) -> Mapping[str, Spot]:
        """The spots as designed."""
        return {} if self.target is None else self.target.spot_values()

    @property
    def inputs(self) -> tuple[Path, ...]:
        """The project file and all files that it names; of a run folder its run.yaml."""
        out = [self.path, *(c.lens_path for c in self.cameras.values()), *self.survey, *self.points]
        for s in self.screens.values():
            out += [p for b in s.boards for p in b.photos.values()]
            out += [p for p in (s.cloud.path, *s.cloud.also, s.cloud.targets) if p] if s.cloud else []
        out += [p for b in self.boards for photos in b.photos.values() for p in photos]
        for r in self.recordings:
            out += [p for p in (r.run / "run.yaml" if r.run else None, r.spots, r.poses) if p]
        return tuple(dict.fromkeys(out))


def _broken_references(content: Project, lab_known: bool) -> list[str]:
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


def placement_of(photo: Path) -> str:
    """The placement of the board in a photograph: the last number of its name, or the name if it has no number.

    left01.jpg and right01.jpg show placement 1.
    """
    numbers = re.findall(r"\d+", photo.stem)
    return str(int(numbers[-1])).zfill(6) if numbers else photo.stem


def load_lens(path: Path, name: str | None = None) -> CameraFile:
    """The lens of one camera from a camera.yaml or any exchange format. Raises InputError.

    name: the camera, where the file has several.
    """
    cameras = read_cameras(path)
    if name is None and len(cameras) != 1:
        names = ", ".join(c.name for c in cameras)
        raise InputError(f"{path}: expected one camera, got {len(cameras)} ({names}); choose one with `camera: NAME`")
    known = {c.name: c for c in cameras}
    if name is not None and name not in known:
        raise InputError(f"{path}: expected a camera of this file, got {name!r}{suggest_name(name, known)}")
    model = cameras[0] if name is None else known[name]
    own = re.search(r"^schema:\s*['\"]?beampose/camera/", text_of_file(path), re.MULTILINE)
    if len(cameras) == 1 and own is not None:
        return load_camera(path)
    return CameraFile(model.name, model.image_size_px, model.matrix, model.distortion, model.lens)
