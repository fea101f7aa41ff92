"""Rows in double precision, chunk by chunk: a whole copy would take longer to allocate than to compute with."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

__all__ = ["find_mean", "split_rows"]

CHUNK = 64
"""Rows of some thousand numbers that fit a processor's cache."""


def split_rows(x: Tensor) -> Iterator[tuple[slice, Tensor]]:
    """Rows (N, D) as at most 64 at a time: which, and (K, D) float64 in the memory of those before; all on a GPU."""
    rows = CHUNK if x.is_cpu else max(len(x), 1)
    buffer = x.new_empty(min(rows, len(x)), x.shape[1], dtype=torch.float64)
    for first in range(0, len(x), rows):
        part = x[first : first + rows]
        yield slice(first, first + len(part)), buffer[: len(part)].copy_(part)


def find_mean(x: Tensor) -> Tensor:
    """Mean (D,) of rows (N, D), in float64."""
    total = x.new_zeros(x.shape[1], dtype=torch.float64)
    for _, part in split_rows(x):
        total += part.sum(0)
    return total / len(x)
