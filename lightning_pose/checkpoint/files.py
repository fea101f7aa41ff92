"""Checkpoint files: reading what `fit` wrote, after comparing it with its checksums."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import torch

from lightning_pose.checkpoint.class_paths import resolve_class_paths
from lightning_pose.errors import CheckpointError

__all__ = ["check_file", "read_checkpoint"]


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """Read a checkpoint that `fit` wrote: tensors are memory-mapped on the CPU, class paths are today's.

    Classes that it names are not imported: `check_specs` decides which of them may be.

    Raises:
        CheckpointError: the file is missing, unreadable, damaged, or was not written by this project.
    """
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(f"{path} is no file; give a checkpoint such as mlruns/checkpoints/RUN_ID/best.ckpt")
    check_file(path)
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except Exception as error:  # torch raises many kinds of exception for a file that is no checkpoint
        raise CheckpointError(
            f"{path} cannot be read as a checkpoint; it is damaged or another kind of file"
        ) from error
    if not isinstance(checkpoint, dict) or not {"lightning_pose", "state_dict"} <= checkpoint.keys():
        raise CheckpointError(f"{path} was not written by lightning_pose; give a checkpoint that `fit` wrote")
    return checkpoint | {"lightning_pose": resolve_class_paths(checkpoint["lightning_pose"])}


def check_file(path: Path) -> None:
    """Compare a checkpoint's content with its checksums: `torch.save` writes a zip archive, with a CRC-32 an entry.

    Torch does not check them when it reads the file.

    Raises:
        CheckpointError: they differ, or the file is no such archive.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
    except Exception as error:  # a damaged archive ends in many kinds of exception
        raise CheckpointError(
            f"{path} cannot be read as a checkpoint; it is damaged or another kind of file"
        ) from error
    if damaged is not None:
        raise CheckpointError(
            f"{path} is damaged (the checksum of {damaged} differs); copy it again, or train it again"
        )
