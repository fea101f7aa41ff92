"""Several runs of one system on one scene: which one is shown, or how their seeds are averaged."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from lightning_pose.errors import ConfigError
from lightning_pose.metrics.catalog import MEDIANS
from lightning_pose.reports.comparability import FOLDERS, differing_settings, same_data
from lightning_pose.runs.reader import Run

__all__ = ["PICKS", "Choice", "Pick", "pick_runs"]

Pick = Literal["best", "latest", "spread"]
PICKS: tuple[Pick, ...] = ("best", "latest", "spread")
VALIDATION = (f"val/{MEDIANS[0]}", "val/loss")
"""Of a run's best epoch, `best/...`, or of its last where that is missing."""

UNMEASURED = "no validation metric, so the newest run is shown"
PASSED_OVER = "runs without a validation metric, which could not be chosen"
UNEVEN = "runs of different data.val_fraction, whose validation errors compare only roughly"


@dataclass
class Choice:
    """What the notes must have about the choices made, cell by cell.

    Attributes:
        notes: in the order in which they came.
        cells: those to which `UNMEASURED`, `PASSED_OVER` or `UNEVEN` applies.
        by: how many cells were decided by each metric.
        judged: how many runs were compared by it.
        by_last: how many of them have only their last epoch's metric.
    """

    notes: list[str]
    cells: dict[str, list[str]] = field(default_factory=lambda: {UNMEASURED: [], PASSED_OVER: [], UNEVEN: []})
    by: Counter[str] = field(default_factory=Counter)
    judged: int = 0
    by_last: int = 0

    def all_notes(self) -> list[str]:
        """The notes, those on several cells last."""
        return [*self.notes, *(f"{', '.join(cells)}: {text}" for text, cells in self.cells.items() if cells)]

    def describe_rule(self, pick: Pick) -> str:
        """How runs were joined, in words."""
        if pick == "spread":
            return "mean and sample standard deviation over n seeds"
        if pick == "latest":
            return "the newest run of each system and scene"
        last = f" (of its last, for {self.by_last} of {self.judged} runs that do not record their best)"
        return (
            f"of each system and scene, the run that is best by {' or '.join(self.by) or VALIDATION[0]} of its best "
            f"epoch{last if self.by_last else ''}; never by test errors"
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
        ConfigError: runs to average differ in a setting, or all are runs of `test`, which have no seed.
    """
    if pick == "latest":
        return [runs[0]]
    return [_pick_best(runs, cell, choice)] if pick == "best" else _pick_seeds(runs, cell, choice)


def _pick_best(runs: Sequence[Run], cell: str, choice: Choice) -> Run:
    for metric in VALIDATION:
        values = {run.run_id: run.metrics.get(f"best/{metric}", run.metrics.get(metric, math.nan)) for run in runs}
        measured = [run for run in runs if math.isfinite(values[run.run_id])]
        if measured:
            choice.by[metric] += 1
            choice.judged += len(measured)
            choice.by_last += sum(f"best/{metric}" not in run.metrics for run in measured)
            if len(measured) < len(runs):
                choice.cells[PASSED_OVER].append(f"{cell} ({len(runs) - len(measured)} of {len(runs)})")
            if "data.val_fraction" in differing_settings(measured):
                choice.cells[UNEVEN].append(cell)
            return min(measured, key=lambda run: values[run.run_id])  # of equals the newest
    if len(runs) > 1:
        choice.cells[UNMEASURED].append(cell)
    return runs[0]


def _pick_seeds(runs: Sequence[Run], cell: str, choice: Choice) -> list[Run]:
    trained = [run for run in runs if run.tags.get("verb") == "fit"]
    if not trained:
        raise ConfigError(
            f"{cell}: {len(runs)} runs of `test`, which do not have the seed of their training, cannot be averaged; "
            "give --pick latest"
        )
    if len(trained) < len(runs):
        choice.notes.append(f"{cell}: {len(runs) - len(trained)} runs of `test` are left out of the mean over seeds")
    _check_alike(trained, cell, choice)
    newest: dict[str, Run] = {}
    for run in trained:
        seed = run.params.get("seed", "None")  # MLflow keeps None as text; such a run drew its numbers anew
        newest.setdefault(run.run_id if seed == "None" else seed, run)
    if len(newest) < len(trained):
        choice.notes.append(f"{cell}: {len(trained)} runs have {len(newest)} seeds; the newest of each counts")
    commits = {run.tags.get("git_commit") or run.tags.get("mlflow.source.git.commit") for run in newest.values()}
    if len(commits - {None}) > 1:
        choice.notes.append(f"{cell}: the runs come from {len(commits - {None})} versions of the program")
    return list(newest.values())


def _check_alike(trained: Sequence[Run], cell: str, choice: Choice) -> None:
    """Refuse runs that differ in more than the seed, or in the folder of the same data."""
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
