"""The stages of map building, each against known values: pairs, matches, depth vote, tracks, bundle adjustment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lightning_pose.geometry.rolling_shutter import remove_rolling
from lightning_pose.mapping.bundle_adjustment import Adjustment, adjust_bundle
from lightning_pose.mapping.camera_correction import CameraCorrection
from lightning_pose.mapping.depth_vote import vote_depths
from lightning_pose.mapping.frames import find_distance_scale, find_turn_rates
from lightning_pose.mapping.guided_matching import KeypointMatches, match_pairs
from lightning_pose.mapping.pairs import choose_pairs
from lightning_pose.mapping.point_map import quantize_descriptors
from lightning_pose.mapping.scene_depth import estimate_depth
from lightning_pose.mapping.tracks import join_tracks
from tests.mapping.helpers import make_frames, make_walk


def make_matches(rows: list[tuple[int, int, int, int, float]]) -> KeypointMatches:
    """Of (frame a, keypoint a, frame b, keypoint b, distance)."""
    frame_a, keypoint_a, frame_b, keypoint_b, distance = (np.array(column) for column in zip(*rows, strict=True))
    return KeypointMatches(
        np.stack([frame_a, frame_b], 1), np.stack([keypoint_a, keypoint_b], 1), distance.astype(np.float32)
    )


def test_the_depth_is_that_of_the_point_all_cameras_look_at() -> None:
    angles = np.radians(np.arange(0, 360, 30))
    position = np.column_stack([-4 * np.sin(angles), np.zeros(12), -4 * np.cos(angles)])
    rotation = Rotation.from_euler("y", angles[:, None]).as_matrix()  # each looks at the origin
    np.testing.assert_allclose(rotation[:, :, 2], -position / 4, atol=1e-12)
    assert estimate_depth(rotation, position + 7) == pytest.approx(4)


def test_pairs_see_the_same_and_stand_apart() -> None:
    rotation, position_m = make_walk(30)
    turned = rotation.copy()
    turned[20:] = turned[20:] @ Rotation.from_euler("y", 180, degrees=True).as_matrix()
    position_m[5] = position_m[4]
    pairs = choose_pairs(make_frames(turned, position_m), depth=3.0).pairs
    assert (pairs[:, 0] < pairs[:, 1]).all()
    assert not ((pairs[:, 0] < 20) & (pairs[:, 1] >= 20)).any(), "a pair looks in opposite directions"
    assert not (pairs == [4, 5]).all(axis=1).any(), "a pair has no baseline"
    assert len(pairs) == len(np.unique(pairs, axis=0))


def test_matches_along_epipolar_lines_are_right() -> None:
    frames = make_frames(*make_walk(30), noise_px=0.2, clutter=40)
    matches = match_pairs(frames, np.array([[3, 8], [10, 14]]))
    look_a, look_b = (frames.descriptors[matches.frame[:, k], matches.keypoint[:, k]] for k in (0, 1))
    np.testing.assert_allclose(np.linalg.norm(look_a - look_b, axis=1), matches.distance, atol=1e-3)
    assert set(map(tuple, matches.frame.tolist())) == {(3, 8), (10, 14)}
    assert len(matches.distance) > 100
    assert vote_depths(frames, matches).dtype == bool


def test_binary_descriptors_may_differ_more() -> None:
    """A fifth of the bits of a point differ from view to view: more than real numbers of one point do."""
    frames = make_frames(*make_walk(30), noise_px=0.2, clutter=0)
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(256, frames.descriptors.shape[2]))
    bits = np.sign(frames.descriptors @ directions.T) * frames.real[..., None]
    binary = (bits / 16).astype(np.float32)
    assert find_distance_scale(binary[0]) > 1
    assert find_distance_scale(frames.descriptors[0]) == find_distance_scale(np.zeros((0, 8))) == 1
    pairs = np.array([[3, 8], [10, 14]])
    found = match_pairs(replace(frames, descriptors=binary), pairs)
    assert len(found.distance) > 0.8 * len(match_pairs(frames, pairs).distance)


def test_padding_is_never_matched() -> None:
    frames = make_frames(*make_walk(10))
    matches = match_pairs(frames, np.array([[2, 5]]))
    assert (matches.keypoint < frames.count[matches.frame]).all()


def test_a_wrong_match_has_no_second_vote() -> None:
    frames = make_frames(*make_walk(30), noise_px=0.0, clutter=0)
    pairs = np.array([[10, 12], [10, 14], [10, 16]])
    matches = match_pairs(frames, pairs)
    shared = np.bincount(matches.keypoint[:, 0])
    keypoint = int(np.argmax(shared == 3))
    rows = np.flatnonzero(matches.keypoint[:, 0] == keypoint)
    spoilt = frames.points.copy()
    spoilt[16, matches.keypoint[rows[2], 1]] += [0.2, 0.0]  # 100 px along the line
    kept = vote_depths(replace(frames, points=spoilt), matches)
    assert kept[rows].tolist() == [True, True, False]


def test_tracks_never_hold_two_keypoints_of_a_frame() -> None:
    matches = make_matches(
        [
            (0, 1, 1, 1, 0.1),
            (1, 1, 2, 1, 0.2),
            (0, 1, 2, 9, 0.4),  # would put keypoints 1 and 9 of frame 2 together
            (2, 9, 3, 9, 0.3),
        ]
    )
    track, frame, keypoint = join_tracks(matches, n_keypoints=20, min_length=2)
    found = {tuple(zip(frame[track == t], keypoint[track == t], strict=True)) for t in np.unique(track)}
    assert found == {((0, 1), (1, 1), (2, 1)), ((2, 9), (3, 9))}


def test_short_tracks_are_left_out() -> None:
    matches = make_matches([(0, 0, 1, 0, 0.1), (1, 0, 2, 0, 0.1), (0, 5, 1, 5, 0.1)])
    track, frame, _ = join_tracks(matches, n_keypoints=10, min_length=3)
    assert track.tolist() == [0, 0, 0]
    assert frame.tolist() == [0, 1, 2]


def test_no_matches_give_no_tracks() -> None:
    none = KeypointMatches(np.zeros((0, 2), np.int64), np.zeros((0, 2), np.int64), np.zeros(0, np.float32))
    assert all(len(part) == 0 for part in join_tracks(none, 10, 3))
    assert len(vote_depths(make_frames(*make_walk(3)), none)) == 0


def test_a_camera_correction_is_undone() -> None:
    camera = CameraCorrection(1.02, np.array([0.01, -0.02]), -0.05)
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (50, 2))
    np.testing.assert_allclose(camera.remove(camera.distort(points)), points, atol=1e-6)


def test_bundle_adjustment_finds_perturbed_poses_and_the_camera() -> None:
    rng = np.random.default_rng(1)
    rotation, position_m = make_walk(12)
    points_m = rng.uniform([-3, -1.5, 2.5], [3, 1.5, 4], (150, 3))
    local = np.einsum("fji,ftj->fti", rotation, points_m[None] - position_m[:, None])
    true = CameraCorrection(1.005, np.array([0.002, -0.001]), 0.01)
    seen = true.distort(local[..., :2] / local[..., 2:])
    frames = make_frames(rotation, position_m)
    turn = Rotation.from_rotvec(rng.normal(0, 0.004, (12, 3))).as_matrix()
    given = replace(
        frames,
        points=seen,
        rotation=rotation @ turn,
        position=position_m + rng.normal(0, 0.01, (12, 3)),
    )
    track, frame = np.repeat(np.arange(150), 12), np.tile(np.arange(12), 150)
    start = Adjustment(given.rotation, given.position, points_m + rng.normal(0, 0.02, (150, 3)))
    found = adjust_bundle(start, given, track, frame, track, steps=20)
    camera_rotation, camera_position = found.camera_poses
    local = np.einsum("fji,ftj->fti", camera_rotation, found.points[None] - camera_position[:, None])
    error = np.linalg.norm(found.camera.distort(local[..., :2] / local[..., 2:]) - seen, axis=2) * 500
    assert np.median(error) < 0.05, "images agree to a twentieth of a pixel"
    # All cameras may turn by a common angle, which the principal point makes up for: compare frames with each other.
    assert _median_turn(rotation, camera_rotation) < 0.2 * _median_turn(rotation, given.rotation)


def test_bundle_adjustment_finds_the_readout_of_a_rolling_shutter() -> None:
    rotation, position_m = make_walk(40, noise_deg=0.0)
    points_m = np.random.default_rng(1).uniform([-3, -1.5, 2.5], [3, 1.5, 4], (150, 3))
    local = np.einsum("fji,ftj->fti", rotation, points_m[None] - position_m[:, None])
    still = local[..., :2] / local[..., 2:]
    rates = find_turn_rates(rotation)
    seen = still
    for _ in range(3):
        seen = seen + still - remove_rolling(seen, 0.6 * rates[:, None])
    given = replace(make_frames(rotation, position_m), points=seen)
    track, frame = np.repeat(np.arange(150), 40), np.tile(np.arange(40), 150)
    start = Adjustment(rotation, position_m, points_m, rolling=True)
    assert adjust_bundle(start, given, track, frame, track).readout == pytest.approx(0.6, abs=0.05)
    assert adjust_bundle(replace(start, rolling=False), given, track, frame, track).readout == 0


def test_turn_rates_do_not_reach_over_gaps() -> None:
    angles = np.array([0.0, 0.02, 0.04, 0.08, 1.0, 1.1])
    rates = find_turn_rates(Rotation.from_rotvec(np.outer(angles, [0, 1, 0])).as_matrix())
    np.testing.assert_allclose(rates[:, 1], [0.02, 0.02, 0.03, 0.04, 0.1, 0.1])
    assert find_turn_rates(np.eye(3)[None]).tolist() == [[0, 0, 0]]


def _median_turn(true: np.ndarray, found: np.ndarray) -> float:
    """Median angle (radians) between true and found rotations from the first frame to each other."""
    steps = [Rotation.from_matrix(each[0].T @ each[1:]) for each in (true, found)]
    return float(np.median((steps[0].inv() * steps[1]).magnitude()))


def test_descriptors_keep_their_direction_in_a_byte() -> None:
    looks = np.random.default_rng(0).normal(size=(20, 64))
    kept = quantize_descriptors(looks).astype(float)
    cosine = (kept * looks).sum(1) / np.linalg.norm(kept, axis=1) / np.linalg.norm(looks, axis=1)
    assert cosine.min() > 0.9995
