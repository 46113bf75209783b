"""`python -m bench.related_measurements.learned_detector`: recall, errors and reliability of the learned detector.

Rendered pictures of 640 x 480 with a drogue of 9 to 200 px before backgrounds that no training picture shows. The
threshold is the one with 0.1 false detections per frame. Beside it: cv2.HoughCircles with its best threshold.
`--calibrate` fits CALIBRATION and GROWTH of the detector on other pictures, as in training and of the renderer that
chose between trainings, and prints them (`--frames 500 --seed 9`; docs/papers/zhou2020_detector.md has the answer).
`--weights` measures another network, such as the paper's layout, trained by studies/learned_detector/train.py.
"""

from __future__ import annotations

import argparse
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.optimize import minimize

from bench.related_measurements.renderers import third_renderer
from geometry.arrays import Array, Bools
from studies.learned_detector.samples import Sample, draw_sample
from tracking.learned_detector.detector import (
    CALIBRATION,
    WEIGHTS,
    DrogueCandidate,
    features,
    find_drogues,
    first_candidates,
    looked_at,
)

SIZE_PX = (640, 480)
DIAMETERS_PX = (9.0, 200.0)
FALSE_PER_FRAME = 0.1
RIGHT_SHARE = 0.25  # of the diameter: largest error of the centre of a right detection
BINS = 8
LEAST_CONFIDENCE = 0.005  # of the candidates that the threshold is chosen from
_THIRD, _THIRD_SEED, _THIRD_WEIGHT = 600, 42, 0.5  # pictures of the third renderer for the calibration
_ENLARGED = 0.3  # log enlargement from which a look shows how much it blurs


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


def logistic(x: Array, y: Bools, signs: tuple[int, ...], weight: Array | float = 1.0, ridge: float = 1.0) -> Array:
    """Coefficients (n,) of the logistic curve of inputs (m, n) and answers (m,), by maximum likelihood (Platt 1999).

    signs (n,): 1 or -1 where a coefficient may not have the other sign, else 0.
    """

    def cost(c: Array) -> tuple[float, Array]:
        z = x @ c
        loss = np.sum(weight * (np.logaddexp(0, z) - y * z)) + 0.5 * ridge * c @ c
        return float(loss), x.T @ (weight * (1 / (1 + np.exp(-z)) - y)) + ridge * c

    bounds = [(0.0 if s > 0 else None, 0.0 if s < 0 else None) for s in signs]
    return np.asarray(minimize(cost, np.zeros(x.shape[1]), jac=True, bounds=bounds, method="L-BFGS-B").x)


def fitted(samples: list[Sample], weight: Array, weights: Path) -> tuple[Array, float]:
    """CALIBRATION and GROWTH of the detector, from weighted pictures."""
    inputs, right, of, growth = [], [], [], []
    for sample, share in zip(samples, weight.tolist(), strict=True):
        rows, levels = first_candidates(sample.image, *DIAMETERS_PX, weights)
        for row in rows:
            seen = looked_at(row, levels, weights)
            u, v = seen[:, 1:3].mean(axis=0).tolist()
            sizes = seen[:, 3] - np.log(sample.diameter_px)  # nan without a drogue
            ok = is_right(sample, DrogueCandidate(u, v, float(np.exp(seen[:, 3].mean())), 1.0))
            inputs.append(features(row, seen))
            right.append(ok)
            of.append(share)
            enlarged = seen[:, 4] > _ENLARGED
            growth += (sizes[enlarged] / seen[enlarged, 4]).tolist() if ok else []
    return logistic(np.array(inputs), np.array(right), (0,) * len(CALIBRATION), np.array(of)), float(np.median(growth))


def own_pictures(frames: int, seed: int, unseen: bool, empty: bool | None) -> list[Sample]:
    """Pictures of the renderer of the training."""
    rng = np.random.default_rng([seed, 77])
    return [draw_sample(rng, SIZE_PX, DIAMETERS_PX, unseen=unseen, empty=empty) for _ in range(frames)]


def of_calibration(frames: int, seed: int) -> tuple[list[Sample], Array]:
    """The pictures that `fitted` gets for the constants of the detector, and their weights."""
    samples = own_pictures(frames, seed, unseen=False, empty=None)
    kinds = third_renderer.BACKGROUNDS
    samples += [drawn(third_renderer, kinds[k % len(kinds)], _THIRD_SEED, k // len(kinds)) for k in range(_THIRD)]
    return samples, np.where(np.arange(len(samples)) < frames, 1.0, _THIRD_WEIGHT)


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
    if a.calibrate:
        samples, weight = of_calibration(a.frames, a.seed)
        curve, growth = fitted(samples, weight, a.weights)
        print(f"CALIBRATION = {np.round(curve, 2).tolist()}, GROWTH = {growth:.2f}")
    else:
        samples = own_pictures(a.frames, a.seed, unseen=True, empty=False)
    start = time.process_time()
    found = [find_drogues(s.image, DIAMETERS_PX[0], DIAMETERS_PX[1], LEAST_CONFIDENCE, a.weights) for s in samples]
    learned_s = time.process_time() - start
    confidence, right, error = scored(samples, found)
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
