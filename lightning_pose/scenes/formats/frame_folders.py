"""Reads folders of `frame-NNNNNN.color.png` and `frame-NNNNNN.pose.txt`, as 7-Scenes and 12-Scenes have them."""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lightning_pose.errors import DataError
from lightning_pose.scenes.formats.image_files import IMAGE_SUFFIXES, choose_images
from lightning_pose.scenes.formats.poses import check_matrices
from lightning_pose.scenes.formats.text_files import list_files, read_matrix

__all__ = ["FrameFolder", "has_posed_frames", "read_frame_folder"]

log = logging.getLogger("lightning_pose")

FRAME_FILE = re.compile(
    rf"frame-(\d{{1,15}})\.(?:(color(?:{'|'.join(map(re.escape, IMAGE_SUFFIXES))}))|(pose\.txt))", re.IGNORECASE
)
USUAL_SUFFIXES = (".png", ".jpg", ".jpeg")


class FrameFolder(NamedTuple):
    """The frames of one folder, by ascending numbers.

    Attributes:
        index: the number of each frame.
        images: N image files.
        position_m: (N, 3).
        quat_wxyz: (N, 4), camera-to-world.
        faults: what is wrong with each frame, beginning with its file; empty if nothing is.
        lost: (N,) whether the pose has infinite or NaN entries, as where tracking was lost.
    """

    index: list[int]
    images: list[Path]
    position_m: np.ndarray
    quat_wxyz: np.ndarray
    faults: list[str]
    lost: np.ndarray


def has_posed_frames(folder: Path) -> bool:
    """Whether a folder has a file `frame-NNNNNN.pose.txt`."""
    return any(match[3] for match in (FRAME_FILE.fullmatch(path.name) for path in folder.iterdir()) if match)


def read_frame_folder(folder: Path) -> FrameFolder:
    """Read the frames of a folder: camera-to-world matrices of 4x4 or 3x4 numbers, beside the images.

    Raises:
        DataError: the folder has no image.
    """
    images: dict[int, list[Path]] = {}
    poses: dict[int, Path] = {}
    for path in list_files(folder):
        if match := FRAME_FILE.fullmatch(path.name):
            if match[2]:
                images.setdefault(int(match[1]), []).append(path)
            else:
                poses.setdefault(int(match[1]), path)
    if not images:
        raise DataError(f"{folder} has no frame-NNNNNN.color.png or .jpg; unpack the images into it")
    image_of = choose_images(images)
    _warn_of_suffixes(list(image_of.values()))
    index = sorted(image_of.keys() | poses.keys())
    _warn_of_holes(folder, index)
    matrices, faults = np.full((len(index), 4, 4), np.nan), []
    for row, number in enumerate(index):
        fault = ""
        if number not in poses:
            fault = f"{image_of[number]} has no .pose.txt beside it; add it or drop the image"
        elif number not in image_of:
            fault = f"{poses[number]} has no image beside it; add it or drop the pose"
        else:
            try:
                matrices[row] = read_matrix(poses[number])
            except (ValueError, DataError) as error:
                fault = f"{poses[number]}: not a 4x4 matrix of numbers ({error}); restore the original"
        faults.append(fault)
    position_m, quat_wxyz, found = check_matrices(matrices)
    lost = np.array([not fault for fault in faults]) & ~np.isfinite(matrices).all(axis=(1, 2))
    faults = [
        fault or (wrong and f"{poses[number]}: {wrong}")
        for number, fault, wrong in zip(index, faults, found, strict=True)
    ]
    paths = [image_of.get(number, folder / f"frame-{number:06d}") for number in index]
    return FrameFolder(index, paths, position_m, quat_wxyz, faults, lost)


def _warn_of_holes(folder: Path, index: list[int]) -> None:
    """Log a warning if the numbers of frames jump by more than their usual step."""
    steps = np.diff(index)
    holes = np.flatnonzero(steps > np.median(steps)) if len(steps) else steps
    if len(holes):
        log.warning(
            "%s: the numbers of frames jump %d times, first from %d to %d; check that no file is missing",
            folder,
            len(holes),
            index[holes[0]],
            index[holes[0] + 1],
        )


def _warn_of_suffixes(images: list[Path]) -> None:
    """Log a warning if images have another extension than 7-Scenes' own, such as `.PNG`."""
    others = [path for path in images if not path.name.endswith(USUAL_SUFFIXES)]
    if others:
        log.warning("%s: %d images are named as %s and are read", others[0].parent, len(others), others[0].name)
