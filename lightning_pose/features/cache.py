"""The feature cache: each image is extracted once, on all cores, and read from disk afterwards."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import random
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TimeRemainingColumn
from rich.text import Text

from lightning_pose.errors import ConfigError, ImageError
from lightning_pose.features.base import FeatureExtractor, Record
from lightning_pose.features.record_files import (
    TEMPORARY,
    DamagedError,
    read_record,
    write_file_atomically,
    write_record,
)
from lightning_pose.paths import cache_folder
from lightning_pose.scenes.images import decode_image, read_bytes

__all__ = ["FeatureCache", "FillReport"]

ImagePath = Path | str
Visit = Callable[[list[int], Record], None]
"""Called with the numbers of all images that have one content, and their record; from several threads."""

_FORMAT = 1  # raise it when what a record's file holds changes
_BATCH = 8  # images per call of extract: enough for a GPU, few enough to spread over the cores
_CHUNK = 64  # records held in memory while iterating
_STALE_SECONDS = 3600  # the writer of a temporary file this old was killed
_log = logging.getLogger("lightning_pose")


@dataclass(frozen=True)
class FillReport:
    """What one `FeatureCache.fill` did.

    Attributes:
        total: images asked for.
        computed: images extracted because the cache did not hold them.
        cached: images that the cache held, or that equal another one asked for.
        redone: images extracted again because their file in the cache was damaged.
        seconds_per_image: wall time of one extraction with all workers at it; 0 if there was none.
    """

    total: int
    computed: int
    cached: int
    redone: int
    seconds_per_image: float


class FeatureCache:
    """An extractor's records on disk, one safetensors file per image, found by the image's content.

    A file is keyed by the bytes of its image and by the extractor's name and settings:
    `<root>/<name>-<settings>/<ab>/<content>.safetensors`; `settings.json` has the settings in full. A moved or
    renamed dataset is therefore still cached, and different settings have different folders. A process that is
    killed leaves no partial file; each file has a checksum, and a damaged file is written anew. Several processes may
    fill one cache at the same time and share the work.

    `extractor.extract` is called from several threads at a time, with up to 8 images each. (With SURF on two cores,
    processes were a sixth faster than threads once they ran, but took as long to start as 200 images to extract.)

    Args:
        extractor: what computes the records.
        root: folder of all caches; by default `features` in `$LIGHTNING_POSE_CACHE`, or else in the
            user's cache folder, `~/.cache/lightning_pose`.
    """

    def __init__(self, extractor: FeatureExtractor, root: ImagePath | None = None) -> None:
        self.extractor = extractor
        self.root = Path(root).expanduser() if root else cache_folder("features")
        self._about = {"format": _FORMAT, "name": extractor.name, "settings": dict(extractor.settings)}
        canonical = json.dumps(self._about, sort_keys=True, separators=(",", ":"))
        self.folder = self.root / f"{extractor.name}-{_hash_bytes(canonical.encode(), 8)}"

    def fill(self, paths: Sequence[ImagePath], workers: int | None = None, progress: bool = True) -> FillReport:
        """Extract what the cache lacks; a run after an interrupted one continues where that stopped.

        Args:
            paths: image files; equal images are extracted once.
            workers: threads to extract with; by default one for each core this process may use.
            progress: show a bar on stderr while extracting.

        Raises:
            ConfigError: workers is not positive.
            ImageError: some images cannot be read; all others have been saved before.
            CacheError: the cache cannot be written or read.
        """
        return self._visit(paths, lambda numbers, record: None, workers, progress)

    def features(self, paths: Sequence[ImagePath], workers: int | None = None, progress: bool = True) -> np.ndarray:
        """The features that networks read, (len(paths), *extractor.feature_shape) of `extractor.dtype`.

        What the cache lacks is extracted first; arguments and errors are those of `fill`.
        """
        rows = np.empty((len(paths), *self.extractor.feature_shape), self.extractor.dtype)

        def put(numbers: list[int], record: Record) -> None:
            rows[numbers] = self.extractor.features(record)

        self._visit(paths, put, workers, progress)
        return rows

    def records(
        self, paths: Sequence[ImagePath], workers: int | None = None, progress: bool = True
    ) -> Iterator[Record]:
        """Yield the record of each image, in order; only 64 are in memory at a time.

        What the cache lacks is extracted first; arguments and errors are those of `fill`.
        """
        self.fill(paths, workers, progress)
        for start in range(0, len(paths), _CHUNK):
            chunk = paths[start : start + _CHUNK]
            found: dict[int, Record] = {}

            def put(numbers: list[int], record: Record, found: dict[int, Record] = found) -> None:
                found.update(dict.fromkeys(numbers, record))

            self._visit(chunk, put, workers, progress=False)
            yield from (found[number] for number in range(len(chunk)))

    def _visit(self, paths: Sequence[ImagePath], visit: Visit, workers: int | None, progress: bool) -> FillReport:
        """Call `visit` with the record of every distinct image, read from disk or else extracted and saved."""
        if workers is not None and workers < 1:
            raise ConfigError(f"workers is {workers}; give the number of threads to extract with, 1 or more")
        job = _Job(self.extractor, self.folder, paths, visit, workers or _count_cores())
        job.read()
        started = time.perf_counter()
        if job.missing or job.damaged:
            _prepare_folder(self.folder, json.dumps(self._about, indent=2))
            job.extract(progress)
        done = job.computed + job.redone
        if job.bad:
            raise ImageError(_join_errors([job.bad[number] for number in sorted(job.bad)], len(paths)))
        return FillReport(
            total=len(paths),
            computed=job.computed,
            cached=len(paths) - done,
            redone=job.redone,
            seconds_per_image=(time.perf_counter() - started) / done if done else 0.0,
        )


@dataclass
class _Job:
    """One pass over some images: read what the cache holds, extract the rest.

    Attributes:
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
            for number, key in enumerate(pool.map(self._key, range(len(self.paths)))):
                if key:
                    self.numbers.setdefault(key, []).append(number)
            held = list(pool.map(self._held, self.numbers))
        self.missing = {key for key, there in zip(self.numbers, held, strict=True) if not there} - self.damaged

    def extract(self, progress: bool) -> None:
        """Extract, save and visit all that is missing or damaged, in batches spread over the threads."""
        todo = [*self.missing, *self.damaged]
        random.SystemRandom().shuffle(todo)  # so that processes that fill one cache rarely extract the same image
        size = min(_BATCH, -(-len(todo) // self.workers))
        batches = [todo[start : start + size] for start in range(0, len(todo), size)]
        workers = min(self.workers, len(batches))
        with _make_extraction_bar(progress) as bar, _set_inner_threads(max(1, self.workers // workers)):
            task = bar.add_task(f"{self.extractor.name} features", total=len(todo))
            pool = ThreadPoolExecutor(workers)
            try:
                futures = {pool.submit(self._extract, batch): batch for batch in batches}
                for done in as_completed(futures):
                    self.computed += len(done.result() - self.damaged)
                    self.redone += len(done.result() & self.damaged)
                    bar.advance(task, len(futures[done]))
            finally:
                pool.shutdown(cancel_futures=True)  # after an error or Ctrl-C, finish only the batches under way

    def _key(self, number: int) -> str | None:
        try:
            return _hash_bytes(read_bytes(self.paths[number]))
        except ImageError as error:
            self.bad[number] = error
            return None

    def _file(self, key: str) -> Path:
        return self.folder / key[:2] / f"{key}.safetensors"

    def _held(self, key: str) -> bool:
        """Visit the record of `key` if the cache holds it whole."""
        file = self._file(key)
        try:
            record = read_record(file)
        except DamagedError as error:
            _log.warning("%s is damaged (%s); its image is extracted again", file, error)
            self.damaged.add(key)
            return False
        if record is None:
            return False
        self.visit(self.numbers[key], record)
        return True

    def _extract(self, batch: list[str]) -> set[str]:
        """Extract one batch; returns the keys that were computed here."""
        images: dict[str, np.ndarray] = {}
        for key in batch:
            if key in self.missing and self._held(key):
                continue  # another process has saved it meanwhile
            number = self.numbers[key][0]
            try:
                images[key] = self._image(self.paths[number], key)
            except ImageError as error:
                self.bad[number] = error
        records = self.extractor.extract(list(images.values())) if images else []
        for key, record in zip(images, records, strict=True):
            write_record(self._file(key), record)
            self.visit(self.numbers[key], record)
        return set(images)

    def _image(self, path: ImagePath, key: str) -> np.ndarray:
        data = read_bytes(path)
        if _hash_bytes(data) != key:
            raise ImageError(f"{path} changed while it was read; run again when nothing writes to it")
        return decode_image(data, path, color=self.extractor.color == "rgb")


def _prepare_folder(folder: Path, about: str) -> None:
    """Make the folder and its settings.json, and delete temporary files of processes that were killed."""
    write_file_atomically(folder / "settings.json", about.encode())
    for temporary in folder.glob(f"**/*{TEMPORARY}"):
        with suppress(OSError):  # another process may delete it first
            if time.time() - temporary.stat().st_mtime > _STALE_SECONDS:
                temporary.unlink()


def _hash_bytes(data: bytes, size: int = 20) -> str:
    """BLAKE2b digest of `size` bytes, in hexadecimal digits."""
    return hashlib.blake2b(data, digest_size=size).hexdigest()


def _count_cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _join_errors(errors: list[ImageError], total: int) -> str:
    """One message for several images; the first three are named."""
    if len(errors) == 1:
        return str(errors[0])
    named = "; ".join(str(error) for error in errors[:3]) + ("; ..." if len(errors) > 3 else "")
    return f"{len(errors)} of {total} images cannot be read: {named}"


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


def _make_extraction_bar(shown: bool) -> Progress:
    return Progress(
        "{task.description}",
        BarColumn(),
        MofNCompleteColumn(),
        _RateColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        disable=not shown,
    )
