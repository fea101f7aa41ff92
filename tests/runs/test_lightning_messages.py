"""Lightning's own words: refusals are one line, notices about settings are shown, an error keeps its traceback."""

from __future__ import annotations

import logging
from collections.abc import Callable

import pytest
import torch
from lightning import Trainer

from lightning_pose.runs.lightning_messages import describe_refusal, filter_messages
from tests.helpers import Workplace


def catch(function: Callable[[], object]) -> Exception:
    try:
        function()
    except Exception as error:
        return error
    raise AssertionError("no error")


def test_a_refusal_is_one_line() -> None:
    refusal = describe_refusal(catch(lambda: Trainer(limit_train_batches=2.5)))
    assert refusal is not None
    assert "limit_train_batches" in refusal
    assert "\n" not in refusal


@pytest.mark.parametrize(
    "mistake",
    [lambda: torch.zeros(2) + torch.zeros(3), lambda: int("x"), lambda: {}["x"], lambda: getattr(Trainer(), "unknown")],  # noqa: B009
)
def test_an_error_of_other_code_is_no_refusal(mistake: Callable[[], object]) -> None:
    assert describe_refusal(catch(mistake)) is None


def test_a_metric_that_does_not_exist(workplace: Workplace, capsys: pytest.CaptureFixture[str]) -> None:
    stopping = ["--trainer.callbacks+", "lightning.pytorch.callbacks.EarlyStopping"]
    assert workplace.run("fit", *stopping, "--trainer.callbacks.monitor", "val/nothing") == 2
    assert "`val/nothing` which is not available" in capsys.readouterr().err.splitlines()[-1]
    assert workplace.runs()[0].info.status == "FAILED"


@pytest.mark.parametrize("verb", ["fit", "extract"])
def test_every_command_says_what_lightning_refuses(
    verb: str, workplace: Workplace, capsys: pytest.CaptureFixture[str]
) -> None:
    assert workplace.run(verb, "--trainer.devices", "0") == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith("error: `Trainer(devices='0')`")
    assert line.endswith(f"`python -m lightning_pose {verb} --help` explains every setting")


@pytest.mark.parametrize(
    ("message", "shown"),
    [
        ("GPU available: False, used: False", False),
        ("`Trainer.fit` stopped: `max_epochs=2` reached.", False),
        ("Ignoring `Trainer(max_time=...)`, callbacks list already contains a Timer.", True),
        ("FIT Profiler Report", True),
        ("Time limit reached. Elapsed time is 0:00:02. Signaling Trainer to stop.", True),
    ],
)
def test_notices_about_settings_are_shown(message: str, shown: bool) -> None:
    filter_messages()
    (handler,) = {h for name in ("lightning", "lightning.pytorch") for h in logging.getLogger(name).handlers}
    record = logging.LogRecord("lightning.pytorch.trainer", logging.INFO, "", 0, message, (), None)
    assert bool(handler.filter(record)) == shown
