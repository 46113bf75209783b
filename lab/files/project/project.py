"""calibration.yaml: the measurements for calibrating screens, camera poses and beams, and where their files are.

`calibrate screen`, `calibrate beams` and `calibrate rig` share this file; each uses the parts that it needs. For
`calibrate beams` the cameras and screens may be left out, since its rig.yaml has them; so may the target, unless the
calibration is to start from another one. Paths are relative to the folder of the file.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration.boards import board_types
from calibration.boards.board_types import Board
from lab.errors import InputError
from lab.files.project.project_blocks import (
    CLOUD_UNITS,
    CameraBlock,
    CameraEntry,
    Cloud,
    CloudBlock,
    FixedBoard,
    FixedBoardBlock,
    Project,
    ProjectBlock,
    RecordingBlock,
    RecordingEntry,
    ScreenBlock,
    ScreenEntry,
    SharedBoard,
    SharedBoardBlock,
    broken_references,
)
from lab.files.rig.board_file import load_board
from lab.files.rig.camera_file import CameraFile, load_camera
from lab.files.rig.interchange import read_cameras
from lab.files.text.error_text import FileError, name_of_path, suggest_name
from lab.files.text.fields import validated
from lab.files.text.regular_file import text_of_file
from lab.files.text.yaml_text import read_mapping


def load_project(path: Path, lab_known: bool = False) -> Project:
    """Read and check a calibration.yaml and the lenses that it names; tables and photographs are not opened.

    path: the file or its folder. lab_known: cameras and screens come from a rig.yaml and may be left out.

    Raises:
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
    content = validated(ProjectBlock, read_mapping(path), path)
    mistakes: list[str] = []
    reader = _Reader(path.parent, content, mistakes)
    cameras = {name: reader.camera(name, block) for name, block in content.cameras.items()}
    project = Project(
        path=path,
        name=content.name or name_of_path(path.resolve().parent),
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
    mistakes += broken_references(content, lab_known)
    if mistakes:
        raise FileError(f"{path}: {m}" for m in mistakes)
    return project


@dataclass(frozen=True, slots=True)
class _Reader:
    """Converts blocks to values, and collects all mistakes instead of stopping at the first."""

    folder: Path
    content: ProjectBlock
    mistakes: list[str]

    def file(self, name: str, where: str) -> Path:
        path = self.folder / name
        if path.is_dir():
            self.mistakes.append(f"{where}: expected a file, found a folder at {path}; name a file in it")
        elif not path.is_file():
            near = suggest_name(path.name, [p.name for p in path.parent.glob("*")] if path.parent.is_dir() else [])
            hint = near if "did you mean" in near else "; paths start at this file's folder"
            self.mistakes.append(f"{where}: expected a file, found none at {path}{hint}")
        return path

    def files(self, names: Sequence[str], where: str) -> tuple[Path, ...]:
        """Several files. In messages they are numbered, unless there is only one."""
        return tuple(self.file(p, where if len(names) == 1 else f"{where}.{i}") for i, p in enumerate(names))

    def camera(self, name: str, block: CameraBlock) -> CameraEntry | None:
        where = f"cameras.{name}.intrinsics"
        path = self.file(block.intrinsics, where)
        if not path.is_file():
            return None
        try:
            lens = load_lens(path, block.camera)
        except InputError as error:
            self.mistakes.append(f"{where}: {error}")
            return None
        near = None if block.near_m is None else np.array(block.near_m)
        return CameraEntry(name, block.screen, lens, path, near, block.within_m)

    def screen(self, name: str, block: ScreenBlock) -> ScreenEntry:
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

    def _cloud(self, block: CloudBlock, where: str) -> Cloud:
        return Cloud(
            path=self.file(block.file, f"{where}.file"),
            unit_m=CLOUD_UNITS[block.unit],
            world_from_cloud=None if block.world_from_cloud is None else block.world_from_cloud.pose(),
            targets=None if block.targets is None else self.file(block.targets, f"{where}.targets"),
            point_sigma_m=block.point_sigma_m,
            also=tuple(self.file(name, f"{where}.also") for name in block.also),
        )

    def _fixed_board(self, block: FixedBoardBlock, where: str) -> FixedBoard | None:
        board = self._board(block.board, where)
        photos = {c: self.file(p, f"{where}.photos.{c}") for c, p in block.photos.items()}
        if board is None:
            return None
        tilt = float(np.radians(block.tilt_sigma_deg))
        return FixedBoard(board, block.offset_m, block.sigma_m, tilt, photos)

    def shared_board(self, block: SharedBoardBlock, where: str) -> SharedBoard:
        board = self._board(block.board, where)
        photos: dict[str, dict[str, Path]] = {}
        for camera, patterns in block.photos.items():
            for path in self._pictures(patterns, f"{where}.photos.{camera}"):
                of_camera = photos.setdefault(placement_of(path), {})
                if camera in of_camera:
                    self.mistakes.append(
                        f"{where}.photos.{camera}: expected one photograph per placement, got {of_camera[camera].name}"
                        f" and {path.name} for {placement_of(path)!r}; the last number of a name is the placement"
                    )
                of_camera[camera] = path
        placeholder = board_types.Chessboard(3, 3, 1.0)  # not used: the mistake is noted
        return SharedBoard(placeholder if board is None else board, dict(sorted(photos.items())))

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
            return board_types.parse(text)
        except ValueError as error:
            self.mistakes.append(f"{where}.board: {str(error).removeprefix(f'board {text!r}: ')}")
            return None

    def recording(self, block: RecordingBlock, where: str) -> RecordingEntry:
        run = None if block.run is None else self.folder / block.run
        if run is not None and not (run / "run.yaml").is_file():
            self.mistakes.append(f"{where}.run: expected a run folder, found no run.yaml in {run}")
        poses = None if block.poses is None else self.file(block.poses, f"{where}.poses")
        if run is not None and block.use_truth:
            poses = self.file(str(Path(str(block.run)) / "truth" / "pose.csv"), f"{where}.use_truth")
        return RecordingEntry(run, None if block.spots is None else self.file(block.spots, f"{where}.spots"), poses)


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
    if len(cameras) == 1 and _is_camera_yaml(path):
        return load_camera(path)
    fx, fy, cx, cy = model.pinhole
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return CameraFile(model.name, model.image_size_px, matrix, model.distortion, model.lens)


def _is_camera_yaml(path: Path) -> bool:
    return re.search(r"^schema:\s*['\"]?beampose/camera/", text_of_file(path), re.MULTILINE) is not None
