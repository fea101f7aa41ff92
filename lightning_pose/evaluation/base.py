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

from lightning_pose.callbacks import checkpoint_folder, train_seconds
from lightning_pose.data.scene import Frame
from lightning_pose.models.base import Pose

__all__ = ["Evaluation", "costs", "skill"]


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


def costs(trainer: Trainer, module: LightningModule, frames: int = 1) -> dict[str, float]:
    """What the localizer costs: to train, to keep, and per frame, features and network apart.

    Args:
        trainer: after a test.
        module: the model.
        frames: how many frames the model is shown at a time.
    """
    datamodule = trainer.datamodule  # type: ignore[attr-defined]
    features = datamodule.dataset("test").data.features

    def locate(i: int) -> None:
        shown = features[i : i + 1] if frames == 1 else features[i : i + frames].unsqueeze(0)
        module(shown.to(module.device))

    found = {
        "cost/parameters": float(sum(p.numel() for p in module.network.parameters())),  # type: ignore[union-attr]
        "cost/ms_per_frame": _milliseconds(locate, len(features) - frames + 1) / frames,
        "cost/features_ms_per_frame": _features_milliseconds(datamodule),
        "cost/frame_bytes": float(features[0].numel() * features.element_size()),
    }
    best = checkpoint_folder(trainer) / "best.ckpt"
    if best.is_file():
        found["cost/checkpoint_bytes"] = float(best.stat().st_size)
    seconds = train_seconds(trainer)
    return found | ({"cost/train_seconds": seconds} if seconds else {})


def _features_milliseconds(datamodule: Any) -> float:
    extractor, scene = datamodule.extractor, datamodule.scene
    files = [scene.frames[i].image for i in scene.splits["test"][:10]]
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
