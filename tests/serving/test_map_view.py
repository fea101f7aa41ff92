"""The map from above: which way is up, what is drawn, and how much of it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lightning_pose.serving.map_view import MAX_CAMERAS, MAX_POINTS, find_plane, view_from_above

Z_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""Camera-to-world of a camera that looks along y in a world whose z is up."""


@pytest.mark.parametrize("seed", range(5))
def test_up_is_against_the_cameras_down_in_any_world(seed: int) -> None:
    world = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    turns = Rotation.from_euler("z", np.linspace(0, 5, 40)[:, None]).as_matrix()
    right, forward = find_plane(world @ turns @ Z_UP, np.zeros((40, 3)))
    np.testing.assert_allclose(np.cross(right, forward), world @ [0, 0, 1], atol=1e-9)


def test_cameras_in_all_directions_leave_it_to_their_places() -> None:
    rotation = Rotation.random(200, rng=np.random.default_rng(0)).as_matrix()
    position = np.random.default_rng(0).normal(size=(200, 3)) * [3, 0.1, 2]  # flat along y
    assert abs(np.cross(*find_plane(rotation, position))[1]) > 0.99


def test_axes_of_the_world_stay_axes_of_the_page() -> None:
    np.testing.assert_allclose(find_plane(Z_UP[None], np.zeros((1, 3))), [[1, 0, 0], [0, 1, 0]], atol=1e-12)


def test_what_is_drawn() -> None:
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(0, 4, (9000, 3)), [[1e6, 0, 0]]])  # one point is far off
    rotation, position = np.tile(Z_UP, (900, 1, 1)), rng.uniform(1, 3, (900, 3))
    view = view_from_above(points, rotation, position)
    drawn, cameras, box = np.array(view["points"]), np.array(view["cameras"]), view["box"]
    assert 0 < len(drawn) <= MAX_POINTS
    assert 0 < len(cameras) <= MAX_CAMERAS
    np.testing.assert_allclose(cameras[0], [*position[0, :2], 0, 1], atol=1e-3)
    assert isinstance(box, list)
    assert -1 < box[0] < 1 < 3 < box[2] < 5


def test_a_system_without_points_has_its_cameras() -> None:
    view = view_from_above(np.zeros((0, 3)), Z_UP[None], np.ones((1, 3)))
    assert view["points"] == []
    assert view["cameras"] == [[1.0, 1.0, 0.0, 1.0]]
