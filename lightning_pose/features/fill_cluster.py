"""Fills a feature cache on the workers of a Dask cluster, which share its folder."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial

from lightning_pose.concurrency.tasks import run_tasks
from lightning_pose.errors import ImageError
from lightning_pose.features.cache import FeatureCache, FillReport
from lightning_pose.features.fill_job import ImagePath, make_extraction_bar

__all__ = ["fill_on_cluster"]

PER_TASK = 64
"""Images per task: seconds of work, of which a killed worker loses what it has under way."""


def fill_on_cluster(
    cache: FeatureCache, paths: Sequence[ImagePath], scheduler: str, workers: int | None = None
) -> FillReport:
    """Extract what the cache lacks, as `FeatureCache.fill`, on a cluster.

    Args:
        cache: in a folder that all workers share.
        paths: image files, under the same path for all workers.
        scheduler: as for `run_tasks`.
        workers: likewise.

    Raises:
        ConfigError: as `run_tasks`.
        ImageError: some images cannot be read; all others have been saved before.
        CacheError: the cache cannot be written or read.
    """
    started = time.perf_counter()
    chunks = [paths[start : start + PER_TASK] for start in range(0, len(paths), PER_TASK)]
    reports, errors = list[FillReport](), dict[int, str]()
    with make_extraction_bar(True) as bar:
        task = bar.add_task(f"{cache.extractor.name} features", total=len(paths))
        for number, done in run_tasks(partial(_fill_chunk, cache), chunks, workers, scheduler):
            bar.advance(task, len(chunks[number]))
            if isinstance(done, FillReport):
                reports.append(done)
            else:
                errors[number] = done
    if errors:
        raise ImageError("; ".join(errors[number] for number in sorted(errors)))
    computed, cached, redone = (sum(getattr(r, name) for r in reports) for name in ("computed", "cached", "redone"))
    seconds = (time.perf_counter() - started) / max(1, computed + redone)
    return FillReport(len(paths), computed, cached, redone, seconds if computed + redone else 0.0)


def _fill_chunk(cache: FeatureCache, paths: Sequence[ImagePath]) -> FillReport | str:
    """Fill the cache for some images; an image that cannot be read must not keep others from being extracted."""
    try:
        return cache.fill(paths, workers=1, progress=False)
    except ImageError as error:
        return str(error)
