"""Interpolated poses: SciPy's slerp, order and repeated times, and no pose where there is none to be known."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from lightning_pose.geometry.interpolation import interpolate_poses


def make_trajectory(poses: int = 12) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    times = 1.6e9 + np.cumsum(rng.uniform(0.01, 0.2, poses))
    return (
        times,
        rng.normal(size=(poses, 3)),
        Rotation.random(poses, rng=np.random.default_rng(1)).as_quat(scalar_first=True),
    )


def angle_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(
        (Rotation.from_quat(a, scalar_first=True).inv() * Rotation.from_quat(b, scalar_first=True)).magnitude()
    )


def test_agrees_with_scipy_whatever_the_signs_and_the_order() -> None:
    times, positions, quats = make_trajectory()
    at = np.linspace(times[0], times[-1], 50)
    expected = Slerp(times, Rotation.from_quat(quats, scalar_first=True))(at).as_quat(scalar_first=True)
    order = np.random.default_rng(2).permutation(len(times))
    signs = np.where(np.arange(len(times)) % 2, 1.0, -1.0)[:, None]
    position, quat = interpolate_poses(times[order], positions[order], (signs * quats)[order], at)
    np.testing.assert_allclose(position, np.stack([np.interp(at, times, axis) for axis in positions.T], axis=1))
    np.testing.assert_allclose(angle_deg(quat, expected), 0, atol=1e-5)
    assert (quat[:, 0] >= 0).all()


def test_at_the_poses_times_it_gives_the_poses() -> None:
    times, positions, quats = make_trajectory()
    position, quat = interpolate_poses(times, positions, quats, times)
    np.testing.assert_allclose(position, positions)
    np.testing.assert_allclose(angle_deg(quat, quats), 0, atol=1e-5)


def test_no_pose_outside_the_trajectory_and_in_holes() -> None:
    times = np.array([0.0, 0.1, 3.0, 3.1])
    at = np.array([-0.01, 0.0, 0.05, 1.5, 3.0, 3.1, 3.2])
    position, quat = interpolate_poses(times, np.zeros((4, 3)), np.tile([1.0, 0, 0, 0], (4, 1)), at, max_gap_s=1.0)
    expected = [False, True, True, False, True, True, False]
    assert np.isfinite(position).all(axis=1).tolist() == np.isfinite(quat).all(axis=1).tolist() == expected


def test_unusable_poses_are_left_out_and_of_equal_times_the_first_is_used() -> None:
    times = np.array([0.0, 1.0, 1.0, np.nan, 2.0])
    positions = np.array([[0.0, 0, 0], [np.nan, 0, 0], [1.0, 0, 0], [50.0, 0, 0], [9.0, 0, 0]])
    quats = np.tile([1.0, 0, 0, 0], (5, 1))
    position, _ = interpolate_poses(times, positions, quats, np.array([0.5, 1.0, 1.5]))
    assert position[:, 0].tolist() == [0.5, 1.0, 5.0]
    times[1], positions[1] = 1.0, [2.0, 0, 0]
    assert interpolate_poses(times, positions, quats, np.array([1.0]))[0][0, 0] == 2.0


def test_a_trajectory_without_usable_poses_gives_none() -> None:
    position, quat = interpolate_poses(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 4)), np.array([1.0]))
    assert np.isnan(position).all()
    assert np.isnan(quat).all()
    assert interpolate_poses(np.array([1.0]), np.ones((1, 3)), np.eye(4)[:1], np.array([1.0]))[0].tolist() == [
        [1, 1, 1]
    ]
