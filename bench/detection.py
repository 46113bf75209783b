"""Accuracy and cost of detection: `python bench/detection.py [frames per set] [first seed]` prints the table."""

from __future__ import annotations

import sys
import tempfile
import time
import warnings
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from geometry.camera import SensorNoise
from tests.tracking.rendering import Scene, Spot, bound, expected, expose
from tracking.detection.detect import find_spots

SETS = ("main", "faint", "saturated", "near", "edge", "streak", "wide", "small", "speckle", "blank")
SIZE = (1280, 1024)
HALF_PX = 12.0  # of a region of interest: three sigmas of a spot and of its prediction


def scene_of(kind: str, rng: np.random.Generator) -> Scene:
    """One random scene of a set: 3 to 9 spots on a gradient, with hot pixels and two reflections."""
    low, high = {"faint": (6, 60), "saturated": (260, 600)}.get(kind, (60, 200))
    thin, thick = {"wide": (5, 13), "small": (0.5, 1.2)}.get(kind, (1.5, 3.0))
    spots: list[Spot] = []
    count = 0 if kind == "blank" else int(rng.integers(3, 10))
    while len(spots) < count:
        a, b = np.sort(rng.uniform(thin, thick, 2))[::-1]
        if kind == "wide":
            b = max(b, a / 2)
        u, v = rng.uniform(60, SIZE[0] - 60), rng.uniform(60, SIZE[1] - 60)
        if kind == "edge":
            near, side = rng.uniform(-0.4, 6), rng.integers(4)
            u, v = [(near, v), (SIZE[0] - 1 - near, v), (u, near), (u, SIZE[1] - 1 - near)][side]
        streak = rng.uniform(5, 12) if kind == "streak" else 0.0
        new = Spot(u, v, float(rng.uniform(low, high)), a, b, float(rng.uniform(-90, 90)), streak)
        if kind == "streak":
            new = Spot(u, v, new.peak, 1.8, 1.8, new.angle, streak)
        together = [new]
        if kind == "near":
            away, turn = rng.uniform(10, 16), rng.uniform(0, 2 * np.pi)
            other = Spot(
                u + away * np.cos(turn), v + away * np.sin(turn), float(rng.uniform(low, high)), a, b, new.angle
            )
            together.append(other)
        free = all(np.hypot(s.u - t.u, s.v - t.v) > 6 * (s.major + t.major) + 12 for s in spots for t in together)
        if free:
            spots += together
    humps = [
        Spot(*rng.uniform(0, SIZE), float(rng.uniform(10, 40)), *rng.uniform(40, 120, 2), float(rng.uniform(0, 90)))
        for _ in range(2)
    ]
    return Scene(
        spots, SIZE, float(rng.uniform(10, 20)), (float(rng.uniform(-8, 8)), float(rng.uniform(-8, 8))), humps, hot=5,
        speckle=0.2 if kind == "speckle" else 0.0,
    )  # fmt: skip


@dataclass(frozen=True)
class Row:
    """The figures of one set."""

    kind: str
    frames: int
    spots: int
    recall: float
    rms_px: float
    worst_px: float
    bound_px: float
    of_bound: float  # rms of error over the bound of each spot
    of_sigma: float  # rms of error over stated sigma
    false_per_frame: float
    time_ms: float
    read_ms: float
    regions_ms: float  # detection in boxes of half size HALF_PX about the spots only
    threshold_ms: float  # cv2.threshold of the picture into an array that exists

    def line(self) -> str:
        return (
            f"{self.kind:10} {self.frames:6} {self.spots:8} {self.recall:8.4f} {self.rms_px:8.4f} {self.worst_px:8.3f}"
            f" {self.rms_px / self.bound_px:8.3f} {self.of_bound:8.3f} {self.of_sigma:8.3f}"
            f" {self.false_per_frame:9.3f} {self.time_ms:8.2f}"
            f" {self.time_ms / self.read_ms:8.2f} {self.time_ms / self.threshold_ms:8.1f} {self.regions_ms:8.2f}"
        )


def measured(kind: str, frames: int, seed: int) -> Row:
    """One line of the table."""
    rng = np.random.default_rng([seed, SETS.index(kind)])
    errors, crlb, claimed, missed, false, total = [], [], [], 0, 0, 0
    spent, reading, in_regions, threshold = 0.0, 0.0, 0.0, 0.0
    other = np.empty(SIZE[::-1], np.uint8)
    folder = Path(tempfile.mkdtemp())
    for _ in range(frames):
        scene = scene_of(kind, rng)
        mean = expected(scene, rng)
        image = expose(mean, scene, rng)
        cv2.imwrite(str(folder / "frame.png"), image)
        start = time.process_time()
        image = cv2.imread(str(folder / "frame.png"), cv2.IMREAD_UNCHANGED)
        middle = time.process_time()
        noise = SensorNoise(scene.gain, scene.read * scene.gain)
        found = find_spots(image, noise=noise)
        after = time.process_time()
        spent += after - middle
        reading += middle - start
        boxes = np.array([[s.u, s.v, HALF_PX] for s in scene.spots]).reshape(-1, 3)
        find_spots(image, noise=noise, regions=boxes)
        later = time.process_time()
        in_regions += later - after
        cv2.threshold(image, 100, 255, cv2.THRESH_BINARY, other)
        threshold += time.process_time() - later
        taken: set[int] = set()
        total += len(scene.spots)
        for spot in scene.spots:
            away = np.hypot(*(found.uv_px - [spot.u, spot.v]).T) if len(found) else np.array([9.0])
            best = int(np.argmin(away))
            if away[best] > 3 or best in taken:
                missed += 1
                continue
            taken.add(best)
            errors.append(found.uv_px[best] - [spot.u, spot.v])
            claimed.append(found.cov_px2[best])
            crlb.append(bound(spot, scene, mean, saturation=255))
        false += len(found) - len(taken)
    e, C, B = np.array(errors).reshape(-1, 2), np.array(claimed).reshape(-1, 2, 2), np.array(crlb).reshape(-1, 2, 2)
    with np.errstate(invalid="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # mean of an empty set of errors
        return Row(
            kind,
            frames,
            total,
            1 - missed / total if total else np.nan,
            float(np.sqrt(np.mean(e**2))),
            float(np.abs(e).max(initial=0.0)),
            float(np.sqrt(np.mean(B[:, [0, 1], [0, 1]]))),
            float(np.sqrt(np.mean(e**2 / B[:, [0, 1], [0, 1]]))),
            float(np.sqrt(np.mean(e**2 / C[:, [0, 1], [0, 1]]))),
            false / frames,
            spent / frames * 1e3,
            reading / frames * 1e3,
            in_regions / frames * 1e3,
            threshold / frames * 1e3,
        )


def main() -> None:
    frames = int(sys.argv[1]) if len(sys.argv) > 1 else 60
    seed = int(sys.argv[2]) if len(sys.argv) > 2 else int(time.time())
    cv2.setNumThreads(1)
    find_spots(np.zeros(SIZE[::-1], np.uint8), regions=np.array([[9.0, 9.0, HALF_PX]]))  # loads the compiled code
    print(f"seed {seed}; 1280x1024, 8 bit; ms are process time of one core; 'read' is cv2.imread of the same PNG")
    print(
        "set        frames    spots   recall   rms px    worst rms/crlb err/crlb  err/sig  FP/frame"
        "      ms   x read x thresh   roi ms"
    )
    for kind in sys.argv[3:] or SETS:
        print(measured(kind, frames, seed).line(), flush=True)


if __name__ == "__main__":
    main()
