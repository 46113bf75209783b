"""A stereo run folder: run.yaml with the schema beampose/stereo/1, the pair, the target and the pictures.

```yaml
schema: beampose/stereo/1
pair: pair.yaml                  # of `beampose calibrate pair`; or a rig.yaml, a Kalibr camchain ... with poses
frame_rate_hz: 25.0
cameras:                         # two; the first is the reference of the histogram specification
  left: {frames: frames/left}    # a folder of colour pictures or a video, or {detections: detections.csv}
  right: {frames: frames/right}
target:                          # or the name of a file with this content
  colours: {red: {hue_deg: [340, 20], saturation: [0.4, 1], value: [0.2, 1]}}
  markers: {"1": {position_m: [0.3, 0, 0], colour: red, radius_m: 0.02}}
  sigma_m: 0.0005                # optional: of the survey of the markers
segmentation: {gamma: 0.8}       # optional: SegmentationParameters
match: {gate_sigmas: 4.5}        # optional: MatchParameters
```
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import permutations
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pydantic

from geometry.arrays import Array
from geometry.camera import Camera
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import PoseFit
from lab.errors import InputError
from lab.files.rig.camera_file import CalibrationState, OptionalDay
from lab.files.rig.pair_file import REMEDY, load_pair_file, of_two_cameras
from lab.files.run.clocks import Times, load_times
from lab.files.run.run_file import (
    RATE_RANGE_HZ,
    DetectionsTable,
    LiveDevice,
    RecordedSource,
    SourceBlock,
    folder_of_run,
    source_of,
)
from lab.files.text import fields
from lab.files.text.dataclass_fields import dataclass_from_yaml
from lab.files.text.error_text import name_of_path, suggest_name
from lab.files.text.yaml_text import read_mapping
from lab.runs.verdict.score import normalised_squares
from tracking.binocular.calibration_check import CalibrationCheck, ClockOffset
from tracking.binocular.joint_fit import pose_of_points
from tracking.binocular.marker_model import (
    BinocularParameters,
    MarkerImages,
    MarkerModel,
    MatchParameters,
    SegmentationParameters,
    StereoPair,
)
from tracking.binocular.pose_tracker import BinocularFrame
from tracking.binocular.segmentation import ColourRange
from tracking.statuses import PoseStatus

LARGEST_NOISE_SCALE, GOOD_NOISE_SCALE = 5.0, 1.5  # residuals over their sigmas
_SYMMETRIC = 0.03  # share of the target's size within which turned markers count as the same


@dataclass(frozen=True, slots=True)
class Target:
    """The markers, and the colours that their `colour` indexes."""

    model: MarkerModel
    colours: tuple[ColourRange, ...]


class _ColourBlock(fields.Block):
    hue_deg: Annotated[list[float], pydantic.PlainValidator(fields.numbers(2))]
    saturation: Annotated[list[float], pydantic.PlainValidator(fields.numbers(2))] = [0.35, 1.0]  # noqa: RUF012 - frozen
    value: Annotated[list[float], pydantic.PlainValidator(fields.numbers(2))] = [0.2, 1.0]  # noqa: RUF012 - frozen

    @pydantic.model_validator(mode="after")
    def _in_range(self) -> _ColourBlock:
        try:
            self.named("")
        except ValueError as error:
            raise fields.field_error(str(error)) from None
        return self

    def named(self, name: str) -> ColourRange:
        """The block as a value."""
        h, s, v = self.hue_deg, self.saturation, self.value
        return ColourRange(name, (h[0], h[1]), (s[0], s[1]), (v[0], v[1]))


class _MarkerBlock(fields.Block):
    position_m: fields.Vector3
    colour: fields.Word = ""
    radius_m: fields.Positive | None = None


class TargetBlock(fields.Block):
    """Colours and markers."""

    colours: dict[fields.Name, _ColourBlock] = {}  # noqa: RUF012 - frozen
    markers: dict[fields.Name, _MarkerBlock]
    sigma_m: fields.NonNegative = 0.0


def load_target(given: Any, folder: Path, path: Path) -> Target:
    """The target of a run.yaml: a block, or the name of a file with one. Raises InputError."""
    where, inside = path, "target"
    if isinstance(given, str):
        where, inside = folder / given, ""
        if not where.is_file():
            raise InputError(f"{path}: target: expected a block or a file with one, found nothing at {where}")
        given = read_mapping(where)
    if not isinstance(given, dict):
        raise InputError(f"{path}: target: expected a mapping with colours and markers, or the name of a file")
    return _target_of(
        fields.validated(TargetBlock, given, where, inside), f"{where}: {inside}." if inside else f"{where}: "
    )


def load_lamps(path: Path) -> MarkerModel:
    """The markers of a target's file, without their colours: lamps look alike. Raises InputError."""
    block = fields.validated(TargetBlock, read_mapping(path), path)
    alike = {name: marker.model_copy(update={"colour": ""}) for name, marker in block.markers.items()}
    return _target_of(
        TargetBlock.model_construct(colours={}, markers=alike, sigma_m=block.sigma_m), f"{path}: ", False
    ).model


def _target_of(block: TargetBlock, where: str, coloured: bool = True) -> Target:
    names = list(block.colours) if coloured else [""]
    if not names:
        raise InputError(f"{where}colours: expected one or more, got none")
    for name, marker in block.markers.items():
        if marker.colour not in names:
            raise InputError(
                f"{where}markers.{name}.colour: expected one of {', '.join(names)}, got {marker.colour!r}"
                f"{suggest_name(marker.colour, names)}"
            )
    least, word = (3, "three") if coloured else (4, "four")
    if len(block.markers) < least:
        raise InputError(f"{where}markers: expected {word} or more, got {len(block.markers)}; fewer do not fix a pose")
    x = np.array([m.position_m for m in block.markers.values()])
    spread = np.linalg.svd(x - x.mean(axis=0), compute_uv=False)
    if spread[1] < 1e-3 * max(spread[0], 1e-12):
        raise InputError(f"{where}markers: expected markers that are not on one line; a turn about it would be free")
    model = MarkerModel(
        names=tuple(block.markers),
        positions=x,
        colour=np.array([names.index(m.colour) for m in block.markers.values()], dtype=np.int64),
        radius_m=np.array([np.nan if m.radius_m is None else m.radius_m for m in block.markers.values()]),
        sigma_m=block.sigma_m,
    )
    if is_symmetric(model):
        raise InputError(
            f"{where}markers: expected markers that look different after every turn, got a symmetric set: its attitude"
            " is ambiguous; give one marker another colour, or move it"
        )
    return Target(model, tuple(colour.named(name) for name, colour in block.colours.items()))


def is_symmetric(model: MarkerModel) -> bool:
    """Whether a turn maps the markers onto markers of the same colour, within 3 % of the size of the target."""
    x, tolerance = model.positions, _SYMMETRIC * model.extent_m
    first = _widest(x)
    sides = _sides(x[list(first)])
    for other in permutations(range(len(x)), 3):
        same_colours = np.array_equal(model.colour[list(other)], model.colour[list(first)])
        if other == first or not same_colours or np.abs(_sides(x[list(other)]) - sides).max() > 2 * tolerance:
            continue
        turned = pose_of_points(x[list(first)], x[list(other)]).apply(x)
        apart = np.linalg.norm(turned[:, None] - x[None], axis=-1)
        apart[model.colour[:, None] != model.colour[None]] = np.inf
        if apart.min(axis=1).max() < tolerance and len(set(apart.argmin(axis=1).tolist())) == len(x):
            return True
    return False


def _sides(triangle: Array) -> Array:
    return np.linalg.norm(triangle - np.roll(triangle, 1, axis=0), axis=1)


def _widest(x: Array) -> Sequence[int]:
    """Three markers of a large triangle."""
    far = int(np.argmax(np.linalg.norm(x - x.mean(axis=0), axis=1)))
    second = int(np.argmax(np.linalg.norm(x - x[far], axis=1)))
    area = np.linalg.norm(np.cross(x - x[far], x[second] - x[far]), axis=1)
    return (far, second, int(np.argmax(area)))


SCHEMA = "beampose/stereo/1"


@dataclass(frozen=True, slots=True)
class StereoRun:
    """One stereo recording, before its pictures are opened."""

    folder: Path
    name: str
    pair: StereoPair
    pair_path: Path
    target: Target
    target_path: Path | None  # a file of its own
    frame_rate_hz: float
    times: Times
    times_path: Path | None
    cameras: Mapping[str, RecordedSource]  # two, by name, the left one first
    parameters: BinocularParameters
    calibration: CalibrationState | None
    recorded: datetime.date | None
    notes: str

    @property
    def path(self) -> Path:
        """Path of run.yaml."""
        return self.folder / "run.yaml"


class _StereoRunBlock(fields.Block):
    schema_: Annotated[str, pydantic.PlainValidator(fields.one_of((SCHEMA,)))] = pydantic.Field(alias="schema")
    name: fields.Name | None = None
    pair: fields.Word
    frame_rate_hz: Annotated[float, pydantic.PlainValidator(fields.number_between(*RATE_RANGE_HZ, "Hz"))]
    timestamps: fields.Word | None = None
    cameras: dict[str, SourceBlock]
    target: Any
    segmentation: Any = None
    match: Any = None
    recorded: OptionalDay = None
    notes: fields.Text = ""


def load_stereo_run(run_folder: Path) -> StereoRun:
    """Read and check a stereo run folder; pictures are not opened. Raises InputError, a line for each mistake."""
    folder = folder_of_run(run_folder)
    path = folder / "run.yaml"
    mapping = read_mapping(path)
    if mapping.get("schema") == "beampose/run/1":
        raise InputError(
            f"{path}: schema: expected {SCHEMA!r}, got a run of laser spots; process it with `beampose run`"
        )
    content = fields.validated(_StereoRunBlock, mapping, path)
    names = list(content.cameras)
    if len(names) != 2:
        what = f"the single camera {names[0]}" if len(names) == 1 else f"{len(names)} cameras"
        raise InputError(f"{path}: cameras: expected two cameras, got {what}; add the second camera of the pair")
    pair_path = folder / content.pair
    file = load_pair_file(pair_path)
    for name in names:
        if name not in file.cameras:
            raise InputError(
                f"{path}: cameras.{name}: expected a camera of {pair_path.name}, got {name!r}"
                f"{suggest_name(name, file.cameras)}"
            )
    cameras, covariance = of_two_cameras(file, names)
    times_path = None if content.timestamps is None else folder / content.timestamps
    target = load_target(content.target, folder, path)
    sources: dict[str, RecordedSource] = {}
    for name, block in content.cameras.items():
        source = source_of(block, folder, f"{path}: cameras.{name}")
        if isinstance(source, LiveDevice):
            raise InputError(f"{path}: cameras.{name}: expected frames or detections, got a live camera")
        sources[name] = source
    if len(target.colours) > 1 and any(isinstance(s, DetectionsTable) for s in sources.values()):
        raise InputError(f"{path}: target.colours: expected one colour with detections, which have none; got several")
    return StereoRun(
        folder=folder,
        name=content.name or name_of_path(folder),
        pair=_pair_of(cameras, covariance, pair_path),
        pair_path=pair_path,
        target=target,
        target_path=folder / content.target if isinstance(content.target, str) else None,
        frame_rate_hz=content.frame_rate_hz,
        times=Times(content.frame_rate_hz) if times_path is None else load_times(times_path, content.frame_rate_hz),
        times_path=times_path,
        cameras=sources,
        parameters=BinocularParameters(
            dataclass_from_yaml(SegmentationParameters, content.segmentation, path, "segmentation"),
            dataclass_from_yaml(MatchParameters, content.match, path, "match"),
        ),
        calibration=file.calibration,
        recorded=content.recorded,
        notes=content.notes,
    )


def _pair_of(cameras: tuple[Camera, Camera], covariance: Any, path: Path) -> StereoPair:
    try:
        return StereoPair(cameras, covariance)
    except ValueError as error:
        raise InputError(f"{path}: cameras: {error}; {REMEDY}") from None


# What processing keeps of each frame of a stereo run; tables, findings and the report are made from it.


@dataclass(frozen=True, slots=True)
class StereoRecord:
    """One frame."""

    frame: int
    t_s: float
    candidates: tuple[MarkerImages | None, MarkerImages | None]  # None: no picture
    missing: tuple[str, str]  # why there is no picture; empty where there is one
    tracked: BinocularFrame

    @property
    def measured(self) -> bool:
        """Whether the pose is a measurement."""
        return self.tracked.status is PoseStatus.MEASURED


@dataclass(frozen=True, slots=True)
class TruthErrors:
    """Errors of the measured poses against truth/pose.csv, n frames."""

    frames: Array  # (n,)
    deltas: Array  # (n, 6): truth minus estimate, section 1 of the file contract
    nees: Array  # (n,)
    range_m: Array  # (n,): estimated minus true distance of the body origin from the left camera

    def as_mapping(self) -> dict[str, float | int]:
        """Figures for summary.json."""
        return {
            "frames": len(self.frames),
            "position_rms_m": _rms(np.linalg.norm(self.deltas[:, :3], axis=1)),
            "rotation_rms_deg": float(np.rad2deg(_rms(np.linalg.norm(self.deltas[:, 3:], axis=1)))),
            "range_bias_m": float(self.range_m.mean()),
            "range_rms_m": _rms(self.range_m),
            "nees_mean": float(self.nees.mean()),
        }


@dataclass(slots=True)
class StereoResults:
    """A whole run."""

    run: StereoRun
    records: list[StereoRecord] = field(default_factory=list)
    clock: ClockOffset | None = None
    calibration: CalibrationCheck | None = None
    errors: TruthErrors | None = None
    notes: list[str] = field(default_factory=list)

    @property
    def measured(self) -> list[StereoRecord]:
        """The frames with a measured pose."""
        return [r for r in self.records if r.measured]

    @property
    def fits(self) -> list[PoseFit | None]:
        """The fits of all frames; None of a frame without a measured pose."""
        return [r.tracked.fit if r.measured else None for r in self.records]

    @property
    def t_s(self) -> Array:
        """Times (n,) of all frames."""
        return np.array([r.t_s for r in self.records])

    @property
    def noise_scale(self) -> float:
        """Root of chi-square over degrees of freedom of all measured frames: 1 if the stated sigmas are right."""
        return noise_scale([fit for fit in self.fits if fit is not None])


def noise_scale(fits: Sequence[PoseFit]) -> float:
    """Root of chi-square over degrees of freedom of measured poses: 1 if the stated sigmas are right; nan: no pose."""
    dof = sum(f.dof for f in fits)
    return float(np.sqrt(sum(f.chi2 for f in fits) / dof)) if dof else float("nan")


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def truth_errors(records: Sequence[StereoRecord], run: StereoRun, frames: Array, poses: Pose) -> TruthErrors | None:
    """Errors of the measured poses against true ones at some frames; None where none is shared."""
    place = {int(f): i for i, f in enumerate(frames)}
    shared = [r for r in records if r.measured and r.frame in place]
    if not shared:
        return None
    true = poses[np.array([place[r.frame] for r in shared])]
    found = Pose.stack([r.tracked.pose for r in shared if r.tracked.pose is not None])
    covariances = np.array([r.tracked.covariance for r in shared])
    delta = true.minus(found)
    eye = run.pair.cameras[0].camera_from_world.inverse().translation
    far, true_far = (np.linalg.norm(p.translation - eye, axis=1) for p in (found, true))
    numbers = np.array([r.frame for r in shared])
    return TruthErrors(numbers, delta, normalised_squares(delta, covariances), far - true_far)
