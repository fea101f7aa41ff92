"""Signals that ask a command to end: SIGTERM and SIGHUP count as Ctrl-C does, and wait while a store is written."""

from __future__ import annotations

import os
import signal
import stat
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

__all__ = ["STOPPING", "delay_interrupts", "interrupt_on"]

STOPPING: list[int] = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
"""Signals beside Ctrl-C's that end a command; Windows has no SIGHUP."""

AGAIN_SECONDS = 10.0
"""A signal so soon after the first one does not break off what that one has begun to close."""


@contextmanager
def interrupt_on(signals: list[int]) -> Iterator[list[int]]:
    """Let signals raise KeyboardInterrupt until the end of the block; yields a list that gets their numbers.

    A signal that the process ignores, as under `nohup`, stays ignored; one that has a handler keeps it.
    """
    received: list[int] = []
    raised: list[float] = []

    def handle(number: int, frame: FrameType | None) -> None:
        received.append(number)
        if number == getattr(signal, "SIGHUP", None):
            _leave_terminal()
        if not raised or time.monotonic() - raised[-1] > AGAIN_SECONDS:
            raised.append(time.monotonic())
            raise KeyboardInterrupt

    plain = (signal.SIG_DFL, signal.default_int_handler)
    with _replace_handlers([number for number in signals if signal.getsignal(number) in plain], handle):
        yield received


def _leave_terminal() -> None:
    """Write nothing more to a terminal that was closed: each attempt would be an error, and so break off the end."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for number in (1, 2):
        with suppress(OSError):
            if stat.S_ISCHR(os.fstat(number).st_mode):  # not a file, nor a pipe
                os.dup2(nowhere, number)
    os.close(nowhere)


@contextmanager
def delay_interrupts() -> Iterator[None]:
    """Delay Ctrl-C, SIGTERM and SIGHUP until the end of the block.

    A transaction that KeyboardInterrupt breaks off may keep SQLite locked for this process: the next write, which is
    to close the run, waits 20 s and fails with "database is locked".
    """
    received: list[int] = []
    signals: list[int] = [number for number in (signal.SIGINT, *STOPPING) if callable(signal.getsignal(number))]
    with _replace_handlers(signals, lambda number, frame: received.append(number)):
        yield
    if received:
        signal.raise_signal(received[0])


@contextmanager
def _replace_handlers(signals: list[int], handler: Callable[[int, FrameType | None], object]) -> Iterator[None]:
    """Handle signals by a function until the end of the block; only the main thread receives any."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number in signals}
    try:
        yield
    finally:
        for number, previous in before.items():
            signal.signal(number, signal.SIG_DFL if previous is None else previous)
