"""The result of a test beside the model's own metrics: baselines, costs, curves, trajectories, figures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from matplotlib.figure import Figure

from lightning_pose.metrics.catalog import MEDIANS, SKILLS
from lightning_pose.models.base import Pose
from lightning_pose.scenes.scene import Frame

__all__ = ["Evaluation", "skill"]


@dataclass
class Evaluation:
    """What a test found.

    Attributes:
        baselines: name to metrics, beside which the model stands.
        extras: further metrics by their whole name.
        curves: metrics over a whole number (a clip's length): name to {number: value}.
        trajectories: `truth` and `predictions` to frames with their poses, for TUM files.
        figures: by file name.
        rows: further rows of the model itself for the printed table, such as over accepted frames alone.
    """

    baselines: Mapping[str, Mapping[str, float]]
    extras: dict[str, float]
    trajectories: Mapping[str, tuple[list[Frame], Pose]]
    figures: Mapping[str, Figure]
    curves: Mapping[str, Mapping[int, float]] = field(default_factory=dict)
    rows: Mapping[str, Mapping[str, float]] = field(default_factory=dict)


def skill(model: Mapping[str, float], baseline: Mapping[str, float]) -> dict[str, float]:
    """The model's median errors divided by a baseline's, as `test/skill_*`; below 1, the model is better.

    A baseline without error, as where the camera never moves, gives no skill.
    """
    return {
        f"test/{name}": model[metric] / baseline[metric]
        for name, metric in zip(SKILLS, MEDIANS, strict=True)
        if baseline[metric]
    }
