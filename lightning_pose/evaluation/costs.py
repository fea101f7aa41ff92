"""Costs of a localizer: training time, file size, parameters, and time per frame."""

from __future__ import annotations

import io
import math
import statistics
import time
from collections.abc import Callable

import torch
from lightning import Trainer
from torch import nn

from lightning_pose.data.datamodule import SceneDataModule, scene_datamodule
from lightning_pose.models.base import PoseModule
from lightning_pose.models.parts.refinement import MapRefinement
from lightning_pose.runs.checkpoints import checkpoint_folder
from lightning_pose.runs.clock import read_train_seconds, wait_for_device

__all__ = ["costs", "count_layers", "measure_weights"]

MOST = 30
"""Frames whose time is measured."""


def costs(
    trainer: Trainer, module: PoseModule, frames: int = 1, split: str = "test", features: bool = True
) -> dict[str, float]:
    """Measure the localizer's costs, features and network apart, as metrics `cost/...`.

    Args:
        trainer: after a test, or after training.
        module: the model.
        frames: how many frames the model reads at a time: 1, or the length of a clip.
        split: whose frames the time is measured on.
        features: extract a few frames again, to measure how long that takes.
    """
    datamodule = scene_datamodule(trainer)
    data = datamodule.dataset(split).data
    held, refinement = data.features, module.refinement
    keypoints = None if refinement is None else refinement.read_keypoints(data.frame[: MOST + 1].tolist())

    def locate(i: int) -> None:
        shown = held[i : i + 1] if frames == 1 else held[i : i + frames].unsqueeze(0)
        module(shown.to(module.device))
        if refinement is not None and keypoints is not None:
            refinement.network.locate(keypoints[i : i + 1])

    keypoint_bytes = 0 if keypoints is None else keypoints[:1].nbytes
    found = {
        "cost/parameters": float(sum(p.numel() for p in module.network.parameters())),
        "cost/carried_numbers": float(sum(tensor.numel() for tensor in module.state_dict().values())),
        "cost/layers": float(count_layers(module.network)),
        "cost/ms_per_frame": _time_median(locate, len(held) - frames + 1) / frames,
        "cost/frame_bytes": float(math.prod(module.reduced_shape) * held.element_size() + keypoint_bytes),
        "cost/weights_bytes": float(measure_weights(module.network)),
    }
    if features:
        found["cost/features_ms_per_frame"] = _time_features(datamodule, split, refinement)
    best = checkpoint_folder(trainer) / "best.ckpt"
    if best.is_file():
        found["cost/checkpoint_bytes"] = float(best.stat().st_size)
    seconds = read_train_seconds(trainer)
    return found | ({"cost/train_seconds": seconds} if seconds else {})


def measure_weights(network: nn.Module) -> int:
    """Bytes of a file with a network's trained weights alone, as the thesis's table 5.1 counts them.

    The checkpoint has more: buffers, such as principal components, and the settings that rebuild the model.
    """
    file = io.BytesIO()
    torch.save({name: parameter.detach() for name, parameter in network.named_parameters()}, file)
    return len(file.getvalue())


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


def _time_features(datamodule: SceneDataModule, split: str, refinement: MapRefinement | None) -> float:
    """Milliseconds to read one frame and extract what the network reads, and what a map beside it reads."""
    extractors, scene = [datamodule.extractor], datamodule.scene
    if refinement is not None and not refinement.extractor.shares_records(datamodule.extractor):
        extractors.append(refinement.extractor)
    files = [scene.frames[i].image for i in scene.splits[split][:10]]
    return _time_median(lambda i: [each.extract([each.read(files[i])]) for each in extractors], len(files))


def _time_median(work: Callable[[int], object], count: int, most: int = MOST) -> float:
    """Median milliseconds of a call with 0, 1, ..., after one that warms up."""
    times = []
    with torch.inference_mode():
        work(0)
        for i in range(min(count, most)):
            wait_for_device()
            start = time.perf_counter()
            work(i)
            wait_for_device()
            times.append((time.perf_counter() - start) * 1e3)
    return statistics.median(times)
