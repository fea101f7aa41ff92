"""Similarities that are known are found again; points that leave one open give none."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lightning_pose.geometry.similarity import Similarity

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("count", [3, 4, 50])
def test_a_known_similarity_is_found(count: int) -> None:
    truth = Similarity(0.3, Rotation.from_rotvec([1.0, -2.0, 0.5]).as_matrix(), np.array([10.0, -20, 30]))
    old = RNG.normal(size=(count, 3))
    found = Similarity.fit(old, truth.apply(old))
    assert found is not None
    np.testing.assert_allclose(found.rotation, truth.rotation, atol=1e-9)
    np.testing.assert_allclose(found.shift, truth.shift, atol=1e-9)
    assert found.scale == pytest.approx(0.3)


def test_a_mirrored_world_is_not_matched_by_a_mirror() -> None:
    old = RNG.normal(size=(20, 3))
    found = Similarity.fit(old, old * [1, 1, -1])
    assert found is not None
    assert np.linalg.det(found.rotation) == pytest.approx(1)


def test_noise_leaves_the_scale_unbiased() -> None:
    old = RNG.normal(size=(2000, 3))
    found = Similarity.fit(old, 2 * old + 0.1 * RNG.normal(size=old.shape))
    assert found is not None
    assert found.scale == pytest.approx(2, abs=0.01)


@pytest.mark.parametrize(
    "points", [np.zeros((0, 3)), np.zeros((2, 3)), np.ones((5, 3)), np.arange(5.0)[:, None] * [1.0, 2, 3]]
)
def test_points_on_a_line_leave_the_rotation_open(points: np.ndarray) -> None:
    assert Similarity.fit(points, points) is None
