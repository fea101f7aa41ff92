"""The search space: conditions, steps of a list_grid, and classes by their name."""

from __future__ import annotations

import json
from typing import Any

import optuna
import pytest

from lightning_pose.errors import ConfigError
from lightning_pose.sweeps.space import check_when, draw_values, list_grid, name_classes, parse_space


@pytest.mark.parametrize("high", [0.3, 0.6, 0.7])
def test_a_grid_of_steps_stays_within_its_ends(high: float) -> None:
    """Three steps of 0.1 are a little more than 0.3 to a computer, and a trial beyond the end is never run again."""
    space = parse_space({"model.dropout": {"type": "float", "low": 0, "high": high, "step": 0.1}})
    labels = sorted(float(point["model.dropout"] or 0) for point in list_grid(space))
    assert labels == [round(i / 10, 1) for i in range(round(high * 10) + 1)]
    assert labels[-1] <= high


def test_a_condition_on_a_step_holds_in_a_grid_as_in_a_draw() -> None:
    space = parse_space(
        {
            "a": {"type": "float", "low": 0, "high": 0.3, "step": 0.1},
            "b": {"choices": [1, 2], "when": {"a": 0.3}},
        }
    )
    assert sorted(map(len, list_grid(space))) == [1, 1, 1, 2, 2]
    study = optuna.create_study()
    study.enqueue_trial({"a": 0.1 + 0.1 + 0.1, "b": 2})
    assert draw_values(study.ask(), space) == {"a": 0.3, "b": 2}


CELLS = {"model.cell": ["gru", "lstm"], "model.channels": [[4, 8], [8, 8]], "base": ["node_pose", "graph_pose"]}


@pytest.mark.parametrize(
    ("when", "said"),
    [
        ({"model.cell": "LSTM"}, r"has when model.cell is 'LSTM'; choose one of gru, lstm"),
        ({"base": "graph_pose.yaml"}, r"has when base is 'graph_pose.yaml'; did you mean graph_pose\?"),
        ({"model.channels": [4, 9]}, "has when model.channels is 4; choose one of"),
    ],
)
def test_a_condition_that_never_holds_is_refused(when: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        check_when(parse_space(CELLS | {"x": {"choices": [1], "when": when}}))


def test_a_condition_on_a_list_is_one_choice() -> None:
    space = parse_space(CELLS | {"x": {"choices": [1], "when": {"model.channels": [4, 8]}}})
    check_when(space)
    with_x = [point for point in list_grid(space) if "x" in point]
    assert len(with_x) == 4
    assert {point["model.channels"] for point in with_x} == {json.dumps([4, 8])}


def test_a_class_is_renamed_to_its_class_path() -> None:
    space = parse_space({"model": ["a.One", "a.Two"], "x": {"choices": [1], "when": {"model": "a.One"}}})
    named, waiting = name_classes(space, {"model.class_path", "x"})
    assert named.key == "model.class_path"
    assert waiting.when == {"model.class_path": ("a.One",)}
