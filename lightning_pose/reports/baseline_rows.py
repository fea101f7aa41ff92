"""Baselines as rows: what the runs on show printed beside their models."""

from __future__ import annotations

import re
from collections.abc import Sequence

from lightning_pose.reports.table import Cell, Report, Row, add_means
from lightning_pose.runs.reader import Run

__all__ = ["add_baselines"]

NAME = re.compile(r"baseline/(\w+)/position_median_m")
ORDER = (
    "train_mean",
    "retrieval_top1",
    "retrieval_top5",
    "oracle",
    "no_motion",
    "constant_velocity",
    "visual_odometry",
)
IN_FEATURES = ("retrieval_top1", "retrieval_top5")
"""What depends on the features; the others know only poses, or images."""

DIGITS = 4  # metres; one machine's features differ from another's in less


def add_baselines(report: Report) -> None:
    """Append the baselines of the runs on show: a row each, and for retrieval one for each kind of features.

    Baselines of one name that differ on one scene, because one system also learns from validation frames, or retrieves
    in other settings of its extractor, get rows that say beside which system they were measured.
    """
    owners: list[tuple[Row, set[str]]] = []
    for own in report.rows:
        if own.kind != "own":
            continue
        for name in _names([run for cell in own.cells.values() for run in cell.runs]):
            row = Row("baseline", name, own.features if name in IN_FEATURES else "", _cells(name, own))
            for other, systems in owners:
                if (other.system, other.features) == (name, row.features) and _agree(row, other):
                    other.cells |= {scene: cell for scene, cell in row.cells.items() if scene not in other.cells}
                    systems.add(own.system)
                    break
            else:
                owners.append((row, {own.system}))
    owners.sort(key=lambda pair: (_place(pair[0].system), pair[0].features))
    keys = [(row.system, row.features) for row, _ in owners]
    for (row, systems), key in zip(owners, keys, strict=True):
        if keys.count(key) > 1:
            row.system += f" beside {', '.join(sorted(systems))}"
    rows = [row for row, _ in owners]
    for row in rows:
        row.cells = {scene: row.cells[scene] for scene in report.scenes if scene in row.cells}
    add_means(report, rows)
    if not rows:
        report.notes.append("the runs on show have no baselines")
    elif any(" beside " in row.system for row in rows):
        report.notes.append(
            "baselines of one name differ where systems learn from different frames (some from validation frames too) "
            "or from other settings of their features: each is named with the systems it was measured beside"
        )
    report.rows += rows


def _names(runs: Sequence[Run]) -> list[str]:
    names = {found[1] for run in runs for metric in run.metrics if (found := NAME.fullmatch(metric))}
    return sorted(names, key=_place)


def _place(name: str) -> tuple[int, str]:
    return (ORDER.index(name) if name in ORDER else len(ORDER), name)


def _cells(name: str, own: Row) -> dict[str, Cell]:
    """A baseline on the scenes where the newest of the runs on show has it."""
    cells = {}
    for scene, cell in own.cells.items():
        run = cell.runs[0]
        if f"baseline/{name}/position_median_m" in run.metrics:
            errors = (run.metrics.get(f"baseline/{name}/{e}") for e in ("position_median_m", "orientation_median_deg"))
            position, orientation = errors
            assert position is not None
            cells[scene] = Cell(position, orientation, runs=(run,), candidates=1)
    return cells


def _agree(one: Row, other: Row) -> bool:
    shared = one.cells.keys() & other.cells.keys()
    return all(
        round(one.cells[scene].position_m, DIGITS) == round(other.cells[scene].position_m, DIGITS) for scene in shared
    )
