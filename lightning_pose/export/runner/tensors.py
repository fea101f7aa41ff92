"""Reads safetensors files without the package: a length, a JSON header of that length, and the arrays' bytes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from lightning_pose.errors import CheckpointError

__all__ = ["read_tensors"]

DTYPES = {"F64": "<f8", "F32": "<f4", "F16": "<f2", "I64": "<i8", "I32": "<i4", "I8": "i1", "U8": "u1"}


def read_tensors(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a file, by name.

    Raises:
        CheckpointError: the file is missing or damaged.
    """
    try:
        data = path.read_bytes()
        start = 8 + int.from_bytes(data[:8], "little")
        header = json.loads(data[8:start])
        header.pop("__metadata__", None)
        arrays = {}
        for name, entry in header.items():
            first, last = entry["data_offsets"]
            array = np.frombuffer(data[start + first : start + last], DTYPES[entry["dtype"]])
            arrays[name] = array.reshape(entry["shape"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise CheckpointError(f"{path} cannot be read ({error}); export the model again") from error
    return arrays
