"""The results of a study as files: its figure and its table."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from optuna import Study

from lightning_pose.errors import ConfigError
from lightning_pose.features.keypoint_statistics import FrameKeypoints, read_frame_keypoints
from lightning_pose.studies.figure import draw_groups, draw_keypoints
from lightning_pose.studies.figure_spec import FigureSpec
from lightning_pose.studies.neighbours import draw_neighbours, read_neighbours
from lightning_pose.studies.table import Group, build_rows, read_groups, varying_settings, write_csv
from lightning_pose.sweeps.base_config import ParsedConfig, open_keypoint_data
from lightning_pose.sweeps.plan import Plan
from lightning_pose.sweeps.space import SCENE, suggest_name
from lightning_pose.terminal import Sheet, format_markdown

__all__ = ["write_study"]


def write_study(study: Study, plan: Plan, spec: FigureSpec, folder: Path) -> tuple[list[Path], Sheet]:
    """Draw a study's figure, and write its table as `table.md` and, with all that was measured, as `table.csv`.

    Returns:
        The files, and the table for the terminal.

    Raises:
        ConfigError: the figure shows what no trial has measured.
    """
    groups = read_groups(study, plan)
    _check_measured(groups, spec)
    title = spec.title or study.study_name
    if SCENE not in varying_settings(groups):  # where it varies, the figure names the scenes
        title = f"{title}, {plan.scene}"
    ended = [group for group in groups if group.metrics]
    if spec.kind == "pictures":
        figure = draw_keypoints(dict(_read_keypoints(plan, group) for group in ended), title)
    elif spec.kind == "neighbours":
        found = [read_neighbours(ParsedConfig(plan.arguments(group.values))) for group in ended]
        names = [_title_panel(group, scene.scene) for group, scene in zip(ended, found, strict=True)]
        figure = draw_neighbours(dict(zip(names, found, strict=True)), title)
    else:
        figure = draw_groups(ended, spec, title)
    heads, rows = build_rows(groups, spec)
    files = [folder / name for name in ("figure.png", "table.csv", "table.md")]
    figure.savefig(files[0])
    files[1].write_text(write_csv(groups, plan))
    files[2].write_text(format_markdown(heads, rows) + "\n")
    return files, Sheet(title, heads, rows)


def _read_keypoints(plan: Plan, group: Group) -> tuple[str, FrameKeypoints]:
    """The name of a group's scene, and the keypoints of one of its frames."""
    data, _, images = open_keypoint_data(ParsedConfig(plan.arguments(group.values)))
    frame = read_frame_keypoints(data.cache, data.scene.name, images)
    return group.names[SCENE] if group.values.get(SCENE) else frame.scene, frame


def _title_panel(group: Group, scene: str) -> str:
    """The scene's name, and the group's other settings."""
    name = group.names[SCENE] if group.values.get(SCENE) else scene
    return ", ".join([name, *(f"{key.rpartition('.')[2]} {text}" for key, text in group.names.items() if key != SCENE)])


def _check_measured(groups: Sequence[Group], spec: FigureSpec) -> None:
    known = sorted({name for group in groups for found in (*group.metrics, *group.curves) for name in found})
    baselines = sorted({name.split("/")[1] for name in known if name.startswith("baseline/")})
    remedy = "correct the file, and the same command draws what there is"
    for name in (*spec.y, *spec.table):
        if name not in known:
            why = f"which no trial has measured ({suggest_name(name, known)})"
            raise ConfigError(f"figure shows {name}, {why}; {remedy}")
    for name in spec.beside:
        if name not in baselines:
            raise ConfigError(
                f"figure.beside has {name}, which is no baseline ({suggest_name(name, baselines)}); {remedy}"
            )
