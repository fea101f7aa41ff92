"""Tests of the extractors' base classes: prefix, geometry columns, names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

from lightning_pose.errors import ConfigError, ImageError
from lightning_pose.features.base import LocalExtractor, Record
from tests.features.helpers import ColorMeans, write_images


class Three(LocalExtractor):
    """Three known features in an image of 640 x 480, whatever it shows."""

    descriptor_dim = 2

    @property
    def settings(self) -> Mapping[str, str | int | float | bool | None]:
        return {"n_stored": self.n_stored}

    def extract(self, images: Sequence[np.ndarray]) -> list[Record]:
        descriptors = np.zeros((self.n_stored, 2), np.float32)
        keypoints = np.zeros((self.n_stored, 5), np.float32)
        descriptors[:3] = [(1, 0), (0.6, 0.8), (0, 1)]
        keypoints[:3] = [(320, 240, 16, 50, 0), (0, 480, 64, 5, 90), (640, 120, 0.5, 1e-9, 10)]
        size = np.array([640, 480])
        record = {"descriptors": descriptors, "keypoints": keypoints, "count": np.array(3), "image_size": size}
        return [record for _ in images]


IMAGE = np.zeros((480, 640), np.uint8)


def test_features_are_a_prefix_of_what_is_stored() -> None:
    (record,) = Three(300).extract([IMAGE])
    extractor = Three(2)
    assert extractor.feature_shape == (2, 2)
    np.testing.assert_array_equal(extractor.features(record), np.array([(1, 0), (0.6, 0.8)], np.float32))
    assert Three(2).settings == Three(300).settings == {"n_stored": 300}
    assert Three(301).n_stored == 301


def test_geometry_by_hand() -> None:
    """x and y over half the image, minus 1; log2(size / 16); half the log10 of response over the strongest."""
    extractor = Three(5, with_geometry=True)
    features = extractor.features(extractor.extract([IMAGE])[0])
    assert (features.shape, features.dtype) == (extractor.feature_shape, np.float32) == ((5, 6), np.float32)
    expected = np.zeros((5, 6))
    expected[0] = (1, 0, 0, 0, 0, 0)
    expected[1] = (0.6, 0.8, -1, 1, 2, -0.5)
    expected[2] = (0, 1, 1, -0.5, -4, -3)  # size is kept above 1 pixel, response above a millionth
    np.testing.assert_allclose(features, expected, atol=1e-6)


def test_geometry_of_a_blank_image_is_zero() -> None:
    extractor = Three(4, with_geometry=True)
    (record,) = extractor.extract([IMAGE])
    blank = {name: np.zeros_like(array) for name, array in record.items()}
    assert not extractor.features(blank).any()


@pytest.mark.parametrize("n_features", [0, -3])
def test_n_features_must_be_positive(n_features: int) -> None:
    with pytest.raises(ConfigError, match=f"n_features is {n_features}; give"):
        Three(n_features)


def test_name_is_the_class_in_lower_case() -> None:
    assert Three().name == "three"


def test_read_by_color(tmp_path: Path) -> None:
    (path,) = write_images(tmp_path, 1)
    assert Three().read(path).shape == (5, 6)
    assert ColorMeans().read(path).shape == (5, 6, 3)
    with pytest.raises(ImageError, match="does not exist"):
        Three().read(tmp_path / "gone.png")


def test_plain_features_are_the_primary_array() -> None:
    (record,) = ColorMeans().extract([np.full((2, 2, 3), 7, np.uint8)])
    np.testing.assert_array_equal(ColorMeans().features(record), [7, 7, 7])
