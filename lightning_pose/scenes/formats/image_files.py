"""Finds the image files that a dataset lists, and numbers them by their names."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import TypeVar

from lightning_pose.errors import DataError
from lightning_pose.scenes.formats.text_files import list_files

__all__ = [
    "IMAGE_SUFFIXES",
    "ImageFinder",
    "choose_images",
    "choose_listed_images",
    "has_image_suffix",
    "is_file",
    "make_natural_key",
    "number_images",
    "parse_image_line",
    "warn_of_unlisted_images",
]

log = logging.getLogger("lightning_pose")
Key = TypeVar("Key")

IMAGE_SUFFIXES = (".png", ".tif", ".tiff", ".bmp", ".ppm", ".pgm", ".webp", ".jpg", ".jpeg", ".jp2")
"""Suffixes of images, in lower case. Of several files of one image, that with the first of these is read."""

IMAGE_FOLDERS = ("rgb", "images", "image", "color", "colour", "cam0/data", "mav0/cam0/data", "data")
"""Folders where an image is looked for that is listed without a folder."""

MAX_LINE = 1000
"""A longer line of an image list is no path."""

MAX_INDEX_DIGITS = 9
"""A longer number in an image's name is a time, not the number of a frame."""


def has_image_suffix(name: str) -> bool:
    """Whether a file's name ends in the suffix of an image, in upper or lower case."""
    return name.lower().endswith(IMAGE_SUFFIXES)


def make_natural_key(text: str) -> list[tuple[int, str]]:
    """Key for sorting by the numbers in a text: `seq2` comes before `seq10`."""
    digits = ((part, part.lstrip("0")) for part in re.split(r"([0-9]+)", text))
    return [(len(number), number) if part[:1].isdecimal() else (-1, part) for part, number in digits]


def choose_images(candidates: Mapping[Key, Sequence[Path]]) -> dict[Key, Path]:
    """One image of each frame: of several, that with the first suffix of `IMAGE_SUFFIXES`, with a warning."""
    chosen = {key: min(paths, key=_rank_image) for key, paths in candidates.items()}
    several = [key for key, paths in candidates.items() if len(paths) > 1]
    if several:
        kept = chosen[several[0]]
        other = next(path for path in candidates[several[0]] if path != kept)
        log.warning(
            "%s: %d frames have several images; %s is read, not %s (png before other lossless files, jpg last); "
            "remove what you do not want",
            kept.parent,
            len(several),
            kept.name,
            other.name,
        )
    return chosen


def choose_listed_images(images: Iterable[Path]) -> set[Path]:
    """The images of a list without the second file of an image, such as `1.jpg` beside `1.png`."""
    files: dict[Path, list[Path]] = {}
    for image in dict.fromkeys(images):
        files.setdefault(image.with_suffix("") if has_image_suffix(image.name) else image, []).append(image)
    return set(choose_images(files).values())


def parse_image_line(line: str) -> tuple[str, str]:
    """The number or time of an image, and its path, from a line of an image list.

    A line is `number path`, or `number path number path`, as the TUM benchmark's association tool writes it. Of two
    paths, the colour image is recognised by its name or folder (`rgb/1.png`, `depth/1.png`), in either order.

    Raises:
        DataError: two images are listed and neither is named as colour or depth.
        ValueError: the line is of another kind.
    """
    pair = (
        None
        if len(line) > MAX_LINE
        else re.fullmatch(r"(\S+?)[\s,;]+(\S.*?\.\w+)[\s,;]+([\d.eE+-]+)[\s,;]+(\S.*\.\w+)", line)
    )
    if pair is not None and has_image_suffix(pair[2]) and has_image_suffix(pair[4]):
        kinds = _find_kinds(pair[2], pair[4])
        if kinds[0] == kinds[1]:
            raise DataError(
                f"`{line}` lists two images, and their names do not say which is colour; call the folders rgb and depth"
            )
        first = kinds[0] == "colour" or kinds[1] == "depth"
        return (pair[1], pair[2]) if first else (pair[3], pair[4])
    number, path = re.split(r"[\s,;]+", line, maxsplit=1)
    return number, path.strip("\"' ")


class ImageFinder:
    """Finds listed images under a folder, also if the list differs in its separators, folders, case or extension.

    Args:
        root: the scene's folder.

    Attributes:
        moved: images that are not where they are listed: what is listed, and what was found.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.moved: list[tuple[str, Path]] = []
        self._listings: dict[Path, dict[str, list[Path]]] = {}
        self._found: dict[Path, str] = {}

    def find(self, listed: str) -> Path:
        """The image file that is listed; `root / listed` if there is none."""
        exact = self.root / listed
        if is_file(exact):
            return exact
        for folder, name in self._list_places(listed):
            path = self._look_up(folder, name)
            if path is not None and self._found.setdefault(path, listed) == listed:
                self.moved.append((listed, path))
                return path
        return exact

    def warn(self, list_name: str) -> None:
        """Log a warning that names the images that are not where they are listed, if there are any."""
        if self.moved:
            listed, path = self.moved[0]
            log.warning(
                "%s: %d images are not as listed; for %s, %s is read; correct the list",
                self.root / list_name,
                len(self.moved),
                listed,
                path.relative_to(self.root),
            )

    def _list_places(self, listed: str) -> Iterable[tuple[Path, str]]:
        """Folders and names under which the image may be."""
        parts = [part for part in PurePosixPath(listed.replace("\\", "/")).parts if part not in ("/", ".", "..")]
        if not parts or len(listed) > MAX_LINE:
            return
        *folders, name = parts
        yield self._enter(folders), name
        if not folders:
            yield from ((self.root / folder, name) for folder in IMAGE_FOLDERS)
        elif not _is_folder(self._enter(folders[:1])):  # the path of another machine
            yield from ((self._enter(folders[i:]), name) for i in range(1, len(parts)))

    def _enter(self, folders: Sequence[str]) -> Path:
        """The folder at the end of a path below the root, in upper or lower case."""
        here = self.root
        for name in folders:
            inside = self._list(here).get(name.lower(), [])
            here = next((path for path in inside if path.name == name), inside[0] if inside else here / name)
        return here

    def _look_up(self, folder: Path, name: str) -> Path | None:
        """The image of that name in a folder, in upper or lower case, or else with another extension."""
        listing = self._list(folder)
        same = listing.get(name.lower()) or [
            path for suffix in IMAGE_SUFFIXES for path in listing.get(f"{_cut_suffix(name)}{suffix}".lower(), [])
        ]
        return next((path for path in same if is_file(path)), None)

    def _list(self, folder: Path) -> dict[str, list[Path]]:
        """The entries of a folder by their names in lower case."""
        if folder not in self._listings:
            listing: dict[str, list[Path]] = {}
            try:
                for path in list_files(folder):
                    listing.setdefault(path.name.lower(), []).append(path)
            except (OSError, ValueError):
                pass
            self._listings[folder] = listing
        return self._listings[folder]


def number_images(names: Sequence[str]) -> list[int]:
    """Number the images of one sequence by their names, so that no two have the same number.

    The number is the one in the name, if the names have one number each, or several of which one alone changes. Where
    no number is different in every name, or a date or a time stands in the names, images are counted in natural order
    from 0.
    """
    numbers = [re.findall(r"[0-9]+", PurePosixPath(name).stem) for name in names]
    if len({len(row) for row in numbers}) == 1 and not any(map(_has_date, names)):
        changing = [column for column in zip(*numbers, strict=True) if len(set(column)) > 1 or len(names) == 1]
        if len(changing) == 1 and max(map(len, changing[0])) <= MAX_INDEX_DIGITS:
            indices = [int(number) for number in changing[0]]
            if len(set(indices)) == len(indices):
                return indices
    order = sorted(range(len(names)), key=lambda i: make_natural_key(names[i]))
    place = {i: rank for rank, i in enumerate(order)}
    return [place[i] for i in range(len(names))]


def warn_of_unlisted_images(listed: Iterable[Path], list_name: str) -> None:
    """Log a warning that counts the images that lie beside the listed ones and are in no list."""
    stems: dict[Path, set[str]] = {}
    for path in listed:
        stems.setdefault(path.parent, set()).add(path.stem.lower())
    for folder, known in stems.items():
        if not _is_folder(folder):
            continue
        images = [path for path in list_files(folder) if has_image_suffix(path.name)]
        left = [path for path in images if path.stem.lower() not in known and _find_kind(path.name) != "depth"]
        if left:
            log.warning(
                "%s: %d of %d images are not in %s and are not used, such as %s; list them, or remove them",
                folder,
                len(left),
                len(images),
                list_name,
                left[0].name,
            )


def is_file(path: Path) -> bool:
    """Whether a file exists; a name that no file can have does not."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def _is_folder(path: Path) -> bool:
    """Whether a folder exists; a name that no folder can have does not."""
    try:
        return path.is_dir()
    except (OSError, ValueError):
        return False


def _rank_image(path: Path) -> tuple[int, str]:
    """The place of an image in the order of preference."""
    suffix = path.suffix.lower()
    return IMAGE_SUFFIXES.index(suffix) if suffix in IMAGE_SUFFIXES else len(IMAGE_SUFFIXES), path.name


def _cut_suffix(name: str) -> str:
    """An image's name without the suffix of an image."""
    return next((name[: -len(suffix)] for suffix in IMAGE_SUFFIXES if name.lower().endswith(suffix)), name)


def _find_kinds(first: str, second: str) -> tuple[str, str]:
    """`depth` or `colour` of two images, by the parts in which their paths differ; empty where these do not say."""
    a, b = first.replace("\\", "/").split("/"), second.replace("\\", "/").split("/")
    while len(a) > 1 and len(b) > 1 and a[0] == b[0]:
        a, b = a[1:], b[1:]
    return _find_kind("/".join(a)), _find_kind("/".join(b))


def _find_kind(path: str) -> str:
    """`depth` or `colour`, if the path of an image has such a word; otherwise empty."""
    if re.search(r"depth|disp", path, re.IGNORECASE):
        return "depth"
    return "colour" if re.search(r"rgb|colou?r|image|gr[ae]y|left|cam", path, re.IGNORECASE) else ""


def _has_date(name: str) -> bool:
    """Whether a name has a date of this century or the last: `20190415` or `2019-04-15`."""
    return bool(re.search(r"(?<!\d)(?:19|20)\d\d([-_.]?)(?:0\d|1[0-2])\1(?:[0-2]\d|3[01])(?!\d)", name))
