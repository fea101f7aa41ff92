"""Configs in the thesis's form: they are complete, have its sizes, and the other configs say in what they depart."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from lightning_pose import models
from lightning_pose.losses import LossConfig
from lightning_pose.sweeps.base_config import ParsedConfig, list_settings
from lightning_pose.sweeps.plan import read_plan
from tests.helpers import REPOSITORY

THESIS = sorted((REPOSITORY / "configs" / "thesis").glob("*.yaml"))
SYSTEMS = ["cnn_3d", "cnn_rnn", "dense_posenet", "graph_pose", "linear_posenet", "node_pose", "surf_cnn", "surf_lstm"]
every_thesis_config = pytest.mark.parametrize("config", THESIS, ids=lambda path: path.stem)


def read_model(config: Path) -> tuple[type[models.PoseModule], dict[str, Any]]:
    """The class and the settings of a config's model."""
    model = yaml.safe_load(config.read_text())["model"]
    return getattr(models, model["class_path"].rpartition(".")[2]), model["init_args"]


def build_network(name: str, shape: list[int], **changes: Any) -> torch.nn.Module:
    """The network of a thesis config for features of a shape."""
    kind, settings = read_model(REPOSITORY / "configs" / "thesis" / f"{name}.yaml")
    with torch.device("meta"):
        return kind(input_shape=shape, **{**settings, **changes}).network


def list_values(config: Path) -> dict[str, Any]:
    """Every setting of the model, the data and the trainer by its dotted name, defaults included."""
    whole = ParsedConfig(["--config", str(config)]).config.as_dict()
    settings = list_settings({group: whole[group] for group in ("model", "data", "trainer")})
    return {key: value for key, value in settings.items() if not isinstance(value, dict)}


def test_each_system_of_the_thesis_has_a_config() -> None:
    assert [config.stem for config in THESIS] == SYSTEMS


@every_thesis_config
def test_it_writes_out_every_setting_of_its_model(config: Path) -> None:
    kind, settings = read_model(config)
    known = {
        name
        for parent in kind.__mro__
        if issubclass(parent, models.PoseModule)
        for name in inspect.signature(parent.__init__).parameters
    }
    assert settings.keys() == known - {"self", "kwargs", "input_shape"}
    assert settings["loss"].keys() == LossConfig.__dataclass_fields__.keys()
    assert not settings["weight_decay"]
    assert not settings["standardize"] | settings["standardize_features"]


@pytest.mark.parametrize(
    ("name", "shape", "changes", "count", "tolerance"),
    [
        ("surf_lstm", [50, 64], {}, 3.73e5, 0.1),
        ("surf_cnn", [300, 64], {}, 1.31e7, 0.1),
        ("surf_cnn", [100, 64], {}, 6.61e6, 0.1),
        ("surf_cnn", [1, 64], {}, 3.47e6, 0.1),
        ("linear_posenet", [2048], {}, 14336, 0),
        ("linear_posenet", [2048], {"components": 280}, 1960, 0),
        ("dense_posenet", [2048], {}, 566_151, 0),
        ("dense_posenet", [2048], {"components": 280}, 1.13e5, 0.01),
    ],
)
def test_it_has_the_parameters_that_the_thesis_counts(
    name: str, shape: list[int], changes: dict[str, Any], count: float, tolerance: float
) -> None:
    network = build_network(name, shape, **changes)
    assert sum(parameter.numel() for parameter in network.parameters()) == pytest.approx(count, rel=tolerance)


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_other_config_says_at_its_head_in_what_it_departs(name: str) -> None:
    ours = REPOSITORY / "configs" / f"{name}.yaml"
    head = ours.read_text().partition("seed_everything")[0]
    thesis, departing = list_values(REPOSITORY / "configs" / "thesis" / f"{name}.yaml"), list_values(ours)
    different = {key.rpartition(".")[2] for key in thesis | departing if thesis.get(key) != departing.get(key)}
    named = {word.strip("# ,:") for line in head.splitlines() if line.startswith("#   ") for word in line.split(" ")}
    assert different <= named
    assert f"configs/thesis/{name}.yaml" in head


STUDIES = sorted((REPOSITORY / "sweeps" / "thesis").glob("*.yaml"))


@pytest.mark.parametrize("study", STUDIES, ids=lambda path: path.stem)
def test_a_study_starts_from_the_form_of_the_thesis(study: Path) -> None:
    content = yaml.safe_load(study.read_text())
    bases = [content["base"]] if isinstance(content["base"], str) else content["base"]
    others = {base for base in bases if not (study.parent / base).resolve().is_relative_to(THESIS[0].parent)}
    assert others <= {"../../configs/posenet.yaml"}, "the only peer that is not the thesis's"
    assert not any(key.startswith("model.") for key in content.get("settings", {})), "the network is the thesis's"


def test_another_backbone_is_that_of_the_systems_that_have_one() -> None:
    plan = read_plan(REPOSITORY / "sweeps" / "thesis" / "table_5_1.yaml", {"data.extractor.backbone": "vgg16"})
    (backbone,) = (parameter for parameter in plan.space if parameter.key == "data.extractor.backbone")
    assert backbone.example() == ["vgg16"]
    assert {base for base in plan.bases if backbone.active({"base": base})} == {"linear_posenet", "dense_posenet"}


def test_node_pose_is_searched_up_to_the_neighbours_of_the_thesis() -> None:
    space = yaml.safe_load((REPOSITORY / "sweeps" / "node_pose.yaml").read_text())["space"]
    assert space["model.neighbours"]["high"] == 40


@pytest.mark.parametrize("name", ["cnn_3d", "cnn_rnn"])
def test_clips_fit_in_the_sequences_of_the_synthetic_room(name: str) -> None:
    data = yaml.safe_load((REPOSITORY / "configs" / "thesis" / f"{name}.yaml").read_text())["data"]["init_args"]
    assert data["clip_length"] <= 30, "frames of a sequence"
    assert data["train_rooms"] != data["test_rooms"], "tested in a room never seen"
