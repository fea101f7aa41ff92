"""TrainingClock: how long a run has trained, over all its parts where it was resumed."""

from __future__ import annotations

import time
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback

from lightning_pose.runs.callbacks import find_callback

__all__ = ["TrainingClock", "read_train_seconds", "wait_for_device"]


def wait_for_device() -> None:
    """Wait until an accelerator has done what it was asked for; without it, a clock measures the asking alone."""
    if torch.accelerator.is_available():
        torch.accelerator.synchronize()


class TrainingClock(Callback):
    """Measures the seconds from the start of training to its end; checkpoints carry those so far.

    Lightning's `Timer` measures them too, but where one is among the callbacks, Lightning ignores `max_time`, and
    trains without end where `max_epochs` is not set.
    """

    def __init__(self) -> None:
        self._before = 0.0
        self._started: float | None = None

    @property
    def seconds(self) -> float:
        """Seconds spent in training so far."""
        return self._before + (0.0 if self._started is None else time.monotonic() - self._started)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        wait_for_device()
        self._started = time.monotonic()

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        wait_for_device()
        self._before, self._started = self.seconds, None

    def state_dict(self) -> dict[str, float]:
        return {"seconds": self.seconds}

    def load_state_dict(self, state_dict: dict[str, float]) -> None:
        self._before = state_dict["seconds"]

    def on_load_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Read the seconds of a checkpoint of an older version, which has them as Lightning's `Timer` does."""
        older = checkpoint["callbacks"].get("Timer", {}) if "callbacks" in checkpoint else {}
        self._before = older.get("time_elapsed", {}).get("train", self._before)


def read_train_seconds(trainer: Trainer) -> float | None:
    """Seconds spent in training, resumed parts included; None where nothing was trained."""
    clock = find_callback(trainer, TrainingClock)
    return (clock.seconds or None) if clock is not None else None
