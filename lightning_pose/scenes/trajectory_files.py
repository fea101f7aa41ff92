"""TUM trajectory files: `timestamp tx ty tz qx qy qz qw`, one pose per line, as evo and the TUM tools read them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from lightning_pose.scenes.scene import Frame

__all__ = ["write_sequences", "write_tum"]


def write_tum(path: Path, timestamps: Sequence[float], position_m: np.ndarray, quat_wxyz: np.ndarray) -> None:
    """Write M camera-to-world poses.

    Args:
        path: the file; its folder is made if it is missing.
        timestamps: M seconds.
        position_m: (M, 3).
        quat_wxyz: (M, 4); the file has the scalar last.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = np.column_stack([timestamps, position_m, np.roll(quat_wxyz, -1, axis=1)])
    np.savetxt(path, rows, fmt="%.6f" + " %.9f" * 7, header="timestamp tx ty tz qx qy qz qw")


def write_sequences(folder: Path, frames: Iterable[Frame], position_m: np.ndarray, quat_wxyz: np.ndarray) -> list[Path]:
    """Write the poses of each sequence's frames into `folder/SEQUENCE.tum`, and return the files.

    If the dataset has no times, the number of a frame is written in place of its time.
    """
    rows: dict[str, list[int]] = {}
    frames = list(frames)
    for i, frame in enumerate(frames):
        rows.setdefault(frame.sequence, []).append(i)
    files = []
    for sequence, members in rows.items():
        times = [_find_time(frames[i]) for i in members]
        files.append(folder / f"{sequence.replace('/', '_')}.tum")
        write_tum(files[-1], times, position_m[members], quat_wxyz[members])
    return files


def _find_time(frame: Frame) -> float:
    """Seconds, or the frame's number if the dataset has no times."""
    return float(frame.index) if frame.timestamp is None else frame.timestamp
