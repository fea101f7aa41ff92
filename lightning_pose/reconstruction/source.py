"""Where frames come from: a video file, or a folder of images in the order of their names."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from lightning_pose.errors import DataError
from lightning_pose.paths import replace_file
from lightning_pose.scenes.formats.image_files import has_image_suffix, make_natural_key
from lightning_pose.scenes.images import read_gray
from lightning_pose.scenes.video_files import name_frame, read_video, write_frames

__all__ = ["Source", "open_source"]

NO_COLOUR = re.compile(r"depth|disparity|mask", re.IGNORECASE)
"""Words in the path of an image that is no photo."""


@dataclass(frozen=True)
class Source:
    """Frames that can be read several times.

    Attributes:
        path: the video file, or the folder.
        images: the images of a folder; empty for a video.
        count: how many frames there are; a video's own word, which may be wrong.
    """

    path: Path
    images: tuple[Path, ...]
    count: int

    @property
    def is_video(self) -> bool:
        return not self.images

    def list_facts(self) -> list:
        """What identifies the frames: names, sizes and times of change of the files, in plain types."""
        files = self.images or (self.path,)
        return [[str(file.resolve()), file.stat().st_size, file.stat().st_mtime_ns] for file in files]

    def list_names(self, count: int) -> list[str]:
        """The names that the first so many frames have when they are written."""
        if self.images:
            return [image.relative_to(self.path).as_posix() for image in self.images[:count]]
        return [name_frame(number) for number in range(count)]

    def read_gray(self) -> Iterator[np.ndarray]:
        """All frames in order, (H, W) uint8.

        Raises:
            ImageError: an image of a folder cannot be read.
            DataError: no frame of a video can be read.
        """
        if self.images:
            yield from map(read_gray, self.images)
        else:
            yield from (cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY) for frame in read_video(self.path))

    def write(self, chosen: Collection[int], folder: Path) -> Iterator[str]:
        """Write frames as images below a folder, and yield their names there one by one; files that are there stay.

        Images of a folder are copied with their names; frames of a video are JPEG files, named by their numbers.
        """
        if not self.images:
            yield from (file.name for file in write_frames(self.path, chosen, folder))
            return
        for i in sorted(chosen):
            name = self.images[i].relative_to(self.path).as_posix()
            file = folder / name
            if not file.exists():
                replace_file(file, self.images[i].read_bytes(), file.with_name(f"{file.name}.tmp"))
            yield name


def open_source(path: Path) -> Source:
    """A video file, or a folder with images in it or in folders below it.

    Raises:
        DataError: there is no such file or folder, or no image in it, or the file is no video.
    """
    if path.is_dir():
        images = [file for file in path.rglob("*") if _is_photo(file, path)]
        if not images:
            raise DataError(f"{path} holds no image; give a folder of images, or a video file")
        images.sort(key=lambda file: make_natural_key(file.relative_to(path).as_posix()))
        return Source(path, tuple(images), len(images))
    if not path.is_file():
        raise DataError(f"{path} does not exist; give a video file or a folder of images")
    if has_image_suffix(path.name):
        raise DataError(f"{path} is one image; give a video file or a folder of images")
    capture = cv2.VideoCapture(str(path))
    count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) if capture.isOpened() else 0
    capture.release()
    return Source(path, (), max(count, 0))


def _is_photo(file: Path, root: Path) -> bool:
    """Whether a file below a folder is an image, and neither hidden nor, by its name, one of depths or the like."""
    parts = file.relative_to(root).parts
    if any(part.startswith(".") for part in parts) or not has_image_suffix(file.name) or not file.is_file():
        return False
    return not any(NO_COLOUR.search(part) for part in parts)
