"""A simulated stereo recording of a drogue with seven markers, with its truth: to try `beampose stereo` with.

The markers are discs on the rim of the drogue, drawn with the exact share of each pixel that they cover, and blurred by
the lens. The right camera is exposed longer. A probe hides some markers in a part of the frames, and a lamp of the
tanker has the colour of the markers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from geometry.arrays import Array, Bools
from geometry.camera import Camera, in_picture
from geometry.pose import Pose
from geometry.uncertainty.rig_uncertainty import PINHOLE, POSE, RigCovariance, perturbed_camera
from lab.errors import InputError
from lab.files.rig.pair_file import PairFile, save_pair_file
from lab.files.run.truth import write_true_poses
from lab.files.text import columns
from lab.files.text.atomic_write import atomic_folder
from lab.files.text.csv_text import write_table
from lab.files.text.yaml_text import write_mapping
from lab.pictures.picture_file import ColourPicture
from lab.targets.stereo.run import SCHEMA
from tracking.binocular.marker_model import MarkerModel, StereoPair, project_markers

SCENARIO = "stereo-drogue"
SUMMARY = "a drogue with seven markers before two cameras, for `beampose stereo`"
FRAMES, RATE_HZ = 60, 25.0
_RADIUS_M = 0.03  # of a marker
_SUB = 8  # each pixel of a marker's outline is divided into _SUB x _SUB
_BLUR_PX = 0.6
_SKY, _MARKER, _RIM, _PROBE = (
    np.array(c, dtype=float) for c in ((150, 120, 95), (40, 35, 165), (70, 70, 75), (45, 48, 50))
)
_EXPOSURE = (1.0, 1.35)  # of the two cameras: the right one is brighter, as in the paper
# Sigmas of the calibration in pair.yaml: lens, per 1000 px of focal length; place and turn of the right camera.
_LENS_SIGMA_PX, _PLACE_SIGMA_M, _TURN_SIGMA_RAD = 0.05, 2e-5, 2e-5
_READ_DN, _ELECTRONS = 1.2, 60.0  # read noise; electrons per DN


@dataclass(frozen=True, slots=True)
class StereoScene:
    """A recording without its pictures."""

    pair: StereoPair
    model: MarkerModel
    t_s: Array  # (n,)
    poses: Pose  # n, world_from_body; world is the frame of the left camera
    hidden: Bools  # (n, 7): markers at which the probe points
    rate_hz: float
    right_delay_s: float = 0.0  # exposure of the right picture after the left one


def drogue_markers() -> MarkerModel:
    """Seven markers on a rim of 0.3 m and two depths, at unequal angles: no turn maps them onto each other."""
    angles = np.deg2rad([0.0, 47.0, 101.0, 156.0, 205.0, 262.0, 313.0])
    depth = np.array([0.0, 0.08, 0.0, 0.08, 0.0, 0.08, 0.04])
    positions = np.column_stack([0.3 * np.cos(angles), 0.3 * np.sin(angles), depth])
    names = tuple(str(i + 1) for i in range(7))
    return MarkerModel(names, positions, np.zeros(7, dtype=np.int64), np.full(7, _RADIUS_M))


def simulated_pair(focal_px: float, size_px: tuple[int, int], baseline_m: float = 0.5) -> StereoPair:
    """Two parallel cameras with a little distortion; the right one is turned by 0.3 deg."""
    w, h = size_px
    K = np.array([[focal_px, 0, (w - 1) / 2], [0, focal_px, (h - 1) / 2], [0, 0, 1.0]])
    turned = Pose.from_ypr(np.deg2rad([0.1, 0.3, -0.2]), np.zeros(3)).rotation
    right_from_world = Pose(turned, -turned @ np.array([baseline_m, 0.0, 0.0]))
    distortion = (-0.08, 0.03, 0.0005, -0.0003)
    return StereoPair(
        (
            Camera("left", "", size_px, K, distortion, Pose.identity()),
            Camera("right", "", size_px, K, distortion, right_from_world),
        )
    )


def scene(
    seed: int, frames: int = FRAMES, size_px: tuple[int, int] = (960, 720), focal_px: float = 1100.0
) -> StereoScene:
    """The drogue sways in front of the cameras and comes from 11 m to 7 m (at 25 Hz, whatever the number of frames)."""
    rng = np.random.default_rng(seed)
    t = np.arange(frames) / RATE_HZ
    phase, speed = rng.uniform(0, 2 * np.pi, 5), rng.uniform(1.5, 3.0, 5)
    waves = np.sin(speed[:, None] * t + phase[:, None])
    distance = 9.0 + 2.0 * np.cos(np.pi * t / 2.4)
    position = np.stack([0.35 * waves[0], 0.3 * waves[1], distance], axis=1)
    ypr = np.stack([0.5 * waves[2], 0.25 * waves[3], 0.25 * waves[4]], axis=1)
    hidden = np.zeros((frames, 7), dtype=bool)
    first = int(rng.integers(7))
    hidden[frames // 3 : frames // 3 + 8, [first, (first + 1) % 7]] = True
    pair = simulated_pair(focal_px, size_px)
    return StereoScene(pair, drogue_markers(), t, Pose.from_ypr(ypr, position), hidden, RATE_HZ)


def render(view: StereoScene, frame: int, camera: int, rng: np.random.Generator) -> ColourPicture:
    """The picture (h, w, 3), BGR, of one camera."""
    w, h = view.pair.cameras[camera].image_size_px
    pose = view.poses[frame]
    if camera == 1 and view.right_delay_s:
        pose = _later(view, frame)
    v, u = np.mgrid[0:h, 0:w]
    clouds = 14 * np.sin(u / 97 + 0.05 * frame) * np.cos(v / 71) + 22 * v / h
    picture = _SKY + clouds[..., None]
    eye = view.pair.cameras[camera]
    angle = np.linspace(0, 2 * np.pi, 120, endpoint=False)
    ring = np.column_stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)])
    _paint(picture, eye.project(pose.apply(0.37 * ring + [0, 0, 0.09])), _RIM)
    _paint(picture, eye.project(pose.apply(0.22 * ring + [0, 0, 0.09])), 0.6 * _RIM)
    for k, centre in enumerate(view.model.positions):
        _paint(picture, eye.project(pose.apply(centre + view.model.radius_m[k] * ring)), _MARKER)
    lamp = np.array([-1.6, -1.1, 14.0])
    _paint(picture, eye.project(lamp + 0.05 * ring), _MARKER)
    if view.hidden[frame].any():
        _paint(picture, _probe(view, frame, eye, pose), _PROBE)
    picture = cv2.GaussianBlur(picture * _EXPOSURE[camera], (0, 0), _BLUR_PX)
    noisy = picture + rng.normal(size=picture.shape) * np.sqrt(_READ_DN**2 + picture / _ELECTRONS)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)


def write_stereo_recording(
    out_folder: Path,
    *,
    seed: int = 0,
    frames: int | None = None,
    points: bool = False,
    noise_px: float = 0.1,
    right_delay_s: float = 0.0,
    scale: float = 1.0,
) -> Path:
    """Write the recording into a new folder: run.yaml, pair.yaml, pictures or detections, truth. The same seed gives
    the same bytes.

    Raises InputError: the folder exists.
    """
    size = (round(960 * scale), round(720 * scale))
    view = replace(scene(seed, frames or FRAMES, size, 1100.0 * scale), right_delay_s=right_delay_s)
    rng = np.random.default_rng([seed, 1])
    with atomic_folder(Path(out_folder), lambda _: False) as folder:
        save_pair_file(_calibrated(view.pair, np.random.default_rng([seed, 2])), folder / "pair.yaml")
        if points:
            _write_points(view, noise_px, rng, folder / "detections.csv")
            sources: dict[str, Any] = {c.name: {"detections": "detections.csv"} for c in view.pair.cameras}
        else:
            for c, camera in enumerate(view.pair.cameras):
                (folder / "frames" / camera.name).mkdir(parents=True)
                for i in range(len(view.t_s)):
                    path = folder / "frames" / camera.name / f"{i:06d}.png"
                    if not cv2.imwrite(str(path), render(view, i, c, rng)):
                        raise InputError(f"{path}: cannot be written")
            sources = {c.name: {"frames": f"frames/{c.name}"} for c in view.pair.cameras}
        _write_truth(view, folder / "truth")
        write_mapping(_run_mapping(view, sources), folder / "run.yaml")
    return Path(out_folder)


def _calibrated(pair: StereoPair, rng: np.random.Generator) -> PairFile:
    """The pair as a calibration finds it: with errors, and with their covariance."""
    right = pair.cameras[1].name
    scale = pair.cameras[0].matrix[0, 0] / 1000
    sigmas = {f"cameras.{c.name}.{p}": _LENS_SIGMA_PX * scale for c in pair.cameras for p in PINHOLE}
    sigmas |= {f"cameras.{right}.{p}": _PLACE_SIGMA_M for p in POSE[:3]}
    sigmas |= {f"cameras.{right}.{p}": _TURN_SIGMA_RAD for p in POSE[3:]}
    errors = {name: sigma * float(rng.normal()) for name, sigma in sigmas.items()}
    cameras = {}
    for c in pair.cameras:
        own = {name.rsplit(".", 1)[1]: e for name, e in errors.items() if name.startswith(f"cameras.{c.name}.")}
        cameras[c.name] = perturbed_camera(c, own)
    return PairFile(cameras, RigCovariance(tuple(sigmas), np.diag(np.square(list(sigmas.values())))))


def _run_mapping(view: StereoScene, sources: dict[str, Any]) -> dict[str, Any]:
    m = view.model
    return {
        "schema": SCHEMA,
        "name": SCENARIO,
        "pair": "pair.yaml",
        "frame_rate_hz": view.rate_hz,
        "cameras": sources,
        "target": {
            "colours": {"red": {"hue_deg": [340.0, 20.0], "saturation": [0.35, 1.0], "value": [0.2, 1.0]}},
            "markers": {
                name: {"position_m": [round(float(v), 6) for v in x], "colour": "red", "radius_m": float(r)}
                for name, x, r in zip(m.names, m.positions, m.radius_m, strict=True)
            },
        },
        "notes": "simulated",
    }


def true_pixels(view: StereoScene) -> Array:
    """Pixels (n, 2, K, 2) of the markers at the instants of the two exposures."""
    pixels = project_markers(view.pair, view.model, view.poses)[0]
    if view.right_delay_s:
        for i in range(len(view.t_s)):
            pixels[i, 1] = project_markers(view.pair, view.model, _later(view, i))[0][1]
    return pixels


def occluded(view: StereoScene) -> Bools:
    """(n, 2, K): which markers the probe covers, wholly or partly, in the picture of each camera."""
    out = np.zeros((len(view.t_s), 2, len(view.model)), dtype=bool)
    pixels = true_pixels(view)
    for i in np.flatnonzero(view.hidden.any(axis=1)):
        for c, camera in enumerate(view.pair.cameras):
            outline = _probe(view, int(i), camera, view.poses[int(i)]).astype(np.float32)
            reach = camera.matrix[0, 0] * view.model.radius_m / view.poses.translation[i, 2] + 1
            for k, at in enumerate(pixels[i, c].tolist()):
                out[i, c, k] = cv2.pointPolygonTest(outline, at, True) > -reach[k]
    return out


def _later(view: StereoScene, frame: int) -> Pose:
    """The pose when the right camera exposes, with the velocity at the frame."""
    a, b = max(frame - 1, 0), min(frame + 1, len(view.t_s) - 1)
    if a == b:
        return view.poses[frame]
    rate = view.poses[b].minus(view.poses[a]) / (view.t_s[b] - view.t_s[a])
    return view.poses[frame].plus(view.right_delay_s * rate)


def _write_truth(view: StereoScene, folder: Path) -> None:
    folder.mkdir()
    write_true_poses(folder / "pose.csv", np.arange(len(view.t_s)), view.t_s, view.poses)
    pixels, hidden, rows = true_pixels(view), occluded(view), []
    for i in range(len(view.t_s)):
        for c, camera in enumerate(view.pair.cameras):
            inside = in_picture(pixels[i, c], np.array(camera.image_size_px))
            for k, name in enumerate(view.model.names):
                seen = 0 if not inside[k] else 2 if hidden[i, c, k] else 1
                rows.append([i, camera.name, name, *(f"{v:.9g}" for v in pixels[i, c, k]), seen])
    write_table(folder / "spots.csv", columns.TRUTH_SPOTS, rows)


def _write_points(view: StereoScene, noise_px: float, rng: np.random.Generator, path: Path) -> None:
    """detections.csv: the visible markers with noise, in random order, and one false point in each picture."""
    pixels, hidden, rows = true_pixels(view), occluded(view), []
    sigma = max(noise_px, 1e-6)
    for i in range(len(view.t_s)):
        for c, camera in enumerate(view.pair.cameras):
            size = np.array(camera.image_size_px)
            seen = in_picture(pixels[i, c], size) & ~hidden[i, c]
            uv = pixels[i, c, seen] + noise_px * rng.normal(size=(int(seen.sum()), 2))
            places = rng.permutation(np.vstack([uv, rng.uniform(0, 1, 2) * (size - 1)]))
            shape = (sigma, sigma, 1000, 100, 1.5, 1.5, 0, 0)
            rows += [[i, camera.name, *(f"{x:.6f}" for x in at), *shape] for at in places]
    write_table(path, columns.DETECTIONS, rows)


def _probe(view: StereoScene, frame: int, eye: Camera, pose: Pose) -> Array:
    """Outline (n, 2) of the probe: a bar over the hidden markers, from the lower edge of the picture."""
    over = eye.project(pose.apply(view.model.positions[view.hidden[frame]]))
    width = 8 + 0.5 * float(np.ptp(over, axis=0).max())
    middle = over.mean(axis=0)
    foot = np.array([0.5 * eye.image_size_px[0], 1.2 * eye.image_size_px[1]])
    along = (foot - middle) / np.linalg.norm(foot - middle)
    side = width * np.array([-along[1], along[0]])
    tip = middle - width * along
    return np.array([tip + side, tip - side, foot - side, foot + side])


def _paint(picture: Array, outline: Array, colour: Array) -> None:
    """Fill an outline (n, 2), px, with a colour, in proportion to the covered share of each pixel."""
    h, w = picture.shape[:2]
    if not np.isfinite(outline).all():
        return
    low = np.clip(np.floor(outline.min(axis=0)).astype(int) - 1, 0, [w, h])
    high = np.clip(np.ceil(outline.max(axis=0)).astype(int) + 2, 0, [w, h])
    if np.any(high <= low):
        return
    size = high - low
    fine = np.zeros((int(size[1]) * _SUB, int(size[0]) * _SUB), np.uint8)
    # Pixel i covers i - 0.5 to i + 0.5; its parts are numbered from its edge. Sixteenths of a part by `shift`.
    at = np.round(((outline - low + 0.5) * _SUB - 0.5) * 16).astype(np.int32)
    cv2.fillPoly(fine, [at], 1, shift=4)
    share = fine.reshape(int(size[1]), _SUB, int(size[0]), _SUB).mean(axis=(1, 3))[..., None]
    box = (slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0])))
    picture[box] = share * colour + (1 - share) * picture[box]
