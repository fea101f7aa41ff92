"""CheckpointFiles: how Lightning writes and reads checkpoints here, so that none is torn or read damaged."""

from __future__ import annotations

import copy
import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import torch
from lightning import Trainer
from lightning.pytorch.plugins.io import TorchCheckpointIO
from torch import Tensor

from lightning_pose.checkpoint import check_file
from lightning_pose.errors import CheckpointError
from lightning_pose.paths import replace_file
from lightning_pose.runs.pace import Pace
from lightning_pose.runs.process import is_abandoned, name_owner

__all__ = ["CheckpointFiles", "delete_abandoned", "find_checkpoint_files", "use_checkpoint_files"]

TEMPORARY = ".tmp"
"""End of the name of a checkpoint that is being written."""


class CheckpointFiles(TorchCheckpointIO):
    """Writes a checkpoint beside the old one, waits for the disk, and renames it; checks checksums when it reads.

    Lightning's own writes into the system's temporary folder, and copies from there if that is another file system:
    a process that is killed then, or a full disk, leaves half a checkpoint where a good one was.

    Where epochs are shorter than writing takes, some are kept in memory for seconds, and only the newest is written.

    Attributes:
        before_write: called before a checkpoint is written; what it stores is never behind the checkpoint.
    """

    def __init__(self) -> None:
        super().__init__()
        self.before_write: Callable[[], object] = lambda: None
        self._held: dict[Path, dict[str, Any]] = {}
        self._spare: dict[Path, dict[str, Any]] = {}  # earlier copies, whose memory the next ones use
        self._may_hold = False
        self._pace = Pace()

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: object = None) -> None:
        """Write a checkpoint; within `hold`, maybe later.

        Raises:
            CheckpointError: the disk is full, or the folder cannot be written; the old file is still there.
        """
        file = Path(path)
        earlier = self._held.pop(file, None)
        if not self._may_hold:
            _write(checkpoint, file)
        elif self._pace.is_due:
            self._write_all({**self._take_held(), file: checkpoint})
        else:  # training goes on with its tensors
            self._held[file] = _copy_values(checkpoint, earlier or self._spare.pop(file, None))

    @contextmanager
    def hold(self) -> Iterator[None]:
        """What is saved here may be kept until `flush`, or until the next one is due."""
        self._may_hold = True
        try:
            yield
        finally:
            self._may_hold = False

    def flush(self) -> None:
        """Write what is kept, in the order in which it came.

        Raises:
            CheckpointError: as `save_checkpoint`.
        """
        held = self._take_held()
        if held:
            self._write_all(held)

    def _take_held(self) -> dict[Path, dict[str, Any]]:
        """What is kept, whose memory the next copies use once it is written."""
        held, self._held = self._held, {}
        self._spare |= held
        return held

    def _write_all(self, checkpoints: dict[Path, dict[str, Any]]) -> None:
        with self._pace.measure():
            self.before_write()
            for file, checkpoint in checkpoints.items():
                _write(checkpoint, file)

    def load_checkpoint(self, path: str | Path, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """Read a checkpoint.

        Raises:
            CheckpointError: the file is damaged.
        """
        if Path(path).is_file():
            check_file(Path(path))
        return super().load_checkpoint(path, *args, **kwargs)


def _copy_values(value: Any, earlier: Any) -> Any:
    """A copy of a checkpoint, in the tensors of an earlier one where they fit: new memory takes longer than copying."""
    if isinstance(value, Tensor):
        if isinstance(earlier, Tensor) and _get_kind(value) == _get_kind(earlier):
            return earlier.copy_(value.detach())
        return value.detach().clone()
    if isinstance(value, dict):
        known, copied = earlier if isinstance(earlier, dict) else {}, copy.copy(value)
        copied.update({key: _copy_values(each, known.get(key)) for key, each in value.items()})
        return copied
    if isinstance(value, list):
        known = earlier if isinstance(earlier, list) and len(earlier) == len(value) else [None] * len(value)
        return [_copy_values(*pair) for pair in zip(value, known, strict=True)]
    return copy.deepcopy(value)


def _get_kind(tensor: Tensor) -> tuple[torch.Size, torch.dtype, torch.device]:
    return tensor.shape, tensor.dtype, tensor.device


def _write(checkpoint: dict[str, Any], file: Path) -> None:
    buffer = io.BytesIO()
    torch.save(checkpoint, buffer)
    try:
        replace_file(file, buffer.getbuffer(), file.with_name(f"{file.name}.{name_owner()}{TEMPORARY}"), sync=True)
    except OSError as error:
        kept = "the one of an earlier epoch is kept, and `fit --ckpt_path last` goes on from the last.ckpt"
        raise CheckpointError(
            f"cannot write {file} ({error.strerror}); free some space, or choose another folder with "
            f"--trainer.default_root_dir{f'; {kept}' if file.exists() else ''}"
        ) from error


def delete_abandoned(folder: Path) -> None:
    """Delete what killed processes have left below the folder of all runs' checkpoints."""
    for unfinished in folder.glob(f"*/*.ckpt.*{TEMPORARY}"):
        with suppress(OSError):  # another process may delete it first
            if is_abandoned(unfinished, unfinished.name.split(".")[-2]):
                unfinished.unlink()


def find_checkpoint_files(trainer: Trainer) -> CheckpointFiles | None:
    """How a trainer writes checkpoints; None if it was given a way of its own."""
    found = trainer.strategy.checkpoint_io
    return found if isinstance(found, CheckpointFiles) else None


def use_checkpoint_files(trainer: Trainer) -> None:
    """Let a trainer write and read checkpoints as `CheckpointFiles` does, unless it was given another way."""
    if type(trainer.strategy.checkpoint_io) is TorchCheckpointIO:
        trainer.strategy.checkpoint_io = CheckpointFiles()
