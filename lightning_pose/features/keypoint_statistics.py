"""Statistics of the keypoints of a set of images: how many an image has, and how strong they are."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lightning_pose.features.base import Record
from lightning_pose.features.cache import FeatureCache

__all__ = ["FrameKeypoints", "measure_keypoints", "read_frame_keypoints"]

SAMPLE = 100  # images, evenly spread: enough for a histogram, and an image with thousands of descriptors is a megabyte
BINS, RANKS = 25, 100
COUNTS, RESPONSES = "features/count_histogram", "features/response_by_rank"
STATISTICS = {"mean": np.mean, "median": np.median, "min": np.min, "max": np.max}

Curves = dict[str, dict[int, float]]


class FrameKeypoints(NamedTuple):
    """One frame with its keypoints.

    Attributes:
        scene: name of its scene.
        image: its file.
        keypoints: (count, 5): x, y, size, response, angle; strongest first.
    """

    scene: str
    image: Path
    keypoints: np.ndarray


def measure_keypoints(cache: FeatureCache, images: Sequence[Path], most: int) -> tuple[dict[str, float], Curves]:
    """Count the keypoints of up to 100 evenly spread images, and compute their mean responses.

    Args:
        cache: of a `LocalExtractor`.
        images: files, at least one.
        most: the extractor's `n_features`, the largest count that an image can have.

    Returns:
        Metrics: `features/count_mean`, `_median`, `_min` and `_max` of keypoints per image. Curves:
        `features/count_histogram`, the fraction of images by the lowest count of their bin, and
        `features/response_by_rank`, the mean response of the strongest keypoint (1), the second (2), and so on, over
        the images that have so many keypoints.
    """
    chosen = np.unique(np.linspace(0, len(images) - 1, min(SAMPLE, len(images))).round().astype(int))
    # Descriptors are not kept: with thousands of them per image they would fill the memory.
    records = [
        {name: record[name] for name in ("count", "keypoints")}
        for record in cache.records([images[i] for i in chosen], progress=False)
    ]
    counts = np.array([int(record["count"]) for record in records])
    metrics = {f"features/count_{name}": float(compute(counts)) for name, compute in STATISTICS.items()}
    return metrics, {COUNTS: _compute_histogram(counts, most), RESPONSES: _average_responses(records, counts)}


def read_frame_keypoints(cache: FeatureCache, scene: str, images: Sequence[Path]) -> FrameKeypoints:
    """Read the keypoints of the middle one of a scene's images."""
    image = images[len(images) // 2]
    (record,) = cache.records([image], progress=False)
    return FrameKeypoints(scene, image, record["keypoints"][: int(record["count"])])


def _compute_histogram(counts: np.ndarray, most: int) -> dict[int, float]:
    """Fraction of images in bins of equal width from 0 to `most`, by the lower edge of the bin."""
    width = max(1, -(-most // BINS))
    held = np.bincount(counts // width, minlength=most // width + 1)
    return {int(i * width): float(share) for i, share in enumerate(held / len(counts))}


def _average_responses(records: Sequence[Record], counts: np.ndarray) -> dict[int, float]:
    """Mean response of the keypoints of each rank, counted from 1, of the images that have so many keypoints."""
    means = {}
    for rank in range(min(int(counts.max()), RANKS)):
        held = [record["keypoints"][rank, 3] for record, count in zip(records, counts, strict=True) if count > rank]
        means[rank + 1] = float(np.mean(held))
    return means
