"""Filters: what passes, and what an error says where nothing does."""

from __future__ import annotations

from pathlib import Path

import pytest

from lightning_pose.errors import ConfigError
from lightning_pose.reports.filters import read_date, select_runs
from lightning_pose.runs.reader import Run, read_runs
from tests.stores import FakeRun, make_store

RUNS = [
    FakeRun(day=1, params={"model.units": "100"}),
    FakeRun(day=5, params={"model.units": "200"}, scene="fire"),
    FakeRun(day=9, system="NodePose", params={"model.neighbours": "20"}, experiment="graphs"),
    FakeRun(day=11, tags={"sweep.trial": "3", "mlflow.parentRunId": "f" * 32}, test=None),
    FakeRun(day=20, system="SurfCNN", test=None),
]


@pytest.fixture
def runs(tmp_path: Path, store: Path) -> list[Run]:
    return read_runs(make_store(tmp_path / "mlflow.db", store, RUNS))


def days(runs: list[Run], **filters: object) -> list[int]:
    kept, _ = select_runs(runs, **filters)  # type: ignore[arg-type]
    return sorted([1, 5, 9, 11, 20][int(run.run_id, 16)] for run in kept)


def test_untested_runs_and_trials_are_left_out(runs: list[Run]) -> None:
    assert days(runs) == [1, 5, 9]
    assert select_runs(runs)[1] == ["1 of 4 runs have no test errors, as most trials of sweeps: left out"]
    assert select_runs(runs, trials=True)[1][0].startswith("2 of 5 runs")


@pytest.mark.parametrize(
    ("filters", "kept"),
    [
        ({"experiments": ("graphs",)}, [9]),
        ({"systems": ("SurfLSTM",)}, [1, 5]),
        ({"scenes": ("fire", "chess")}, [1, 5, 9]),
        ({"tags": (("model.units", "200"),)}, [5]),
        ({"tags": (("model.units", "200"), ("model.units", "100"))}, [1, 5]),
        ({"tags": (("features", "surf"), ("scene", "chess"))}, [1, 9]),
        ({"since": "2026-03-05"}, [5, 9]),
        ({"until": "2026-03-05"}, [1, 5]),
        ({"until": "2026-03-05T11:00"}, [1]),
        ({"since": "2026-03-02", "until": "2026-03-08"}, [5]),
    ],
)
def test_filters(runs: list[Run], filters: dict[str, object], kept: list[int]) -> None:
    assert days(runs, **filters) == kept


@pytest.mark.parametrize(
    ("filters", "says"),
    [
        ({"experiments": ("graph",)}, "--experiment graph matches no run; there is graphs, lightning_pose"),
        ({"systems": ("PoseNet",)}, "--system PoseNet matches no run; there is NodePose, SurfCNN, SurfLSTM"),
        ({"scenes": ("heads",)}, "--scene heads matches no run; there is chess, fire"),
        ({"tags": (("model.units", "1"),)}, "--tag model.units=1 matches no run; there is 100, 200"),
        ({"tags": (("model.unit", "1"),)}, "no run has 'model.unit', .* did you mean model.units?"),
        ({"tags": (("units", "1"),)}, "no run has 'units', .* did you mean model.units?"),
        ({"since": "2026-04-01"}, "^--since 2026-04-01 matches no run; the 4 others are from 2026-03-01"),
        (
            {"since": "2025-03-01T10", "until": "2026-02-01"},
            "^--since 2025-03-01T10 --until 2026-02-01 matches no run",
        ),
        ({"systems": ("SurfCNN",)}, "none of the 1 runs has test errors; measure a checkpoint with .* test"),
    ],
)
def test_nothing_passes(runs: list[Run], filters: dict[str, object], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        days(runs, **filters)


def test_nothing_but_trials(runs: list[Run]) -> None:
    trials = [run for run in runs if run.trial]
    with pytest.raises(ConfigError, match="all 1 finished runs are trials of sweeps; give --trials"):
        select_runs(trials)
    with pytest.raises(ConfigError, match=r"none of the 1 runs has test errors \(trials of a sweep never see"):
        select_runs(trials, trials=True)


@pytest.mark.parametrize("text", ["yesterday", "2026-13-01", "01.03.2026"])
def test_no_date(text: str) -> None:
    with pytest.raises(ConfigError, match=f"'{text}' is no date; give one as 2026-03-01"):
        read_date(text)


@pytest.mark.parametrize(("text", "end"), [("9999-12-31", True), ("0001-01-01", False), ("0001-01-01T00:00", True)])
def test_a_date_beyond_the_calendar(text: str, end: bool) -> None:
    with pytest.raises(ConfigError, match=f"'{text}' is out of range; give a date such as 2026-03-01"):
        read_date(text, end)
