"""The motion between two views of points at known positions."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from lightning_pose.geometry.quaternions import orientation_error_deg, quat_normalize, quat_to_matrix
from lightning_pose.geometry.two_view import MIN_INLIERS, two_view_motion

FOCAL_PX = 500.0


def two_views(position: list[float], quat_wxyz: torch.Tensor, count: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """(N, 2) normalised image points in camera a, at the origin, and in camera b, at this pose."""
    rng = np.random.default_rng(0)
    points_m = np.column_stack([rng.uniform(-2, 2, count), rng.uniform(-2, 2, count), rng.uniform(4, 9, count)])
    R = quat_to_matrix(quat_wxyz).numpy()
    seen_by_b = (points_m - np.array(position)) @ R  # row by row R^T (x - c)
    return points_m[:, :2] / points_m[:, 2:], seen_by_b[:, :2] / seen_by_b[:, 2:]


@pytest.mark.parametrize("position", [[0.5, 0.0, 0.0], [-0.5, 0.1, 0.0], [0.0, 0.0, 0.6], [0.1, 0.2, -0.4]])
def test_the_pose_of_the_second_camera_but_for_its_scale(position: list[float]) -> None:
    quat_wxyz = quat_normalize(torch.tensor([1.0, 0.05, 0.15, -0.08], dtype=torch.float64))
    found = two_view_motion(*two_views(position, quat_wxyz), FOCAL_PX)
    assert found is not None
    np.testing.assert_allclose(found[0], np.array(position) / np.linalg.norm(position), atol=0.01)
    assert orientation_error_deg(found[1], quat_wxyz) < 0.2


def test_too_few_matches_give_no_motion() -> None:
    views = two_views([0.5, 0.0, 0.0], torch.tensor([1.0, 0, 0, 0], dtype=torch.float64), MIN_INLIERS - 1)
    assert two_view_motion(*views, FOCAL_PX) is None
