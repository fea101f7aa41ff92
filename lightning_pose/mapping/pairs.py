"""Which pairs of frames to match: those that see the same things from places far enough apart."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise, repeat
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.spatial import KDTree

from lightning_pose.mapping.frames import MapFrames

__all__ = ["FramePairs", "choose_pairs"]

MIN_OVERLAP = 0.4
"""Share of either image that the other must see, at the nominal depth."""

MIN_BASELINE = 0.015
"""Distance between the cameras, in nominal depths; below it depths are too uncertain to help."""

PARTNERS = 8
"""Partners chosen for each frame, spread evenly from the nearest to the farthest. 12 took longer and gained nothing."""

PARTNERS_OF_FEW = 40
"""The same where the median frame overlaps with at most `FEW_OVERLAPS` others: photos, or a walk that passes once."""

FEW_OVERLAPS = 50
"""Frames that a frame overlaps with: up to so many are few."""

MOST_COMPARED = 1000
"""Up to so many frames, all are compared with each other; of more, each with so many that look at near places."""

GRID = (7, 5)
"""Points across and down an image that stand for what it sees."""


class FramePairs(NamedTuple):
    """Pairs of frames to match.

    Attributes:
        pairs: (P, 2) int64, first frame below the second, in ascending order.
        few: whether frames overlap with so few others that each point is seen by few.
    """

    pairs: np.ndarray
    few: bool


def choose_pairs(frames: MapFrames, depth: float) -> FramePairs:
    """Choose pairs of frames to match.

    Args:
        frames: with poses.
        depth: typical distance of what the frames see.
    """
    overlapping = list(_list_overlapping(frames, depth))
    few = np.median([len(others) for others in overlapping] or [0]) <= FEW_OVERLAPS
    partners = PARTNERS_OF_FEW if few else PARTNERS
    pairs: set[tuple[int, int]] = set()
    for i, others in enumerate(overlapping):
        chosen = np.unique(np.linspace(0, len(others) - 1, partners).round().astype(int)) if len(others) else []
        pairs.update((min(i, j), max(i, j)) for j in others[chosen].tolist())
    return FramePairs(np.array(sorted(pairs), np.int64).reshape(-1, 2), bool(few))


def _list_overlapping(frames: MapFrames, depth: float) -> Iterator[np.ndarray]:
    """Of each frame, those that see enough of the same from far enough away, the nearest first."""
    both = _measure_overlaps(frames, depth)
    for i, (first, last) in enumerate(pairwise(both.indptr)):
        others = both.indices[first:last]
        baseline = np.linalg.norm(frames.position[others] - frames.position[i], axis=1)
        kept = baseline >= MIN_BASELINE * depth
        yield others[kept][np.argsort(baseline[kept], kind="stable")]


def _list_candidates(frames: MapFrames, depth: float) -> Iterator[np.ndarray | slice]:
    """Of each frame, those that it is compared with, in ascending order."""
    if len(frames) <= MOST_COMPARED:
        yield from repeat(slice(None), len(frames))
        return
    looked_at = frames.position + depth * frames.rotation[:, :, 2]
    tree = KDTree(looked_at)
    for place in looked_at:
        yield np.sort(tree.query(place, MOST_COMPARED)[1])


def _measure_overlaps(frames: MapFrames, depth: float) -> sparse.csr_matrix:
    """(F, F): the share of either image, at the nominal depth, that the other sees; 0 below `MIN_OVERLAP`.

    A camera sees what lies inside the four planes through its centre and the sides of its image: one product of the
    planes of all candidates with the points that a frame sees.
    """
    n = len(frames)
    x, y = np.meshgrid(*(np.linspace(-1, 1, count) for count in GRID))
    unit = np.column_stack([x.ravel(), y.ravel()])
    local = np.concatenate([unit * frames.half_view[:, None], np.ones((n, len(unit), 1))], axis=2) * depth
    centre = frames.position - frames.position.mean(axis=0)  # float32 has no digits for a far origin
    world = local @ np.swapaxes(frames.rotation, 1, 2) + centre[:, None]
    points = np.concatenate([world, np.ones((n, len(unit), 1))], axis=2).astype(np.float32)
    outward = np.zeros((n, 4, 3))
    outward[:, [0, 1], 0] = outward[:, [2, 3], 1] = [1, -1]
    outward[:, :, 2] = -frames.half_view[:, [0, 0, 1, 1]]
    normal = outward @ np.swapaxes(frames.rotation, 1, 2)
    offset = -(normal @ centre[:, :, None])
    planes = np.ascontiguousarray(np.moveaxis(np.concatenate([normal, offset], axis=2), 1, 0), np.float32)
    number, rows, columns, shares = np.arange(n), [], [], []
    for i, (view, others) in enumerate(zip(points, _list_candidates(frames, depth), strict=True)):
        some = planes[:, others]
        outside = (some.reshape(-1, 4) @ view.T).reshape(4, some.shape[1], -1).max(axis=0)
        share = (outside <= 0).mean(axis=1)
        kept = share >= MIN_OVERLAP
        columns.append(number[others][kept])
        shares.append(share[kept])
        rows.append(np.full(len(columns[-1]), i))
    seen = sparse.csr_matrix((np.concatenate(shares), (np.concatenate(rows), np.concatenate(columns))), (n, n))
    both = seen.minimum(seen.T).tocsr()
    both.sort_indices()
    return both
