"""Fills the database of a reconstruction in threads: keypoints of frames, and matches of pairs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import TypeVar

import pycolmap

from lightning_pose.reconstruction.database import Features, ImageDatabase
from lightning_pose.reconstruction.keypoints import extract_features
from lightning_pose.reconstruction.matches import verify_pair
from lightning_pose.reconstruction.progress import StepProgress
from lightning_pose.scenes.images import read_gray

__all__ = ["extract_all", "match_all"]

Cameras = tuple[pycolmap.Camera, pycolmap.Camera]
Task = TypeVar("Task")
Result = TypeVar("Result")

CHUNK = 64
"""Frames or pairs that are under way at once, to limit memory, and what is lost when the command is stopped."""


def extract_all(database: ImageDatabase, paths: Sequence[Path], threads: int, progress: StepProgress) -> None:
    """Write the keypoints of the images that have none yet.

    Raises:
        ImageError: an image cannot be read.
    """
    missing = [row for row in range(len(paths)) if not database.has_features(row)]

    def compute(row: int) -> tuple[int, Features]:
        return row, extract_features(read_gray(paths[row]))

    for row, features in progress.track(_run_threads(compute, missing, threads), "finding keypoints", len(missing)):
        database.write_features(row, features)


def match_all(
    database: ImageDatabase, pairs: Sequence[tuple[int, int]], threads: int, step: str, progress: StepProgress
) -> int:
    """Match and verify the pairs that the database does not have yet; return how many of these match."""
    missing = [pair for pair in pairs if not database.has_pair(*pair)]
    read_features = lru_cache(maxsize=4 * CHUNK)(database.read_features)
    read_camera = lru_cache(maxsize=None)(database.read_camera)
    tasks = ((a, b, read_features(a), read_features(b), (read_camera(a), read_camera(b))) for a, b in missing)

    def compute(task: tuple[int, int, Features, Features, Cameras]) -> tuple[int, int, pycolmap.TwoViewGeometry]:
        a, b, first, second, cameras = task
        return a, b, verify_pair(first, second, cameras)

    found = 0
    for a, b, geometry in progress.track(_run_threads(compute, tasks, threads), step, len(missing)):
        database.write_pair(a, b, geometry)
        found += len(geometry.inlier_matches) > 0
    return found


def _run_threads(compute: Callable[[Task], Result], tasks: Iterable[Task], threads: int) -> Iterator[Result]:
    """Results in the order of tasks; the tasks themselves are made by this thread."""
    waiting = iter(tasks)
    with ThreadPoolExecutor(threads) as pool:
        while chunk := list(islice(waiting, CHUNK)):
            yield from pool.map(compute, chunk)
