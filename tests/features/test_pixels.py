"""Tests of images themselves as features: their size, which part is kept, what retrieval compares."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from lightning_pose.errors import ConfigError, ImageError
from lightning_pose.features import FeatureCache, Pixels
from tests.features.helpers import write_images


def striped(height: int, width: int) -> np.ndarray:
    """Red the row, green the column."""
    image = np.zeros((height, width, 3), np.uint8)
    image[..., 0] = np.arange(height)[:, None]
    image[..., 1] = np.arange(width)
    return image


def test_an_image_of_that_size_is_kept_as_it_is() -> None:
    image = striped(20, 30)
    (record,) = Pixels(20, 30).extract([image])
    np.testing.assert_array_equal(record["pixels"], image.transpose(2, 0, 1))
    assert record["pixels"].dtype == np.uint8


@pytest.mark.parametrize(
    ("height", "width", "row", "column"), [(20, 50, 9.5, 24.5), (60, 30, 29.5, 14.5), (40, 60, 19.5, 29.5)]
)
def test_the_middle_is_kept_of_others(height: int, width: int, row: float, column: float) -> None:
    (record,) = Pixels(20, 30).extract([striped(height, width)])
    assert record["pixels"].shape == (3, 20, 30)
    assert record["pixels"][0].mean() == pytest.approx(row, abs=0.6)
    assert record["pixels"][1].mean() == pytest.approx(column, abs=0.6)


@pytest.mark.parametrize("size", [(7, 5), (480, 640), (641, 479), (1, 1), (3, 900)])
def test_every_size_fits(size: tuple[int, int]) -> None:
    (record,) = Pixels().extract([np.zeros((*size, 3), np.uint8)])
    assert record["pixels"].shape == Pixels().feature_shape == (3, 256, 341)


def test_they_come_back_from_the_cache_as_bytes(tmp_path: Path) -> None:
    paths = write_images(tmp_path / "images", 3)
    cache = FeatureCache(Pixels(16, 16), tmp_path / "cache")
    for _ in range(2):
        features = cache.features(paths)
        assert features.dtype == np.uint8
        assert features.shape == (3, 3, 16, 16)
        assert features.any()


def test_retrieval_compares_what_images_show_and_not_how_bright_they_are() -> None:
    extractor = Pixels(32, 32)
    image = torch.randint(0, 200, (1, 3, 32, 32), dtype=torch.uint8)
    brighter, other = image + 40, torch.randint(0, 200, (1, 3, 32, 32), dtype=torch.uint8)
    own, same, far = (extractor.appearance(each) for each in (image, brighter, other))
    assert own.shape == (1, 1024)
    torch.testing.assert_close(own, same, atol=1e-3, rtol=0)
    assert (own - far).norm() > 10


def test_what_cannot_work_is_refused() -> None:
    with pytest.raises(ConfigError, match="height is 0 and width is 341"):
        Pixels(height=0)
    with pytest.raises(ImageError, match=r"image 1 has shape \(4, 4\)"):
        Pixels().extract([np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4), np.uint8)])
