"""Evaluation of a model of single images, beside the mean pose, image retrieval and its oracle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from lightning import Trainer
from matplotlib.figure import Figure
from torch import Tensor

from lightning_pose.data.batches import PoseBatch
from lightning_pose.data.datamodule import SceneDataModule, scene_datamodule
from lightning_pose.evaluation.baselines.images import BaselineResult, evaluate_baselines
from lightning_pose.evaluation.costs import costs
from lightning_pose.evaluation.maps import (
    MapEvaluation,
    draw_examples,
    evaluate_map,
    measure_accepted,
    measure_coverage,
)
from lightning_pose.evaluation.result import Evaluation, skill
from lightning_pose.figures import images as image_figures
from lightning_pose.figures.maps import draw_calibration
from lightning_pose.geometry.quaternions import orientation_error_deg, position_error_m
from lightning_pose.metrics.catalog import MEDIANS, reference_baseline
from lightning_pose.metrics.summary import summarize_errors
from lightning_pose.models.base import Pose, PoseModule
from lightning_pose.models.landmark_map import LandmarkMap
from lightning_pose.models.parts.poses import Located
from lightning_pose.scenes.scene import Scene

__all__ = ["evaluate_images", "match_rows"]

CHUNK = 64
"""Frames that a network is asked for at once."""


def evaluate_images(trainer: Trainer, module: PoseModule, located: Located, model: Mapping[str, float]) -> Evaluation:
    """Evaluate a test of single images.

    Args:
        trainer: after the test.
        module: the model.
        located: poses of the test frames, or of some of them.
        model: its metrics.
    """
    datamodule = scene_datamodule(trainer)
    scene = datamodule.scene
    train, test = _join_splits(datamodule, module.training_splits), datamodule.dataset("test").data
    rows = match_rows(test.frame, located.frame)
    test = PoseBatch(*(tensor[rows] for tensor in test))
    prediction = Pose(located.position_m.double(), located.quat_wxyz.float())
    appearance = datamodule.extractor.appearance
    baselines = evaluate_baselines(
        appearance(train.features),
        train.position_m,
        train.quat_wxyz,
        appearance(test.features),
        test.position_m,
        test.quat_wxyz,
    )
    name = module.system_name
    poses = {name: Pose(*(tensor.double() for tensor in prediction)), **baselines}
    frames = [scene.frames[i] for i in test.frame.tolist()]
    metrics = {system: result.metrics for system, result in baselines.items()}
    on_map = _evaluate_map(module, prediction, datamodule, test)
    return Evaluation(
        baselines=metrics,
        rows=on_map.rows,
        extras=skill(model, metrics[reference_baseline(clips=False)]) | on_map.metrics | costs(trainer, module),
        trajectories={"truth": (frames, Pose(test.position_m, test.quat_wxyz)), "predictions": (frames, prediction)},
        figures=_draw_image_figures(scene, name, train, test, poses) | on_map.figures,
    )


def _evaluate_map(module: PoseModule, prediction: Pose, datamodule: SceneDataModule, test: PoseBatch) -> MapEvaluation:
    """What only a map has, or a system with one beside it; empty for others."""
    network, scene = module.map_network, datamodule.scene
    if network is None:
        return _evaluate_radius(module, prediction, scene, test)
    if isinstance(module, LandmarkMap):
        answers = module.locate_frames(test)
    else:
        assert module.refinement is not None, "it has the map"
        answers = module.refinement.locate_frames(test.frame.tolist())
    found = evaluate_map(network, answers, module.world_frame, prediction, scene, test, module.system_name)
    found.figures |= draw_examples(network, answers, prediction, test, datamodule, module.system_name)
    if isinstance(module, LandmarkMap):
        return found
    alone = _measure_alone(module, test)
    found.metrics |= {f"test/alone_{name}": alone[name] for name in MEDIANS}
    return replace(found, rows={**found.rows, f"{type(module).__name__} alone": alone})


@torch.inference_mode()
def _evaluate_radius(module: PoseModule, prediction: Pose, scene: Scene, test: PoseBatch) -> MapEvaluation:
    """Which frames a regressor accepts, and how well its radii hold their errors; empty where it has none."""
    if module.radius is None:
        return MapEvaluation({}, {}, {})
    parts = [module.radius.find_radii(chunk.to(module.device)) for chunk in test.features.split(CHUNK)]
    radii = torch.cat([part[0] for part in parts]).numpy(), torch.cat([part[1] for part in parts]).numpy()
    errors = (
        position_error_m(prediction.position_m.double(), test.position_m.double()).numpy(),
        orientation_error_deg(prediction.quat_wxyz.double(), test.quat_wxyz.double()).numpy(),
    )
    accepted = ~module.find_refused(test)
    metrics, rows = measure_accepted(errors, accepted) if module.radius.has_limit else ({}, {})
    if accepted.all():
        rows = {}  # the same as all frames
    errors, radii = ((each[0][accepted], each[1][accepted]) for each in (errors, radii))
    coverage = measure_coverage(errors, radii)
    about = f"{module.system_name} on {scene.name}"
    figures = {"calibration": draw_calibration(errors, radii, title=about, unit=scene.unit)} if coverage else {}
    return MapEvaluation(metrics | coverage, rows, figures)


@torch.inference_mode()
def _measure_alone(module: PoseModule, test: PoseBatch) -> dict[str, float]:
    """The errors of a refined system's own network, which is asked again: `test_step` returned refined poses."""
    parts = [module(features.to(module.device)) for features in test.features.split(CHUNK)]
    position, quat = (torch.cat(tensors).cpu().double() for tensors in zip(*parts, strict=True))
    return summarize_errors(
        position_error_m(position, test.position_m.double()), orientation_error_deg(quat, test.quat_wxyz.double())
    )


def match_rows(frame: Tensor, wanted: Tensor) -> Tensor:
    """(M,) rows of `frame` (N,), in any order, that hold each wanted frame (M,)."""
    order = frame.argsort()
    return order[torch.searchsorted(frame[order], wanted)]


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
