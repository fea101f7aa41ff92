"""The data module for single images: Scene -> cached features -> batches."""

from __future__ import annotations

from copy import copy
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning import LightningDataModule
from torch.utils.data import DataLoader

from lightning_pose.data.batches import DrawnDataset, PoseBatch, PoseDataset, batch_loader
from lightning_pose.data.formats import load_scene
from lightning_pose.data.scene import Scene
from lightning_pose.data.synthetic import RENDERER_VERSION, render_room
from lightning_pose.errors import ConfigError, DataError
from lightning_pose.features import FeatureCache, FeatureExtractor, LocalExtractor
from lightning_pose.features.cache import FillReport
from lightning_pose.folders import cache_folder
from lightning_pose.spec import describe

__all__ = ["ImageDataModule"]


class ImageDataModule(LightningDataModule):
    """Single posed images of one scene, as features.

    Args:
        extractor: what the networks read, such as `lightning_pose.features.SURF`.
        root: the scene's folder; none renders the synthetic room on first use.
        format: name of the dataset format; recognised from the folder if not given.
        val_fraction: part of the training split kept for validation, in whole blocks of the trajectory; 0 for none.
        batch_size: frames in a training batch.
        eval_batch_size: frames in a batch where no gradient is needed.
        feature_pool: in training, draw the features of each frame at random from this many of its strongest, anew
            in every epoch, so that no frame is known by heart; validation and test read the strongest. None never
            draws. For extractors of local features only, and at most the 300 that the cache holds, or N.
        cache_dir: where extracted features are kept; the user's cache folder if not given.
        workers: processes or threads that extract features; every core if not given.
        room_seed: which synthetic room.
        room_frames: how many frames of it.

    Raises:
        ConfigError: a number is out of its range.
        DataError: the scene cannot be read, or a split that is needed is empty.
    """

    def __init__(
        self,
        extractor: FeatureExtractor,
        root: str | None = None,
        format: str | None = None,
        val_fraction: float = 0.1,
        batch_size: int = 64,
        eval_batch_size: int = 256,
        feature_pool: int | None = None,
        cache_dir: str | None = None,
        workers: int | None = None,
        room_seed: int = 0,
        room_frames: int = 300,
    ) -> None:
        super().__init__()
        for name, value in (("batch_size", batch_size), ("eval_batch_size", eval_batch_size)):
            if value < 1:
                raise ConfigError(f"data.{name} is {value}; give 1 or more frames")
        self.extractor = extractor
        self.root = root
        self.format = format
        self.val_fraction = val_fraction
        self.batch_size = batch_size
        self.eval_batch_size = eval_batch_size
        self.feature_pool = feature_pool
        self._pool = None if feature_pool is None else _pooled(extractor, feature_pool)
        self.cache_dir = cache_dir
        self.workers = workers
        self.room_seed = room_seed
        self.room_frames = room_frames
        self.cache = FeatureCache(extractor, cache_dir)
        self._scene: Scene | None = None
        self._datasets: dict[str, PoseDataset] = {}

    @property
    def input_shape(self) -> tuple[int, ...]:
        """Shape of one frame's features; the models are built for it."""
        return self.extractor.feature_shape

    @property
    def scene(self) -> Scene:
        """The scene, read (or rendered) on first use."""
        if self._scene is None:
            root = Path(self.root) if self.root is not None else self._room()
            self._scene = load_scene(root, self.format, self.val_fraction)
        return self._scene

    def _room(self) -> Path:
        folder = cache_folder("rooms") / f"room-{self.room_seed}-{self.room_frames}-v{RENDERER_VERSION}"
        return render_room(folder, self.room_seed, self.room_frames)

    def prepare_data(self) -> None:
        self.fill()

    def fill(self) -> FillReport:
        """Extract what the cache lacks, for every split."""
        return self.cache.fill([frame.image for frame in self.scene.frames], workers=self.workers)

    def dataset(self, split: str) -> PoseDataset:
        """One of `train`, `val`, `test`, its features in memory."""
        if split not in self._datasets:
            self._datasets[split] = PoseDataset(self._read(split, self.cache))
        return self._datasets[split]

    def _read(self, split: str, cache: FeatureCache) -> PoseBatch:
        frames = [self.scene.frames[i] for i in self.scene.splits[split]]
        return PoseBatch(
            features=torch.from_numpy(cache.features([frame.image for frame in frames], workers=self.workers)),
            position_m=_stack([frame.position_m for frame in frames], 3),
            quat_wxyz=_stack([frame.quat_wxyz for frame in frames], 4),
            frame=torch.as_tensor(self.scene.splits[split], dtype=torch.int64),
        )

    def train_dataloader(self) -> DataLoader[PoseBatch]:
        train = self.dataset("train")
        if self._pool is not None:
            pool = self._read("train", FeatureCache(self._pool, self.cache_dir))
            train = DrawnDataset(pool, self.input_shape[0])
        return batch_loader(train, self.batch_size, shuffle=True)

    def val_dataloader(self) -> DataLoader[PoseBatch] | list[Any]:
        if len(self.scene.splits["val"]):
            return self._eval_loader("val")
        if self.trainer is not None and self.trainer.validating:
            raise DataError(f"{self.scene.root} has no validation frames; give data.val_fraction, such as 0.1")
        return []

    def test_dataloader(self) -> DataLoader[PoseBatch]:
        if not len(self.scene.splits["test"]):
            raise DataError(f"{self.scene.root} has no test frames; give it a test split")
        return self._eval_loader("test")

    predict_dataloader = test_dataloader

    def _eval_loader(self, split: str) -> DataLoader[PoseBatch]:
        return batch_loader(self.dataset(split), self.eval_batch_size, shuffle=False)

    def describe(self) -> dict[str, Any]:
        """Plain settings that rebuild this data module; checkpoints carry them."""
        spec = describe(self)
        spec["init_args"]["extractor"] = describe(self.extractor)
        return spec


def _pooled(extractor: FeatureExtractor, feature_pool: int) -> LocalExtractor:
    """The extractor with `feature_pool` features a frame, out of the same cache."""
    if not isinstance(extractor, LocalExtractor):
        raise ConfigError(f"data.feature_pool needs local features, and {extractor.name} has none; leave it out")
    if not extractor.n_features <= feature_pool <= extractor.n_stored:
        raise ConfigError(
            f"data.feature_pool is {feature_pool}; give {extractor.n_features} (n_features) to {extractor.n_stored}"
        )
    pooled = copy(extractor)
    pooled.n_features = feature_pool
    return pooled


def _stack(rows: list[np.ndarray], width: int) -> torch.Tensor:
    return torch.from_numpy(np.asarray(rows, dtype=np.float32).reshape(-1, width))
