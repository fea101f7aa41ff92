"""Arrays too large for memory: in a file without a name, which the system reads page by page and deletes at the end."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import numpy as np

from lightning_pose.errors import CacheError

__all__ = ["IN_MEMORY_BYTES", "allocate_rows"]

IN_MEMORY_BYTES = 2**30
"""Larger arrays are on disk."""


def allocate_rows(shape: tuple[int, ...], dtype: np.dtype | type, folder: Path) -> np.ndarray:
    """An array to fill: in memory, or mapped from a file in a folder where it is large.

    Mapped pages that the program has not used for long are written out, or dropped, when memory is needed.

    Raises:
        CacheError: the folder cannot be written, or has no space for the file.
    """
    array = np.dtype(dtype)
    size = int(np.prod(shape, dtype=np.int64)) * array.itemsize
    if size <= IN_MEMORY_BYTES:
        return np.empty(shape, dtype)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            _reserve(file.fileno(), size)
            return np.memmap(file, array, "r+", shape=shape)
    except OSError as error:
        raise CacheError(
            f"{size / 2**30:.1f} GiB of features do not fit memory, and cannot be written to {folder} "
            f"({error.strerror}); free some space, or set LIGHTNING_POSE_CACHE to another disk"
        ) from error


def _reserve(file: int, size: int) -> None:
    """Give a file its size at once: a write to a mapped page that the disk has no space for would end the process."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file, 0, size)
    else:
        os.ftruncate(file, size)
