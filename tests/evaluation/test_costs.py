"""Measured times: the first call of a model, which allocates and compiles, is not among them."""

from __future__ import annotations

import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lightning import Trainer
from torch import Tensor

from lightning_pose.evaluation.costs import costs
from lightning_pose.models import KernelPoseNet, Pose, PoseModule
from tests.models.helpers import LearnableProblem


class SlowAtFirst(PoseModule):
    """A model whose first call takes 1 s of the test's clock, and every other 2 ms."""

    input_ranks = (1,)

    def __init__(self, clock: Any) -> None:
        super().__init__(input_shape=[4])
        self.network = torch.nn.Linear(4, 7)
        self.clock = clock
        self.calls = 0

    def forward(self, features: Tensor) -> Pose:
        self.clock.seconds += 0.002 if self.calls else 1.0
        self.calls += 1
        return super().forward(features)


def test_the_first_call_is_not_measured(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    clock = SimpleNamespace(seconds=0.0)
    problem = LearnableProblem([4], count=2)  # of two frames the median is the mean, which a slow one would raise
    trainer = Trainer(accelerator="cpu", logger=False, enable_checkpointing=False, default_root_dir=tmp_path)
    trainer.datamodule = problem  # type: ignore[attr-defined]
    model = SlowAtFirst(clock)
    monkeypatch.setattr(time, "perf_counter", lambda: clock.seconds)
    waits: list[float] = []
    monkeypatch.setattr(torch.accelerator, "is_available", lambda: True)
    monkeypatch.setattr(torch.accelerator, "synchronize", lambda: waits.append(clock.seconds))
    found = costs(trainer, model, features=False)
    assert found["cost/ms_per_frame"] == pytest.approx(2.0)
    assert model.calls == 3
    assert waits == pytest.approx([1.0, 1.002, 1.002, 1.004]), "a GPU's work is waited for on both sides"


def test_trained_and_carried_numbers(tmp_path: Path) -> None:
    problem = LearnableProblem([4], count=6)
    trainer = Trainer(accelerator="cpu", logger=False, enable_checkpointing=False, default_root_dir=tmp_path)
    trainer.datamodule = problem  # type: ignore[attr-defined]
    model = KernelPoseNet(input_shape=[4])
    model.network.set_landmarks(problem.dataset("train").data.features, gamma=0.2)
    found = costs(trainer, model, features=False)
    assert found["cost/parameters"] == 6 * 7
    # landmarks, scale and bias; scales of poses and features, the hemisphere of quaternions, the world's frame, and of
    # radii the mean of the features, the median and the largest distance, and two factors
    assert found["cost/carried_numbers"] == 6 * 7 + 6 * 4 + 1 + 7 + 7 + 7 + 4 + 4 + 4 + 4 + (4 + 2 + 2)
