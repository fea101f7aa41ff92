"""Poses of a split from the batches of all processes, each frame once."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import distributed

from lightning_pose.models.parts.poses import Located

__all__ = ["gather_poses"]


def gather_poses(batches: Sequence[Located]) -> Located:
    """Join the batches of all processes, in the order of frames; every process calls it, and gets the same.

    Args:
        batches: of this process, on any device.

    Returns:
        Poses of M frames on the CPU: (M,), (M, 3) and (M, 4). What several processes were given, because their
        shares of a split are equal, is in it once.
    """
    own = [Located(*(tensor.detach().cpu() for tensor in batch)) for batch in batches]
    shares = [own]
    if distributed.is_available() and distributed.is_initialized():
        shares = [own] * distributed.get_world_size()
        distributed.all_gather_object(shares, own)
    joined = Located(*(torch.cat(parts) for parts in zip(*(batch for share in shares for batch in share), strict=True)))
    order = joined.frame.argsort(stable=True)
    ordered = joined.frame[order]
    first = torch.ones_like(ordered, dtype=torch.bool)
    first[1:] = ordered[1:] != ordered[:-1]
    return Located(*(tensor[order[first]] for tensor in joined))
