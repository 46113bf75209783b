"""`python -m bench.related_measurements.learned_detector`: recall, errors and reliability of the learned detector.

Rendered pictures of 640 x 480 with a drogue of 9 to 200 px before backgrounds that no training picture shows. The
threshold is the one with 0.1 false detections per frame. Beside it: cv2.HoughCircles with its best threshold.
`--calibrate` fits the logistic curve of the confidence on other pictures: as in training, and half as many of the
renderer that chose between trainings. `--weights` measures another network, such as the paper's layout, trained by
studies/learned_detector/train.py.
"""

from __future__ import annotations

import argparse
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from geometry.arrays import Array, Bools
from studies.learned_detector import third_renderer
from studies.learned_detector.samples import Sample, draw_sample
from tracking.learned_detector.detector import WEIGHTS, DrogueCandidate, find_drogues

SIZE_PX = (640, 480)
DIAMETERS_PX = (9.0, 200.0)
FALSE_PER_FRAME = 0.1
RIGHT_SHARE = 0.25  # of the diameter: largest error of the centre of a right detection
BINS = 8
LEAST_CONFIDENCE = 0.005  # of the candidates that the threshold is chosen from


def is_right(sample: Sample, found: DrogueCandidate) -> bool:
    """Whether a candidate is the sample's drogue: its centre, and its diameter to a factor of 1.5."""
    if not np.isfinite(sample.diameter_px):
        return False
    error = np.hypot(found.u_px - sample.centre_px[0], found.v_px - sample.centre_px[1])
    ratio = found.diameter_px / sample.diameter_px
    return bool(error <= RIGHT_SHARE * sample.diameter_px and 1 / 1.5 < ratio < 1.5)


def drawn(render: Any, kind: str, seed: int, k: int) -> Sample:
    """Picture k of a renderer before one of its backgrounds: every second one without a drogue, half of these small."""
    rng = np.random.default_rng([seed, k])
    scene, look = render.background(kind, rng), render.face("drogue", rng, hose=True)
    small, shown = k % 4 < 2, k % 2 == 0
    diameter = float(np.exp(rng.uniform(*np.log((9, 15) if small else (15, 200)))))
    u, v = (rng.uniform(0.6 * diameter, side - 0.6 * diameter) for side in render.SIZE)
    picture = render.draw(scene, look if shown else None, u, v, diameter / 2, rng)
    return Sample(picture, (u, v), diameter if shown else float("nan"))


def scored(samples: list[Sample], found: list[list[DrogueCandidate]]) -> tuple[Array, Bools, Array]:
    """Of all candidates: confidence, whether right (each drogue once), and centre error over the diameter."""
    rows: list[tuple[float, bool, float]] = []
    for sample, candidates in zip(samples, found, strict=True):
        taken = False
        for c in candidates:
            right = not taken and is_right(sample, c)
            taken |= right
            error = np.hypot(c.u_px - sample.centre_px[0], c.v_px - sample.centre_px[1]) / sample.diameter_px
            rows.append((c.confidence, right, float(error)))
    table = np.array(rows, dtype=float).reshape(-1, 3)
    return table[:, 0], table[:, 1] > 0, table[:, 2]


def recall_at(samples: list[Sample], score: Array, right: Bools, false_per_frame: float) -> tuple[float, float]:
    """Recall and threshold at a number of false detections per frame."""
    order = np.argsort(-score)
    allowed = np.cumsum(~right[order]) <= false_per_frame * len(samples)
    targets = sum(np.isfinite(s.diameter_px) for s in samples)
    last = int(np.flatnonzero(allowed)[-1]) if allowed.any() else -1
    threshold = float(score[order][last]) if last >= 0 else np.inf
    return float(right[order][: last + 1].sum() / max(targets, 1)), threshold


def hough(sample: Sample) -> list[DrogueCandidate]:
    """cv2.HoughCircles over the same range of diameters; its votes fall with the order of its answers."""
    grey = cv2.GaussianBlur(sample.image, (0, 0), 1.0)
    low, high = round(DIAMETERS_PX[0] / 2), round(DIAMETERS_PX[1] / 2)
    circles = cv2.HoughCircles(grey, cv2.HOUGH_GRADIENT, 1, 20, param1=100, param2=15, minRadius=low, maxRadius=high)
    if circles is None:
        return []
    return [DrogueCandidate(float(u), float(v), 2 * float(r), 1 / (1 + k)) for k, (u, v, r) in enumerate(circles[0])]


def calibration(confidence: Array, right: Bools) -> tuple[float, float]:
    """Slope and offset of the logistic curve over the logit of the confidence, by maximum likelihood (Platt 1999)."""
    x = np.log(np.clip(confidence, 1e-9, 1 - 1e-9) / np.clip(1 - confidence, 1e-9, 1))
    a, b = 1.0, 0.0
    for _ in range(50):
        p = 1 / (1 + np.exp(-(a * x + b)))
        w = np.maximum(p * (1 - p), 1e-9)
        J = np.stack([x, np.ones_like(x)], axis=1)
        step = np.linalg.solve(J.T @ (w[:, None] * J) + 1e-6 * np.eye(2), J.T @ (right - p))
        a, b = a + float(step[0]), b + float(step[1])
    return a, b


def reliability(confidence: Array, right: Bools) -> list[tuple[float, float, int]]:
    """Mean confidence, share of right candidates and number, by bins of confidence."""
    edges = np.linspace(0, 1, BINS + 1)
    out = []
    for low, high in pairwise(edges.tolist()):
        own = (confidence >= low) & (confidence <= high)
        if own.any():
            out.append((float(confidence[own].mean()), float(right[own].mean()), int(own.sum())))
    return out


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--calibrate", action="store_true")
    parser.add_argument("--weights", type=Path, default=WEIGHTS, help="a file weights.onnx of the training script")
    a = parser.parse_args()
    cv2.setNumThreads(1)
    rng = np.random.default_rng([a.seed, 77])
    samples = [
        draw_sample(rng, SIZE_PX, DIAMETERS_PX, unseen=not a.calibrate, empty=None if a.calibrate else False)
        for _ in range(a.frames)
    ]
    if a.calibrate:
        kinds = third_renderer.BACKGROUNDS
        samples += [drawn(third_renderer, kinds[k % len(kinds)], a.seed, k // len(kinds)) for k in range(a.frames // 2)]
    start = time.process_time()
    found = [find_drogues(s.image, DIAMETERS_PX[0], DIAMETERS_PX[1], LEAST_CONFIDENCE, a.weights) for s in samples]
    learned_s = time.process_time() - start
    confidence, right, error = scored(samples, found)
    if a.calibrate:
        slope, offset = calibration(confidence, right)
        print(f"slope and offset relative to the present ones: {slope:.3f}, {offset:.3f}")
    recall, threshold = recall_at(samples, confidence, right, FALSE_PER_FRAME)
    used = right & (confidence >= threshold)
    print(f"{len(samples)} frames, seed {a.seed}: recall {recall:.4f} at {FALSE_PER_FRAME} false detections per frame")
    centre = 100 * error[used] if used.any() else np.array([np.nan])
    print(f"  (confidence {threshold:.3f} and more); centre error, share of the diameter: median")
    print(f"  {np.median(centre):.2f} %, 95 % {np.quantile(centre, 0.95):.2f} %")
    print(f"  {1e3 * learned_s / len(samples):.0f} ms per frame, process time, one thread")
    print("reliability (confidence, share right, number):")
    for mean, share, number in reliability(confidence, right):
        print(f"  {mean:.2f} {share:.2f} {number}")
    start = time.process_time()
    circles = [hough(s) for s in samples]
    hough_s = time.process_time() - start
    score, ok, _ = scored(samples, circles)
    known, _ = recall_at(samples, score, ok, FALSE_PER_FRAME)
    print(f"cv2.HoughCircles: recall {known:.4f}, {1e3 * hough_s / len(samples):.0f} ms per frame")
    for low, high in ((9, 15), (15, 40), (40, 100), (100, 200)):
        size = np.array([s.diameter_px for s in samples])
        own = [i for i in range(len(samples)) if low <= size[i] < high]
        hits = sum(any(is_right(samples[i], c) and c.confidence >= threshold for c in found[i]) for i in own)
        print(f"  {low} to {high} px: {hits} of {len(own)}")


if __name__ == "__main__":
    main()
