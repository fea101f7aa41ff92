"""TrainingMemory: tensors as long as the training split take over a checkpoint's length."""

from __future__ import annotations

import copy
from typing import ClassVar

import pytest
import torch
from torch import nn

from lightning_pose.models.parts.memory import TrainingMemory


class Remembers(TrainingMemory):
    memory: ClassVar[tuple[str, ...]] = ("kept", "layer.weight")

    def __init__(self, rows: int = 0) -> None:
        super().__init__()
        self.register_buffer("kept", torch.ones(rows, 2))
        self.layer = nn.Linear(3, rows, bias=False)


def test_the_length_is_the_checkpoint_s() -> None:
    trained, fresh = Remembers(5), Remembers()
    fresh.load_state_dict(trained.state_dict())
    assert fresh.get_buffer("kept").equal(trained.get_buffer("kept"))
    assert fresh.layer.weight.equal(trained.layer.weight)


def test_also_within_another_module_and_in_a_copy() -> None:
    trained, fresh = nn.Sequential(Remembers(5)), copy.deepcopy(nn.Sequential(Remembers(2)))
    fresh.load_state_dict(trained.state_dict())
    assert fresh.get_buffer("0.kept").shape == (5, 2)


def test_other_differences_are_refused() -> None:
    with pytest.raises(RuntimeError, match="size mismatch for kept"):
        Remembers().load_state_dict({"kept": torch.zeros(5, 4), "layer.weight": torch.zeros(5, 3)})
