"""How many threads torch uses for work that is too small to be shared out."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

__all__ = ["use_one_thread"]


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
