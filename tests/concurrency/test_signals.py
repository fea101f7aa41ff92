"""Signals that ask a command to end: exit codes, a second one, an ignored one, and one while a store is written."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from types import SimpleNamespace

import pytest

from lightning_pose import __main__
from lightning_pose.__main__ import main
from lightning_pose.concurrency.signals import STOPPING, delay_interrupts, interrupt_on
from tests.helpers import FailAt, Workplace


class HangUpAt(FailAt):
    """Receives SIGHUP in the middle of an epoch, as when a terminal is closed."""

    def stop(self) -> None:
        signal.raise_signal(signal.SIGHUP)


@pytest.fixture(autouse=True)
def _plain_handlers() -> Iterator[None]:
    """As a shell starts a command; whoever runs the tests in the background has them ignore some."""
    before = {number: signal.signal(number, signal.SIG_DFL) for number in STOPPING}
    before[signal.SIGINT] = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_each_signal_has_its_exit_code(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    number = getattr(signal, name)
    before = signal.getsignal(number)

    def stopped(argv: list[str]) -> int:
        try:
            signal.raise_signal(number)
        finally:
            if number != signal.SIGINT:
                signal.raise_signal(number)  # a second one does not break off what the first has begun
        return 0

    monkeypatch.setattr(__main__, "import_module", lambda name: SimpleNamespace(main=stopped))
    assert main(["check", "DIR"]) == 128 + number
    assert capsys.readouterr().err == "interrupted\n"
    assert signal.getsignal(number) == before


def test_an_ignored_signal_stays_ignored() -> None:
    """As under `nohup`."""
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with interrupt_on(STOPPING) as received:
        signal.raise_signal(signal.SIGHUP)
    assert received == []


def test_signals_wait_for_the_end_of_a_write() -> None:
    written = []

    def write() -> None:
        with delay_interrupts():
            signal.raise_signal(signal.SIGTERM)
            written.append(True)

    with interrupt_on(STOPPING) as received, pytest.raises(KeyboardInterrupt):
        write()
    assert (written, received) == ([True], [signal.SIGTERM])


def test_a_closed_terminal_closes_the_run(workplace: Workplace, capsys: pytest.CaptureFixture[str]) -> None:
    stopper = ["--trainer.callbacks+", "tests.concurrency.test_signals.HangUpAt", "--trainer.callbacks.epoch", "1"]
    assert workplace.run("fit", "--trainer.max_epochs", "1000", *stopper) == 128 + signal.SIGHUP
    (run,) = workplace.runs()
    assert run.info.status == "KILLED"
    assert workplace.checkpoint(run, "last").is_file()
    assert "`fit --ckpt_path last`, with the same settings, goes on" in capsys.readouterr().err
