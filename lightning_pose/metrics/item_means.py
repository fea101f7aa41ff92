"""Means over the items of a split, collected batch by batch and over processes, each item once."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor
from torchmetrics import Metric

__all__ = ["ItemMeans", "key_items", "key_poses", "select_unique"]

_FRAMES = 2**31  # more than a scene has


def key_items(frame: Tensor) -> Tensor:
    """One number for each item of a batch: of the frame (B,), or of the first and last frame of a clip (B, T)."""
    ends = frame if frame.ndim == 1 else frame[:, -1]
    return (frame if frame.ndim == 1 else frame[:, 0]) * _FRAMES + ends


def key_poses(frame: Tensor) -> Tensor:
    """One number for each pose of a batch, (B,) or (B, T): of the frame, and of the clip's first frame."""
    return (frame if frame.ndim == 1 else frame[:, :1]) * _FRAMES + frame


def select_unique(keys: Tensor) -> Tensor:
    """Rows (M,) of the first occurrence of each key (N,); all rows whose key is negative.

    Several processes share out a split in equal parts, for which a sampler repeats some items.
    """
    order = keys.argsort(stable=True)
    ordered = keys[order]
    first = torch.ones_like(ordered, dtype=torch.bool)
    first[1:] = (ordered[1:] != ordered[:-1]) | (ordered[1:] < 0)
    return order[first].sort().values


class ItemMeans(Metric):
    """Mean of each term over all items added; items that several processes added count once."""

    is_differentiable = False
    higher_is_better = None
    full_state_update = False

    keys: list[Tensor]
    values: list[Tensor]

    def __init__(self) -> None:
        super().__init__()
        self.add_state("keys", default=[], dist_reduce_fx="cat")
        self.add_state("values", default=[], dist_reduce_fx="cat")
        self._names: tuple[str, ...] = ()

    def update(self, terms: Mapping[str, Tensor], keys: Tensor) -> None:
        """Add a batch.

        Args:
            terms: name to (B,), the same names in every batch.
            keys: (B,) as `key_items` returns them.
        """
        self._names = tuple(terms)
        self.keys.append(keys)
        self.values.append(torch.stack([term.detach().float() for term in terms.values()], dim=1))

    def compute(self) -> dict[str, float]:
        """The means by name; none if no item was added."""
        if isinstance(self.keys, Tensor):  # gathered from several processes
            values = self.values[select_unique(self.keys)]
        else:
            values = torch.cat([torch.empty(0, len(self._names)), *(value.cpu() for value in self.values)])
        return dict(zip(self._names, values.double().mean(0).tolist(), strict=True))
