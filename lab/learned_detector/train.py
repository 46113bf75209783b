"""`python -m lab.learned_detector.train --out DIR`: trains the learned detector and exports it.

Needs the extra `training` (torch, onnx). The weights of the package were made by

    python -m lab.learned_detector.train --out build/detector --samples 8000 --epochs 12 --seed 2020

and copied to tracking/learned_detector/. The same seed gives the same samples; sums in another order change the weights
in their last digits on another machine.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from geometry.arrays import Array
from lab.learned_detector.networks import NETWORKS, SMALL, STRIDE, make_network
from lab.learned_detector.samples import draw_sample

SIZE_PX = 112
DIAMETERS_PX = (7.0, 44.0)  # one level of the pyramid; the detector uses 8 to 40
VALIDATION = 1500  # samples


def drawn_samples(number: int, seed: int) -> tuple[np.ndarray, Array]:
    """Pictures (number, SIZE_PX, SIZE_PX) and truths (number, 3): centre u, v and diameter, px; nan without one."""
    rng = np.random.default_rng([seed, number])
    images, truth = np.empty((number, SIZE_PX, SIZE_PX), np.uint8), np.empty((number, 3))
    for i in range(number):
        sample = draw_sample(rng, (SIZE_PX, SIZE_PX), DIAMETERS_PX)
        images[i], truth[i] = sample.image, (*sample.centre_px, sample.diameter_px)
    return images, truth


def targets(truth: Array) -> tuple[Array, Array, Array]:
    """Heat (n, s, s), regression (n, 3, s, s) and its weight (n, s, s) for truths (n, 3); s = SIZE_PX / STRIDE."""
    side = SIZE_PX // STRIDE
    centres = STRIDE * np.arange(side) + (STRIDE - 1) / 2
    u, v, diameter = (truth[:, i, None, None] for i in range(3))
    du, dv = u - centres[None, None, :], v - centres[None, :, None]
    sigma = np.maximum(0.08 * diameter, 1.6)
    heat = np.nan_to_num(np.exp(-0.5 * (du**2 + dv**2) / sigma**2))
    # The cell that holds the centre is a full positive.
    inside = (np.abs(du) <= STRIDE / 2) & (np.abs(dv) <= STRIDE / 2)
    heat = np.where(inside, 1.0, heat)
    size = np.broadcast_to(np.log(diameter), heat.shape)
    values = np.nan_to_num(np.stack([du / STRIDE + 0 * dv, dv / STRIDE + 0 * du, size], axis=1))
    return heat, values, (heat > 0.5).astype(float)


def loss(out: Any, heat: Any, values: Any, weight: Any) -> Any:
    """Focal loss of the heat (Law & Deng 2018, CornerNet) and L1 of offset and log diameter where a centre is."""
    import torch
    from torch.nn import functional

    p = torch.sigmoid(out[:, 0]).clamp(1e-5, 1 - 1e-5)
    positive = (heat >= 1.0).float()
    gain = positive * (1 - p) ** 2 * torch.log(p) + (1 - positive) * (1 - heat) ** 4 * p**2 * torch.log(1 - p)
    count = positive.sum().clamp(min=1.0)
    step = functional.l1_loss(out[:, 1:], values, reduction="none")
    scaled = step * torch.tensor([1.0, 1.0, 3.0])[None, :, None, None] * weight[:, None]
    return -gain.sum() / count + scaled.sum() / weight.sum().clamp(min=1.0)


def train(network: str, samples: int, epochs: int, seed: int, out: Path) -> None:
    """Train, write weights.onnx and training.json into a folder, print a line per epoch."""
    import torch

    torch.manual_seed(seed)
    torch.set_num_threads(1)
    images, truth = drawn_samples(samples, seed)
    held_images, held_truth = drawn_samples(VALIDATION, seed + 1)
    model = make_network(network)
    batch, rng, log = 32, np.random.default_rng(seed), []
    steps = epochs * (samples // batch)
    optimiser = torch.optim.AdamW(model.parameters(), lr=3e-3, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, max_lr=6e-3, total_steps=steps)
    start = time.process_time()
    for epoch in range(epochs):
        model.train()
        total = 0.0
        for rows in np.array_split(rng.permutation(samples)[: samples // batch * batch], samples // batch):
            pictures, wanted = _augmented(images[rows], truth[rows], rng)
            value = loss(model(_tensor(pictures[:, None] / 255.0)), *map(_tensor, targets(wanted)))
            optimiser.zero_grad()
            value.backward()
            optimiser.step()
            schedule.step()
            total += float(value.detach())
        held = _validated(model, held_images, held_truth)
        log.append({"epoch": epoch + 1, "loss": total / (samples // batch), "validation_loss": held})
        print(f"epoch {epoch + 1}: loss {log[-1]['loss']:.4f}, validation {held:.4f}", flush=True)
    out.mkdir(parents=True, exist_ok=True)
    _export(model, out / "weights.onnx")
    record = {
        "network": network,
        "samples": samples,
        "epochs": epochs,
        "seed": seed,
        "parameters": sum(p.numel() for p in model.parameters()),
        "process_s": round(time.process_time() - start),
        "torch": torch.__version__,
        "log": log,
    }
    (out / "training.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def _augmented(images: np.ndarray, truth: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Mirrored and turned by quarters, with another contrast."""
    pictures, wanted = images.astype(np.float32), truth.copy()
    if rng.random() < 0.5:
        pictures, wanted = pictures[:, :, ::-1], wanted * [-1, 1, 1] + [SIZE_PX - 1, 0, 0]
    if rng.random() < 0.5:
        pictures, wanted = pictures.swapaxes(1, 2), wanted[:, [1, 0, 2]]
    gain = rng.uniform(0.5, 1.3, (len(pictures), 1, 1)).astype(np.float32)
    offset = rng.uniform(-25, 40, (len(pictures), 1, 1)).astype(np.float32)
    return np.clip(gain * pictures + offset, 0, 255), wanted


def _tensor(values: np.ndarray) -> Any:
    import torch

    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))


def _validated(model: Any, images: np.ndarray, truth: Array) -> float:
    import torch

    model.eval()
    with torch.no_grad():
        return float(loss(model(_tensor(images[:, None] / 255.0)), *map(_tensor, targets(truth))))


def _export(model: Any, path: Path) -> None:
    """Write the network as ONNX for pictures of any size."""
    import torch

    model.eval()
    axes = {"picture": {2: "height", 3: "width"}, "cells": {2: "rows", 3: "columns"}}
    torch.onnx.export(
        model, (torch.zeros(1, 1, SIZE_PX, SIZE_PX),), str(path), input_names=["picture"], output_names=["cells"],
        dynamic_axes=axes, opset_version=13, dynamo=False,
    )  # fmt: skip


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog="lab.learned_detector.train", description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--network", choices=NETWORKS, default=SMALL)
    parser.add_argument("--samples", type=int, default=8000)
    parser.add_argument("--epochs", type=int, default=12)
    parser.add_argument("--seed", type=int, default=2020)
    a = parser.parse_args()
    try:
        train(a.network, a.samples, a.epochs, a.seed, a.out)
    except ImportError as error:
        remedy = "pip install 'beampose[training]'"
        print(f"beampose: training needs the extra `training`: {remedy} ({error})", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
