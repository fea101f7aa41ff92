"""Pairs to match: neighbours in time, and frames that look alike."""

from __future__ import annotations

import numpy as np

from lightning_pose.reconstruction.pairs import ALL_PAIRS, choose_pairs, describe_frames


def test_few_frames_are_matched_to_all() -> None:
    assert choose_pairs(describe_frames([np.zeros((3, 128), np.uint8)] * 3)) == [(0, 1), (0, 2), (1, 2)]


def test_a_place_that_is_seen_again_is_found() -> None:
    """Frames 50 to 55 show what frames 0 to 5 showed."""
    rng = np.random.default_rng(0)
    places = [rng.integers(0, 200, (40, 128), dtype=np.uint8) for _ in range(ALL_PAIRS + 10)]
    frames = [*places, *(place + rng.integers(0, 5, place.shape, dtype=np.uint8) for place in places[:6])]
    pairs = choose_pairs(describe_frames(frames), alike=2)
    assert {(i, 50 + i) for i in range(6)} <= set(pairs)
    assert {(i, i + 1) for i in range(55)} <= set(pairs)
    assert len(pairs) < 56 * 10


def test_frames_without_keypoints_are_no_mistake() -> None:
    frames = [np.zeros((0, 128), np.uint8)] * (ALL_PAIRS + 1)
    assert (0, 1) in choose_pairs(describe_frames(frames))
