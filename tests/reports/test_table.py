"""Tables: means that are recomputed, and mixtures that are refused."""

from __future__ import annotations

import pytest

from lightning_pose.errors import ConfigError
from lightning_pose.reports.baseline_rows import add_baselines
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
    node, lstm = (row.means["mean"] for row in report.rows)
    assert (*lstm.errors, lstm.scenes) == (pytest.approx(0.3), pytest.approx(8.0), 3)
    assert (*node.errors, node.scenes) == (0.2, 7.0, 1)
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
    with pytest.raises(ConfigError, match=r"no run has 'neighbors', .* did you mean model.neighbours\?"):
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
    (note,) = [note for note in report.notes if "do not record" in note]
    assert note == "1 of 2 runs do not record split, image size, test frames: taken to match the others, not checked"
    assert report.captions == ["chess: absolute poses, official split, original ground truth, images 640x480, "
                               "150 test frames"]  # fmt: skip


CLIPS = {"task": "relative", "clip_length": "10", "stride": "1", "relative_frame": "camera"}


@pytest.mark.parametrize(
    ("fact", "other"), [("unit", "scene"), ("task", "absolute"), ("relative_frame", "world")], ids=str
)
def test_no_mean_over_what_does_not_add_up(table, fact: str, other: str) -> None:
    report = table(FakeRun(tags=CLIPS), FakeRun(scene="den", tags={**CLIPS, fact: other}))
    assert report.rows[0].means == {}
    told = f"scenes differ in {fact.replace('_', ' ')}: no mean over them"
    assert [note for note in report.notes if "scenes differ" in note] == [told]


@pytest.mark.parametrize(
    ("fact", "other"),
    [
        ("split", "blocks"),
        ("ground_truth", "sfm"),
        ("image_size", "320x240"),
        ("clip_length", "100"),
        ("stride", "2"),
    ],
)
def test_a_mean_over_mixed_scenes_says_so(table, fact: str, other: str) -> None:
    report = table(FakeRun(tags=CLIPS), FakeRun(scene="den", tags={**CLIPS, fact: other}))
    assert report.rows[0].means["mean"].scenes == 2
    told = f"scenes differ in {fact.replace('_', ' ')}: the mean over them mixes the two"
    assert [note for note in report.notes if "scenes differ" in note] == [told]


def test_errors_of_scenes_tested_alike_mix_wherever_the_network_was_trained(table) -> None:
    rooms = {"dataset": "tum+7scenes", "ground_truth": "synthetic+original"}
    report = table(
        FakeRun(scene="heads to chess", tags={**CLIPS, "split": "unseen"}),
        FakeRun(scene="den to chess", tags={**CLIPS, "split": "unseen", **rooms}),
    )
    assert list(report.means) == ["mean"]
    assert not any("scenes differ" in note for note in report.notes)


def test_a_mean_for_each_dataset(table) -> None:
    outdoors = {"dataset": "cambridge", "ground_truth": "sfm", "image_size": "1920x1080"}
    report = table(
        FakeRun(test=(0.1, 8.0)),
        FakeRun(scene="fire", test=(0.3, 6.0)),
        FakeRun(scene="KingsCollege", test=(2.0, 3.0), tags=outdoors),
        FakeRun(scene="OldHospital", test=(4.0, 5.0), tags=outdoors),
        FakeRun("NodePose", "ShopFacade", test=(1.0, 4.0), tags=outdoors),
    )
    outside = ["KingsCollege", "OldHospital", "ShopFacade"]
    assert report.means == {"mean 7scenes": ["chess", "fire"], "mean cambridge": outside}
    node, lstm = report.rows
    assert {column: mean.scenes for column, mean in node.means.items()} == {"mean cambridge": 1}
    errors = {column: mean.errors for column, mean in lstm.means.items()}
    assert errors == {"mean 7scenes": (pytest.approx(0.2), 7.0), "mean cambridge": (3.0, 4.0)}
    assert not any("scenes differ" in note for note in report.notes), "each mean is of scenes measured alike"


def test_one_datasets_units_leave_the_mean_of_another(table) -> None:
    report = table(
        FakeRun(),
        FakeRun(scene="fox", tags={"dataset": "nerf", "unit": "scene"}),
        FakeRun(scene="barn", tags={"dataset": "nerf"}),
        FakeRun(scene="den", tags={"dataset": None}),
    )
    assert report.means == {"mean 7scenes": ["chess"], "mean nerf": ["barn", "fox"], "mean unknown": ["den"]}
    assert list(report.rows[0].means) == ["mean 7scenes", "mean unknown"]
    assert "scenes of nerf differ in unit: no mean over them" in report.notes
    alone = table(FakeRun(), FakeRun(scene="den", tags={"dataset": None}))
    assert alone.means == {"mean": ["chess", "den"]}, "what is not told is taken to match"


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
    assert report.rows[0].average_costs() == {"train_seconds": 3.0}, "one scene has no skill"


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
    assert rows[0].cells["fire"].errors[1] == 5.0
    assert rows[0].means["mean"].errors[0] == pytest.approx(0.35)


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
