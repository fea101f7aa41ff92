"""The feature cache: each image is extracted once, on all cores, and read from disk afterwards."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lightning_pose.errors import ConfigError, ImageError
from lightning_pose.features.array_files import allocate_rows
from lightning_pose.features.base import FeatureExtractor, Record
from lightning_pose.features.fill_job import FillJob, ImagePath, Visit, count_cores, hash_bytes
from lightning_pose.features.record_files import TEMPORARY, write_file_atomically
from lightning_pose.paths import cache_folder
from lightning_pose.scenes.images import DECODING_VERSION

__all__ = ["FeatureCache", "FillReport"]

_FORMAT = 1  # raise it when what a record's file holds changes
_CHUNK = 64  # records held in memory while iterating
_STALE_SECONDS = 3600  # the writer of a temporary file this old was killed


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

    A file is keyed by the bytes of its image, the version of their decoding, and the extractor's name, version and
    settings: `<root>/<name>-<settings>/<ab>/<content>.safetensors`; `settings.json` has the settings in full. A moved
    or renamed dataset is therefore still cached, and different settings have different folders. A process that is
    killed leaves no partial file; each file has a checksum, and a damaged file is written anew. Several processes may
    fill one cache at the same time and share the work.

    `extractor.extract` is called from several threads at a time, with up to 8 images each; of extractors that hold the
    interpreter, and many images, from processes that are forked off this one.

    Args:
        extractor: what computes the records.
        root: folder of all caches; by default `features` in `$LIGHTNING_POSE_CACHE`, or else in the
            user's cache folder, `~/.cache/lightning_pose`.
    """

    def __init__(self, extractor: FeatureExtractor, root: ImagePath | None = None) -> None:
        self.extractor = extractor
        self.root = Path(root).expanduser() if root else cache_folder("features")
        self._about = {
            "format": _FORMAT,
            "name": extractor.name,
            "version": extractor.version,
            "decoding": DECODING_VERSION,
            "settings": dict(extractor.settings),
        }
        canonical = json.dumps(self._about, sort_keys=True, separators=(",", ":"))
        self.folder = self.root / f"{extractor.name}-{hash_bytes(canonical.encode(), 8)}"

    def fill(self, paths: Sequence[ImagePath], workers: int | None = None, progress: bool = True) -> FillReport:
        """Extract what the cache lacks; a run after an interrupted one continues where that stopped.

        Args:
            paths: image files; equal images are extracted once.
            workers: threads or processes to extract with; by default one for each core this process may use.
            progress: show a bar on stderr while extracting.

        Raises:
            ConfigError: workers is not positive.
            ImageError: some images cannot be read; all others have been saved before.
            CacheError: the cache cannot be written or read.
        """
        return self._visit(paths, None, workers, progress)

    def features(self, paths: Sequence[ImagePath], workers: int | None = None, progress: bool = True) -> np.ndarray:
        """The features that networks read, (len(paths), *extractor.feature_shape) of `extractor.dtype`.

        More than a gibibyte of them is mapped from a temporary file in the cache's folder instead of held in memory.
        What the cache lacks is extracted first; arguments and errors are those of `fill`.

        Raises:
            ImageError: also where features are not finite numbers.
        """
        rows = allocate_rows((len(paths), *self.extractor.feature_shape), self.extractor.dtype, self.folder)
        bad: list[int] = []

        def put(numbers: list[int], record: Record) -> None:
            rows[numbers] = features = self.extractor.features(record)
            if not np.isfinite(features).all():
                bad.extend(numbers)

        self._visit(paths, put, workers, progress)
        if bad:
            named = ", ".join(str(paths[number]) for number in sorted(bad)[:3]) + (", ..." if len(bad) > 3 else "")
            raise ImageError(
                f"{len(bad)} of {len(paths)} images have {self.extractor.name} features that are not finite numbers: "
                f"{named}; check the extractor's weights, or leave these images out"
            )
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

    def _visit(
        self, paths: Sequence[ImagePath], visit: Visit | None, workers: int | None, progress: bool
    ) -> FillReport:
        """Call `visit` with the record of every distinct image, read from disk or else extracted and saved."""
        if workers is not None and workers < 1:
            raise ConfigError(
                f"workers is {workers}; give the number of threads or processes to extract with, 1 or more"
            )
        job = FillJob(self.extractor, self.folder, paths, visit, workers or count_cores())
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


def _prepare_folder(folder: Path, about: str) -> None:
    """Make the folder and its settings.json, and delete temporary files of processes that were killed."""
    write_file_atomically(folder / "settings.json", about.encode())
    for temporary in folder.glob(f"**/*{TEMPORARY}"):
        with suppress(OSError):  # another process may delete it first
            if time.time() - temporary.stat().st_mtime > _STALE_SECONDS:
                temporary.unlink()


def _join_errors(errors: list[ImageError], total: int) -> str:
    """One message for several images; the first three are named."""
    if len(errors) == 1:
        return str(errors[0])
    named = "; ".join(str(error) for error in errors[:3]) + ("; ..." if len(errors) > 3 else "")
    return f"{len(errors)} of {total} images cannot be read: {named}"
