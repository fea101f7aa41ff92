"""The command that runs the benchmarks of speed: its registry, its table, and how rounds are measured."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from dataclasses import asdict
from importlib import import_module
from inspect import signature
from pathlib import Path

import pytest

from benchmarks import __main__ as command
from benchmarks.__main__ import BENCHMARKS, main
from benchmarks.measurement import (
    Goal,
    Measurement,
    Options,
    Seconds,
    describe_machine,
    format_table,
    interleave,
    restore_measurement,
    time_process,
)

ROUNDS = [Seconds(1.0, 0.5), Seconds(3.0, 2.5), Seconds(2.0, 1.5)]
PEER = [Seconds(2.0, 2.0), Seconds(2.0, 2.0), Seconds(2.0, 2.0)]


@pytest.mark.parametrize("name", BENCHMARKS)
def test_every_benchmark_measures_by_options_alone(name: str) -> None:
    first, *others = signature(import_module(f"benchmarks.{name}").measure).parameters.values()
    assert first.annotation == "Options"
    assert all(parameter.default is not parameter.empty for parameter in others)


def test_a_row_has_medians_of_rounds() -> None:
    found = Measurement.from_rounds("start", ROUNDS, "bare", PEER, Goal("ratio", 1.05))
    assert found.row == ["start", "2 s (1.5 s CPU)", "bare", "2 s (2 s CPU)", "1.00", "ratio at most 1.05", "yes"]
    speed_up = Measurement.from_rounds("two", ROUNDS, "one", PEER, Goal("ratio", 1.8, at_least=True))
    assert speed_up.ratio == 1.0
    assert speed_up.row[-2:] == ["ratio at least 1.8", "no"]


@pytest.mark.parametrize(("ours", "met"), [(1.5, "yes"), (1.6, "no")])
def test_a_goal_may_be_in_seconds(ours: float, met: str) -> None:
    row = Measurement("check", ours, "", math.nan, math.nan, Goal("ours", 1.5)).row
    assert row == ["check", f"{ours:g} s", "", "", "", "at most 1.5 s", met]


def test_measurements_pass_between_processes() -> None:
    found = Measurement.from_rounds("start", ROUNDS, "bare", PEER, Goal("ratio", 1.05))
    assert restore_measurement(json.loads(json.dumps(asdict(found)))) == found


def test_rounds_alternate_and_the_first_is_not_counted() -> None:
    order: list[str] = []

    def measure(name: str) -> Seconds:
        order.append(name)
        return Seconds(len(order), 0)

    found = interleave({"a": lambda: measure("a"), "b": lambda: measure("b")}, rounds=2)
    assert "".join(order) == "ababab"
    assert [each.wall for each in found["b"]] == [4, 6]


def test_processes_are_timed_and_must_succeed(tmp_path: Path) -> None:
    assert time_process([sys.executable, "-c", "import time; time.sleep(0.2)"], tmp_path).wall > 0.2
    with pytest.raises(subprocess.CalledProcessError):
        time_process([sys.executable, "-c", "raise SystemExit(3)"], tmp_path)


def test_the_command_writes_one_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[tuple[str, Options]] = []

    def run(name: str, options: Options) -> list[Measurement]:
        asked.append((name, options))
        return [Measurement.from_rounds(name, ROUNDS, "bare", PEER, Goal("ratio", 1.05))]

    monkeypatch.setattr(command, "run_benchmark", run)
    assert main(["surf", "query", "--rounds", "2", "--out", str(tmp_path / "table.md")]) == 0
    assert asked == [("surf", Options(rounds=2))]
    written = (tmp_path / "table.md").read_text()
    assert written == capsys.readouterr().out
    assert written.startswith(describe_machine()[:10])
    assert "| surf | 2 s (1.5 s CPU) |" in written
    assert written.endswith("Left out without --root: query.\n")
    assert main(["query", "--root", "kitchen"]) == 0
    assert asked[-1] == ("query", Options(root="kitchen"))


def test_an_unknown_name_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["surff"])
    assert "there is no benchmark surff; choose of startup" in capsys.readouterr().err


def test_the_table_is_markdown() -> None:
    lines = format_table([Measurement("a", 1.0, "b", 2.0, 0.5, Goal("ratio", 0.7))]).splitlines()
    assert len(lines) == 3
    assert {line.count("|") for line in lines} == {8}
