"""Cambridge Landmarks (Kendall et al., ICCV 2015): phone images outdoors, posed by structure from motion."""

from __future__ import annotations

import logging
import re
from pathlib import Path, PurePosixPath

import numpy as np
from scipy.spatial.transform import Rotation

from lightning_pose.errors import DataError
from lightning_pose.scenes.formats.base import SceneFormat, read_lines, require_images, sort_frames, unit_quats
from lightning_pose.scenes.scene import Frame, Scene

__all__ = ["FORMAT", "Cambridge"]

log = logging.getLogger("lightning_pose")

SPLIT_FILES = {"train": "dataset_train.txt", "test": "dataset_test.txt"}
HEADER_LINES = 3
MAX_DISTANCE_M = 10_000.0
"""Poses farther than this from the median position are dropped."""


class Cambridge(SceneFormat):
    """`dataset_train.txt` and `dataset_test.txt`: three header lines, then `image x y z qw qx qy qz`.

    xyz is the camera centre in the world, metres; the quaternion is world-to-camera, w first, and is
    inverted here. The image's folder is its sequence. Poses more than 10 km from the median of all
    positions are errors of the reconstruction; they are dropped with a warning.
    """

    name = "cambridge"
    looks_for = "dataset_train.txt and dataset_test.txt"

    def matches(self, root: Path) -> bool:
        return all((root / file).is_file() for file in SPLIT_FILES.values())

    def read(self, root: Path) -> Scene:
        rows = {split: _read_pose_list(root / file) for split, file in SPLIT_FILES.items()}
        frames, split_of = _make_frames(root, rows)
        splits = {
            split: np.array([i for i, frame in enumerate(frames) if split_of[frame.image] == split], dtype=int)
            for split in SPLIT_FILES
        }
        for split, file in SPLIT_FILES.items():
            if not len(splits[split]):
                raise DataError(f"{root / file} lists no usable frame; the {split} split needs at least one")
        return Scene(root.resolve().name, root, self.name, frames, splits, ground_truth="sfm")


FORMAT = Cambridge()

Row = tuple[str, list[float], str]
"""An image, its seven numbers, and its place in the file."""


def _read_pose_list(path: Path) -> list[Row]:
    """Read the rows of a split's file."""
    rows = []
    for number, line in read_lines(path):
        if number <= HEADER_LINES:
            continue
        image, *items = line.split()
        try:
            pose = [float(item) for item in items]
        except ValueError:
            pose = []
        if len(pose) != 7 or not np.isfinite(pose).all():
            raise DataError(
                f"{path}:{number}: expected `image x y z qw qx qy qz` after {HEADER_LINES} header lines, "
                f"found `{line}`; correct the line"
            )
        rows.append((image, pose, f"{path}:{number}"))
    return rows


def _make_frames(root: Path, rows: dict[str, list[Row]]) -> tuple[tuple[Frame, ...], dict[Path, str]]:
    """Make the frames of both lists, sorted, and find the split of each image."""
    split_of: dict[Path, str] = {}
    for split, listed in rows.items():
        for image, _, place in listed:
            if root / image in split_of:
                raise DataError(f"{place}: {image} is listed twice; an image belongs once to one split")
            split_of[root / image] = split
    listed = [row for split_rows in rows.values() for row in split_rows]
    poses = np.array([pose for _, pose, _ in listed]).reshape(-1, 7)
    quats = unit_quats(poses[:, 3:], [place for *_, place in listed], scalar_first=True)
    quats = Rotation.from_quat(quats, scalar_first=True).inv().as_quat(canonical=True, scalar_first=True)
    kept = _keep_near_median(root, poses[:, :3])
    frames = [Frame(root / listed[i][0], poses[i, :3], quats[i], *_parse_image_path(root, listed[i][0])) for i in kept]
    require_images((frame.image for frame in frames), " or ".join(SPLIT_FILES.values()))
    return sort_frames(frames), split_of


def _keep_near_median(root: Path, positions_m: np.ndarray) -> np.ndarray:
    """Rows within MAX_DISTANCE_M of the median position; warn if others are dropped."""
    if not len(positions_m):
        return np.array([], dtype=int)
    distance = np.linalg.norm(positions_m - np.median(positions_m, axis=0), axis=1)
    kept = np.flatnonzero(distance <= MAX_DISTANCE_M)
    if len(kept) < len(positions_m):
        dropped = len(positions_m) - len(kept)
        log.warning("%s: dropped %d of %d frames, posed more than 10 km off", root, dropped, len(positions_m))
    return kept


def _parse_image_path(root: Path, image: str) -> tuple[str, int]:
    """Sequence and frame number of an image path: `seq1`, 12 of `seq1/frame00012.png`."""
    path = PurePosixPath(image)
    number = re.search(r"\d+", path.stem)
    folder = path.parent.as_posix()
    return (root.resolve().name if folder == "." else folder), int(number[0]) if number else 0
