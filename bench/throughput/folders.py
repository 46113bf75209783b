"""Run folders of any length and format from one set of simulated pictures, which is kept."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from bench.random_pictures.render import Renderer
from bench.random_pictures.scene import picture_scene
from bench.random_pictures.write_folder import write_pictures
from lab.simulate.scenarios import SCENARIOS, Light
from lab.simulate.write import simulate

PICTURES = 300  # simulated; longer runs repeat them forwards and backwards, so that the motion is continuous
SEED = 9100
FORMATS = ("png", "tiff", "pgm", "mjpeg", "points")
TEXTURED = "textured"  # the first scenario on a screen with a texture of 4 %: 12 hot pixels, 20 % clutter
PHOTOGRAPHS = "photographs-"  # and a seed: that recording of bench.random_pictures, 1280x1024


def run_folder(kept: Path, kind: str, frames: int, scenario: str) -> Path:
    """A run folder with this format and number of frames; it is written if it does not exist.

    scenario: of lab.simulate, TEXTURED, or PHOTOGRAPHS with a seed.
    """
    folder = kept / f"{scenario}-{kind}-{frames}"
    if (folder / "run.yaml").is_file():
        return folder
    shutil.rmtree(folder, ignore_errors=True)
    if kind == "points":
        return simulate(scenario, folder, seed=SEED, frames=frames, points=True)
    simulated = _simulated(kept, scenario)
    folder.mkdir(parents=True)
    shutil.copy(simulated / "rig.yaml", folder / "rig.yaml")
    text = (simulated / "run.yaml").read_text("utf-8")
    for camera in sorted(p.name for p in (simulated / "frames").iterdir()):
        pictures = sorted((simulated / "frames" / camera).iterdir())
        if kind == "mjpeg":
            _write_video(folder / f"{camera}.avi", pictures, frames)
            text = text.replace(f"frames/{camera}", f"{camera}.avi")
        else:
            suffix, write = _WRITERS[kind]
            stored = [_converted(kept / f"{scenario}-{kind}" / camera, p, suffix, write) for p in pictures]
            target = folder / "frames" / camera
            target.mkdir(parents=True)
            for frame, k in enumerate(_to_and_fro(len(stored), frames)):
                os.link(stored[k], target / f"{frame:06d}{suffix}")
    (folder / "run.yaml").write_text(text, "utf-8")
    return folder


def _simulated(kept: Path, scenario: str) -> Path:
    folder = kept / scenario
    if not (folder / "run.yaml").is_file():
        shutil.rmtree(folder, ignore_errors=True)
        if scenario.startswith(PHOTOGRAPHS):
            seed = int(scenario.removeprefix(PHOTOGRAPHS))
            shown = picture_scene(seed, "photographs", PICTURES, sizes_px=((1280, 1024),))
            write_pictures(Renderer(shown), folder)
        elif scenario == TEXTURED:
            simulate(replace(SCENARIOS["huo2015"], light=Light(texture=0.04)), folder, seed=SEED, frames=PICTURES)
        else:
            simulate(scenario, folder, seed=SEED, frames=PICTURES)
    return folder


def _to_and_fro(pictures: int, frames: int) -> Iterator[int]:
    """0, 1, ..., last, last, ..., 1, 0, 0, 1, ..."""
    for frame in range(frames):
        turn, k = divmod(frame, pictures)
        yield k if turn % 2 == 0 else pictures - 1 - k


def _converted(folder: Path, picture: Path, suffix: str, write: Callable[[Path, np.ndarray], None] | None) -> Path:
    """The picture in another format; it is written if it does not exist."""
    if write is None:
        return picture
    path = folder / f"{picture.stem}{suffix}"
    if not path.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        write(path, cv2.imread(str(picture), cv2.IMREAD_UNCHANGED))
    return path


def _write_tiff(path: Path, picture: np.ndarray) -> None:
    cv2.imwrite(str(path), picture, [cv2.IMWRITE_TIFF_COMPRESSION, 1])  # uncompressed


def _write_pgm(path: Path, picture: np.ndarray) -> None:
    cv2.imwrite(str(path), picture)


_WRITERS: dict[str, tuple[str, Callable[[Path, np.ndarray], None] | None]] = {
    "png": (".png", None),
    "tiff": (".tif", _write_tiff),
    "pgm": (".pgm", _write_pgm),
}


def _write_video(path: Path, pictures: list[Path], frames: int) -> None:
    first = cv2.imread(str(pictures[0]), cv2.IMREAD_UNCHANGED)
    size = (first.shape[1], first.shape[0])
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 100, size, False)
    writer.set(cv2.VIDEOWRITER_PROP_QUALITY, 95)
    for k in _to_and_fro(len(pictures), frames):
        writer.write(cv2.imread(str(pictures[k]), cv2.IMREAD_GRAYSCALE))
    writer.release()
