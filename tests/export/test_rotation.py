"""The rotations of exported folders against scipy's."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation as Expected

from lightning_pose.export.runner.rotation import Rotation

ROTVECS = np.concatenate(
    [
        np.random.default_rng(0).normal(0, 1.5, (200, 3)),
        np.zeros((1, 3)),
        np.eye(3) * np.pi,
        np.eye(3) * 1e-9,
        np.array([[np.pi / np.sqrt(2), np.pi / np.sqrt(2), 0], [2.0, -2.0, 1.5]]),
    ]
)


def test_from_and_to_rotation_vectors() -> None:
    expected = Expected.from_rotvec(ROTVECS)
    found = Rotation.from_rotvec(ROTVECS)
    np.testing.assert_allclose(found.as_matrix(), expected.as_matrix(), atol=1e-12)
    back = Rotation.from_matrix(expected.as_matrix()).as_rotvec()
    np.testing.assert_allclose(Expected.from_rotvec(back).as_matrix(), expected.as_matrix(), atol=1e-9)
    assert np.linalg.norm(back, axis=1).max() < np.pi + 1e-9
    np.testing.assert_allclose(Rotation.from_rotvec(ROTVECS[0]).as_matrix(), expected[0].as_matrix(), atol=1e-12)


def test_quaternions() -> None:
    expected = Expected.from_rotvec(ROTVECS)
    found = Rotation.from_matrix(expected.as_matrix()).as_quat(scalar_first=True)
    np.testing.assert_allclose(np.abs((found * expected.as_quat(scalar_first=True)).sum(axis=1)), 1, atol=1e-12)
    assert Rotation.from_matrix(np.eye(3)).as_quat().tolist() == [1, 0, 0, 0]
    canonical = Rotation.from_matrix(expected.as_matrix()).as_quat(canonical=True)
    assert canonical[:, 0].min() >= 0
