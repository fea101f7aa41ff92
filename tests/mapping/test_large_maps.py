"""What is done for many frames and many points gives what comparing all of them gives, or nearly."""

from __future__ import annotations

import numpy as np
import pytest

from lightning_pose.mapping import pairs, query_matching, scene_depth
from lightning_pose.mapping.build_map import build_point_map
from lightning_pose.mapping.calibration import measure_frames
from lightning_pose.mapping.map_localizer import MapLocalizer
from lightning_pose.mapping.pairs import choose_pairs
from lightning_pose.mapping.scene_depth import estimate_depth, measure_depth
from lightning_pose.mapping.vote_index import VOTE_CELLS, VoteIndex
from tests.mapping.helpers import make_frames, make_walk

MANY = 8 * VOTE_CELLS


def make_unit_rows(count: int, seed: int) -> np.ndarray:
    rows = np.random.default_rng(seed).normal(size=(count, 32)).astype(np.float32)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def test_the_index_finds_the_point_of_a_noisy_keypoint() -> None:
    points = make_unit_rows(MANY, 0)
    asked = np.arange(0, MANY, 7)
    keypoints = points[asked] + make_unit_rows(len(asked), 1) * np.float32(0.2)
    exact = VoteIndex(points, most_voted=MANY).find_nearest(keypoints)
    found = VoteIndex(points, most_voted=MANY - 1).find_nearest(keypoints)
    assert (exact == asked).mean() > 0.98
    assert (found == exact).mean() > 0.9


def test_the_index_answers_where_cells_are_empty() -> None:
    points = np.repeat(make_unit_rows(3, 0), MANY // 3, axis=0)
    found = VoteIndex(points, most_voted=10).find_nearest(points[[0, MANY // 3, 2 * (MANY // 3)]])
    np.testing.assert_allclose(points[found], points[[0, MANY // 3, 2 * (MANY // 3)]])


def test_pairs_of_many_frames_are_among_those_that_look_at_near_places(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = make_frames(*make_walk(60))
    every = choose_pairs(frames, 3.0)
    monkeypatch.setattr(pairs, "MOST_COMPARED", 59)
    almost = choose_pairs(frames, 3.0)
    monkeypatch.setattr(pairs, "MOST_COMPARED", 12)
    some = choose_pairs(frames, 3.0)
    of_every, of_almost, of_some = ({tuple(pair) for pair in each.pairs.tolist()} for each in (every, almost, some))
    assert len(of_every & of_almost) > 0.9 * len(of_every)
    assert of_some
    assert max(b - a for a, b in of_some) < max(b - a for a, b in of_every), "the farthest are not compared"


def test_frames_that_overlap_with_few_others_have_more_partners(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = make_frames(*make_walk(60))
    few = choose_pairs(frames, 3.0)
    monkeypatch.setattr(pairs, "FEW_OVERLAPS", 5)
    many = choose_pairs(frames, 3.0)
    assert few.few
    assert not many.few
    assert len(few.pairs) > len(many.pairs)


def test_distances_are_measured_in_rooms_that_lie_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """The point that the cameras of two rooms all look at lies in neither of them."""
    rotation, position_m = make_walk(40)
    away = np.concatenate([position_m, position_m + np.array([200.0, 0.0, 0.0])])
    one, both = estimate_depth(rotation, position_m), np.concatenate([rotation, rotation])
    assert estimate_depth(both, away) > 2 * one
    monkeypatch.setattr(scene_depth, "MOST_COMPARED", 40)
    monkeypatch.setattr(scene_depth, "GROUP", 30)
    assert estimate_depth(both, away) < 2 * one


def test_the_depth_is_measured_from_matches() -> None:
    frames = make_frames(*make_walk(60))
    point_map = build_point_map(frames)
    assert measure_depth(frames) == pytest.approx(point_map.measure_depth(), rel=0.1)


def test_the_depth_of_frames_that_match_nothing_is_that_of_their_poses() -> None:
    frames = make_frames(*make_walk(10))
    frames.descriptors[:] = make_unit_rows(frames.descriptors[..., 0].size, 0)[
        :, : frames.descriptors.shape[2]
    ].reshape(frames.descriptors.shape)
    assert measure_depth(frames) == estimate_depth(frames.rotation, frames.position)


def test_a_large_map_answers_as_a_small_one(monkeypatch: pytest.MonkeyPatch) -> None:
    point_map = build_point_map(make_frames(*make_walk(60)))
    asked = make_frames(*make_walk(10, seed=5), seed=1)
    small = measure_frames(MapLocalizer(point_map), asked)
    monkeypatch.setattr(query_matching, "MOST_FRAMES", 59)
    monkeypatch.setattr(query_matching, "MOST_NEAR", 20)
    large = measure_frames(MapLocalizer(point_map), asked)
    assert large.accepted.all()
    np.testing.assert_allclose(large.position, small.position, atol=2e-3)
