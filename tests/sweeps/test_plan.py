"""The plan of a sweep: what the command line narrows, which objectives are allowed, and the content of best.yaml."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from lightning_pose.commands.sweep import parse_value
from lightning_pose.errors import ConfigError
from lightning_pose.studies.figure_spec import parse_figure_spec
from lightning_pose.sweeps.base_config import ParsedConfig
from lightning_pose.sweeps.plan import read_plan
from tests.helpers import Workplace

Write = Callable[..., Path]


@pytest.fixture
def sweep(workplace: Workplace) -> Write:
    """Write a sweep of the workplace's configs: `tiny`, and `split`, whose loss means something else."""
    split = yaml.safe_load(workplace.config.read_text())
    split["model"]["init_args"]["loss"] = {"form": "split", "orientation_weight": 10.0}
    (workplace.folder / "split.yaml").write_text(yaml.safe_dump(split))

    def write(**entries: Any) -> Path:
        file = workplace.folder / "sweep.yaml"
        file.write_text(yaml.safe_dump({"base": "tiny.yaml", "space": {"model.units": [4, 8]}} | entries))
        return file

    return write


def test_losses_that_differ_are_no_objective(sweep: Write) -> None:
    both = ["tiny.yaml", "split.yaml"]
    assert read_plan(sweep(), {}).objectives[0].metric == "val/loss"
    assert read_plan(sweep(base=both), {}).objectives[0].metric == "val/position_median_m"
    with pytest.raises(ConfigError, match="objective val/loss means something else for each base; take val/pos"):
        read_plan(sweep(base=both, objective="val/loss"), {})


@pytest.mark.parametrize(
    ("space", "comparable"),
    [
        ({"model.units": [4]}, True),
        ({"data.root": ["a", "b"]}, False),
        ({"data.val_scenes": [["a"], ["b"]]}, False),
        ({"data.ground_truth": ["original", "registered"]}, False),
    ],
)
def test_scenes_are_not_equally_hard(space: dict[str, Any], comparable: bool, sweep: Write) -> None:
    assert read_plan(sweep(space=space), {}).comparable == comparable


def test_a_narrowed_parameter_keeps_its_condition(sweep: Write) -> None:
    both = {"base": ["tiny.yaml", "split.yaml"]}
    file = sweep(**both, space={"model.units": {"choices": [4, 8, 16], "when": {"base": "tiny"}}})
    for overrides in ({"space.model.units": [8]}, {"model.units": 8}):
        plan = read_plan(file, overrides)
        (units,) = (parameter for parameter in plan.space if parameter.key == "model.units")
        assert (units.example(), units.when) == ([8], {"base": ("tiny",)})
        assert "model.units" not in plan.settings


def test_a_value_that_a_condition_names_may_be_narrowed_away(sweep: Write) -> None:
    space = {"model.cell": ["gru", "lstm"], "model.layers": {"choices": [1, 2], "when": {"model.cell": "lstm"}}}
    plan = read_plan(sweep(space=space), {"space.model.cell": ["gru"]})
    assert plan.space[0].example() == ["gru"]


def test_a_class_that_is_searched_is_written_with_its_settings(sweep: Write, workplace: Workplace) -> None:
    """As the trial had it: the command line keeps what the next class takes too."""
    thumbnails = {"data.extractor.rows": 5}
    extractors = ["tests.helpers.Thumbnails", "tests.studies.test_studies.Flat"]
    plan = read_plan(sweep(settings=thumbnails, space={"data.extractor": extractors}), {})
    values = {plan.space[0].key: extractors[1]}
    config = plan.config(values)["data"]["init_args"]["extractor"]
    assert config == {"class_path": extractors[1], "init_args": {"rows": 5}}
    trial = ParsedConfig(plan.arguments(values)).config.data.init_args.extractor
    assert (trial.class_path, trial.init_args.rows) == (extractors[1], 5)


@pytest.mark.parametrize(
    ("text", "value"),
    [("2024-05-01", "2024-05-01"), ("00", "00"), ("0x10", "0x10"), ("7", 7), ("[1, 2]", [1, 2]), ("null", None)],
)
def test_folders_that_look_like_dates_and_numbers(text: str, value: Any) -> None:
    assert parse_value(text) == value


def test_a_folder_of_digits_stays_a_folder(sweep: Write) -> None:
    plan = read_plan(sweep(), {"data.root": 2024})
    assert plan.config({"model.units": 4})["data"]["init_args"]["root"] == "2024"


def check_file(file: Path) -> None:
    """Check a sweep file as the verb does before anything is trained."""
    plan = read_plan(file, {})
    parse_figure_spec(plan.figure, plan.measure, plan.space)


@pytest.mark.parametrize(
    ("entries", "said"),
    [
        ({"settings": ["trainer.max_epochs"]}, r"settings are \['trainer.max_epochs'\]; give them by name"),
        ({"measure": ["test"]}, r"measure is \['test'\]; give test or features"),
        ({"settings": {"trainer.logger": True}}, "tiny.yaml has another trainer.logger"),
        ({"figure": {"x": "model.units", "labels": ["units"]}}, r"figure.labels are \['units'\]; give them by name"),
        ({"space": {"model.units": {"choices": [4], "when": {"model.cell": "gru"}}}}, "model.cell, which is not sea"),
    ],
)
def test_a_malformed_entry_is_named(entries: dict[str, Any], said: str, sweep: Write) -> None:
    with pytest.raises(ConfigError, match=said):
        check_file(sweep(**entries))
