"""What every test ends with: baselines beside the model, costs, figures, prediction files, and one table."""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from lightning_pose import plots
from lightning_pose.baselines import BaselineResult, evaluate_baselines
from lightning_pose.callbacks import checkpoint_folder, run_logger, train_seconds
from lightning_pose.data.batches import PoseBatch
from lightning_pose.data.scene import Scene
from lightning_pose.geometry import orientation_error_deg, position_error_m
from lightning_pose.models.base import Pose
from lightning_pose.tracking import MLflowLogger, log_localizer
from lightning_pose.tum import write_sequences

__all__ = ["TestReport", "print_results"]

COLUMNS = {
    "position_median_m": ("median\nm", "{:.3f}"),
    "orientation_median_deg": ("median\ndeg", "{:.2f}"),
    "position_mean_m": ("mean\nm", "{:.3f}"),
    "orientation_mean_deg": ("mean\ndeg", "{:.2f}"),
    "position_p95_m": ("95 %\nm", "{:.3f}"),
    "orientation_p95_deg": ("95 %\ndeg", "{:.2f}"),
    "recall_5cm_5deg": ("5 cm\n5 deg", "{:.0%}"),
    "recall_10cm_5deg": ("10 cm\n5 deg", "{:.0%}"),
    "recall_25cm_2deg": ("25 cm\n2 deg", "{:.0%}"),
    "recall_50cm_5deg": ("50 cm\n5 deg", "{:.0%}"),
}


class TestReport(Callback):
    """Gathers the test's predictions and, at its end, logs and prints all that belongs beside them.

    Args:
        log_model: keep a model in the run that `mlflow.pyfunc.load_model` loads.
    """

    __test__ = False  # not a test case, whatever pytest makes of its name

    def __init__(self, log_model: bool = True) -> None:
        self.log_model = log_model
        self.results: dict[str, dict[str, float]] = {}
        self._poses: list[Pose] = []

    def on_test_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._poses = []

    def on_test_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, *args: Any, **kwargs: Any
    ) -> None:
        self._poses.append(Pose(*(tensor.float().cpu() for tensor in outputs)))

    def on_test_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if not trainer.is_global_zero:
            return
        datamodule = trainer.datamodule  # type: ignore[attr-defined]
        train, test = (datamodule.dataset(split).data for split in ("train", "test"))
        prediction = Pose(*(torch.cat(parts) for parts in zip(*self._poses, strict=True)))
        appearance = datamodule.extractor.appearance
        baselines = evaluate_baselines(
            appearance(train.features),
            train.position_m,
            train.quat_wxyz,
            appearance(test.features),
            test.position_m,
            test.quat_wxyz,
        )
        model = {
            name.removeprefix("test/"): float(value)
            for name, value in trainer.callback_metrics.items()
            if name.startswith("test/")
        }
        self.results = {type(pl_module).__name__: model} | {k: v.metrics for k, v in baselines.items()}
        extras = _skill(model, baselines["retrieval_top1"].metrics) | _costs(trainer, pl_module)
        print_results(self.results, f"{datamodule.scene.name}, {pl_module.headline}", extras)
        logger = run_logger(trainer)
        if logger is None:
            return
        logger.log_metrics(
            extras | {f"baseline/{k}/{name}": v for k, r in baselines.items() for name, v in r.metrics.items()}
        )
        name = type(pl_module).__name__
        poses = {name: Pose(*(tensor.double() for tensor in prediction)), **baselines}
        truth = Pose(test.position_m, test.quat_wxyz)
        _log_trajectories(logger, datamodule.scene, test, {"truth": truth, "predictions": prediction})
        for file, figure in _figures(datamodule.scene, name, train, test, poses).items():
            logger.client.log_figure(str(logger.run_id), figure, f"figures/{file}.png")
        best = checkpoint_folder(trainer) / "best.ckpt"
        if self.log_model and best.is_file():
            log_localizer(logger, best)
        print(f"run {logger.run_id} in {logger.uri}")


def _skill(model: Mapping[str, float], retrieval: Mapping[str, float]) -> dict[str, float]:
    """Model error over top-1 retrieval error: below 1, learning helped."""
    pairs = {"test/skill_position": "position_median_m", "test/skill_orientation": "orientation_median_deg"}
    return {
        name: model[metric] / retrieval[metric] if retrieval[metric] else float("inf") for name, metric in pairs.items()
    }


def _costs(trainer: Trainer, module: LightningModule) -> dict[str, float]:
    """What the localizer costs: to train, to keep, and per frame, features and network apart."""
    datamodule = trainer.datamodule  # type: ignore[attr-defined]
    features = datamodule.dataset("test").data.features
    costs = {
        "cost/parameters": float(sum(p.numel() for p in module.network.parameters())),  # type: ignore[union-attr]
        "cost/ms_per_frame": _milliseconds(lambda i: module(features[i : i + 1].to(module.device)), len(features)),
        "cost/features_ms_per_frame": _features_milliseconds(datamodule),
        "cost/frame_bytes": float(features[0].numel() * features.element_size()),
    }
    best = checkpoint_folder(trainer) / "best.ckpt"
    if best.is_file():
        costs["cost/checkpoint_bytes"] = float(best.stat().st_size)
    seconds = train_seconds(trainer)
    return costs | ({"cost/train_seconds": seconds} if seconds else {})


def _features_milliseconds(datamodule: Any) -> float:
    extractor, scene = datamodule.extractor, datamodule.scene
    files = [scene.frames[i].image for i in scene.splits["test"][:10]]
    return _milliseconds(lambda i: extractor.extract([extractor.read(files[i])]), len(files))


def _milliseconds(work: Callable[[int], Any], count: int, most: int = 30) -> float:
    """Median time of one call, after one that warms up."""
    times = []
    with torch.inference_mode():
        work(0)
        for i in range(min(count, most)):
            start = time.perf_counter()
            work(i)
            times.append((time.perf_counter() - start) * 1e3)
    return statistics.median(times)


def _log_trajectories(logger: MLflowLogger, scene: Scene, test: PoseBatch, poses: Mapping[str, Pose]) -> None:
    frames = [scene.frames[i] for i in test.frame.tolist()]
    with tempfile.TemporaryDirectory() as folder:
        for name, pose in poses.items():
            write_sequences(Path(folder) / name, frames, pose.position_m.numpy(), pose.quat_wxyz.numpy())
        logger.client.log_artifacts(str(logger.run_id), folder, "trajectories")


def print_results(results: Mapping[str, Mapping[str, float]], title: str, extras: Mapping[str, float]) -> None:
    """Print one row a system, best known facts first, and the skill and costs below."""
    table = Table(title=title, caption="  ".join(_said(name, value) for name, value in extras.items()))
    table.add_column("test")
    for heading, _ in COLUMNS.values():
        table.add_column(heading, justify="right")
    for i, (system, metrics) in enumerate(results.items()):
        cells = [form.format(metrics[name]) for name, (_, form) in COLUMNS.items()]
        table.add_row(system, *cells, style="bold" if i == 0 else None, end_section=i == 0)
    Console(width=None if sys.stdout.isatty() else 120).print(table)


def _said(name: str, value: float) -> str:
    """`cost/train_seconds` 12.34 as `train seconds 12.3`."""
    number = f"{value:,.0f}" if value >= 1000 else f"{value:.3g}"
    return f"{name.partition('/')[2].replace('_', ' ')} {number}"


def _figures(
    scene: Scene, name: str, train: PoseBatch, test: PoseBatch, poses: Mapping[str, Pose | BaselineResult]
) -> dict[str, Figure]:
    """The run's figures by file name; `poses` has the model's first, then the baselines'."""
    frames = [scene.frames[i] for i in test.frame.tolist()]
    errors = {
        system: (
            position_error_m(pose.position_m, test.position_m.double()).numpy(),
            orientation_error_deg(pose.quat_wxyz, test.quat_wxyz.double()).numpy(),
        )
        for system, pose in poses.items()
    }
    model = errors.pop(name)
    about = f"{name} on {scene.name}"
    return {
        "trajectory": plots.trajectory(
            test.position_m.numpy(),
            poses[name].position_m.numpy(),
            [frame.sequence for frame in frames],
            train.position_m.numpy(),
            title=about,
            unit=scene.unit,
        ),
        "cumulative_errors": plots.cumulative_errors(model, errors, name, title=about, unit=scene.unit),
        "error_vs_distance": plots.error_vs_distance(model[0], errors["oracle"][0], title=about, unit=scene.unit),
    }
