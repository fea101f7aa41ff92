"""A Dask cluster on loopback for tests: its scheduler in this process, and two workers forked off the tests' server."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.processes import ForkedProcess

__all__ = ["Cluster", "start_cluster"]


@dataclass(frozen=True)
class Cluster:
    """A running cluster.

    Attributes:
        address: of its scheduler.
        workers: processes.
    """

    address: str
    workers: list[ForkedProcess]


@contextmanager
def start_cluster(folder: Path, environment: Mapping[str, str], workers: int = 2) -> Iterator[Cluster]:
    """A cluster whose workers have one thread each and run in a folder; the test is skipped without Dask."""
    distributed = pytest.importorskip("distributed", reason="`uv sync --extra cluster` installs distributed")
    with ExitStack() as stack:
        scheduler = stack.enter_context(distributed.LocalCluster(n_workers=0, dashboard_address=None))
        address = scheduler.scheduler_address
        started = [
            stack.enter_context(ForkedProcess(_serve, address, folder=folder, environment=environment))
            for _ in range(workers)
        ]
        if workers:
            with distributed.Client(scheduler, set_as_default=False) as client:
                client.wait_for_workers(workers, timeout=100)
        yield Cluster(address, started)


def _serve(address: str) -> None:
    """Be a worker until the scheduler is gone, or the process is killed."""
    from distributed import Worker

    async def serve() -> None:
        async with Worker(address, nthreads=1, dashboard_address=None) as worker:
            await worker.finished()

    asyncio.run(serve())
