"""A run folder: run.yaml, and the location of its pictures or detected points."""

from __future__ import annotations

import dataclasses
import datetime
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pydantic

from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import RigCovariance
from lab.errors import InputError
from lab.files.rig.camera_file import CalibrationState, OptionalDay
from lab.files.rig.rig_file import joint_covariance, load_rig_file
from lab.files.run.clocks import ESTIMATE, CameraClock, Times, clocks_in, load_clock, load_times
from lab.files.text import fields
from lab.files.text.dataclass_fields import dataclass_from_yaml
from lab.files.text.error_text import FileError, name_of_path, suggest_name
from lab.files.text.json_text import read_json
from lab.files.text.yaml_text import read_mapping, write_mapping
from lab.pictures.picture_file import PICTURE_SUFFIXES
from tracking.parameters import TrackerParameters

SCHEMA = "beampose/run/1"
LONGEST_EXPOSURE = 1.05  # of the time between two frames; above 1 for a rounded frame rate
RATE_RANGE_HZ = (1e-6, 1e7)  # a picture in 12 days; the fastest cameras


@dataclass(frozen=True, slots=True)
class FramesFolder:
    """A folder of pictures; the number in the name of a picture is its frame number."""

    path: Path


@dataclass(frozen=True, slots=True)
class VideoFile:
    """A video; frame n is its n-th picture, from 0."""

    path: Path


@dataclass(frozen=True, slots=True)
class DetectionsTable:
    """A detections.csv: points detected earlier."""

    path: Path


@dataclass(frozen=True, slots=True)
class LiveDevice:
    """A camera that OpenCV opens, for `beampose watch`. Frames count from 0 at the frame rate of run.yaml."""

    device: int | str  # its number, or a name such as /dev/video0 or an address of a stream

    @property
    def path(self) -> Path:
        """The name in messages."""
        return Path(f"device {self.device}")


RecordedSource = FramesFolder | VideoFile | DetectionsTable
Source = RecordedSource | LiveDevice


@dataclass(frozen=True, slots=True)
class Run:
    """One recording, before its pictures are opened."""

    folder: Path
    name: str
    rig: Rig  # with the cameras of this run only
    rig_path: Path
    frame_rate_hz: float
    exposure_s: float | None
    times: Times
    times_path: Path | None  # the timestamps file, where the run has one
    cameras: Mapping[str, Source]  # in the rig's order
    left_out: tuple[str, ...]  # cameras of the rig that this run does not have
    prior: PosePrior | None  # pose of the vehicle in the first frame
    tracker: TrackerParameters
    notes: str
    covariance: RigCovariance | None = None  # of the rig's calibration
    calibration: CalibrationState | None = None  # date and verdict
    recorded: datetime.date | None = None  # the day of the recording
    # Of cameras that have one of their own, with what the rig states of it.
    clocks: Mapping[str, CameraClock] = dataclasses.field(default_factory=dict)

    @property
    def path(self) -> Path:
        """Path of run.yaml."""
        return self.folder / "run.yaml"

    @property
    def times_paths(self) -> tuple[Path, ...]:
        """The timestamps files of the run and of its cameras."""
        own = (self.times_path, *(clock.times_path for clock in self.clocks.values()))
        return tuple(dict.fromkeys(p for p in own if p is not None))

    @property
    def paths_outside(self) -> tuple[Path, ...]:
        """The files and folders that run.yaml names and that are not in the run folder, links followed."""
        named = [self.rig_path, *self.times_paths]
        named += [s.path for s in self.cameras.values() if not isinstance(s, LiveDevice)]
        home = self.folder.resolve()
        return tuple(dict.fromkeys(p for p in named if not p.resolve().is_relative_to(home)))


def folder_of_run(given: Path) -> Path:
    """The run folder that a path names: itself, or the folder of its run.yaml. Raises InputError: it is none."""
    folder = Path(given)
    if folder.name == "run.yaml" and not folder.is_dir():
        folder = folder.parent
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a run folder, found {'a file' if folder.exists() else 'nothing'}")
    if not (folder / "run.yaml").exists():
        raise no_run_error(folder)
    return folder


def load_run(run_folder: Path, rig_path: Path | None = None, recording: bool = False) -> Run:
    """Read and check run.yaml of a run folder, its rig and its timestamps; pictures are not opened.

    rig_path: a rig.yaml in place of the one that run.yaml names. recording: the cameras' timestamps are still being
    written, and are not read. Raises InputError: with file, field, what was expected and what was found; FileError for
    several mistakes.
    """
    folder = folder_of_run(run_folder)
    path = folder / "run.yaml"
    content = fields.validated(_RunBlock, read_mapping(path), path)
    tracker = dataclass_from_yaml(TrackerParameters, content.tracker, path, "tracker")

    named, rig_path = (content.rig, folder / content.rig) if rig_path is None else (rig_path, rig_path)
    if not rig_path.is_file():
        raise InputError(
            f"{path}: rig: expected a rig file, found none at {rig_path}; paths start at run.yaml's folder"
        )
    rig_file = load_rig_file(rig_path)
    rig = rig_file.rig
    mistakes = [
        f"{path}: cameras.{name}: expected a camera of {named}, got {name!r}{suggest_name(name, rig.cameras)}"
        for name in content.cameras
        if name not in rig.cameras
    ]
    sources: dict[str, Source] = {}
    clocks: dict[str, CameraClock] = {}
    for name in rig.cameras:
        if name not in content.cameras:
            continue
        try:
            block, where = content.cameras[name], f"{path}: cameras.{name}"
            sources[name] = source_of(block, folder, where)
            rate_hz, height = content.frame_rate_hz, rig.cameras[name].image_size_px[1]
            offset_s, row_time_s = block.time_offset_s, block.row_time_s
            clock = load_clock(
                offset_s, row_time_s, block.timestamps, folder, where, rate_hz, height, recording=recording
            )
            if clock is not None:
                clocks[name] = clock
        except InputError as error:
            mistakes.append(str(error))
    in_use = dataclasses.replace(rig, cameras={n: c for n, c in rig.cameras.items() if n in sources})
    covariance = joint_covariance(in_use, rig_file.covariances, rig_path)
    clocks = clocks_in(in_use, covariance, clocks)
    if clocks and tracker.method != "rigid":
        mistakes.append(
            f"{path}: cameras.{next(iter(clocks))}: expected tracker.method rigid with a clock of its own, got"
            f" {tracker.method}, which takes all pictures of a frame for those of one instant"
        )
    if mistakes:
        raise FileError(mistakes)

    times_path = None if content.timestamps is None else folder / content.timestamps
    return Run(
        folder=folder,
        name=content.name or name_of_path(folder),
        rig=in_use,
        rig_path=rig_path,
        frame_rate_hz=content.frame_rate_hz,
        exposure_s=content.exposure_s,
        times=Times(content.frame_rate_hz) if times_path is None else load_times(times_path, content.frame_rate_hz),
        times_path=times_path,
        cameras=sources,
        left_out=tuple(n for n in rig.cameras if n not in sources),
        prior=None if content.prior is None else _prior_of(content.prior),
        tracker=tracker,
        notes=content.notes,
        covariance=covariance,
        calibration=rig_file.calibration,
        recorded=content.recorded,
        clocks=clocks,
    )


def save_run(content: Mapping[str, Any], run_folder: Path) -> Path:
    """Write run.yaml from a plain mapping, checked as by the reader; returns its path.

    `schema` may be left out. Paths in the mapping are relative to the run folder. Raises InputError.
    """
    path = Path(run_folder) / "run.yaml"
    full = {"schema": SCHEMA, **content}
    block = fields.validated(_RunBlock, full, path)
    dataclass_from_yaml(TrackerParameters, block.tracker, path, "tracker")
    write_mapping(full, path)
    return path


_MOST_NAMES = 3


def no_run_error(folder: Path) -> InputError:
    """The error for a folder without a run.yaml: what was found in it, and what to name instead.

    Raises InputError: a summary.json in it is a named pipe, a socket or a device.
    """
    start = f"{folder}: expected a run folder, with a run.yaml,"
    if (folder / "summary.json").is_file() and (run := _run_of_results(folder)):
        return InputError(f"{start} found results; they are of the run {run}")
    try:
        entries = sorted(folder.iterdir())
    except OSError as error:
        return InputError(f"{folder}: cannot be read: {error.strerror}")
    runs = [path for path in entries if (path / "run.yaml").is_file()]
    if runs:
        names = ", ".join(name_of_path(path) for path in runs[:_MOST_NAMES])
        more = f" and {len(runs) - _MOST_NAMES} more" if len(runs) > _MOST_NAMES else ""
        return InputError(f"{start} found run folders in it: {names}{more}; name one, or give all to `beampose batch`")
    above = next((path for path in list(folder.resolve().parents)[:2] if (path / "run.yaml").is_file()), None)
    if above is not None:
        return InputError(f"{start} found a part of one; name the run folder {name_of_path(above)}")
    if any(path.suffix.lower() in PICTURE_SUFFIXES for path in entries):
        return InputError(
            f"{start} found pictures; `beampose detect` needs no run.yaml, and `beampose init` writes one to start from"
        )
    return InputError(f"{start} found none; check the path, or write one with `beampose init`")


def _run_of_results(folder: Path) -> str:
    """The run folder that a summary.json names; empty where it names none."""
    try:
        summary = read_json(folder / "summary.json")
        return str(summary.get("run_folder") or "")
    except (OSError, ValueError, AttributeError):
        return ""


# The schema of the file ----------------------------------------------------------------------------------------------


def _a_device(value: Any) -> int | str:
    if isinstance(value, int) and not isinstance(value, bool) and value >= 0:
        return value
    if isinstance(value, str) and value.strip():
        return value
    raise fields.unexpected_value("a camera's number from 0, or the name of a device", value)


class SourceBlock(fields.Block):
    """The pictures of one camera in run.yaml."""

    frames: fields.Word | None = None
    detections: fields.Word | None = None
    device: Annotated[int | str | None, pydantic.PlainValidator(_a_device)] = None

    @pydantic.model_validator(mode="after")
    def _one_of_them(self) -> SourceBlock:
        given = [n for n in ("frames", "detections", "device") if getattr(self, n) is not None]
        if "device" in given and len(given) > 1:
            raise fields.field_error(
                f"expected one of frames, detections and device, got {' and '.join(given)}; keep one"
            )
        if len(given) > 1:
            raise fields.field_error("expected frames or detections, got both; keep one")
        if not given:
            raise fields.field_error("expected frames or detections, got neither")
        return self


def _seconds_or_estimate(value: Any) -> float | str:
    if isinstance(value, str) and value != ESTIMATE:
        raise fields.unexpected_value(f"a finite number or `{ESTIMATE}`", value)
    return ESTIMATE if value == ESTIMATE else fields.finite_number(value)


class _CameraBlock(SourceBlock):
    """The pictures of one camera in run.yaml, and its clock."""

    time_offset_s: Annotated[float | str, pydantic.PlainValidator(_seconds_or_estimate)] = 0.0  # added to rig.yaml's
    row_time_s: Annotated[float | str, pydantic.PlainValidator(_seconds_or_estimate)] = 0.0  # added to rig.yaml's
    timestamps: fields.Word | None = None


def _an_angle_range(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value <= 180:
        raise fields.unexpected_value("an angle above 0 and up to 180", value)
    return float(value)


class _PriorBlock(fields.Block):
    position_m: fields.Vector3
    yaw_pitch_roll_deg: fields.Vector3
    within_m: fields.NonNegative
    within_deg: Annotated[float, pydantic.PlainValidator(_an_angle_range)]


def _some_cameras(value: Any) -> Any:
    if isinstance(value, dict) and not value:
        raise fields.field_error("expected one or more cameras, got none")
    return value


class _RunBlock(fields.Block):
    schema_: Annotated[str, pydantic.PlainValidator(fields.one_of((SCHEMA,)))] = pydantic.Field(alias="schema")
    name: fields.Name | None = None
    rig: fields.Word
    frame_rate_hz: Annotated[float, pydantic.PlainValidator(fields.number_between(*RATE_RANGE_HZ, "Hz"))]
    exposure_s: fields.Positive | None = None
    timestamps: fields.Word | None = None
    cameras: Annotated[dict[str, _CameraBlock], pydantic.BeforeValidator(_some_cameras)]
    prior: _PriorBlock | None = None
    tracker: Any = None
    recorded: OptionalDay = None
    notes: fields.Text = ""

    @pydantic.model_validator(mode="after")
    def _exposure_within_a_frame(self) -> _RunBlock:
        if self.exposure_s is not None and self.exposure_s * self.frame_rate_hz > LONGEST_EXPOSURE:
            raise fields.field_error(
                f"exposure_s: expected at most the {1 / self.frame_rate_hz:.6g} s between two frames"
                f" ({self.frame_rate_hz:g} Hz), got {self.exposure_s:g}; give seconds, not milliseconds"
            )
        return self


def _prior_of(block: _PriorBlock) -> PosePrior:
    return PosePrior(
        centre=Pose.from_ypr(np.radians(block.yaw_pitch_roll_deg), np.array(block.position_m)),
        within_m=block.within_m,
        within_rad=float(np.radians(block.within_deg)),
    )


def prior_from(content: Mapping[str, Any]) -> PosePrior:
    """The prior region that the `prior` block of a run.yaml states. Raises InputError."""
    return _prior_of(fields.validated(_PriorBlock, dict(content), "prior"))


def source_of(block: SourceBlock, folder: Path, where: str) -> Source:
    """The pictures that a block names, in a run folder. where: of the block, in messages. Raises InputError."""
    if block.device is not None:
        return LiveDevice(block.device)
    if block.detections is not None:
        path = folder / block.detections
        if not path.is_file():
            raise InputError(f"{where}.detections: expected a table, found none at {path}")
        return DetectionsTable(path)
    path = folder / str(block.frames)
    if path.is_dir():
        return FramesFolder(path)
    if path.suffix.lower() in PICTURE_SUFFIXES and path.is_file():
        raise InputError(
            f"{where}.frames: expected a folder or a video, got the single picture {path}; name its folder"
        )
    if path.is_file():
        return VideoFile(path)
    raise InputError(f"{where}.frames: expected a folder of pictures or a video, found nothing at {path}")
