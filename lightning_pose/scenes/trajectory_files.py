"""TUM trajectory files: `timestamp tx ty tz qx qy qz qw`, one pose per line, as evo and the TUM tools read them."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from lightning_pose.scenes.scene import Frame

__all__ = ["write_sequences", "write_tum"]

log = logging.getLogger("lightning_pose")


def write_tum(
    path: Path,
    timestamps: Sequence[float],
    position_m: np.ndarray,
    quat_wxyz: np.ndarray,
    images: Sequence[str] | None = None,
    refused: np.ndarray | None = None,
) -> None:
    """Write M camera-to-world poses.

    Args:
        path: the file; its folder is made if it is missing.
        timestamps: M seconds.
        position_m: (M, 3).
        quat_wxyz: (M, 4); the file has the scalar last.
        images: M names; each is written as a comment in the line above its pose, which readers of TUM files skip.
        refused: (M,) bool, poses that are left out; a comment says so.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = np.column_stack([timestamps, position_m, np.roll(quat_wxyz, -1, axis=1)])
    with path.open("w", encoding="utf-8") as file:
        file.write("# timestamp tx ty tz qx qy qz qw\n")
        for i, row in enumerate(rows):
            left_out = refused is not None and bool(refused[i])
            if images is not None:
                file.write(f"# {' '.join(images[i].splitlines())}{' refused' * left_out}\n")
            if left_out:
                continue
            file.write(f"{row[0]:.6f} {' '.join(f'{value:.9f}' for value in row[1:])}\n")


def write_sequences(
    folder: Path,
    frames: Iterable[Frame],
    position_m: np.ndarray,
    quat_wxyz: np.ndarray,
    refused: np.ndarray | None = None,
) -> list[Path]:
    """Write the poses of each sequence's frames into `folder/SEQUENCE.tum`, and return the files.

    Above each pose stands the name of its image, relative to the folder that the sequence's images share. If the
    dataset has no times, or if two frames of a sequence have the same time, the numbers of frames are written in place
    of times. Poses that are `refused` (M,) are left out, as `write_tum` does.
    """
    rows: dict[str, list[int]] = {}
    frames = list(frames)
    for i, frame in enumerate(frames):
        rows.setdefault(frame.sequence, []).append(i)
    files = []
    for sequence, members in rows.items():
        files.append(folder / f"{sequence.replace('/', '_')}.tum")
        chosen = [frames[i] for i in members]
        times = _find_times(chosen, sequence)
        left_out = None if refused is None else refused[members]
        write_tum(files[-1], times, position_m[members], quat_wxyz[members], _name_images(chosen), left_out)
    return files


def _find_times(frames: Sequence[Frame], sequence: str) -> list[float]:
    """Seconds; or the frames' numbers where the dataset has no times, or where rounded times are not all different."""
    times = [frame.timestamp for frame in frames if frame.timestamp is not None]
    if len(times) == len(frames) == len({f"{time:.6f}" for time in times}):
        return times
    if len(times) == len(frames):
        log.warning(
            "%s: two frames have the same time; the trajectory has the frames' numbers in place of times", sequence
        )
    return [float(frame.index) for frame in frames]


def _name_images(frames: Sequence[Frame]) -> list[str]:
    """Paths of the images, relative to the folder that they share."""
    shared = Path(os.path.commonpath([frame.image.parent.absolute() for frame in frames]))
    return [frame.image.absolute().relative_to(shared).as_posix() for frame in frames]
