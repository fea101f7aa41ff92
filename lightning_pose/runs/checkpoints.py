"""The checkpoints of a run: the best epoch and the last one, in the run's own folder."""

from __future__ import annotations

from pathlib import Path

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from torch import Tensor

from lightning_pose.data.datamodule import find_datamodule
from lightning_pose.runs.checkpoint_files import use_checkpoint_files
from lightning_pose.runs.logger import MLflowLogger

__all__ = ["BestCheckpoint", "LastCheckpoint", "checkpoint_folder", "run_logger"]


def run_logger(trainer: Trainer) -> MLflowLogger | None:
    """The trainer's MLflow logger, if it has one and this process writes to it."""
    loggers = [logger for logger in trainer.loggers if isinstance(logger, MLflowLogger)]
    return loggers[0] if loggers and trainer.is_global_zero else None


def checkpoint_folder(trainer: Trainer) -> Path:
    """Where the run's checkpoints are: `checkpoints/RUN_ID` under the trainer's root, `local` without a run."""
    logger = next(iter(trainer.loggers), None)
    return Path(trainer.default_root_dir) / "checkpoints" / str(logger.version if logger else "local")


class _RunCheckpoint(ModelCheckpoint):
    """A checkpoint in the run's own folder, whose path is known only once the run has begun."""

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        use_checkpoint_files(trainer)
        if stage == "fit":
            self.dirpath = str(checkpoint_folder(trainer))
        super().setup(trainer, pl_module, stage)


class BestCheckpoint(_RunCheckpoint):
    """`best.ckpt`: the weights of the best epoch on validation frames, or of the last one where there are none.

    That epoch's validation metrics are logged as `best/val/...`, beside `val/...` of every epoch.

    Args:
        monitor: the validation metric to choose by; lower is better.
    """

    def __init__(self, monitor: str = "val/loss") -> None:
        super().__init__(monitor=monitor, filename="best", save_weights_only=True, enable_version_counter=False)
        self._metrics: dict[str, float] = {}

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        datamodule = find_datamodule(trainer)
        if stage == "fit" and datamodule is not None and not datamodule.val_dataloader():
            self.monitor = None
        super().setup(trainer, pl_module, stage)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        before = self.best_model_score
        super().on_validation_end(trainer, pl_module)
        self._keep_metrics(trainer, before)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        before = self.best_model_score
        super().on_train_epoch_end(trainer, pl_module)
        self._keep_metrics(trainer, before)

    def _keep_metrics(self, trainer: Trainer, before: Tensor | None) -> None:
        """Keep the epoch's validation metrics if it is the best so far; `before` is the best score until now."""
        if self.best_model_score is not before:
            measured = trainer.callback_metrics.items()
            self._metrics = {f"best/{name}": float(v) for name, v in measured if name.startswith("val/")}

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._log_best(trainer)

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        self._log_best(trainer)

    def _log_best(self, trainer: Trainer) -> None:
        """Log the best epoch's validation metrics."""
        logger = run_logger(trainer)
        if logger is not None and self._metrics:
            logger.log_metrics(self._metrics)


class LastCheckpoint(_RunCheckpoint):
    """`last.ckpt`: everything that training needs to resume, written after every epoch."""

    def __init__(self) -> None:
        # On the end of the training epoch, so that it is written with and without validation frames.
        super().__init__(filename="last", enable_version_counter=False, save_on_train_epoch_end=True)
