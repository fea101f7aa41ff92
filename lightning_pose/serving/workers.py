"""WorkerPool: threads that locate images, and a bounded number of requests that wait for them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

from lightning_pose.serving.errors import RequestError, busy
from lightning_pose.serving.limits import Limits

__all__ = ["WorkerPool"]

T = TypeVar("T")


class WorkerPool:
    """Runs functions on `limits.threads` threads; used from one event loop.

    A thread cannot be stopped: one whose request ran out of time works on, and counts as a request until it is done.

    Args:
        limits: threads, waiting requests and time.
    """

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self._executor = ThreadPoolExecutor(limits.threads, thread_name_prefix="locate")
        self._requests = 0
        self._abandoned = 0

    @property
    def busy(self) -> int:
        """Requests that have been admitted and not answered, and threads that work on after theirs ran out of time."""
        return self._requests + self._abandoned

    @contextmanager
    def admit(self) -> Iterator[None]:
        """Count a request while it is handled; before its body is read, so that bodies in memory are bounded.

        Raises:
            RequestError: too many are being handled.
        """
        if self.busy >= self.limits.threads + self.limits.waiting:
            raise busy(f"{self.busy} requests are being handled; try again")
        self._requests += 1
        try:
            yield
        finally:
            self._requests -= 1

    async def run(self, function: Callable[[], T]) -> T:
        """Call a function on one of the threads.

        Raises:
            RequestError: no thread was free within the time, or the function takes longer.
            Exception: what the function raises.
        """
        job = self._executor.submit(function)
        waited = asyncio.wrap_future(job)
        done, _ = await asyncio.wait({waited}, timeout=self.limits.timeout_s)
        if done:
            return waited.result()
        if job.cancel():
            raise busy(f"no thread was free for {self.limits.timeout_s:g} s; try again")
        self._abandoned += 1
        waited.add_done_callback(self._forget)
        raise RequestError(504, "timeout", f"the image was not located within {self.limits.timeout_s:g} s")

    def _forget(self, job: asyncio.Future[T]) -> None:
        """A thread has ended whose request ran out of time."""
        self._abandoned -= 1
        if not job.cancelled():
            job.exception()  # seen, so that asyncio does not print it

    def close(self) -> None:
        """Wait for the threads."""
        self._executor.shutdown(cancel_futures=True)
