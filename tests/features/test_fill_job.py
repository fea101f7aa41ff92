"""Filling the cache by forked processes: the same records as threads write, and errors that say what to do."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from lightning_pose.concurrency.forked_pool import can_fork
from lightning_pose.errors import CacheError, ImageError
from lightning_pose.features import fill_job
from lightning_pose.features.base import Record
from lightning_pose.features.cache import FeatureCache
from tests.features.helpers import ColorMeans, expected, records_in, write_images


class HeldColorMeans(ColorMeans):
    """Is taken to hold the interpreter, so that processes extract; `deadly` kills them."""

    holds_interpreter = True
    deadly = False

    def extract(self, images: Sequence[np.ndarray]) -> list[Record]:
        if self.deadly:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().extract(images)


@pytest.fixture
def forked(monkeypatch: pytest.MonkeyPatch) -> None:
    if not can_fork():
        pytest.skip("processes cannot be forked here")
    monkeypatch.setattr(fill_job, "FORKED", 4)


@pytest.mark.usefixtures("forked")
def test_processes_extract_what_threads_do(tmp_path: Path) -> None:
    paths = write_images(tmp_path / "images", 30)
    extractor = HeldColorMeans()
    cache = FeatureCache(extractor, tmp_path / "cache")
    np.testing.assert_array_equal(cache.features(paths, workers=3, progress=False), expected(30))
    assert not extractor.seen, "this process has extracted nothing"
    cache.fill(paths[:20], workers=2, progress=False)
    records_in(tmp_path / "cache")[0].write_bytes(b"damaged")
    report = FeatureCache(extractor, tmp_path / "cache").fill(paths, workers=2, progress=False)
    assert (report.total, report.computed, report.cached, report.redone) == (30, 0, 29, 1)


@pytest.mark.usefixtures("forked")
def test_processes_count_and_save_all_but_bad_images(tmp_path: Path) -> None:
    paths = write_images(tmp_path / "images", 30)
    paths[7].write_bytes(b"no image")
    cache = FeatureCache(HeldColorMeans(), tmp_path / "cache")
    with pytest.raises(ImageError, match=r"007\.png"):
        cache.fill(paths, workers=2, progress=False)
    assert len(records_in(tmp_path / "cache")) == 29
    good = paths[:7] + paths[8:]
    assert cache.fill(good, workers=2, progress=False).cached == 29


@pytest.mark.usefixtures("forked")
def test_a_killed_process_has_a_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = write_images(tmp_path / "images", 30)
    extractor = HeldColorMeans()
    monkeypatch.setattr(extractor, "deadly", True)
    with pytest.raises(CacheError, match=r"was killed; run the command again, .* with fewer data.workers"):
        FeatureCache(extractor, tmp_path / "cache").fill(paths, workers=2, progress=False)


@pytest.mark.usefixtures("forked")
def test_processes_that_cannot_start_have_a_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths, fork, started = write_images(tmp_path / "images", 30), os.fork, list[int]()

    def fork_once() -> int:
        if started:
            raise BlockingIOError(11, "Resource temporarily unavailable")
        started.append(1)
        return fork()

    monkeypatch.setattr(os, "fork", fork_once)
    message = r"cannot start processes .* \(Resource temporarily unavailable\); set data.workers to 1"
    with pytest.raises(CacheError, match=message):
        FeatureCache(HeldColorMeans(), tmp_path / "cache").fill(paths, workers=2, progress=False)
    for child in multiprocessing.active_children():
        child.join(timeout=30)
    assert not multiprocessing.active_children()


@pytest.mark.parametrize("readable", [True, False])
def test_a_record_that_is_gone_is_extracted_here_or_its_image_is_bad(readable: bool, tmp_path: Path) -> None:
    paths, seen = write_images(tmp_path / "images", 1), list[int]()
    job = fill_job.FillJob(ColorMeans(), tmp_path, paths, lambda numbers, record: seen.extend(numbers), workers=2)
    job.read()
    (key,) = job.missing
    if not readable:
        paths[0].write_bytes(b"no image")
    job._take([key], fill_job.Extracted({key}, {}, apart=True))
    assert (seen, [*job.bad]) == (([0], []) if readable else ([], [0]))
