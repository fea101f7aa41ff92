"""Matches between frames of a dataset that lie near each other in time, found without any use of their poses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from threading import Lock

import numpy as np

from lightning_pose.features.matching import match_descriptors

__all__ = ["FrameMatches", "match_nearby_frames"]

ANCHORS = 24
"""Frames, evenly spread, from which later frames are matched."""

MIN_MATCHES = 25
"""Fewer matches between two frames, and frames farther apart are not tried."""

MIN_MOTION_PX = 1.0
"""Median movement of a pair's matches; below it the pair says nothing of the camera's motion."""


@dataclass(frozen=True)
class FrameMatches:
    """Matched keypoints of P pairs of frames, M in all.

    Attributes:
        frame_a: (P,) int64, the first frame of each pair.
        frame_b: (P,) int64, the second.
        pair: (M,) int64, to which pair each match belongs.
        points_a_px: (M, 2) float64, pixels from the image's centre.
        points_b_px: (M, 2) float64.
    """

    frame_a: np.ndarray
    frame_b: np.ndarray
    pair: np.ndarray
    points_a_px: np.ndarray
    points_b_px: np.ndarray

    def sample(self, most: int) -> FrameMatches:
        """At most so many of the matches, evenly spread over the pairs."""
        if len(self.pair) <= most:
            return self
        kept = np.linspace(0, len(self.pair) - 1, most).round().astype(np.int64)
        return FrameMatches(self.frame_a, self.frame_b, self.pair[kept], self.points_a_px[kept], self.points_b_px[kept])


Keypoints = tuple[np.ndarray, np.ndarray]
"""(N, 2) pixels from the image's centre, and (N, D) L2-normalised descriptors."""


def match_nearby_frames(
    sequence: Sequence[str], read_keypoints: Callable[[int], Keypoints], anchors: int = ANCHORS, threads: int = 1
) -> FrameMatches:
    """Match frames 1, 2, 4, 8 ... places apart, as far as they still share enough of what they see.

    Wide pairs say most about the poses, near ones can be matched at all: the doubling gap finds both.

    Args:
        sequence: which sequence each frame belongs to; frames of one sequence are consecutive and in order.
        read_keypoints: a frame's number to its keypoints; called once for each frame that is needed, in any order.
        anchors: how many frames to start from.
        threads: how many of these are worked on at once; the result is the same.
    """
    frames = len(sequence)
    known: dict[int, Keypoints] = {}
    locks = [Lock() for _ in range(frames)]

    def look_up(frame: int) -> Keypoints:
        with locks[frame]:
            if frame not in known:
                known[frame] = read_keypoints(frame)
            return known[frame]

    def match_from(a: int) -> list[tuple[int, np.ndarray, np.ndarray]]:
        """Later frames with matched points of both; each pair of frames moves."""
        found, gap = [], 1
        while a + gap < frames and sequence[a + gap] == sequence[a]:
            matched = _match_keypoints(look_up(a), look_up(a + gap))
            if matched is None:
                break
            if np.median(np.linalg.norm(matched[0] - matched[1], axis=1)) >= MIN_MOTION_PX:
                found.append((a + gap, *matched))
            gap *= 2
        return found

    starts = np.unique(np.linspace(0, frames - 1, anchors).round().astype(int)).tolist()
    with ThreadPoolExecutor(threads) as pool:
        found = [(a, *pair) for a, pairs in zip(starts, pool.map(match_from, starts), strict=True) for pair in pairs]
    pairs, nothing = np.array([each[:2] for each in found], np.int64).reshape(-1, 2), np.zeros((0, 2))
    points_a_px, points_b_px = (np.concatenate([nothing, *(each[side] for each in found)]) for side in (2, 3))
    pair = np.repeat(np.arange(len(found)), [len(each[2]) for each in found])
    return FrameMatches(pairs[:, 0], pairs[:, 1], pair, points_a_px, points_b_px)


def _match_keypoints(a: Keypoints, b: Keypoints) -> tuple[np.ndarray, np.ndarray] | None:
    """Points (K, 2) and (K, 2) of the matches of two frames; None for fewer than `MIN_MATCHES`."""
    if min(len(a[0]), len(b[0])) < MIN_MATCHES:
        return None
    rows_a, rows_b = match_descriptors(a[1], b[1])
    return (a[0][rows_a], b[0][rows_b]) if len(rows_a) >= MIN_MATCHES else None
