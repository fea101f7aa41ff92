"""The checkpoints of a run: the best epoch and the last one, in the run's own folder."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Any

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint, Timer
from torch import Tensor
from torch.utils.data import DataLoader

from lightning_pose.data.batches import PoseBatch
from lightning_pose.data.datamodule import find_datamodule
from lightning_pose.errors import CheckpointError
from lightning_pose.runs.callbacks import find_callback
from lightning_pose.runs.checkpoint_files import (
    delete_abandoned,
    find_checkpoint_files,
    use_checkpoint_files,
)
from lightning_pose.runs.logger import MLflowLogger
from lightning_pose.runs.random_state import RandomState, collect_random_states, restore_random_state
from lightning_pose.runs.resume import read_seed

__all__ = ["BestCheckpoint", "LastCheckpoint", "checkpoint_folder", "run_logger"]


def run_logger(trainer: Trainer) -> MLflowLogger | None:
    """The trainer's MLflow logger, if it has one and this process writes to it."""
    loggers = [logger for logger in trainer.loggers if isinstance(logger, MLflowLogger)]
    return loggers[0] if loggers and trainer.is_global_zero else None


def checkpoint_folder(trainer: Trainer) -> Path:
    """Where the run's checkpoints are: `checkpoints/RUN_ID` under the trainer's root, `local` without a run."""
    logger = next(iter(trainer.loggers), None)
    return Path(trainer.default_root_dir) / "checkpoints" / str(logger.version if logger else "local")


def _flush(trainer: Trainer) -> None:
    """Write the checkpoints that are kept in memory."""
    files = find_checkpoint_files(trainer)
    if files is not None:
        files.flush()


class _RunCheckpoint(ModelCheckpoint):
    """A checkpoint in the run's own folder, whose path is known only once the run has begun."""

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        use_checkpoint_files(trainer)
        if stage == "fit":
            self.dirpath = str(checkpoint_folder(trainer))
        super().setup(trainer, pl_module, stage)

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Make the folder now: a first epoch may take an hour.

        Raises:
            CheckpointError: it cannot be made.
        """
        if not trainer.is_global_zero:
            return  # other processes do not know the run
        try:
            checkpoint_folder(trainer).mkdir(parents=True, exist_ok=True)
            delete_abandoned(checkpoint_folder(trainer).parent)
        except OSError as error:
            raise CheckpointError(
                f"cannot make {self.dirpath} ({error.strerror}); choose another folder with --trainer.default_root_dir"
            ) from error

    def _save_checkpoint(self, trainer: Trainer, filepath: str) -> None:
        files = find_checkpoint_files(trainer)
        with nullcontext() if files is None else files.hold():
            super()._save_checkpoint(trainer, filepath)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        _flush(trainer)

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        if not isinstance(exception, CheckpointError):  # it could not write
            _flush(trainer)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the best score of the same run; its folder may have moved."""
        if self._is_same_run(state_dict):
            state_dict = {**state_dict, "dirpath": self.dirpath}
        super().load_state_dict(state_dict)

    def _is_same_run(self, state_dict: dict[str, Any]) -> bool:
        """Whether a state is of the run that goes on, and not of one that another run begins with."""
        return Path(state_dict["dirpath"] or "").name == Path(self.dirpath or "").name


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

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._log_best(trainer)

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        super().on_exception(trainer, pl_module, exception)
        self._log_best(trainer)

    def _log_best(self, trainer: Trainer) -> None:
        """Log the best epoch's validation metrics."""
        logger = run_logger(trainer)
        if logger is not None and self._metrics:
            logger.log_metrics(self._metrics)

    def state_dict(self) -> dict[str, Any]:
        return {**super().state_dict(), "metrics": self._metrics}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        super().load_state_dict(state_dict)
        if self._is_same_run(state_dict):
            self._metrics = state_dict.get("metrics", {})


class LastCheckpoint(_RunCheckpoint):
    """`last.ckpt`: everything that training needs to resume, of the last epoch; short ones are written together.

    A run that goes on from it draws the same random numbers as one that was not stopped.

    Attributes:
        finishes: a run that had stopped training early, and was stopped before the end of its test, trains no more.
    """

    def __init__(self) -> None:
        # On the end of the training epoch, so that it is written with and without validation frames.
        super().__init__(filename="last", enable_version_counter=False, save_on_train_epoch_end=True)
        self.finishes = False
        self._stopped = False
        self._settings: dict[str, object] = {}
        self._logged: dict[str, Any] = {}
        self._random_states: list[RandomState] | None = None

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        timer = find_callback(trainer, Timer)
        # A run that ran out of time may go on with more of it.
        self._stopped = trainer.should_stop and not (timer is not None and (timer.time_remaining() or 1) <= 0)
        self._settings = {"seed_everything": read_seed(), "trainer.precision": str(trainer.precision)}
        measured = {name: float(v) for name, v in trainer.callback_metrics.items() if name.startswith("train/")}
        # Lightning logs by batches, of which a closed form has many for its one step; it adds the epoch's number.
        batches = trainer.fit_loop.epoch_loop.batch_progress.total.ready
        steps = trainer.global_step if pl_module.automatic_optimization else batches
        self._logged = {"step": steps - 1, "metrics": {**measured, "epoch": float(trainer.current_epoch)}}
        super().on_train_epoch_end(trainer, pl_module)

    def state_dict(self) -> dict[str, Any]:
        own = {"stopped": self._stopped, "settings": self._settings, "random_states": collect_random_states()}
        return {**super().state_dict(), **own, "logged": self._logged}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        super().load_state_dict(state_dict)
        self._stopped = state_dict.get("stopped", False)
        self._random_states = state_dict.get("random_states")
        self._logged = state_dict.get("logged", {}) if self._is_same_run(state_dict) else {}

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        super().on_fit_start(trainer, pl_module)
        logger, files = run_logger(trainer), find_checkpoint_files(trainer)
        if logger is not None and files is not None:
            files.before_write = logger.send_metrics
        self._log_missing(trainer)
        if self.finishes and self._stopped:
            trainer.should_stop = True

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        # A checkpoint's epoch counts as completed once training has gone on; here nothing may have been left of it.
        epochs = trainer.fit_loop.epoch_progress.current
        epochs.completed = epochs.state_dict()["processed"]  # an attribute, but not of its declared type

    def _log_missing(self, trainer: Trainer) -> None:
        """Log the training metrics of the checkpoint's epoch if the run lacks them.

        Lightning logs them after the checkpoint is written; a process that is killed in between has not.
        """
        logger, metrics = run_logger(trainer), self._logged.get("metrics")
        if logger is None or not metrics:
            return
        logger.log_metrics(metrics, self._logged["step"])

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self._random_states is not None:
            restore_random_state(self._random_states)
            # In a run that goes on without a stop, each further epoch begins with a new iterator, which draws a number.
            loader: DataLoader[PoseBatch] | None = trainer.train_dataloader
            assert loader is not None, "training has begun"
            iter(loader)
            self._random_states = None
