"""Similarity transforms: rotation, scale and shift between two worlds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

__all__ = ["Similarity"]

FLAT = 1e-6
"""Points on a line, up to this share of their extent, leave the rotation open."""


@dataclass(frozen=True)
class Similarity:
    """`new = scale * rotation @ old + shift`.

    Attributes:
        scale: above 0.
        rotation: (3, 3).
        shift: (3,).

    >>> old = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    >>> Similarity.fit(old, 2 * old + [0, 0, 5]).apply(np.array([0.0, 0, 1])).round(6).tolist()
    [0.0, 0.0, 7.0]
    """

    scale: float
    rotation: np.ndarray
    shift: np.ndarray

    @classmethod
    def fit(cls, old: Float[np.ndarray, "n 3"], new: Float[np.ndarray, "n 3"]) -> Similarity | None:
        """The similarity with the smallest sum of squared distances (Umeyama, PAMI 1991); None if it is not unique.

        Three points that are not on one line are enough.
        """
        if len(old) < 3:
            return None
        centre, target = old.mean(axis=0), new.mean(axis=0)
        spreads = [np.linalg.svd(points, compute_uv=False) for points in (old - centre, new - target)]
        if any(spread[1] <= FLAT * max(spread[0], 1e-300) for spread in spreads):
            return None
        left, singular, right = np.linalg.svd((new - target).T @ (old - centre))
        signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))])  # a rotation, not a mirror
        rotation = (left * signs) @ right
        scale = float((singular * signs).sum() / ((old - centre) ** 2).sum())
        return cls(scale, rotation, target - scale * rotation @ centre)

    def apply(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Points in the new world."""
        return self.scale * points @ self.rotation.T + self.shift
