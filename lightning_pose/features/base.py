"""The extractor contract: images in, named arrays out, with settings that key the cache."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from torch import Tensor

from lightning_pose.errors import ConfigError
from lightning_pose.scenes.images import read_gray, read_rgb

__all__ = ["MIN_STORED_FEATURES", "FeatureExtractor", "LocalExtractor", "Record"]

Record = dict[str, np.ndarray]
"""What an extractor computes from one image: arrays by name."""

MIN_STORED_FEATURES = 300
"""The cache keeps at least this many local features, so that a smaller N never extracts again."""


class FeatureExtractor(ABC):
    """Turns images into arrays. Cache, data modules and models use extractors through this class only.

    To add an extractor, subclass it and give

    - `color`: whether `extract` takes `gray` (H, W) or `rgb` (H, W, 3) uint8 images;
    - `primary`: the name of the array that the networks read;
    - `settings`: everything that changes the stored arrays, in plain types (it keys the cache);
    - `version`: of the computation, raised by one when the same settings give other arrays (it keys the cache too);
    - `holds_interpreter`: only where extraction is many short operations, among which Python's threads wait for each
      other; processes are then used on many images;
    - `feature_shape`: the shape that `features` returns for one image, and `dtype` if it is not float32;
    - `extract`: the computation, deterministic, for images that may differ in size;
    - `features`: only where the networks do not read the stored primary array as it is.

    Constructor arguments must be plain types, so that a config file can name the extractor.
    """

    color: ClassVar[Literal["gray", "rgb"]]
    primary: ClassVar[str]
    dtype: ClassVar[type[np.generic]] = np.float32
    version: ClassVar[int] = 1
    holds_interpreter: ClassVar[bool] = False

    @property
    def name(self) -> str:
        """Short lower-case name, used in cache folders, run names and tables."""
        return type(self).__name__.lower()

    @property
    @abstractmethod
    def settings(self) -> Mapping[str, str | int | float | bool | None]:
        """Everything that changes the stored arrays, in plain types."""

    @property
    @abstractmethod
    def feature_shape(self) -> tuple[int, ...]:
        """Shape of one image's features as the networks read them."""

    def shares_records(self, other: FeatureExtractor) -> bool:
        """Whether another extractor computes the same records, of which it may read another part."""
        ours, theirs = ((e.name, e.version, dict(e.settings)) for e in (self, other))
        return type(self) is type(other) and ours == theirs

    def read(self, path: str | Path) -> np.ndarray:
        """Read an image file as `extract` takes it.

        Raises:
            ImageError: the file is missing or cannot be read.
        """
        return read_gray(path) if self.color == "gray" else read_rgb(path)

    @abstractmethod
    def extract(self, images: Sequence[np.ndarray]) -> list[Record]:
        """Compute one record per image."""

    def features(self, record: Record) -> np.ndarray:
        """The array that networks read, of `feature_shape` and `dtype`, from one stored record."""
        return record[self.primary]

    def appearance(self, features: Tensor) -> Tensor:
        """The part of features (B, *feature_shape) that image retrieval compares; here all of it."""
        return features

    def check_mirror(self) -> None:
        """Raise an error if the extractor has no `mirror`.

        Raises:
            ConfigError: the features of a mirrored image cannot be computed from those of the image.
        """
        if type(self).mirror is FeatureExtractor.mirror:
            raise ConfigError(f"data.mirror is on, but {self.name} features cannot be mirrored; turn it off")

    def mirror(self, features: Tensor) -> Tensor:
        """Features (..., *feature_shape) of images mirrored left to right, computed from those of the images."""
        raise NotImplementedError


class LocalExtractor(FeatureExtractor):
    """Base of extractors of keypoints with descriptors, strongest first. Each record holds

    - `descriptors`: (M, D) float32, L2-normalised, sorted by response, zero rows at the end;
    - `keypoints`: (M, 5) float32: x, y, size (pixels), response, angle (degrees), zero rows at the end;
    - `count`: () int64, how many of the M rows are real;
    - `image_size`: (2,) int64, width and height of the image,

    with M = max(n_features, MIN_STORED_FEATURES): the N strongest are a prefix of the M strongest, so
    the cache is shared by every N up to M. `features` cuts the prefix of N rows.

    Args:
        n_features: N, how many of the strongest features the networks read.
        with_geometry: append normalised x, y, log size and response to each descriptor (D + 4 columns).

    Raises:
        ConfigError: n_features is not positive.
    """

    color: ClassVar[Literal["gray", "rgb"]] = "gray"
    primary: ClassVar[str] = "descriptors"
    descriptor_dim: ClassVar[int]

    def __init__(self, n_features: int = 300, with_geometry: bool = False) -> None:
        if n_features < 1:
            raise ConfigError(f"n_features is {n_features}; give the number of features to keep, 1 or more")
        self.n_features = n_features
        self.with_geometry = with_geometry

    @property
    def n_stored(self) -> int:
        """M, the rows kept in the cache."""
        return max(self.n_features, MIN_STORED_FEATURES)

    @property
    def feature_shape(self) -> tuple[int, ...]:
        return self.n_features, self.descriptor_dim + (4 if self.with_geometry else 0)

    def features(self, record: Record) -> np.ndarray:
        """(N, D) descriptors, or (N, D + 4) with x, y in -1..1, log size and response, both scaled.

        Rows past `count` stay zero in every column.
        """
        rows = record["descriptors"][: self.n_features]
        if not self.with_geometry:
            return rows
        return np.concatenate([rows, _compute_geometry(record)[: self.n_features]], axis=1, dtype=np.float32)

    def appearance(self, features: Tensor) -> Tensor:
        """The descriptors without their geometry, whose larger values would outweigh them."""
        return features[..., : self.descriptor_dim]


def _compute_geometry(record: Record) -> np.ndarray:
    """(M, 4) float32: x and y in -1..1 by half the width and height, log size, and log of response by the strongest."""
    x, y, size, response = record["keypoints"][:, :4].T
    real = np.arange(len(x)) < record["count"]
    half_w, half_h = np.maximum(record["image_size"] / 2, 0.5)
    strongest = max(float(response[:1].sum()), np.finfo(np.float32).tiny)
    columns = np.stack(
        [
            x / half_w - 1,
            y / half_h - 1,
            np.log2(np.maximum(size, 1.0) / 16),
            np.log10(np.maximum(response / strongest, 1e-6)) / 2,
        ],
        axis=1,
    )
    return (columns * real[:, None]).astype(np.float32)
