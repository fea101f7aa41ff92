"""The callback that ends every test with baselines, costs, figures, prediction files, and one table."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback

from lightning_pose.data.datamodule import scene_datamodule
from lightning_pose.evaluation.clips import evaluate_clips
from lightning_pose.evaluation.gather import gather_poses
from lightning_pose.evaluation.images import evaluate_images
from lightning_pose.evaluation.result import Evaluation
from lightning_pose.evaluation.table import print_results, results_markdown
from lightning_pose.models.base import Pose, PoseModule
from lightning_pose.models.parts.poses import Located
from lightning_pose.runs.checkpoints import checkpoint_folder, run_logger
from lightning_pose.runs.logged_model import log_localizer
from lightning_pose.runs.logger import MLflowLogger
from lightning_pose.runs.tags import NOTE
from lightning_pose.scenes.scene import Frame
from lightning_pose.scenes.trajectory_files import write_sequences

__all__ = ["TestReport", "describe_run"]


class TestReport(Callback):
    """Collects the test's predictions and, at its end, evaluates them, logs the results and prints a table.

    Args:
        log_model: keep a model in the run that `mlflow.pyfunc.load_model` loads.
        visual_odometry: for models of clips, match images to compare with; about 0.1 s a frame.
    """

    __test__ = False  # not a test case, whatever pytest makes of its name

    def __init__(self, log_model: bool = True, visual_odometry: bool = True) -> None:
        self.log_model = log_model
        self.visual_odometry = visual_odometry
        self.results: dict[str, Mapping[str, float]] = {}
        self.evaluation: Evaluation | None = None
        self._batches: list[Located] = []

    def on_test_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._batches = []

    def on_test_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Located, *args: object, **kwargs: object
    ) -> None:
        self._batches.append(outputs)

    def on_test_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        assert isinstance(pl_module, PoseModule)
        located = None if pl_module.reads_clips else gather_poses(self._batches)
        if not trainer.is_global_zero:
            return
        model = {
            name.removeprefix("test/"): float(value)
            for name, value in trainer.callback_metrics.items()
            if name.startswith("test/")
        }
        if located is None:
            found = evaluate_clips(trainer, pl_module, model, self.visual_odometry)
        else:
            found = evaluate_images(trainer, pl_module, located, model)
        self.evaluation = found
        self.results = {pl_module.system_name: model, **found.rows, **found.baselines}
        scene = scene_datamodule(trainer).scene
        unit = "" if scene.unit == "m" else "; lengths are in the scene's own unit, not in metres"
        print_results(self.results, f"{scene.name}, {pl_module.headline}{unit}", found.extras)
        logger = run_logger(trainer)
        if logger is None:
            return
        _log_evaluation(logger, found)
        describe_run(logger, results_markdown(self.results, found.extras))
        best = checkpoint_folder(trainer) / "best.ckpt"
        if self.log_model and best.is_file():
            log_localizer(logger, best, scene.frames[scene.splits["test"][0]].image)
        print(f"run {logger.run_id} in {logger.uri}")


def _log_evaluation(logger: MLflowLogger, found: Evaluation) -> None:
    """Write an evaluation's metrics, curves, trajectories and figures to the run."""
    logger.log_metrics(
        found.extras | {f"baseline/{k}/{name}": v for k, r in found.baselines.items() for name, v in r.items()}
    )
    for name, curve in found.curves.items():
        for number, value in curve.items():
            logger.log_metrics({name: value}, step=number)
    _log_trajectories(logger, found.trajectories)
    for file, figure in found.figures.items():
        logger.client.log_figure(str(logger.run_id), figure, f"figures/{file}.png")


def describe_run(logger: MLflowLogger, text: str) -> None:
    """Make the table the run's description, unless a user has written one."""
    run = str(logger.run_id)
    written = logger.client.get_run(run).data.tags.get(NOTE)
    if not written or written.startswith("| test |"):
        logger.client.set_tag(run, NOTE, text)


def _log_trajectories(logger: MLflowLogger, trajectories: Mapping[str, tuple[list[Frame], Pose]]) -> None:
    """Write one TUM file per sequence to the run, in a folder for each kind of trajectory."""
    with tempfile.TemporaryDirectory() as folder:
        for name, (frames, pose) in trajectories.items():
            write_sequences(Path(folder) / name, frames, pose.position_m.numpy(), pose.quat_wxyz.numpy())
        logger.client.log_artifacts(str(logger.run_id), folder, "trajectories")
