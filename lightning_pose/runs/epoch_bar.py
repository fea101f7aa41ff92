"""EpochBar: a progress bar over the epochs of training, with the latest losses and validation errors.

Epochs here take a second or less, so that a bar over their batches would only flicker.
"""

from __future__ import annotations

import sys

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import ProgressBar
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

__all__ = ["EpochBar"]

SHOWN = {"train/loss": "loss", "val/position_median_m": "val m", "val/orientation_median_deg": "val deg"}


class EpochBar(ProgressBar):
    """A bar over epochs on a terminal's stderr; without a terminal, one line after each tenth of the run."""

    def __init__(self) -> None:
        super().__init__()
        self._bar: Progress | None = None
        self._task = TaskID(0)
        self.is_enabled = True  # LightningModule.print reads it

    def disable(self) -> None:
        self.is_enabled = False

    def enable(self) -> None:
        self.is_enabled = True

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        console = Console(stderr=True)
        if self.is_enabled and console.is_terminal:
            columns = (
                TextColumn("epoch"), MofNCompleteColumn(), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn(),
                TextColumn("{task.description}", markup=False),
            )  # fmt: skip
            self._bar = Progress(*columns, console=console)
            self._task = self._bar.add_task("", total=trainer.max_epochs, completed=trainer.current_epoch)
            self._bar.start()

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if not self.is_enabled:
            return
        done, total = trainer.current_epoch + 1, trainer.max_epochs or 0
        shown = {label: trainer.callback_metrics.get(name) for name, label in SHOWN.items()}
        text = "  ".join(f"{label} {float(value):.3f}" for label, value in shown.items() if value is not None)
        if self._bar is not None:
            self._bar.update(self._task, completed=done, description=text)
        elif done == total or done % max(1, total // 10) == 0:
            print(f"epoch {done}/{total}  {text}", file=sys.stderr, flush=True)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._stop()

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        self._stop()

    def _stop(self) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None
