"""Work that several threads share, with the same result for any number of them; torch only where it is there."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numpy as np

__all__ = ["map_in_threads", "multiply"]

Item = TypeVar("Item")
Result = TypeVar("Result")


def map_in_threads(work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """`work` of each item, in the order of the items; as many at once as torch has threads.

    Each item is worked on by one thread: torch's own threads, which share out single products and sums, gain nothing on
    the small arrays of a map, and more of them than cores take several times as long.
    """
    import torch  # a second; whoever only asks a map does without

    from lightning_pose.concurrency.threads import use_one_thread

    items = list(items)
    with use_one_thread() as threads:
        if min(threads, len(items)) < 2:
            return [work(item) for item in items]
        with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
            return list(pool.map(work, items))


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The product of matrices by as many threads as torch has here; numpy's own would be as many in each thread.

    Where nothing has imported torch, as when an exported folder is asked, it is numpy's.
    """
    if "torch" not in sys.modules:
        return a @ b
    import torch

    return (torch.from_numpy(a) @ torch.from_numpy(b)).numpy()
