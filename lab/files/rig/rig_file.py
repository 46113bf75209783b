"""rig.yaml: the rig, and the joint covariance of its parameters; screens.yaml: a rig without beams."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import pydantic

from geometry.arrays import symmetric
from geometry.camera import Camera, SensorNoise
from geometry.rig import Beam, Rig, Screen, Spot
from geometry.uncertainty.rig_uncertainty import CLOCK, RigCovariance, independent, is_known, split_name
from lab.errors import InputError
from lab.files.rig.camera_file import (
    CalibrationState,
    CovarianceBlock,
    LensBlock,
    covariance_error,
    covariance_mapping,
    lens_mapping,
    plain_floats,
)
from lab.files.rig.pose_block import BeamBlock, CameraPoseBlock, ScreenPoseBlock, measured_forms, pose_mapping
from lab.files.text import fields
from lab.files.text.error_text import FileError, suggest_name
from lab.files.text.yaml_text import read_mapping, write_mapping

# The covariance blocks of a rig.yaml as one joint covariance of the rig's parameters.

TARGET = "target"


def joint_covariance(rig: Rig, blocks: Mapping[str, RigCovariance], path: Path | str) -> RigCovariance | None:
    """The joint covariance of the parameters of this rig in the blocks; None where there are none.

    blocks: by `cameras.NAME`, `screens.NAME`, `target`. The target's block may also name parameters of cameras and
    screens (as a joint solve writes it): then it is complete, and the other blocks, excerpts of it, are not used.
    Unknown names are ignored, as the contract of the files defines. Raises InputError: a matrix is not a covariance.
    """
    target = blocks.get(TARGET)
    if target is not None and any(n.startswith(("cameras.", "screens.")) for n in target.names):
        used = {TARGET: target}
    else:
        used = dict(blocks)
    parts = []
    for where, block in used.items():
        prefix = "" if where == TARGET else f"{where}."
        known = block.part([is_known(rig, prefix + n) for n in block.names])
        mistake = covariance_error(known)
        if mistake:
            raise InputError(f"{path}: {where}.covariance.matrix: {mistake}")
        parts.append(RigCovariance(tuple(prefix + n for n in known.names), symmetric(known.matrix)))
    joint = independent(parts)
    return joint if joint.names else None


def covariance_blocks(covariance: RigCovariance) -> dict[str, RigCovariance]:
    """A joint covariance as blocks of a rig.yaml: complete for the target, an excerpt for each camera and screen."""
    out: dict[str, RigCovariance] = {}
    things = [".".join(split_name(n)[:2]) for n in covariance.names]
    for where in dict.fromkeys(t for t in things if t.startswith(("cameras.", "screens."))):
        own = covariance.part([t == where for t in things])
        out[where] = RigCovariance(tuple(split_name(n)[2] for n in own.names), symmetric(own.matrix))
    out[TARGET] = RigCovariance(covariance.names, symmetric(covariance.matrix))
    return out


# rig.yaml: screens, cameras, and the beams and spots of the vehicle; read, checked and written.


SCHEMA, SCREENS_SCHEMA = "beampose/rig/1", "beampose/screens/1"


@dataclass(frozen=True, slots=True)
class RigFile:
    """The content of a rig.yaml. The keys of `covariances` are `cameras.NAME`, `screens.NAME`, `target`.

    `joint_covariance` (lab/files/rig/rig_file.py) combines them.
    """

    rig: Rig
    covariances: Mapping[str, RigCovariance] = field(default_factory=dict)
    calibration: CalibrationState | None = None  # None: not stated
    # How a transform or a beam was stated where not in the form of a written file; by its place, such as
    # screens.left.world_from_screen. A written file has it as a comment.
    measured_as: Mapping[str, str] = field(default_factory=dict)


def load_rig(path: Path) -> Rig:
    """The rig of a rig.yaml. Raises InputError: one line for each mistake, with file and field."""
    return load_rig_file(path).rig


def load_rig_file(path: Path) -> RigFile:
    """The rig of a rig.yaml with its covariance blocks and the state of its calibration. Raises InputError."""
    path = Path(path)
    content = fields.validated(_RigBlock, read_mapping(path), path)
    mistakes = _broken_references(content)
    if mistakes:
        raise FileError(f"{path}: {m}" for m in mistakes)
    covariances = {where: block.value() for where, block in _covariance_blocks(content)}
    return RigFile(_rig_of(content), covariances, content.calibration, dict(measured_forms(content)))


def load_lab_file(path: Path) -> RigFile:
    """The cameras and screens of a rig.yaml, or of a screens.yaml: a rig without beams. Raises InputError."""
    mapping = read_mapping(path)
    if mapping.get("schema") != SCREENS_SCHEMA:
        return load_rig_file(path)
    content = fields.validated(ScreensFileBlock, mapping, path)
    mistakes = _unknown_screens(content)
    if mistakes:
        raise FileError(f"{path}: {m}" for m in mistakes)
    covariances = {} if content.covariance is None else {TARGET: content.covariance.value()}
    return RigFile(_rig_of(content), covariances, content.calibration)


def save_screens(name: str, file: RigFile, path: Path) -> None:
    """Write the cameras and screens of a rig as a screens.yaml, as `save_rig` does. name: of the project."""
    own = as_mapping(file)
    content = {"schema": SCREENS_SCHEMA, "name": name, "screens": own["screens"], "cameras": own["cameras"]}
    if TARGET in file.covariances:
        content["covariance"] = covariance_mapping(file.covariances[TARGET])
    if "calibration" in own:
        content["calibration"] = own["calibration"]
    fields.validated(ScreensFileBlock, content, path)
    write_mapping(content, Path(path))


def save_rig(rig: Rig | RigFile, path: Path) -> None:
    """Write a rig.yaml, complete or not at all.

    It reads back to the same numbers, directions and rotation matrices to 4e-16 (quaternions have 17 digits). Raises
    InputError: the rig could not be loaded again, or the file cannot be written; an old file stays as it was.
    """
    file = rig if isinstance(rig, RigFile) else RigFile(rig)
    content = as_mapping(file)
    fields.validated(_RigBlock, content, path)
    write_mapping(content, Path(path), file.measured_as)


# The schema of the file ----------------------------------------------------------------------------------------------


class ScreenBlock(fields.Block):
    """A screen of a rig."""

    world_from_screen: ScreenPoseBlock
    size_m: Annotated[list[float] | None, pydantic.PlainValidator(fields.positive_numbers(2))] = None
    bow_per_m: fields.Vector3 = [0.0, 0.0, 0.0]  # noqa: RUF012 - frozen
    covariance: CovarianceBlock | None = None

    def value(self, name: str) -> Screen:
        """The screen."""
        a, b, c = self.bow_per_m
        size = self.world_from_screen.size_m() if self.size_m is None else (self.size_m[0], self.size_m[1])
        return Screen(name, self.world_from_screen.pose(), size, (a, b, c))


class _NoiseBlock(fields.Block):
    gain_e_per_dn: fields.Positive
    read_noise_e: fields.NonNegative
    black_dn: fields.Number = 0.0


class CameraBlock(LensBlock):
    """A camera of a rig."""

    screen: fields.Word
    camera_from_world: CameraPoseBlock
    noise: _NoiseBlock | None = None
    time_offset_s: fields.Number = 0.0  # of its clock in every run, added to that of run.yaml; later: positive
    row_time_s: fields.Number = 0.0  # by which a row is exposed later than the one above; added to that of run.yaml
    covariance: CovarianceBlock | None = None

    def value(self, name: str) -> Camera:
        """The camera."""
        n = self.noise
        return Camera(
            name=name,
            screen=self.screen,
            image_size_px=self.size(),
            matrix=self.matrix(),
            distortion=tuple(self.distortion),
            camera_from_world=self.camera_from_world.pose(),
            noise=None if n is None else SensorNoise(n.gain_e_per_dn, n.read_noise_e, n.black_dn),
            lens=self.lens,
            time_offset_s=self.time_offset_s,
            row_time_s=self.row_time_s,
        )


class _SpotBlock(fields.Block):
    beam: fields.Word
    end: Annotated[str, pydantic.PlainValidator(fields.one_of(("+", "-")))]
    screen: fields.Word


class TargetBlock(fields.Block):
    """The vehicle's beams and spots."""

    beams: dict[fields.Name, BeamBlock]
    spots: dict[fields.Name, _SpotBlock]
    covariance: CovarianceBlock | None = None

    def beam_values(self) -> dict[str, Beam]:
        """The beams by name."""
        return {name: Beam(name, *b.line()) for name, b in self.beams.items()}

    def spot_values(self) -> dict[str, Spot]:
        """The spots by name."""
        return {name: Spot(name, s.beam, 1 if s.end == "+" else -1, s.screen) for name, s in self.spots.items()}

    def mistakes(self, screens: Collection[str]) -> list[str]:
        """Mistakes across fields: too few entries, and names that do not exist."""
        out = []
        if len(self.beams) < 2:
            out.append(
                f"target.beams: expected two or more, got {len(self.beams)}; one line does not determine an attitude"
            )
        if not self.spots:
            out.append("target.spots: expected one or more, got none")
        ends: dict[tuple[str, str], str] = {}
        for name, spot in self.spots.items():
            if spot.beam not in self.beams:
                out.append(unknown_name("beam", spot.beam, f"target.spots.{name}.beam", self.beams))
            if spot.screen not in screens:
                out.append(unknown_name("screen", spot.screen, f"target.spots.{name}.screen", screens))
            other = ends.setdefault((spot.beam, spot.end), name)
            if other != name:
                out.append(
                    f"target.spots.{name}: expected one spot per beam end, got beam {spot.beam!r} end {spot.end!r}"
                    f" a second time (spot {other!r} has it)"
                )
        return out


class _RigBlock(fields.Block):
    schema_: Annotated[str, pydantic.PlainValidator(fields.one_of((SCHEMA,)))] = pydantic.Field(alias="schema")
    screens: dict[fields.Name, ScreenBlock]
    cameras: dict[fields.Name, CameraBlock]
    target: TargetBlock
    calibration: CalibrationState | None = None


class ScreensFileBlock(fields.Block):
    """screens.yaml: cameras and screens in one world frame, with their joint covariance."""

    schema_: Annotated[str, pydantic.PlainValidator(fields.one_of((SCREENS_SCHEMA,)))] = pydantic.Field(alias="schema")
    name: fields.Word
    screens: dict[str, ScreenBlock]
    cameras: dict[str, CameraBlock]
    covariance: CovarianceBlock | None = None
    calibration: CalibrationState | None = None


def _broken_references(content: _RigBlock) -> list[str]:
    """Mistakes across fields: too few entries, and names that do not exist."""
    out = []
    for name, block in (("screens", content.screens), ("cameras", content.cameras)):
        if not block:
            out.append(f"{name}: expected one or more, got none")
    return out + _unknown_screens(content) + content.target.mistakes(content.screens)


def _unknown_screens(content: _RigBlock | ScreensFileBlock) -> list[str]:
    return [
        unknown_name("screen", camera.screen, f"cameras.{name}.screen", content.screens)
        for name, camera in content.cameras.items()
        if camera.screen not in content.screens
    ]


def unknown_name(kind: str, name: str, where: str, known: Collection[str]) -> str:
    """The message for a name that does not exist in the file."""
    return f"{where}: expected a {kind} of this file, got {name!r}{suggest_name(name, known)}"


def _covariance_blocks(content: _RigBlock) -> list[tuple[str, CovarianceBlock]]:
    blocks = [(f"screens.{n}", s.covariance) for n, s in content.screens.items()]
    blocks += [(f"cameras.{n}", c.covariance) for n, c in content.cameras.items()]
    blocks += [("target", content.target.covariance)]
    return [(where, block) for where, block in blocks if block is not None]


def _rig_of(content: _RigBlock | ScreensFileBlock) -> Rig:
    target = content.target if isinstance(content, _RigBlock) else None
    return Rig(
        screens={name: s.value(name) for name, s in content.screens.items()},
        cameras={name: c.value(name) for name, c in content.cameras.items()},
        beams={} if target is None else target.beam_values(),
        spots={} if target is None else target.spot_values(),
    )


# Writing -------------------------------------------------------------------------------------------------------------


def as_mapping(file: RigFile) -> dict[str, Any]:
    """The content of rig.yaml as a plain mapping."""
    rig = file.rig
    screens = {name: screen_mapping(screen) for name, screen in rig.screens.items()}
    cameras = {name: camera_mapping(camera) for name, camera in rig.cameras.items()}
    target = {
        "beams": {
            name: {"direction": plain_floats(b.direction), "point_m": plain_floats(b.point)}
            for name, b in rig.beams.items()
        },
        "spots": {
            name: {"beam": s.beam, "end": "+" if s.sign > 0 else "-", "screen": s.screen}
            for name, s in rig.spots.items()
        },
    }
    content: dict[str, Any] = {"schema": SCHEMA, "screens": screens, "cameras": cameras, "target": target}
    for where, covariance in file.covariances.items():
        block = content
        for key in where.split(".", 1):
            block = block[key]
        block["covariance"] = covariance_mapping(covariance)
    if file.calibration is not None:
        content["calibration"] = file.calibration.as_mapping()
    return content


def screen_mapping(screen: Screen) -> dict[str, Any]:
    """The plain mapping from which a `ScreenBlock` reads the same screen."""
    out: dict[str, Any] = {"world_from_screen": pose_mapping(screen.world_from_screen)}
    if screen.size_m is not None:
        out["size_m"] = [float(v) for v in screen.size_m]
    if any(screen.bow):
        out["bow_per_m"] = [float(v) for v in screen.bow]
    return out


def camera_mapping(camera: Camera) -> dict[str, Any]:
    """The plain mapping from which a `CameraBlock` reads the same camera."""
    out: dict[str, Any] = {
        "screen": camera.screen,
        **lens_mapping(camera),
        "camera_from_world": pose_mapping(camera.camera_from_world),
    }
    if camera.noise is not None:
        out["noise"] = {name: float(value) for name, value in asdict(camera.noise).items()}
    out |= {n: getattr(camera, n) for n in CLOCK if getattr(camera, n)}
    return out
