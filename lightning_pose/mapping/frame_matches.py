"""Matches between frames of a dataset that lie near each other in time, found without any use of their poses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

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
    sequence: Sequence[str], read_keypoints: Callable[[int], Keypoints], anchors: int = ANCHORS
) -> FrameMatches:
    """Match frames 1, 2, 4, 8 ... places apart, as far as they still share enough of what they see.

    Wide pairs say most about the poses, near ones can be matched at all: the doubling gap finds both.

    Args:
        sequence: which sequence each frame belongs to; frames of one sequence are consecutive and in order.
        read_keypoints: a frame's number to its keypoints; called once for each frame that is needed.
        anchors: how many frames to start from.
    """
    known: dict[int, Keypoints] = {}

    def look_up(frame: int) -> Keypoints:
        if frame not in known:
            known[frame] = read_keypoints(frame)
        return known[frame]

    pairs: list[tuple[int, int]] = []
    points: list[tuple[np.ndarray, np.ndarray]] = [(np.zeros((0, 2)), np.zeros((0, 2)))]
    frames = len(sequence)
    for a in np.unique(np.linspace(0, frames - 1, anchors).round().astype(int)).tolist():
        gap = 1
        while a + gap < frames and sequence[a + gap] == sequence[a]:
            matched = _match_keypoints(look_up(a), look_up(a + gap))
            if matched is None:
                break
            if np.median(np.linalg.norm(matched[0] - matched[1], axis=1)) >= MIN_MOTION_PX:
                pairs.append((a, a + gap))
                points.append(matched)
            gap *= 2
    frame_a, frame_b = np.array(pairs, np.int64).reshape(-1, 2).T
    pair = np.repeat(np.arange(len(points)) - 1, [len(matched[0]) for matched in points])
    points_a_px, points_b_px = (np.concatenate(side) for side in zip(*points, strict=True))
    return FrameMatches(frame_a, frame_b, pair, points_a_px, points_b_px)


def _match_keypoints(a: Keypoints, b: Keypoints) -> tuple[np.ndarray, np.ndarray] | None:
    """Points (K, 2) and (K, 2) of the matches of two frames; None for fewer than `MIN_MATCHES`."""
    if min(len(a[0]), len(b[0])) < MIN_MATCHES:
        return None
    rows_a, rows_b = match_descriptors(a[1], b[1])
    return (a[0][rows_a], b[0][rows_b]) if len(rows_a) >= MIN_MATCHES else None
