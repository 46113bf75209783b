"""A results folder in the format of the contract, from the forward model: truth plus noise, without a tracker.

The noise is drawn from the stated covariances, so the scores are known: NEES 6, correct sigmas, correct labels.
"""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from geometry import rotations
from geometry.arrays import Array
from geometry.camera import Camera
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.rig import Beam, Rig, Screen, Spot
from lab.files.rig.rig_file import save_rig
from lab.files.run.run_file import save_run
from lab.files.text import columns

NOISE_PX = 0.1
RATE_HZ = 100.0
MOTION_SIGMA = np.array([0.004] * 3 + [0.002] * 3)  # m/s and rad/s


def fake_rig(n_cameras: int = 2) -> Rig:
    """Screens at x = -2.5 m and +2.5 m, a camera for each (or for the left one only), three beams 20 deg apart."""
    turn = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # screen x, y, z = world y, z, x
    screens = {n: Screen(n, Pose(turn, np.array([x, 0.0, 0.0]))) for n, x in (("left", -2.5), ("right", 2.5))}
    K = np.array([[1180.0, 0, 639.5], [0, 1180, 511.5], [0, 0, 1]])
    axes = {"left": [[0, 1, 0], [0, 0, -1], [-1, 0, 0]], "right": [[0, -1, 0], [0, 0, -1], [1, 0, 0]]}
    cameras = {}
    for name, side in list(zip(axes, (1.0, -1.0), strict=True))[:n_cameras]:
        R = np.array(axes[name], dtype=float)
        cameras[name] = Camera(
            name, name, (1280, 1024), K, (-0.08, 0.01, 0.0, 0.0, 0.0), Pose(R, -R @ [side * 1.1, 0.1, 0.2])
        )
    beams = {
        n: Beam(n, np.array([np.cos(np.radians(a)), np.sin(np.radians(a)), 0.05 * k]), np.zeros(3))
        for k, (n, a) in enumerate({"A": -20.0, "B": 0.0, "C": 20.0}.items())
    }
    spots = {str(i + 1): Spot(str(i + 1), b, -1, "left") for i, b in enumerate("ABC")}
    spots |= {str(i + 4): Spot(str(i + 4), b, 1, "right") for i, b in enumerate("ABC")}
    return Rig(screens, cameras, beams, spots)


@dataclass(frozen=True)
class Fake:
    """The folders and their truth."""

    results: Path
    run_folder: Path
    model: SpotModel
    true_uv: Array  # (F, V, 2)


@dataclass(frozen=True)
class _Truth:
    """The true motion of F frames and its projection to V views."""

    t: Array  # (F,) s
    triangle: Array  # (F,) the wave of the yaw
    pose: Pose  # (F,)
    motion: Array  # (F, 6) m/s and rad/s
    uv: Array  # (F, V, 2)
    J: Array  # (F, V, 2, 6) of the projection


@dataclass(frozen=True)
class _States:
    """The status of each spot and pose."""

    spot: Array  # (F, V) words
    in_view: Array  # (F, V) as in truth/spots.csv
    predicted: Array  # (F,)
    lost: Array  # (F,)

    @property
    def measured(self) -> Array:
        """(F, V): the spot is measured."""
        return np.isin(self.spot, ["matched", "turned"])

    @property
    def pose(self) -> Array:
        """(F,) the words of the poses."""
        return np.where(self.lost, "lost", np.where(self.predicted, "predicted", "measured"))


def make(
    folder: Path,
    n_frames: int = 600,
    *,
    n_cameras: int = 2,
    truth: bool = True,
    pictures: bool = False,
    all_lost: bool = False,
    eventful: bool = True,
    causal: bool = False,
    seed: int = 1,
) -> Fake:
    """Write folder/run and folder/results. causal: also causal poses, with twice the sigmas."""
    rng = np.random.default_rng(seed)
    rig = fake_rig(n_cameras)
    model = SpotModel.of(rig)
    true = _true_motion(model, n_frames)
    states = _states(model, true, eventful and n_frames >= 100, all_lost, rng)
    results, run_folder = folder / "results", folder / "run"
    results.mkdir(parents=True, exist_ok=True)
    run_folder.mkdir(parents=True, exist_ok=True)
    _write_spots(results, model, true, states, rng)
    states, covariance = _pose_covariance(true, states)
    _write_poses(results, true, states, covariance, causal, rng)
    if truth:
        _write_truth(run_folder / "truth", model, true, states)
    summary = _summary(run_folder, states.spot, states.pose, model)
    (results / "summary.json").write_text(json.dumps(summary), encoding="utf-8")
    if pictures:
        _pictures(run_folder, model, true.uv, states.in_view, rng)
    (run_folder / "detections.csv").write_bytes((results / "detections.csv").read_bytes())
    save_rig(rig, run_folder / "rig.yaml")
    sources = {n: {"frames": f"frames/{n}"} if pictures else {"detections": "detections.csv"} for n in rig.cameras}
    content = {"name": "fake <yaw & bend>", "rig": "rig.yaml", "frame_rate_hz": RATE_HZ, "cameras": sources}
    save_run({"schema": "beampose/run/1", **content, "notes": "Notes of the run & more."}, run_folder)
    return Fake(results, run_folder, model, true.uv)


def _true_motion(model: SpotModel, n_frames: int) -> _Truth:
    t = np.arange(n_frames) / RATE_HZ
    triangle, pose = _path(t)
    moment = 1e-4
    motion = _path(t + moment)[1].minus(_path(t - moment)[1]) / (2 * moment)
    uv, J = np.empty((n_frames, len(model), 2)), np.empty((n_frames, len(model), 2, 6))
    for k in range(0, n_frames, 2000):
        uv[k : k + 2000], J[k : k + 2000] = model.project(pose[slice(k, k + 2000)])
    return _Truth(t, triangle, pose, motion, uv, J)


def _states(model: SpotModel, true: _Truth, eventful: bool, all_lost: bool, rng: np.random.Generator) -> _States:
    """Turns, occlusions, missing pictures, and predicted and lost poses."""
    n_frames = len(true.t)
    inside = model.in_picture(true.uv)
    status = np.where(inside, "matched", np.where(np.isnan(true.uv[..., 0]), "off_screen", "out_of_view"))
    status = status.astype(object)
    in_view = inside.astype(int)
    lost, predicted = np.zeros(n_frames, dtype=bool), np.zeros(n_frames, dtype=bool)
    if eventful:
        slope = np.sign(np.diff(true.triangle, prepend=true.triangle[0] - 1e-3))
        for k in np.flatnonzero(np.diff(slope) != 0) + 1:
            status[k][inside[k]] = "turned"
        for j in range(len(model)):
            for start in rng.integers(0, n_frames, size=max(1, n_frames // 150)):
                rows = slice(start, start + int(rng.integers(3, 20)))
                occluded = inside[rows, j]
                status[rows, j][occluded] = "occluded"
                in_view[rows, j][occluded] = 2
        f = int(0.31 * n_frames)
        status[f : f + 3, model.camera_of == 0] = "no_image"
        predicted[int(0.55 * n_frames) : int(0.55 * n_frames) + 14] = True
        lost[int(0.80 * n_frames) : int(0.80 * n_frames) + 12] = True
    if all_lost:
        lost[:] = True
    status[predicted & ~lost] = np.where(inside[predicted & ~lost], "occluded", status[predicted & ~lost])
    in_view[predicted & inside.any(1)] *= 2
    status[lost] = "lost"
    status[:, ~np.isfinite(true.uv).any(axis=(0, 2))] = "off_screen"
    return _States(status, np.minimum(in_view, 2), predicted, lost)


def _write_spots(results: Path, model: SpotModel, true: _Truth, states: _States, rng: np.random.Generator) -> None:
    """spots.csv and detections.csv with measured and predicted positions."""
    measured, absent = states.measured, np.isin(states.spot, ["lost", "off_screen"])
    sigma = np.where(measured, NOISE_PX, 0.4)
    uv = true.uv + sigma[..., None] * rng.normal(size=true.uv.shape)
    predicted = true.uv + 0.2 * rng.normal(size=true.uv.shape)
    predicted[states.spot == "turned"] += 8.0
    uv[absent] = predicted[absent] = np.nan
    sigma[np.isnan(uv[..., 0])] = np.nan
    cells = [(k, j) for k in range(len(true.t)) for j in range(len(model))]
    spots = [
        [
            k, _number(true.t[k]), *model.views[j], *map(_number, uv[k, j]), _number(sigma[k, j]),
            _number(sigma[k, j]), states.spot[k, j], *map(_number, predicted[k, j]),
            "0.97" if measured[k, j] else "", "0" if np.isfinite(sigma[k, j]) else "",
            "0.999" if measured[k, j] else "",
        ]
        for k, j in cells
    ]  # fmt: skip
    _write(results / "spots.csv", columns.SPOTS, spots)
    other = ("0.1", "0.1", "5000", "300", "2.1", "1.8", "12", "0")
    detected = [[k, model.views[j][0], *map(_number, uv[k, j]), *other] for k, j in cells if measured[k, j]]
    _write(results / "detections.csv", columns.DETECTIONS, detected)


def _pose_covariance(true: _Truth, states: _States) -> tuple[_States, Array]:
    """The covariances (F, 6, 6) of the poses; a frame whose spots determine no pose becomes predicted."""
    J = np.nan_to_num(true.J)
    information = np.einsum("fv,fvij,fvik->fjk", states.measured.astype(float), J, J)
    # The spots of one screen lie on a line: without both screens no pose is determined.
    shrunk = information + 1e-9 * np.eye(6)
    weak = NOISE_PX**2 * np.linalg.inv(shrunk)[:, range(3), range(3)].max(axis=1) > 0.05**2
    predicted = states.predicted | (~states.lost & weak)
    information[predicted | states.lost] = np.eye(6) * NOISE_PX**2
    covariance = np.linalg.inv(information / NOISE_PX**2)
    since = np.zeros(len(true.t))
    for k in np.flatnonzero(predicted):
        since[k] = since[k - 1] + 1 if k else 1
    grown = (since[:, None] * np.array([2e-3] * 3 + [1e-3] * 3)) ** 2
    covariance[predicted] = np.eye(6) * grown[predicted][:, None, :]
    return replace(states, predicted=predicted), covariance


def _write_poses(
    results: Path, true: _Truth, states: _States, covariance: Array, causal: bool, rng: np.random.Generator
) -> None:
    """attitude.csv and covariance.csv; of the causal poses with twice the errors and sigmas."""
    n_frames = len(true.t)
    delta = (np.linalg.cholesky(covariance) @ rng.normal(size=(n_frames, 6, 1)))[..., 0]
    delta[states.lost] = 0
    rms = np.abs(NOISE_PX * (1 + 0.2 * rng.normal(size=n_frames)))
    motion_error = MOTION_SIGMA * rng.normal(size=true.motion.shape)
    words, count, upper = states.pose, states.measured.sum(axis=1), np.triu_indices(6)
    for which, times in (("", 1.0), (columns.CAUSAL, 2.0))[: 1 + causal]:
        wrong = times * delta  # truth = estimate plus delta
        estimate = Pose(true.pose.rotation @ rotations.exp(-wrong[:, 3:]), true.pose.translation - wrong[:, :3])
        C = times**2 * covariance
        Jypr = rotations.ypr_jacobian(estimate.rotation)
        s_ypr = np.degrees(np.sqrt(np.einsum("fij,fjk,fik->fi", Jypr, C[:, 3:, 3:], Jypr)))
        s_xyz = np.sqrt(np.diagonal(C, axis1=1, axis2=2)[:, :3])
        table = np.concatenate(
            [estimate.translation, estimate.quaternion_wxyz, np.degrees(estimate.ypr), s_xyz, s_ypr], axis=1
        )
        sigmas = np.full((n_frames, 6), times) * MOTION_SIGMA
        moving = np.concatenate([true.motion - times * motion_error, sigmas], axis=1)
        rows = []
        for k in range(n_frames):
            rms_text = _number(rms[k]) if words[k] == "measured" else ""
            fields = [""] * 16 if states.lost[k] else [f"{x:.9f}" for x in table[k]]
            last = [""] * 12 if states.lost[k] else [f"{x:.9f}" for x in moving[k]]
            rows.append([k, _number(true.t[k]), *fields, int(count[k]), rms_text, words[k], *last])
        _write(results / f"attitude{which}.csv", columns.ATTITUDE, rows)
        known = [[k, *(f"{x:.9e}" for x in C[k][upper])] for k in np.flatnonzero(~states.lost)]
        _write(results / f"covariance{which}.csv", columns.COVARIANCE, known)


def _write_truth(folder: Path, model: SpotModel, true: _Truth, states: _States) -> None:
    q = true.pose.quaternion_wxyz
    poses = [[k, true.t[k], *true.pose.translation[k], *q[k]] for k in range(len(q))]
    _write(folder / "pose.csv", columns.TRUTH_POSE, poses)
    spots = [
        [k, *model.views[j], *map(_number, true.uv[k, j]), states.in_view[k, j]]
        for k in range(len(q))
        for j in range(len(model))
    ]
    _write(folder / "spots.csv", columns.TRUTH_SPOTS, spots)


def _number(x: float) -> str:
    return "" if np.isnan(x) else f"{x:.6f}"


def _write(path: Path, header: tuple[str, ...], rows: list[list[object]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)


def without_added_columns(results: Path, folder: Path) -> Path:
    """A copy of a results folder without the columns of columns.ADDED, as in older versions."""
    folder.mkdir()
    for path in results.iterdir():
        if path.suffix != ".csv":
            (folder / path.name).write_bytes(path.read_bytes())
            continue
        with path.open(newline="") as file:
            rows = list(csv.reader(file))
        kept = [i for i, name in enumerate(rows[0]) if name not in columns.ADDED]
        with (folder / path.name).open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([row[i] for i in kept] for row in rows)
    return folder


def _path(t: Array) -> tuple[Array, Pose]:
    """The motion of the vehicle: a triangle wave of yaw, whose corners are bends, and the poses."""
    triangle = 2 / np.pi * np.arcsin(np.sin(2 * np.pi * t / 3.0))
    ypr = np.radians(np.stack([19 * triangle, 6 * np.sin(1.3 * t), 8 * np.cos(0.9 * t)], -1))
    return triangle, Pose.from_ypr(ypr, np.stack([0.3 * np.sin(t), 0.2 * np.cos(0.7 * t), 0.1 * np.sin(2 * t)], -1))


def _summary(run_folder: Path, status: Array, word: Array, model: SpotModel) -> dict[str, object]:
    counts = {
        f"{c}/{s}": {w: int((status[:, j] == w).sum()) for w in np.unique(status[:, j])}
        for j, (c, s) in enumerate(model.views)
    }
    gone = np.flatnonzero((status[:, model.camera_of == 0] == "no_image").all(axis=1))
    share = float((word == "measured").mean())
    verdict = {"status": "pass", "reasons": [], "exit_status": 0}
    if share < 0.99:
        verdict = {
            "status": "check" if share > 0 else "fail",
            "reasons": [f"The pose was measured in {100 * share:.1f} % of the frames, fewer than 99 %."],
            "exit_status": 0 if share > 0 else 4,
        }
    return {
        "schema": "beampose/summary/1",
        "name": "fake <yaw & bend>",
        "run_folder": str(run_folder),
        "rig": "rig.yaml",
        "verdict": verdict,
        "counts": {
            "frames": len(word),
            "spot_status": counts,
            "pose_status": {w: int((word == w).sum()) for w in np.unique(word)},
            "detections_per_frame": {"left": 3.1, "right": 2.9},
            "no_image": {"left": [[int(gone[0]), int(gone[-1])]] if len(gone) else []},
        },
        "rates": {"measured": share, "frames_per_second": 71.3},
        "errors": None,
        "timings": {"read_s": 2.1, "detect_s": 4.0, "track_s": 0.8},
        "versions": {"beampose": "0.1.0", "numpy": np.__version__},
        "parameters": {"tracker": {"method": "spots", "r1_px": 10.0, "weights": [0.6, 0.2, 0.2]}},
        "inputs": [{"path": "run.yaml", "sha256": "ab" * 32, "bytes": 412}],
        "notes": ["A note with <b>markup</b> & an ampersand."],
        "events": [],
    }


def _pictures(run_folder: Path, model: SpotModel, true_uv: Array, in_view: Array, rng: np.random.Generator) -> None:
    """Grey pictures with Gaussian spots; the ninth file of the first camera is truncated."""
    v, u = np.mgrid[-20:21, -20:21]
    for c, name in enumerate(dict.fromkeys(camera for camera, _ in model.views)):
        (run_folder / "frames" / name).mkdir(parents=True, exist_ok=True)
        for k in range(len(true_uv)):
            picture = np.full((1024 + 80, 1280 + 80), 12.0) + np.linspace(0, 10, 1360)
            for j in np.flatnonzero((model.camera_of == c) & (in_view[k] == 1)):
                at = np.round(true_uv[k, j]).astype(int)
                off = true_uv[k, j] - at
                glow = 180 * np.exp(-((u - off[0]) ** 2 + (v - off[1]) ** 2) / (2 * 2.5**2))
                picture[at[1] + 20 : at[1] + 61, at[0] + 20 : at[0] + 61] += glow
            picture = picture[40:-40, 40:-40] + rng.normal(scale=2, size=(1024, 1280))
            path = run_folder / "frames" / name / f"{k:06d}.png"
            cv2.imwrite(str(path), np.clip(picture, 0, 255).astype(np.uint8))
            if c == 0 and k == 8:
                path.write_bytes(path.read_bytes()[:2000])
