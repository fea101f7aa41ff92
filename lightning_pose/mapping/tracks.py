"""Tracks: which keypoints of different frames are one point of the scene."""

from __future__ import annotations

import numpy as np

from lightning_pose.mapping.guided_matching import KeypointMatches

__all__ = ["join_tracks"]


def join_tracks(
    matches: KeypointMatches, n_keypoints: int, min_length: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Join matched keypoints into tracks, the most alike first; no track has two keypoints of one frame.

    A match that would put two keypoints of one frame into a track is passed over. (Joining everything that is linked
    makes one track of most keypoints: a single wrong match joins two points.)

    Args:
        matches: of pairs of frames.
        n_keypoints: N, keypoints a frame has at most.
        min_length: shortest track that is returned.

    Returns:
        track (O,), frame (O,) and keypoint (O,) of each observation, int64, sorted by track, then frame.
    """
    ids = matches.frame * n_keypoints + matches.keypoint
    nodes, index = np.unique(ids, return_inverse=True)
    index = index.reshape(-1, 2)
    parent = list(range(len(nodes)))
    frames = (nodes // n_keypoints).tolist()
    members: dict[int, int] = {}  # a bit for each frame of a root that has more than its own
    order = np.lexsort((ids[:, 1], ids[:, 0], matches.distance))
    for a, b in zip(*index[order].T.tolist(), strict=True):
        while parent[a] != a:
            parent[a] = a = parent[parent[a]]
        while parent[b] != b:
            parent[b] = b = parent[parent[b]]
        if a == b:
            continue
        one, other = members.get(a) or 1 << frames[a], members.get(b) or 1 << frames[b]
        if not one & other:
            if a > b:
                a, b = b, a
            members[a] = one | other
            members.pop(b, None)
            parent[b] = a
    root = np.array(parent, np.int64)
    while not np.array_equal(root, root[root]):
        root = root[root]
    _, track, length = np.unique(root, return_inverse=True, return_counts=True)
    kept = length[track] >= min_length
    number = np.cumsum(length >= min_length) - 1
    track, nodes = number[track[kept]], nodes[kept]
    order = np.lexsort((nodes, track))
    return track[order], nodes[order] // n_keypoints, nodes[order] % n_keypoints
