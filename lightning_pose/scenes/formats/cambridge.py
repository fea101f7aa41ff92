"""Cambridge Landmarks (Kendall et al., ICCV 2015): phone images outdoors, posed by structure from motion."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from lightning_pose.errors import DataError
from lightning_pose.scenes.formats.base import SceneFormat, keep_usable
from lightning_pose.scenes.formats.image_files import (
    ImageFinder,
    choose_listed_images,
    has_image_suffix,
    number_images,
    warn_of_unlisted_images,
)
from lightning_pose.scenes.formats.poses import check_quats
from lightning_pose.scenes.formats.text_files import find_column_order, list_files, parse_numbers, read_lines
from lightning_pose.scenes.scene import Frame, Scene

__all__ = ["FORMAT", "Cambridge"]

log = logging.getLogger("lightning_pose")

SPLIT_FILE = re.compile(r"(.*?)[_-]?(train|val|validation|test)\.txt", re.IGNORECASE)
COLUMNS = ("tx", "ty", "tz", "qw", "qx", "qy", "qz")
MAX_DISTANCE_M = 10_000.0
"""Poses farther than this from the median position are dropped."""


class Cambridge(SceneFormat):
    """`dataset_train.txt` and `dataset_test.txt`: header lines, then `image x y z qw qx qy qz`.

    Lists of another name are read as well, such as `chess_train.txt` with `chess_val.txt` or `chess_test.txt`. A `val`
    list without a `test` list is the test split.

    xyz is the camera centre in the world, metres; the quaternion is world-to-camera, w first unless the header gives
    another order, and is inverted here. Lines before the first that names an image are the header; there may be none.
    The image's folder is its sequence. Poses more than 10 km from the median of all positions are errors of the
    reconstruction; they are dropped with a warning.
    """

    name = "cambridge"
    looks_for = "dataset_train.txt and dataset_test.txt"

    def matches(self, root: Path) -> bool:
        return bool(_find_split_files(root))

    def read(self, root: Path) -> Scene:
        files = _find_split_files(root)
        if not files:
            raise DataError(f"{root} has no {self.looks_for}; give both")
        rows = {split: _read_pose_list(file) for split, file in files.items()}
        lists = " or ".join(file.name for file in files.values())
        frames, faults, split_of = _make_frames(root, rows, lists)
        kept = _keep_near_median(root, frames, faults)
        usable, bad = keep_usable([frames[i] for i in kept], [faults[i] for i in kept], lists)
        splits = {
            split: np.array([i for i, frame in enumerate(usable) if split_of[frame.image] == split], dtype=int)
            for split in files
        }
        return Scene(root.resolve().name, root, self.name, usable, splits, ground_truth="sfm", bad_frames=bad)


FORMAT = Cambridge()


class PoseRow(NamedTuple):
    """A line of a list: the image as listed, the seven numbers of its pose (NaN if unreadable), its place and fault."""

    image: str
    numbers: np.ndarray
    place: str
    fault: str


def _find_split_files(root: Path) -> dict[str, Path]:
    """The lists of a folder by split, `train` and `test` and perhaps `val`; none without the first two."""
    lists: dict[str, dict[str, Path]] = {}
    for path in list_files(root) if root.is_dir() else []:
        found = SPLIT_FILE.fullmatch(path.name)
        if found and path.is_file():
            split = "val" if found[2].lower() == "validation" else found[2].lower()
            lists.setdefault(found[1].lower(), {})[split] = path
    for prefix in sorted(lists, key=lambda prefix: prefix != "dataset"):
        files = lists[prefix]
        if "test" not in files and "val" in files:
            files["test"] = files.pop("val")
        if {"train", "test"} <= set(files) and (prefix == "dataset" or _lists_poses(files["train"])):
            return {split: files[split] for split in ("train", "test", "val") if split in files}
    return {}


def _lists_poses(path: Path) -> bool:
    """Whether a text file has a line of an image's path and seven numbers."""
    try:
        rows = (_parse_pose_row(line, "") for _, line in read_lines(path))
        return any(not row.fault and has_image_suffix(row.image) for row in rows)
    except DataError:
        return False


def _read_pose_list(path: Path) -> list[PoseRow]:
    """Read the rows of a split's file."""
    rows: list[PoseRow] = []
    order = list(range(7))
    for number, line in read_lines(path, comments=True):
        row = _parse_pose_row(line, f"{path}:{number}")
        if line.startswith("#") or (not rows and row.fault and not has_image_suffix(re.split(r"[\s,;]+", line)[0])):
            words = re.split(r"[\s,;\[\]()]+", line.strip("[]()# "))
            order = find_column_order(words[-7:], COLUMNS) or order
        else:
            rows.append(row._replace(numbers=row.numbers[order]))
    if not rows:
        raise DataError(f"{path} lists no usable frame; the {path.stem.rpartition('_')[2]} split needs at least one")
    return rows


def _parse_pose_row(line: str, place: str) -> PoseRow:
    """Read `image x y z qw qx qy qz`, separated by blanks, tabs or commas; blanks in the image's path are kept."""
    tokens = re.split(r"([\s,;]+)", line)
    image = "".join(tokens[:-14]).strip("\"' ")
    try:
        numbers = parse_numbers(" ".join(tokens[-13::2]), 7)
        if not image or not np.isfinite(numbers).all() or (" " in image and not has_image_suffix(image)):
            raise ValueError(image)
    except ValueError:
        fault = f"{place}: expected `image x y z qw qx qy qz`, found `{line[:200]}`; correct the line"
        return PoseRow(re.split(r"[\s,;]+", line)[0], np.full(7, np.nan), place, fault)
    return PoseRow(image, numbers, place, "")


def _make_frames(
    root: Path, rows: dict[str, list[PoseRow]], lists: str
) -> tuple[list[Frame], list[str], dict[Path, str]]:
    """Make the frames of both lists, with the fault of each, and find the split of each image."""
    listed = [(split, row) for split, split_rows in rows.items() for row in split_rows]
    finder = ImageFinder(root)
    images = [finder.find(row.image) for _, row in listed]
    finder.warn(lists)
    warn_of_unlisted_images(images, lists)
    split_of: dict[Path, str] = {}
    for image, (split, row) in zip(images, listed, strict=True):
        if image in split_of:
            raise DataError(f"{row.place}: {row.image} is listed twice; an image belongs once to one split")
        split_of[image] = split
    numbers = np.array([row.numbers for _, row in listed])
    position_m, quats, found = check_quats(numbers[:, :3], numbers[:, 3:], scalar_first=True)
    quats = Rotation.from_quat(quats, scalar_first=True).inv().as_quat(canonical=True, scalar_first=True)
    sequences = [_find_image_folder(root, image) for image in images]
    indices = _number_frames(sequences, images)
    read = choose_listed_images(images)
    chosen = [i for i, image in enumerate(images) if image in read]
    frames = [Frame(images[i], position_m[i], quats[i], sequences[i], indices[i]) for i in chosen]
    faults = [listed[i][1].fault or (found[i] and f"{listed[i][1].place}: {found[i]}") for i in chosen]
    return frames, faults, split_of


def _number_frames(sequences: Sequence[str], images: Sequence[Path]) -> list[int]:
    """The number of each image in its sequence."""
    indices = [0] * len(images)
    for sequence in set(sequences):
        members = [i for i, name in enumerate(sequences) if name == sequence]
        for i, index in zip(members, number_images([images[i].name for i in members]), strict=True):
            indices[i] = index
    return indices


def _keep_near_median(root: Path, frames: Sequence[Frame], faults: Sequence[str]) -> list[int]:
    """Rows with a fault, and those within MAX_DISTANCE_M of the median position; warn if others are dropped."""
    sound = [frame.position_m for frame, fault in zip(frames, faults, strict=True) if not fault]
    middle = np.median(sound, axis=0) if sound else np.zeros(3)
    kept = [
        i for i, frame in enumerate(frames) if faults[i] or np.linalg.norm(frame.position_m - middle) <= MAX_DISTANCE_M
    ]
    if len(kept) < len(frames):
        dropped = len(frames) - len(kept)
        log.warning("%s: dropped %d of %d frames, posed more than 10 km off", root, dropped, len(frames))
    return kept


def _find_image_folder(root: Path, image: Path) -> str:
    """The sequence of an image: its folder under the root, or the root's name."""
    folder = image.parent.relative_to(root).as_posix() if image.is_relative_to(root) else image.parent.as_posix()
    return root.resolve().name if folder == "." else folder
