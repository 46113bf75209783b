"""A simulated calibration campaign, and its files."""

from __future__ import annotations

import datetime
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calibration.boards import board_types as boards
from calibration.least_squares.adjustment import Poses, Stack, Vectors, solve
from calibration.terms.corners import single_camera
from calibration.terms.rig_blocks import SpotPixels
from geometry.arrays import Array, Bools, Ints
from geometry.camera import FISHEYE, Camera, camera_matrix, in_picture, pinhole_numbers
from geometry.forward_model import SpotModel
from geometry.lens import padded
from geometry.pose import Pose
from geometry.rig import Beam, Rig, Screen
from geometry.uncertainty.rig_uncertainty import PINHOLE, RigCovariance, distortion_names
from lab.errors import InputError
from lab.files.project.point_files import POINTS, POSE_SIGMAS, SURVEY, SURVEY_SIGMAS
from lab.files.project.project import SCHEMA
from lab.files.rig.board_file import save_board
from lab.files.rig.camera_file import CameraCalibration, CameraFile, save_camera
from lab.files.rig.pose_block import pose_mapping
from lab.files.rig.rig_file import RigFile, as_mapping, load_rig, save_rig
from lab.files.text import columns
from lab.files.text.atomic_write import atomic_folder
from lab.files.text.csv_text import write_table
from lab.files.text.error_text import suggest_name
from lab.files.text.yaml_text import write_mapping
from lab.simulate.board_photo import PhotoSettings, photograph
from lab.simulate.scenarios import RIGS

# A simulated calibration campaign: the true rig, and the measurements of it that a laboratory makes.

# One stream of random numbers per subject, so that the positions of the stand do not depend on the number of dots.
_MOUNTING, _LENSES, _DOTS, _PIXELS, _STAND, _SPOTS, _WRONG = range(7)
_EDGE_PX = 12.0  # spots and dots closer to the edge of the picture are not used


@dataclass(frozen=True, slots=True)
class CampaignQuality:
    """Sigmas, per coordinate, of the mounting and of the measurements."""

    camera_m: float = 0.004  # mounting: deviation of the cameras from the drawing ...
    camera_deg: float = 0.3
    screen_m: float = 0.004
    screen_deg: float = 0.2
    beam_deg: float = 0.3
    beam_m: float = 0.003
    focal_px: float = 8.0  # lenses: deviation from the data sheet
    centre_px: float = 5.0
    distortion_share: float = 0.03  # of each distortion coefficient
    bow_per_m: float = 0.0  # of the bow of the screens
    lens_corner_px: float = 0.08  # of a board corner in the preceding lens calibration
    dots: tuple[int, int] = (6, 5)  # surveyed dots per screen: columns, rows; without those that no camera sees
    survey_m: float = 0.0003  # total station on good targets
    dot_px: float = 0.07  # of the centre of a dot in the picture
    positions: int = 40  # of the stand
    turn_deg: float = 25.0  # its largest rotation about each axis ...
    shift_m: float = 0.2  # ... and its largest shift along each axis
    stand_m: float = 2e-5  # its error, per position
    stand_deg: float = 0.002
    place_known: bool = False  # the survey also measured the pose of the stand
    place_m: float = 0.0003
    place_deg: float = 0.01
    spot_px: float = 0.054  # 0.2 mm on the screen, 4.4 m from a camera of 1180 px focal length
    wrong: float = 0.0  # share of outliers among the pixels of dots and of spots


@dataclass(frozen=True, slots=True)
class Campaign:
    """The truth and all measurements."""

    name: str
    seed: int
    quality: CampaignQuality
    nominal: Rig  # as drawn
    truth: Rig  # as mounted
    lenses: dict[str, CameraFile]  # as calibrated
    dot_names: tuple[str, ...]  # n dots
    dot_screen: Ints  # (n,): index into the screens
    dots_surveyed: Array  # (n, 3), m, world
    seen_camera: Ints  # (k,)
    seen_dot: Ints  # (k,)
    seen_pixels: Array  # (k, 2)
    world_from_stand: Pose  # truth
    stand_surveyed: Pose  # as measured by the survey
    stand_from_body: Pose  # (p,) truth
    stand_recorded: Pose  # (p,) as reported by the stand
    spots: SpotPixels
    wrong_spots: Bools  # (n spots,): pixels made outliers


def draw_campaign(seed: int, rig: str | Rig = "fan", quality: CampaignQuality | None = None) -> Campaign:
    """The truth and the measurements of one campaign, from a seed.

    rig: a name of RIGS, the path of a rig.yaml, or a rig. Raises InputError: there is no such rig or file, or the file
    is wrong.
    """
    q = CampaignQuality() if quality is None else quality
    nominal = rig if isinstance(rig, Rig) else RIGS[rig]() if rig in RIGS else _designed(rig)
    truth = as_mounted(nominal, q, np.random.default_rng([seed, _MOUNTING]))
    lenses = {
        n: _lens(c, q, np.random.default_rng([seed, _LENSES, i])) for i, (n, c) in enumerate(truth.cameras.items())
    }
    names, of_screen, dots = _dots(truth, q)
    rng = np.random.default_rng([seed, _DOTS])
    surveyed = dots + rng.normal(0, q.survey_m, dots.shape)
    camera, dot, pixels = _observations(truth, of_screen, dots)
    pixels = pixels + np.random.default_rng([seed, _PIXELS]).normal(0, q.dot_px, pixels.shape)
    rng = np.random.default_rng([seed, _STAND])
    world_from_stand = Pose.from_ypr(np.deg2rad(rng.normal(0, 2.0, 3)), rng.normal(0, 0.03, 3))
    turns = rng.uniform(-1, 1, (q.positions, 3)) * np.deg2rad(q.turn_deg)
    stand_from_body = Pose.from_ypr(turns, rng.uniform(-q.shift_m, q.shift_m, (q.positions, 3)))
    sigmas = np.repeat([q.stand_m, np.deg2rad(q.stand_deg)], 3)
    recorded = stand_from_body.plus(rng.normal(size=(q.positions, 6)) * sigmas)
    place = np.repeat([q.place_m, np.deg2rad(q.place_deg)], 3)
    stand_surveyed = world_from_stand.plus(rng.normal(size=6) * place)
    spots = spots_at(truth, world_from_stand @ stand_from_body, q.spot_px, np.random.default_rng([seed, _SPOTS]))
    rng = np.random.default_rng([seed, _WRONG])
    _, pixels = _some_wrong(pixels, q.wrong, rng)
    wrong_spots, spot_pixels = _some_wrong(spots.pixels, q.wrong, rng)
    return Campaign(
        name=rig if isinstance(rig, str) and rig in RIGS else "rig",
        seed=seed,
        quality=q,
        nominal=nominal,
        truth=truth,
        lenses=lenses,
        dot_names=names,
        dot_screen=of_screen,
        dots_surveyed=surveyed,
        seen_camera=camera,
        seen_dot=dot,
        seen_pixels=pixels,
        world_from_stand=world_from_stand,
        stand_surveyed=stand_surveyed,
        stand_from_body=stand_from_body,
        stand_recorded=recorded,
        spots=replace(spots, pixels=spot_pixels),
        wrong_spots=wrong_spots,
    )


def as_mounted(nominal: Rig, q: CampaignQuality, rng: np.random.Generator) -> Rig:
    """The rig with random deviations of every pose, lens, beam and screen from the drawing."""

    def off(m: float, deg: float) -> Array:
        return rng.normal(size=6) * np.repeat([m, np.deg2rad(deg)], 3)

    cameras, screens, beams = {}, {}, {}
    for name, c in nominal.cameras.items():
        # Errors of the body's place and attitude, not of camera_from_world, whose lever arm would be metres long.
        stands = c.camera_from_world.inverse().plus(off(q.camera_m, q.camera_deg))
        focal, dx, dy = rng.normal(0, [q.focal_px, q.centre_px, q.centre_px])
        matrix = c.matrix + np.array([[focal, 0, dx], [0, focal * (1 + 1e-4 * rng.normal()), dy], [0, 0, 0]])
        distortion = tuple(
            (np.array(c.distortion) * (1 + q.distortion_share * rng.normal(size=len(c.distortion)))).tolist()
        )
        cameras[name] = replace(c, matrix=matrix, distortion=distortion, camera_from_world=stands.inverse())
    for name, s in nominal.screens.items():
        a, b, c2 = (np.array(s.bow) + rng.normal(0, 1, 3) * q.bow_per_m).tolist()
        pose = s.world_from_screen.plus(off(q.screen_m, q.screen_deg))
        screens[name] = Screen(name, pose, s.size_m, (a, b, c2))
    for name, beam in nominal.beams.items():
        turn, shift = rng.normal(0, np.deg2rad(q.beam_deg), 3), rng.normal(0, q.beam_m, 3)
        beams[name] = Beam(name, beam.direction + turn, beam.point + shift)
    return Rig(screens, cameras, beams, nominal.spots)


def spots_at(rig: Rig, world_from_body: Pose, sigma_px: float, rng: np.random.Generator) -> SpotPixels:
    """The spots in the pictures at poses (p,), with noise, which is drawn for all views, visible or not."""
    model = SpotModel.of(rig)
    pixels, _ = model.project(world_from_body)
    noise = rng.normal(0, sigma_px, pixels.shape)
    position, view = np.nonzero(model.in_picture(pixels, -_EDGE_PX))
    covariance = np.broadcast_to(np.eye(2) * sigma_px**2, (len(position), 2, 2)).copy()
    return SpotPixels(position, view, (pixels + noise)[position, view], covariance)


def board_poses(count: int, seed: int = 5) -> Pose:
    """camera_from_board (count,) of a tilted board of 0.4 m x 0.3 m, distributed over the picture."""
    rng = np.random.default_rng(seed)
    turns = np.deg2rad(rng.uniform([-20, -35, -35], [20, 35, 35], (count, 3)))
    z = rng.uniform(0.9, 1.6, count)
    middle = np.stack([rng.uniform(-0.5, 0.5, count) * z, rng.uniform(-0.4, 0.4, count) * z, z], axis=-1)
    poses = Pose.from_ypr(turns, middle)
    return Pose(poses.rotation, middle - poses.turn(np.array([0.2, 0.15, 0.0])))


def lens_covariance(camera: Camera, corner_px: float, views: int = 30) -> Array:
    """The covariance (p, p) of fx, fy, cx, cy and the distortion after a calibration with `views` board photographs."""
    x, y = np.meshgrid(np.linspace(0, 0.4, 9), np.linspace(0, 0.3, 7))
    board = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1)
    poses = board_poses(views)
    alone = replace(camera, camera_from_world=Pose.identity())
    points = np.tile(board, (views, 1))
    placement = np.repeat(np.arange(views), len(board))
    pixels = alone.project(poses[placement].apply(points))
    seen = in_picture(pixels, np.array([camera.image_size_px], dtype=float), -3.0)
    term = single_camera(
        pixels[seen], points[seen], board.mean(axis=0), placement[seen], corner_px, camera.lens == FISHEYE
    )
    numbers = np.concatenate([pinhole_numbers(camera), padded(camera.distortion)])
    values: dict[str, Stack] = {
        "intrinsics": Vectors(numbers[None]),
        "cameras": Poses.of([Pose.identity()]),
        "boards": Poses(poses),
        "warp": Vectors(np.zeros((1, 3))),
    }
    used = 4 + len(camera.distortion)
    free: dict[str, bool | Bools] = {"intrinsics": np.arange(18)[None] < used, "boards": True}
    return solve(values, [term], free).covariance([("intrinsics", 0)])[:used, :used]


def _lens(true: Camera, q: CampaignQuality, rng: np.random.Generator) -> CameraFile:
    C = lens_covariance(true, q.lens_corner_px)
    off = np.linalg.cholesky(C) @ rng.normal(size=len(C))
    lens = (np.concatenate([pinhole_numbers(true), true.distortion]) + off).tolist()
    known = RigCovariance((*PINHOLE, *distortion_names(true)), C)
    state = CameraCalibration(date=datetime.date.fromisoformat(_DATE), verdict="PASS", notes="simulated")
    return CameraFile(true.name, true.image_size_px, camera_matrix(lens[:4]), tuple(lens[4:]), true.lens, known, state)


def _dots(rig: Rig, q: CampaignQuality) -> tuple[tuple[str, ...], Ints, Array]:
    """Names, screens and true positions of the dots that at least one camera sees."""
    names, of_screen, xyz = [], [], []
    columns, rows = q.dots
    for k, screen in enumerate(rig.screens.values()):
        half = np.array([2.2, 1.7]) if screen.size_m is None else np.minimum(np.array(screen.size_m) * 0.45, [2.2, 1.7])
        x, y = np.meshgrid(np.linspace(-half[0], half[0], columns), np.linspace(-half[1], half[1], rows))
        a, b, c = screen.bow
        on_screen = np.stack([x, y, a * x * x + b * x * y + c * y * y], axis=-1).reshape(-1, 3)
        world = screen.world_from_screen.apply(on_screen)
        seen = np.zeros(len(world), dtype=bool)
        for camera in rig.cameras.values():
            if camera.screen == screen.name:
                seen |= _in(camera, camera.project(world))
        for i in np.flatnonzero(seen):
            names.append(f"{screen.name}-{i + 1:02d}")
            of_screen.append(k)
            xyz.append(world[i])
    return tuple(names), np.array(of_screen, dtype=np.int64), np.array(xyz)


def _observations(rig: Rig, of_screen: Ints, dots: Array) -> tuple[Ints, Ints, Array]:
    """Camera, dot and pixel of each observation; each camera sees the dots of its own screen."""
    parts, screens = [], list(rig.screens)
    for c, camera in enumerate(rig.cameras.values()):
        uv = camera.project(dots)
        seen = np.flatnonzero(_in(camera, uv) & (of_screen == screens.index(camera.screen)))
        parts.append((np.full(len(seen), c), seen, uv[seen]))
    camera_of, dot_of, pixels = (np.concatenate(column) for column in zip(*parts, strict=True))
    return camera_of, dot_of, pixels


def _in(camera: Camera, pixels: Array) -> Bools:
    size = np.array([camera.image_size_px], dtype=float)
    return in_picture(pixels, size, -_EDGE_PX)


def _some_wrong(pixels: Array, share: float, rng: np.random.Generator) -> tuple[Bools, Array]:
    """A share of the pixels, moved by 4 to 40 px."""
    wrong = rng.uniform(size=len(pixels)) < share
    angle, far = rng.uniform(0, 2 * np.pi, len(pixels)), rng.uniform(4, 40, len(pixels))
    off = far[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return wrong, pixels + wrong[:, None] * off


# A simulated calibration campaign as a folder: the input of `beampose calibrate rig`, and the truth.


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
    calibrate camera`. quality: sigmas of mounting and measurement. Raises InputError: an argument is not valid, the rig
    file cannot be read, or the folder exists.
    """
    if not 0 <= wrong < 0.3:
        raise InputError(f"wrong: expected a share from 0 up to 0.3, got {wrong:g}")
    if positions < 3:
        raise InputError(f"positions: expected 3 or more, got {positions}")
    q = replace(CampaignQuality() if quality is None else quality, positions=positions, wrong=wrong)
    campaign = draw_campaign(seed, rig, q)
    with atomic_folder(Path(out), lambda _: False) as folder:
        write_campaign(campaign, folder)
        if photos:
            _write_photos(campaign, folder)
    return Path(out)


def _designed(rig: str) -> Rig:
    """The rig of a rig.yaml; a word that names no file and no rig is taken for a misspelt name."""
    if not Path(rig).exists():
        raise InputError(f"rig: expected a rig.yaml or a rig's name, got {rig!r}{suggest_name(rig, RIGS)}")
    return load_rig(Path(rig))


def write_campaign(c: Campaign, folder: Path) -> None:
    """Write the files of a campaign into an existing folder."""
    for name, lens in c.lenses.items():
        save_camera(lens, folder / f"camera-{name}.yaml")
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
