"""What models are fed: batches of features and poses, cut by index from tensors that live in memory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from torch import Tensor
from torch.utils.data import DataLoader, Dataset

__all__ = ["PoseBatch", "PoseDataset", "batch_loader"]


class PoseBatch(NamedTuple):
    """Features and poses of B frames.

    Attributes:
        features: (B, ...) float32, as the extractor shapes them.
        position_m: (B, 3) float32, camera centre in the world.
        quat_wxyz: (B, 4) float32, unit, camera-to-world.
        frame: (B,) int64, index of each frame in `Scene.frames`.
    """

    features: Tensor
    position_m: Tensor
    quat_wxyz: Tensor
    frame: Tensor


class PoseDataset(Dataset[PoseBatch]):
    """One split in memory. Indexing by a list gives the whole batch in one gather, without collating."""

    def __init__(self, data: PoseBatch) -> None:
        self.data = data

    def __len__(self) -> int:
        return len(self.data.frame)

    def __getitem__(self, index: int) -> PoseBatch:
        return PoseBatch(*(tensor[index] for tensor in self.data))

    def __getitems__(self, indices: Sequence[int]) -> PoseBatch:
        return PoseBatch(*(tensor[list(indices)] for tensor in self.data))


def _as_is(batch: Any) -> PoseBatch:
    return batch


def batch_loader(dataset: PoseDataset, batch_size: int, shuffle: bool) -> DataLoader[PoseBatch]:
    """A DataLoader whose batches come from `__getitems__`; Lightning can still shard it over processes."""
    return DataLoader(dataset, batch_size=batch_size, shuffle=shuffle, collate_fn=_as_is)
