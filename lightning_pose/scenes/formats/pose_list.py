"""`poses.csv`: one image a line with its pose, columns by name. The format to write for data of one's own."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from lightning_pose.errors import DataError
from lightning_pose.scenes.formats.base import SceneFormat, keep_usable
from lightning_pose.scenes.formats.image_files import ImageFinder, number_images
from lightning_pose.scenes.formats.poses import check_quats
from lightning_pose.scenes.formats.text_files import find_column_order, find_file, read_text
from lightning_pose.scenes.scene import SPLITS, Frame, Intrinsics, Scene

__all__ = ["FORMAT", "PoseList"]

POSE_COLUMNS = ("tx", "ty", "tz", "qx", "qy", "qz", "qw")
IMAGE_COLUMNS = ("image", "file", "filename", "file_name", "path", "image_path", "name")
CAMERA_COLUMNS = ("fx", "fy", "cx", "cy")
FORM = "image,tx,ty,tz,qw,qx,qy,qz"


class PoseList(SceneFormat):
    """`poses.csv` with a header such as `image,tx,ty,tz,qw,qx,qy,qz`; columns are in any order.

    The pose is camera-to-world, OpenCV axes, metres; the names of the columns say the order of the quaternion. Further
    columns may be `sequence`, `timestamp` (seconds), `split` (train, val or test) and the camera `fx`, `fy`, `cx`, `cy`
    in pixels, with the centre of the first pixel at (0, 0). Others are not read. Columns are separated by commas,
    semicolons or tabs.
    """

    name = "pose_list"
    looks_for = "poses.csv"

    def matches(self, root: Path) -> bool:
        return find_file(root, "poses.csv").is_file()

    def read(self, root: Path) -> Scene:
        path = find_file(root, "poses.csv")
        rows = _read_rows(path)
        names = [row["image"] for row in rows]
        values = np.array([_parse_row(row, POSE_COLUMNS) for row in rows])
        position_m, quats, found = check_quats(values[:, :3], values[:, 3:], scalar_first=False)
        faults = [wrong and f"{path}:{row['line']}: {wrong}" for row, wrong in zip(rows, found, strict=True)]
        scene_name, finder = root.resolve().name, ImageFinder(root)
        sequences = [row.get("sequence") or scene_name for row in rows]
        index = {}
        for sequence in dict.fromkeys(sequences):
            members = [i for i, name in enumerate(sequences) if name == sequence]
            index |= dict(zip(members, number_images([names[i] for i in members]), strict=True))
        frames = [
            Frame(
                finder.find(names[i]),
                position_m[i],
                quats[i],
                sequences[i],
                index[i],
                _parse_time(row),
                _read_camera(path, row),
            )
            for i, row in enumerate(rows)
        ]
        finder.warn(path.name)
        usable, bad = keep_usable(frames, faults, path.name)
        split_of = {id(frame): row.get("split", "") for frame, row in zip(frames, rows, strict=True)}
        return Scene(
            scene_name, root, self.name, usable, _make_splits([split_of[id(f)] for f in usable]), bad_frames=bad
        )  # fmt: skip


FORMAT = PoseList()


def _read_rows(path: Path) -> list[dict[str, str]]:
    """The rows of the file by the names of columns, those of the pose and the image in their standard form.

    Raises:
        DataError: the header does not name the columns, or a row has another number of them.
    """
    lines = [(number, line) for number, line in enumerate(read_text(path).splitlines(), start=1) if line.strip()]
    if len(lines) < 2:
        raise DataError(f"{path} has {len(lines)} lines; give a header, such as {FORM}, and a line for each image")
    header = lines[0][1].lstrip("# ")
    separator = next((mark for mark in ("\t", ";", ",") if mark in header), ",")
    columns = [name.strip().lower() for name in next(csv.reader([header], delimiter=separator))]
    has_camera = set(CAMERA_COLUMNS) <= set(columns)  # cx and cy may also be the names of a position's columns
    posed = ["" if has_camera and name in CAMERA_COLUMNS else name for name in columns]
    order = find_column_order(posed, POSE_COLUMNS)
    image = [name for name in IMAGE_COLUMNS if name in columns]
    if order is None or not image:
        raise DataError(f"{path}:{lines[0][0]}: the header is `{header[:200]}`; name the columns, such as {FORM}")
    names = list(columns)
    names[columns.index(image[0])] = "image"
    for place, name in zip(order, POSE_COLUMNS, strict=True):
        names[place] = name
    rows = []
    for number, line in lines[1:]:
        if line.lstrip().startswith("#"):
            continue
        cells = [cell.strip() for cell in next(csv.reader([line], delimiter=separator))]
        if len(cells) != len(names):
            raise DataError(f"{path}:{number}: {len(cells)} columns, but the header has {len(names)}; correct the line")
        row = dict(zip(names, cells, strict=True)) | {"line": str(number)}
        if row.get("split") and row["split"] not in SPLITS:
            raise DataError(f"{path}:{number}: the split is {row['split']!r}; give train, val or test")
        rows.append(row)
    return rows


def _parse_row(row: Mapping[str, str], columns: tuple[str, ...]) -> list[float]:
    """Numbers of a row; NaN for what is none."""
    numbers = []
    for name in columns:
        try:
            numbers.append(float(row[name]))
        except ValueError:
            numbers.append(float("nan"))
    return numbers


def _parse_time(row: Mapping[str, str]) -> float | None:
    """The time of a row in seconds, if it has one."""
    value = _parse_row(row, ("timestamp",))[0] if "timestamp" in row else float("nan")
    return value if np.isfinite(value) else None


def _read_camera(path: Path, row: Mapping[str, str]) -> Intrinsics | None:
    """The camera of a row, if the file has its columns."""
    if not all(row.get(name) for name in CAMERA_COLUMNS):
        return None
    fx, fy, cx, cy = _parse_row(row, CAMERA_COLUMNS)
    if not (np.isfinite([fx, fy, cx, cy]).all() and min(fx, fy) > 0):
        raise DataError(f"{path}:{row['line']}: the camera is {fx:g} {fy:g} {cx:g} {cy:g}; give pixels above 0")
    return Intrinsics(fx, fy, cx, cy)


def _make_splits(split_of: list[str]) -> dict[str, np.ndarray]:
    """The splits that the rows name; none if they do not name training and test frames."""
    names = np.array(split_of)
    if not {"train", "test"} <= set(split_of):
        return {}
    splits = {split: np.flatnonzero(names == split) for split in SPLITS}
    return splits if len(splits["val"]) else {"train": splits["train"], "test": splits["test"]}
