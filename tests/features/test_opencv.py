"""Tests of the extractors of OpenCV's four kinds of features."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest

from lightning_pose.features.base import LocalExtractor
from lightning_pose.features.opencv import AKAZE, BRIEF, FREAK, ORB, SIFT

DIMS = {SIFT: 128, ORB: 256, AKAZE: 486, FREAK: 512, BRIEF: 256}
BINARY = (ORB, AKAZE, FREAK, BRIEF)


def texture(seed: int = 0, height: int = 240, width: int = 320) -> np.ndarray:
    rng = np.random.default_rng(seed)
    noise = rng.integers(0, 256, (height // 4, width // 4), np.uint8)
    return cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)


@pytest.fixture(params=DIMS, ids=lambda kind: kind.__name__)
def kind(request: pytest.FixtureRequest) -> type[LocalExtractor]:
    return request.param


def test_record(kind: type[LocalExtractor]) -> None:
    extractor = kind(50)
    (record,) = extractor.extract([texture()])
    assert {name: (a.dtype, a.shape) for name, a in record.items()} == {
        "descriptors": (np.float32, (300, DIMS[kind])),
        "keypoints": (np.float32, (300, 5)),
        "count": (np.int64, ()),
        "image_size": (np.int64, (2,)),
    }
    count = int(record["count"])
    assert count > 100
    np.testing.assert_array_equal(record["image_size"], (320, 240))
    np.testing.assert_allclose(np.linalg.norm(record["descriptors"][:count], axis=1), 1, atol=1e-5)
    assert not record["descriptors"][count:].any()
    assert not record["keypoints"][count:].any()
    x, y, size, response, angle = record["keypoints"][:count].T
    assert np.all(np.diff(response) <= 0)
    assert np.all((x >= 0) & (x < 320) & (y >= 0) & (y < 240) & (size > 0))
    assert np.all((angle >= 0) & (angle <= 360))
    assert extractor.features(record).shape == extractor.feature_shape == (50, DIMS[kind])


def test_fewer_are_a_prefix_of_more(kind: type[LocalExtractor]) -> None:
    few, many = kind(50), kind(300)
    image = texture()
    np.testing.assert_array_equal(few.features(few.extract([image])[0]), many.features(many.extract([image])[0])[:50])
    assert few.settings == many.settings


@pytest.mark.parametrize("kind", [SIFT, FREAK, BRIEF])
def test_prefix_holds_beyond_the_stored_minimum(kind: type[LocalExtractor]) -> None:
    (few,), (many,) = kind(300).extract([texture()]), kind(400).extract([texture()])
    assert many["count"] > 300
    np.testing.assert_array_equal(few["keypoints"], many["keypoints"][:300])
    np.testing.assert_array_equal(few["descriptors"], many["descriptors"][:300])


def test_same_on_any_threads(kind: type[LocalExtractor]) -> None:
    extractor = kind()
    images = [texture(seed) for seed in range(4)]
    alone = extractor.extract(images)
    with ThreadPoolExecutor(4) as pool:
        apart = [records[0] for records in pool.map(lambda image: extractor.extract([image]), images)]
    for one, other in zip(alone, apart, strict=True):
        for name, array in one.items():
            np.testing.assert_array_equal(array, other[name])


@pytest.mark.parametrize("shape", [(240, 320), (40, 40), (7, 300), (1, 1)])
def test_blank_and_tiny_images_are_all_zeros(kind: type[LocalExtractor], shape: tuple[int, int]) -> None:
    (record,) = kind().extract([np.full(shape, 90, np.uint8)])
    assert record["count"] == 0
    assert not record["descriptors"].any()
    assert not record["keypoints"].any()
    np.testing.assert_array_equal(record["image_size"], shape[::-1])


def test_no_image(kind: type[LocalExtractor]) -> None:
    assert kind().extract([]) == []


@pytest.mark.parametrize("kind", BINARY)
def test_bits_keep_hamming_distance(kind: type[LocalExtractor]) -> None:
    """Bits are -1 or +1 before normalising, so squared distance is 4/D of the number of bits that differ."""
    (record,) = kind().extract([texture()])
    a, b = record["descriptors"][:2]
    scale = np.float32(1 / np.sqrt(DIMS[kind]))
    np.testing.assert_allclose(np.abs(a), scale, rtol=1e-6)
    assert np.sum((a - b) ** 2) == pytest.approx(4 / DIMS[kind] * np.sum(a != b), rel=1e-5)


def test_sift_is_opencv_s() -> None:
    image = texture()
    (record,) = SIFT().extract([image])
    keypoints, descriptors = cv2.SIFT.create().detectAndCompute(image, None)
    strongest = max(range(len(keypoints)), key=lambda i: keypoints[i].response)
    np.testing.assert_allclose(record["keypoints"][0, :2], keypoints[strongest].pt)
    np.testing.assert_allclose(
        record["descriptors"][0], descriptors[strongest] / np.linalg.norm(descriptors[strongest]), atol=1e-6
    )


@pytest.mark.parametrize(
    ("strict", "lax"),
    [
        (SIFT(contrast_threshold=0.1), SIFT(contrast_threshold=0.01)),
        (ORB(fast_threshold=60), ORB(fast_threshold=5)),
        (FREAK(fast_threshold=60), FREAK(fast_threshold=5)),
        (BRIEF(fast_threshold=60), BRIEF(fast_threshold=5)),
    ],
    ids=lambda extractor: extractor.name,
)
def test_threshold(strict: LocalExtractor, lax: LocalExtractor) -> None:
    image = texture(height=120, width=160) // 4 + 90
    assert strict.settings != lax.settings
    assert strict.extract([image])[0]["count"] < lax.extract([image])[0]["count"]


def test_upright_brief_has_no_angle() -> None:
    (record,) = BRIEF().extract([texture()])
    assert not record["keypoints"][:, 4].any()
