"""Batches of features and poses, cut by index from tensors in memory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

__all__ = ["DrawnDataset", "PoseBatch", "PoseDataset", "make_loader"]


class PoseBatch(NamedTuple):
    """Features and poses of B frames, or of B clips of T frames, with one axis more.

    Attributes:
        features: (B, ...) as the extractor shapes them; float32, or uint8 for images.
        position_m: (B, 3) float64, camera centre in the world.
        quat_wxyz: (B, 4) float32, unit, camera-to-world.
        frame: (B,) int64, index of each frame in `Scene.frames`.
    """

    features: Tensor
    position_m: Tensor
    quat_wxyz: Tensor
    frame: Tensor


class PoseDataset(Dataset[PoseBatch]):
    """One split in memory. A list of indices returns a whole batch in one gather, without collating.

    Attributes:
        data: the split frame by frame, whatever its items are: features (M, ...) and poses in the world.
    """

    def __init__(self, data: PoseBatch) -> None:
        self.data = data

    def __len__(self) -> int:
        return len(self.data.frame)

    def __getitem__(self, index: int) -> PoseBatch:
        return PoseBatch(*(tensor[index] for tensor in self.data))

    def __getitems__(self, indices: Sequence[int]) -> PoseBatch:
        return PoseBatch(*(tensor[list(indices)] for tensor in self.data))

    def targets(self) -> tuple[Tensor, Tensor]:
        """Positions and quaternions of all items, as batches have them: (M, 3) and (M, 4) of M frames."""
        return self.data.position_m, self.data.quat_wxyz


class DrawnDataset(PoseDataset):
    """One split with more features per frame than a batch has; each access draws some at random, in their order.

    Args:
        data: features (F, M, D), strongest first.
        n_features: how many of the M features a batch has.
    """

    def __init__(self, data: PoseBatch, n_features: int) -> None:
        super().__init__(data)
        self.n_features = n_features

    def __getitem__(self, index: int) -> PoseBatch:
        return PoseBatch(*(tensor[0] for tensor in self.__getitems__([index])))

    def __getitems__(self, indices: Sequence[int]) -> PoseBatch:
        batch = super().__getitems__(indices)
        frames, pool, _ = batch.features.shape
        drawn = torch.rand(frames, pool).argsort(dim=1)[:, : self.n_features].sort(dim=1).values
        return batch._replace(features=batch.features[torch.arange(frames)[:, None], drawn])


def _keep_batch(batch: Any) -> PoseBatch:
    """Collate nothing: `__getitems__` has returned a whole batch."""
    return batch


def make_loader(dataset: Dataset[PoseBatch], batch_size: int, shuffle: bool) -> DataLoader[PoseBatch]:
    """A DataLoader whose batches come from `__getitems__`; Lightning can still shard it over processes."""
    return DataLoader(dataset, batch_size=batch_size, shuffle=shuffle, collate_fn=_keep_batch)
