"""Arrays too large for memory: they behave as others, leave no file, and say so where the disk is full."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from lightning_pose.errors import CacheError
from lightning_pose.features import FeatureCache, array_files
from lightning_pose.features.array_files import allocate_rows
from tests.helpers import Thumbnails, limit_file_size


def test_features_from_disk_are_those_from_memory(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    images = sorted(scene.rglob("*.png"))
    cache = FeatureCache(Thumbnails(), tmp_path)
    held = cache.features(images, progress=False)
    before = sorted(tmp_path.rglob("*"))
    monkeypatch.setattr(array_files, "IN_MEMORY_BYTES", held.nbytes - 1)
    mapped = cache.features(images, progress=False)
    assert not isinstance(held, np.memmap)
    assert isinstance(mapped, np.memmap)
    np.testing.assert_array_equal(mapped, held)
    assert sorted(tmp_path.rglob("*")) == before, "the file has no name"
    batch = torch.from_numpy(mapped)[[3, 1]]
    assert batch.equal(torch.from_numpy(held[[3, 1]]))


def test_a_full_disk_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(array_files, "IN_MEMORY_BYTES", 0)
    with (
        limit_file_size(1000),
        pytest.raises(CacheError, match=r"0.0 GiB of features .* cannot be written to .*free some"),
    ):
        allocate_rows((1000, 10), np.float32, tmp_path)
