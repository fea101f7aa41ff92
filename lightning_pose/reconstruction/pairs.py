"""Chooses the pairs of frames to match: neighbours in time, and frames that look alike."""

from __future__ import annotations

import numpy as np

from lightning_pose.reconstruction.keypoints import scale_descriptors

__all__ = ["choose_pairs", "describe_frames"]

NEIGHBOURS = (1, 2, 3, 4, 6, 8, 12)
"""Distances in the order of frames."""

ALIKE = 6
"""How many frames that look most alike each frame is matched to, beside its neighbours."""

ALL_PAIRS = 40
"""Up to so many frames each is matched to all others."""

SAMPLE = 300
"""Descriptors of a frame that tell whether frames look alike; they are spread over its scales."""


def describe_frames(descriptors: list[np.ndarray]) -> np.ndarray:
    """Vectors that are near for frames that look alike: VLAD of descriptors.

    Args:
        descriptors: of N frames, (M, 128) uint8 each.

    Returns:
        (N, D) float32 of unit length; (N, 0) for so few frames that all are matched to all.
    """
    if len(descriptors) <= ALL_PAIRS:
        return np.zeros((len(descriptors), 0), np.float32)
    from lightning_pose.features.retrieval import compute_global_vectors  # torch, which takes seconds to import

    rows = np.zeros((len(descriptors), SAMPLE, 128), np.float32)
    for i, each in enumerate(descriptors):
        chosen = np.linspace(0, len(each) - 1, min(SAMPLE, len(each))).astype(int)
        rows[i, : len(chosen)] = scale_descriptors(each[chosen])
    return compute_global_vectors(rows, rows[:1])[0].numpy()


def choose_pairs(vectors: np.ndarray, alike: int = ALIKE) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, in ascending order.

    Args:
        vectors: (N, D), of `describe_frames`.
        alike: how many frames that look alike each frame is matched to, beyond its neighbours.
    """
    n = len(vectors)
    if n <= ALL_PAIRS:
        return [(i, j) for i in range(n) for j in range(i + 1, n)]
    pairs = {(i, i + step) for step in NEIGHBOURS for i in range(n - step)}
    for i in range(n):
        likeness = vectors @ vectors[i]
        likeness[max(i - max(NEIGHBOURS), 0) : i + max(NEIGHBOURS) + 1] = -np.inf
        nearest = np.argsort(-likeness, kind="stable")[:alike]
        pairs |= {(min(i, j), max(i, j)) for j in nearest.tolist() if np.isfinite(likeness[j])}
    return sorted(pairs)
