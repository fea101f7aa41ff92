"""Evaluation of a model of single images, beside the mean pose, image retrieval and its oracle."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from lightning import Trainer
from matplotlib.figure import Figure

from lightning_pose.data.batches import PoseBatch
from lightning_pose.data.datamodule import SceneDataModule, scene_datamodule
from lightning_pose.evaluation.baselines.images import BaselineResult, evaluate_baselines
from lightning_pose.evaluation.costs import costs
from lightning_pose.evaluation.result import Evaluation, skill
from lightning_pose.figures import images as image_figures
from lightning_pose.geometry.quaternions import orientation_error_deg, position_error_m
from lightning_pose.metrics.catalog import reference_baseline
from lightning_pose.models.base import Pose, PoseModule
from lightning_pose.scenes.scene import Scene

__all__ = ["evaluate_images"]


def evaluate_images(
    trainer: Trainer, module: PoseModule, outputs: list[Pose], model: Mapping[str, float]
) -> Evaluation:
    """Evaluate a test of single images.

    Args:
        trainer: after the test.
        module: the model.
        outputs: poses of each batch.
        model: its metrics.
    """
    datamodule = scene_datamodule(trainer)
    scene = datamodule.scene
    train, test = _join_splits(datamodule, module.training_splits), datamodule.dataset("test").data
    prediction = Pose(*(torch.cat(parts) for parts in zip(*outputs, strict=True)))
    appearance = datamodule.extractor.appearance
    baselines = evaluate_baselines(
        appearance(train.features),
        train.position_m,
        train.quat_wxyz,
        appearance(test.features),
        test.position_m,
        test.quat_wxyz,
    )
    name = type(module).__name__
    poses = {name: Pose(*(tensor.double() for tensor in prediction)), **baselines}
    frames = [scene.frames[i] for i in test.frame.tolist()]
    metrics = {system: result.metrics for system, result in baselines.items()}
    return Evaluation(
        baselines=metrics,
        extras=skill(model, metrics[reference_baseline(clips=False)]) | costs(trainer, module),
        trajectories={"truth": (frames, Pose(test.position_m, test.quat_wxyz)), "predictions": (frames, prediction)},
        figures=_draw_image_figures(scene, name, train, test, poses),
    )


def _join_splits(datamodule: SceneDataModule, splits: tuple[str, ...]) -> PoseBatch:
    """The frames of one split or more, in the order of the splits."""
    parts = [datamodule.dataset(split).data for split in splits]
    return PoseBatch(*(torch.cat(tensors) for tensors in zip(*parts, strict=True))) if len(parts) > 1 else parts[0]


def _draw_image_figures(
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
        "trajectory": image_figures.draw_trajectory(
            test.position_m.numpy(),
            poses[name].position_m.numpy(),
            [frame.sequence for frame in frames],
            train.position_m.numpy(),
            title=about,
            unit=scene.unit,
        ),
        "cumulative_errors": image_figures.draw_cumulative_errors(model, errors, name, title=about, unit=scene.unit),
        "error_vs_distance": image_figures.draw_error_vs_distance(
            model[0], errors["oracle"][0], title=about, unit=scene.unit
        ),
    }
