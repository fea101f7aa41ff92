"""Files of one record each: never written in part, and read only if the content is what was written."""

from __future__ import annotations

import uuid
import zlib
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from lightning_pose.errors import CacheError
from lightning_pose.features.base import Record
from lightning_pose.paths import replace_file

__all__ = ["TEMPORARY", "DamagedError", "read_record", "write_file_atomically", "write_record"]

TEMPORARY = ".tmp"
"""Suffix of a file that is being written."""


class DamagedError(Exception):
    """A file whose content is not what was written."""


def read_record(file: Path, owner: str | None = None) -> Record | None:
    """Read a record; None if there is no such file.

    Args:
        file: of `write_record`.
        owner: whose record it must be; files of earlier versions do not say whose they are, and are believed.

    Raises:
        DamagedError: the file is cut short or altered, or holds another owner's record.
        CacheError: the file exists and cannot be read.
    """
    try:
        with safe_open(file, framework="numpy") as opened:
            record = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
            about = opened.metadata() or {}
    except FileNotFoundError:
        return None
    except OSError as error:
        raise CacheError(f"{file} cannot be read ({error}); check its permissions, or delete it") from error
    except (SafetensorError, ValueError, TypeError) as error:
        raise DamagedError(error) from error
    if about.get("checksum") != _compute_checksum(record):
        raise DamagedError("its checksum differs")
    if owner is not None and about.get("owner", owner) != owner:
        raise DamagedError(f"it is the record of {about['owner']}")
    return record


def write_record(file: Path, record: Record, owner: str | None = None) -> None:
    """Write a record as a safetensors file with its checksum, and its owner, in the metadata.

    Args:
        file: to write.
        record: arrays by name.
        owner: identifies the extractor with its settings, and the image.

    Raises:
        CacheError: as `write_file_atomically`.
    """
    # safetensors writes an array in its memory order, so a transposed array would be saved transposed.
    record = {name: np.asarray(array, order="C") for name, array in record.items()}
    about = {"checksum": _compute_checksum(record)} | ({} if owner is None else {"owner": owner})
    write_file_atomically(file, save(record, about))


def write_file_atomically(file: Path, data: bytes) -> None:
    """Write a file of the cache as `replace_file` does; several processes may write one at the same time.

    Raises:
        CacheError: the folder cannot be written, or the disk is full.
    """
    try:
        replace_file(file, data, file.with_name(uuid.uuid4().hex + TEMPORARY))
    except OSError as error:
        raise CacheError(
            f"cannot write to the feature cache in {file.parent} ({error.strerror}); free some space, or set "
            "LIGHTNING_POSE_CACHE to a folder that can be written"
        ) from error


def _compute_checksum(record: Record) -> str:
    """CRC-32 of every array's name, type, shape and bytes."""
    crc = 0
    for name in sorted(record):
        array = record[name]
        crc = zlib.crc32(f"{name} {array.dtype} {array.shape}".encode(), crc)
        crc = zlib.crc32(array.data, crc)
    return f"{crc:08x}"
