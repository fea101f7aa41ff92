"""The clock of training, and the trainer's own limits of time, which it leaves alone."""

from __future__ import annotations

import time
from types import SimpleNamespace

import pytest
import torch
from lightning import LightningModule, Trainer

from lightning_pose.runs.clock import TrainingClock, wait_for_device
from tests.helpers import Workplace


@pytest.fixture
def clock_time(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    now = SimpleNamespace(seconds=0.0)
    monkeypatch.setattr(time, "monotonic", lambda: now.seconds)
    return now


def test_parts_of_a_run_add_up(clock_time: SimpleNamespace) -> None:
    trainer, module = Trainer(accelerator="cpu", logger=False), LightningModule()
    first, second = TrainingClock(), TrainingClock()
    first.on_train_start(trainer, module)
    clock_time.seconds = 3.0
    second.load_state_dict(first.state_dict())  # of a checkpoint in the middle
    second.on_train_start(trainer, module)
    clock_time.seconds = 5.0
    second.on_train_end(trainer, module)
    clock_time.seconds = 50.0
    assert second.seconds == 5.0


def test_seconds_of_an_older_checkpoint() -> None:
    clock = TrainingClock()
    older = {"callbacks": {"Timer": {"time_elapsed": {"train": 7.0}}}}
    clock.on_load_checkpoint(Trainer(accelerator="cpu", logger=False), LightningModule(), older)
    assert clock.seconds == 7.0


def test_an_accelerator_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    waited: list[bool] = []
    monkeypatch.setattr(torch.accelerator, "is_available", lambda: True)
    monkeypatch.setattr(torch.accelerator, "synchronize", lambda: waited.append(True))
    wait_for_device()
    assert waited == [True]


def test_max_time_ends_training(workplace: Workplace) -> None:
    endless = ["--trainer.max_epochs", "1000000", "--trainer.max_time", "00:00:00:01"]
    started = time.monotonic()
    assert workplace.run("fit", *endless) == 0
    assert time.monotonic() - started < 100
    (run,) = workplace.runs()
    assert run.info.status == "FINISHED"
    assert "test/position_median_m" in run.data.metrics


def test_the_profiler_reports(workplace: Workplace) -> None:
    process = workplace.fork("fit", "--config", workplace.config, "--trainer.profiler", "simple")
    _, stderr = process.communicate(timeout=200)
    assert process.returncode == 0, stderr
    assert "Profiler Report" in stderr
