"""What happens around training: checkpoints in the run's folder, the run's record, and its status."""

from __future__ import annotations

import contextlib
import os
import subprocess
from pathlib import Path
from typing import Any

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback, ModelCheckpoint, Timer
from lightning.pytorch.utilities.exceptions import SIGTERMException
from torch import Tensor

from lightning_pose.errors import ImageError
from lightning_pose.runs.logger import MLflowLogger
from lightning_pose.scenes.images import read_gray

__all__ = [
    "BestCheckpoint",
    "LastCheckpoint",
    "RunRecorder",
    "checkpoint_folder",
    "run_logger",
    "train_seconds",
]


def run_logger(trainer: Trainer) -> MLflowLogger | None:
    """The trainer's MLflow logger, if it has one and this process writes to it."""
    loggers = [logger for logger in trainer.loggers if isinstance(logger, MLflowLogger)]
    return loggers[0] if loggers and trainer.is_global_zero else None


def checkpoint_folder(trainer: Trainer) -> Path:
    """Where the run's checkpoints are: `checkpoints/RUN_ID` under the trainer's root, `local` without a run."""
    logger = next(iter(trainer.loggers), None)
    return Path(trainer.default_root_dir) / "checkpoints" / str(logger.version if logger else "local")


class _RunCheckpoint(ModelCheckpoint):
    """A checkpoint in the run's own folder, which is known only once the run has begun."""

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        if stage == "fit":
            self.dirpath = str(checkpoint_folder(trainer))
        super().setup(trainer, pl_module, stage)


class BestCheckpoint(_RunCheckpoint):
    """`best.ckpt`: the weights of the best epoch on validation frames, or of the last one where there are none.

    The run keeps that epoch's validation metrics as `best/val/...`, beside `val/...` of every epoch.

    Args:
        monitor: the validation metric that decides; lower is better.
    """

    def __init__(self, monitor: str = "val/loss") -> None:
        super().__init__(monitor=monitor, filename="best", save_weights_only=True, enable_version_counter=False)
        self._metrics: dict[str, float] = {}

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        datamodule = getattr(trainer, "datamodule", None)
        if stage == "fit" and datamodule is not None and not datamodule.val_dataloader():
            self.monitor = None
        super().setup(trainer, pl_module, stage)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        before = self.best_model_score
        super().on_validation_end(trainer, pl_module)
        self._remember(trainer, before)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        before = self.best_model_score
        super().on_train_epoch_end(trainer, pl_module)
        self._remember(trainer, before)

    def _remember(self, trainer: Trainer, before: Tensor | None) -> None:
        if self.best_model_score is not before:
            measured = trainer.callback_metrics.items()
            self._metrics = {f"best/{name}": float(v) for name, v in measured if name.startswith("val/")}

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._tell(trainer)

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        self._tell(trainer)

    def _tell(self, trainer: Trainer) -> None:
        logger = run_logger(trainer)
        if logger is not None and self._metrics:
            logger.log_metrics(self._metrics)


class LastCheckpoint(_RunCheckpoint):
    """`last.ckpt`: everything that training needs to go on, after every epoch."""

    def __init__(self) -> None:
        # On the end of the training epoch, so that it is written with and without validation frames.
        super().__init__(filename="last", enable_version_counter=False, save_on_train_epoch_end=True)


class RunRecorder(Callback):
    """Gives the run its name, tags, parameters and config, and ends it with the right status.

    Attributes:
        config_yaml: the command line's whole configuration, kept in the run as `config.yaml`; None for none.
        keeps_checkpoints: whether the run has them as artifacts.
    """

    config_yaml: str | None = None
    keeps_checkpoints: bool = True

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        logger = run_logger(trainer)
        if logger is None:
            return
        run_id = str(logger.run_id)
        logger.client.update_run(run_id, status="RUNNING", name=self._name(trainer, pl_module, logger, stage))
        if stage == "test" and logger.client.get_run(run_id).data.params:
            return  # the test that follows fit belongs to the same run
        for name, value in self._tags(trainer, pl_module, stage).items():
            logger.client.set_tag(run_id, name, value)
        logger.log_hyperparams(_settings(trainer, pl_module))
        if self.config_yaml is not None:
            logger.client.log_text(run_id, self.config_yaml, "config.yaml")

    def _name(self, trainer: Trainer, module: LightningModule, logger: MLflowLogger, stage: str) -> str | None:
        kept = logger.client.get_run(str(logger.run_id)).data
        if kept.params:
            return None  # a run that goes on keeps its name
        scene, seed = trainer.datamodule.scene.name, _seed()  # type: ignore[attr-defined]
        trial = kept.tags.get("sweep.trial")
        parts = (
            f"{type(module).__name__} {scene} {module.headline}",
            f"seed={seed}" if seed else "",
            "" if stage == "fit" else "(test)",
        )
        name = logger._run_name or " ".join(part for part in parts if part)
        return name if trial is None else f"{name} trial {trial}"

    @staticmethod
    def _tags(trainer: Trainer, module: LightningModule, stage: str) -> dict[str, str]:
        datamodule = trainer.datamodule  # type: ignore[attr-defined]
        scene = datamodule.scene
        tags = {
            "verb": str(getattr(stage, "value", stage)),  # Lightning gives an enum
            "architecture": type(module).__name__,
            "dataset": scene.format,
            "scene": scene.name,
            "format": scene.format,
            "split": scene.split_source,
            "ground_truth": scene.ground_truth,
            "unit": scene.unit,
            "features": datamodule.extractor.name,
            **_test_tags(datamodule, module),
        }
        commit = _git_commit()
        return tags | ({"git_commit": commit} if commit else {})

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        logger = run_logger(trainer)
        if logger is not None and isinstance(exception, KeyboardInterrupt | SIGTERMException):
            logger.stopped_as = "KILLED"

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        logger = run_logger(trainer)
        if logger is not None and self.keeps_checkpoints:
            for file in sorted(checkpoint_folder(trainer).glob("*.ckpt")):
                logger.client.log_artifact(str(logger.run_id), str(file), "checkpoints")


def train_seconds(trainer: Trainer) -> float | None:
    """Seconds spent in training, resumed parts included; None where nothing was trained."""
    timers = [callback for callback in trainer.callbacks if isinstance(callback, Timer)]  # type: ignore[attr-defined]
    return (timers[0].time_elapsed("train") or None) if timers else None


_OF_THE_MACHINE = ("cache_dir", "workers", "eval_batch_size")
"""Settings of the data that change nothing in the result, and would only differ where runs are compared."""


def _settings(trainer: Trainer, module: LightningModule) -> dict[str, Any]:
    datamodule = trainer.datamodule  # type: ignore[attr-defined]
    data = datamodule.describe()
    kept = {name: value for name, value in data["init_args"].items() if name not in _OF_THE_MACHINE}
    return {
        # The name for the class path, which `config.yaml` has: MLflow's plots cut values off after some ten letters.
        "architecture": type(module).__name__,
        "scene": datamodule.scene.name,
        "features": datamodule.extractor.name,
        "model": module.describe()["init_args"],  # type: ignore[operator]
        "data": data | {"init_args": kept},
        "trainer": {"max_epochs": trainer.max_epochs, "precision": trainer.precision},
        "seed": _seed(),
    }


def _test_tags(datamodule: Any, module: LightningModule) -> dict[str, str]:
    """What test errors are of: reports refuse to put errors of different things side by side."""
    scene = datamodule.scene
    test = scene.splits.get("test", ())
    clips = getattr(module, "reads_clips", False)
    tags = {"task": "relative" if clips else "absolute", "test_frames": str(len(test))}
    if clips:
        tags |= {name: str(getattr(datamodule, name)) for name in ("clip_length", "stride", "relative_frame")}
    if len(test):
        # Of one frame: those of a scene are alike. Cached features do without images, so one may be gone.
        with contextlib.suppress(ImageError):
            height, width = read_gray(scene.frames[test[0]].image).shape
            tags["image_size"] = f"{width}x{height}"
    return tags


def _seed() -> int | None:
    seed = os.environ.get("PL_GLOBAL_SEED")
    return int(seed) if seed else None


def _git_commit() -> str | None:
    try:
        answer = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return answer.stdout.strip() if answer.returncode == 0 else None
