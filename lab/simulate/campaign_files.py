"""A simulated calibration campaign as a folder: the input of `beampose calibrate rig`, and the truth."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2

from calibration.boards import board_types as boards
from geometry.arrays import Array
from geometry.camera import Camera
from geometry.pose import Pose
from geometry.rig import Rig
from lab.errors import InputError
from lab.files.project.point_files import POINTS, POSE_SIGMAS, SURVEY, SURVEY_SIGMAS
from lab.files.project.project_blocks import SCHEMA
from lab.files.rig.board_file import save_board
from lab.files.rig.camera_block import Covariance
from lab.files.rig.camera_file import CameraCalibration, CameraFile, save_camera
from lab.files.rig.rig_file import RigFile, as_mapping, load_rig, pose_mapping, save_rig
from lab.files.text import columns
from lab.files.text.atomic_write import atomic_folder
from lab.files.text.csv_text import write_table
from lab.files.text.error_text import suggest_name
from lab.files.text.yaml_text import write_mapping
from lab.simulate.board_photo import PhotoSettings, photograph
from lab.simulate.calibration_campaign import Campaign, CampaignQuality, LensDraw, board_poses, draw_campaign
from lab.simulate.rigs import RIGS

PROJECT = "calibration.yaml"
BOARD = "charuco:11x9:36mm:27mm:DICT_4X4_100"  # usable also where part of the board is outside the picture
PHOTOS = 24  # per camera
_PHOTO_POSES = 11  # seed of the poses of the board, other than those of the lens covariance
_DATE = "2026-01-15"  # of all measurements; fixed, so that the same seed gives the same bytes


def simulate_calibration(
    out: Path,
    *,
    seed: int = 0,
    rig: str = "fan",
    positions: int = 40,
    wrong: float = 0.0,
    photos: bool = False,
    quality: CampaignQuality | None = None,
) -> Path:
    """Write a complete calibration campaign into a new folder; returns the folder.

    calibration.yaml, a camera.yaml per camera, survey.csv, points.csv, poses.csv, spots.csv, and truth/: rig.yaml (as
    mounted), poses.csv (world_from_body at the positions). The same arguments give the same bytes.

    rig: a name of RIGS, or the path of a rig.yaml with the designed rig. positions: of the stand. wrong: share of
    outliers among the pixels of control points and spots. photos: also board photographs of each camera, for `beampose
    calibrate camera`. quality: sigmas of mounting and measurement.

    Raises:
        InputError: an argument is not valid, the rig file cannot be read, or the folder exists.
    """
    if not 0 <= wrong < 0.3:
        raise InputError(f"wrong: expected a share from 0 up to 0.3, got {wrong:g}")
    if positions < 3:
        raise InputError(f"positions: expected 3 or more, got {positions}")
    q = replace(CampaignQuality() if quality is None else quality, positions=positions, wrong=wrong)
    campaign = draw_campaign(seed, rig if rig in RIGS else _designed(rig), q)
    with atomic_folder(Path(out), lambda _: False) as folder:
        write_campaign(campaign, folder)
        if photos:
            _write_photos(campaign, folder)
    return Path(out)


def _designed(rig: str) -> Rig:
    """The rig of a rig.yaml; a word that names no file and no rig is taken for a misspelt name.

    Raises:
        InputError: there is no such rig or file, or the file is wrong.
    """
    if not Path(rig).exists():
        raise InputError(f"rig: expected a rig.yaml or a rig's name, got {rig!r}{suggest_name(rig, RIGS)}")
    return load_rig(Path(rig))


def write_campaign(c: Campaign, folder: Path) -> None:
    """Write the files of a campaign into an existing folder."""
    for name, lens in c.lenses.items():
        save_camera(_camera_file(name, lens), folder / f"camera-{name}.yaml")
    screens = list(c.truth.screens)
    survey = [
        (name, *_metres(xyz), *[_short(c.quality.survey_m)] * 3, screens[k])
        for name, xyz, k in zip(c.dot_names, c.dots_surveyed, c.dot_screen, strict=True)
    ]
    write_table(folder / "survey.csv", (*SURVEY, *SURVEY_SIGMAS, "screen"), survey)
    cameras = list(c.truth.cameras)
    points = [
        (cameras[k], c.dot_names[d], *_pixels(uv), _short(c.quality.dot_px))
        for k, d, uv in zip(c.seen_camera, c.seen_dot, c.seen_pixels, strict=True)
    ]
    write_table(folder / "points.csv", (*POINTS, "sigma_px"), points)
    sigmas = [*[_short(c.quality.stand_m)] * 3, *[_short(c.quality.stand_deg)] * 3]
    write_table(
        folder / "poses.csv",
        (*columns.TRUTH_POSE, *POSE_SIGMAS),
        [(*row, *sigmas) for row in _pose_rows(c.stand_recorded)],
    )
    views = c.truth.views()
    spots = [
        (k, *views[v], *_pixels(uv), _short(c.quality.spot_px))
        for k, v, uv in zip(c.spots.position, c.spots.view, c.spots.pixels, strict=True)
    ]
    write_table(folder / "spots.csv", ("frame", "camera", "spot", "u_px", "v_px", "sigma_px"), spots)
    (folder / "truth").mkdir()
    save_rig(c.truth, folder / "truth" / "rig.yaml")
    in_world = c.world_from_stand @ c.stand_from_body
    write_table(folder / "truth" / "poses.csv", columns.TRUTH_POSE, _pose_rows(in_world))
    write_mapping(_project(c), folder / PROJECT)


def _project(c: Campaign) -> dict[str, Any]:
    out: dict[str, Any] = {
        "schema": SCHEMA,
        "name": f"{c.name}-{c.seed}",
        "date": _DATE,
        "cameras": {
            n: {
                "intrinsics": f"camera-{n}.yaml",
                "screen": cam.screen,
                "near_m": _rounded(c.nominal.cameras[n].camera_from_world.inverse().translation),
            }
            for n, cam in c.truth.cameras.items()
        },
        "screens": {n: {} if s.size_m is None else {"size_m": list(s.size_m)} for n, s in c.truth.screens.items()},
        "survey": "survey.csv",
        "points": "points.csv",
        "target": as_mapping(RigFile(c.nominal))["target"],
    }
    stand: dict[str, Any] = {}
    if c.quality.place_known:
        stand |= {
            "world_from_stand": pose_mapping(c.stand_surveyed),
            "sigma_m": c.quality.place_m,
            "sigma_deg": c.quality.place_deg,
        }
    out["stand"] = stand | {"pose_sigma_m": c.quality.stand_m, "pose_sigma_deg": c.quality.stand_deg}
    out["recordings"] = [{"spots": "spots.csv", "poses": "poses.csv"}]
    out["notes"] = f"simulated: seed {c.seed}; the truth is in truth/"
    return out


def _camera_file(name: str, lens: LensDraw) -> CameraFile:
    c = lens.camera
    covariance = Covariance(lens.names, lens.covariance)
    state = CameraCalibration(date=_DATE, verdict="PASS", notes="simulated")
    return CameraFile(name, c.image_size_px, c.matrix, c.distortion, c.lens, covariance, state)


def _write_photos(c: Campaign, folder: Path) -> None:
    """Write photographs of a board by each camera, and board.yaml."""
    board = boards.parse(BOARD)
    save_board(board, folder / "board.yaml")
    for i, (name, camera) in enumerate(c.truth.cameras.items()):
        into = folder / "photos" / name
        into.mkdir(parents=True)
        alone = replace(camera, camera_from_world=Pose.identity())
        shoot = partial(_photograph, board, alone, board_poses(PHOTOS, seed=_PHOTO_POSES + i), c.seed, into)
        with ThreadPoolExecutor(max_workers=min(4, os.cpu_count() or 1)) as pool:
            list(pool.map(shoot, range(PHOTOS)))


def _photograph(board: boards.Board, camera: Camera, poses: Pose, seed: int, into: Path, k: int) -> None:
    photo = photograph(board, camera, poses[k], look=PhotoSettings(noise_dn=2.0, samples=16), seed=seed * 1000 + k)
    if not cv2.imwrite(str(into / f"{k:02d}.png"), photo.image):
        raise InputError(f"{into}: a photograph cannot be written")


def _pose_rows(poses: Pose) -> list[tuple[object, ...]]:
    return [
        (k, k, *_metres(t), *(f"{v:.12f}" for v in q))
        for k, (t, q) in enumerate(zip(poses.translation, poses.quaternion_wxyz, strict=True))
    ]


def _metres(xyz: Array) -> list[str]:
    return [f"{v:.7f}" for v in xyz]


def _pixels(uv: Array) -> list[str]:
    return [f"{v:.5f}" for v in uv]


def _short(value: float) -> str:
    return f"{value:.9g}"


def _rounded(xyz: Array) -> list[float]:
    return [round(float(v), 3) for v in xyz]
