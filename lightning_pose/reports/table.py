"""Runs to a table: a row a system, a column a scene; a rule that the table states joins several runs of one cell."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from lightning_pose.reports.choose_run import Choice, Pick, pick_runs
from lightning_pose.reports.comparability import column_facts, describe_facts, differing_settings, missing_facts, tested
from lightning_pose.reports.filters import check_setting, setting
from lightning_pose.runs.reader import Run

__all__ = ["COSTS", "MEAN", "SEVEN_SCENES", "Cell", "Mean", "Report", "Row", "add_means", "build_report", "over_scenes"]

SEVEN_SCENES = ("chess", "fire", "heads", "office", "pumpkin", "redkitchen", "stairs")

POSITION, ORIENTATION = "position_median_m", "orientation_median_deg"
COSTS = ("parameters", "train_seconds", "ms_per_frame", "features_ms_per_frame", "frame_bytes", "checkpoint_bytes")
SKILLS = ("skill_position", "skill_orientation")
BY_SCENE = (
    "scene", "data.root", "data.format", "data.room_seed", "data.train_scenes", "data.test_scenes", "data.train_rooms",
    "data.test_rooms",
)  # fmt: skip

MEAN = "mean"
APART = ("unit", "task", "relative_frame")
"""Facts in which scenes must not differ for their errors to have a mean."""

MIXED = ("split", "ground_truth", "image_size", "clip_length", "stride")
"""Facts in which they may, and the reader is told: each column is sound, the mean mixes them."""

PARTIAL = "a mean marked [k of n] is over k of the n scenes, and does not compare with means over others"

UNTOLD = "not told"

Kind = Literal["own", "baseline", "published"]


@dataclass(frozen=True)
class Cell:
    """One system on one scene.

    Attributes:
        position_m: median error.
        orientation_deg: median error, degrees; None where it was not published.
        position_std_m: over seeds; None for one run.
        orientation_std_deg: likewise.
        text: both errors as published, digit by digit.
        runs: behind the numbers.
        candidates: how many runs they were chosen from.
    """

    position_m: float
    orientation_deg: float | None
    position_std_m: float | None = None
    orientation_std_deg: float | None = None
    text: tuple[str, str] | None = None
    runs: tuple[Run, ...] = ()
    candidates: int = 0


@dataclass(frozen=True)
class Mean:
    """The mean over the scenes where a row has a value; of orientations only where all have one."""

    position_m: float
    orientation_deg: float | None
    scenes: int


@dataclass
class Row:
    """One system.

    Attributes:
        kind: the user's own, a baseline, or published.
        system: its name, with the settings that set it apart.
        features: what it reads.
        cells: by scene.
        settings: those that were asked for by name.
        costs: means over the scenes, by name.
        skill: likewise, model error over that of the first baseline.
        means: over the scenes of a dataset, by the columns of `Report.means`; none where there can be none.
        source: of a published row.
    """

    kind: Kind
    system: str
    features: str
    cells: dict[str, Cell]
    settings: Mapping[str, str] = field(default_factory=dict)
    costs: Mapping[str, float] = field(default_factory=dict)
    skill: Mapping[str, float] = field(default_factory=dict)
    means: dict[str, Mean] = field(default_factory=dict)
    source: str = ""


@dataclass
class Report:
    """A table and all that must be said beside it.

    Attributes:
        scenes: the columns.
        facts: what the runs of a scene share, by scene.
        rows: own ones first, then baselines, then published ones.
        rule: how runs of one cell were joined.
        notes: what the reader must know.
        footnotes: sources of published rows.
    """

    scenes: list[str]
    facts: dict[str, dict[str, str]]
    rows: list[Row]
    rule: str
    notes: list[str]
    footnotes: list[str] = field(default_factory=list)

    @property
    def means(self) -> dict[str, list[str]]:
        """The columns of means, one a dataset, and the scenes that each is over."""
        told = {scene: tested(scene, self.facts[scene], "dataset") for scene in self.scenes}
        known = {dataset for dataset in told.values() if dataset}
        if len(known) < 2:  # what a run does not tell goes with any
            return {MEAN: list(self.scenes)}
        columns: dict[str, list[str]] = {}
        for scene, dataset in told.items():
            columns.setdefault(f"{MEAN} {dataset or 'unknown'}", []).append(scene)
        return columns

    @property
    def captions(self) -> list[str]:
        """What the columns are."""
        by_text: dict[str, list[str]] = {}
        for scene in self.scenes:
            by_text.setdefault(describe_facts(self.facts[scene]), []).append(scene)
        return [f"{', '.join(scenes)}: {text}" for text, scenes in by_text.items()]


def build_report(runs: Sequence[Run], pick: Pick = "best", by: Sequence[str] = ()) -> Report:
    """The table of the user's own runs.

    Args:
        runs: tested ones, the newest first.
        pick: how several runs of one cell are joined, see `pick_runs`.
        by: names of settings that set rows apart.

    Raises:
        ConfigError: runs of one scene do not compare, a setting is unknown, or seeds cannot be averaged.
    """
    scenes = sorted({run.scene for run in runs}, key=_scene_order)
    facts = {scene: column_facts([run for run in runs if run.scene == scene]) for scene in scenes}
    for name in by:
        check_setting(name, runs)
    groups: dict[tuple[str, ...], dict[str, list[Run]]] = {}
    for run in runs:
        key = (run.system, *(setting(run, name) or UNTOLD for name in by))
        groups.setdefault(key, {}).setdefault(run.scene, []).append(run)
    missing = missing_facts(runs)
    notes = [missing] if missing else []
    choice = Choice(notes)
    rows = []
    for key in sorted(groups, key=_row_order):
        row = _row(key, by, {scene: groups[key][scene] for scene in scenes if scene in groups[key]}, pick, choice)
        rows.append(row)
    choice.tell()
    report = Report(scenes, facts, rows, choice.rule(pick), notes)
    add_means(report, rows)
    return report


def add_means(report: Report, rows: Sequence[Row]) -> None:
    """Give rows the mean of their cells in each dataset, where its scenes have one unit, one task and one frame."""
    for column, scenes in report.means.items():
        dataset = column.removeprefix(MEAN).strip()
        whose = f"scenes of {dataset}" if dataset else "scenes"
        if apart := _differing(report, scenes, APART):
            _note(report, f"{whose} differ in {', '.join(apart)}: no mean over them")
            continue
        for fact in _differing(report, scenes, MIXED):
            _note(report, f"{whose} differ in {fact}: the mean over them mixes the two")
        for row in rows:
            cells = [row.cells[scene] for scene in scenes if scene in row.cells]
            if cells:
                row.means[column] = _mean(cells)
                if len(cells) < len(scenes):
                    _note(report, PARTIAL)


def _differing(report: Report, scenes: Sequence[str], facts: Sequence[str]) -> list[str]:
    """Which facts the scenes differ in, in words; a run without a fact matches every value."""
    told = {fact: {tested(scene, report.facts[scene], fact) for scene in scenes} - {None} for fact in facts}
    return [fact.replace("_", " ") for fact, values in told.items() if len(values) > 1]


def _note(report: Report, note: str) -> None:
    """Say it once: own rows, baselines and published ones have the same scenes."""
    if note not in report.notes:
        report.notes.append(note)


def _mean(cells: Sequence[Cell]) -> Mean:
    orientations = [cell.orientation_deg for cell in cells if cell.orientation_deg is not None]
    whole = len(orientations) == len(cells)
    position = statistics.fmean(cell.position_m for cell in cells)
    return Mean(position, statistics.fmean(orientations) if whole else None, len(cells))


def _row(key: tuple[str, ...], by: Sequence[str], groups: Mapping[str, list[Run]], pick: Pick, choice: Choice) -> Row:
    settings = dict(zip(by, key[1:], strict=True))
    told = ", ".join(f"{name.rpartition('.')[2]}={value}" for name, value in settings.items() if value != UNTOLD)
    label = key[0] + (f" ({told})" if told else "")
    cells = {}
    for scene, runs in groups.items():
        chosen = pick_runs(runs, pick, f"{label} on {scene}", choice)
        cells[scene] = _cell(chosen, len(runs))
    shown = [run for cell in cells.values() for run in cell.runs]
    features = ", ".join(dict.fromkeys(run.features for run in shown))
    if len(cells) > 1 and (names := differing_settings(shown, BY_SCENE)):
        told = ", ".join(f"{name} ({', '.join(values)})" for name, values in list(names.items())[:4])
        choice.notes.append(f"{label} has other settings in other scenes: {told}{', ...' if len(names) > 4 else ''}")
    return Row(
        kind="own",
        system=label,
        features=features,
        cells=cells,
        settings=settings,
        costs=over_scenes(cells, {name: f"cost/{name}" for name in COSTS}),
        skill=over_scenes(cells, {name: f"test/{name}" for name in SKILLS}),
    )


def _cell(runs: Sequence[Run], candidates: int) -> Cell:
    positions, orientations = (
        [run.metrics.get(f"test/{n}", math.nan) for run in runs] for n in (POSITION, ORIENTATION)
    )
    several = len(runs) > 1
    return Cell(
        position_m=statistics.fmean(positions),
        orientation_deg=statistics.fmean(orientations),
        position_std_m=_std(positions) if several else None,
        orientation_std_deg=_std(orientations) if several else None,
        runs=tuple(runs),
        candidates=candidates,
    )


def _std(values: Sequence[float]) -> float:
    """Of a sample, n - 1; not a number where a value is none."""
    return statistics.stdev(values) if all(map(math.isfinite, values)) else math.nan


def over_scenes(cells: Mapping[str, Cell], metrics: Mapping[str, str]) -> dict[str, float]:
    """Mean over the scenes of the mean over a cell's runs, of each metric that all of them have."""
    found = {}
    for name, metric in metrics.items():
        values = [[run.metrics.get(metric) for run in cell.runs] for cell in cells.values()]
        told = [[value for value in cell if value is not None] for cell in values]
        if told and all(told):
            found[name] = statistics.fmean(statistics.fmean(cell) for cell in told)
    return found


def _scene_order(scene: str) -> tuple[int, str]:
    """The seven scenes in the order of the thesis, then the others by name."""
    return (SEVEN_SCENES.index(scene) if scene in SEVEN_SCENES else len(SEVEN_SCENES), scene)


def _row_order(key: tuple[str, ...]) -> list[tuple[int, float, str]]:
    """By name, numbers as numbers."""
    return [_sortable(part) for part in key]


def _sortable(text: str) -> tuple[int, float, str]:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    return (1, 0.0, text) if math.isnan(number) else (0, number, text)
