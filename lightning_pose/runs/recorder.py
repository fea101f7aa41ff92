"""What happens around training: checkpoints in the run's folder, the run's record, and its status."""

from __future__ import annotations

import contextlib
import os
import subprocess
from typing import Any

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback, Timer
from lightning.pytorch.utilities.exceptions import SIGTERMException

from lightning_pose.errors import ImageError
from lightning_pose.runs.checkpoints import checkpoint_folder, run_logger
from lightning_pose.runs.logger import MLflowLogger
from lightning_pose.runs.tags import OPERATIONAL
from lightning_pose.scenes.images import read_gray

__all__ = ["RunRecorder", "train_seconds"]


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


def _settings(trainer: Trainer, module: LightningModule) -> dict[str, Any]:
    datamodule = trainer.datamodule  # type: ignore[attr-defined]
    data = datamodule.describe()
    kept = {name: value for name, value in data["init_args"].items() if name not in OPERATIONAL}
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
