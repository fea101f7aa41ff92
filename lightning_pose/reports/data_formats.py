"""A report as programs read it: tidy CSV, a row a cell, and JSON with everything."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterator, Sequence
from typing import Any

from lightning_pose.reports.table import SKILLS, Cell, Mean, Report, Row, over_scenes
from lightning_pose.reports.text_formats import HEADINGS

__all__ = ["as_csv", "as_json"]

ERRORS = ("position_median_m", "orientation_median_deg", "position_std_m", "orientation_std_deg")


def as_csv(report: Report) -> str:
    """One line a system and scene: `pandas.read_csv(FILE).pivot(index="system", columns="scene", values=...)`.

    Means are lines too, with the column of the mean as their scene. Costs and skill are those of the line's own runs,
    their mean where there are several. `kind` is own, baseline or published; `n` is how many runs a cell has, or how
    many scenes a mean is over; `runs` are MLflow's ids, separated by spaces.
    """
    facts = list(dict.fromkeys(fact for told in report.facts.values() for fact in told))
    columns = ["features", "scene", *ERRORS, "n", *SKILLS, *HEADINGS, *facts, "source", "runs"]
    asked = next((row.settings for row in report.rows if row.kind == "own"), {})
    by = [name for name in asked if name not in ("kind", "system", *columns)]
    out = io.StringIO()
    writer = csv.DictWriter(out, ["kind", "system", *by, *columns], lineterminator="\n")
    writer.writeheader()
    for row in report.rows:
        about = {"kind": row.kind, "system": row.system, "source": row.source}
        about |= {name: row.settings.get(name, "") for name in by}
        about |= {} if row.kind == "published" else {"features": row.features}
        writer.writerows({**about, **line} for line in _lines(row, report))
    return out.getvalue().rstrip("\n")


def _lines(row: Row, report: Report) -> Iterator[dict[str, Any]]:
    """The cells of a row, and then its means."""
    for scene, cell in row.cells.items():
        told = dict(zip(ERRORS, map(_text, _errors(cell)), strict=True))
        runs = " ".join(run.run_id for run in cell.runs)
        yield {"scene": scene, **told, "n": len(cell.runs) or "", "runs": runs, **_beside(row, report, [scene])}
    for column, mean in row.means.items():
        told = dict(zip(ERRORS[:2], map(_text, (mean.position_m, mean.orientation_deg)), strict=True))
        yield {"scene": column, **told, "n": mean.scenes, **_beside(row, report, report.means[column])}


def _beside(row: Row, report: Report, scenes: Sequence[str]) -> dict[str, str]:
    """Costs and skill of a system on some scenes, and the facts that these share; nothing for what is published."""
    if row.kind == "published":
        return {}
    told = [report.facts[scene] for scene in scenes]
    shared = {fact: value for fact, value in told[0].items() if all(facts.get(fact) == value for facts in told)}
    if row.kind == "baseline":
        return shared
    cells = {scene: row.cells[scene] for scene in scenes if scene in row.cells}
    metrics = {name: f"test/{name}" for name in SKILLS} | {name: f"cost/{name}" for name in HEADINGS}
    return shared | {name: _text(value) for name, value in over_scenes(cells, metrics).items()}


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
    told = dict(zip(ERRORS, map(_finite, _errors(cell)), strict=True))
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


def _text(value: float | None) -> str:
    return "" if value is None else repr(value)


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
