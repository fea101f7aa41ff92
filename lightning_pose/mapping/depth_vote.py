"""Dropping wrong matches: those of one keypoint must agree on its depth."""

from __future__ import annotations

import itertools

import numpy as np

from lightning_pose.mapping.frames import MapFrames
from lightning_pose.mapping.guided_matching import KeypointMatches
from lightning_pose.mapping.threads import map_in_threads

__all__ = ["vote_depths"]

AGREE_PX = 4.0
"""A match supports a depth if its keypoint lies this near to where that depth puts it."""

SUPPORTERS = 2
"""Matches, the proposer included, that a depth needs."""

PART = 2**16
"""Directed matches whose keypoints are looked at at once."""

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
    n_keypoints = frames.points.shape[1]
    ids = (matches.frame * n_keypoints + matches.keypoint).T.ravel()
    order = np.argsort(ids, kind="stable")
    group = np.cumsum(np.diff(ids[order], prepend=-1) != 0) - 1
    far, far_keypoint = matches.frame[:, ::-1].T.ravel()[order], matches.keypoint[:, ::-1].T.ravel()[order]
    near, keypoint = np.divmod(ids[order], n_keypoints)

    def support(first: int, last: int) -> np.ndarray:
        part = slice(*np.searchsorted(group, [first, last]))
        step, start = _find_rays(frames, near[part], keypoint[part], far[part])
        observed = frames.points[far[part], far_keypoint[part]].T
        depth = _find_depths(step, start, observed)
        ranges = _find_depth_ranges(step, start, observed, agree_px / frames.focal_px[far[part]])
        return _support_best(group[part] - first, depth, *ranges)

    ends = [*np.unique(group[::PART]).tolist(), int(group[-1]) + 1] if len(group) else []
    supports = np.concatenate(
        [np.zeros(0, bool), *map_in_threads(lambda part: support(*part), itertools.pairwise(ends))]
    )
    kept = np.zeros(len(matches.distance), bool)
    kept[order[supports] % len(kept)] = True
    return kept


def _find_rays(
    frames: MapFrames, near: np.ndarray, keypoint: np.ndarray, far: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The rays of D keypoints in other frames' cameras: at depth z, one lies at z * step + start; both (3, D)."""
    pair, index = np.unique(near * len(frames) + far, return_inverse=True)
    one, other = pair // len(frames), pair % len(frames)
    to_other = np.swapaxes(frames.rotation[other], 1, 2)
    rotation = to_other @ frames.rotation[one]
    shift = (to_other @ (frames.position[one] - frames.position[other])[:, :, None])[:, :, 0]
    x, y = frames.points[near, keypoint].T
    step = np.stack([r[index, 0] * x + r[index, 1] * y + r[index, 2] for r in np.moveaxis(rotation, 1, 0)])
    return step, shift.T[:, index]


def _find_depths(step: np.ndarray, start: np.ndarray, observed: np.ndarray) -> np.ndarray:
    """(D,) depth at which each ray passes nearest to its partner's; negative where they meet behind the camera."""
    ray = np.stack([*observed, np.ones(observed.shape[1])])
    aa, bb, ab = ((x * y).sum(axis=0) for x, y in ((step, step), (ray, ray), (step, ray)))
    at, bt = (step * start).sum(axis=0), (ray * start).sum(axis=0)
    return (ab * bt - bb * at) / np.maximum(aa * bb - ab**2, 1e-12)


def _support_best(group: np.ndarray, depth: np.ndarray, nearest: np.ndarray, farthest: np.ndarray) -> np.ndarray:
    """(D,) bool: which of the directed matches support the best depth of their near keypoint (`group`, ascending)."""
    if not len(group):
        return np.zeros(0, bool)
    size = np.bincount(group)
    first = np.cumsum(size) - size
    votes = np.zeros(len(group), np.int64)
    voters = size[group]  # of each proposer: its whole group
    done = np.cumsum(voters)
    for low, high in itertools.pairwise(
        np.searchsorted(done, np.arange(0, done[-1] + CHUNK, CHUNK), side="right").tolist()
    ):
        if low == high:
            continue
        count = voters[low:high]
        ends = np.cumsum(count)
        proposed = np.repeat(depth[low:high], count)
        voter = np.arange(len(proposed)) + np.repeat(first[group[low:high]] - ends + count, count)
        agrees = (proposed >= nearest[voter]) & (proposed <= farthest[voter])
        votes[low:high] = np.add.reduceat(agrees, ends - count, dtype=np.int64)
    most = np.maximum.reduceat(votes, first)
    best = np.flatnonzero(votes == most[group])
    best = best[np.diff(group[best], prepend=-1) != 0]
    winner = depth[best][group]
    return (winner >= nearest) & (winner <= farthest) & (most >= SUPPORTERS)[group]


def _find_depth_ranges(
    step: np.ndarray, start: np.ndarray, observed: np.ndarray, radius: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Nearest and farthest depth z at which z * step + start projects to within `radius` of `observed`.

    In front of the camera, a point that moves along a ray moves along a line in the image, and is within a disc from
    one depth to another, or for ever. The two are the roots of a square equation.

    Args:
        step: (3, D).
        start: (3, D).
        observed: (2, D), normalised image coordinates.
        radius: (D,).

    Returns:
        (D,) nearest depth, and (D,) farthest; the nearest is above the farthest where there is none.
    """
    moving, fixed, squared = step[:2] - observed * step[2], start[:2] - observed * start[2], radius**2
    a = (moving**2).sum(axis=0) - squared * step[2] ** 2
    b = (moving * fixed).sum(axis=0) - squared * step[2] * start[2]
    c = (fixed**2).sum(axis=0) - squared * start[2] ** 2
    root = np.sqrt(np.maximum(b**2 - a * c, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        one, other = (-b - root) / a, (-b + root) / a
        low, high = np.minimum(one, other), np.maximum(one, other)
        passes = (b**2 >= a * c) & (step[2] * (low + high) / 2 + start[2] > 0)
    # a < 0: the ray ends within the disc; it enters from the side of the camera where depths are positive.
    away = step[2] > 0
    nearest = np.where(a > 0, np.where(passes, low, np.inf), np.where(away, high, -np.inf))
    farthest = np.where(a > 0, np.where(passes, high, -np.inf), np.where(away, np.inf, low))
    return np.maximum(nearest, np.finfo(float).tiny), farthest
