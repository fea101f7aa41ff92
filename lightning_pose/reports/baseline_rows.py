"""Baselines as rows: what the tests of the runs on show measured beside their models."""

from __future__ import annotations

from lightning_pose.metrics.catalog import BASELINES, MEDIANS, Baseline
from lightning_pose.reports.table import Cell, Report, Row, add_means
from lightning_pose.runs.reader import Run

__all__ = ["add_baselines"]

DIGITS = 4  # metres; one machine's features differ from another's in less


def add_baselines(report: Report) -> None:
    """Append the baselines of the runs on show: a row each, and for retrieval one for each kind of features.

    Baselines of one name that differ on one scene, because one system also learns from validation frames, or retrieves
    in other settings of its extractor, get rows that say beside which system they were measured.
    """
    found: list[tuple[Row, set[str]]] = []
    for own in [row for row in report.rows if row.kind == "own"]:
        runs = {scene: cell.runs for scene, cell in own.cells.items()}
        for name in _list_names([run for cell in runs.values() for run in cell]):
            features = own.features if BASELINES.get(name, Baseline()).reads_features else ""
            cells = {scene: cell for scene in runs if (cell := _read_cell(name, runs[scene][0]))}
            row = Row("baseline", name, features, cells)
            for other, systems in found:
                if (other.system, other.features) == (name, features) and _agree_on_scenes(row, other):
                    other.cells = row.cells | other.cells
                    systems.add(own.system)
                    break
            else:
                found.append((row, {own.system}))
    found.sort(key=lambda pair: (_sort_name(pair[0].system), pair[0].features))
    keys = [(row.system, row.features) for row, _ in found]
    for row, systems in found:
        if keys.count((row.system, row.features)) > 1:
            row.system += f" beside {', '.join(sorted(systems))}"
        row.cells = {scene: row.cells[scene] for scene in report.scenes if scene in row.cells}
    rows = [row for row, _ in found]
    add_means(report, rows)
    if not rows:
        report.notes.append("the runs on show have no baselines")
    elif len(set(keys)) < len(keys):
        report.notes.append(
            "baselines of one name differ where systems learn from different frames (some from validation frames too) "
            "or from other settings of their features: each is named with the systems it was measured beside"
        )
    report.rows += rows


def _list_names(runs: list[Run]) -> list[str]:
    """Names of the baselines that the runs have a position error of, in the catalogue's order."""
    metrics = {tuple(metric.split("/")) for run in runs for metric in run.metrics}
    return sorted({parts[1] for parts in metrics if parts[0] == "baseline" and parts[-1] == MEDIANS[0]}, key=_sort_name)


def _sort_name(name: str) -> tuple[int, str]:
    """A key that sorts as the catalogue, unknown names last."""
    return (list(BASELINES).index(name) if name in BASELINES else len(BASELINES), name)


def _read_cell(name: str, run: Run) -> Cell | None:
    """A baseline's errors in a run; None where it has none."""
    position, orientation = (run.metrics.get(f"baseline/{name}/{error}") for error in MEDIANS)
    return None if position is None else Cell((position, orientation), runs=(run,), candidates=1)


def _agree_on_scenes(one: Row, other: Row) -> bool:
    shared = one.cells.keys() & other.cells.keys()
    return all(len({round(row.cells[scene].errors[0], DIGITS) for row in (one, other)}) == 1 for scene in shared)
