"""Evaluation of a model of clips, by clip length and over whole sequences, beside no motion and odometry."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from lightning import Trainer
from matplotlib.figure import Figure
from torch import Tensor

from lightning_pose.data.clip_datamodule import ClipDataModule, require_clips
from lightning_pose.data.clip_dataset import ClipDataset
from lightning_pose.data.datamodule import scene_datamodule
from lightning_pose.evaluation.baselines.clips import predict_constant_velocity, predict_no_motion
from lightning_pose.evaluation.baselines.visual_odometry import run_visual_odometry
from lightning_pose.evaluation.costs import costs
from lightning_pose.evaluation.responses import record_responses
from lightning_pose.evaluation.result import Evaluation, skill
from lightning_pose.figures import clips as clip_figures
from lightning_pose.geometry.quaternions import orientation_error_deg, position_error_m, quat_rotate
from lightning_pose.geometry.relative import absolute_poses, relative_poses
from lightning_pose.localization.sequences import chain_test_split
from lightning_pose.metrics.catalog import MEDIANS, reference_baseline
from lightning_pose.metrics.summary import summarize_errors
from lightning_pose.metrics.trajectory import drift_by_length, mean_over_sequences, trajectory_errors
from lightning_pose.models.base import Pose, PoseModule
from lightning_pose.scenes.scene import Frame

__all__ = ["LENGTHS", "evaluate_clips"]

LENGTHS = (2, 5, 10, 20, 50, 100, 200, 400)
"""Frames of the clips that errors are measured for, as far as sequences are long enough (thesis, fig. 6.4)."""

_FRAMES = 512  # in a batch, whatever the length of its clips


class Sequence(NamedTuple):
    """A run of M test frames and its trajectories: world poses, float64, all from the true first one.

    Attributes:
        rows: (M,) rows of the test split's data.
        frames: the M frames.
        truth: their true poses.
        systems: trajectories by name: the model's, and `visual_odometry` where it ran.
        failed_steps: of visual odometry, which does not move where images do not match.
    """

    rows: Tensor
    frames: list[Frame]
    truth: Pose
    systems: dict[str, Pose]
    failed_steps: int


def evaluate_clips(
    trainer: Trainer, module: PoseModule, model: Mapping[str, float], odometry: bool = True
) -> Evaluation:
    """Evaluate a test of clips, also on clips of other lengths, and on clips chained over whole sequences.

    Args:
        trainer: after the test.
        module: a model of clips.
        model: the model's metrics over clips of the data's own length.
        odometry: match images for visual odometry.
    """
    datamodule = require_clips(scene_datamodule(trainer))
    name = type(module.eval()).__name__
    sequences = _chain_sequences(datamodule, module, odometry)
    lengths = sorted({n for n in (*LENGTHS, datamodule.clip_length) if n <= datamodule.longest_clip("test")})
    motion = _read_odometry(datamodule, sequences) if odometry else None
    found = {n: _evaluate_length(datamodule, module, motion, n) for n in lengths}
    baselines = {system: m for system, m in found[datamodule.clip_length].items() if system != name}
    tracking = _measure_tracking(sequences)
    curves = {
        f"{_metric_prefix(system, name)}/{metric}_by_length": {n: found[n][system][metric] for n in lengths}
        for system in found[lengths[0]]
        for metric in MEDIANS
    }
    extras = skill(model, baselines[reference_baseline(clips=True)]) | costs(trainer, module, datamodule.clip_length)
    for system, metrics in tracking.items():
        extras |= {f"{_metric_prefix(system, name)}/{metric}": value for metric, value in metrics.items()}
    if odometry:
        extras["baseline/visual_odometry/failed_steps"] = float(sum(sequence.failed_steps for sequence in sequences))
    figures = _draw_clip_figures(datamodule, name, sequences, found)
    if len(module.input_shape) == 3:
        figures["responses"] = _draw_responses(datamodule, module)
    return Evaluation(
        baselines=baselines,
        extras=extras,
        trajectories=_join_trajectories(sequences, name),
        figures=figures,
        curves=curves | _drift_curves(sequences, name, lengths),
    )


def _metric_prefix(system: str, model: str) -> str:
    """What the names of a system's metrics begin with."""
    return "test" if system == model else f"baseline/{system}"


def _chain_sequences(datamodule: ClipDataModule, module: PoseModule, odometry: bool) -> list[Sequence]:
    """Chain clips over every run of test frames that holds two."""
    scene, data = datamodule.scene, datamodule.dataset("test").data
    found = []
    for rows, *chained in chain_test_split(module, datamodule):
        frames = [scene.frames[i] for i in data.frame[rows].tolist()]
        truth = Pose(data.position_m[rows].double(), data.quat_wxyz[rows].double())
        systems, failed = {type(module).__name__: Pose(*chained)}, 0
        if odometry:
            systems["visual_odometry"], failed = _follow_frames(frames, truth)
        found.append(Sequence(rows, frames, truth, systems, failed))
    return found


def _follow_frames(frames: list[Frame], truth: Pose) -> tuple[Pose, int]:
    """Visual odometry over frames from the true pose of the first, and how many steps failed."""
    motion = run_visual_odometry(frames, torch.arange(len(frames))[None])
    start = truth.position_m[0], truth.quat_wxyz[0]
    return Pose(*absolute_poses(motion.position_m[0], motion.quat_wxyz[0], *start)), motion.failed_steps


def _read_odometry(datamodule: ClipDataModule, sequences: list[Sequence]) -> Pose:
    """Visual odometry's poses (M, ...) of all M test frames, for clips: also those that a stride leaves out of chains.

    Poses of frames that no clip has together are of different chains.
    """
    scene, data = datamodule.scene, datamodule.dataset("test").data
    found = Pose(torch.zeros(len(data.frame), 3).double(), torch.zeros(len(data.frame), 4).double())
    parts = [(sequence.rows, sequence.systems["visual_odometry"]) for sequence in sequences]
    for run in map(torch.from_numpy, datamodule.dataset("test").runs):
        for rows in (run[offset :: datamodule.stride] for offset in range(1, datamodule.stride)):
            if len(rows) > 1:
                frames = [scene.frames[i] for i in data.frame[rows].tolist()]
                truth = Pose(data.position_m[rows].double(), data.quat_wxyz[rows].double())
                parts.append((rows, _follow_frames(frames, truth)[0]))
    for rows, pose in parts:
        found.position_m[rows], found.quat_wxyz[rows] = pose
    return found


def _evaluate_length(
    datamodule: ClipDataModule, module: PoseModule, odometry: Pose | None, length: int
) -> dict[str, dict[str, float]]:
    """Metrics of the model, first, and of every baseline on clips of one length, first frames left out."""
    own = length == datamodule.clip_length  # with its own hop, as the model's metrics are
    clips = datamodule.dataset("test") if own else datamodule.clips("test", length)
    truth = Pose(*(part.double() for part in clips.targets()))
    count = len(clips)
    position_m, quat_wxyz = datamodule.dataset("train").targets()
    velocity = predict_constant_velocity(position_m, quat_wxyz, length, datamodule.relative_frame)
    answers = {
        type(module).__name__: _predict_clips(module, clips),
        "no_motion": Pose(*predict_no_motion(count, length)),
        "constant_velocity": Pose(velocity[0].expand(count, -1, 3), velocity[1].expand(count, -1, 4)),
    }
    if odometry is not None:
        answers["visual_odometry"] = _cut_odometry(odometry, clips)
    return {system: _summarize_clips(answer, truth) for system, answer in answers.items()}


def _predict_clips(module: PoseModule, clips: ClipDataset) -> Pose:
    """The model's poses of all clips, (W, T, 3) and (W, T, 4)."""
    size = max(1, _FRAMES // clips.shape.length)
    poses = []
    with torch.inference_mode():
        for start in range(0, len(clips), size):
            batch = clips.__getitems__(range(start, min(start + size, len(clips))))
            poses.append(module(batch.features.to(module.device)))
    return Pose(*(torch.cat(parts).double().cpu() for parts in zip(*poses, strict=True)))


def _cut_odometry(odometry: Pose, clips: ClipDataset) -> Pose:
    """Visual odometry's poses of all clips (W, T, ...); in world axes it gets each clip's true first orientation."""
    position_m, quat_wxyz = (part[clips.rows()] for part in odometry)
    moved, turned = relative_poses(position_m, quat_wxyz)
    if clips.relative_frame == "world":
        moved = quat_rotate(clips.data.quat_wxyz[clips.rows()[:, :1]].double(), moved)
    return Pose(moved, turned)


def _summarize_clips(answer: Pose, truth: Pose) -> dict[str, float]:
    """Metrics of relative poses (W, T, ...), first frames left out."""
    positions, quats = ([part[:, 1:] for part in pair] for pair in zip(answer, truth, strict=True))
    return summarize_errors(position_error_m(*positions), orientation_error_deg(*quats))


def _measure_tracking(sequences: list[Sequence]) -> dict[str, dict[str, float]]:
    """ATE and RPE of each system, the mean over sequences."""
    return {
        system: mean_over_sequences(
            {str(i): trajectory_errors(*s.systems[system], *s.truth) for i, s in enumerate(sequences)}
        )
        for system in sequences[0].systems
    }


def _drift_curves(sequences: list[Sequence], name: str, lengths: list[int]) -> dict[str, dict[int, float]]:
    """Error at the end of sub-trajectories by their number of frames, the mean over sequences that are long enough."""
    curves: dict[str, dict[int, float]] = {}
    for system in sequences[0].systems:
        drifts = [drift_by_length(*s.systems[system], *s.truth, [n - 1 for n in lengths]) for s in sequences]
        for part in ("position_m", "orientation_deg", "percent"):
            values = torch.tensor([getattr(drift, part).tolist() for drift in drifts]).nanmean(0)
            measured = {n: float(value) for n, value in zip(lengths, values, strict=True) if not value.isnan()}
            curves[f"{_metric_prefix(system, name)}/drift_{part}_by_length"] = measured
    return curves


def _draw_clip_figures(
    datamodule: ClipDataModule,
    name: str,
    sequences: list[Sequence],
    found: Mapping[int, Mapping[str, Mapping[str, float]]],
) -> dict[str, Figure]:
    """The run's figures by file name.

    Args:
        datamodule: of the test.
        name: the model's.
        sequences: as `_chain_sequences` returns them.
        found: metrics by clip length and system.
    """
    scene = datamodule.scene
    shown = _title_sequences(sequences)
    lengths = list(found)
    errors = {
        system: ([found[n][system][MEDIANS[0]] for n in lengths], [found[n][system][MEDIANS[1]] for n in lengths])
        for system in found[lengths[0]]
    }
    return {
        "trajectory": clip_figures.draw_relative_trajectories(
            {title: s.truth.position_m.numpy() for title, s in shown.items()},
            {title: s.systems[name].position_m.numpy() for title, s in shown.items()},
            title=f"{name} on {scene.name}, chained from the start",
            unit=scene.unit,
        ),
        "error_by_length": clip_figures.draw_error_by_length(
            lengths, errors, title=f"{name} on {scene.name}", unit=scene.unit
        ),
    }


def _title_sequences(sequences: list[Sequence]) -> dict[str, Sequence]:
    """Sequences by title: the name, with a number where a sequence has gaps and so several runs."""
    names = [sequence.frames[0].sequence for sequence in sequences]
    numbered = (
        f"{name} #{names[:i].count(name) + 1}" if names.count(name) > 1 else name for i, name in enumerate(names)
    )
    return dict(zip(numbered, sequences, strict=True))


def _draw_responses(datamodule: ClipDataModule, module: PoseModule) -> Figure:
    """Responses of the first two layers to the middle frame of the first test clip."""
    clip = datamodule.dataset("test")[0].features
    middle = len(clip) // 2
    layers = {name: list(out[middle].numpy()) for name, out in record_responses(module, clip).items()}
    images = [image.permute(1, 2, 0).numpy() for image in clip]
    return clip_figures.draw_responses(images, layers, title=f"What {type(module).__name__} responds to")


def _join_trajectories(sequences: list[Sequence], name: str) -> dict[str, tuple[list[Frame], Pose]]:
    """Frames with true poses (`truth`) and with the model's (`predictions`), sequence after sequence."""
    frames = [frame for s in sequences for frame in s.frames]
    parts = {"truth": [s.truth for s in sequences], "predictions": [s.systems[name] for s in sequences]}
    return {
        kind: (frames, Pose(*(torch.cat(part) for part in zip(*poses, strict=True)))) for kind, poses in parts.items()
    }
