"""Dropping wrong matches: those of one keypoint must agree on its depth."""

from __future__ import annotations

import itertools

import numpy as np

from lightning_pose.geometry.triangulation import find_two_view_depths
from lightning_pose.mapping.frames import MapFrames
from lightning_pose.mapping.guided_matching import KeypointMatches

__all__ = ["vote_depths"]

AGREE_PX = 4.0
"""A match supports a depth if its keypoint lies this near to where that depth puts it."""

SUPPORTERS = 2
"""Matches, the proposer included, that a depth needs."""

CHUNK = 2**19
"""Pairs of a proposer and a voter looked at at once."""


def vote_depths(frames: MapFrames, matches: KeypointMatches, agree_px: float = AGREE_PX) -> np.ndarray:
    """Which matches agree with the depth that most matches of one of their keypoints support.

    Each match of a keypoint proposes the depth along the keypoint's ray at which its partner's ray passes. The
    proposal with the most supporters wins, and of equal ones the first. A match stays if it supports the winner at
    either of its ends.

    Args:
        frames: with poses.
        matches: of pairs of frames.
        agree_px: how near a supporter lies, in its own frame.

    Returns:
        (M,) bool.
    """
    rows = np.concatenate([np.arange(len(matches.distance))] * 2)
    near = np.concatenate([matches.frame[:, 0], matches.frame[:, 1]])
    far = np.concatenate([matches.frame[:, 1], matches.frame[:, 0]])
    near_keypoint = np.concatenate([matches.keypoint[:, 0], matches.keypoint[:, 1]])
    far_keypoint = np.concatenate([matches.keypoint[:, 1], matches.keypoint[:, 0]])
    order = np.argsort(near * frames.points.shape[1] + near_keypoint, kind="stable")
    rows, near, far, near_keypoint, far_keypoint = (
        column[order] for column in (rows, near, far, near_keypoint, far_keypoint)
    )
    group = np.cumsum(np.diff(near * frames.points.shape[1] + near_keypoint, prepend=-1) != 0) - 1
    supports = _find_supporters(frames, group, near, near_keypoint, far, far_keypoint, agree_px)
    kept = np.zeros(len(matches.distance), bool)
    kept[rows[supports]] = True
    return kept


def _find_supporters(
    frames: MapFrames,
    group: np.ndarray,
    near: np.ndarray,
    near_keypoint: np.ndarray,
    far: np.ndarray,
    far_keypoint: np.ndarray,
    agree_px: float,
) -> np.ndarray:
    """(D,) bool: which of the directed matches, sorted by their near keypoint (`group`), support its best depth."""
    to_far = np.swapaxes(frames.rotation[far], 1, 2)
    rotation = to_far @ frames.rotation[near]
    start = np.einsum("dij,dj->di", to_far, frames.position[near] - frames.position[far])
    ray = np.column_stack([frames.points[near, near_keypoint], np.ones(len(near))])
    observed = frames.points[far, far_keypoint]
    centre = -np.einsum("dji,dj->di", rotation, start)
    depth = find_two_view_depths(ray[:, :2], observed, np.swapaxes(rotation, 1, 2), centre).astype(np.float32)
    # At depth z of its ray, the near keypoint lies at z * step + start in the far camera.
    step, start = np.einsum("dij,dj->di", rotation, ray).astype(np.float32), start.astype(np.float32)
    observed, gate = observed.astype(np.float32), ((agree_px / frames.focal_px[far]) ** 2).astype(np.float32)

    def agrees(z: np.ndarray, voter: np.ndarray) -> np.ndarray:
        local = z[:, None] * step[voter] + start[voter]
        with np.errstate(divide="ignore", invalid="ignore"):
            error = local[:, :2] / local[:, 2:] - observed[voter]
        return ((error**2).sum(axis=1) <= gate[voter]) & (local[:, 2] > 0) & (z > 0)

    size = np.bincount(group)
    first = np.cumsum(size) - size
    votes = np.zeros(len(group), np.int64)
    voters = size[group]  # of each proposer: its whole group
    done = np.cumsum(voters)
    cuts = np.searchsorted(done, np.arange(0, done[-1] + CHUNK, CHUNK), side="right").tolist() if len(group) else []
    for low, high in itertools.pairwise(cuts):
        count = voters[low:high]
        proposer = np.repeat(np.arange(low, high), count)
        voter = np.arange(len(proposer)) + np.repeat(first[group[low:high]] - np.cumsum(count) + count, count)
        votes[low:high] = np.bincount(proposer - low, agrees(depth[proposer], voter), high - low)
    best = np.lexsort((-votes, group))[first]
    return agrees(depth[best][group], np.arange(len(group))) & (votes[best] >= SUPPORTERS)[group]
