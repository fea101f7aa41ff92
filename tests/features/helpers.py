"""A cheap extractor and cheap images, for tests of what is done with features."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from lightning_pose.features.base import FeatureExtractor, Record

__all__ = ["ColorMeans", "expected", "records_in", "write_images"]


class ColorMeans(FeatureExtractor):
    """The mean of each channel, times `scale`; counts the images it has seen."""

    color = "rgb"
    primary = "means"

    def __init__(self, scale: float = 1.0, seconds: float = 0.0) -> None:
        self.scale, self.seconds = scale, seconds
        self.seen: list[int] = []

    @property
    def settings(self) -> Mapping[str, str | int | float | bool | None]:
        return {"scale": self.scale}

    @property
    def feature_shape(self) -> tuple[int, ...]:
        return (3,)

    def extract(self, images: Sequence[np.ndarray]) -> list[Record]:
        self.seen.append(len(images))
        time.sleep(self.seconds * len(images))
        return [{"means": np.float32(self.scale) * i.mean(axis=(0, 1), dtype=np.float32)} for i in images]


def write_images(folder: Path, count: int) -> list[Path]:
    """PNG files of 6 x 5 pixels, the n-th filled with RGB (n, 2n, 100)."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{n:03d}.png" for n in range(count)]
    for n, path in enumerate(paths):
        cv2.imwrite(str(path), np.full((5, 6, 3), (100, 2 * n, n), np.uint8))
    return paths


def expected(count: int) -> np.ndarray:
    """Features (count, 3) of the images of `write_images`."""
    n = np.arange(count, dtype=np.float32)
    return np.stack([n, 2 * n, np.full(count, 100, np.float32)], axis=1)


def records_in(root: Path) -> list[Path]:
    """Files of a cache's records."""
    return sorted(root.rglob("*.safetensors"))
