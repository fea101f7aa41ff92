"""Locates many image files at once: on threads of this process, or on the workers of a Dask cluster."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial

from lightning_pose.concurrency.tasks import run_tasks
from lightning_pose.errors import ConfigError, ImageError
from lightning_pose.geometry.camera import Camera
from lightning_pose.localization.localizer import Localizer
from lightning_pose.localization.located_pose import LocatedPose, refuse_image

__all__ = ["ModelSource", "locate_file", "locate_files"]

PER_TASK = 16


@dataclass(frozen=True)
class ModelSource:
    """A model that another process loads: arguments of `Localizer.load`."""

    model: str
    allow: tuple[str, ...] = ()
    tracking_uri: str | None = None


def locate_file(localizer: Localizer, camera: Camera | None, path: str) -> LocatedPose:
    """The pose of an image file, refused where the file cannot be read."""
    try:
        return localizer.localize(path, camera)
    except (ImageError, ConfigError) as error:
        return refuse_image(path, str(error))


def locate_files(
    model: Localizer | ModelSource,
    camera: Camera | None,
    paths: Iterable[str],
    workers: int | None = None,
    scheduler: str | None = None,
) -> Iterator[LocatedPose]:
    """Locate image files independently of each other.

    Args:
        model: with a scheduler, what its workers load, each once.
        camera: of all images; the model's if None.
        paths: of the files; with a scheduler, under the same path for all workers.
        workers: as for `run_tasks`.
        scheduler: likewise.

    Yields:
        Poses, in the order of the paths.

    Raises:
        ConfigError: as `run_tasks`.
    """
    listed = list(paths)
    chunks = [listed[start : start + PER_TASK] for start in range(0, len(listed), PER_TASK)]
    early: dict[int, list[LocatedPose]] = {}
    following = 0
    for number, poses in run_tasks(partial(_locate_chunk, model, camera), chunks, workers, scheduler):
        early[number] = poses
        while following in early:
            yield from early.pop(following)
            following += 1


def _locate_chunk(model: Localizer | ModelSource, camera: Camera | None, paths: Sequence[str]) -> list[LocatedPose]:
    localizer = _load_once(model) if isinstance(model, ModelSource) else model
    return [locate_file(localizer, camera, path) for path in paths]


@cache
def _load_once(source: ModelSource) -> Localizer:
    """The model, which a worker process keeps."""
    return Localizer.load(source.model, source.allow, source.tracking_uri)
