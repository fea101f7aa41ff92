"""Tiny datasets on disk for tests: empty image files and poses that can be computed by hand."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

__all__ = ["QUARTER_TURN_Z", "REAL_DATA", "make_image", "write_seven_scenes"]

REAL_DATA = Path(__file__).parents[3] / "shared" / "data"
"""Real datasets beside the checkout, for those who have them; tests that need them are skipped without."""

QUARTER_TURN_Z = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
"""90 degrees about z: the quaternion wxyz (sqrt(1/2), 0, 0, sqrt(1/2))."""


def make_image(path: Path) -> Path:
    """An empty file: the formats do not decode images."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    return path


def write_seven_scenes(root: Path, train: Mapping[int, int], test: Mapping[int, int], suffix: str = "png") -> Path:
    """A folder in 7-Scenes layout; frame i of sequence s stands at (i, s, 0), turned a quarter about z.

    Args:
        root: folder to write.
        train: sequence number -> number of frames.
        test: likewise.
        suffix: of the images.
    """
    root.mkdir(parents=True, exist_ok=True)
    for file, sequences in (("TrainSplit.txt", train), ("TestSplit.txt", test)):
        (root / file).write_text("".join(f"sequence{number}\n" for number in sequences))
        for number, count in sequences.items():
            for i in range(count):
                stem = root / f"seq-{number:02d}" / f"frame-{i:06d}"
                make_image(stem.with_suffix(f".color.{suffix}"))
                T_world_cam = np.eye(4)
                T_world_cam[:3, :3] = QUARTER_TURN_Z
                T_world_cam[:3, 3] = i, number, 0
                np.savetxt(stem.with_suffix(".pose.txt"), T_world_cam, fmt="%.7e")
    return root
