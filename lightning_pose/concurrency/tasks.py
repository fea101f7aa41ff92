"""The one way to run many independent tasks: on threads of this process, or on the workers of a Dask cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

from lightning_pose.errors import ConfigError

if TYPE_CHECKING:
    from distributed import Client

__all__ = ["LOCAL", "SCHEDULER_HELP", "run_tasks"]

T = TypeVar("T")
R = TypeVar("R")

LOCAL = "local"
"""Instead of a scheduler's address: a cluster of processes on this machine, for one call."""

SCHEDULER_HELP = (
    f"Dask's scheduler, such as tcp://HOST:8786, or `{LOCAL}` for processes on this machine (extra `cluster`)"
)

CONNECT_SECONDS = 10


def run_tasks(
    function: Callable[[T], R], tasks: Sequence[T], workers: int | None = None, scheduler: str | None = None
) -> Iterator[tuple[int, R]]:
    """Call a function with each task, several at a time.

    A task whose worker is killed runs again on another one, so that a function with effects must allow for being called
    twice; after four workers it is given up. If the caller stops early, by an error or Ctrl-C, tasks that have not
    begun are dropped, and those under way on a cluster are finished.

    Args:
        function: with a scheduler, it is pickled, as the tasks and results are, and called in a thread of a worker.
        tasks: its arguments.
        workers: threads, or processes with `local`; as many as there are cores if None. A cluster has its own number.
        scheduler: address of Dask's scheduler, whose workers were started in this folder of a shared disk; or `local`;
            threads of this process if None.

    Yields:
        The number of a task and the function's result, as tasks end.

    Raises:
        ConfigError: Dask is not installed, the scheduler is out of reach or has no worker, or one in another folder.
        KilledWorker: a task has ended four workers.
        Exception: what the function raises.
    """
    import joblib  # here, as Dask below: parsers read this file's texts

    calls = [joblib.delayed(_call_numbered)(function, number, task) for number, task in enumerate(tasks)]
    options: dict[str, Any] = {"return_as": "generator_unordered", "batch_size": 1, "pre_dispatch": "all"}
    if scheduler is None:
        yield from cast(Iterator[tuple[int, R]], joblib.Parallel(workers or -1, backend="threading", **options)(calls))
        return
    with _connect(scheduler, workers) as client, joblib.parallel_config(backend="dask", client=client):
        yield from cast(Iterator[tuple[int, R]], joblib.Parallel(**options)(calls))


def _call_numbered(function: Callable[[T], R], number: int, task: T) -> tuple[int, R]:
    return number, function(task)


@contextmanager
def _connect(scheduler: str, workers: int | None) -> Iterator[Client]:
    """A client of a cluster that has workers in this folder.

    Raises:
        ConfigError: as `run_tasks`.
    """
    if find_spec("distributed") is None:
        raise ConfigError(
            f"--scheduler {scheduler} needs Dask's distributed; `uv sync --extra cluster` installs it, or leave it out"
        )
    import joblib
    from distributed import Client, LocalCluster

    if scheduler == LOCAL:
        options: dict[str, Any] = {"threads_per_worker": 1, "dashboard_address": None}  # no web page
        cluster = LocalCluster(n_workers=workers or joblib.cpu_count(), **options)
        with cluster, Client(cluster, set_as_default=False) as client:
            yield client
        return
    try:
        client = Client(scheduler, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"--scheduler is {scheduler}, which does not answer ({error}); start one with `dask scheduler`, or give "
            "its address as tcp://HOST:8786"
        ) from error
    with client:
        _check_workers(client, scheduler)
        yield client


def _check_workers(client: Client, scheduler: str) -> None:
    """Refuse a cluster without workers, or with one in another folder, where paths would mean other files."""
    try:
        client.wait_for_workers(1, timeout=CONNECT_SECONDS)
    except TimeoutError as error:
        raise ConfigError(f"{scheduler} has no workers; start some with `dask worker {scheduler}`") from error
    here = Path.cwd()
    for worker, folder in cast(dict[str, Path], client.run(Path.cwd)).items():
        if folder != here:
            raise ConfigError(f"the worker {worker} runs in {folder}, and this command in {here}; start both in one")
