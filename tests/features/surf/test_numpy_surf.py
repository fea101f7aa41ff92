"""SURF in numpy, which exported folders and `check` use, against SURF in torch."""

from __future__ import annotations

import numpy as np
import pytest

from lightning_pose.features import SURF
from lightning_pose.features.surf.numpy_surf import extract_surf


@pytest.fixture(scope="module")
def image() -> np.ndarray:
    rng = np.random.default_rng(0)
    return rng.integers(0, 256, (200, 300), dtype=np.uint8)


@pytest.mark.parametrize("upright", [True, False])
@pytest.mark.parametrize("threshold", [0.0, 1000.0])
def test_keypoints_and_descriptors_are_those_of_torch(image: np.ndarray, upright: bool, threshold: float) -> None:
    (record,) = SURF(300, upright, threshold).extract([image])
    keypoints, descriptors = extract_surf(image, 300, upright, threshold)
    count = int(record["count"])
    assert len(keypoints) == len(descriptors) == count > 30
    np.testing.assert_allclose(keypoints[:, :3], record["keypoints"][:count, :3], atol=1e-3)
    np.testing.assert_allclose(keypoints[:, 3], record["keypoints"][:count, 3], rtol=1e-4)
    turned = np.abs(keypoints[:, 4] - record["keypoints"][:count, 4])
    assert np.minimum(turned, 360 - turned).max() < 0.01
    np.testing.assert_allclose(descriptors, record["descriptors"][:count], atol=0.003)


@pytest.mark.parametrize("shape", [(1, 1), (20, 300), (60, 60)])
def test_images_too_small_or_blank_have_no_features(shape: tuple[int, int]) -> None:
    keypoints, descriptors = extract_surf(np.full(shape, 7, np.uint8), 300, True, 0.0)
    assert keypoints.shape == (0, 5)
    assert descriptors.shape == (0, 64)
