"""A results folder in the format of the contract, from the forward model: truth plus noise, without a tracker.

The noise is drawn with the covariances in the tables, so that their score is known: NEES 6, correct sigmas, all labels
correct.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from geometry import rotations
from geometry.arrays import Array, Bools, Ints
from geometry.camera import Camera
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.rig import Beam, Rig, Screen, Spot
from lab.files.rig.rig_file import save_rig
from lab.files.run.run_file import save_run
from lab.files.text import columns
from lab.files.text.csv_text import write_table

NOISE_PX = 0.1
RATE_HZ = 100.0
MOTION_SIGMA = np.array([0.004] * 3 + [0.002] * 3)  # m/s and rad/s


def fake_rig(n_cameras: int = 2) -> Rig:
    """Screens at x = -2.5 m and +2.5 m, a camera for each (or for the left one only), three beams 20 deg apart."""
    turn = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # screen x, y, z = world y, z, x
    screens = {n: Screen(n, Pose(turn, np.array([x, 0.0, 0.0]))) for n, x in (("left", -2.5), ("right", 2.5))}
    K = np.array([[1180.0, 0, 639.5], [0, 1180, 511.5], [0, 0, 1]])
    axes_of = {"left": [[0, 1, 0], [0, 0, -1], [-1, 0, 0]], "right": [[0, -1, 0], [0, 0, -1], [1, 0, 0]]}
    cameras = {}
    for name, side in list(zip(axes_of, (1.0, -1.0), strict=True))[:n_cameras]:
        R = np.array(axes_of[name], dtype=float)
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
class _Recording:
    """What happens in F frames and V views."""

    frame: Ints  # (F,)
    t_s: Array  # (F,)
    pose: Pose  # (F,)
    motion: Array  # (F, 6): velocity, m/s, in world; rate, rad/s, about the body's axes
    true_uv: Array  # (F, V, 2)
    jacobian: Array  # (F, V, 2, 6), px per pose error
    status: np.ndarray  # (F, V) status words
    in_view: Ints  # (F, V)
    lost: Bools  # (F,)
    predicted: Bools  # (F,)

    @property
    def measured(self) -> Bools:
        """(F, V): the spot is measured."""
        return np.isin(self.status, ["matched", "turned"])

    @property
    def pose_status(self) -> np.ndarray:
        """(F,) status words of the poses."""
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
    recording = _record(model, n_frames, eventful, all_lost, rng)
    results, run_folder = folder / "results", folder / "run"
    (run_folder / "truth").mkdir(parents=True, exist_ok=True)
    results.mkdir(parents=True, exist_ok=True)
    uv, predicted_uv, sigma = _measured_spots(recording, rng)
    recording, covariance, error = _pose_errors(recording, rng)
    _write_spots(recording, model, uv, predicted_uv, sigma, results)
    rms = np.abs(NOISE_PX * (1 + 0.2 * rng.normal(size=n_frames)))
    motion_error = MOTION_SIGMA * rng.normal(size=recording.motion.shape)
    for which, scale in (("", 1.0), (columns.CAUSAL, 2.0))[: 2 if causal else 1]:
        scaled = (scale * error, scale**2 * covariance, scale * motion_error)
        _write_poses(recording, *scaled, scale * MOTION_SIGMA, rms, which, results)
    if truth:
        _write_truth(recording, model, run_folder / "truth")
    else:
        (run_folder / "truth").rmdir()
    summary = _summary(run_folder, recording.status, recording.pose_status, model)
    (results / "summary.json").write_text(json.dumps(summary), encoding="utf-8")
    if pictures:
        _pictures(run_folder, model, recording.true_uv, recording.in_view, rng)
    (run_folder / "detections.csv").write_bytes((results / "detections.csv").read_bytes())
    save_rig(rig, run_folder / "rig.yaml")
    sources = {n: {"frames": f"frames/{n}"} if pictures else {"detections": "detections.csv"} for n in rig.cameras}
    content = {"name": "fake <yaw & bend>", "rig": "rig.yaml", "frame_rate_hz": RATE_HZ, "cameras": sources}
    save_run({"schema": "beampose/run/1", **content, "notes": "Notes of the run & more."}, run_folder)
    return Fake(results, run_folder, model, recording.true_uv)


def _record(model: SpotModel, n_frames: int, eventful: bool, all_lost: bool, rng: np.random.Generator) -> _Recording:
    """The motion, and which spots and poses are measured, predicted or lost in each frame."""
    V = len(model)
    frame = np.arange(n_frames)
    t = frame / RATE_HZ
    triangle, pose = _path(t)
    moment = 1e-4
    motion = _path(t + moment)[1].minus(_path(t - moment)[1]) / (2 * moment)
    true_uv = np.empty((n_frames, V, 2))
    J = np.empty((n_frames, V, 2, 6))
    for k in range(0, n_frames, 2000):
        true_uv[k : k + 2000], J[k : k + 2000] = model.project(pose[slice(k, k + 2000)])
    inside = model.in_picture(true_uv)
    status = np.where(inside, "matched", np.where(np.isnan(true_uv[..., 0]), "off_screen", "out_of_view"))
    status = status.astype(object)
    in_view = inside.astype(int)
    lost = np.zeros(n_frames, dtype=bool)
    predicted = np.zeros(n_frames, dtype=bool)
    if eventful and n_frames >= 100:
        slope = np.sign(np.diff(triangle, prepend=triangle[0] - 1e-3))
        bends = np.flatnonzero(np.diff(slope) != 0) + 1
        for k in bends:
            status[k][inside[k]] = "turned"
        for j in range(V):
            for start in rng.integers(0, n_frames, size=max(1, n_frames // 150)):
                rows = slice(start, start + int(rng.integers(3, 20)))
                hidden = inside[rows, j]
                status[rows, j][hidden] = "occluded"
                in_view[rows, j][hidden] = 2
        f = int(0.31 * n_frames)
        status[f : f + 3, model.camera_of == 0] = "no_image"
        predicted[int(0.55 * n_frames) : int(0.55 * n_frames) + 14] = True
        lost[int(0.80 * n_frames) : int(0.80 * n_frames) + 12] = True
    if all_lost:
        lost[:] = True
    status[predicted & ~lost] = np.where(inside[predicted & ~lost], "occluded", status[predicted & ~lost])
    in_view[predicted & inside.any(1)] *= 2
    in_view = np.minimum(in_view, 2)
    status[lost] = "lost"
    status[:, ~np.isfinite(true_uv).any(axis=(0, 2))] = "off_screen"
    return _Recording(frame, t, pose, motion, true_uv, J, status, in_view, lost, predicted)


def _measured_spots(r: _Recording, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Positions (F, V, 2), their predictions (F, V, 2) and sigmas (F, V), px."""
    sigma = np.where(r.measured, NOISE_PX, 0.4)
    uv = r.true_uv + sigma[..., None] * rng.normal(size=r.true_uv.shape)
    early = r.true_uv + 0.2 * rng.normal(size=r.true_uv.shape)
    early[r.status == "turned"] += 8.0
    uv[np.isin(r.status, ["lost", "off_screen"])] = np.nan
    early[np.isin(r.status, ["lost", "off_screen"])] = np.nan
    sigma[np.isnan(uv[..., 0])] = np.nan
    return uv, early, sigma


def _pose_errors(r: _Recording, rng: np.random.Generator) -> tuple[_Recording, Array, Array]:
    """Covariances (F, 6, 6) and errors (F, 6) of the poses; frames with too few spots become predicted ones."""
    J = np.nan_to_num(r.jacobian)
    information = np.einsum("fv,fvij,fvik->fjk", r.measured.astype(float), J, J)
    # Spots of one screen lie on a line: without both screens the pose is not observable.
    regular = information + 1e-9 * np.eye(6)
    poor = NOISE_PX**2 * np.linalg.inv(regular)[:, range(3), range(3)].max(axis=1) > 0.05**2
    predicted = r.predicted | (~r.lost & poor)
    information[predicted | r.lost] = np.eye(6) * NOISE_PX**2
    cov = np.linalg.inv(information / NOISE_PX**2)
    since = np.zeros(len(r.frame))
    for k in np.flatnonzero(predicted):
        since[k] = since[k - 1] + 1 if k else 1
    grown = (since[:, None] * np.array([2e-3] * 3 + [1e-3] * 3)) ** 2
    cov[predicted] = np.eye(6) * grown[predicted][:, None, :]
    delta = (np.linalg.cholesky(cov) @ rng.normal(size=(len(r.frame), 6, 1)))[..., 0]
    delta[r.lost] = 0
    return replace(r, predicted=predicted), cov, delta


def _number(x: float) -> str:
    return "" if np.isnan(x) else f"{x:.6f}"


def _write_spots(r: _Recording, model: SpotModel, uv: Array, predicted_uv: Array, sigma: Array, results: Path) -> None:
    measured = r.measured
    rows, detected = [], []
    for k in range(len(r.frame)):
        for j, view in enumerate(model.views):
            place = [*map(_number, uv[k, j])]
            last = ["0.97" if measured[k, j] else "", "0" if np.isfinite(sigma[k, j]) else ""]
            rows.append(
                [r.frame[k], _number(r.t_s[k]), *view, *place, *[_number(sigma[k, j])] * 2, r.status[k, j],
                 *map(_number, predicted_uv[k, j]), *last, "0.999" if measured[k, j] else ""]
            )  # fmt: skip
            if measured[k, j]:
                shape = ["0.1", "0.1", "5000", "300", "2.1", "1.8", "12", "0"]
                detected.append([r.frame[k], view[0], *place, *shape])
    write_table(results / "spots.csv", columns.SPOTS, rows)
    write_table(results / "detections.csv", columns.DETECTIONS, detected)


def _write_poses(
    r: _Recording,
    error: Array,
    covariance: Array,
    motion_error: Array,
    motion_sigma: Array,
    rms_px: Array,
    which: str,
    results: Path,
) -> None:
    """attitude.csv and covariance.csv with these errors and sigmas: truth = estimate plus error."""
    estimate = Pose(r.pose.rotation @ rotations.exp(-error[:, 3:]), r.pose.translation - error[:, :3])
    Jypr = rotations.ypr_jacobian(estimate.rotation)
    s_ypr = np.degrees(np.sqrt(np.einsum("fij,fjk,fik->fi", Jypr, covariance[:, 3:, 3:], Jypr)))
    s_xyz = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)[:, :3])
    table = np.concatenate(
        [estimate.translation, estimate.quaternion_wxyz, np.degrees(estimate.ypr), s_xyz, s_ypr], axis=1
    )
    moving = np.concatenate([r.motion - motion_error, np.broadcast_to(motion_sigma, r.motion.shape)], axis=1)
    words, spots_used = r.pose_status, r.measured.sum(axis=1)
    rows = []
    for k in range(len(r.frame)):
        rms = _number(rms_px[k]) if words[k] == "measured" else ""
        fields = [""] * 16 if r.lost[k] else [f"{x:.9f}" for x in table[k]]
        last = [""] * 12 if r.lost[k] else [f"{x:.9f}" for x in moving[k]]
        rows.append([r.frame[k], _number(r.t_s[k]), *fields, int(spots_used[k]), rms, words[k], *last])
    write_table(results / f"attitude{which}.csv", columns.ATTITUDE, rows)
    upper = np.triu_indices(6)
    kept = np.flatnonzero(~r.lost)
    write_table(
        results / f"covariance{which}.csv",
        columns.COVARIANCE,
        [[r.frame[k], *(f"{x:.9e}" for x in covariance[k][upper])] for k in kept],
    )


def _write_truth(r: _Recording, model: SpotModel, folder: Path) -> None:
    q = r.pose.quaternion_wxyz
    poses = [[r.frame[k], r.t_s[k], *r.pose.translation[k], *q[k]] for k in range(len(r.frame))]
    write_table(folder / "pose.csv", columns.TRUTH_POSE, poses)
    spots = [
        [r.frame[k], *view, *map(_number, r.true_uv[k, j]), r.in_view[k, j]]
        for k in range(len(r.frame))
        for j, view in enumerate(model.views)
    ]
    write_table(folder / "spots.csv", columns.TRUTH_SPOTS, spots)


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
