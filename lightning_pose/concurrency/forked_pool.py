"""A pool of processes that are forked off this one, for work that Python's threads cannot share out."""

from __future__ import annotations

import gc
import multiprocessing
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ProcessPoolExecutor
from typing import Any, Generic, TypeVar

import torch

from lightning_pose.concurrency.signals import delay_interrupts
from lightning_pose.concurrency.threads import use_inner_threads

__all__ = ["ForkedPool", "can_fork"]

A = TypeVar("A")
R = TypeVar("R")

_work: Callable[[Any], Any]  # of a process of the pool


def can_fork() -> bool:
    """Whether processes can be forked off this one: not where a GPU is in use, and not on other systems than Linux."""
    # A process of a pool may have no children.
    return sys.platform == "linux" and not torch.cuda.is_initialized() and not multiprocessing.current_process().daemon


class ForkedPool(ProcessPoolExecutor, Generic[A, R]):
    """Calls one function, which need not be picklable, in processes of one thread each.

    They start with the first call. Those of a process that is killed end within a second.

    Args:
        work: what is called; its argument and its result are pickled.
        workers: how many processes.
    """

    def __init__(self, work: Callable[[A], R], workers: int) -> None:
        super().__init__(workers, multiprocessing.get_context("fork"), _prepare_worker, (work, os.getpid()))

    def start(self, arguments: Iterable[A]) -> list[Future[R]]:
        """Call the function with each of the arguments.

        Raises:
            OSError: no process can be started, as memory or their number is limited.
        """
        others = multiprocessing.active_children()
        # A process is forked by calls that ignore exceptions, and so Ctrl-C.
        with delay_interrupts(), warnings.catch_warnings(), use_inner_threads(1):
            # Python warns that this process's threads are not in forked ones, where some would be waited for.
            warnings.filterwarnings("ignore", ".*fork.*", DeprecationWarning)
            try:
                return [self.submit(_call_work, argument) for argument in arguments]
            except OSError:
                for started in multiprocessing.active_children():
                    if started not in others:
                        started.terminate()
                raise


def _prepare_worker(work: Callable[[Any], Any], parent: int) -> None:
    """Leave alone what this process has from its parent: open files, and signals."""
    global _work  # passed on here, it is not pickled
    _work = work
    for sent in (signal.SIGINT, signal.SIGHUP):  # a terminal sends them to both
        signal.signal(sent, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    gc.freeze()
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: int) -> None:
    """End this process once its parent has ended: a parent that is killed cannot stop its pool."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)


def _call_work(argument: Any) -> Any:
    return _work(argument)
