"""Published rows: their figures, which of them are shown, and what keeps them from comparing."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from lightning_pose.reports.published_rows import FRAMES, SCENES, add_published, read_published
from lightning_pose.reports.table import Report
from lightning_pose.scenes.combine import join_scenes
from lightning_pose.scenes.scene import Frame, Scene

SEVEN = list(SCENES)[:7]

RECORDED = {
    "2.4": {"fr1/xyz", "fr1/rpy", "fr2/xyz", "fr2/rpy"},
    "2.5": {"icl/office 0", "icl/office 1", "icl/office 2", "fr3/long office household"},
    "3.3": {"fr1/xyz", "fr2/xyz", "fr3/long office household", "fr3/nostructure texture near withloop"},
}
"""Tables of recordings, and theirs."""


def report_on(*scenes: str, **facts: str) -> Report:
    """A table without rows of the user's own."""
    told = {"task": "absolute", "dataset": "7scenes", "split": "official", "ground_truth": "original", "unit": "m"}
    return Report(list(scenes), dict.fromkeys(scenes, told | facts), [], "", [])


def a_scene(name: str, form: str = "7scenes", ground_truth: str = "original", test: int | None = None) -> Scene:
    """A scene with as many frames again to train on as the official split has to test."""
    count = FRAMES.get(name, 10) if test is None else test
    frame = Frame(Path(name), np.zeros(3), np.eye(4)[0], "seq-01", 0)
    splits = {"train": np.arange(count), "val": np.zeros(0, np.int64), "test": np.arange(count, 2 * count)}
    source = "blocks" if form == "tum" else "official"
    return Scene(name, Path(name), form, (frame,) * 2 * count, splits, source, ground_truth=ground_truth)


ROOM = a_scene("room-0-300-v1", ground_truth="synthetic")
OFFICE = a_scene("hololens_office", "tum")


def clips_on(train: Sequence[Scene], test: Sequence[Scene]) -> Report:
    """A table of a model of clips, with the facts that its run has."""
    joint = join_scenes(train, test)
    facts = {"dataset": joint.format, "split": joint.split_source, "ground_truth": joint.ground_truth}
    return report_on(joint.name, task="relative", test_frames=str(len(joint.splits["test"])), **facts)


def cell(system: str, table: str, scene: str) -> tuple[float, float | None]:
    (cells,) = [cells for key, cells in read_published().items() if key[:2] == (table, system)]
    return cells[scene].errors


def test_every_table_is_whole() -> None:
    rows = read_published()
    counts = {table: sum(key[0] == table for key in rows) for table in (*RECORDED, "2.3", "3.2", "4.1", "5.2", "6.1")}
    assert counts == {"2.3": 14, "2.4": 2, "2.5": 3, "3.2": 14, "3.3": 3, "4.1": 14, "5.2": 15, "6.1": 7}
    for (table, system, _), cells in rows.items():
        if table in RECORDED:
            assert set(cells) == RECORDED[table], system
            continue
        outdoors = table in ("4.1", "5.2") and len(cells) > 7
        assert set(cells) == (set(FRAMES) if outdoors else set(list(FRAMES)[:7])), system
        assert all(0.1 <= c.errors[0] <= 8 for c in cells.values())
        assert all(c.errors[1] is None or 1 <= c.errors[1] <= 19 for c in cells.values())


@pytest.mark.parametrize(
    ("system", "table", "scene", "errors"),
    [
        ("SurfCNN 300", "2.3", "kitchen", (0.37, 10.25)),
        ("SurfCNN 300", "2.3", "fire", (0.24, 8.2)),
        ("SurfCNN", "3.2", "fire", (0.24, 12.8)),
        ("SURF-CNN", "4.1", "stairs", (0.36, 10.8)),
        ("SURF-LSTM 50", "3.2", "kitchen", (0.36, 7.6)),
        ("Node-Pose (ImageNet)", "4.1", "shop", (0.8, 4.7)),
        ("Dense-PoseNet (Places)", "5.2", "kings", (1.5, 2.9)),
        ("VidLoc", "2.3", "kitchen", (0.31, None)),
        ("SurfCNN", "2.4", "fr1/rpy", (0.03, 0.39)),
        ("PoseNet", "2.4", "fr2/xyz", (0.12, 0.12)),
        ("SurfCNN", "2.5", "icl/office 2", (0.52, None)),
        ("ORB-SLAM", "2.5", "fr3/long office household", (1.2, None)),
        ("Surf-LSTM", "3.3", "fr3/nostructure texture near withloop", (0.45, None)),
        ("ORB-SLAM", "3.3", "fr3/nostructure texture near withloop", (0.436, None)),
        ("3D CNN, clips", "6.1", "kitchen", (0.16, 6.5)),
        ("2D CNN-RNN, clips", "6.1", "heads", (0.187, 7.26)),
    ],
)
def test_cells(system: str, table: str, scene: str, errors: tuple[float, float | None]) -> None:
    assert cell(system, table, scene) == errors


@pytest.mark.parametrize("system", ["PoseNet", "G-PoseNet", "Mobile-PoseNet"])
def test_the_literature_is_the_same_in_all_chapters(system: str) -> None:
    for scene in list(FRAMES)[:7]:
        assert cell(system, "2.3", scene) == cell(system, "3.2", scene) == cell(system, "5.2", scene)


def test_some_printed_averages_are_the_means_of_their_cells() -> None:
    """Where they are, a slip in copying a cell would show."""
    printed = {
        ("SurfCNN 300", "2.3"): (0.28, None), ("SURF-LSTM 100", "3.2"): (0.29, 9.53), ("PoseNet", "2.3"): (0.44, None),
        ("RelocNet", "2.3"): (0.29, 11.29), ("Dense VLAD", "4.1"): (0.26, 13.11), ("PN L-W", "5.2"): (0.24, 7.87),
        ("Node-Pose (ImageNet)", "4.1"): (0.19, 7.5), ("Graph-Pose (ImageNet)", "4.1"): (0.22, 7.74),
        ("3D CNN, clips", "6.1"): (0.161, 7.2), ("2D CNN-RNN, clips", "6.1"): (0.21, 8.23),
        ("Pose-LSTM", "6.1"): (0.32, 9.85), ("Linear-PoseNet (Places)", "5.2"): (0.31, 10.76),
    }  # fmt: skip
    for (system, table), (position_m, orientation_deg) in printed.items():
        cells = [cell(system, table, scene) for scene in list(FRAMES)[:7]]
        assert statistics.fmean(c[0] for c in cells) == pytest.approx(position_m, abs=0.006), system
        if orientation_deg is not None:
            assert statistics.fmean(c[1] or 0 for c in cells) == pytest.approx(orientation_deg, abs=0.02), system


def test_rows_of_the_scenes_on_show() -> None:
    report = report_on("redkitchen", "den")
    add_published(report, [2])
    rows = {row.system: row for row in report.rows}
    assert len(rows) == 14
    assert rows["SurfCNN 300"].kind == "published"
    assert list(rows["SurfCNN 300"].cells) == ["redkitchen"]
    assert rows["SurfCNN 300"].cells["redkitchen"].text == ("0.37", "10.25")
    mean = rows["VidLoc"].means["mean"]
    assert (*mean.errors, mean.scenes) == (0.31, None, 1)
    assert any("table 2.3" in note and "recomputed" in note for note in report.footnotes)
    assert any("structure-based" in note for note in report.footnotes)


def test_tables_that_agree_share_a_row() -> None:
    report = report_on("heads", "office", "redkitchen")
    add_published(report)
    sources = {(row.system, row.source) for row in report.rows}
    assert {("PoseNet", "table 2.3, 3.2, 4.1, 5.2"), ("PoseNet", "table 6.1")} <= sources, "the office differs"
    assert ("G-PoseNet", "table 2.3, 3.2, 5.2") in sources
    assert ("G-PoseNet", "table 4.1") in sources, "there it has another row's cells"
    assert ("SurfCNN", "table 3.2") in sources
    assert ("SURF-CNN", "table 4.1, 5.2") in sources


def test_cambridge_has_its_scenes() -> None:
    report = report_on("KingsCollege", "ShopFacade", dataset="cambridge", ground_truth="sfm", test_frames="343")
    add_published(report, [5])
    dense = next(row for row in report.rows if row.system == "Dense-PoseNet (Places)")
    assert [(c.errors[0], c.errors[1]) for c in dense.cells.values()] == [(1.5, 2.9), (0.75, 3.5)]
    assert any("0.8/47" in note for note in report.footnotes)
    assert not any("St Mary's" in note for note in report.footnotes)
    assert any("ShopFacade is a cut, 343 test frames of 103" in note for note in report.notes)


@pytest.mark.parametrize("facts", [{"dataset": "tum"}, {"ground_truth": "sfm"}, {"ground_truth": "synthetic"}], ids=str)
def test_other_data_of_the_same_name_has_no_published_rows(facts: dict[str, str]) -> None:
    report = report_on("office", **facts)
    add_published(report)
    assert report.rows == []
    assert "no published row: none of the scenes on show (office)" in report.notes[0]


@pytest.mark.parametrize(
    ("scene", "facts", "tables"),
    [
        ("rgbd_dataset_freiburg1_xyz", {"dataset": "tum"}, {"table 2.4", "table 3.3"}),
        ("rgbd_dataset_freiburg1_desk to fr1_rpy", {"dataset": "tum", "split": "unseen"}, {"table 2.4"}),
        ("rgbd_dataset_freiburg3_long_office_household", {"dataset": "tum"}, {"table 2.5", "table 3.3"}),
        ("traj1_frei_png", {"dataset": "icl_nuim", "ground_truth": "synthetic"}, {"table 2.5"}),
    ],
)
def test_recordings_have_their_tables(scene: str, facts: dict[str, str], tables: set[str]) -> None:
    report = report_on(scene, **({"split": "blocks"} | facts))
    add_published(report)
    assert {row.source for row in report.rows} == tables
    assert any("has no official split, and the thesis does not say which" in note for note in report.notes)
    hardly = [note for note in report.footnotes if "radians (0.39 is 22 degrees)" in note]
    assert bool(hardly) == ("table 2.4" in tables)


def test_a_folder_of_another_scene_is_not_taken_for_a_published_one() -> None:
    others = ("office-2", "chess_2", "heads3", "2chess", "my_office")
    report = report_on(*others, "Red Kitchen", "red_kitchen", "red-kitchen")
    add_published(report, [2])
    assert {scene for row in report.rows for scene in row.cells} == {"Red Kitchen", "red_kitchen", "red-kitchen"}


def with_cambridge() -> Report:
    """The ten scenes of tables 4.1 and 5.2."""
    inside, outside = report_on(*SEVEN), report_on(*list(SCENES)[7:], dataset="cambridge", ground_truth="sfm")
    return Report([*inside.scenes, *outside.scenes], inside.facts | outside.facts, [], "", [])


@pytest.mark.parametrize(("report", "column"), [(report_on(*SEVEN), "mean"), (with_cambridge(), "mean 7scenes")])
def test_means_stand_beside_the_seven_scenes(report: Report, column: str) -> None:
    add_published(report)
    means = {row.system: row.means for row in report.rows if not row.cells}
    assert len(means) == 8
    assert list(means["AtLoc"]) == [column]
    atloc = means["AtLoc"][column]
    assert (atloc.errors[0], atloc.errors[1], atloc.scenes) == (0.20, 7.56, 7)


def test_means_over_seven_scenes_do_not_stand_beside_fewer() -> None:
    report = report_on(*SEVEN[:6])
    add_published(report)
    assert all(row.cells for row in report.rows)
    assert any("means over the seven scenes are left out" in note for note in report.notes)


def test_published_rows_have_a_mean_for_each_dataset() -> None:
    report = with_cambridge()
    add_published(report, [5])
    (dense,) = [row for row in report.rows if row.system == "Dense-PoseNet (ImageNet)"]
    inside, outside = dense.means["mean 7scenes"], dense.means["mean cambridge"]
    assert (inside.errors[0], inside.scenes) == (pytest.approx(1.38 / 7), 7)
    assert (outside.errors[0], outside.errors[1]) == (pytest.approx(4.6 / 3), pytest.approx(14 / 3))


@pytest.mark.parametrize(("task", "systems"), [("relative", 2), ("absolute", 5)])
def test_clips_stand_beside_clips(task: str, systems: int) -> None:
    report = report_on("heads", task=task)
    add_published(report, [6])
    assert len(report.rows) == systems
    assert all(row.system.endswith("clips") == (task == "relative") for row in report.rows)
    assert any("poses are left out" in note for note in report.notes)


@pytest.mark.parametrize(
    "train",
    [[a_scene("heads")], [ROOM], [OFFICE], [a_scene("fire"), OFFICE, ROOM]],
    ids=lambda scenes: "+".join(scene.name for scene in scenes),
)
def test_a_model_trained_elsewhere_stands_beside_the_scene_it_was_tested_on(train: list[Scene]) -> None:
    """The protocol of table 6.1: the official test frames of a scene that was not trained on."""
    report = clips_on(train, [a_scene("chess")])
    (scene,) = report.scenes
    assert scene.endswith(" to chess")
    add_published(report, [6])
    assert [row.cells[scene].errors[0] for row in report.rows] == [0.22, 0.16]
    assert any(note.startswith("published rows are of the same official test frames") for note in report.notes)


def test_a_scene_tested_on_that_was_never_published_has_no_rows() -> None:
    for test in (ROOM, OFFICE, a_scene("chess", "tum"), a_scene("chess", ground_truth="synthetic")):
        report = clips_on([a_scene("heads"), a_scene("fire", "tum")], [test])
        add_published(report, [6])
        assert report.rows == [], test


def test_a_part_of_an_unseen_scene_does_not_compare() -> None:
    report = clips_on([a_scene("heads")], [a_scene("chess", test=150)])
    add_published(report, [6])
    assert any("do not compare: heads to chess is a cut, 150 test frames of 2000" in note for note in report.notes)


def test_published_clips_are_of_scenes_that_were_not_seen() -> None:
    says = "do not compare: chess was seen in training, the scenes of published clips were not"
    for train in ([a_scene("chess")], [a_scene("heads"), a_scene("chess")], [OFFICE, a_scene("chess")]):
        report = clips_on(train, [a_scene("chess")])
        add_published(report, [6])
        assert len(report.rows) == 2
        assert any(note.endswith(says) for note in report.notes), report.notes


@pytest.mark.parametrize(
    ("facts", "says"),
    [
        ({"test_frames": "150"}, "do not compare: redkitchen is a cut, 150 test frames of 5000"),
        ({"split": "blocks"}, "do not compare: redkitchen has its own split (blocks)"),
        ({}, "do not compare: redkitchen may be a cut, no run records how many of the 5000 test frames it has"),
        ({"test_frames": "5000"}, "published rows are of the same official test frames"),
    ],
)
def test_what_does_not_compare_is_told(facts: dict[str, str], says: str) -> None:
    report = report_on("redkitchen", **facts)
    add_published(report, [5])
    assert any(says in note for note in report.notes)
