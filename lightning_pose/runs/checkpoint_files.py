"""CheckpointFiles: how Lightning writes and reads checkpoints here, so that none is torn or read damaged."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import torch
from lightning import Trainer
from lightning.pytorch.plugins.io import TorchCheckpointIO

from lightning_pose.checkpoint import check_file
from lightning_pose.errors import CheckpointError
from lightning_pose.paths import replace_file

__all__ = ["CheckpointFiles", "use_checkpoint_files"]

TEMPORARY = ".tmp"
"""Added to the name of a checkpoint that is being written; a killed process leaves it, and the next write reuses it."""


class CheckpointFiles(TorchCheckpointIO):
    """Writes a checkpoint beside the old one, waits for the disk, and renames it; checks checksums when it reads.

    Lightning's own writes into the system's temporary folder, and copies from there if that is another file system:
    a process that is killed then, or a full disk, leaves half a checkpoint where a good one was.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: object = None) -> None:
        """Write a checkpoint.

        Raises:
            CheckpointError: the disk is full, or the folder cannot be written; the old file is still there.
        """
        file, buffer = Path(path), io.BytesIO()
        torch.save(checkpoint, buffer)
        try:
            replace_file(file, buffer.getbuffer(), file.with_name(file.name + TEMPORARY), sync=True)
        except OSError as error:
            kept = "the one of an earlier epoch is kept, and `fit --ckpt_path last` goes on from the last.ckpt"
            raise CheckpointError(
                f"cannot write {file} ({error.strerror}); free some space, or choose another folder with "
                f"--trainer.default_root_dir{f'; {kept}' if file.exists() else ''}"
            ) from error

    def load_checkpoint(self, path: str | Path, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """Read a checkpoint.

        Raises:
            CheckpointError: the file is damaged.
        """
        if Path(path).is_file():
            check_file(Path(path))
        return super().load_checkpoint(path, *args, **kwargs)


def use_checkpoint_files(trainer: Trainer) -> None:
    """Let a trainer write and read checkpoints as `CheckpointFiles` does, unless it was given another way."""
    if type(trainer.strategy.checkpoint_io) is TorchCheckpointIO:
        trainer.strategy.checkpoint_io = CheckpointFiles()
