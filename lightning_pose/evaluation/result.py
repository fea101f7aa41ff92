"""An evaluation: everything that a test says beside the model's own metrics."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from lightning import LightningModule, Trainer
from matplotlib.figure import Figure
from torch import nn

from lightning_pose.models.base import Pose
from lightning_pose.runs.recorder import checkpoint_folder, train_seconds
from lightning_pose.scenes.scene import Frame

__all__ = ["Evaluation", "costs", "count_layers", "skill"]


@dataclass
class Evaluation:
    """What a test found.

    Attributes:
        baselines: name to metrics, beside which the model stands.
        extras: further metrics by their whole name.
        curves: metrics over a whole number (a clip's length): name to {number: value}.
        trajectories: `truth` and `predictions` to frames with their poses, for TUM files.
        figures: by file name.
    """

    baselines: Mapping[str, Mapping[str, float]]
    extras: dict[str, float]
    trajectories: Mapping[str, tuple[list[Frame], Pose]]
    figures: Mapping[str, Figure]
    curves: Mapping[str, Mapping[int, float]] = field(default_factory=dict)


def skill(model: Mapping[str, float], baseline: Mapping[str, float]) -> dict[str, float]:
    """Model error over a baseline's: below 1, learning helped."""
    pairs = {"test/skill_position": "position_median_m", "test/skill_orientation": "orientation_median_deg"}
    return {
        name: model[metric] / baseline[metric] if baseline[metric] else float("inf") for name, metric in pairs.items()
    }


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
