"""Matching of descriptors: known pairs of mutual nearest neighbours, in known order."""

from __future__ import annotations

import math

import numpy as np

from lightning_pose.features.matching import match_descriptors


def on_circle(*degrees: float) -> np.ndarray:
    """(N, 2) unit descriptors at these angles; two are nearer, the smaller the angle between them."""
    radians = np.radians(degrees)
    return np.stack([np.cos(radians), np.sin(radians)], axis=1).astype(np.float32)


def matched(a: np.ndarray, b: np.ndarray, ratio: float = 0.8) -> list[tuple[int, int]]:
    return [(int(i), int(j)) for i, j in zip(*match_descriptors(a, b, ratio), strict=True)]


def test_each_finds_its_own() -> None:
    assert matched(on_circle(0, 90, 200), on_circle(202, 1, 93)) == [(0, 1), (1, 2), (2, 0)]


def test_a_match_is_nearest_from_both_sides() -> None:
    # Both descriptors of a are nearest to b's first, which is nearer to the second of them.
    assert matched(on_circle(0, 8), on_circle(10, 180)) == [(1, 0)]


def test_a_match_is_clearly_nearer_than_the_second_nearest() -> None:
    def chord(degrees: float) -> float:
        return 2 * math.sin(math.radians(degrees) / 2)

    limit = chord(10) / chord(14)
    a, b = on_circle(0), on_circle(10, -14)
    assert matched(a, b, ratio=limit + 0.01) == [(0, 0)]
    assert matched(a, b, ratio=limit - 0.01) == []
