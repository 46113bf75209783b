"""A simulated lab for the drift check: a stored rig with its covariance, the true rig, control points and spots."""

from __future__ import annotations

import datetime
from dataclasses import replace
from pathlib import Path

import numpy as np

from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.rig import Rig
from geometry.rotations import exp
from geometry.uncertainty.rig_uncertainty import RigCovariance, camera_names, perturbed_rig
from lab.files.rig.camera_file import CalibrationState
from lab.files.rig.rig_file import RigFile, save_rig
from tests.geometry.scenes import LENSES, paper_rig

DAY = datetime.date(2026, 5, 1)
STATE = CalibrationState(date=datetime.date(2026, 3, 1), verdict="PASS", valid_until=datetime.date(2026, 9, 1))
POINT_SIGMA_M = 1e-4
_WRITTEN: dict[tuple[int, int, int], tuple[bytes, object]] = {}  # rig.yaml of what is kept alive beside it


def rig_and_covariance() -> tuple[Rig, RigCovariance]:
    """The stored rig, and the covariance of a calibration from 60 control points per camera measured to 0.15 px.

    Computed by numeric derivatives of the projection, independently of the code of the check.
    """
    rig = paper_rig(LENSES[5], (4.0, 3.0))
    names: list[str] = []
    blocks = []
    for name, camera in rig.cameras.items():
        own = [f"cameras.{name}.{p}" for p in camera_names(camera)]
        x, y = np.meshgrid(np.linspace(-1.8, 1.8, 10), np.linspace(-1.3, 1.3, 6))
        # Points on two planes, as in a calibration with boards: a single plane does not determine the focal length.
        z = 0.8 * ((np.arange(x.size) % 2) - 0.5)
        pose = rig.screens[camera.screen].world_from_screen
        xyz = pose.apply(np.stack([x.ravel(), y.ravel(), z], axis=-1))
        J = np.empty((xyz.shape[0] * 2, len(own)))
        for k, parameter in enumerate(own):
            step = np.zeros(len(own))
            step[k] = 1e-3 if parameter.endswith((".fx", ".fy", ".cx", ".cy")) else 1e-6
            ends = [perturbed_rig(rig, own, s * step).cameras[name].project(xyz).ravel() for s in (1, -1)]
            J[:, k] = (ends[0] - ends[1]) / (2 * step[k])
        names += own
        blocks.append(np.linalg.inv(J.T @ J / 0.15**2))
    size = len(names)
    matrix = np.zeros((size, size))
    at = 0
    for block in blocks:
        matrix[at : at + len(block), at : at + len(block)] = block
        at += len(block)
    return rig, RigCovariance(tuple(names), matrix)


def true_rig(rig: Rig, covariance: RigCovariance, rng: np.random.Generator) -> Rig:
    """The true rig: it differs from the stored one by a random error with the stated covariance."""
    values, vectors = np.linalg.eigh(covariance.matrix)
    return perturbed_rig(
        rig, covariance.names, vectors @ (np.sqrt(np.maximum(values, 0)) * rng.normal(size=len(values)))
    )


def turned(rig: Rig, camera: str, degrees: float, axis: int = 1) -> Rig:
    """The rig with a camera rotated about one of its own axes."""
    old = rig.cameras[camera]
    turn = np.zeros(3)
    turn[axis] = np.deg2rad(degrees)
    new = replace(old, camera_from_world=Pose(exp(turn), np.zeros(3)) @ old.camera_from_world)
    return Rig(rig.screens, {**rig.cameras, camera: new}, rig.beams, rig.spots)


def control_points(rig: Rig) -> dict[str, tuple[str, np.ndarray]]:
    """Five control points on each screen, by name: the screen and the coordinates on it (2,), m."""
    places = [(-1.0, -0.8), (1.0, -0.8), (1.0, 0.8), (-1.0, 0.8), (0.1, 0.0)]
    return {f"{s[0].upper()}{i}": (s, np.array(p)) for s in rig.screens for i, p in enumerate(places, 1)}


def write_rig(folder: Path, rig: Rig, covariance: RigCovariance | None, state: CalibrationState | None = STATE) -> Path:
    """Write rig.yaml of a calibrated lab; return its path."""
    path = folder / "rig.yaml"
    known = id(rig), id(covariance), id(state)
    if known not in _WRITTEN:  # a covariance of 32 parameters takes a tenth of a second
        save_rig(RigFile(rig, {} if covariance is None else {"target": covariance}, state), path)
        _WRITTEN[known] = path.read_bytes(), (rig, covariance, state)
    path.write_bytes(_WRITTEN[known][0])
    return path


def write_points(
    folder: Path,
    today: Rig,
    rng: np.random.Generator,
    *,
    wrong: dict[str, tuple[float, float]] | None = None,
    on_screens: bool = False,
    sigma_px: float = 0.1,
) -> tuple[Path, Path]:
    """Write points.csv and survey.csv of a check of the true rig `today`. wrong: errors of single points, px."""
    pixels, survey = ["camera,point,u_px,v_px,sigma_px"], []
    survey.append("point,screen,x_m,y_m,sigma_x_m,sigma_y_m" if on_screens else
                  "point,x_m,y_m,z_m,sigma_x_m,sigma_y_m,sigma_z_m")  # fmt: skip
    for name, (screen, xy) in control_points(today).items():
        pose = today.screens[screen].world_from_screen
        error = rng.normal(0, POINT_SIGMA_M, 3)
        if on_screens:
            true = pose.apply(np.array([*(xy + error[:2]), 0.0]))
            survey.append(f"{name},{screen},{xy[0]:.7f},{xy[1]:.7f},{POINT_SIGMA_M},{POINT_SIGMA_M}")
        else:
            surveyed = pose.apply(np.array([*xy, 0.0]))
            true = surveyed + error
            survey.append(f"{name}," + ",".join(f"{v:.7f}" for v in surveyed) + f",{POINT_SIGMA_M}" * 3)
        for camera in today.cameras.values():
            if camera.screen != screen:
                continue
            uv = camera.project(true) + rng.normal(0, sigma_px, 2) + np.array((wrong or {}).get(name, (0.0, 0.0)))
            pixels.append(f"{camera.name},{name},{uv[0]:.5f},{uv[1]:.5f},{sigma_px}")
    (folder / "points.csv").write_text("\n".join(pixels) + "\n")
    (folder / "survey.csv").write_text("\n".join(survey) + "\n")
    return folder / "points.csv", folder / "survey.csv"


SPOTS_HEADER = (
    "frame,t_s,camera,spot,u_px,v_px,sigma_u_px,sigma_v_px,status,predicted_u_px,predicted_v_px,gain,cov_uv_px2"
)
ATTITUDE_HEADER = (
    "frame,t_s,x_m,y_m,z_m,qw,qx,qy,qz,yaw_deg,pitch_deg,roll_deg,sigma_x_m,sigma_y_m,sigma_z_m,"
    "sigma_yaw_deg,sigma_pitch_deg,sigma_roll_deg,spots_used,rms_px,status"
)


def write_still(
    folder: Path, today: Rig, pose: Pose, rng: np.random.Generator, *, frames: int = 50, wander_px: float = 0.0
) -> Path:
    """Write spots.csv, attitude.csv and pose.csv of a vehicle at rest with 0.05 px noise; return the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    model = SpotModel.of(today)
    uv = model.derivatives(pose).pixels
    rows, attitude = [SPOTS_HEADER], [ATTITUDE_HEADER]
    p, q = pose.translation, pose.quaternion_wxyz
    seven = ",".join(f"{v:.9f}" for v in (*p, *q))
    for frame in range(frames):
        t = frame / 100
        seen = uv + rng.normal(0, 0.05, uv.shape) + wander_px * frame / frames
        for (camera, spot), (u, v) in zip(model.views, seen.tolist(), strict=True):
            rows.append(f"{frame},{t},{camera},{spot},{u:.4f},{v:.4f},0.05,0.05,matched,{u:.4f},{v:.4f},0.5,0")
        attitude.append(f"{frame},{t},{seven},0,0,0,0.001,0.001,0.001,0.01,0.01,0.01,6,0.05,measured")
    (folder / "spots.csv").write_text("\n".join(rows) + "\n")
    (folder / "attitude.csv").write_text("\n".join(attitude) + "\n")
    (folder / "pose.csv").write_text(f"frame,t_s,x_m,y_m,z_m,qw,qx,qy,qz\n0,0,{seven}\n")
    return folder
