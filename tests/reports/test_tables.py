"""Tables: means that are recomputed, and mixtures that are refused."""

from __future__ import annotations

import pytest

from lightning_pose.errors import ConfigError
from lightning_pose.reports.beside import add_baselines
from tests.reports.helpers import shown
from tests.stores import FakeRun


def test_rows_are_systems_and_columns_scenes(table) -> None:
    report = table(
        FakeRun("SurfLSTM", "stairs", (0.3, 10.0)),
        FakeRun("SurfLSTM", "office_b", (0.5, 6.0)),
        FakeRun("SurfLSTM", "chess", (0.1, 8.0)),
        FakeRun("NodePose", "chess", (0.2, 7.0)),
    )
    assert report.scenes == ["chess", "stairs", "office_b"]
    assert shown(report) == {"NodePose": {"chess": 0.2}, "SurfLSTM": {"chess": 0.1, "stairs": 0.3, "office_b": 0.5}}
    node, lstm = (row.mean for row in report.rows)
    assert (lstm.position_m, lstm.orientation_deg, lstm.scenes) == (pytest.approx(0.3), pytest.approx(8.0), 3)
    assert (node.position_m, node.orientation_deg, node.scenes) == (0.2, 7.0, 1)
    assert any(note.startswith("a mean marked [k of n]") for note in report.notes)


def test_rows_by_settings_in_the_order_of_numbers(table) -> None:
    runs = [FakeRun("NodePose", params={"model.neighbours": n}) for n in ("20", "5", "100")]
    report = table(*runs, FakeRun("SurfLSTM"), by=("model.neighbours", "features"))
    assert [row.system for row in report.rows] == [
        "NodePose (neighbours=5, features=surf)",
        "NodePose (neighbours=20, features=surf)",
        "NodePose (neighbours=100, features=surf)",
        "SurfLSTM (features=surf)",
    ]
    assert report.rows[1].settings == {"model.neighbours": "20", "features": "surf"}
    with pytest.raises(ConfigError, match=r"no run tells 'neighbors', .* did you mean model.neighbours\?"):
        table(*runs, by=("neighbors",))


def test_settings_that_only_look_like_numbers_are_text(table) -> None:
    values = ("2.6.6", "1e-3", "nan", "10", "2", ".5", "-")
    report = table(*(FakeRun(params={"version": value}) for value in values), by=("version",))
    assert [row.settings["version"] for row in report.rows] == ["1e-3", ".5", "2", "10", "-", "2.6.6", "nan"]


@pytest.mark.parametrize(
    ("fact", "other"),
    [
        ("split", "blocks"),
        ("ground_truth", "sfm"),
        ("unit", "scene"),
        ("image_size", "320x240"),
        ("test_frames", "150"),
        ("dataset", "tum"),
        ("task", "relative"),
    ],
)
def test_a_column_mixes_nothing(table, fact: str, other: str) -> None:
    one = FakeRun("SurfLSTM", tags={"test_frames": "2000"}, day=1)
    two = FakeRun("NodePose", tags={"test_frames": "2000", fact: other}, day=2)
    says = rf"runs on chess differ in {fact} .* \(0000000\d\) has .*; give --tag {fact}=\S+ or --tag {fact}=\S+$"
    with pytest.raises(ConfigError, match=says) as info:
        table(one, two)
    assert other in str(info.value)
    assert "NodePose chess" in str(info.value)
    assert "SurfLSTM chess" in str(info.value)
    assert len(table(one, FakeRun("NodePose", "fire", tags=two.tags)).rows) == 2, "other scenes may differ"


def test_clips_of_another_length_do_not_mix(table) -> None:
    clips = [FakeRun("CNN3D", tags={"task": "relative", "clip_length": n}) for n in ("10", "100")]
    with pytest.raises(ConfigError, match=r"differ in clip_length .* grow with the clip"):
        table(*clips)


def test_what_old_runs_do_not_tell_is_told(table) -> None:
    old = FakeRun("SurfLSTM", tags={"image_size": None, "split": None})
    report = table(old, FakeRun("NodePose", tags={"test_frames": "150"}))
    (note,) = [note for note in report.notes if "do not tell" in note]
    assert note == "1 of 2 runs do not tell split, image size, test frames: taken to match the others, not checked"
    assert report.captions == ["chess: absolute poses, official split, original ground truth, images 640x480, "
                               "150 test frames"]  # fmt: skip


def test_no_mean_over_units_or_tasks(table) -> None:
    report = table(FakeRun(), FakeRun(scene="fox", tags={"unit": "scene"}))
    assert report.rows[0].mean is None
    assert "scenes differ in unit or task: no mean over them" in report.notes
    mixed = table(FakeRun(), FakeRun(scene="den", tags={"split": "blocks"}))
    assert mixed.rows[0].mean is not None
    assert "scenes differ in split: the mean over them mixes the two" in mixed.notes


def test_a_row_with_other_settings_in_other_scenes_says_so(table) -> None:
    report = table(
        FakeRun(params={"model.units": "100", "data.root": "a"}),
        FakeRun(scene="fire", params={"model.units": "200", "data.root": "b"}),
    )
    assert "SurfLSTM has other settings in other scenes: model.units (100, 200)" in report.notes
    alike = table(FakeRun(), FakeRun(scene="fire"))
    assert not any("other settings" in note for note in alike.notes), "another scene is no other setting"


def test_costs_and_skill_are_means_over_scenes(table) -> None:
    report = table(
        FakeRun(metrics={"cost/train_seconds": 2.0, "test/skill_position": 0.5}),
        FakeRun(scene="fire", metrics={"cost/train_seconds": 4.0}),
    )
    assert report.rows[0].costs == {"train_seconds": 3.0}
    assert report.rows[0].skill == {}, "one scene has none"


def baseline(name: str, value: float) -> dict[str, float]:
    return {f"baseline/{name}/position_median_m": value, f"baseline/{name}/orientation_median_deg": 10 * value}


def test_baselines_by_their_features(table) -> None:
    oracle = baseline("oracle", 0.1)
    report = table(
        FakeRun("SurfLSTM", metrics={**baseline("retrieval_top1", 0.3), **oracle}),
        FakeRun("SurfCNN", metrics={**baseline("retrieval_top1", 0.3), **oracle}),
        FakeRun("NodePose", tags={"features": "cnn"}, metrics={**baseline("retrieval_top1", 0.2), **oracle}),
        FakeRun("NodePose", "fire", tags={"features": "cnn"}, metrics=baseline("retrieval_top1", 0.5)),
    )
    add_baselines(report)
    rows = [row for row in report.rows if row.kind == "baseline"]
    assert [(row.system, row.features) for row in rows] == [
        ("retrieval_top1", "cnn"),
        ("retrieval_top1", "surf"),
        ("oracle", ""),
    ]
    assert rows[0].cells["fire"].orientation_deg == 5.0
    assert rows[0].mean is not None
    assert rows[0].mean.position_m == pytest.approx(0.35)


def test_baselines_that_differ_say_whose_they_are(table) -> None:
    report = table(
        FakeRun("SurfLSTM", metrics=baseline("train_mean", 0.6)),
        FakeRun("SurfCNN", metrics=baseline("train_mean", 0.6)),
        FakeRun("LinearPoseNet", metrics=baseline("train_mean", 0.5)),
    )
    add_baselines(report)
    assert [row.system for row in report.rows if row.kind == "baseline"] == [
        "train_mean beside LinearPoseNet",
        "train_mean beside SurfCNN, SurfLSTM",
    ]
    assert any("learn from different frames" in note for note in report.notes)
