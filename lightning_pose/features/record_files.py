"""Files of one record each: never written in part, and read only if the content is what was written."""

from __future__ import annotations

import uuid
import zlib
from contextlib import suppress
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from lightning_pose.errors import CacheError
from lightning_pose.features.base import Record

__all__ = ["TEMPORARY", "DamagedError", "read_record", "write_file_atomically", "write_record"]

TEMPORARY = ".tmp"
"""Suffix of a file that is being written."""


class DamagedError(Exception):
    """A file whose content is not what was written."""


def read_record(file: Path) -> Record | None:
    """Read a record; None if there is no such file.

    Raises:
        DamagedError: the file is cut short or altered.
        CacheError: the file exists and cannot be read.
    """
    try:
        with safe_open(file, framework="numpy") as opened:
            record = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
            written = (opened.metadata() or {}).get("checksum")
    except FileNotFoundError:
        return None
    except OSError as error:
        raise CacheError(f"{file} cannot be read ({error}); check its permissions, or delete it") from error
    except (SafetensorError, ValueError, TypeError) as error:
        raise DamagedError(error) from error
    if written != _compute_checksum(record):
        raise DamagedError("its checksum differs")
    return record


def write_record(file: Path, record: Record) -> None:
    """Write a record as a safetensors file with its checksum in the metadata.

    Raises:
        CacheError: as `write_file_atomically`.
    """
    # safetensors writes an array in its memory order, so a transposed array would be saved transposed.
    record = {name: np.asarray(array, order="C") for name, array in record.items()}
    write_file_atomically(file, save(record, {"checksum": _compute_checksum(record)}))


def write_file_atomically(file: Path, data: bytes) -> None:
    """Write a file under a temporary name and rename it, so that no process reads a part of it; make its folder.

    Raises:
        CacheError: the folder cannot be written, or the disk is full.
    """
    temporary = file.with_name(uuid.uuid4().hex + TEMPORARY)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(data)
        temporary.replace(file)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink()
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
