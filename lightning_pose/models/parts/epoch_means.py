"""EpochMeans: means of the terms of the training loss over the items of an epoch."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

__all__ = ["EpochMeans"]


class EpochMeans:
    """Sums terms over batches on their device, as Lightning's `log` does at a hundred times the cost a batch."""

    def __init__(self) -> None:
        self._sums: dict[str, Tensor] = {}
        self._count = 0

    def add(self, terms: Mapping[str, Tensor], count: int) -> None:
        """Add a batch.

        Args:
            terms: name to the mean over the batch, the same names in every batch.
            count: items of the batch.
        """
        for name, value in terms.items():
            wide = value.detach() if value.dtype in (torch.float32, torch.float64) else value.detach().float()
            weighted = wide * count
            self._sums[name] = self._sums[name] + weighted if self._count else weighted
        self._count += count

    def take(self) -> dict[str, Tensor]:
        """The means over all items that were added, none if none were; they are forgotten."""
        sums, count = self._sums, self._count
        self._sums, self._count = {}, 0
        return {name: value / count for name, value in sums.items()}
