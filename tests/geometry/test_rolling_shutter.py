"""Rolling shutters: images of a turning camera, rows one after the other, give its pose and its turn."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from lightning_pose.geometry.absolute_pose import CameraPose, refine_pose
from lightning_pose.geometry.rolling_shutter import refine_turning_pose, remove_rolling

TURN = np.array([0.03, -0.02, 0.05])
TRUE = CameraPose(Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix(), np.array([0.5, -0.3, 0.2]))


def see_turning(count: int = 120) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) in the world, and where a camera at `TRUE` that turns by `TURN` a unit of y sees them."""
    rng = np.random.default_rng(0)
    local = np.column_stack([rng.uniform(-0.6, 0.6, count), rng.uniform(-0.45, 0.45, count), np.ones(count)])
    local *= rng.uniform(2, 4, (count, 1))
    seen = local[:, :2] / local[:, 2:]
    for _ in range(10):  # the row that sees a point depends on where it is seen
        turned = np.einsum("nji,nj->ni", Rotation.from_rotvec(seen[:, 1:] * TURN).as_matrix(), local)
        seen = turned[:, :2] / turned[:, 2:]
    return local @ TRUE.rotation.T + TRUE.position, seen


def test_points_are_where_a_camera_that_stood_still_would_see_them() -> None:
    points, seen = see_turning()
    local = (points - TRUE.position) @ TRUE.rotation
    still = local[:, :2] / local[:, 2:]
    before = np.abs(seen - still).max()
    assert np.abs(remove_rolling(seen, TURN) - still).max() < 0.02 * before
    np.testing.assert_array_equal(remove_rolling(seen, np.zeros(3)), seen)


def test_the_pose_of_a_turning_camera_is_found_with_its_turn() -> None:
    points, seen = see_turning()
    start = CameraPose(TRUE.rotation @ Rotation.from_rotvec([0.02, 0.01, 0]).as_matrix(), TRUE.position + 0.05)
    found = refine_turning_pose(start, points, seen, 0.002, turn_sd=0.03)
    static = refine_pose(start, points, seen, 0.002)
    away, static_away = (np.linalg.norm(each.pose.position - TRUE.position) for each in (found, static))
    assert away < 0.1 * static_away
    np.testing.assert_allclose(found.turn, TURN, atol=0.003)
    assert (np.linalg.eigvalsh(found.normal) > 0).all()


def test_few_points_do_not_make_a_turn() -> None:
    points, seen = see_turning(5)
    found = refine_turning_pose(TRUE, points, seen, 0.002, turn_sd=1e-9)
    np.testing.assert_allclose(found.pose.position, refine_pose(TRUE, points, seen, 0.002).pose.position, atol=1e-4)
