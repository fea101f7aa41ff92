"""Made frames for the benchmarks of growth: a camera's walks through a place that grows with the number of frames."""

from __future__ import annotations

import json
import math
import resource
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning import Callback, LightningModule, Trainer
from torch.utils.data import DataLoader

from lightning_pose.checkpoint import Spec
from lightning_pose.data import SceneDataModule
from lightning_pose.data.batches import PoseBatch, PoseDataset, make_loader
from lightning_pose.features.array_files import allocate_rows
from lightning_pose.features.base import FeatureExtractor, Record
from lightning_pose.scenes.scene import Scene

__all__ = ["EpochClock", "MadeFrames", "MadeVectors", "ask_process", "fit_exponent", "peak_rss_gb"]

PER_M2 = 400
"""Frames a square metre, whatever their number."""

WALK = 100
"""Frames of a walk, 2 cm apart."""

CHUNK = 4096


class MadeVectors(FeatureExtractor):
    """The shape of global vectors; it extracts nothing."""

    def __init__(self, width: int) -> None:
        self.width = width

    @property
    def settings(self) -> Mapping[str, int]:
        return {"width": self.width}

    @property
    def feature_shape(self) -> tuple[int, ...]:
        return (self.width,)

    def extract(self, images: Sequence[np.ndarray]) -> list[Record]:
        raise NotImplementedError


class MadeFrames(SceneDataModule):
    """Frames whose features are smooth functions of the pose, with noise; those of training may be on disk.

    Args:
        extractor: has the shape of the features; extracts nothing.
        frames: of training; there are a tenth as many for validation, at most 2000.
        batch_size: of training.
        folder: for features that are too large for memory.
    """

    def __init__(self, extractor: FeatureExtractor, frames: int, batch_size: int, folder: Path) -> None:
        super().__init__(extractor, batch_size, 1024, cache_dir=None, workers=None)
        count = min(2000, max(100, frames // 10))
        self._splits = {"train": self._make(frames, 0, folder), "val": self._make(count, frames, folder)}
        self._splits["test"] = self._splits["val"]

    def _make(self, frames: int, first: int, folder: Path) -> PoseDataset:
        """A split, whose frames are numbered from `first` on; training frames decide how large the place is."""
        rng = np.random.default_rng([first, 0])
        side = math.sqrt((first or frames) / PER_M2)
        walks = -(-frames // WALK)
        yaw = rng.uniform(0, 2 * np.pi, (walks, 1)) + np.cumsum(rng.normal(0, 0.05, (walks, WALK)), 1)
        x, y = (rng.uniform(0, side, (walks, 1)) + np.cumsum(f(yaw) * 0.02, 1) for f in (np.cos, np.sin))
        x, y, yaw = (values.reshape(-1)[:frames] for values in (x, y, yaw))
        seen = np.stack([x, y, np.cos(yaw), np.sin(yaw)], 1)
        shape = self.extractor.feature_shape
        features = allocate_rows((frames, *shape), np.float32, folder)
        mix = np.random.default_rng(1).normal(0, 1, (4, math.prod(shape))) * np.array([[2], [2], [1], [1]])
        phase = np.random.default_rng(2).uniform(0, 2 * np.pi, math.prod(shape))
        for start in range(0, frames, CHUNK):
            rows = np.cos(seen[start : start + CHUNK] @ mix + phase)
            rows += 0.1 * rng.standard_normal(rows.shape, np.float32)
            features[start : start + CHUNK] = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).reshape(-1, *shape)
        position = torch.from_numpy(np.stack([x, y, np.full(frames, 1.5)], 1))
        quat = torch.from_numpy(np.stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)], 1)).float()
        return PoseDataset(PoseBatch(torch.from_numpy(features), position, quat, torch.arange(first, first + frames)))

    def _load_scene(self) -> Scene:
        return Scene("made", Path(), "made", ())

    def prepare_data(self) -> None:
        """There is nothing to extract."""

    def dataset(self, split: str) -> PoseDataset:
        return self._splits[split]

    def train_dataloader(self) -> DataLoader[PoseBatch]:
        return make_loader(self.dataset("train"), self.batch_size, shuffle=True)

    def val_dataloader(self) -> DataLoader[PoseBatch]:
        return self._eval_loader("val")

    def describe(self) -> Spec:
        return {"class_path": "benchmark", "init_args": {}}


class EpochClock(Callback):
    """CPU seconds of each epoch's training steps."""

    def __init__(self) -> None:
        self.seconds: list[float] = []

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._start = time.process_time()

    def on_train_batch_end(self, trainer: Trainer, *args: object) -> None:
        if trainer.is_last_batch:
            self.seconds.append(time.process_time() - self._start)


def peak_rss_gb() -> float:
    """The most memory that this process has had, GiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def fit_exponent(counts: list[int], values: list[float]) -> float:
    """The exponent of values that grow as a power of counts, by least squares of logarithms."""
    return float(np.polyfit(np.log(counts), np.log(values), 1)[0])


def ask_process(module: str, *words: object) -> dict[str, Any]:
    """What `python -m MODULE --one WORDS` prints as JSON, in its last line: a process with its own peak memory."""
    command = [sys.executable, "-m", module, "--one", *map(str, words)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])
