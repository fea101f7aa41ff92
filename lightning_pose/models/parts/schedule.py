"""The learning rate over a run, as a factor of its highest value."""

from __future__ import annotations

import math

__all__ = ["cosine_factor"]


def cosine_factor(step: int, steps: int) -> float:
    """The factor at a step: a linear warm-up over the first 5 % of the steps, then half a cosine down to zero.

    Args:
        step: counted from 0.
        steps: of the whole run.
    """
    warmup = max(1, steps // 20)
    if step < warmup:
        return (step + 1) / warmup
    return 0.5 * (1 + math.cos(math.pi * (step - warmup) / max(1, steps - warmup)))
