"""Damaged configs, sweep files and checkpoints: they are used, or refused in one line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from hypothesis import given
from hypothesis import strategies as st

from lightning_pose.cli import PoseCLI
from lightning_pose.errors import PoseError
from lightning_pose.localization.localizer import Localizer
from lightning_pose.studies.figure_spec import parse_figure_spec
from lightning_pose.sweeps.plan import read_plan
from tests.fuzz.datasets import Damage, apply_damages, damages
from tests.fuzz.nested import Change, apply_changes, changes
from tests.helpers import Workplace

CHECKPOINT = Path(__file__).parents[1] / "checkpoint" / "files" / "surf_lstm_0_1.ckpt"

SWEEP = {
    "objective": ["val/position_median_m", "cost/parameters"],
    "sampler": {"name": "tpe", "n_startup_trials": 5},
    "pruner": "median",
    "n_trials": 3,
    "settings": {"trainer.max_epochs": 1},
    "space": {
        "model.units": {"type": "int", "low": 8, "high": 16, "step": 8},
        "model.learning_rate": {"type": "float", "low": 1e-4, "high": 1e-2, "log": True},
        "model.schedule": ["constant", "cosine"],
        "model.weight_decay": {"type": "float", "low": 0.0, "high": 0.1, "when": {"model.schedule": "cosine"}},
    },
}
FIGURE = {
    "x": "model.units",
    "y": ["test/position_median_m"],
    "kind": "line",
    "log": ["x"],
    "beside": ["retrieval_top1"],
    "table": ["test/position_median_m"],
}


def find_error(step: Callable[[], object]) -> str | None:
    """The one line by which a step refuses its input; None if it does not."""
    try:
        step()
    except PoseError as error:
        message = str(error)
        assert message
        assert "\n" not in message
        assert len(message) < 4000
        return message
    return None


def damage_text(settings: dict[str, Any], chosen: list[Change], text: list[Damage]) -> bytes:
    """Settings as YAML, with changed values, and then with changed text."""
    written = yaml.safe_dump(apply_changes(settings, chosen), allow_unicode=True).encode()
    return apply_damages({"a.yaml": written}, text).get("a.yaml", b"")


@pytest.fixture
def place(workplace: Workplace, monkeypatch: pytest.MonkeyPatch) -> Workplace:
    """A workplace that is the current folder."""
    monkeypatch.chdir(workplace.folder)
    for name, value in workplace.environment.items():
        monkeypatch.setenv(name, value)
    return workplace


@given(chosen=changes, text=st.lists(damages, max_size=1))
def test_damaged_config(chosen: list[Change], text: list[list[Damage]], place: Workplace) -> None:
    settings = yaml.safe_load(place.config.read_text())
    settings["trainer"]["logger"] = False
    file = place.folder / "a.yaml"
    file.write_bytes(damage_text(settings, chosen, text[0] if text else []))
    find_error(lambda: PoseCLI(["--config", str(file)], run=False))


@given(chosen=changes, text=st.lists(damages, max_size=1))
def test_damaged_sweep_file(chosen: list[Change], text: list[list[Damage]], place: Workplace) -> None:
    file = place.folder / "sweep.yaml"
    settings = {"base": str(place.config), **SWEEP, "figure": FIGURE}
    file.write_bytes(damage_text(settings, chosen, text[0] if text else []))

    def read() -> None:
        plan = read_plan(file, {})
        parse_figure_spec(plan.figure, plan.measure, plan.space)

    find_error(read)


@given(chosen=changes, weights=st.booleans())
def test_damaged_checkpoint(chosen: list[Change], weights: bool, tmp_path: Path) -> None:
    """Its specs, or names, shapes and types of its weights; the pose is of finite numbers, or there is none."""
    checkpoint = torch.load(CHECKPOINT, weights_only=True)
    file = tmp_path / "a.ckpt"
    if weights:
        checkpoint["state_dict"] = apply_changes(checkpoint["state_dict"], chosen)
    else:
        checkpoint["lightning_pose"] = apply_changes(checkpoint["lightning_pose"], chosen)
    torch.save(checkpoint, file)

    def locate() -> None:
        pose = Localizer.load(file).localize(np.random.default_rng(0).integers(0, 255, (48, 64), np.uint8))
        assert pose.status == "refused" or (np.isfinite(pose.position_m).all() and np.isfinite(pose.quat_wxyz).all())

    find_error(locate)
