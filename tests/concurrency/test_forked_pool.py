"""Work in forked processes: results, errors, and processes that are killed."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import BrokenExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from lightning_pose.concurrency.forked_pool import ForkedPool, can_fork
from lightning_pose.concurrency.threads import use_inner_threads
from lightning_pose.errors import ImageError

pytestmark = pytest.mark.skipif(not can_fork(), reason="processes cannot be forked here")


def test_it_works_in_other_processes_with_one_thread_each() -> None:
    with ForkedPool(lambda number: (number, os.getpid(), torch.get_num_threads()), 2) as pool:
        found = [started.result() for started in pool.start(range(7))]
    assert [number for number, _, _ in found] == list(range(7))
    assert os.getpid() not in {pid for _, pid, _ in found}
    assert {threads for _, _, threads in found} == {1}
    assert not multiprocessing.active_children()


def test_threads_of_the_parent_are_not_waited_for() -> None:
    """A forked process has none of them; work that torch shares out would wait for them without end."""
    matrix, image = torch.ones(600, 600), np.ones((600, 600), np.uint8)

    def work(number: int) -> float:
        resized = cv2.GaussianBlur(cv2.resize(image, (1000, 1000)), (31, 31), number + 1)
        return float((matrix @ matrix).sum()) + float(resized.sum())

    with use_inner_threads(2):
        expected = [work(number) for number in range(3)]  # starts the threads
        with ForkedPool(work, 2) as pool:
            assert [started.result(timeout=60) for started in pool.start(range(3))] == expected
            assert (torch.get_num_threads(), cv2.getNumThreads()) == (2, 2)


def test_an_error_is_raised_as_it_is() -> None:
    def fail(number: int) -> int:
        if number == 2:
            raise ImageError("third.png is empty")
        return number

    with ForkedPool(fail, 2) as pool:
        started = pool.start(range(5))
        with pytest.raises(ImageError, match=r"^third.png is empty$"):
            started[2].result()
        assert started[4].result() == 4


@pytest.mark.parametrize("sent", [signal.SIGKILL, signal.SIGTERM])
def test_a_killed_process_breaks_the_pool(sent: signal.Signals) -> None:
    with ForkedPool(lambda number: os.kill(os.getpid(), sent), 2) as pool, pytest.raises(BrokenExecutor):
        pool.start([0])[0].result(timeout=30)
    assert not multiprocessing.active_children()


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGHUP])
def test_what_a_terminal_sends_is_left_to_the_parent(sent: signal.Signals) -> None:
    with ForkedPool(lambda number: os.kill(os.getpid(), sent), 1) as pool:
        assert pool.start([0])[0].result(timeout=30) is None


def test_processes_of_a_killed_one_end() -> None:
    code = (
        "import os, time; from lightning_pose.concurrency.forked_pool import ForkedPool\n"
        "pool = ForkedPool(lambda seconds: time.sleep(seconds) or os.getpid(), 1)\n"
        "print(pool.start([0])[0].result(), flush=True); pool.start([60])[0].result()"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        parent.kill()
    deadline = time.monotonic() + 30
    while _runs(child):
        assert time.monotonic() < deadline, "it is still there"
        time.sleep(0.05)


def _runs(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except OSError:
        return False
    return state != "Z"  # nobody may have waited for it
