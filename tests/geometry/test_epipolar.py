"""Essential matrices and Sampson distances against known values."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from lightning_pose.geometry.epipolar import essential_matrices, sampson_distances_px

FOCAL_PX = 500.0


def project_px(points_m: np.ndarray, rotation: np.ndarray, position_m: np.ndarray) -> np.ndarray:
    """(N, 2) pixels from the principal point, of a camera-to-world pose."""
    local = (points_m - position_m) @ rotation
    return FOCAL_PX * local[:, :2] / local[:, 2:]


def make_two_views() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Essential matrix (1, 3, 3), and 40 points as both cameras see them."""
    rng = np.random.default_rng(0)
    points_m = rng.uniform([-1, -1, 3], [1, 1, 5], (40, 3))
    rotations = Rotation.from_euler("xyz", [[0, 0, 0], [5, -8, 3]], degrees=True).as_matrix()
    positions_m = np.array([[0.0, 0, 0], [0.4, 0.1, -0.2]])
    views = [project_px(points_m, rotations[i], positions_m[i]) for i in (0, 1)]
    essential = essential_matrices(rotations[:1], positions_m[:1], rotations[1:], positions_m[1:])
    return essential, views[0], views[1]


def test_matches_of_the_true_motion_lie_on_their_epipolar_lines() -> None:
    essential, a_px, b_px = make_two_views()
    assert sampson_distances_px(np.repeat(essential, 40, 0), a_px, b_px, FOCAL_PX).max() < 1e-9


def test_essential_matrices_have_two_equal_singular_values_and_a_zero() -> None:
    essential = make_two_views()[0]
    np.testing.assert_allclose(np.linalg.svd(essential[0])[1], [1, 1, 0], atol=1e-12)


def test_a_point_moved_across_its_line_is_that_far_off() -> None:
    # b stands to the right of a: epipolar lines are rows of the images, and both points share the correction.
    eye = np.eye(3)[None]
    essential = essential_matrices(eye, np.zeros((1, 3)), eye, np.array([[1.0, 0, 0]]))
    distance = sampson_distances_px(essential, np.array([[10.0, 5.0]]), np.array([[-30.0, 8.0]]), FOCAL_PX)
    np.testing.assert_allclose(distance, 3 / np.sqrt(2))


def test_cameras_in_one_place_have_no_epipolar_lines() -> None:
    eye = np.eye(3)[None]
    essential = essential_matrices(eye, np.ones((1, 3)), eye, np.ones((1, 3)))
    assert not essential.any()
    assert np.isnan(sampson_distances_px(essential, np.zeros((1, 2)), np.ones((1, 2)), FOCAL_PX)).all()


def test_several_focal_lengths_are_measured_as_one_by_one() -> None:
    essential, a_px, b_px = make_two_views()
    essential, focal_px = np.repeat(essential, 40, 0), np.array([300.0, FOCAL_PX, 900])
    together = sampson_distances_px(essential, a_px, b_px, focal_px)
    assert together.shape == (3, 40)
    assert np.median(together[0]) > 1
    for focal, distances in zip(focal_px, together, strict=True):
        np.testing.assert_array_equal(distances, sampson_distances_px(essential, a_px, b_px, focal))
