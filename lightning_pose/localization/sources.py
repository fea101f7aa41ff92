"""What `localize` is asked to locate: image files, folders, patterns, videos, cameras, and paths on standard input."""

from __future__ import annotations

import glob
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

from lightning_pose.errors import ConfigError
from lightning_pose.localization.inputs import is_video
from lightning_pose.scenes.formats.image_files import has_image_suffix, make_natural_key

__all__ = ["ImageFiles", "VideoSource", "find_sources"]


@dataclass(frozen=True)
class ImageFiles:
    """Image files in order.

    Attributes:
        paths: of the files; read once.
        count: how many, or None if that is not known beforehand.
    """

    paths: Iterable[str]
    count: int | None


@dataclass(frozen=True)
class VideoSource:
    """A video file, or the index of a camera of this computer."""

    source: str | int


def find_sources(words: Sequence[str], stdin: TextIO) -> list[ImageFiles | VideoSource]:
    """What the words of a command line name, in their order; neighbouring image files are one.

    Args:
        words: paths of images, folders and videos, patterns such as `*.jpg`, `camera:0`, or `-` for one path a line
            of `stdin`.
        stdin: is read when its images are.

    Raises:
        ConfigError: a path does not exist, a folder has no images, or a pattern matches nothing.
    """
    found: list[ImageFiles | VideoSource] = []
    for word in words:
        camera = re.fullmatch(r"camera:(\d+)", word)
        if camera:
            found.append(VideoSource(int(camera[1])))
        elif word == "-":
            found.append(ImageFiles(_read_lines(stdin), None))
        else:
            for path in _expand(word):
                _add_path(found, path)
    return found


def _add_path(found: list[ImageFiles | VideoSource], path: Path) -> None:
    if path.is_dir():
        images = _list_folder(path)
        found.append(ImageFiles(images, len(images)))
    elif is_video(path):
        found.append(VideoSource(str(path)))
    elif found and isinstance(found[-1], ImageFiles) and isinstance(found[-1].paths, list):
        found[-1] = ImageFiles([*found[-1].paths, str(path)], len(found[-1].paths) + 1)
    else:
        found.append(ImageFiles([str(path)], 1))


def _expand(word: str) -> list[Path]:
    """The path that a word names, or those that it matches.

    Raises:
        ConfigError: there is none.
    """
    path = Path(word).expanduser()
    if path.exists():
        return [path]
    if not glob.has_magic(word):
        raise ConfigError(f"{word} does not exist; give images, folders, videos, camera:0, or - for paths on stdin")
    # `Path.glob` takes no absolute pattern.
    matches = sorted(glob.glob(str(path), recursive=True), key=make_natural_key)  # noqa: PTH207
    if not matches:
        raise ConfigError(f"{word} matches no file; check the pattern")
    return [Path(match) for match in matches]


def _list_folder(folder: Path) -> list[str]:
    """The images in a folder in natural order, without those that are named as depth images.

    Raises:
        ConfigError: it has none.
    """
    names = [path for path in folder.iterdir() if has_image_suffix(path.name) and path.is_file()]
    images = [str(path) for path in names if "depth" not in path.name.lower()]
    if not images:
        inner = sorted(path.name for path in folder.iterdir() if path.is_dir())
        remedy = f"give one of its folders, such as {folder / inner[0]}" if inner else "give a folder with images"
        raise ConfigError(f"{folder} has no images; {remedy}")
    return sorted(images, key=make_natural_key)


def _read_lines(stdin: TextIO) -> Iterator[str]:
    """Paths, one a line; empty lines are passed over."""
    for line in stdin:
        path = line.rstrip("\r\n")
        if path:
            yield path
