"""One pass of the feature cache over images: find their records on disk, extract what is missing, with threads."""

from __future__ import annotations

import hashlib
import logging
import os
import random
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.text import Text

from lightning_pose.errors import ImageError
from lightning_pose.features.base import FeatureExtractor, Record
from lightning_pose.features.record_files import DamagedError, read_record, write_record
from lightning_pose.scenes.images import decode_image, read_bytes

__all__ = ["FillJob", "ImagePath", "Visit", "count_cores", "hash_bytes", "make_extraction_bar"]

ImagePath = Path | str
Visit = Callable[[list[int], Record], None]
"""Called with the numbers of all images that have one content, and their record; from several threads."""

BATCH = 8
"""Images per call of `extract`: enough for a GPU, few enough to spread over the cores."""

log = logging.getLogger("lightning_pose")


def hash_bytes(data: bytes, size: int = 20) -> str:
    """BLAKE2b digest of `size` bytes, in hexadecimal digits."""
    return hashlib.blake2b(data, digest_size=size).hexdigest()


def count_cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass
class FillJob:
    """One pass over some images: `read` the records that the cache holds, then `extract` the others.

    Attributes:
        extractor: computes the records.
        folder: the cache's folder for this extractor.
        paths: image files.
        visit: called with each record.
        workers: number of threads.
        numbers: content key to the numbers of all images with that content.
        missing, damaged: keys that must be extracted.
        bad: image number to the error of reading the image.
        computed, redone: extractions done so far, of missing and of damaged ones.
    """

    extractor: FeatureExtractor
    folder: Path
    paths: Sequence[ImagePath]
    visit: Visit
    workers: int
    numbers: dict[str, list[int]] = field(default_factory=dict)
    missing: set[str] = field(default_factory=set)
    damaged: set[str] = field(default_factory=set)
    bad: dict[int, ImageError] = field(default_factory=dict)
    computed: int = 0
    redone: int = 0

    def read(self) -> None:
        """Find each image's key, visit the records that the cache holds, and note those to extract."""
        with ThreadPoolExecutor(self.workers) as pool:
            for number, key in enumerate(pool.map(self._compute_key, range(len(self.paths)))):
                if key:
                    self.numbers.setdefault(key, []).append(number)
            held = list(pool.map(self._visit_record, self.numbers))
        self.missing = {key for key, there in zip(self.numbers, held, strict=True) if not there} - self.damaged

    def extract(self, progress: bool) -> None:
        """Extract, save and visit all that is missing or damaged, in batches spread over the threads."""
        todo = [*self.missing, *self.damaged]
        random.SystemRandom().shuffle(todo)  # so that processes that fill one cache rarely extract the same image
        size = min(BATCH, -(-len(todo) // self.workers))
        batches = [todo[start : start + size] for start in range(0, len(todo), size)]
        workers = min(self.workers, len(batches))
        with make_extraction_bar(progress) as bar, _set_inner_threads(max(1, self.workers // workers)):
            task = bar.add_task(f"{self.extractor.name} features", total=len(todo))
            pool = ThreadPoolExecutor(workers)
            try:
                futures = {pool.submit(self._extract_batch, batch): batch for batch in batches}
                for done in as_completed(futures):
                    self.computed += len(done.result() - self.damaged)
                    self.redone += len(done.result() & self.damaged)
                    bar.advance(task, len(futures[done]))
            finally:
                pool.shutdown(cancel_futures=True)  # after an error or Ctrl-C, finish only the batches under way

    def _compute_key(self, number: int) -> str | None:
        """Digest of an image file's content; None if it cannot be read, which is noted in `bad`."""
        try:
            return hash_bytes(read_bytes(self.paths[number]))
        except ImageError as error:
            self.bad[number] = error
            return None

    def _record_file(self, key: str) -> Path:
        """The file of a key's record."""
        return self.folder / key[:2] / f"{key}.safetensors"

    def _record_owner(self, key: str) -> str:
        """Whose record a key's file holds: extractor and settings, and the image."""
        return f"{self.folder.name}/{key}"

    def _visit_record(self, key: str) -> bool:
        """Read and visit the record of a key; return False if the cache has none or a damaged one."""
        file = self._record_file(key)
        try:
            record = read_record(file, self._record_owner(key))
        except DamagedError as error:
            log.warning("%s is damaged (%s); its image is extracted again", file, error)
            self.damaged.add(key)
            return False
        if record is None:
            return False
        self.visit(self.numbers[key], record)
        return True

    def _extract_batch(self, batch: list[str]) -> set[str]:
        """Extract one batch; returns the keys that were computed here."""
        images: dict[str, np.ndarray] = {}
        for key in batch:
            if key in self.missing and self._visit_record(key):
                continue  # another process has saved it meanwhile
            number = self.numbers[key][0]
            try:
                images[key] = self._read_image(self.paths[number], key)
            except ImageError as error:
                self.bad[number] = error
        records = self.extractor.extract(list(images.values())) if images else []
        for key, record in zip(images, records, strict=True):
            write_record(self._record_file(key), record, self._record_owner(key))
            self.visit(self.numbers[key], record)
        return set(images)

    def _read_image(self, path: ImagePath, key: str) -> np.ndarray:
        """Read an image whose content must still have this key."""
        data = read_bytes(path)
        if hash_bytes(data) != key:
            raise ImageError(f"{path} changed while it was read; run again when nothing writes to it")
        return decode_image(data, path, color=self.extractor.color == "rgb")


@contextmanager
def _set_inner_threads(count: int) -> Iterator[None]:
    """Set the number of threads that torch and OpenCV start inside each thread of ours, and restore it afterwards."""
    before = torch.get_num_threads(), cv2.getNumThreads()
    torch.set_num_threads(count)
    cv2.setNumThreads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before[0])
        cv2.setNumThreads(before[1])


class _RateColumn(ProgressColumn):
    """Shows images per second."""

    def render(self, task: Task) -> Text:
        return Text(f"{task.speed:.1f} images/s" if task.speed else "", style="progress.data.speed")


def make_extraction_bar(shown: bool) -> Progress:
    """A progress bar on stderr, with images per second."""
    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        _RateColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        disable=not shown,
    )
