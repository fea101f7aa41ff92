"""What a localizer costs: to train, to keep, and for each frame."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import torch
from lightning import LightningModule, Trainer
from torch import nn

from lightning_pose.runs.checkpoints import checkpoint_folder
from lightning_pose.runs.recorder import train_seconds

__all__ = ["costs", "count_layers"]


def costs(
    trainer: Trainer, module: LightningModule, frames: int = 1, split: str = "test", features: bool = True
) -> dict[str, float]:
    """What the localizer costs: to train, to keep, and per frame, features and network apart.

    Args:
        trainer: after a test, or after training.
        module: the model.
        frames: how many frames the model is shown at a time.
        split: whose frames the time is measured on.
        features: extract a few frames again, to know how long that takes.
    """
    datamodule = trainer.datamodule  # type: ignore[attr-defined]
    held = datamodule.dataset(split).data.features

    def locate(i: int) -> None:
        shown = held[i : i + 1] if frames == 1 else held[i : i + frames].unsqueeze(0)
        module(shown.to(module.device))

    found = {
        "cost/parameters": float(sum(p.numel() for p in module.network.parameters())),  # type: ignore[union-attr]
        "cost/layers": float(count_layers(module.network)),  # type: ignore[arg-type]
        "cost/ms_per_frame": _milliseconds(locate, len(held) - frames + 1) / frames,
        "cost/frame_bytes": float(held[0].numel() * held.element_size()),
    }
    if features:
        found["cost/features_ms_per_frame"] = _features_milliseconds(datamodule, split)
    best = checkpoint_folder(trainer) / "best.ckpt"
    if best.is_file():
        found["cost/checkpoint_bytes"] = float(best.stat().st_size)
    seconds = train_seconds(trainer)
    return found | ({"cost/train_seconds": seconds} if seconds else {})


def count_layers(module: nn.Module) -> int:
    """Layers with weights, as the thesis counts them: normalisation is none, a graph convolution is one, and a
    recurrent network of two layers is two, in one direction or both.
    """
    if isinstance(module, nn.RNNBase):
        return module.num_layers
    if hasattr(module, "propagate"):  # a graph convolution, which has linear maps inside
        return 1
    own = any(parameter.ndim > 1 for parameter in module.parameters(recurse=False))
    return own + sum(count_layers(child) for child in module.children())


def _features_milliseconds(datamodule: Any, split: str) -> float:
    extractor, scene = datamodule.extractor, datamodule.scene
    files = [scene.frames[i].image for i in scene.splits[split][:10]]
    return _milliseconds(lambda i: extractor.extract([extractor.read(files[i])]), len(files))


def _milliseconds(work: Callable[[int], Any], count: int, most: int = 30) -> float:
    """Median time of one call, after one that warms up."""
    times = []
    with torch.inference_mode():
        work(0)
        for i in range(min(count, most)):
            start = time.perf_counter()
            work(i)
            times.append((time.perf_counter() - start) * 1e3)
    return statistics.median(times)
