"""A report as programs read it: tidy CSV, a row a cell, and JSON with everything."""

from __future__ import annotations

import csv
import io
import json
import math
from typing import Any

from lightning_pose.reports.render import HEADINGS
from lightning_pose.reports.store import Run
from lightning_pose.reports.tables import SKILLS, Cell, Mean, Report, Row

__all__ = ["as_csv", "as_json"]


def as_csv(report: Report) -> str:
    """One line a system and scene: `pandas.read_csv(FILE).pivot(index="system", columns="scene", values=...)`.

    Costs and skill are those of the cell's own runs, their mean where there are several. `kind` is own, baseline or
    published; `runs` are MLflow's ids, separated by spaces.
    """
    by = list(next((row.settings for row in report.rows if row.kind == "own"), {}))
    errors = ["position_median_m", "orientation_median_deg", "position_std_m", "orientation_std_deg"]
    facts = list(dict.fromkeys(fact for told in report.facts.values() for fact in told))
    heading = ["kind", "system", *by, "features", "scene", *errors, "n", *SKILLS, *HEADINGS, *facts, "source", "runs"]
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(heading)
    for row in report.rows:
        for scene, cell in row.cells.items():
            published = row.kind == "published"
            own = cell.runs if row.kind == "own" else ()
            writer.writerow(
                [row.kind, row.system, *(row.settings.get(name, "") for name in by)]
                + ["" if published else row.features, scene, *map(_text, _errors(cell)), len(cell.runs) or ""]
                + [_text(_average(own, f"test/{name}")) for name in SKILLS]
                + [_text(_average(own, f"cost/{name}")) for name in HEADINGS]
                + ["" if published else report.facts[scene].get(fact, "") for fact in facts]
                + [row.source, " ".join(run.run_id for run in cell.runs)]
            )
    return out.getvalue().rstrip("\n")


def as_json(report: Report) -> str:
    """Scenes with their facts, rows with cells, runs and settings, the rule, notes and sources; no NaN: null."""
    document = {
        "scenes": [{"name": scene, **report.facts[scene]} for scene in report.scenes],
        "rows": [_row(row) for row in report.rows],
        "rule": report.rule,
        "notes": report.notes,
        "sources": report.footnotes,
    }
    return json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False)


def _row(row: Row) -> dict[str, Any]:
    return {
        "kind": row.kind,
        "system": row.system,
        "features": None if row.kind == "published" else row.features,
        "settings": dict(row.settings),
        "cells": {scene: _cell(cell) for scene, cell in row.cells.items()},
        "means": {column: _mean(mean) for column, mean in row.means.items()},
        "skill": {name: _finite(value) for name, value in row.skill.items()},
        "costs": {name: _finite(value) for name, value in row.costs.items()},
        "source": row.source or None,
    }


def _mean(mean: Mean) -> dict[str, Any]:
    return {
        "position_median_m": _finite(mean.position_m),
        "orientation_median_deg": _finite(mean.orientation_deg),
        "scenes": mean.scenes,
    }


def _cell(cell: Cell) -> dict[str, Any]:
    names = ("position_median_m", "orientation_median_deg", "position_std_m", "orientation_std_deg")
    told = dict(zip(names, map(_finite, _errors(cell)), strict=True))
    return {
        **told,
        "candidates": cell.candidates,
        "runs": [
            {
                "run_id": run.run_id,
                "name": run.name,
                "experiment": run.experiment,
                "settings": dict(run.params),
                "metrics": {name: _finite(value) for name, value in run.metrics.items()},
            }
            for run in cell.runs
        ],
    }


def _errors(cell: Cell) -> tuple[float | None, ...]:
    return cell.position_m, cell.orientation_deg, cell.position_std_m, cell.orientation_std_deg


def _average(runs: tuple[Run, ...], metric: str) -> float | None:
    values = [run.metrics[metric] for run in runs if metric in run.metrics]
    return sum(values) / len(values) if values else None


def _text(value: float | None) -> str:
    return "" if value is None else repr(value)


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
