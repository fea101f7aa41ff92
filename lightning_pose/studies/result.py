"""What a study ends in: its figure and its table, as files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from optuna import Study

from lightning_pose.errors import ConfigError
from lightning_pose.features.keypoint_statistics import FrameKeypoints, read_frame_keypoints
from lightning_pose.studies.figure import draw_cells, draw_keypoints
from lightning_pose.studies.figure_spec import FigureSpec
from lightning_pose.studies.table import Cell, as_csv, as_markdown, as_sheet, gather, varying
from lightning_pose.sweeps.base_config import ParsedConfig, open_keypoint_data
from lightning_pose.sweeps.plan import Plan
from lightning_pose.sweeps.space import SCENE, nearest
from lightning_pose.terminal import Sheet

__all__ = ["show_study"]


def show_study(study: Study, plan: Plan, spec: FigureSpec | None, folder: Path) -> tuple[list[Path], Sheet | None]:
    """Draw a study's figure, and write its table as `table.md` and, with all that was measured, as `table.csv`.

    Returns:
        The files, and the table for the terminal; none for pictures, which have no numbers.

    Raises:
        ConfigError: it is to show what no trial has measured.
    """
    if spec is None:
        return [], None
    cells = gather(study, plan)
    _check_measured(cells, spec)
    title = spec.title or study.study_name
    if SCENE not in varying(cells):  # where it does, the scenes are named beside their curves
        title = f"{title}, {plan.scene}"
    figure = folder / "figure.png"
    if spec.kind == "pictures":
        shown = [cell for cell in cells if cell.metrics]
        frames = [_read_keypoints(plan, cell) for cell in shown]
        names = [
            cell.names[SCENE] if cell.values.get(SCENE) else frame.scene
            for cell, frame in zip(shown, frames, strict=True)
        ]
        draw_keypoints(dict(zip(names, frames, strict=True)), title).savefig(figure)
    else:
        draw_cells(cells, spec, title).savefig(figure)
    (folder / "table.csv").write_text(as_csv(cells, plan))
    (folder / "table.md").write_text(as_markdown(cells, spec))
    return [figure, folder / "table.csv", folder / "table.md"], as_sheet(cells, spec, title)


def _read_keypoints(plan: Plan, cell: Cell) -> FrameKeypoints:
    data, images = open_keypoint_data(ParsedConfig(plan.arguments(cell.values)))
    return read_frame_keypoints(data.cache, data.scene.name, images)


def _check_measured(cells: Sequence[Cell], spec: FigureSpec) -> None:
    held = [found for cell in cells for found in (*cell.metrics, *cell.curves)]
    known = sorted(set[str]().union(*held))
    baselines = sorted({name.split("/")[1] for name in known if name.startswith("baseline/")})
    again = "correct the file, and the same command draws what there is"
    for name in (*spec.y, *spec.table):
        if name not in known:
            raise ConfigError(f"figure shows {name}, which no trial has measured ({nearest(name, known)}); {again}")
    for name in spec.beside:
        if name not in baselines:
            raise ConfigError(f"figure.beside has {name}, which is no baseline ({nearest(name, baselines)}); {again}")
