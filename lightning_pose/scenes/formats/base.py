"""The base class of formats on disk, and functions for reading and checking files that several formats use."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from lightning_pose.errors import DataError, ImageError
from lightning_pose.scenes.scene import Frame, Scene

__all__ = [
    "SceneFormat",
    "convert_matrices",
    "make_natural_key",
    "read_lines",
    "read_table",
    "require_images",
    "sort_frames",
    "unit_quats",
]

MAX_SKEW = 1e-2
"""Largest entry of R^T R - 1 that is taken for a rounding error; in 7-Scenes' own poses it is up to 3e-4."""


class SceneFormat(ABC):
    """Reads one layout of posed images; no other code depends on how it is stored on disk.

    To add a format, put one module into this package with a subclass that has

    - `name`: what a user writes as `format`;
    - `looks_for`: the files by which the format is recognised, in words, for messages;
    - `matches`: whether a folder is of this format, by the presence of those files, quickly;
    - `read`: the scene, with camera-to-world poses in OpenCV axes; `splits` has `train` and `test` if the format has
      an official split and is empty otherwise (`load_scene` makes the missing splits);

    and an instance of it named `FORMAT`, which `known_formats` finds.
    """

    name: ClassVar[str]
    looks_for: ClassVar[str]

    @abstractmethod
    def matches(self, root: Path) -> bool:
        """Whether the folder has the files of this format."""

    @abstractmethod
    def read(self, root: Path) -> Scene:
        """Read every posed frame, without decoding an image.

        Raises:
            DataError: a file is missing or malformed; the message names it.
        """


def read_lines(path: Path) -> list[tuple[int, str]]:
    """Read the lines of a text file, stripped, with their numbers from 1, without blank lines and `#` comments.

    Raises:
        DataError: the file is missing or is not text.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise DataError(f"{path} is missing; repeat the download or the unpacking") from error
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path} cannot be read as text ({error}); restore the original") from error
    lines = ((number, line.strip()) for number, line in enumerate(text.splitlines(), start=1))
    return [(number, line) for number, line in lines if line and not line.startswith("#")]


def read_table(path: Path, columns: str) -> tuple[np.ndarray, list[str]]:
    """Read a table of finite numbers.

    Args:
        path: text file, one row per line, separated by blanks, tabs or commas.
        columns: names of the columns, for the message.

    Returns:
        (N, number of columns) float64, and the place of each row, `path:line`, for messages.

    Raises:
        DataError: a line has another number of columns, or an entry that is not a finite number.
    """
    rows, where = [], []
    for number, line in read_lines(path):
        place = f"{path}:{number}"
        try:
            row = [float(item) for item in line.replace(",", " ").split()]
        except ValueError:
            row = []
        if len(row) != len(columns.split()) or not np.isfinite(row).all():
            raise DataError(f"{place}: expected finite numbers `{columns}`, found `{line}`; correct the line")
        rows.append(row)
        where.append(place)
    return np.array(rows, dtype=np.float64).reshape(-1, len(columns.split())), where


def convert_matrices(T_world_cam: np.ndarray, where: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """Positions and quaternions of (N, 4, 4) camera-to-world matrices.

    A matrix that is a rotation except for rounding errors is replaced by the nearest rotation (SVD).

    Args:
        T_world_cam: (N, 4, 4).
        where: the file of each matrix, for the message.

    Returns:
        (N, 3) positions and (N, 4) unit quaternions wxyz, w >= 0, float64.

    Raises:
        DataError: an entry is not finite, the last row is not 0 0 0 1, or the rotation is scaled, skewed
            or mirrored.
    """
    finite = np.isfinite(T_world_cam).sum(axis=(1, 2))
    _raise_if_any(finite < 16, where, T_world_cam, "the pose has NaN or infinite entries ({}); remove the frame")
    bottom = T_world_cam[:, 3]
    off = np.abs(bottom - [0, 0, 0, 1]).max(axis=1)
    _raise_if_any(off > 1e-6, where, bottom, "the last row is {}, not 0 0 0 1; give a 4x4 camera-to-world matrix")
    R = T_world_cam[:, :3, :3]
    det = np.linalg.det(R)
    _raise_if_any(det < 0, where, det, "the rotation is mirrored (determinant {}); give right-handed axes")
    skew = np.abs(R.swapaxes(1, 2) @ R - np.eye(3)).max(axis=(1, 2))
    _raise_if_any(skew > MAX_SKEW, where, skew, "the 3x3 is no rotation (R^T R is off by {}); correct the pose")
    U, _, Vt = np.linalg.svd(R)
    return T_world_cam[:, :3, 3], _make_canonical_quats(Rotation.from_matrix(U @ Vt))


def unit_quats(quats: np.ndarray, where: Sequence[str], scalar_first: bool) -> np.ndarray:
    """Normalise (N, 4) finite quaternions of a file; return unit quaternions wxyz with w >= 0.

    Args:
        quats: as the file has them.
        where: the place of each in the file, for the message.
        scalar_first: whether the file has wxyz; otherwise xyzw.

    Raises:
        DataError: a norm differs from 1 by more than 10 %, more than rounding errors can explain.
    """
    norms = np.linalg.norm(quats, axis=1)
    off = np.abs(norms - 1)
    _raise_if_any(off > 0.1, where, norms, "the quaternion's norm is {}, not 1; check the order of the columns")
    return _make_canonical_quats(Rotation.from_quat(quats, scalar_first=scalar_first))


def require_images(paths: Iterable[Path], listed_in: str) -> None:
    """Check that all images exist.

    Args:
        paths: image files.
        listed_in: the file that lists them, for the message.

    Raises:
        ImageError: images are missing; the message names the first and how many there are.
    """
    missing = [path for path in paths if not path.is_file()]
    if missing:
        raise ImageError(
            f"{missing[0]} is missing, listed in {listed_in} ({len(missing)} such images); "
            "unpack the images there or remove them from the list"
        )


def make_natural_key(text: str) -> list[tuple[int, str]]:
    """Key for sorting by the numbers in a text: `seq2` comes before `seq10`."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", text)]


def sort_frames(frames: Iterable[Frame]) -> tuple[Frame, ...]:
    """Sort frames as a `Scene` needs them: by sequence, and by index within each sequence."""
    return tuple(sorted(frames, key=lambda frame: (make_natural_key(frame.sequence), frame.index)))


def _make_canonical_quats(rotation: Rotation) -> np.ndarray:
    """Quaternions wxyz with w >= 0: of q and -q, always the same one, whichever the file has."""
    return rotation.as_quat(canonical=True, scalar_first=True)


def _raise_if_any(bad: np.ndarray, where: Sequence[str], values: np.ndarray, complaint: str) -> None:
    """Raise a DataError with the place and the value of the first bad row, if there is one."""
    for i in np.flatnonzero(bad)[:1]:
        value = np.array2string(values[i], precision=6).replace("\n", "")
        raise DataError(f"{where[i]}: {complaint.format(value)}")
