"""Matching keypoints of two posed frames along their epipolar lines."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np
import torch

from lightning_pose.geometry.epipolar import essential_matrices
from lightning_pose.mapping.frames import MapFrames, find_distance_scale
from lightning_pose.mapping.threads import map_in_threads

__all__ = ["KeypointMatches", "match_pairs"]

BAND_PX = 4.5
"""How far a match of equal sizes may lie from its epipolar line."""

SIZE_RATIO = 2.25
"""How much larger one keypoint of a match may be than the other, if it lies on the line."""

MAX_DISTANCE = 0.5
"""Largest distance of the two descriptors."""

RATIO = 0.8
"""The best match's distance must be below this times the second best's within the band."""

FAR = 1e6
"""Squared distance of rows that are no keypoints from all others."""

ENLARGE = 1e6
"""So much more than descriptors differ: what is left for places and sizes."""

SAMPLE = 10
"""Frames of which one at least has keypoints, to look at their descriptors."""

BATCH = 4
"""Pairs matched at once: as many as fit a processor's cache."""


@dataclass(frozen=True)
class KeypointMatches:
    """M matches between keypoints of different frames.

    Attributes:
        frame: (M, 2) int64, the two frames.
        keypoint: (M, 2) int64, the keypoint's row in each.
        distance: (M,) float32, of the descriptors.
    """

    frame: np.ndarray
    keypoint: np.ndarray
    distance: np.ndarray

    def select(self, kept: np.ndarray) -> KeypointMatches:
        """The matches under a mask or of these numbers."""
        return KeypointMatches(self.frame[kept], self.keypoint[kept], self.distance[kept])


def match_pairs(frames: MapFrames, pairs: np.ndarray, band_px: float = BAND_PX) -> KeypointMatches:
    """Mutual nearest keypoints of each pair, among those near each other's epipolar lines.

    Args:
        frames: with poses.
        pairs: (P, 2) int64.
        band_px: largest distance from the epipolar line, in the second image.

    Returns:
        the matches, pair by pair.
    """
    pair, row_a, row_b, similarity = _join(_PairMatcher(frames, pairs, band_px).match_all())
    distance = np.sqrt(np.maximum(2 - 2 * similarity, 0))
    return KeypointMatches(pairs[pair], np.stack([row_a, row_b], axis=1), distance)


class _PairMatcher:
    """Matches pairs, some at a time, in arrays that each thread uses again: new ones would cost as much as the work.

    Keypoint b may match keypoint a if the squared distance of b to the line of a and the squared difference of their
    sizes, in units of their limits, add up to less than 1. The squares are multiplied out, so that one product finds
    how much is left; many times enlarged, it is far below -1 or above 1.
    """

    def __init__(self, frames: MapFrames, pairs: np.ndarray, band_px: float) -> None:
        self.frames, self.pairs = frames, pairs
        a, b = pairs.T
        self.essential = essential_matrices(
            frames.rotation[a], frames.position[a], frames.rotation[b], frames.position[b]
        ).astype(np.float32)
        self.rays = np.concatenate([frames.points, np.ones_like(frames.points[..., :1])], axis=2).astype(np.float32)
        self.descriptors = torch.from_numpy(frames.descriptors)
        size = np.maximum(frames.size_px / frames.focal_px[:, None], 1e-9)  # an angle: images may differ in size
        self.octaves = (np.log2(size) / np.log2(SIZE_RATIO)).astype(np.float32)
        self.own = self.octaves**2 + np.where(frames.real, 0.0, FAR).astype(np.float32)
        self.band = (band_px / frames.focal_px).astype(np.float32)
        self.scale = max((find_distance_scale(rows) for rows in frames.descriptors[:SAMPLE]), default=1.0)
        u, v, one = np.moveaxis(self.rays, 2, 0)
        self.places = torch.from_numpy(np.stack([u * u, v * v, u * v, u, v, one, self.octaves, self.own], axis=1))
        self.buffers = threading.local()

    def match_all(self) -> list[tuple[np.ndarray, ...]]:
        return map_in_threads(self._match, range(0, len(self.pairs), BATCH))

    def _match(self, start: int) -> tuple[np.ndarray, ...]:
        """Pair, row a, row b and similarity of what is each other's best and clearly the best."""
        i, j = self.pairs[start : start + BATCH].T
        similarity, limit = self._take_buffers(len(i))
        for a, b, product in zip(i.tolist(), j.tolist(), torch.from_numpy(similarity), strict=True):
            torch.mm(self.descriptors[a], self.descriptors[b].mT, out=product)
        if self.scale != 1:  # as if the descriptors differed so many times less
            similarity[:] = (similarity - 1) / self.scale**2 + 1
        lines = torch.from_numpy(self._find_lines(i, j, start))
        torch.bmm(lines, self.places[j], out=torch.from_numpy(limit))
        np.minimum(similarity, limit, out=similarity)
        rows = similarity.reshape(-1, similarity.shape[2])
        best = rows.argmax(axis=1)
        value = rows[np.arange(len(rows)), best]
        mutual = value == np.take_along_axis(similarity.max(axis=1), best.reshape(len(i), -1), axis=1).ravel()
        kept = np.flatnonzero(mutual & (value > 1 - MAX_DISTANCE**2 / 2))
        rows[kept, best[kept]] = -1.0
        kept = kept[1 - value[kept] < RATIO**2 * (1 - rows[kept].max(axis=1))]
        pair, row_a = np.divmod(kept, similarity.shape[1])
        return pair + start, row_a, best[kept], value[kept]

    def _find_lines(self, i: np.ndarray, j: np.ndarray, start: int) -> np.ndarray:
        """(B, N, 8): what `places` of frames j are multiplied with, for the keypoints of frames i."""
        lines = self.rays[i] @ self.essential[start : start + BATCH].swapaxes(1, 2)
        length = np.sqrt(lines[..., 0] ** 2 + lines[..., 1] ** 2)
        lines /= (np.maximum(length, 1e-12) * self.band[j][:, None])[..., None]
        x, y, w = np.moveaxis(lines, 2, 0)
        of_a = [
            x * x,
            y * y,
            2 * x * y,
            2 * x * w,
            2 * y * w,
            w * w + self.own[i] - 1,
            -2 * self.octaves[i],
            self.rays[i, :, 2],
        ]
        return np.stack(of_a, axis=2) * np.float32(-ENLARGE)

    def _take_buffers(self, n_pairs: int) -> tuple[np.ndarray, np.ndarray]:
        """Two arrays (B, N, N) of this thread."""
        if not hasattr(self.buffers, "arrays"):
            n = self.frames.points.shape[1]
            self.buffers.arrays = np.empty((BATCH, n, n), np.float32), np.empty((BATCH, n, n), np.float32)
        one, other = self.buffers.arrays
        return one[:n_pairs], other[:n_pairs]


def _join(parts: list[tuple[np.ndarray, ...]]) -> tuple[np.ndarray, ...]:
    empty = (np.zeros(0, np.int64),) * 3 + (np.zeros(0, np.float32),)
    return tuple(np.concatenate(column) for column in zip(empty, *parts, strict=True))
