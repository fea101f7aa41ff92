"""The epoch bar: lines where there is no terminal, a bar where there is one, silence where it is switched off."""

from __future__ import annotations

import io
from typing import Any

import pytest
import torch
from lightning import LightningModule, Trainer
from rich.console import Console

from lightning_pose.runs import epoch_bar
from lightning_pose.runs.epoch_bar import EpochBar


class Epochs:
    """As much of a Trainer as a bar looks at."""

    def __init__(self, max_epochs: int, current_epoch: int = 0) -> None:
        self.max_epochs, self.current_epoch = max_epochs, current_epoch
        self.callback_metrics = {"train/loss": torch.tensor(0.5), "val/position_median_m": torch.tensor(1.25)}


def run(bar: EpochBar, epochs: int, start: int = 0) -> None:
    trainer: Any = Epochs(epochs, start)
    module: Any = None
    bar.on_train_start(trainer, module)
    for epoch in range(start, epochs):
        trainer.current_epoch = epoch
        bar.on_train_epoch_end(trainer, module)
    bar.on_train_end(trainer, module)


def test_a_line_every_tenth_of_the_run(capsys: pytest.CaptureFixture[str]) -> None:
    run(EpochBar(), 25)
    lines = capsys.readouterr().err.splitlines()
    assert [line.split()[1] for line in lines] == [f"{n}/25" for n in [*range(2, 26, 2), 25]]
    assert lines[0] == "epoch 2/25  loss 0.500  val m 1.250"


def test_short_and_resumed_runs(capsys: pytest.CaptureFixture[str]) -> None:
    run(EpochBar(), 4, start=2)
    assert [line.split()[1] for line in capsys.readouterr().err.splitlines()] == ["3/4", "4/4"]


def test_a_bar_on_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = io.StringIO()
    monkeypatch.setattr(epoch_bar, "Console", lambda stderr: Console(file=screen, force_terminal=True, width=100))
    run(EpochBar(), 3)
    assert "3/3" in screen.getvalue()
    assert "val m 1.250" in screen.getvalue()


def test_an_error_closes_the_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(epoch_bar, "Console", lambda stderr: Console(file=io.StringIO(), force_terminal=True))
    bar, trainer = EpochBar(), Epochs(3)
    bar.on_train_start(trainer, None)  # type: ignore[arg-type]
    bar.on_exception(trainer, None, RuntimeError())  # type: ignore[arg-type]
    assert bar._bar is None


def test_switched_off(capsys: pytest.CaptureFixture[str]) -> None:
    bar = EpochBar()
    bar.disable()
    run(bar, 3)
    assert capsys.readouterr().err == ""
    bar.enable()
    run(bar, 1)
    assert "1/1" in capsys.readouterr().err


def test_what_a_module_prints_passes_by_the_bar(capsys: pytest.CaptureFixture[str]) -> None:
    module = LightningModule()
    module.trainer = Trainer(callbacks=[EpochBar()], logger=False, enable_checkpointing=False)
    module.print("a map of 5000 points")
    assert capsys.readouterr().out == "a map of 5000 points\n"
