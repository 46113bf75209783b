"""The training loop of the learned detector: AdamW, one cycle of the learning rate, mean weights, checkpoints.

Needs torch.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

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
    """Write the checkpoint and the log."""
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
    """Log and process time of the checkpoint of the same plan, whose state is loaded; without one, nothing and 0."""
    import torch

    path = out / "checkpoint.pt"
    out.mkdir(parents=True, exist_ok=True)
    if not path.is_file():
        return [], 0.0
    kept = torch.load(path, weights_only=True)
    if kept["plan"] != asdict(plan):
        return [], 0.0
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
