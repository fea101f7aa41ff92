"""What a study measured, by settings: the rows of its table, and the points of its figure."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean

from optuna import Study
from optuna.trial import FrozenTrial, TrialState

from lightning_pose.runs.tags import CURVES, METRICS, REASON
from lightning_pose.studies.figure_spec import FigureSpec
from lightning_pose.sweeps.plan import Plan
from lightning_pose.sweeps.space import SCENE, SEED, Config

__all__ = ["Group", "build_rows", "name_scenes", "name_value", "read_groups", "varying_settings", "write_csv"]


@dataclass
class Group:
    """Trials that differ in nothing but the seed.

    Attributes:
        values: their settings, without the seed.
        metrics: of each trial that ended.
        curves: of each trial that ended: values over whole numbers, by name.
        reason: why there is no trial that ended; None if there is.
        seeds: of each trial that ended, None where no seed was searched.
        names: what figures and tables call each value.
    """

    values: Config
    metrics: list[Mapping[str, float]] = field(default_factory=list)
    curves: list[Mapping[str, Mapping[int, float]]] = field(default_factory=list)
    reason: str | None = None
    seeds: list[object] = field(default_factory=list)
    names: dict[str, str] = field(init=False)

    def __post_init__(self) -> None:
        self.names = {key: name_value(value) for key, value in self.values.items()}

    def add_trial(self, trial: FrozenTrial) -> None:
        """Add a trial; one that failed only counts while none has ended."""
        if trial.state == TrialState.COMPLETE:
            curves = trial.user_attrs.get(CURVES, {})
            self.metrics.append(trial.user_attrs.get(METRICS, {}))
            self.curves.append({name: {int(n): value for n, value in points} for name, points in curves.items()})
            self.seeds.append(trial.params.get(SEED))
            self.reason = None
        elif not self.metrics:
            self.reason = trial.user_attrs.get(REASON, "failed")

    def all(self, metric: str) -> list[float]:
        """One value of each trial that has it."""
        return [found[metric] for found in self.metrics if metric in found]

    def curve(self, name: str) -> dict[int, float]:
        """The mean of its trials' curves of a name."""
        held = [curves[name] for curves in self.curves if name in curves]
        return {n: fmean(curve[n] for curve in held if n in curve) for n in sorted(set[int]().union(*held))}


def read_groups(study: Study, plan: Plan) -> list[Group]:
    """Every combination of settings that was tried, in the order of the search space."""
    groups: dict[tuple[str, ...], Group] = {}
    parameters = [parameter for parameter in plan.space if parameter.key != SEED]
    for trial in study.get_trials(deepcopy=False, states=(TrialState.COMPLETE, TrialState.FAIL)):
        if trial.params:
            labels = {p.key: trial.params[p.key] for p in parameters if p.key in trial.params}
            values = {p.key: p.value(labels[p.key]) for p in parameters if p.key in labels}
            groups.setdefault(tuple(map(str, labels.items())), Group(values)).add_trial(trial)
    name_scenes(list(groups.values()))
    order = {p.key: p.example() for p in parameters}
    return sorted(groups.values(), key=lambda group: [_rank_value(group.values.get(key), order[key]) for key in order])


def name_scenes(groups: Sequence[Group]) -> None:
    """Name folders of the same name by as much of their paths as distinguishes them."""
    groups = [group for group in groups if isinstance(group.values.get(SCENE), str)]
    paths = {group.values[SCENE]: Path(group.values[SCENE]).parts for group in groups}
    for length in range(1, 1 + max(map(len, paths.values()), default=0)):
        for group in groups:
            group.names[SCENE] = "/".join(paths[group.values[SCENE]][-length:])
        if len({group.names[SCENE] for group in groups}) == len(paths):
            return


def _rank_value(value: object, choices: Sequence[object]) -> float:
    """Numbers by value, choices in the order of the file, what is not searched there first."""
    numeric = all(isinstance(number, int | float) and not isinstance(number, bool) for number in choices)
    if numeric and isinstance(value, int | float):
        return float(value)
    return float(choices.index(value)) if value in choices else float("-inf")


def name_value(value: object) -> str:
    """A setting's value as a figure or table shows it: a class without its module, a folder without its parents."""
    if isinstance(value, str):
        return Path(value).name if "/" in value else value.rpartition(".")[2]
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, list) and len(value) == 1:
        return name_value(value[0])
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "none" if value is None else str(value)


def varying_settings(groups: Sequence[Group]) -> list[str]:
    """The settings that have several values among the groups that have them."""
    keys = dict.fromkeys(key for group in groups for key in group.values)
    return [key for key in keys if len({str(group.values[key]) for group in groups if key in group.values}) > 1]


def build_rows(groups: Sequence[Group], spec: FigureSpec) -> tuple[list[str], list[list[str]]]:
    """The heads of the study's table, and a row of text for each group."""
    keys = varying_settings(groups) or list(dict.fromkeys(key for group in groups for key in group.values))
    several = any(len(group.metrics) > 1 for group in groups)
    heads = [spec.label(key) for key in keys] + ["trials"] * several + [spec.label(name) for name in spec.table]
    rows = []
    for group in groups:
        measured = [_format_range(group.all(metric)) for metric in spec.table]
        if group.reason is not None and measured:
            measured = [f"failed: {group.reason}"] + [""] * (len(measured) - 1)
        rows.append([group.names.get(key, "") for key in keys] + [str(len(group.metrics))] * several + measured)
    return heads, rows


def _format_range(values: Sequence[float]) -> str:
    """A mean, and the lowest and highest value where they differ; empty without values."""
    if not values:
        return ""
    mean, low, high = (f"{v:,.0f}" if abs(v) >= 1000 else f"{v:.3g}" for v in (fmean(values), min(values), max(values)))
    return mean if min(values) == max(values) else f"{mean} ({low} to {high})"


def write_csv(groups: Sequence[Group], plan: Plan) -> str:
    """Everything that was measured, one line a trial, at full precision."""
    seeded = [SEED] * any(seed is not None for group in groups for seed in group.seeds)
    keys = [parameter.key for parameter in plan.space if parameter.key != SEED] + seeded
    metrics = sorted({name for group in groups for found in group.metrics for name in found})
    text = io.StringIO()
    writer = csv.DictWriter(text, [*keys, *metrics, "failed"], extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for group in groups:
        for found, seed in zip(group.metrics or [{}], group.seeds or [""], strict=True):
            writer.writerow({**group.values, SEED: seed, **found, "failed": group.reason})
    return text.getvalue()
