"""12-Scenes (Valentin et al., 3DV 2016): rooms of two buildings, filmed with a depth camera on a tablet computer."""

from __future__ import annotations

import logging
import re
from pathlib import Path

import numpy as np

from lightning_pose.errors import DataError
from lightning_pose.scenes.formats.base import SceneFormat, keep_usable
from lightning_pose.scenes.formats.frame_folders import read_frame_folder
from lightning_pose.scenes.formats.text_files import find_file, parse_numbers, read_lines
from lightning_pose.scenes.scene import Frame, Intrinsics, Scene

__all__ = ["FORMAT", "TwelveScenes"]

log = logging.getLogger("lightning_pose")

CALIBRATION = "m_calibrationColorIntrinsic"
RANGE = re.compile(r"(\S+)\s*\[\s*frames\s*=.*?start\s*=\s*(\d{1,9})\s*;\s*end\s*=\s*(\d{1,9})\s*\]")


class TwelveScenes(SceneFormat):
    """`split.txt` gives the frames of each sequence, `info.txt` the camera, and `data` holds all frames.

    A line of `split.txt` is `sequence0 [frames=357]  [start=0 ; end=356]`. The first sequence is the test split, the
    others are for training. `data` holds `frame-NNNNNN.color.jpg` and `frame-NNNNNN.pose.txt`, the 4x4
    camera-to-world matrix in metres, OpenCV axes. Frames whose pose has infinite entries were not tracked; they are
    dropped with a count. `info.txt` has the camera matrix as `m_calibrationColorIntrinsic = ` and 16 numbers.
    """

    name = "12scenes"
    looks_for = "split.txt and info.txt"

    def matches(self, root: Path) -> bool:
        return all(find_file(root, file).is_file() for file in ("split.txt", "info.txt"))

    def read(self, root: Path) -> Scene:
        ranges = _read_ranges(find_file(root, "split.txt"))
        intrinsics = _read_camera(find_file(root, "info.txt"))
        listed = read_frame_folder(root / "data" if (root / "data").is_dir() else root)
        sequences = [_find_sequence(index, ranges) for index in listed.index]
        kept = [i for i in range(len(sequences)) if sequences[i] and not listed.lost[i]]
        _warn_of_dropped(root, int(listed.lost.sum()), sequences.count(""), len(sequences))
        frames = [
            Frame(
                listed.images[i],
                listed.position_m[i],
                listed.quat_wxyz[i],
                sequences[i],
                listed.index[i],
                intrinsics=intrinsics,
            )
            for i in kept
        ]
        usable, bad = keep_usable(frames, [listed.faults[i] for i in kept])
        tested = np.array([frame.sequence == next(iter(ranges)) for frame in usable], dtype=bool)
        splits = {"train": np.flatnonzero(~tested), "test": np.flatnonzero(tested)}
        return Scene(root.resolve().name, root, self.name, usable, splits, bad_frames=bad)


FORMAT = TwelveScenes()


def _read_ranges(path: Path) -> dict[str, tuple[int, int]]:
    """The first and the last frame of each sequence, by its name, in the order of the file."""
    ranges: dict[str, tuple[int, int]] = {}
    for number, line in read_lines(path):
        match = RANGE.match(line)
        if match is None or int(match[2]) > int(match[3]) or match[1] in ranges:
            raise DataError(
                f"{path}:{number}: expected `sequenceN [frames=COUNT] [start=FIRST ; end=LAST]`, found `{line[:200]}`; "
                "correct the line"
            )
        ranges[match[1]] = (int(match[2]), int(match[3]))
    if len(ranges) < 2:
        raise DataError(f"{path} lists {len(ranges)} sequences; it needs one to test on and one or more to train on")
    return ranges


def _read_camera(path: Path) -> Intrinsics:
    """The colour camera, in pixels."""
    for number, line in read_lines(path):
        key, _, value = line.partition("=")
        if key.strip() == CALIBRATION:
            try:
                matrix = parse_numbers(value, 16).reshape(4, 4)
            except ValueError:
                matrix = np.zeros((4, 4))
            if np.isfinite(matrix).all() and matrix[0, 0] > 0 and matrix[1, 1] > 0:
                fx, fy, cx, cy = matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
                return Intrinsics(fx, fy, cx, cy)
            raise DataError(f"{path}:{number}: expected 16 numbers of a camera matrix; restore the original")
    raise DataError(f"{path} has no line `{CALIBRATION} = ` with the camera matrix; restore the original")


def _find_sequence(index: int, ranges: dict[str, tuple[int, int]]) -> str:
    """The sequence that a frame belongs to, empty if it is in none."""
    return next((name for name, (first, last) in ranges.items() if first <= index <= last), "")


def _warn_of_dropped(root: Path, lost: int, outside: int, total: int) -> None:
    """Log how many frames are dropped, and why."""
    if lost:
        log.warning("%s: dropped %d of %d frames, poses with infinite entries: not tracked", root, lost, total)
    if outside:
        log.warning("%s: dropped %d of %d frames that are in no sequence of split.txt", root, outside, total)
