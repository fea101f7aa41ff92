"""Matching keypoints of two posed frames along their epipolar lines."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

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
    a, b = pairs.T
    essential = essential_matrices(frames.rotation[a], frames.position[a], frames.rotation[b], frames.position[b])
    rays = torch.from_numpy(np.concatenate([frames.points, np.ones_like(frames.points[..., :1])], axis=2)).float()
    descriptors = torch.from_numpy(frames.descriptors)
    size = np.maximum(frames.size_px / frames.focal_px[:, None], 1e-9)  # an angle: images may differ in size
    octaves = torch.from_numpy(np.log2(size) / np.log2(SIZE_RATIO)).float()
    padding = torch.from_numpy(np.where(frames.real, 0.0, FAR)).float()
    band = torch.from_numpy(band_px / frames.focal_px).float()
    scale = max((find_distance_scale(rows) for rows in frames.descriptors[:SAMPLE]), default=1.0)

    def match_chunk(start: int) -> tuple[np.ndarray, ...]:
        chunk = slice(start, start + BATCH)
        i, j = torch.from_numpy(a[chunk]), torch.from_numpy(b[chunk])
        lines = rays[i] @ torch.from_numpy(essential[chunk]).float().mT
        lines = lines / (lines[..., :2].norm(dim=-1, keepdim=True).clamp(min=1e-12) * band[j][:, None, None])
        limit = _limit_by_places(lines, octaves[i], padding[i], rays[j], octaves[j], padding[j])
        similarity = torch.bmm(descriptors[i], descriptors[j].mT)
        if scale != 1:  # as if the descriptors differed so many times less
            similarity = similarity.sub_(1).div_(scale**2).add_(1)
        return _take_mutual(torch.minimum(similarity, limit, out=limit), start)

    pair, row_a, row_b, distance = _join(map_in_threads(match_chunk, range(0, len(pairs), BATCH)))
    return KeypointMatches(pairs[pair], np.stack([row_a, row_b], axis=1), distance)


def _limit_by_places(
    lines: Tensor, octaves_a: Tensor, padding_a: Tensor, rays_b: Tensor, octaves_b: Tensor, padding_b: Tensor
) -> Tensor:
    """(B, N, N): above 1 where keypoint b may match keypoint a by its place and size, far below -1 elsewhere.

    The squared distance of b to the line of a and the squared difference of their sizes, in units of their limits, may
    add up to 1. The squares are multiplied out, so that one product finds how much is left, many times enlarged.
    """
    x, y, w = lines.unbind(2)
    of_a = [x * x, y * y, 2 * x * y, 2 * x * w, 2 * y * w, w * w + octaves_a**2 + padding_a - 1, -2 * octaves_a]
    u, v, one = rays_b.unbind(2)
    of_b = [u * u, v * v, u * v, u, v, one, octaves_b]
    of_a, of_b = [*of_a, one], [*of_b, octaves_b**2 + padding_b]
    return torch.bmm(torch.stack(of_a, 2) * -ENLARGE, torch.stack(of_b, 1))


def _take_mutual(similarity: Tensor, first: int) -> tuple[np.ndarray, ...]:
    """Pair, row a, row b and descriptor distance of what is each other's best and clearly the best."""
    best_of_a, best_of_b = similarity.amax(2), similarity.amax(1)
    pair, row_a = (best_of_a > 1 - MAX_DISTANCE**2 / 2).nonzero(as_tuple=True)
    of_a = similarity.flatten(0, 1).index_select(0, pair * similarity.shape[1] + row_a)
    value, row_b = best_of_a[pair, row_a], torch.from_numpy(of_a.numpy().argmax(axis=1))  # faster than torch's
    of_a.scatter_(1, row_b[:, None], -1.0)
    kept = (value == best_of_b[pair, row_b]) & ((1 - value) < RATIO**2 * (1 - of_a.amax(1)))
    pair, row_a, row_b, value = pair[kept], row_a[kept], row_b[kept], value[kept]
    distance = (2 - 2 * value).clamp(min=0).sqrt()
    return (pair + first).numpy(), row_a.numpy(), row_b.numpy(), distance.numpy()


def _join(parts: list[tuple[np.ndarray, ...]]) -> tuple[np.ndarray, ...]:
    empty = (np.zeros(0, np.int64),) * 3 + (np.zeros(0, np.float32),)
    return tuple(np.concatenate(column) for column in zip(empty, *parts, strict=True))
