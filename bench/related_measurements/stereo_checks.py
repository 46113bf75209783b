"""The binocular method on recordings of the generator beside it (stereo_generator.py), which shares no code with it.

    python -m bench.related_measurements.stereo_checks poses 5 10 20 30 --seed 1 --frames 12
    python -m bench.related_measurements.stereo_checks subsets 5 10 15 20 --seed 1 --markers 4
    python -m bench.related_measurements.stereo_checks errors --seed 1 --frames 30 [--covariance]
    python -m bench.related_measurements.stereo_checks approach 15 5 --seed 1 --frames 100

poses: NEES/6, bias and RMS by distance (m), time per frame, from ray-traced pictures; each frame is a first one.
subsets: each choice of so many of the seven markers, alone at the start (three: after one frame with all). errors: one
error of the stated calibration at a time, from centroids with .04 px noise; the verdict, what the calibration check
names, and the NEES. covariance: pair.yaml states one (.2 px of each lens, .1 mm, .006 deg), which the errors exceed.
approach: frames per second, and process time beside that of cv2.imread for the same pictures.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np

from bench.related_measurements.stereo_generator import (
    DISCS,
    HEIGHT,
    WIDTH,
    Eye,
    Place,
    approach,
    random_place,
    rotation,
    true_eyes,
    write_recording,
)
from geometry.camera import Camera
from geometry.pose import Pose
from lab.files.run.truth import read_true_poses
from lab.findings.finding import Verdict
from lab.targets.stereo.process import add_truth, findings_of, measure
from lab.targets.stereo.run import StereoResults, load_stereo_run
from tracking.binocular.marker_model import MarkerImages, MarkerModel, MatchParameters, StereoPair
from tracking.binocular.pose_tracker import BinocularTracker
from tracking.statuses import PoseStatus

CENTROID_NOISE_PX = {5: 0.016, 10: 0.027, 15: 0.045, 20: 0.062}  # of the pictures at these distances (m)
WRONG_NEES = 40.0
STATED = {f"cameras.{name}.{p}": 0.2 for name in ("left", "right") for p in ("fx", "fy", "cx", "cy")}
STATED |= {f"cameras.right.{p}": 1e-4 for p in ("x_m", "y_m", "z_m", "rot_x_rad", "rot_y_rad", "rot_z_rad")}
ERRORS = {
    "baseline": (-0.003, 0.01, -0.05), "yaw": (0.01, 0.03, -0.3), "pitch": (0.01, -0.05, 0.3),
    "roll": (0.01, -0.05, 0.3), "focal both": (0.002, -0.005, 0.02), "focal left": (0.002, -0.02),
    "focal right": (-0.002, 0.005, 0.02), "cx right": (1, -5), "cy left": (1, -5), "cx left": (-2,), "cy right": (3,),
}  # fmt: skip # share, deg, px


def processed(folder: Path) -> tuple[StereoResults, float]:
    """The results of a recording with its truth, and the process time (s) of the measurement."""
    run, clock = load_stereo_run(folder), time.process_time()
    results = measure(run)
    seconds = time.process_time() - clock
    add_truth(results, read_true_poses(folder / "truth" / "pose.csv"))
    return results, seconds


def poses(distances: list[float], frames: int, seed: int, work: Path) -> None:
    for z in distances:
        rng = np.random.default_rng([seed, int(z)])
        folder = work / f"{z:g}"
        write_recording(folder, [random_place(z, rng) for _ in range(frames)], true_eyes(), rng)
        results, seconds = processed(folder)
        e = results.errors
        figures = "no pose"
        if e is not None:
            bias, rms = 1e3 * e.deltas[:, 2].mean(), 1e3 * np.sqrt((e.deltas[:, 2] ** 2).mean())
            figures = f"NEES/6 {e.nees.mean() / 6:.2f}, distance: bias {bias:.2f}, RMS {rms:.2f} mm"
        print(
            f"{z:g} m: {len(results.measured)} of {frames} measured, {figures}, {1e3 * seconds / frames:.0f} ms/frame"
        )


def along_approach(far: float, near: float, frames: int, seed: int, work: Path) -> None:
    """Frames per second of one recording, the target of which comes nearer, from files to poses."""
    rng = np.random.default_rng([seed, int(far), int(near)])
    write_recording(work / "run", approach(frames, far, near, rng), true_eyes(), rng)
    processed(work / "run")  # compiles
    clock = time.perf_counter()
    results, seconds = processed(work / "run")
    took, start = time.perf_counter() - clock, time.process_time()
    for path in sorted((work / "run" / "frames").rglob("*.png")):
        cv2.imread(str(path))
    by_opencv = time.process_time() - start
    print(
        f"{far:g} to {near:g} m: {len(results.measured)} of {frames} measured; {frames / took:.0f} frames per second,"
        f" {1e3 * seconds / frames:.0f} ms of process time per frame, cv2.imread {1e3 * by_opencv / frames:.0f} ms"
    )


def subsets(distances: list[float], markers: int, seed: int) -> None:
    eyes, rng = true_eyes(), np.random.default_rng(seed)
    names = ("left", "right")
    pair = StereoPair((_camera(names[0], eyes[0]), _camera(names[1], eyes[1])))
    model = MarkerModel(tuple("1234567"), DISCS, np.zeros(7, int), np.full(7, np.nan))

    def images(place: Place, chosen: tuple[int, ...], sigma: float) -> tuple[MarkerImages, MarkerImages]:
        out = []
        for eye in eyes:
            uv = eye.pixels(DISCS[list(chosen)] @ place.R.T + place.t)
            uv = rng.permutation(uv + rng.normal(0, sigma, uv.shape))
            n = len(uv)
            cov = np.broadcast_to(sigma**2 * np.eye(2), (n, 2, 2))
            out.append(MarkerImages(uv, cov, np.full(n, np.nan), np.zeros(n, int)))
        return out[0], out[1]

    for z in distances:
        found: Counter[str] = Counter()
        for chosen in combinations(range(7), markers):
            place, tracker = random_place(z, rng), BinocularTracker(pair, model, MatchParameters())
            sigma = CENTROID_NOISE_PX.get(int(z), 0.05)
            if markers < 4:
                tracker.step(-0.04, images(place, tuple(range(7)), sigma))
            frame = tracker.step(0.0, images(place, chosen, sigma))
            found[f"{frame.status.value} {frame.reason}".strip()] += 1
            if frame.status is PoseStatus.MEASURED and frame.pose is not None and frame.covariance is not None:
                d = Pose(place.R, place.t).minus(frame.pose)
                found["wrong"] += int(d @ np.linalg.solve(frame.covariance, d) > WRONG_NEES)
        print(f"{z:g} m, {markers} markers: {dict(found)}")


def _camera(name: str, eye: Eye) -> Camera:
    matrix = np.array([[eye.f, 0, eye.c[0]], [0, eye.f, eye.c[1]], [0, 0, 1.0]])
    return Camera(name, "", (WIDTH, HEIGHT), matrix, (), Pose(eye.R, -eye.R @ eye.centre))


def stated_eyes(kind: str, size: float) -> tuple[Eye, Eye]:
    """The cameras as a calibration with one error states them."""
    a, b = true_eyes()
    if kind == "baseline":
        b = replace(b, centre=b.centre * (1 + size))
    elif kind in ("pitch", "yaw", "roll"):
        axis = np.eye(3)[("pitch", "yaw", "roll").index(kind)]
        b = replace(b, R=rotation(np.deg2rad(size) * axis) @ b.R)
    elif kind.startswith("focal"):
        a = replace(a, f=a.f * (1 + size)) if kind != "focal right" else a
        b = replace(b, f=b.f * (1 + size)) if kind != "focal left" else b
    elif kind != "none":
        shift = size * np.eye(2)[("cx", "cy").index(kind[:2])]
        a = replace(a, c=tuple(np.array(a.c) + shift)) if kind.endswith("left") else a
        b = replace(b, c=tuple(np.array(b.c) + shift)) if kind.endswith("right") else b
    return a, b


def _errors() -> Iterator[tuple[str, float]]:
    yield "none", 0.0
    for kind, sizes in ERRORS.items():
        for size in sizes:
            yield kind, size


def errors(frames: int, seed: int, work: Path, sigmas: dict[str, float] | None) -> None:
    for i, (kind, size) in enumerate(_errors()):
        rng = np.random.default_rng([seed, 7])
        folder = work / str(i)
        write_recording(
            folder, approach(frames, 20, 5, rng), stated_eyes(kind, size), rng, pictures=False, noise_px=0.04,
            sigmas=sigmas,
        )  # fmt: skip
        results, _ = processed(folder)
        check, nees = results.calibration, 0.0 if results.errors is None else results.errors.nees.mean()
        verdict = Verdict(findings_of(results)).status
        words = "none" if check is None else "; ".join(
            f"{s.name} {s.value:.3f} +- {s.sigma:.3f} {s.unit} ({s.chi2:.0f})" for s in check.suspects
        )  # fmt: skip
        certain = "" if check is None else ", significant" if check.significant else ", not significant"
        print(
            f"{kind} {size:g}: {verdict}, {len(results.measured)} of {frames} measured, NEES {nees:.0f}{certain}:"
            f" {words}",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("poses", "subsets", "errors", "approach"))
    parser.add_argument("distances", nargs="*", type=float, default=[5.0, 10.0, 20.0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--markers", type=int, default=4)
    parser.add_argument("--covariance", action="store_true")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as work:
        if given.what == "poses":
            poses(given.distances, given.frames, given.seed, Path(work))
        elif given.what == "subsets":
            subsets(given.distances, given.markers, given.seed)
        elif given.what == "approach":
            along_approach(given.distances[0], given.distances[-1], given.frames, given.seed, Path(work))
        else:
            errors(given.frames, given.seed, Path(work), STATED if given.covariance else None)


if __name__ == "__main__":
    main()
