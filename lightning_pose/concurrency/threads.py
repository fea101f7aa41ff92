"""How many threads torch and OpenCV use inside threads of ours, or for work that is too small to be shared out."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import cv2
import torch

__all__ = ["use_inner_threads", "use_one_thread"]


@contextmanager
def use_one_thread() -> Iterator[int]:
    """Let torch compute with the calling thread alone; gives how many threads it had, and has again afterwards.

    Products and sums of a few thousand numbers are done before a second thread has woken up. On a machine whose cores
    are taken, each of them waits until that thread gets its turn.
    """
    threads = torch.get_num_threads()
    if threads > 1:
        torch.set_num_threads(1)
    try:
        yield threads
    finally:
        if threads > 1:
            torch.set_num_threads(threads)


@contextmanager
def use_inner_threads(count: int) -> Iterator[None]:
    """Set the number of threads that torch and OpenCV start inside each thread of ours, and restore it afterwards."""
    before = torch.get_num_threads(), cv2.getNumThreads()
    torch.set_num_threads(count)
    cv2.setNumThreads(count)  # which ends those that wait
    try:
        yield
    finally:
        torch.set_num_threads(before[0])
        cv2.setNumThreads(before[1])
