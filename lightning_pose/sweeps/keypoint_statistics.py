"""What a study measures of features alone: how many an image has, how strong they are, and where they lie."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lightning_pose.errors import ConfigError
from lightning_pose.features import LocalExtractor
from lightning_pose.features.base import Record
from lightning_pose.sweeps.base_config import ParsedConfig

__all__ = ["FrameKeypoints", "keypoints_of_a_frame", "measure_features"]

SAMPLE = 100  # frames, evenly spread: a histogram needs no more, and thousands of descriptors a frame are a megabyte
BINS, RANKS = 25, 100
COUNTS, RESPONSES = "features/count_histogram", "features/response_by_rank"

Curves = dict[str, dict[int, float]]


class FrameKeypoints(NamedTuple):
    """One frame with its keypoints.

    Attributes:
        scene: name of its scene.
        image: its file.
        keypoints: (count, 5): x, y, size, response, angle, strongest first.
    """

    scene: str
    image: Path
    keypoints: np.ndarray


def measure_features(config: ParsedConfig) -> tuple[dict[str, float], Curves]:
    """Count the features of a config's training images, and weigh them.

    Args:
        config: whose data are meant; its model and trainer serve for nothing.

    Returns:
        Metrics: `features/count_mean`, `_median`, `_min` and `_max` of features an image, at most the extractor's
        `n_features`, which should be large. Curves: `features/count_histogram`, the share of images by the least
        count of their bin, and `features/response_by_rank`, the mean response of the strongest feature (1), the
        second (2), and so on, of images that have as many.

    Raises:
        ConfigError: the extractor finds no keypoints.
    """
    datamodule = _datamodule(config)
    records = _records(datamodule)
    counts = np.array([int(record["count"]) for record in records])
    metrics = {f"features/count_{name}": float(f(counts)) for name, f in _STATISTICS.items()}
    return metrics, {
        COUNTS: _histogram(counts, datamodule.extractor.n_features),
        RESPONSES: _responses(records, counts),
    }


_STATISTICS = {"mean": np.mean, "median": np.median, "min": np.min, "max": np.max}


def keypoints_of_a_frame(config: ParsedConfig) -> FrameKeypoints:
    """The middle one of the training frames, with its keypoints.

    Raises:
        ConfigError: the extractor finds no keypoints.
    """
    datamodule = _datamodule(config)
    images = [datamodule.scene.frames[i].image for i in datamodule.scene.splits["train"]]
    image = images[len(images) // 2]
    (record,) = datamodule.cache.records([image], progress=False)
    return FrameKeypoints(datamodule.scene.name, Path(image), record["keypoints"][: int(record["count"])])


def _datamodule(config: ParsedConfig) -> Any:
    data = config.parser.instantiate_classes(config.config)["data"]
    if not isinstance(data.extractor, LocalExtractor):
        raise ConfigError(f"{data.extractor.name} finds no keypoints; give an extractor that does, such as SURF")
    return data


def _records(datamodule: Any) -> list[Record]:
    frames = datamodule.scene.splits["train"]
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(SAMPLE, len(frames))).round().astype(int))
    images = [datamodule.scene.frames[frames[i]].image for i in chosen]
    # Of each record, what is counted: with thousands of descriptors they would fill the memory.
    return [
        {name: record[name] for name in ("count", "keypoints")}
        for record in datamodule.cache.records(images, progress=False)
    ]


def _histogram(counts: np.ndarray, most: int) -> dict[int, float]:
    """Share of images in equally wide bins up to the most that could be found, by their lower edges."""
    width = max(1, -(-most // BINS))
    held = np.bincount(counts // width, minlength=most // width + 1)
    return {int(i * width): float(share) for i, share in enumerate(held / len(counts))}


def _responses(records: Sequence[Record], counts: np.ndarray) -> dict[int, float]:
    means = {}
    for rank in range(min(int(counts.max()), RANKS)):
        held = [record["keypoints"][rank, 3] for record, count in zip(records, counts, strict=True) if count > rank]
        means[rank + 1] = float(np.mean(held))
    return means
