"""Recordings for the gallery: what a table of sights states, with its mistake. Nothing here knows how it is found."""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from calibration.boards.board_types import parse
from geometry.pose import Pose
from geometry.rig import Rig
from geometry.rotations import exp
from lab.files.rig.rig_file import load_rig, save_rig
from lab.simulate.board_photo import PhotoSettings, photograph
from lab.simulate.campaign import board_poses
from lab.simulate.scenarios import RIGS, SCENARIOS, Clutter, PictureTiming, scaled, unequal_fan
from lab.simulate.write import simulate

BOARD = "chessboard:12x8:30mm"
PHOTOS = 16


def record(folder: Path, stated: Mapping[str, Any], frames: int | None = None) -> Path:
    """A simulated run folder, of half-size pictures.

    stated: scenario, frames, seed; `change` has other values for fields of the scenario and of its parts, such as
    {light: {peak_dn: 900}}; `late` the delays (frames) of cameras, which run.yaml does not state.
    """
    scenario = SCENARIOS[stated["scenario"]]
    light = replace(scenario.light, reflections=0, hot_pixels=0)  # one sight at a time
    scenario = _changed(replace(scenario, clutter=Clutter(per_spot=0), light=light), stated.get("change", {}))
    late = (PictureTiming(name, delay) for name, delay in stated.get("late", {}).items())
    scenario = replace(scenario, clocks=(*scenario.clocks, *late))
    with tempfile.TemporaryDirectory() as other:
        save_rig(with_lenses(scaled(RIGS[scenario.rig](), 0.5)), Path(other) / "rig.yaml")
        rig = Path(other) / "rig.yaml"
        simulate(scenario, folder, seed=stated.get("seed", 1), frames=frames or stated["frames"], rig=rig)
    path = folder / "run.yaml"
    run = yaml.safe_load(path.read_text(encoding="utf-8"))
    for camera in run["cameras"].values():
        camera.pop("time_offset_s", None)
    path.write_text(yaml.safe_dump(run, sort_keys=False), encoding="utf-8")
    return folder


def with_lenses(rig: Rig) -> Rig:
    """The rig with a lens of its own in each camera: two lenses are never alike to the last digit."""
    cameras = {}
    for k, (name, camera) in enumerate(rig.cameras.items()):
        matrix = camera.matrix * np.array([[1 + 0.01 * k, 1, 1], [1, 1 + 0.01 * k, 1], [1, 1, 1]])
        cameras[name] = replace(camera, matrix=matrix)
    return replace(rig, cameras=cameras)


def _changed(value: Any, change: Mapping[str, Any]) -> Any:
    """A frozen value with other values in some fields; a mapping changes fields of a part."""
    parts = {k: _changed(getattr(value, k), v) if isinstance(v, Mapping) else v for k, v in change.items()}
    return replace(value, **parts)


def photograph_board(folder: Path, bow_mm: float) -> Path:
    """board.yaml and photographs of a printed board, which is bowed by so much over its length."""
    board = parse(BOARD)
    camera = replace(unequal_fan().cameras["left"], camera_from_world=Pose.identity())
    half = np.ptp(board.points[:, 0]) / 2
    poses = board_poses(PHOTOS)
    (folder / "photos").mkdir(parents=True)
    for k in range(PHOTOS):
        shot = photograph(
            board, camera, poses[k], np.array([bow_mm / 1000 / half**2, 0, 0]), PhotoSettings(noise_dn=2, samples=16), k
        )
        cv2.imwrite(str(folder / "photos" / f"{k:02d}.png"), shot.image)
    return folder


# Mistakes: each changes the files of a run folder.


def first(run: Path) -> str:
    """The first camera of a run folder."""
    return min(path.name for path in (run / "frames").iterdir())


def last(run: Path) -> str:
    """Its last camera."""
    return max(path.name for path in (run / "frames").iterdir())


def exchange_cameras(run: Path) -> None:
    """The pictures of two cameras are in each other's folder."""
    left, right, other = (run / "frames" / name for name in (first(run), last(run), "other"))
    left.rename(other)
    right.rename(left)
    other.rename(right)


def turn_camera(run: Path) -> None:
    """The first camera has turned by 0.1 deg since the calibration."""
    _change_rig(run, lambda pose: Pose(exp(np.deg2rad([0.0, 0.1, 0.0])), np.zeros(3)) @ pose, camera=first(run))


def shift_screen(run: Path) -> None:
    """The right screen has moved by 5 mm along its normal since the calibration."""
    _change_rig(run, lambda pose: pose @ Pose(np.eye(3), np.array([0.0, 0.0, 0.005])), screen="right")


def _change_rig(run: Path, change: Callable[[Pose], Pose], camera: str = "", screen: str = "") -> None:
    """Another pose of a camera or a screen in rig.yaml, which then no longer describes the recording."""
    rig = load_rig(run / "rig.yaml")
    cameras = {
        n: replace(c, camera_from_world=change(c.camera_from_world)) if n == camera else c
        for n, c in rig.cameras.items()
    }
    screens = {
        n: replace(s, world_from_screen=change(s.world_from_screen)) if n == screen else s
        for n, s in rig.screens.items()
    }
    save_rig(replace(rig, cameras=cameras, screens=screens), run / "rig.yaml")


def exchange_lenses(run: Path) -> None:
    """rig.yaml has each other's lens for the two cameras; one has a focal length that is 1 % longer."""
    rig = load_rig(run / "rig.yaml")
    a, b = rig.cameras[first(run)], rig.cameras[last(run)]
    lenses = {
        a.name: replace(a, matrix=b.matrix, distortion=b.distortion),
        b.name: replace(b, matrix=a.matrix, distortion=a.distortion),
    }
    save_rig(replace(rig, cameras={**rig.cameras, **lenses}), run / "rig.yaml")


def slip_a_frame(run: Path) -> None:
    """The last camera missed the first trigger: each of its pictures has the number of the one before."""
    pictures = sorted((run / "frames" / last(run)).iterdir())
    pictures[0].unlink()
    for before, after in itertools.pairwise(pictures):
        after.rename(before)


def mirror(run: Path) -> None:
    """The last camera delivers mirrored pictures."""
    _change_pictures(run / "frames" / last(run), lambda picture: picture[:, ::-1])


def compress(run: Path) -> None:
    """JPEG files of quality 75 in place of PNG."""
    for folder in (run / "frames").iterdir():
        for path in sorted(folder.iterdir()):
            cv2.imwrite(
                str(path.with_suffix(".jpg")),
                cv2.imread(str(path), cv2.IMREAD_UNCHANGED),
                [cv2.IMWRITE_JPEG_QUALITY, 75],
            )
            path.unlink()


def filter_colours(run: Path) -> None:
    """The raw pictures of a colour camera: red light reaches the pixels behind green and blue filters weakly."""
    share = np.array([[1.0, 0.25], [0.25, 0.08]])

    def mosaic(picture: np.ndarray) -> np.ndarray:
        rows, columns = picture.shape
        black = 8.0
        light = np.tile(share, (rows // 2, columns // 2)) * (picture - black)
        return np.clip(np.round(black + light), 0, 255).astype(np.uint8)

    for folder in (run / "frames").iterdir():
        _change_pictures(folder, mosaic)


def knock_camera(run: Path) -> None:
    """The first camera is knocked in the middle of the recording: its pictures move by 3 px."""
    pictures = sorted((run / "frames" / first(run)).iterdir())
    for path in pictures[len(pictures) // 2 :]:
        picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(path), np.roll(picture, (1, 3), axis=(0, 1)))


def _change_pictures(folder: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    for path in sorted(folder.iterdir()):
        picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(path), change(picture))


MISTAKES: Mapping[str, Callable[[Path], None]] = {
    f.__name__: f
    for f in (
        exchange_cameras, turn_camera, shift_screen, exchange_lenses, slip_a_frame, mirror, compress, filter_colours,
        knock_camera,
    )
}  # fmt: skip
