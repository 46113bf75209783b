"""`python -m lab.learned_detector.train --out DIR`: trains the learned detector and exports it.

Needs the extra `training` (torch, onnx). The weights of the package were made by

    python -m lab.learned_detector.train --out build/detector --samples 28000 --epochs 28 --seed 2020 --bf16

and copied to tracking/learned_detector/. The same seed gives the same samples; sums in another order change the weights
in their last digits on another machine. A run that was interrupted continues from the files of its folder.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np

from geometry.arrays import Array
from lab.learned_detector.dataset import SIZE_PX, augmented, middle, rendered
from lab.learned_detector.fitting import Plan, export, fit, tensor
from lab.learned_detector.networks import NETWORKS, SMALL, STRIDE, make_network

BATCH = 32
VALIDATION = 1000  # samples


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
    return heat, values, (heat > 0.3).astype(float)


def loss(out: Any, heat: Any, values: Any, weight: Any) -> Any:
    """Focal loss of the heat (Law & Deng 2018, CornerNet) and L1 of offset and log diameter where a centre is."""
    import torch
    from torch.nn import functional

    out = out.float()
    p = torch.sigmoid(out[:, 0]).clamp(1e-5, 1 - 1e-5)
    positive = (heat >= 1.0).float()
    gain = positive * (1 - p) ** 2 * torch.log(p) + (1 - positive) * (1 - heat) ** 4 * p**2 * torch.log(1 - p)
    count = positive.sum().clamp(min=1.0)
    step = functional.l1_loss(out[:, 1:], values, reduction="none")
    scaled = step * torch.tensor([1.0, 1.0, 3.0])[None, :, None, None] * weight[:, None]
    return -gain.sum() / count + scaled.sum() / weight.sum().clamp(min=1.0)


def train(plan: Plan, out: Path) -> None:
    """Train, write weights.onnx and training.json into a folder, print a line per epoch."""
    import torch

    images, truth = rendered(plan.samples, plan.seed, out / "samples")
    held_images, held_truth = middle(*rendered(VALIDATION, plan.seed + 1, out / "samples"))
    held_targets = [tensor(t) for t in targets(held_truth)]

    def batch_loss(model: Any, rng: np.random.Generator) -> Any:
        rows = rng.integers(0, len(images), BATCH)
        pictures, wanted = augmented(images[rows], truth[rows], rng)
        shown = tensor(pictures[:, None]).to(memory_format=torch.channels_last)
        return loss(model(shown), *map(tensor, targets(wanted)))

    def validate(model: Any) -> float:
        return float(loss(model(tensor(held_images[:, None])), *held_targets))

    torch.manual_seed(plan.seed)
    model = fit(make_network(plan.network), batch_loss, validate, plan, out)
    axes = {"picture": {2: "height", 3: "width"}, "cells": {2: "rows", 3: "columns"}}
    export(model, torch.zeros(1, 1, SIZE_PX, SIZE_PX), out / "weights.onnx", ("picture", "cells"), axes)


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog="lab.learned_detector.train", description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--network", choices=NETWORKS, default=SMALL)
    parser.add_argument("--samples", type=int, default=28000)
    parser.add_argument("--epochs", type=int, default=28)
    parser.add_argument("--seed", type=int, default=2020)
    parser.add_argument("--bf16", action="store_true", help="layers in bfloat16, for processors that have it")
    a = parser.parse_args()
    steps = max(a.samples // BATCH, 1)
    try:
        train(Plan(a.network, a.samples, a.epochs, a.seed, steps, bf16=a.bf16), a.out)
    except ImportError as error:
        remedy = "pip install 'beampose[training]'"
        print(f"beampose: training needs the extra `training`: {remedy} ({error})", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
