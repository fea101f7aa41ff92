"""Matching keypoints of two posed frames along their epipolar lines."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from lightning_pose.geometry.epipolar import essential_matrices
from lightning_pose.mapping.frames import MapFrames

__all__ = ["KeypointMatches", "match_pairs"]

BAND_PX = 4.0
"""How far a match may lie from its epipolar line."""

SIZE_RATIO = 2.0
"""How much larger one keypoint of a match may be than the other."""

MAX_DISTANCE = 0.5
"""Largest distance of the two descriptors."""

RATIO = 0.8
"""The best match's distance must be below this times the second best's within the band."""

BATCH = 16
"""Pairs matched at once."""


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
    log_size = torch.from_numpy(np.where(frames.real, np.log2(size), np.inf)).float()
    band = torch.from_numpy(band_px / frames.focal_px).float()
    found: list[tuple[np.ndarray, ...]] = []
    for start in range(0, len(pairs), BATCH):
        chunk = slice(start, start + BATCH)
        i, j = torch.from_numpy(a[chunk]), torch.from_numpy(b[chunk])
        lines = rays[i] @ torch.from_numpy(essential[chunk]).float().mT
        lines = lines / lines[..., :2].norm(dim=-1, keepdim=True).clamp(min=1e-12)
        offset = torch.bmm(lines, rays[j].mT).abs_()
        possible = offset <= band[j][:, None, None]
        possible &= (log_size[i][:, :, None] - log_size[j][:, None, :]).abs_() <= np.log2(SIZE_RATIO)
        similarity = torch.bmm(descriptors[i], descriptors[j].mT).masked_fill_(~possible, -1.0)
        found.append(_take_mutual(similarity, chunk.start))
    pair, row_a, row_b, distance = _join(found)
    return KeypointMatches(pairs[pair], np.stack([row_a, row_b], axis=1), distance)


def _take_mutual(similarity: Tensor, first: int) -> tuple[np.ndarray, ...]:
    """Pair, row a, row b and descriptor distance of what is each other's best and clearly the best."""
    best, to_b = similarity.max(dim=2)
    to_a = similarity.max(dim=1).indices
    rows = torch.arange(similarity.shape[1])
    mutual = (to_a.gather(1, to_b) == rows) & (best > 1 - MAX_DISTANCE**2 / 2)
    pair, row_a = mutual.nonzero(as_tuple=True)
    row_b, value = to_b[pair, row_a], best[pair, row_a]
    of_a = similarity[pair, row_a].scatter_(1, row_b[:, None], -1.0).amax(1)
    clear = (1 - value) < RATIO**2 * (1 - of_a)
    pair, row_a, row_b, value = pair[clear], row_a[clear], row_b[clear], value[clear]
    distance = (2 - 2 * value).clamp(min=0).sqrt()
    return (pair + first).numpy(), row_a.numpy(), row_b.numpy(), distance.numpy()


def _join(parts: list[tuple[np.ndarray, ...]]) -> tuple[np.ndarray, ...]:
    empty = (np.zeros(0, np.int64),) * 3 + (np.zeros(0, np.float32),)
    return tuple(np.concatenate(column) for column in zip(empty, *parts, strict=True))
