"""Reference rows for the scenes on show: chosen, merged where tables agree, and marked as published.

`published_rows.csv` has the errors, one a line: medians in metres and degrees on the official test split (`cell`),
and means over the seven scenes that the field quotes, with the original ground truth (`mean`). `published_scenes.csv`
has the scenes, `published_remarks.csv` remarks by table, or by scene of tables 4.1 and 5.2. Tables 2.4, 2.5 and 3.3 are
of recordings of TUM RGB-D and ICL-NUIM, which have no official split; the author's own data of table 2.4, which are not
public, are left out. Numbers are as printed, but for three kinds of slips that the chapters themselves show:

- Tables 2.3 and 3.2 name the scenes in another order than the later ones, yet seven of their rows from the literature
  are in the later order. These rows are read in that order.
- Table 4.1's "0.8/47" is 0.8/4.7.
- Table 3.2's ".25/12.00" is 0.25/12.00.

The tables' averages are not kept: several do not equal the mean of their rows, so means are computed anew.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from importlib.resources import files

from lightning_pose.reports.comparability import find_tested_fact
from lightning_pose.reports.table import Cell, Report, Row, add_means

__all__ = ["CHAPTERS", "FRAMES", "SCENES", "add_published", "read_published"]

CHAPTERS = (2, 3, 4, 5, 6)
SOURCE = (
    "published, not measured here: A. Elmoogy, Efficient Image Based Localization Using Machine Learning Techniques, "
    "University of Victoria"
)
SEVEN = 7
GROUND_TRUTHS = {"7scenes": "original", "cambridge": "sfm", "tum": "original", "icl_nuim": "synthetic"}
"""What the published errors of a dataset were measured against."""


def _read_csv(name: str) -> list[dict[str, str]]:
    """The lines of a CSV file of this package, in their order."""
    text = files("lightning_pose.reports").joinpath(f"{name}.csv").read_text(encoding="utf-8")
    return list(csv.DictReader(text.splitlines()))


WITH_SPLITS = ("7scenes", "cambridge")
"""Datasets with official splits."""

SCENES = {line["folder"]: line["name"] for line in _read_csv("published_scenes") if line["dataset"] in WITH_SPLITS}
"""Folders of these, in small letters without spaces, hyphens and underscores, to names of scenes in the rows."""

FRAMES = {
    line["name"]: int(line["test_frames"]) for line in _read_csv("published_scenes") if line["dataset"] in WITH_SPLITS
}
"""Test frames of the official splits."""

RECORDINGS = {(line["dataset"], line["folder"]): line["name"] for line in _read_csv("published_scenes")}
"""The same for all datasets: (dataset, folder) to names; `rgbd_dataset_freiburg1_xyz` of TUM RGB-D is `fr1xyz`."""

RECORDED_FRAMES = {line["name"]: line["test_frames"] for line in _read_csv("published_scenes")}
"""Test frames as table 2.4 counts them, which are of no official split; empty where the thesis gives none."""


def read_published(chapters: Iterable[int] = CHAPTERS) -> dict[tuple[str, str, str], dict[str, Cell]]:
    """The rows of the thesis's tables 2.3, 2.4, 2.5, 3.2, 3.3, 4.1, 5.2 and 6.1.

    Args:
        chapters: whose tables.

    Returns:
        (number of the table, system as the table names it, task) to cells by scene, in the names that `SCENES` gives.
    """
    rows: dict[tuple[str, str, str], dict[str, Cell]] = {}
    for line in _read_csv("published_rows"):
        if line["kind"] == "cell" and int(line["chapter"]) in chapters:
            row = rows.setdefault((line["table"], line["system"], line["task"]), {})
            row[line["scene"]] = _published_cell(line)
    return rows


def add_published(report: Report, chapters: Sequence[int] = ()) -> None:
    """Append the reference rows of the scenes on show, with their sources and what keeps them from comparing.

    Args:
        report: gets rows, notes and footnotes.
        chapters: of the thesis; all, and means of other papers, if none is given.
    """
    columns = {scene: name for scene in report.scenes if (name := _published_name(report, scene))}
    if not columns:
        report.notes.append(
            f"no published row: none of the scenes on show ({', '.join(report.scenes)}) is one of 7-Scenes "
            "or Cambridge, or of the thesis's recordings of TUM RGB-D or ICL-NUIM, with its original ground truth "
            f"({', '.join(dict.fromkeys(RECORDINGS.values()))})"
        )
        return
    rows: dict[tuple[object, ...], Row] = {}
    tables: set[str] = set()
    left_out: set[str] = set()
    for (table, system, task), cells in read_published(chapters or CHAPTERS).items():
        shared = {scene: cells[name] for scene, name in columns.items() if name in cells}
        alike = {scene: shared[scene] for scene in shared if report.facts[scene].get("task", task) == task}
        if len(alike) < len(shared):
            left_out.add(task)
        if alike:
            # Tables that agree in all the cells on show share a row.
            key = system, *((scene, cell.errors) for scene, cell in alike.items())
            row = rows.setdefault(key, Row("published", system, "", alike))
            row.source += f", {table}" if row.source else f"table {table}"
            row.features = row.source
            tables.add(table)
    add_means(report, list(rows.values()))
    means = [] if chapters else _mean_rows(report, columns)
    report.rows += [*rows.values(), *means]
    report.notes += [f"published rows of {task} poses are left out: those on show are not" for task in sorted(left_out)]
    report.notes.append(_compare_scenes(report, columns) if rows or means else "no published row has the task on show")
    report.footnotes += _list_sources(sorted(tables), bool(means), set(columns.values()))


def _published_cell(line: Mapping[str, str]) -> Cell:
    """The errors of a line, as numbers and as printed; VidLoc has no orientation."""
    text = line["position_m"], line["orientation_deg"]
    return Cell((float(text[0]), float(text[1]) if text[1] else None), text=text)


def _published_name(report: Report, scene: str) -> str | None:
    """The published name of a scene on show; that of the scene tested on, for a model trained elsewhere."""
    facts = report.facts[scene]
    dataset = find_tested_fact(scene, facts, "dataset") or "7scenes"
    truth = GROUND_TRUTHS.get(dataset)
    if truth is None or (find_tested_fact(scene, facts, "ground_truth") or truth) != truth:
        return None
    folder = re.sub("[ _-]", "", scene.rpartition(" to ")[2].lower())
    if dataset in WITH_SPLITS:
        return SCENES.get(folder)
    return RECORDINGS.get((dataset, folder.removeprefix("rgbddataset").replace("freiburg", "fr")))


def _mean_rows(report: Report, columns: dict[str, str]) -> list[Row]:
    """Means over the seven scenes as other papers quote them, where a column of the report is over just these."""
    absolute = {scene for scene in columns if report.facts[scene].get("task", "absolute") == "absolute"}
    seven = set(list(SCENES.values())[:SEVEN])
    for column, scenes in report.means.items():
        if len(scenes) == SEVEN and {columns[scene] for scene in scenes if scene in absolute} == seven:
            rows = []
            for line in [line for line in _read_csv("published_rows") if line["kind"] == "mean"]:
                mean = replace(_published_cell(line), text=None, scenes=SEVEN)
                source = line["source"]
                rows.append(Row("published", line["system"], source, {}, means={column: mean}, source=source))
            return rows
    if absolute:
        report.notes.append("published means over the seven scenes are left out: other scenes, or fewer, are on show")
    return []


def _compare_scenes(report: Report, columns: dict[str, str]) -> str:
    """A note on whether the scenes on show are what was published."""
    reasons = [why for scene, name in columns.items() for why in _list_differences(scene, name, report.facts[scene])]
    if not reasons:
        return "published rows are of the same official test frames; image sizes and training may differ"
    official = " are of the whole official test split and" if set(columns.values()) & set(FRAMES) else ""
    return f"published rows{official} do not compare: {'; '.join(reasons)}"


def _list_differences(scene: str, name: str, facts: Mapping[str, str]) -> list[str]:
    """What keeps the errors on a scene from comparing with published ones."""
    if name not in FRAMES:
        count = f" {RECORDED_FRAMES[name]}" if RECORDED_FRAMES[name] else ""
        return [f"{scene} has no official split, and the thesis does not say which{count} frames of it were tested"]
    reasons = []
    frames, whole = facts.get("test_frames"), str(FRAMES[name])
    # A scene that was only tested on has the frames of its official split, and the split `unseen`.
    if facts.get("split", "official") not in ("official", "unseen"):
        reasons.append(f"{scene} has its own split ({facts['split']})")
    elif frames is None:
        reasons.append(f"{scene} may be a cut, no run records how many of the {whole} test frames it has")
    elif frames != whole:
        reasons.append(f"{scene} is a cut, {frames} test frames of {whole}")
    # Where no run records the split, the names say what was trained on.
    learned, apart, asked = scene.rpartition(" to ")
    seen = facts["split"] != "unseen" if "split" in facts else not apart or asked in learned.split("+")
    if facts.get("task") == "relative" and seen:
        reasons.append(f"{asked} was seen in training, the scenes of published clips were not")
    return reasons


def _list_sources(tables: Sequence[str], means: bool, scenes: set[str]) -> list[str]:
    """The footnotes: sources, what must be known about them, and what they are not."""
    notes = []
    if tables:
        notes.append(
            f"{SOURCE}, table{'s' if len(tables) > 1 else ''} {', '.join(tables)}: cells as printed, means recomputed "
            "from them, so that the tables' own averages may differ; the chapters disagree with each other in places"
        )
        remarks = _read_csv("published_remarks")
        notes += [line["remark"] for line in remarks if line["about"] in (*tables, *scenes)]
    if means:
        notes.append("means over the seven scenes, original ground truth, as the literature quotes them: no cells")
    if notes:
        notes.append(
            "all of these regress or retrieve poses; structure-based systems, such as ACE and hloc, are ten times "
            "more accurate"
        )
    return notes
