"""A report as programs read it: tidy CSV, a row a cell, and JSON with everything."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterator, Mapping

from lightning_pose.metrics.catalog import COSTS, MEDIANS, SKILLS
from lightning_pose.reports.table import STANDARD_DEVIATIONS, Cell, Report, Row

__all__ = ["as_csv", "as_json"]


def as_csv(report: Report) -> str:
    """One line a system and scene: `pandas.read_csv(FILE).pivot(index="system", columns="scene", values=...)`.

    Means are lines too, with the column of the mean as their scene. Costs and skill are those of the line's own runs,
    their mean where there are several. `kind` is own, baseline or published; `n` is how many runs a cell has, or how
    many scenes a mean is over; `runs` are MLflow's ids, separated by spaces.
    """
    facts = list(dict.fromkeys(fact for scene in report.scenes for fact in report.facts[scene]))
    errors = (*MEDIANS, *STANDARD_DEVIATIONS)
    columns = ["features", "scene", *errors, "n", *SKILLS, *COSTS, *facts, "source", "runs"]
    by = [name for row in report.rows[:1] for name in row.settings if name not in ("kind", "system", *columns)]
    out = io.StringIO()
    writer = csv.DictWriter(out, ["kind", "system", *by, *columns], lineterminator="\n")
    writer.writeheader()
    for row in report.rows:
        about = {"kind": row.kind, "system": row.system, "source": row.source}
        about |= {name: row.settings.get(name, "") for name in by}
        about |= {} if row.kind == "published" else {"features": row.features}
        writer.writerows({**about, **line} for line in _list_lines(row, report))
    return out.getvalue().rstrip("\n")


def _list_lines(row: Row, report: Report) -> Iterator[dict[str, object]]:
    """The cells of a row, and then its means: errors, skill, costs, and the facts that the scenes share."""
    for (column, cell), is_mean in [*((c, False) for c in row.cells.items()), *((m, True) for m in row.means.items())]:
        scenes = report.means[column] if is_mean else [column]
        first, *others = (report.facts[scene] for scene in scenes)
        shared = {fact: value for fact, value in first.items() if all(other.get(fact) == value for other in others)}
        yield {
            "scene": column,
            **cell.values,
            "n": cell.scenes if is_mean else len(cell.runs) or None,
            **row.average_costs(scenes),
            **({} if row.kind == "published" else shared),
            "runs": " ".join(run.run_id for run in cell.runs),
        }


def as_json(report: Report) -> str:
    """Scenes with their facts, rows with cells, runs and settings, the rule, notes and sources; no NaN: null."""
    document = {
        "scenes": [{"name": scene, **report.facts[scene]} for scene in report.scenes],
        "rows": [_row_document(row) for row in report.rows],
        "rule": report.rule,
        "notes": report.notes,
        "sources": report.footnotes,
    }
    return json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False)


def _row_document(row: Row) -> dict[str, object]:
    averages = _replace_infinite(row.average_costs())
    return {
        "kind": row.kind,
        "system": row.system,
        "features": None if row.kind == "published" else row.features,
        "settings": dict(row.settings),
        "cells": {scene: _cell_document(cell) for scene, cell in row.cells.items()},
        "means": {
            column: _replace_infinite({name: mean.values[name] for name in MEDIANS}) | {"scenes": mean.scenes}
            for column, mean in row.means.items()
        },
        "skill": {name: value for name, value in averages.items() if name in SKILLS},
        "costs": {name: value for name, value in averages.items() if name in COSTS},
        "source": row.source or None,
    }


def _cell_document(cell: Cell) -> dict[str, object]:
    runs = [
        {
            "run_id": run.run_id,
            "name": run.name,
            "experiment": run.experiment,
            "settings": dict(run.params),
            "metrics": _replace_infinite(run.metrics),
        }
        for run in cell.runs
    ]
    return {**_replace_infinite(cell.values), "candidates": cell.candidates, "runs": runs}


def _replace_infinite(values: Mapping[str, float | None]) -> dict[str, float | None]:
    """The values, with None for those that are infinite or not a number."""
    return {name: v if v is not None and math.isfinite(v) else None for name, v in values.items()}
