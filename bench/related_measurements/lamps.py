"""`beampose track lamps` on pictures of a second renderer: poses within 10 cm and 1 deg, NEES, wrong poses.

    python -m bench.related_measurements.lamps --seeds 1:6 --frames 100

Written from the question alone, without the code of studies/: lamps are discs of light that the lens blurs, with a
size and a brightness of their own, on a black body before clouds or ground; the camera has a lens with distortion, the
body six degrees of freedom. Each recording is a folder of pictures, a camera.yaml and a lamps.yaml, given to the
command. Lamps are hidden one at a time, for 3 to 19 frames, and other lights shine, others in each picture.

    python -m bench.related_measurements.lamps --seeds 1:17 --lamps 4 --others 5

The first lamps alone, never hidden, among lights that move through the pictures, each on its own; without the target
with --lamps 0 (then the target has four).
"""

from __future__ import annotations

import argparse
import csv
import tempfile
from pathlib import Path

import cv2
import numpy as np
import yaml
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

from bench.related_measurements.renderers.second_renderer import background, field
from cli import main as beampose
from geometry.arrays import Array

SIZE, F, RATE = (640, 480), 620.0, 25.0
LENS = np.array([-0.12, 0.03, 0.0, 0.0])
LAMPS = np.array(
    [[-2.6, 0.3, 0.0], [2.5, 0.1, -0.2], [0.1, -1.3, 1.0], [0.0, 0.2, -0.9], [0.3, 1.1, 0.4]]
)  # m, in body
HULL = 1.3 * np.array([[-2.9, 0.3, 0], [0, -1.5, 0.2], [2.8, 0.1, 0], [0, 1.3, 0.2]])


def truth(rng: np.random.Generator, n: int) -> tuple[Array, Rotation]:
    """Positions (n, 3), m, in the camera's frame, and attitudes of a body that approaches and sways."""
    t = np.arange(n) / RATE
    phase = rng.uniform(0, 2 * np.pi, (6,))
    sway = np.stack([np.sin(2 * np.pi * t / p + a) for p, a in zip(rng.uniform(4, 12, 6), phase, strict=True)], -1)
    position = np.array([0.8, 0.5, 0.5]) * sway[:, :3] + [rng.uniform(-1, 1), rng.uniform(-1, 1), 0]
    position[:, 2] += np.linspace(rng.uniform(18, 26), rng.uniform(10, 14), n)
    return position, Rotation.from_euler("zyx", np.array([6.0, 8.0, 8.0]) * sway[:, 3:], degrees=True)


def draw(
    at: Array, turn: Rotation, scene: Array, glow: Array, hidden: list[int], rng: np.random.Generator,
    others: Array | None = None,
) -> Array:  # fmt: skip
    """A picture (h, w), 8 bit. hidden: lamps that do not shine; others (n, 2): lights beside them, None: some."""
    K = np.array([[F, 0, SIZE[0] / 2 - 0.5], [0, F, SIZE[1] / 2 - 0.5], [0, 0, 1]])

    def pixels(points: Array) -> Array:
        return np.asarray(cv2.projectPoints(turn.apply(points) + at, np.zeros(3), np.zeros(3), K, LENS)[0]).reshape(
            -1, 2
        )

    out = scene.copy()
    cv2.fillPoly(out, [np.round(8 * pixels(HULL)).astype(np.int32)], 40.0, cv2.LINE_AA, 3)
    light = np.zeros((4 * SIZE[1], 4 * SIZE[0]), np.float32)  # 4 x 4 samples per pixel
    lamps = np.delete(pixels(LAMPS), hidden, axis=0)
    for (u, v), (radius_px, peak) in zip(lamps, glow, strict=False):
        cv2.circle(
            light,
            np.round(16 * (4 * np.array([u, v]) + 1.5)).astype(int).tolist(),
            round(64 * radius_px),
            peak,
            -1,
            0,
            4,
        )
    if others is None:
        others = rng.uniform(0, 1, (rng.integers(0, 6), 2)) * SIZE
    for u, v in others:
        cv2.circle(light, (int(4 * u), int(4 * v)), int(4 * rng.uniform(0.5, 2)), float(rng.uniform(60, 200)), -1)
    small = cv2.resize(light, SIZE, interpolation=cv2.INTER_AREA)
    out = cv2.GaussianBlur(out, (0, 0), 0.8) + cv2.GaussianBlur(small, (0, 0), 0.9)
    return np.clip(np.round(out + 2.0 * rng.normal(size=out.shape)), 0, 255).astype(np.uint8)


def write_recording(
    folder: Path, seed: int, n: int, shining: int | None = None, others: int = 0
) -> tuple[Array, Rotation]:
    """Pictures, camera.yaml and lamps.yaml in a folder, and the true motion.

    shining: lamps that shine, never hidden, of a target that has as many, and others that move; None: all lamps.
    """
    rng = np.random.default_rng(seed)
    position, attitude = truth(rng, n)
    kind = ("cloud", "ground", "sky")[seed % 3]
    scene = (0.6 * background(kind, rng, SIZE) + 4 * field(rng, SIZE, 60, 4, 0.6)).astype(np.float32)
    glow = np.stack([rng.uniform(0.7, 2.0, len(LAMPS)), rng.uniform(130, 230, len(LAMPS))], -1)
    (folder / "frames").mkdir(parents=True)
    apart = np.random.default_rng((seed, 1))
    start, speed = apart.uniform(0.1, 0.9, (others, 2)) * SIZE, apart.normal(0, 1.0, (others, 2))  # px, px per frame
    hidden, until = -1, 0
    for k in range(n):
        if k == until:
            hidden = -1
        if k > until and rng.random() < 0.04:
            hidden, until = int(rng.integers(len(LAMPS))), k + int(rng.integers(3, 20))
        if shining is None:
            drawn = draw(position[k], attitude[k], scene, glow, [hidden] if hidden >= 0 else [], rng)
        else:
            off = list(range(shining, len(LAMPS)))
            drawn = draw(position[k], attitude[k], scene, glow, off, rng, start + k * speed)
        cv2.imwrite(str(folder / "frames" / f"{k:05d}.png"), drawn)
    camera = {
        "schema": "beampose/camera/1", "name": "nose", "image_size_px": list(SIZE),
"camera_matrix": {"fx": F, "fy": F, "cx": SIZE[0] / 2 - 0.5, "cy": SIZE[1] / 2 - 0.5},
        "distortion": LENS.tolist(),
        "covariance": {"parameters": ["fx", "fy"], "matrix": [[0.04, 0.0], [0.0, 0.04]]},
    }  # fmt: skip
    (folder / "camera.yaml").write_text(yaml.safe_dump(camera))
    of_target = LAMPS if shining is None else LAMPS[: max(shining, 4)]
    markers = {f"L{k + 1}": {"position_m": lamp.tolist()} for k, lamp in enumerate(of_target)}
    (folder / "lamps.yaml").write_text(yaml.safe_dump({"markers": markers}))
    return position, attitude


def judged(folder: Path, position: Array, attitude: Rotation, detector: str) -> tuple[list[str], Array]:
    """The statuses of the rows, and (n, 3): error of the position, m, of the attitude, deg, NEES/6; nan without one."""
    options = ["--target", folder / "lamps.yaml", "--camera", folder / "camera.yaml", "--detector", detector]
    done = CliRunner().invoke(
        beampose, ["track", "lamps", *map(str, [folder / "frames", *options, "--out", folder / "out"])]
    )
    if done.exit_code not in (0, 4):
        raise SystemExit(done.output)
    with (folder / "out" / "attitude.csv").open() as file:
        rows = list(csv.DictReader(file))
    with (folder / "out" / "covariance.csv").open() as file:
        covariances = {int(r.pop("frame")): np.array(list(map(float, r.values()))) for r in csv.DictReader(file)}
    out = np.full((len(rows), 3), np.nan)
    for k, row in enumerate(rows):
        if row["x_m"]:
            shift = position[k] - np.array([float(row[c]) for c in ("x_m", "y_m", "z_m")])
            turn = Rotation.from_quat([float(row[c]) for c in ("qx", "qy", "qz", "qw")])
            error = np.concatenate([shift, (turn.inv() * attitude[k]).as_rotvec()])
            C = np.zeros((6, 6))
            C[np.triu_indices(6)] = covariances[int(row["frame"])]
            C = C + C.T - np.diag(np.diag(C))
            out[k] = np.linalg.norm(shift), np.rad2deg(np.linalg.norm(error[3:])), error @ np.linalg.solve(C, error) / 6
    return [row["status"] for row in rows], out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="1:6", help="FIRST:LAST, one recording each")
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--lamps", type=int, help="lamps that shine, among --others; else five, one hidden at times")
    parser.add_argument("--others", type=int, default=5)
    parser.add_argument("--detector", default="spots", choices=["spots", "harris"])
    given = parser.parse_args()
    status, errors = [], []
    for seed in range(*map(int, given.seeds.split(":"))):
        with tempfile.TemporaryDirectory() as place:
            motion = write_recording(Path(place), seed, given.frames, given.lamps, given.others)
            of_run, e = judged(Path(place), *motion, given.detector)
        measured = np.array(of_run) == "measured"
        right = (e[:, 0] < 0.1) & (e[:, 1] < 1.0)
        status += of_run
        errors.append(e)
        if not measured.any():
            print(f"seed {seed}: none measured", flush=True)
            continue
        print(
            f"seed {seed}: measured {measured.mean():.3f}; within 10 cm and 1 deg {right.mean():.3f} of all,"
            f" {right[measured].mean():.3f} of the measured frames; NEES/6 {np.nanmean(e[measured, 2]):.2f}; largest"
            f" measured error {np.nanmax(e[measured, 0]):.3f} m, {np.nanmax(e[measured, 1]):.2f} deg",
            flush=True,
        )
    e, measured = np.concatenate(errors), np.array(status) == "measured"
    if not measured.any():
        return
    right = (e[:, 0] < 0.1) & (e[:, 1] < 1.0)
    print(
        f"all {len(e)} frames: measured {measured.mean():.4f}; within 10 cm and 1 deg {right.mean():.4f} of all,"
        f" {right[measured].mean():.4f} of the measured; NEES/6 {np.nanmean(e[measured, 2]):.2f}, median"
        f" {np.nanmedian(e[measured, 2]):.2f}"
    )


if __name__ == "__main__":
    main()
