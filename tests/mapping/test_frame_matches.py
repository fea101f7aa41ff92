"""Matches between frames near each other in time: which pairs are tried, and that threads change nothing."""

from __future__ import annotations

import time

import numpy as np

from lightning_pose.mapping.frame_matches import match_nearby_frames

POINTS, SHARED, STEP_PX = 200, 25, 3.0
"""Points on a line that a camera passes: each frame sees all but 25 of those that the frame before it saw."""


class Walk:
    """Frames that pass a line of points; counts how often each is read."""

    def __init__(self) -> None:
        self.descriptors = np.random.default_rng(0).normal(size=(2 * POINTS + 40 * SHARED, 64)).astype(np.float32)
        self.descriptors /= np.linalg.norm(self.descriptors, axis=1, keepdims=True)
        self.read: list[int] = []

    def read_keypoints(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        self.read.append(frame)
        time.sleep(0.001)  # so that threads take turns
        seen = np.arange(POINTS) + SHARED * frame
        return np.column_stack([STEP_PX * (seen - frame), seen % 7.0]), self.descriptors[seen]


def test_pairs_are_tried_as_far_as_they_match() -> None:
    matches = match_nearby_frames(["a"] * 12 + ["b"] * 8, Walk().read_keypoints, anchors=20)
    gaps = matches.frame_b - matches.frame_a
    assert set(gaps) == {1, 2, 4}  # eight places apart, nothing is shared
    assert not ((matches.frame_a < 12) & (matches.frame_b >= 12)).any()
    moved = (matches.points_a_px - matches.points_b_px)[:, 0]
    np.testing.assert_allclose(moved, STEP_PX * gaps[matches.pair])


def test_threads_change_nothing_and_no_frame_is_read_twice() -> None:
    alone, together = Walk(), Walk()
    expected = match_nearby_frames(["a"] * 30, alone.read_keypoints, anchors=12)
    found = match_nearby_frames(["a"] * 30, together.read_keypoints, anchors=12, threads=4)
    for name, array in vars(expected).items():
        np.testing.assert_array_equal(getattr(found, name), array)
    assert sorted(together.read) == sorted(alone.read) == sorted(set(alone.read))
