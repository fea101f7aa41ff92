"""RunRecorder: writes a run's name, tags, parameters, config, checkpoints and status to MLflow."""

from __future__ import annotations

import contextlib
import subprocess

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback, EarlyStopping
from lightning.pytorch.utilities.exceptions import SIGTERMException

from lightning_pose.data.datamodule import SceneDataModule, scene_datamodule
from lightning_pose.errors import ImageError
from lightning_pose.models.base import PoseModule
from lightning_pose.runs.callbacks import find_callback
from lightning_pose.runs.checkpoints import checkpoint_folder, run_logger
from lightning_pose.runs.logger import MLflowLogger, flatten_settings
from lightning_pose.runs.resume import read_seed
from lightning_pose.runs.tags import OPERATIONAL

__all__ = ["RunRecorder"]


class RunRecorder(Callback):
    """Writes the run's name, tags, parameters, config and checkpoints, and its status if it is stopped.

    Attributes:
        config_yaml: the command line's whole configuration, kept in the run as `config.yaml`; None for none.
        keeps_checkpoints: whether the run has them as artifacts.
    """

    config_yaml: str | None = None
    keeps_checkpoints: bool = True
    _patience: int | None = None

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        stopping = find_callback(trainer, EarlyStopping)
        self._patience = None if stopping is None else stopping.patience
        logger = run_logger(trainer)
        if logger is None:
            return
        assert isinstance(pl_module, PoseModule)
        run_id = str(logger.run_id)
        logger.client.update_run(run_id, status="RUNNING", name=self._make_name(trainer, pl_module, logger, stage))
        if stage == "test" and logger.client.get_run(run_id).data.params:
            return  # the test that follows fit belongs to the same run
        for name, value in self._collect_tags(trainer, pl_module, stage).items():
            logger.client.set_tag(run_id, name, value)
        settings = _collect_settings(trainer, pl_module)
        known = logger.client.get_run(run_id).data.params
        for name, value in flatten_settings(settings).items():
            if name in known and known[name] != str(value):  # MLflow keeps a parameter as it is
                logger.client.set_tag(run_id, name, str(value))
        logger.log_hyperparams(settings)
        if self.config_yaml is not None:
            logger.client.log_text(run_id, self.config_yaml, "config.yaml")

    def _make_name(self, trainer: Trainer, module: PoseModule, logger: MLflowLogger, stage: str) -> str | None:
        """The name of a new run; None for one that is resumed, which keeps its name."""
        kept = logger.client.get_run(str(logger.run_id)).data
        if kept.params:
            return None
        scene, seed = scene_datamodule(trainer).scene.name, read_seed()
        trial = kept.tags.get("sweep.trial")
        parts = (
            f"{module.system_name} {scene} {module.headline}",
            f"seed={seed}" if seed else "",
            "" if stage == "fit" else "(test)",
        )
        name = logger.run_name or " ".join(part for part in parts if part)
        return name if trial is None else f"{name} trial {trial}"

    @staticmethod
    def _collect_tags(trainer: Trainer, module: PoseModule, stage: str) -> dict[str, str]:
        """The run's tags, by name."""
        datamodule = scene_datamodule(trainer)
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
            **({"refined": "true"} if module.refinement is not None else {}),
            **_test_tags(datamodule, module),
        }
        commit = _read_git_commit()
        return tags | ({"git_commit": commit} if commit else {})

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        logger = run_logger(trainer)
        if logger is not None and isinstance(exception, KeyboardInterrupt | SIGTERMException):
            logger.stopped_as = "KILLED"

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        stopping = find_callback(trainer, EarlyStopping)
        if stopping is not None and self._patience is not None:
            stopping.patience = self._patience  # the checkpoint has set it to what it was

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        logger = run_logger(trainer)
        if logger is not None and self.keeps_checkpoints:
            for file in sorted(checkpoint_folder(trainer).glob("*.ckpt")):
                logger.client.log_artifact(str(logger.run_id), str(file), "checkpoints")


def _collect_settings(trainer: Trainer, module: PoseModule) -> dict[str, object]:
    """The run's settings, nested, as parameters of the run: `MLflowLogger` flattens them."""
    datamodule = scene_datamodule(trainer)
    data = datamodule.describe()
    kept = {name: value for name, value in data["init_args"].items() if name not in OPERATIONAL}
    return {
        # The name for the class path, which `config.yaml` has: MLflow's plots cut values off after some ten letters.
        "architecture": type(module).__name__,
        "scene": datamodule.scene.name,
        "features": datamodule.extractor.name,
        "model": module.describe()["init_args"],
        "data": data | {"init_args": kept},
        "trainer": {"max_epochs": trainer.max_epochs, "precision": trainer.precision},
        "seed": read_seed(),
    }


def _test_tags(datamodule: SceneDataModule, module: PoseModule) -> dict[str, str]:
    """Tags of what test errors are measured on; reports refuse to put runs with different ones into one column."""
    scene = datamodule.scene
    test = scene.splits.get("test", [])
    tags = {"task": "relative" if module.reads_clips else "absolute", "test_frames": str(len(test))}
    if module.reads_clips:
        tags |= {name: str(getattr(datamodule, name)) for name in ("clip_length", "stride", "relative_frame")}
    if len(test):
        # Cached features do without images, so one may be gone.
        with contextlib.suppress(ImageError):
            width, height = datamodule.find_image_size("test")
            tags["image_size"] = f"{width}x{height}"
    return tags


def _read_git_commit() -> str | None:
    """The commit of the current folder's checkout; None if it is not one."""
    try:
        answer = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return answer.stdout.strip() if answer.returncode == 0 else None
