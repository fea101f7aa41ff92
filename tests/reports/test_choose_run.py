"""Several runs of one cell: which is shown, and what is told of the choice."""

from __future__ import annotations

import math

import pytest

from lightning_pose.errors import ConfigError
from tests.reports.helpers import shown
from tests.stores import FakeRun


def test_best_is_by_validation_and_never_by_test(table) -> None:
    report = table(
        FakeRun(test=(0.1, 1.0), val=0.3, day=3),
        FakeRun(test=(0.9, 9.0), val=0.2, day=1),
        FakeRun(test=(0.05, 1.0), val=math.nan, day=2),
    )
    (cell,) = report.rows[0].cells.values()
    assert (cell.errors[0], cell.candidates, len(cell.runs)) == (0.9, 3, 1)
    assert "best by val/position_median_m" in report.rule
    assert any("SurfLSTM on chess (1 of 3): runs without a validation metric" in note for note in report.notes)


def test_best_is_by_the_best_epoch_where_a_run_tells_it(table) -> None:
    report = table(
        FakeRun(test=(0.1, 1.0), val=0.2, day=1),
        FakeRun(test=(0.9, 9.0), val=0.5, metrics={"best/val/position_median_m": 0.1}, day=2),
    )
    assert shown(report) == {"SurfLSTM": {"chess": 0.9}}


def test_the_rule_tells_how_many_runs_know_only_their_last_epoch(table) -> None:
    known = {"best/val/position_median_m": 0.1}
    runs = [FakeRun(metrics=known), FakeRun(val=0.2), FakeRun(scene="fire", val=0.3)]
    says = "the run that is best by val/position_median_m of its best epoch"
    assert table(*runs).rule == (
        f"of each system and scene, {says} (of its last, for 2 of 3 runs that do not record their best); "
        "never by test errors"
    )
    assert table(runs[0]).rule == f"of each system and scene, {says}; never by test errors"


def test_best_falls_back_to_the_loss_and_then_to_the_newest(table) -> None:
    by_loss = table(
        FakeRun(test=(0.1, 1.0), val=None, metrics={"val/loss": 2.0}, day=3),
        FakeRun(test=(0.9, 9.0), val=None, metrics={"val/loss": 1.0}, day=1),
    )
    assert shown(by_loss) == {"SurfLSTM": {"chess": 0.9}}
    newest = table(FakeRun(test=(0.1, 1.0), val=None, day=1), FakeRun(test=(0.9, 9.0), val=None, day=3))
    assert shown(newest) == {"SurfLSTM": {"chess": 0.9}}
    assert "SurfLSTM on chess: no validation metric, so the newest run is shown" in newest.notes


def test_the_latest(table) -> None:
    report = table(FakeRun(test=(0.1, 1.0), val=0.1, day=1), FakeRun(test=(0.9, 9.0), val=0.3, day=3), pick="latest")
    assert shown(report) == {"SurfLSTM": {"chess": 0.9}}


def test_validation_on_different_frames_is_told(table) -> None:
    report = table(FakeRun(), FakeRun(params={"data.val_fraction": "0.2"}))
    assert any("different data.val_fraction" in note for note in report.notes)


def test_spread_over_seeds(table) -> None:
    seeds = [FakeRun(test=(value, 10 * value), params={"seed": str(i)}) for i, value in enumerate((0.1, 0.2, 0.6))]
    (cell,) = table(*seeds, pick="spread").rows[0].cells.values()
    assert (cell.errors[0], cell.errors[1]) == (pytest.approx(0.3), pytest.approx(3.0))
    assert cell.deviations[0] == pytest.approx(math.sqrt(0.07))  # (0.04 + 0.01 + 0.09) / 2
    assert len(cell.runs) == 3


def test_spread_takes_the_newest_of_each_seed_and_no_test_runs(table) -> None:
    report = table(
        FakeRun(test=(9.0, 1.0), params={"seed": "0", "data.eval_batch_size": "64"}, day=1),
        FakeRun(test=(0.1, 1.0), params={"seed": "0", "data.workers": "4", "data.eval_batch_size": "8"}, day=2),
        FakeRun(test=(0.3, 1.0), params={"seed": "1"}, day=2),
        FakeRun(test=(9.0, 1.0), params={"seed": "2"}, tags={"verb": "test"}, day=2),
        pick="spread",
    )
    assert shown(report) == {"SurfLSTM": {"chess": pytest.approx(0.2)}}
    assert "SurfLSTM on chess: 3 runs have 2 seeds; the newest of each counts" in report.notes
    assert any("1 runs of `test` are left out" in note for note in report.notes)


def test_spread_counts_each_run_without_a_seed(table) -> None:
    """Whose seed the store tells as the text None."""
    runs = [FakeRun(test=(value, 1.0), params={"seed": "None"}) for value in (0.1, 0.2, 0.6)]
    report = table(*runs, pick="spread")
    (cell,) = report.rows[0].cells.values()
    assert (len(cell.runs), cell.errors[0]) == (3, pytest.approx(0.3))
    assert not any("seeds" in note for note in report.notes)


def test_spread_takes_one_scene_for_the_same_in_any_folder(table) -> None:
    """Where its name, its split and its test frames agree."""

    def runs(**tags: str | None) -> list[FakeRun]:
        folders = ("chess", "/data/7scenes/chess")
        return [
            FakeRun(tags=tags, params={"seed": f, "data.root": f, "data.train_scenes": f"['{f}']"}) for f in folders
        ]

    report = table(*runs(test_frames="2000"), pick="spread")
    (cell,) = report.rows[0].cells.values()
    assert len(cell.runs) == 2
    says = "runs name data.root, data.train_scenes in several ways; taken for the same data, as scene, split and"
    assert any(says in note for note in report.notes), report.notes
    with pytest.raises(ConfigError, match=r"differ in data.root \(/data/7scenes/chess, chess\)"):
        table(*runs(), pick="spread")


def test_spread_refuses_runs_that_differ_in_more_than_the_seed(table) -> None:
    runs = [FakeRun(params={"seed": str(n), "model.units": str(n)}) for n in (1, 2)]
    with pytest.raises(ConfigError, match=r"2 runs differ in model.units \(1, 2\), .* give --by model.units "):
        table(*runs, pick="spread")
    assert list(shown(table(*runs, pick="spread", by=("model.units",)))) == ["SurfLSTM (units=1)", "SurfLSTM (units=2)"]
    with pytest.raises(ConfigError, match="1 runs of `test`, which do not have the seed"):
        table(FakeRun(tags={"verb": "test"}), pick="spread")
