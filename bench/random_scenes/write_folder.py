"""A scene as a run folder in the documented file formats."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from bench.random_scenes.scene import Scene
from lab.files.rig.rig_file import RigFile, covariance_blocks, save_rig
from lab.files.run.run_file import save_run
from lab.files.text import columns


def write_run_folder(scene: Scene, folder: Path) -> Path:
    """Write rig.yaml, run.yaml, detections.csv, truth/pose.csv and truth/spots.csv.

    A missing picture has one row without a position, the only form that the file format has for it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    covariances = {} if scene.covariance is None else covariance_blocks(scene.covariance)
    save_rig(RigFile(scene.known_rig, covariances), folder / "rig.yaml")
    content: dict[str, object] = {
        "name": f"seed-{scene.seed}",
        "rig": "rig.yaml",
        "frame_rate_hz": scene.frame_rate_hz,
        "cameras": {name: {"detections": "detections.csv"} for name in scene.rig.cameras},
        "notes": scene.text,
    }
    content |= prior_block(scene)
    save_run(content, folder)
    _write(folder / "detections.csv", columns.DETECTIONS, _detection_rows(scene))
    write_truth(scene, folder)
    return folder


def prior_block(scene: Scene) -> dict[str, object]:
    """The key `prior` of run.yaml; empty without one."""
    if scene.prior is None:
        return {}
    return {
        "prior": {
            "position_m": scene.prior.centre.translation.tolist(),
            "yaw_pitch_roll_deg": np.rad2deg(scene.prior.centre.ypr).tolist(),
            "within_m": scene.prior.within_m,
            "within_deg": float(np.rad2deg(scene.prior.within_rad)),
        }
    }


def write_truth(scene: Scene, folder: Path) -> None:
    """Write truth/pose.csv and truth/spots.csv of a run folder."""
    (folder / "truth").mkdir(exist_ok=True)
    quaternions = scene.poses.quaternion_wxyz
    pose_rows = (
        (k, f"{t:.12g}", *(f"{x:.15g}" for x in (*p, *q)))
        for k, (t, p, q) in enumerate(zip(scene.t_s, scene.poses.translation, quaternions, strict=True))
    )
    _write(folder / "truth" / "pose.csv", columns.TRUTH_POSE, pose_rows)
    spot_rows = (
        (k, camera, spot, *("" if np.isnan(x) else f"{x:.9f}" for x in scene.uv_px[k, i]), scene.in_view[k, i])
        for k in range(len(scene))
        for i, (camera, spot) in enumerate(scene.rig.views())
    )
    _write(folder / "truth" / "spots.csv", columns.TRUTH_SPOTS, spot_rows)


def _detection_rows(scene: Scene) -> Iterable[tuple[object, ...]]:
    for k in range(len(scene)):
        for camera, found in zip(scene.rig.cameras, scene.found(k), strict=True):
            if found is None:
                yield (k, camera, *[""] * 10)
                continue
            for uv, cov in zip(found.uv_px, found.cov_px2, strict=True):
                sigma_u, sigma_v = np.sqrt(np.diagonal(cov))
                numbers = (f"{uv[0]:.9f}", f"{uv[1]:.9f}", f"{sigma_u:.12g}", f"{sigma_v:.12g}")
                yield (k, camera, *numbers, "", "", "", "", "", "0")


def _write(path: Path, header: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)
