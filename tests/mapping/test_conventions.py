"""The right reading of poses wins, whichever convention the files were written in."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lightning_pose.mapping.conventions import AS_READ, rank_readings, read_poses_as
from lightning_pose.mapping.frame_matches import FrameMatches, match_nearby_frames

FOCAL_PX = 500.0
FRAMES = 30


def make_walk() -> tuple[np.ndarray, np.ndarray]:
    """Camera-to-world rotations (F, 3, 3) and positions (F, 3) of a hand-held walk."""
    rng = np.random.default_rng(1)
    angles = np.cumsum(rng.normal(0, 4, (FRAMES, 3)), axis=0) + np.array([20, -70, 10])
    return Rotation.from_euler("xyz", angles, degrees=True).as_matrix(), np.cumsum(rng.normal(0, 0.1, (FRAMES, 3)), 0)


def make_matches(rotation: np.ndarray, position_m: np.ndarray, noise_px: float = 0.5) -> FrameMatches:
    """80 matches for each pair of neighbours, a tenth of them wrong."""
    rng = np.random.default_rng(2)
    seen_by_a, seen_by_b = [], []
    for a in range(FRAMES - 1):
        local = np.column_stack([rng.uniform(-0.5, 0.5, (80, 2)), np.ones(80)]) * rng.uniform(1, 5, (80, 1))
        world = local @ rotation[a].T + position_m[a]
        for seen, frame in ((seen_by_a, a), (seen_by_b, a + 1)):
            local = (world - position_m[frame]) @ rotation[frame]
            seen.append(FOCAL_PX * local[:, :2] / local[:, 2:] + rng.normal(0, noise_px, (80, 2)))
        seen_by_b[-1][:8] = rng.uniform(-300, 300, (8, 2))
    first = np.arange(FRAMES - 1)
    return FrameMatches(first, first + 1, np.repeat(first, 80), np.concatenate(seen_by_a), np.concatenate(seen_by_b))


FLIP = np.diag([1.0, -1, -1])

WRITTEN: dict[str, Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]] = {
    "world-to-camera": lambda R, c: (R.transpose(0, 2, 1), -np.einsum("fji,fj->fi", R, c)),
    "OpenGL axes (y up, z backward)": lambda R, c: (R @ FLIP, c),
    "world-to-camera, OpenGL axes (y up, z backward)": lambda R, c: (
        FLIP @ R.transpose(0, 2, 1),
        -np.einsum("ij,fkj,fk->fi", FLIP, R, c),
    ),
    "camera centre with a world-to-camera rotation": lambda R, c: (R.transpose(0, 2, 1), c),
    "images turned by 180 degrees": lambda R, c: (R @ np.diag([-1.0, -1, 1]), c),
}
"""What a reader that expects camera-to-world OpenCV poses gets from files of another convention."""


def test_the_files_own_reading_wins_with_the_true_focal_length() -> None:
    rotation, position_m = make_walk()
    best, second = rank_readings(make_matches(rotation, position_m), rotation, position_m, 640)[:2]
    assert best.name == AS_READ
    assert best.residual_px < 0.6 < 3 * best.residual_px < second.residual_px
    assert best.focal_px == pytest.approx(FOCAL_PX, rel=0.02)


@pytest.mark.parametrize("name", WRITTEN)
def test_the_convention_of_the_files_wins(name: str) -> None:
    rotation, position_m = make_walk()
    best = rank_readings(make_matches(rotation, position_m), *WRITTEN[name](rotation, position_m), 640)[0]
    assert best.name == name
    assert best.residual_px < 0.6


@pytest.mark.parametrize(("shift", "name"), [(1, "quaternion order wxyz"), (-1, "quaternion order xyzw")])
def test_the_order_of_the_quaternion_is_found(shift: int, name: str) -> None:
    rotation, position_m = make_walk()
    quats = np.roll(Rotation.from_matrix(rotation).as_quat(scalar_first=True), shift, axis=1)
    wrong = Rotation.from_quat(quats, scalar_first=True).as_matrix()
    assert rank_readings(make_matches(rotation, position_m), wrong, position_m, 640)[0].name == name
    np.testing.assert_allclose(read_poses_as(name, wrong, position_m)[0], rotation, atol=1e-12)


def test_left_handed_poses_are_found_and_reflected_whole() -> None:
    rotation, position_m = make_walk()
    mirror = np.diag([1.0, -1, 1])
    left_handed = mirror @ rotation @ mirror, position_m @ mirror
    best = rank_readings(make_matches(rotation, position_m), *left_handed, 640)[0]
    assert best.name == "left-handed axes (y up)"
    np.testing.assert_allclose(read_poses_as(best.name, *left_handed)[0], rotation, atol=1e-12)


def test_a_camera_that_never_moves_decides_nothing() -> None:
    rotation, position_m = make_walk()
    readings = rank_readings(make_matches(rotation, position_m), rotation, np.zeros_like(position_m), 640)
    as_read = next(reading for reading in readings if reading.name == AS_READ)
    assert np.isnan([as_read.cost, as_read.residual_px]).all()


def test_frames_are_matched_as_far_as_they_share_enough() -> None:
    # Frame i sees points 10 i to 10 i + 79 of a row: frames 4 apart share 40, frames 8 apart none.
    descriptors = np.linalg.qr(np.random.default_rng(0).normal(size=(400, 400)))[0].astype(np.float32)

    def read_keypoints(frame: int) -> tuple[np.ndarray, np.ndarray]:
        seen = np.arange(10 * frame, 10 * frame + 80)
        return np.column_stack([seen - 50.0 * frame, np.zeros(80)]), descriptors[seen]

    matches = match_nearby_frames(["a"] * 16 + ["b"] * 16, read_keypoints, anchors=32)
    gap = matches.frame_b - matches.frame_a
    assert set(gap.tolist()) == {1, 2, 4}
    assert not ((matches.frame_a < 16) & (matches.frame_b >= 16)).any(), "a pair crosses two sequences"
    np.testing.assert_allclose((matches.points_a_px - matches.points_b_px)[:, 0], 50.0 * gap[matches.pair])


def test_frames_without_keypoints_give_no_matches() -> None:
    matches = match_nearby_frames(["a"] * 5, lambda frame: (np.zeros((0, 2)), np.zeros((0, 64), np.float32)))
    assert len(matches.pair) == len(matches.frame_a) == 0
    assert matches.points_a_px.shape == (0, 2)
