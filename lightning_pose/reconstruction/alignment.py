"""Makes a scene metric: by one known distance, or by a few known positions."""

from __future__ import annotations

import csv
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np

from lightning_pose.errors import ConfigError, DataError
from lightning_pose.geometry.similarity import Similarity
from lightning_pose.scenes.formats.text_files import find_column_order, read_text

__all__ = ["KnownDistance", "align_positions", "find_frame", "parse_distance", "read_positions", "scale_to_distance"]

POSITION_COLUMNS = ("tx", "ty", "tz")
IMAGE_COLUMNS = ("image", "file", "filename", "file_name", "path", "image_path", "name")
FORM = "image,tx,ty,tz"

NARROW = 0.1
"""Share of their length by which known positions must lie beside the line through them, to fix the rotation well."""

log = logging.getLogger("lightning_pose")


class KnownDistance(NamedTuple):
    """The distance in metres between the camera centres of two frames."""

    first: str
    second: str
    metres: float


def parse_distance(text: str) -> KnownDistance:
    """A known distance from a text `A B METRES`; A and B are names or numbers of frames.

    Raises:
        ConfigError: it has another form.

    >>> parse_distance("img_1.jpg img_9.jpg 2.5").metres
    2.5
    """
    words = text.split()
    try:
        first, second, metres = words[0], words[1], float(words[2])
    except (IndexError, ValueError):
        metres, first, second = 0.0, "", ""
    if len(words) != 3 or not (0 < metres < np.inf) or first == second:
        raise ConfigError(
            f"--scale is {text!r}; give two frames and the distance between their camera centres in metres, such as "
            '--scale "IMG_001.jpg IMG_020.jpg 2.5", or numbers of a video\'s frames, "0 120 2.5"'
        )
    return KnownDistance(first, second, metres)


def read_positions(path: Path) -> dict[str, np.ndarray]:
    """Known camera centres (3,) in metres by image, of a file with a header such as `image,tx,ty,tz`.

    `poses.csv`, as the format of that name has it, serves too; its quaternions are not read.

    Raises:
        DataError: the file is missing, its header does not name the columns, or a row is malformed.
    """
    lines = [(i, line) for i, line in enumerate(read_text(path).splitlines(), start=1) if line.strip()]
    header = lines[0][1].lstrip("# ") if lines else ""
    separator = next((mark for mark in ("\t", ";", ",") if mark in header), ",")
    columns = [name.strip().lower() for name in next(csv.reader([header], delimiter=separator))]
    pixels = {"fx", "fy", "cx", "cy"} <= set(columns)
    order = find_column_order(["" if pixels and c in ("cx", "cy") else c for c in columns], POSITION_COLUMNS)
    image = [name for name in IMAGE_COLUMNS if name in columns]
    if order is None or not image:
        raise DataError(f"{path}: the header is `{header[:200]}`; name the columns, such as {FORM}")
    known = {}
    for number, line in lines[1:]:
        cells = next(csv.reader([line], delimiter=separator))
        try:
            position = np.array([float(cells[i]) for i in order])
            name = cells[columns.index(image[0])].strip()
        except (ValueError, IndexError):
            position, name = np.array([np.nan]), ""
        if not np.isfinite(position).all() or not name:
            raise DataError(f"{path}:{number}: expected `{','.join(columns)}`, found `{line[:200]}`; correct the line")
        known[name] = position
    return known


def find_frame(wanted: str, names: Sequence[str]) -> int | None:
    """The row of a frame by its name, with or without folders and suffix, or by its number; None if there is none.

    >>> find_frame("7", ["frame_000002.jpg", "frame_000007.jpg"])
    1
    """
    path = PurePosixPath(wanted.replace("\\", "/"))
    tests = (
        lambda name: name == wanted or str(path).endswith(f"/{name}") or name.endswith(f"/{path}"),
        lambda name: PurePosixPath(name).name == path.name,
        lambda name: PurePosixPath(name).stem == path.stem,
        lambda name: wanted.isdecimal() and name == f"frame_{int(wanted):06d}.jpg",
    )
    for test in tests:
        rows = [row for row, name in enumerate(names) if test(name)]
        if len(rows) == 1:
            return rows[0]
    return None


def scale_to_distance(known: KnownDistance, centres: Mapping[str, np.ndarray]) -> Similarity:
    """The scale by which two camera centres are as far from each other as they are known to be.

    Args:
        known: the distance.
        centres: (3,) by the names of the frames that have a pose.

    Raises:
        DataError: a frame has no pose, or both have one centre.
    """
    names = list(centres)
    rows = [find_frame(name, names) for name in (known.first, known.second)]
    for name, row in zip((known.first, known.second), rows, strict=True):
        if row is None:
            raise DataError(
                f"--scale: {name} has no pose; give two of the {len(names)} frames that have, {_list(names)}"
            )
    first, second = (centres[names[row]] for row in rows if row is not None)
    distance = float(np.linalg.norm(first - second))
    extent = float(np.ptp(np.array(list(centres.values())), axis=0).max())
    if distance <= 1e-3 * extent:
        raise DataError(
            f"--scale: {known.first} and {known.second} are at one place ({distance / max(extent, 1e-300):.1g} of the "
            "extent); give two frames that are far from each other"
        )
    return Similarity(known.metres / distance, np.eye(3), np.zeros(3))


def align_positions(
    known: Mapping[str, np.ndarray], centres: Mapping[str, np.ndarray]
) -> tuple[Similarity, dict[str, float]]:
    """The similarity that moves camera centres to known positions, and how far each is off afterwards, in metres.

    Args:
        known: (3,) in metres by image.
        centres: (3,) by the names of the frames that have a pose.

    Raises:
        DataError: fewer than three frames are known and have a pose, or all are on one line.
    """
    names = list(centres)
    rows = {wanted: find_frame(wanted, names) for wanted in known}
    used = [wanted for wanted, row in rows.items() if row is not None]
    if len(used) < 3:
        missing = [wanted for wanted, row in rows.items() if row is None]
        raise DataError(
            f"--align: {len(used)} of {len(known)} known positions are of frames with a pose; give three or more"
            + (f" (without a pose: {_list(missing)})" if missing else "")
        )
    old = np.array([centres[names[row]] for row in rows.values() if row is not None])
    new = np.array([known[wanted] for wanted in used])
    found = Similarity.fit(old, new)
    if found is None:
        raise DataError(f"--align: the {len(used)} known positions are on one line; give one that is beside it")
    spread = np.linalg.svd(new - new.mean(axis=0), compute_uv=False)
    if spread[1] < NARROW * spread[0]:
        log.warning(
            "--align: the %d known positions are nearly on one line, so that the rotation about it is uncertain; give "
            "one that is farther beside it",
            len(used),
        )
    errors = np.linalg.norm(found.apply(old) - new, axis=1)
    return found, dict(zip(used, errors.tolist(), strict=True))


def _list(names: Sequence[str]) -> str:
    """The first and the last of some names, for a message."""
    return ", ".join(names) if len(names) <= 3 else f"{names[0]}, {names[1]} ... {names[-1]}"
