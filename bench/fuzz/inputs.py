"""Valid inputs to start from: a run with points, one with pictures, a video, a calibration project, lens files."""

from __future__ import annotations

import shutil
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np

from geometry.rotations import quaternion_from_matrix
from lab.files.rig.interchange import convert
from lab.results.compare import read_reference
from lab.runs.batch.batch import BatchOptions, process_batch
from lab.runs.process import process_run
from lab.simulate.write import simulate

ROOT = Path(__file__).resolve().parents[2]
HAS_PYARROW = find_spec("pyarrow") is not None  # an extra: without it no Parquet
PICTURE_SUFFIXES = (".png", ".tif", ".bmp", ".jpg", ".pgm")


def write_inputs(folder: Path) -> Path:
    """Write all valid inputs into a new folder; returns it."""
    simulate("huo2015", folder / "points", seed=1, frames=8, points=True)
    times = "".join(f"{n},{n / 100}\n" for n in range(8))
    (folder / "points" / "times.csv").write_text(f"frame,t_s\n{times}")
    with (folder / "points" / "run.yaml").open("a") as file:
        file.write("timestamps: times.csv\ntracker:\n  r1_px: 12\n  detect:\n    threshold_sigma: 5.0\n")
    simulate("huo2015", folder / "pictures", seed=1, frames=2, scale=0.2)
    shutil.copytree(ROOT / "sample_runs" / "calibration", folder / "calibration")
    _write_lenses(folder / "lenses")
    rng = np.random.default_rng(1)
    pictures = [_picture(rng, 16 + 4 * n) for n in range(4)]
    for suffix in PICTURE_SUFFIXES:
        (folder / "shots" / suffix[1:]).mkdir(parents=True)
        for n, picture in enumerate(pictures):
            cv2.imwrite(str(folder / "shots" / suffix[1:] / f"{n:03d}{suffix}"), picture)
    video = cv2.VideoWriter(str(folder / "video.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 25, (64, 48), False)
    for picture in pictures:
        video.write(picture)
    video.release()
    _write_results(folder)
    return folder


def _write_results(folder: Path) -> None:
    """Results of the run with points, a batch of it, and its truth as references in both formats."""
    process_run(folder / "points", folder / "results")
    process_batch([folder / "points"], folder / "batch", BatchOptions(parquet=HAS_PYARROW))
    shutil.copy(folder / "points" / "truth" / "pose.csv", folder / "reference.csv")
    truth, _ = read_reference(folder / "reference.csv")
    assert truth.position_m is not None
    assert truth.rotation is not None
    w, x, y, z = quaternion_from_matrix(truth.rotation).T
    rows = np.column_stack([truth.t_s, truth.position_m, x, y, z, w])
    np.savetxt(folder / "reference.tum", rows)


def _write_lenses(folder: Path) -> None:
    folder.mkdir()
    source = ROOT / "sample_runs" / "calibration" / "camera-left.yaml"
    shutil.copy(source, folder / "camera.yaml")
    for name in ("opencv.yml", "camera_info.yaml"):
        convert(source, folder / name)
    convert(ROOT / "sample_runs" / "huo2015" / "rig.yaml", folder / "camchain.yaml")


def _picture(rng: np.random.Generator, column: int) -> np.ndarray:  # type: ignore[type-arg]
    """A noisy picture (48, 64) with one spot."""
    y, x = np.mgrid[:48, :64]
    light = 20 + 150 * np.exp(-((x - column) ** 2 + (y - 24) ** 2) / 4.5)
    return np.clip(light + rng.normal(0, 2, light.shape), 0, 255).astype(np.uint8)
