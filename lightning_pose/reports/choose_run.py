"""Several runs of one system on one scene: which one is shown, or how their seeds are averaged."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from lightning_pose.errors import ConfigError
from lightning_pose.reports.comparability import FOLDERS, differing_settings, same_data
from lightning_pose.runs.reader import Run

__all__ = ["PICKS", "Choice", "Pick", "pick_runs"]

Pick = Literal["best", "latest", "spread"]
PICKS: tuple[Pick, ...] = ("best", "latest", "spread")
VALIDATION = ("val/position_median_m", "val/loss")
"""Of a run's best epoch, `best/...`, or of its last where that is missing."""


@dataclass
class Choice:
    """What the notes must say of the choices made, cell by cell.

    Attributes:
        notes: the notes of the table.
        by: how many cells were decided by each metric.
        judged: how many runs that took.
        by_last: how many of them have only their last epoch's metric.
    """

    notes: list[str]
    by: Counter[str] = field(default_factory=Counter)
    judged: int = 0
    by_last: int = 0
    unmeasured: list[str] = field(default_factory=list)
    passed_over: list[str] = field(default_factory=list)
    uneven: list[str] = field(default_factory=list)

    def tell(self) -> None:
        """Put what was gathered into the notes."""
        for cells, says in (
            (self.unmeasured, "no validation metric, so the newest run is shown"),
            (self.passed_over, "runs without a validation metric, which could not be chosen"),
            (self.uneven, "runs of different data.val_fraction, whose validation errors compare only roughly"),
        ):
            if cells:
                self.notes.append(f"{', '.join(cells)}: {says}")

    def rule(self, pick: Pick) -> str:
        """How runs were joined, in words."""
        if pick == "spread":
            return "mean and sample standard deviation over n seeds"
        if pick == "latest":
            return "the newest run of each system and scene"
        metrics = " or ".join(self.by) or VALIDATION[0]
        last = f" (of its last, for {self.by_last} of {self.judged} runs that do not tell their best)"
        return (
            f"of each system and scene, the run that is best by {metrics} of its best epoch"
            f"{last if self.by_last else ''}; never by test errors"
        )


def pick_runs(runs: Sequence[Run], pick: Pick, cell: str, choice: Choice) -> list[Run]:
    """The runs that a cell shows.

    - `best`: the lowest validation error, `val/position_median_m` or else `val/loss`, never a test error: that of the
      best epoch, or of the last where a run lacks that. Where no run has one, the newest run.
    - `latest`: the newest run.
    - `spread`: all runs of `fit`, which may differ in nothing but the seed; of several with one seed, the newest.

    Args:
        runs: of one system on one scene, the newest first.
        pick: the rule.
        cell: system and scene, for messages.
        choice: takes notes.

    Raises:
        ConfigError: runs to average differ in a setting, or all are runs of `test`, which know no seed.
    """
    if pick == "latest":
        return [runs[0]]
    return [_best(runs, cell, choice)] if pick == "best" else _seeds(runs, cell, choice)


def _best(runs: Sequence[Run], cell: str, choice: Choice) -> Run:
    for metric in VALIDATION:
        told = [run for run in runs if math.isfinite(_measured(run, metric))]
        if told:
            choice.by[metric] += 1
            choice.judged += len(told)
            choice.by_last += sum(f"best/{metric}" not in run.metrics for run in told)
            if len(told) < len(runs):
                choice.passed_over.append(f"{cell} ({len(runs) - len(told)} of {len(runs)})")
            if "data.val_fraction" in differing_settings(told):
                choice.uneven.append(cell)
            return min(told, key=lambda run: _measured(run, metric))  # of equals the newest
    if len(runs) > 1:
        choice.unmeasured.append(cell)
    return runs[0]


def _measured(run: Run, metric: str) -> float:
    return run.metrics.get(f"best/{metric}", run.metrics.get(metric, math.nan))


def _seeds(runs: Sequence[Run], cell: str, choice: Choice) -> list[Run]:
    trained = [run for run in runs if run.tags.get("verb") == "fit"]
    if not trained:
        raise ConfigError(
            f"{cell}: {len(runs)} runs of `test`, which do not know the seed of their training, cannot be averaged; "
            "give --pick latest"
        )
    if len(trained) < len(runs):
        choice.notes.append(f"{cell}: {len(runs) - len(trained)} runs of `test` are left out of the mean over seeds")
    _check_alike(trained, cell, choice)
    by_seed = _newest_of_each_seed(trained)
    if len(by_seed) < len(trained):
        choice.notes.append(f"{cell}: {len(trained)} runs have {len(by_seed)} seeds; the newest of each counts")
    commits = {run.tags.get("git_commit") or run.tags.get("mlflow.source.git.commit") for run in by_seed}
    if len(commits - {None}) > 1:
        choice.notes.append(f"{cell}: the runs come from {len(commits - {None})} versions of the program")
    return by_seed


def _check_alike(trained: Sequence[Run], cell: str, choice: Choice) -> None:
    """Refuse runs that differ in more than the seed, or in where the same data lie."""
    different = differing_settings(trained)
    if same_data(trained) and (folders := [name for name in FOLDERS if different.pop(name, None)]):
        choice.notes.append(
            f"{cell}: the runs name {', '.join(folders)} in several ways; taken for the same data, as scene, split and "
            "number of test frames agree"
        )
    if different:
        name, values = next(iter(different.items()))
        others = f" and {', '.join(list(different)[1:6])}" if len(different) > 1 else ""
        raise ConfigError(
            f"{cell}: {len(trained)} runs differ in {name} ({', '.join(values[:5])}){others}, not only in the seed, "
            f"and have no common mean; give --by {name} for a row each, or --tag {name}={values[0]}"
        )


def _newest_of_each_seed(runs: Sequence[Run]) -> list[Run]:
    """One run of each seed; every run that was given none, as its numbers were drawn anew."""
    found: dict[str, Run] = {}
    for run in runs:
        seed = run.params.get("seed", "None")  # MLflow keeps None as text
        found.setdefault(run.run_id if seed == "None" else seed, run)
    return list(found.values())
