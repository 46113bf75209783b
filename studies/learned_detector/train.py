"""`python -m studies.learned_detector.train --out DIR`: trains the learned detector and exports it.

Needs the extra `training` (torch, onnx). docs/papers/zhou2020_detector.md has the command that made the weights of the
package, and their figures. The same seed gives the same samples; sums in another order change the weights in their last
digits on another machine. A run that was interrupted continues from the files of its folder, and one that has ended
goes on with more epochs.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geometry.arrays import Array
from studies.learned_detector.samples import SIZE_PX, augmented, middle, rendered

STRIDE = 4
SMALL, PAPER = "small", "zhou2020"
NETWORKS = (SMALL, PAPER)


def make_network(name: str) -> Any:
    """A torch.nn.Module: grey pictures (n, 1, h, w) of 0 to 1 -> (n, 4, h / STRIDE, w / STRIDE).

    Raises ImportError: torch is not installed; ValueError: there is no network of that name.
    """
    if name == SMALL:
        return _small()
    if name == PAPER:
        return _zhou2020()
    raise ValueError(f"expected one of {', '.join(NETWORKS)}, got {name!r}")


def _layer(before: int, after: int, stride: int = 1) -> Any:
    from torch import nn

    return nn.Sequential(nn.Conv2d(before, after, 3, stride, 1, bias=False), nn.BatchNorm2d(after), nn.ReLU())


def _small() -> Any:
    """Some 177,000 parameters: layers at 1/2 and 1/4 of the picture; five at 1/8, whose output is enlarged and added.

    A cell sees 47 px on each side. The sides of the picture are multiples of 8. Source: ours, after Ronneberger
    (2015), U-Net.
    """
    from torch import nn
    from torch.nn import functional

    class Small(nn.Module):  # type: ignore[misc]  # no types without torch, an extra
        def __init__(self) -> None:
            super().__init__()
            self.fine = nn.Sequential(_layer(1, 12, 2), _layer(12, 24, 2), _layer(24, 24))
            self.deep = nn.Sequential(_layer(24, 64, 2), *[_layer(64, 64) for _ in range(4)])
            self.lateral = nn.Conv2d(64, 24, 1)
            self.head = nn.Sequential(_layer(24, 24), nn.Conv2d(24, 4, 1))
            # Few cells hold a centre: start from a low probability.
            nn.init.constant_(self.head[-1].bias, 0.0)
            self.head[-1].bias.data[0] = -5.0

        def forward(self, x: Any) -> Any:
            fine = self.fine(x)
            coarse = functional.interpolate(self.lateral(self.deep(fine)), scale_factor=2, mode="nearest")
            return self.head(functional.relu(fine + coarse))

    return Small()


def _zhou2020() -> Any:
    """The layout of Zhou (2020), table 1: residual blocks of 1x1 and 3x3 layers, 1, 2, 8, 8 and 4 of them.

    The paper predicts boxes at three scales; here the features of the coarser scales are enlarged and added to those
    of STRIDE, and the head is the one of the small network, so that both are trained and used in the same way.
    """
    from torch import nn
    from torch.nn import functional

    def layer(before: int, after: int, size: int, stride: int = 1) -> Any:
        return nn.Sequential(
            nn.Conv2d(before, after, size, stride, size // 2, bias=False), nn.BatchNorm2d(after), nn.LeakyReLU(0.1)
        )

    class Residual(nn.Module):  # type: ignore[misc]  # no types without torch, an extra
        def __init__(self, channels: int) -> None:
            super().__init__()
            self.body = nn.Sequential(layer(channels, channels // 2, 1), layer(channels // 2, channels, 3))

        def forward(self, x: Any) -> Any:
            return x + self.body(x)

    class Zhou2020(nn.Module):  # type: ignore[misc]  # no types without torch, an extra
        def __init__(self) -> None:
            super().__init__()
            self.first = layer(1, 16, 3)
            self.stages, self.lateral, channels = nn.ModuleList(), nn.ModuleList(), 16
            for blocks, out in ((1, 32), (2, 64), (8, 128), (8, 256), (4, 512)):
                residuals = [Residual(out) for _ in range(blocks)]
                self.stages.append(nn.Sequential(layer(channels, out, 3, 2), *residuals))
                channels = out
                if out >= 64:
                    self.lateral.append(nn.Conv2d(out, 64, 1))
            self.head = nn.Sequential(layer(64, 64, 3), nn.Conv2d(64, 4, 1))

        def forward(self, x: Any) -> Any:
            x, scales = self.first(x), []
            for number, stage in enumerate(self.stages):
                x = stage(x)
                if number >= 1:
                    scales.append(self.lateral[number - 1](x))
            out = scales.pop()
            while scales:
                finer = scales.pop()
                out = finer + functional.interpolate(out, size=finer.shape[-2:], mode="nearest")
            return self.head(out)

    return Zhou2020()


# The training loop of the learned detector: AdamW, one cycle of the learning rate, mean weights, checkpoints.
#
# Needs torch.


BatchLoss = Callable[[Any, np.random.Generator], Any]  # (model, rng) -> loss of a new batch
_KEPT, _FORGOTTEN_STEPS = 0.998, 40.0  # largest share of the mean weights that a step keeps; see `_kept`


@dataclass(frozen=True, slots=True)
class Plan:
    """What a training run is; a checkpoint belongs to one plan."""

    network: str
    samples: int
    epochs: int
    seed: int
    steps: int  # of an epoch
    rate: float = 4e-3  # largest learning rate
    bf16: bool = False  # layers in bfloat16: three times as fast where the processor has it


def fit(model: Any, batch_loss: BatchLoss, validate: Callable[[Any], float], plan: Plan, out: Path) -> Any:
    """Train a model and return its mean over the last steps; writes training.json, continues from out/checkpoint.pt.

    validate: loss of a model on the validation samples.
    """
    import torch
    from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

    torch.manual_seed(plan.seed)
    torch.set_num_threads(1)
    model = model.to(memory_format=torch.channels_last)
    mean = AveragedModel(model, multi_avg_fn=get_ema_multi_avg_fn(_kept(plan.epochs * plan.steps)), use_buffers=True)
    optimiser = torch.optim.AdamW(model.parameters(), lr=plan.rate, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, max_lr=plan.rate, total_steps=plan.epochs * plan.steps, pct_start=0.1
    )
    parts = {"model": model, "mean": mean, "optimiser": optimiser, "schedule": schedule}
    log, spent = _continued(parts, plan, out)
    for epoch in range(len(log), plan.epochs):
        rng, start, total = np.random.default_rng([plan.seed, epoch]), time.process_time(), 0.0
        model.train()
        for _ in range(plan.steps):
            with torch.autocast("cpu", torch.bfloat16, enabled=plan.bf16):
                value = batch_loss(model, rng)
            optimiser.zero_grad()
            value.backward()
            torch.nn.utils.clip_grad_norm_(model.parameters(), 5.0)
            optimiser.step()
            schedule.step()
            mean.update_parameters(model)
            total += float(value.detach())
        mean.eval()
        with torch.no_grad():
            held = validate(mean.module)
        spent += time.process_time() - start
        log.append({"epoch": epoch + 1, "loss": round(total / plan.steps, 5), "validation_loss": round(held, 5)})
        print(f"epoch {epoch + 1}: loss {total / plan.steps:.4f}, validation {held:.4f}, {spent:.0f} s", flush=True)
        _keep(parts, plan, out, log, spent)
    mean.eval()
    return mean.module


def _kept(steps: int) -> float:
    """Share of the mean weights that a step keeps: in a short run fewer steps, so that the first ones are forgotten."""
    return float(np.clip(1 - _FORGOTTEN_STEPS / steps, 0.5, _KEPT))


def _keep(parts: dict[str, Any], plan: Plan, out: Path, log: list[dict[str, float]], spent: float) -> None:
    import torch

    state = {name: part.state_dict() for name, part in parts.items()}
    new = out / "checkpoint.new"
    torch.save({**state, "plan": asdict(plan), "log": log, "spent": spent}, new)
    new.replace(out / "checkpoint.pt")
    parameters = sum(p.numel() for p in parts["model"].parameters())
    record = {
        **asdict(plan),
        "parameters": parameters,
        "process_s": round(spent),
        "torch": torch.__version__,
        "log": log,
    }
    (out / "training.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def _continued(parts: dict[str, Any], plan: Plan, out: Path) -> tuple[list[dict[str, float]], float]:
    """Log and process time of the checkpoint of the same plan, whose state is loaded; without one, nothing and 0.

    A plan with more epochs prolongs a run: its learning rate goes on where it would be after as many epochs.
    """
    import torch

    path = out / "checkpoint.pt"
    out.mkdir(parents=True, exist_ok=True)
    if not path.is_file():
        return [], 0.0
    kept = torch.load(path, weights_only=True)
    if {**kept["plan"], "epochs": plan.epochs} != asdict(plan):
        return [], 0.0
    kept["schedule"] = {name: kept["schedule"][name] for name in ("last_epoch", "_step_count")}
    for name, part in parts.items():
        part.load_state_dict(kept[name])
    return list(kept["log"]), float(kept["spent"])


def export(model: Any, picture: Any, path: Path, names: tuple[str, str], axes: dict[str, dict[int, str]]) -> None:
    """Write a network as ONNX. picture: an example of its input; axes: those of any length."""
    import torch

    model = model.to(memory_format=torch.contiguous_format).eval()
    torch.onnx.export(
        model, (picture,), str(path), input_names=[names[0]], output_names=[names[1]], dynamic_axes=axes,
        opset_version=13, dynamo=False,
    )  # fmt: skip


def tensor(values: np.ndarray) -> Any:
    """A tensor of 32-bit floats."""
    import torch

    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))


BATCH = 32
VALIDATION = 1000  # samples
HARDNESS = (0.4, 4.0)  # range of the relative frequencies of samples


def targets(truth: Array) -> tuple[Array, Array, Array]:
    """Heat (n, s, s), regression (n, 3, s, s) and its weight (n, s, s) for truths (n, k, 3); s = SIZE_PX / STRIDE."""
    side = SIZE_PX // STRIDE
    centres = STRIDE * np.arange(side) + (STRIDE - 1) / 2
    heat, values = np.zeros((len(truth), side, side)), np.zeros((len(truth), 3, side, side))
    for own in np.moveaxis(truth.reshape(len(truth), -1, 3), 1, 0):
        u, v, diameter = (own[:, i, None, None] for i in range(3))
        du, dv = u - centres[None, None, :], v - centres[None, :, None]
        sigma = np.maximum(0.08 * diameter, 1.6)
        near = np.nan_to_num(np.exp(-0.5 * (du**2 + dv**2) / sigma**2))
        # The cell that holds the centre is a full positive.
        near = np.where((np.abs(du) <= STRIDE / 2) & (np.abs(dv) <= STRIDE / 2), 1.0, near)
        answer = np.stack([du / STRIDE + 0 * dv, dv / STRIDE + 0 * du, np.log(diameter) + 0 * near], axis=1)
        values = np.where((near > heat)[:, None], answer, values)
        heat = np.maximum(heat, near)
    return heat, values, (heat > 0.3).astype(float)


def loss(out: Any, heat: Any, values: Any, weight: Any) -> tuple[Any, Any]:
    """Focal loss of the heat (Law & Deng 2018, CornerNet) and L1 of offset and log diameter where a centre is.

    Also the part (n,) of each sample in the former.
    """
    import torch
    from torch.nn import functional

    out = out.float()
    p = torch.sigmoid(out[:, 0]).clamp(1e-5, 1 - 1e-5)
    positive = (heat >= 1.0).float()
    gain = positive * (1 - p) ** 2 * torch.log(p) + (1 - positive) * (1 - heat) ** 4 * p**2 * torch.log(1 - p)
    count = positive.sum().clamp(min=1.0)
    step = functional.l1_loss(out[:, 1:], values, reduction="none")
    scaled = step * torch.tensor([1.0, 1.0, 3.0])[None, :, None, None] * weight[:, None]
    return -gain.sum() / count + scaled.sum() / weight.sum().clamp(min=1.0), -gain.detach().sum(dim=(1, 2))


def train(plan: Plan, out: Path) -> None:
    """Train, write weights.onnx and training.json into a folder, print a line per epoch."""
    import torch

    images, truth = rendered(plan.samples, plan.seed, out / "samples")
    held_images, held_truth = middle(*rendered(VALIDATION, plan.seed + 1, out / "samples"))
    held_targets = [tensor(t) for t in targets(held_truth)]
    hardness = np.ones(len(images))  # hard samples are drawn more often (Shrivastava 2016); 1 after an interruption

    def batch_loss(model: Any, rng: np.random.Generator) -> Any:
        rows = rng.choice(len(images), BATCH, p=hardness / hardness.sum())
        pictures, wanted = augmented(images[rows], truth[rows], rng)
        shown = tensor(pictures[:, None]).to(memory_format=torch.channels_last)
        value, parts = loss(model(shown), *map(tensor, targets(wanted)))
        share = parts.numpy() / max(float(parts.mean()), 1e-9)
        hardness[rows] = (0.5 * hardness[rows] + 0.5 * share).clip(*HARDNESS)
        return value

    def validate(model: Any) -> float:
        return float(loss(model(tensor(held_images[:, None])), *held_targets)[0])

    torch.manual_seed(plan.seed)
    model = fit(make_network(plan.network), batch_loss, validate, plan, out)
    axes = {"picture": {2: "height", 3: "width"}, "cells": {2: "rows", 3: "columns"}}
    export(model, torch.zeros(1, 1, SIZE_PX, SIZE_PX), out / "weights.onnx", ("picture", "cells"), axes)


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog="studies.learned_detector.train", description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--network", choices=NETWORKS, default=SMALL)
    parser.add_argument("--samples", type=int, default=12000)
    parser.add_argument("--epochs", type=int, default=20)
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
