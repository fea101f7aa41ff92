"""Matches the descriptors of two images."""

from __future__ import annotations

import numpy as np

__all__ = ["match_descriptors"]

RATIO = 0.8
"""Lowe's ratio (IJCV 2004): the best match's distance must be below this times that of the second best."""


def match_descriptors(
    descriptors_a: np.ndarray, descriptors_b: np.ndarray, ratio: float = RATIO
) -> tuple[np.ndarray, np.ndarray]:
    """Find pairs of descriptors that are each other's nearest, and clearly nearer than the second nearest in b.

    Args:
        descriptors_a: (N, D) float32, L2-normalised; N at least 1.
        descriptors_b: (M, D) float32, L2-normalised; M at least 2.
        ratio: the distance of a match is below this times that of the second nearest.

    Returns:
        rows of a (K,) and of b (K,), pair by pair, int64, in ascending order of the rows of a.
    """
    squared = 2 - 2 * (descriptors_a @ descriptors_b.T)
    rows, nearest = np.arange(len(squared)), squared.argmin(axis=1)
    mutual = squared.argmin(axis=0)[nearest] == rows
    best = squared[rows, nearest]
    squared[rows, nearest] = np.inf
    keep = mutual & (best < ratio**2 * squared.min(axis=1))
    return rows[keep], nearest[keep]
