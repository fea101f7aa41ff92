"""One pass of the feature cache over images: find their records on disk, extract what is missing, on all cores."""

from __future__ import annotations

import hashlib
import logging
import os
import random
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.text import Text

from lightning_pose.concurrency.forked_pool import ForkedPool, can_fork
from lightning_pose.concurrency.threads import use_inner_threads
from lightning_pose.errors import CacheError, ImageError
from lightning_pose.features.base import FeatureExtractor, Record
from lightning_pose.features.record_files import DamagedError, read_record, write_record
from lightning_pose.scenes.images import decode_image, read_bytes

__all__ = ["FillJob", "ImagePath", "Visit", "count_cores", "hash_bytes", "make_extraction_bar"]

ImagePath = Path | str
Visit = Callable[[list[int], Record], None]
"""Called with the numbers of all images that have one content, and their record; from several threads."""

BATCH = 8
"""Images per call of `extract`: enough for a GPU, few enough to spread over the cores."""

FORKED = 64
"""Fewer images are extracted by threads: processes have to be started, which takes as long as some of them."""

log = logging.getLogger("lightning_pose")


def hash_bytes(data: bytes, size: int = 20) -> str:
    """BLAKE2b digest of `size` bytes, in hexadecimal digits."""
    return hashlib.blake2b(data, digest_size=size).hexdigest()


def count_cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Extracted(NamedTuple):
    """What came of a batch.

    Attributes:
        computed: keys of the images that were extracted.
        bad: image number to the error of reading the image.
        apart: whether no record was visited.
    """

    computed: set[str]
    bad: dict[int, ImageError]
    apart: bool


@dataclass
class FillJob:
    """One pass over some images: `read` the records that the cache holds, then `extract` the others.

    Attributes:
        extractor: computes the records.
        folder: the cache's folder for this extractor.
        paths: image files.
        visit: called with each record; None where records are only to be in the cache.
        workers: number of threads, or processes.
        numbers: content key to the numbers of all images with that content.
        missing, damaged: keys that must be extracted.
        bad: image number to the error of reading the image.
        computed, redone: extractions done so far, of missing and of damaged ones.
    """

    extractor: FeatureExtractor
    folder: Path
    paths: Sequence[ImagePath]
    visit: Visit | None
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
        """Extract, save and visit all that is missing or damaged, in batches spread over threads or processes.

        Raises:
            CacheError: a process was killed, as happens where memory is short.
        """
        todo = [*self.missing, *self.damaged]
        random.SystemRandom().shuffle(todo)  # so that processes that fill one cache rarely extract the same image
        size = min(BATCH, -(-len(todo) // self.workers))
        batches = [todo[start : start + size] for start in range(0, len(todo), size)]
        with self._start(batches) as futures, make_extraction_bar(progress) as bar:
            task = bar.add_task(f"{self.extractor.name} features", total=len(todo))
            batch_of = dict(zip(futures, batches, strict=True))
            for done in as_completed(futures):
                self._take(batch_of[done], done.result())
                bar.advance(task, len(batch_of[done]))

    @contextmanager
    def _start(self, batches: list[list[str]]) -> Iterator[list[Future[Extracted]]]:
        """Start to extract batches; after an error or Ctrl-C, finish only those under way."""
        workers, images = min(self.workers, len(batches)), sum(map(len, batches))
        forks = self.extractor.holds_interpreter and workers > 1 and images >= FORKED and can_fork()
        fork = ForkedPool(replace(self, visit=None)._extract_batch, workers) if forks else None
        with fork or ThreadPoolExecutor(workers) as pool, use_inner_threads(max(1, self.workers // workers)):
            try:
                # Processes start here, before the bar's thread runs, which may hold the terminal.
                yield _start_forked(fork, batches) if fork else [pool.submit(self._extract_batch, b) for b in batches]
            except BrokenExecutor as error:
                raise CacheError(
                    "a process that extracts features was killed; run the command again, which goes on from here, "
                    "with fewer data.workers if memory is short"
                ) from error
            finally:
                pool.shutdown(cancel_futures=True)

    def _take(self, batch: list[str], extracted: Extracted) -> None:
        """Count what was extracted, and visit the records of other processes."""
        self.computed += len(extracted.computed - self.damaged)
        self.redone += len(extracted.computed & self.damaged)
        self.bad |= extracted.bad
        for key in batch if self.visit is not None and extracted.apart else ():
            if self.numbers[key][0] not in extracted.bad and not self._visit_record(key):
                self.bad |= self._extract_batch([key]).bad  # something has deleted or damaged it meanwhile

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
        if self.visit is not None:
            self.visit(self.numbers[key], record)
        return True

    def _extract_batch(self, batch: list[str]) -> Extracted:
        """Extract one batch, but for what another process has saved meanwhile."""
        images: dict[str, np.ndarray] = {}
        bad: dict[int, ImageError] = {}
        for key in batch:
            if key in self.missing and self._visit_record(key):
                continue
            number = self.numbers[key][0]
            try:
                images[key] = self._read_image(self.paths[number], key)
            except ImageError as error:
                bad[number] = error
        records = self.extractor.extract(list(images.values())) if images else []
        for key, record in zip(images, records, strict=True):
            write_record(self._record_file(key), record, self._record_owner(key))
            if self.visit is not None:
                self.visit(self.numbers[key], record)
        return Extracted(set(images), bad, self.visit is None)

    def _read_image(self, path: ImagePath, key: str) -> np.ndarray:
        """Read an image whose content must still have this key."""
        data = read_bytes(path)
        if hash_bytes(data) != key:
            raise ImageError(f"{path} changed while it was read; run again when nothing writes to it")
        return decode_image(data, path, color=self.extractor.color == "rgb")


def _start_forked(pool: ForkedPool[list[str], Extracted], batches: list[list[str]]) -> list[Future[Extracted]]:
    """Start the processes of a pool, with all batches to do.

    Raises:
        CacheError: they cannot be started.
    """
    try:
        return pool.start(batches)
    except OSError as error:
        raise CacheError(
            f"cannot start processes to extract features ({error.strerror}); set data.workers to 1"
        ) from error


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
