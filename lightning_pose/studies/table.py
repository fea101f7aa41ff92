"""What a study measured, trial by trial: the rows of its table, and the points of its figure."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean
from typing import Any

from optuna import Study
from optuna.trial import FrozenTrial, TrialState

from lightning_pose.runs.tags import CURVES, METRICS, REASON
from lightning_pose.studies.figure_spec import FigureSpec
from lightning_pose.sweeps.plan import Plan
from lightning_pose.sweeps.space import SCENE, SEED
from lightning_pose.terminal import Sheet

__all__ = ["Cell", "as_csv", "as_markdown", "as_sheet", "gather", "name_scenes", "named", "varying"]

Curve = Mapping[int, float]


@dataclass
class Cell:
    """Trials that differ in nothing but the seed.

    Attributes:
        values: their settings, without the seed.
        names: what figures and tables call each value.
        seeds: of each trial that ended, None where no seed was searched.
        metrics: of each trial that ended.
        curves: of each trial that ended.
        reason: why there is no trial that ended; None if there is.
    """

    values: dict[str, Any]
    metrics: list[Mapping[str, float]] = field(default_factory=list)
    curves: list[Mapping[str, Curve]] = field(default_factory=list)
    reason: str | None = None
    seeds: list[Any] = field(default_factory=list)
    names: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.names = {key: named(value) for key, value in self.values.items()} | self.names

    def all(self, metric: str) -> list[float]:
        """One value of each trial that has it."""
        return [found[metric] for found in self.metrics if metric in found]

    def curve(self, name: str) -> dict[int, float]:
        """The mean of its trials' curves of a name."""
        held = [curves[name] for curves in self.curves if name in curves]
        numbers = sorted(set().union(*held)) if held else []
        return {n: fmean(curve[n] for curve in held if n in curve) for n in numbers}


def gather(study: Study, plan: Plan) -> list[Cell]:
    """Every setting that was tried, in the order of the search space."""
    cells: dict[tuple[str, ...], Cell] = {}
    parameters = [parameter for parameter in plan.space if parameter.key != SEED]
    for trial in sorted(study.get_trials(deepcopy=False), key=lambda trial: trial.number):
        if trial.state not in (TrialState.COMPLETE, TrialState.FAIL) or not trial.params:
            continue
        labels = {p.key: trial.params[p.key] for p in parameters if p.key in trial.params}
        values = {p.key: p.value(labels[p.key]) for p in parameters if p.key in labels}
        _take(cells.setdefault(tuple(map(str, labels.items())), Cell(values)), trial)
    name_scenes(list(cells.values()))
    order = {p.key: p.example() for p in parameters}
    return sorted(cells.values(), key=lambda cell: [_rank(cell.values.get(key), order[key]) for key in order])


def name_scenes(cells: Sequence[Cell]) -> None:
    """Call folders of the same name by as much of their paths as makes them distinct."""
    cells = [cell for cell in cells if SCENE in cell.values]
    paths = {path: Path(path).parts for cell in cells if isinstance(path := cell.values[SCENE], str)}
    for length in range(1, 1 + max(map(len, paths.values()), default=0)):
        names = {path: "/".join(parts[-length:]) for path, parts in paths.items()}
        for cell in cells:
            cell.names[SCENE] = names.get(cell.values[SCENE], named(cell.values[SCENE]))
        if len(set(names.values())) == len(names):
            return


def _take(cell: Cell, trial: FrozenTrial) -> None:
    if trial.state == TrialState.COMPLETE:
        cell.metrics.append(trial.user_attrs.get(METRICS, {}))
        cell.seeds.append(trial.params.get(SEED))
        curves = trial.user_attrs.get(CURVES, {})
        cell.curves.append({name: {int(n): value for n, value in points} for name, points in curves.items()})
        cell.reason = None
    elif not cell.metrics:
        cell.reason = trial.user_attrs.get(REASON, "failed")


def _rank(value: Any, choices: Sequence[Any]) -> tuple[int, float]:
    """Numbers in their order, choices in that of the file, what is not searched there first."""
    if all(map(_is_number, choices)) and _is_number(value):
        return (1, float(value))
    return (1, float(choices.index(value))) if value in choices else (0, 0.0)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def named(value: Any) -> str:
    """A setting's value as a figure or table shows it: a class without its module, a folder without the way to it."""
    if isinstance(value, str):
        return Path(value).name if "/" in value else value.rpartition(".")[2]
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, list) and len(value) == 1:
        return named(value[0])
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "none" if value is None else str(value)


def varying(cells: Iterable[Cell]) -> list[str]:
    """The settings that have several values; what a system alone has, and always the same, distinguishes nothing."""
    cells = list(cells)
    keys = dict.fromkeys(key for cell in cells for key in cell.values)
    return [key for key in keys if len({str(cell.values[key]) for cell in cells if key in cell.values}) > 1]


def _rows(cells: Sequence[Cell], spec: FigureSpec) -> tuple[list[str], list[list[str]]]:
    keys = varying(cells) or list(dict.fromkeys(key for cell in cells for key in cell.values))
    several = any(len(cell.metrics) > 1 for cell in cells)
    heads = [spec.label(key) for key in keys] + ["trials"] * several + [spec.label(name) for name in spec.table]
    rows = []
    for cell in cells:
        row = [cell.names.get(key, "") for key in keys]
        row += [str(len(cell.metrics))] * several
        if cell.reason is not None and spec.table:
            row += [f"failed: {cell.reason}"] + [""] * (len(spec.table) - 1)
        else:
            row += [_number(cell.all(metric)) for metric in spec.table]
        rows.append(row)
    return heads, rows


def _number(values: Sequence[float]) -> str:
    """A mean, and how far its parts lie apart."""
    if not values:
        return ""
    shown = _short(fmean(values))
    return shown if min(values) == max(values) else f"{shown} ({_short(min(values))} to {_short(max(values))})"


def _short(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def as_sheet(cells: Sequence[Cell], spec: FigureSpec, title: str) -> Sheet:
    """For the terminal."""
    return Sheet(title, *_rows(cells, spec))


def as_markdown(cells: Sequence[Cell], spec: FigureSpec) -> str:
    """A GitHub table."""
    heads, rows = _rows(cells, spec)
    lines = [heads, ["---"] * len(heads), *rows]
    return "".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |\n" for line in lines)


def as_csv(cells: Sequence[Cell], plan: Plan) -> str:
    """Everything that was measured, one line a trial, at full precision."""
    keys = [parameter.key for parameter in plan.space if parameter.key != SEED]
    seeded = [SEED] * any(seed is not None for cell in cells for seed in cell.seeds)
    metrics = sorted({name for cell in cells for found in cell.metrics for name in found})
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*keys, *seeded, *metrics, "failed"])
    for cell in cells:
        settings = [cell.values.get(key, "") for key in keys]
        for found, seed in zip(cell.metrics or [{}], cell.seeds or [""], strict=True):
            writer.writerow(
                [*settings, *([seed] * len(seeded)), *(found.get(name, "") for name in metrics), cell.reason or ""]
            )
    return text.getvalue()
