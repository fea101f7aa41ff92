"""Ctrl-C while a run's metrics are being written."""

from __future__ import annotations

import signal
from typing import Any

import pytest
from mlflow import MlflowClient

from tests.helpers import Workplace


def test_ctrl_c_waits_until_the_metrics_are_written(
    workplace: Workplace, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """SQLite would stay locked by a write that is broken off, and the run could not be closed."""
    write, pressed = MlflowClient.log_batch, []

    def press(self: MlflowClient, run_id: str, metrics: Any = (), *args: Any, **kwargs: Any) -> Any:
        if metrics and not pressed:  # parameters come this way too
            pressed.append(True)
            signal.raise_signal(signal.SIGINT)
        return write(self, run_id, metrics, *args, **kwargs)

    monkeypatch.setattr(MlflowClient, "log_batch", press)
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        assert workplace.run("fit", "--trainer.max_epochs", 1000) == 130
    finally:
        signal.signal(signal.SIGINT, handler)
    assert pressed
    (run,) = workplace.runs()
    assert run.info.status == "KILLED"
    assert "val/loss" in run.data.metrics
    assert "interrupted" in capsys.readouterr().err
