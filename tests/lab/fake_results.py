"""A results folder in the documented formats from the forward model: truth plus noise, without a tracker.

The noise is drawn from the stated covariances, so the scores are known: NEES 6, correct sigmas, correct labels.
"""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
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
    """The folders, and the truth."""

    results: Path
    run_folder: Path
    model: SpotModel
    true_uv: Array  # (F, V, 2)


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
    """Write folder/run and folder/results. causal: also the causal poses, twice as uncertain."""
    rng = np.random.default_rng(seed)
    rig = fake_rig(n_cameras)
    model = SpotModel.of(rig)
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
    measured = np.isin(status, ["matched", "turned"])

    sigma = np.where(measured, NOISE_PX, 0.4)
    uv = true_uv + sigma[..., None] * rng.normal(size=true_uv.shape)
    early = true_uv + 0.2 * rng.normal(size=true_uv.shape)
    early[status == "turned"] += 8.0
    uv[np.isin(status, ["lost", "off_screen"])] = np.nan
    early[np.isin(status, ["lost", "off_screen"])] = np.nan
    sigma[np.isnan(uv[..., 0])] = np.nan

    information = np.einsum("fv,fvij,fvik->fjk", measured.astype(float), np.nan_to_num(J), np.nan_to_num(J))
    # Spots of one screen lie on a line: without both screens there is no pose to measure.
    shrunk = information + 1e-9 * np.eye(6)
    predicted |= ~lost & (NOISE_PX**2 * np.linalg.inv(shrunk)[:, range(3), range(3)].max(axis=1) > 0.05**2)
    information[predicted | lost] = np.eye(6) * NOISE_PX**2
    cov = np.linalg.inv(information / NOISE_PX**2)
    since = np.zeros(n_frames)
    for k in np.flatnonzero(predicted):
        since[k] = since[k - 1] + 1 if k else 1
    grown = (since[:, None] * np.array([2e-3] * 3 + [1e-3] * 3)) ** 2
    cov[predicted] = np.eye(6) * grown[predicted][:, None, :]
    delta = (np.linalg.cholesky(cov) @ rng.normal(size=(n_frames, 6, 1)))[..., 0]
    delta[lost] = 0

    results, run_folder = folder / "results", folder / "run"
    results.mkdir(parents=True, exist_ok=True)
    run_folder.mkdir(parents=True, exist_ok=True)

    def number(x: float) -> str:
        return "" if np.isnan(x) else f"{x:.6f}"

    def write(path: Path, header: tuple[str, ...], rows: list[list[object]]) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("w", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(header)
            writer.writerows(rows)

    write(
        results / "spots.csv",
        columns.SPOTS,
        [
            [
                frame[k], number(t[k]), *model.views[j], *map(number, uv[k, j]), number(sigma[k, j]),
                number(sigma[k, j]), status[k, j], *map(number, early[k, j]),
                "0.97" if measured[k, j] else "", "0" if np.isfinite(sigma[k, j]) else "",
                "0.999" if measured[k, j] else "",
            ]
            for k in range(n_frames)
            for j in range(V)
        ],
    )  # fmt: skip
    rms = np.abs(NOISE_PX * (1 + 0.2 * rng.normal(size=n_frames)))
    word = np.where(lost, "lost", np.where(predicted, "predicted", "measured"))
    motion_error = MOTION_SIGMA * rng.normal(size=motion.shape)

    def write_poses(which: str, times: float) -> None:
        """Attitude and covariance with errors and sigmas multiplied by `times`."""
        wrong = times * delta  # truth = estimate plus delta
        estimate = Pose(pose.rotation @ rotations.exp(-wrong[:, 3:]), pose.translation - wrong[:, :3])
        C = times**2 * cov
        Jypr = rotations.ypr_jacobian(estimate.rotation)
        s_ypr = np.degrees(np.sqrt(np.einsum("fij,fjk,fik->fi", Jypr, C[:, 3:, 3:], Jypr)))
        s_xyz = np.sqrt(np.diagonal(C, axis1=1, axis2=2)[:, :3])
        table = np.concatenate(
            [estimate.translation, estimate.quaternion_wxyz, np.degrees(estimate.ypr), s_xyz, s_ypr], axis=1
        )
        moving = np.concatenate([motion - times * motion_error, np.full((n_frames, 6), times) * MOTION_SIGMA], axis=1)
        rows = []
        for k in range(n_frames):
            rms_text = number(rms[k]) if word[k] == "measured" else ""
            fields = [""] * 16 if lost[k] else [f"{x:.9f}" for x in table[k]]
            last = [""] * 12 if lost[k] else [f"{x:.9f}" for x in moving[k]]
            rows.append([frame[k], number(t[k]), *fields, int(measured[k].sum()), rms_text, word[k], *last])
        write(results / f"attitude{which}.csv", columns.ATTITUDE, rows)
        upper = np.triu_indices(6)
        write(
            results / f"covariance{which}.csv",
            columns.COVARIANCE,
            [[frame[k], *(f"{x:.9e}" for x in C[k][upper])] for k in np.flatnonzero(~lost)],
        )

    write_poses("", 1.0)
    if causal:
        write_poses(columns.CAUSAL, 2.0)
    detected = [
        [
            frame[k], model.views[j][0], *map(number, uv[k, j]), "0.1", "0.1", "5000", "300", "2.1", "1.8", "12", "0",
        ]
        for k in range(n_frames)
        for j in range(V)
        if measured[k, j]
    ]  # fmt: skip
    write(results / "detections.csv", columns.DETECTIONS, detected)
    if truth:
        true_q = pose.quaternion_wxyz
        write(
            run_folder / "truth" / "pose.csv",
            columns.TRUTH_POSE,
            [[frame[k], t[k], *pose.translation[k], *true_q[k]] for k in range(n_frames)],
        )
        write(
            run_folder / "truth" / "spots.csv",
            columns.TRUTH_SPOTS,
            [
                [frame[k], *model.views[j], *map(number, true_uv[k, j]), in_view[k, j]]
                for k in range(n_frames)
                for j in range(V)
            ],
        )
    (results / "summary.json").write_text(json.dumps(_summary(run_folder, status, word, model)), encoding="utf-8")
    if pictures:
        _pictures(run_folder, model, true_uv, in_view, rng)
    (run_folder / "detections.csv").write_bytes((results / "detections.csv").read_bytes())
    save_rig(rig, run_folder / "rig.yaml")
    sources = {n: {"frames": f"frames/{n}"} if pictures else {"detections": "detections.csv"} for n in rig.cameras}
    content = {"name": "fake <yaw & bend>", "rig": "rig.yaml", "frame_rate_hz": RATE_HZ, "cameras": sources}
    save_run({"schema": "beampose/run/1", **content, "notes": "Notes of the run & more."}, run_folder)
    return Fake(results, run_folder, model, true_uv)


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
    """The motion of the vehicle: the triangle wave of its yaw, whose corners are bends, and the poses."""
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
    """Grey pictures with Gaussian spots; the ninth file of the first camera is cut short."""
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
