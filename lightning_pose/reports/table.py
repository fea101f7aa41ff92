"""Runs as a table: a row a system, a column a scene; several runs of one cell are joined by a rule that it states."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from lightning_pose.metrics.catalog import COSTS, MEDIANS, SKILLS
from lightning_pose.reports.choose_run import Choice, Pick, pick_runs
from lightning_pose.reports.comparability import (
    column_facts,
    describe_facts,
    differing_settings,
    find_tested_fact,
    missing_facts,
)
from lightning_pose.reports.filters import check_setting
from lightning_pose.runs.reader import Run

__all__ = ["SEVEN_SCENES", "STANDARD_DEVIATIONS", "Cell", "Report", "Row", "add_means", "build_report"]

SEVEN_SCENES = ("chess", "fire", "heads", "office", "pumpkin", "redkitchen", "stairs")
STANDARD_DEVIATIONS = ("position_std_m", "orientation_std_deg")
SETTINGS_OF_SCENES = (
    "scene", "data.root", "data.format", "data.room_seed", "data.train_scenes", "data.test_scenes", "data.val_scenes",
    "data.pgt", "data.train_rooms", "data.test_rooms",
)  # fmt: skip
NO_MEAN = ("unit", "task", "relative_frame")
"""Facts in which scenes must not differ for their errors to have a mean."""

MIXED = ("split", "ground_truth", "image_size", "clip_length", "stride")
"""Facts in which they may differ, with a note: each column is sound, the mean mixes them."""

PARTIAL = "a mean marked [k of n] is over k of the n scenes, and does not compare with means over others"
UNKNOWN = "not told"


@dataclass(frozen=True)
class Cell:
    """The errors of one system on one scene, or the mean over several scenes.

    Attributes:
        errors: median position error and median orientation error in degrees; None where it was not published.
        deviations: of both over seeds, with n - 1; None for one run.
        text: both errors as published, digit by digit.
        runs: behind the numbers.
        candidates: how many runs they were chosen from.
        scenes: how many the mean is over.
    """

    errors: tuple[float, float | None]
    deviations: tuple[float, float] | None = None
    text: tuple[str, str] | None = None
    runs: tuple[Run, ...] = ()
    candidates: int = 0
    scenes: int = 1

    @property
    def values(self) -> dict[str, float | None]:
        """Errors and deviations by name."""
        deviations = self.deviations or (None, None)
        return dict(zip((*MEDIANS, *STANDARD_DEVIATIONS), (*self.errors, *deviations), strict=True))


@dataclass
class Row:
    """One system.

    Attributes:
        kind: the user's own, a baseline, or published.
        system: its name, with the settings that distinguish it.
        features: what it reads.
        cells: by scene.
        settings: those that were asked for by name.
        means: over the scenes of a dataset, by the columns of `Report.means`; none where there can be none.
        source: of a published row.
    """

    kind: Literal["own", "baseline", "published"]
    system: str
    features: str
    cells: dict[str, Cell]
    settings: Mapping[str, str] = field(default_factory=dict)
    means: dict[str, Cell] = field(default_factory=dict)
    source: str = ""

    def average_costs(self, scenes: Sequence[str] | None = None) -> dict[str, float]:
        """Skill and costs of one of the user's systems: the mean over scenes (all by default) of the mean over a
        cell's runs, of each metric that all cells have."""
        cells = [cell for scene, cell in self.cells.items() if scenes is None or scene in scenes]
        averages = {}
        for name in (*SKILLS, *COSTS) if self.kind == "own" else ():
            metric = f"test/{name}" if name in SKILLS else f"cost/{name}"
            values = [[run.metrics[metric] for run in cell.runs if metric in run.metrics] for cell in cells]
            if values and all(values):
                averages[name] = statistics.fmean(map(statistics.fmean, values))
        return averages


@dataclass
class Report:
    """A table with its notes.

    Attributes:
        scenes: the columns.
        facts: what the runs of a scene share, by scene.
        rows: own ones first, then baselines, then published ones.
        rule: how runs of one cell were joined.
        notes: on choices, on what was left out, and on what does not compare.
        footnotes: sources of published rows.
        further: which columns a table has beside the scenes: `skill`, `costs`.
    """

    scenes: list[str]
    facts: dict[str, dict[str, str]]
    rows: list[Row]
    rule: str
    notes: list[str]
    footnotes: list[str] = field(default_factory=list)
    further: tuple[str, ...] = ()

    @property
    def means(self) -> dict[str, list[str]]:
        """The columns of means, one a dataset, and the scenes that each is over."""
        datasets = {scene: find_tested_fact(scene, self.facts[scene], "dataset") for scene in self.scenes}
        if len(set(datasets.values()) - {None}) < 2:  # a scene of an unknown dataset matches every other
            return {"mean": list(self.scenes)}
        columns: dict[str, list[str]] = {}
        for scene, dataset in datasets.items():
            columns.setdefault(f"mean {dataset or 'unknown'}", []).append(scene)
        return columns

    @property
    def captions(self) -> list[str]:
        """What the columns are, a line for all scenes that are alike."""
        by_text: dict[str, list[str]] = {}
        for scene in self.scenes:
            by_text.setdefault(describe_facts(self.facts[scene]), []).append(scene)
        return [f"{', '.join(scenes)}: {text}" for text, scenes in by_text.items()]

    def add_note(self, note: str) -> None:
        """Add a note once: own, baseline and published rows have the same scenes."""
        if note not in self.notes:
            self.notes.append(note)


def build_report(runs: Sequence[Run], pick: Pick = "best", by: Sequence[str] = ()) -> Report:
    """The table of the user's own runs.

    Args:
        runs: tested ones, the newest first.
        pick: how several runs of one cell are joined, see `pick_runs`.
        by: names of settings, each value of which gets a row.

    Raises:
        ConfigError: runs of one scene do not compare, a setting is unknown, or seeds cannot be averaged.
    """
    scenes = sorted({run.scene for run in runs}, key=_sort_scene)
    facts = {scene: column_facts([run for run in runs if run.scene == scene]) for scene in scenes}
    for name in by:
        check_setting(name, runs)
    groups: dict[tuple[str, ...], list[Run]] = {}
    for run in runs:
        groups.setdefault((run.system, *(run.settings.get(name, UNKNOWN) for name in by)), []).append(run)
    choice = Choice(missing_facts(runs))
    rows = []
    for key in sorted(groups, key=lambda key: [_sort_number(part) for part in key]):
        settings = dict(zip(by, key[1:], strict=True))
        by_scene = {scene: [run for run in groups[key] if run.scene == scene] for scene in scenes}
        rows.append(_build_row(key[0], settings, by_scene, pick, choice))
    report = Report(scenes, facts, rows, choice.describe_rule(pick), choice.all_notes())
    add_means(report, rows)
    return report


def add_means(report: Report, rows: Sequence[Row]) -> None:
    """Give rows the mean of their cells in each dataset, where its scenes have one unit, one task and one frame."""
    for column, scenes in report.means.items():
        whose = f"scenes{column.removeprefix('mean').replace(' ', ' of ', 1)}"
        if different := _differing_facts(report, scenes, NO_MEAN):
            report.add_note(f"{whose} differ in {', '.join(different)}: no mean over them")
            continue
        for fact in _differing_facts(report, scenes, MIXED):
            report.add_note(f"{whose} differ in {fact}: the mean over them mixes the two")
        for row in rows:
            cells = [row.cells[scene] for scene in scenes if scene in row.cells]
            if cells:
                orientations = [cell.errors[1] for cell in cells if cell.errors[1] is not None]
                whole = len(orientations) == len(cells)
                position = statistics.fmean(cell.errors[0] for cell in cells)
                errors = position, statistics.fmean(orientations) if whole else None
                row.means[column] = Cell(errors, scenes=len(cells))
                if len(cells) < len(scenes):
                    report.add_note(PARTIAL)


def _differing_facts(report: Report, scenes: Sequence[str], facts: Sequence[str]) -> list[str]:
    """Which facts the scenes differ in, in words; a scene without a fact matches every value."""
    values = {fact: {find_tested_fact(scene, report.facts[scene], fact) for scene in scenes} - {None} for fact in facts}
    return [fact.replace("_", " ") for fact, found in values.items() if len(found) > 1]


def _build_row(system: str, settings: dict[str, str], runs: dict[str, list[Run]], pick: Pick, choice: Choice) -> Row:
    named = [f"{name.rpartition('.')[2]}={value}" for name, value in settings.items() if value != UNKNOWN]
    label = f"{system} ({', '.join(named)})" if named else system
    cells = {}
    for scene, found in runs.items():
        if found:
            cells[scene] = _join_runs(pick_runs(found, pick, f"{label} on {scene}", choice), len(found))
    shown = [run for cell in cells.values() for run in cell.runs]
    if len(cells) > 1 and (names := differing_settings(shown, SETTINGS_OF_SCENES)):
        listed = [f"{name} ({', '.join(values)})" for name, values in names.items()]
        others = ", ".join(listed[:4] + ["..."] * (len(listed) > 4))
        choice.notes.append(f"{label} has other settings in other scenes: {others}")
    return Row("own", label, ", ".join(dict.fromkeys(run.features for run in shown)), cells, settings)


def _join_runs(runs: Sequence[Run], candidates: int) -> Cell:
    """The mean of the runs' test errors; of several also their deviation, which is NaN where an error is not finite."""
    values = [[run.metrics.get(f"test/{name}", math.nan) for run in runs] for name in MEDIANS]
    position, orientation = map(statistics.fmean, values)
    deviations = None
    if len(runs) > 1:
        finite = [all(map(math.isfinite, errors)) for errors in values]
        first, second = (statistics.stdev(e) if ok else math.nan for e, ok in zip(values, finite, strict=True))
        deviations = first, second
    return Cell((position, orientation), deviations, runs=tuple(runs), candidates=candidates)


def _sort_scene(scene: str) -> tuple[int, str]:
    """A key that sorts the seven scenes in the order of the thesis, then the others by name."""
    return (SEVEN_SCENES.index(scene) if scene in SEVEN_SCENES else len(SEVEN_SCENES), scene)


def _sort_number(text: str) -> tuple[int, float, str]:
    """A key that sorts numbers as numbers, and before other texts."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    return (1, 0.0, text) if math.isnan(number) else (0, number, text)
