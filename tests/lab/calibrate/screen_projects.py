"""Simulated screen calibration projects on disk, measured with the `fan` example rig, and the true rig."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from geometry.rig import Rig
from lab.files.rig.camera_file import CameraFile, save_camera
from lab.files.text.yaml_text import write_mapping
from lab.simulate.scenarios import fan

SURVEY_SIGMA_M, PIXEL_SIGMA_PX = 3e-4, 0.1
SIZE_M = (2.4, 2.0)


def truth(bow: float = 0.0) -> Rig:
    """Two screens of 2.4 m x 2 m, each with its camera; no vehicle."""
    rig = fan()
    screens = {n: replace(s, size_m=SIZE_M, bow=(bow, 0.0, 0.0)) for n, s in rig.screens.items()}
    return Rig(screens, rig.cameras, {}, {})


def write_project(folder: Path, seed: int = 0, bow: float = 0.0, points_each: int = 16, **extra: object) -> Path:
    """Write calibration.yaml with lenses, survey.csv and points.csv; return its path. extra: further keys of it."""
    rng = np.random.default_rng(seed)
    rig = truth(bow)
    folder.mkdir(parents=True, exist_ok=True)
    survey = ["point,x_m,y_m,z_m,sigma_x_m,sigma_y_m,sigma_z_m,screen"]
    points = ["camera,point,u_px,v_px,sigma_px"]
    for name, camera in rig.cameras.items():
        screen = rig.screens[camera.screen]
        save_camera(
            CameraFile(name, camera.image_size_px, camera.matrix, camera.distortion), folder / f"{name}-camera.yaml"
        )
        done = 0
        while done < points_each:
            x, y = rng.uniform(-1, 1, 2) * np.array(SIZE_M) / 2 * 0.95
            xyz = screen.world_from_screen.apply(np.array([x, y, bow * x * x]))
            pixel = camera.project(xyz)
            if not camera.sees(pixel):
                continue
            point = f"{name[0].upper()}{done + 1}"
            measured = xyz + SURVEY_SIGMA_M * rng.normal(size=3)
            u, v = pixel + PIXEL_SIGMA_PX * rng.normal(size=2)
            survey.append(",".join([point, *(f"{c:.6f}" for c in measured), *[str(SURVEY_SIGMA_M)] * 3, screen.name]))
            points.append(f"{name},{point},{u:.4f},{v:.4f},{PIXEL_SIGMA_PX}")
            done += 1
    (folder / "survey.csv").write_text("\n".join(survey) + "\n")
    (folder / "points.csv").write_text("\n".join(points) + "\n")
    content: dict[str, object] = {
        "schema": "beampose/calibration/1",
        "name": "bay 3",
        "date": "2026-03-14",
        "cameras": {n: {"intrinsics": f"{n}-camera.yaml", "screen": c.screen} for n, c in rig.cameras.items()},
        "screens": {n: {"size_m": list(SIZE_M)} for n in rig.screens},
        "survey": "survey.csv",
        "points": "points.csv",
    }
    content.update(extra)
    write_mapping(content, folder / "calibration.yaml")
    return folder / "calibration.yaml"
